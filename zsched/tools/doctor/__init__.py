"""What `zsched doctor` looks at: one small function per check, in the file of its family, listed in `table`."""
