"""Real fleets on this machine: daemons, loads, links, and what watches them."""
