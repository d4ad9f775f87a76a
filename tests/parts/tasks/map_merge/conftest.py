"""What robots see of the synthetic office, for all tests here."""

from support.office import office, view

__all__ = ["office", "view"]
