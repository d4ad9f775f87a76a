"""Tells who has installed this program: what a Debian package holds is apt's to change, and it has no pip.

Knows: the installed distribution's metadata. Does not know: what is to be installed.
"""

from __future__ import annotations


def is_debian_package() -> bool:
    """Whether this zsched is a Debian package (PEP 376's INSTALLER says so)."""
    from importlib.metadata import PackageNotFoundError, distribution  # noqa: PLC0415 - it loads the whole of `email`

    try:
        installer = distribution("zsched").read_text("INSTALLER") or ""
    except PackageNotFoundError:
        return False
    return installer.strip() == "dpkg"
