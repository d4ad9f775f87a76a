"""Who belongs to the fleet, who is there, and who is who."""
