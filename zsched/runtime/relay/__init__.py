"""The relay's process, as the daemon sees it."""
