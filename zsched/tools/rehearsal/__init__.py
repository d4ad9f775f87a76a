"""REHEARSAL: what a fleet promises for each fault, and the order in which they are played."""
