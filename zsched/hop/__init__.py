"""Numbered, acknowledged streams."""
