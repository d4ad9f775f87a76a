"""Between the daemon and its relay."""
