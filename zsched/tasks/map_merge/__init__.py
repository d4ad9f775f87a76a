"""The reference task: merging the maps of several robots."""
