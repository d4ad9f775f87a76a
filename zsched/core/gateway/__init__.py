"""Stage 2: what every robot knows of all machines."""
