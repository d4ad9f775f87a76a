"""Configurations and links of zenoh sessions."""
