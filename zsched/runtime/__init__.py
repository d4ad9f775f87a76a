"""What the daemon is built of."""
