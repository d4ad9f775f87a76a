"""Wi-Fi of this machine."""
