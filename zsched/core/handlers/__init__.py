"""The handlers of events: one file per subject."""
