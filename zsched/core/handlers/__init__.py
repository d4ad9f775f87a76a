"""What each event means to the stages: a file for what it is about."""
