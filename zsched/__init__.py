"""zsched: masterless scheduling of shared robot tasks over zenoh."""

__version__ = "0.1.0"
