"""Who elects: the fleet register, its changes, and what follows from them for the registers of tasks."""
