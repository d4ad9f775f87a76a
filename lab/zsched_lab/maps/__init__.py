"""Maps of laser scans, and how good they are."""
