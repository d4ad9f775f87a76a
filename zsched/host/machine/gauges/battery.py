"""The charge of the machine's own batteries, by /sys/class/power_supply (the kernel's sysfs-class-power).

Knows: batteries of the system; several give their mean. Does not know: batteries of mice and headsets (``scope``
Device), and batteries that only a robot's own controller knows.
"""

from __future__ import annotations

from pathlib import Path

from zsched.host.machine.gauges import number

_FULL = (("energy_now", "energy_full"), ("charge_now", "charge_full"))


class Reader:
    """The mean charge in [0, 1]."""

    def __init__(self, root: Path) -> None:
        """Files below ``root``."""
        self._folder = root / "sys/class/power_supply"

    def read(self) -> float | None:
        """``None`` without a battery."""
        charges = [charge for supply in sorted(self._folder.glob("*")) if (charge := _charge(supply)) is not None]
        return sum(charges) / len(charges) if charges else None


def _charge(supply: Path) -> float | None:
    if _word(supply / "type") != "Battery" or _word(supply / "scope") == "Device":
        return None
    percent = number(supply / "capacity")
    if percent is not None:
        return min(max(percent / 100.0, 0.0), 1.0)
    for now, full in _FULL:
        held, most = number(supply / now), number(supply / full)
        if held is not None and most:
            return min(max(held / most, 0.0), 1.0)
    return None


def _word(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
