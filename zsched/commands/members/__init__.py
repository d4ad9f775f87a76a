"""The verbs by which a fleet begins, and a machine comes into it and goes."""
