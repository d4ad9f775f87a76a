"""The verbs that look."""
