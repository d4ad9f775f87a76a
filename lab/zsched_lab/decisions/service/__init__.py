"""Judges rules by what the task gets: cores, outputs, deadlines, moves at their price."""
