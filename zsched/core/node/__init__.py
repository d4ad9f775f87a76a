"""The door of one daemon: what each event does, and the stages behind it."""
