"""The lab's robots: their applications and their laser logs."""
