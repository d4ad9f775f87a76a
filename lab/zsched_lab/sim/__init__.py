"""Fleets of real nodes on a simulated network, clock and disk, and schedules of faults by seed."""
