"""Figures, not tests: each module prints what it measured, with n, percentiles and the goal beside it."""
