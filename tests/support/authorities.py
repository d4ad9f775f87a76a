"""An authority for one test, and folders as machines of a secured fleet have them."""

from __future__ import annotations

from zsched_lab.fleet.secured import install, make_authority, secured

__all__ = ["install", "make_authority", "secured"]
