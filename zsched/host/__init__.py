"""This machine, one outside thing each: its clock, files, processes, figures, radio, service manager."""
