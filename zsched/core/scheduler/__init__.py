"""Stage 3: the score of every candidate, and when to propose another one."""
