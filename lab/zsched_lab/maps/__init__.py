"""Maps of laser scans, the logs with the scans, and how good the maps are."""
