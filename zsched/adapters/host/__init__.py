"""The service manager, the state file, the operator's socket."""
