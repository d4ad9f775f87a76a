"""What travels between daemons: frames and keys."""
