"""Stage 6: key expressions and the routes of the streams."""
