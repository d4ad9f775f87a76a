"""Stage 4: votes, agreement and the lease."""
