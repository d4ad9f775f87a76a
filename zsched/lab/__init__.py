"""The lab: a whole fleet on one machine."""
