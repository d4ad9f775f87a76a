"""Stage 4: votes, the register and the lease."""
