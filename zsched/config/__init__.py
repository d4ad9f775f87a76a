"""The fleet file: read, checked, explained."""
