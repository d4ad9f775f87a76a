"""Closed-loop exploration: simulated robots that choose where to go on the merged map that they receive back."""
