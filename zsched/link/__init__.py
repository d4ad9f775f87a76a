"""Between processes: keys, seals, zenoh sessions, the control bus, the pipe to the relay."""
