"""What the tests must find: planted bugs, mutants, hostile frames and keys."""
