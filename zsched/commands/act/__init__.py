"""The verbs that change something: plan, question, order, and a look until a condition holds."""
