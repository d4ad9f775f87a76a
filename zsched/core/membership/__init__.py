"""Which nodes belong to the fleet, which are there, and whether a name is one node's alone."""
