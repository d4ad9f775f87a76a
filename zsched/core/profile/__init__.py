"""Stage 1: what a machine can give."""
