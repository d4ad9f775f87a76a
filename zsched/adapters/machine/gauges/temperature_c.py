"""The hottest sensor of the machine, by /sys/class/thermal, or by /sys/class/hwmon where there are no thermal zones.

Knows: sensors that report no temperature of the machine: a zone that is off (the kernel's -274 °C, or 0), Jetson's
PMIC-Die, which always says 100 °C. Does not know: which sensor belongs to what.
"""

from __future__ import annotations

from pathlib import Path

from zsched.adapters.machine.gauges import number

NO_SENSORS = frozenset({"PMIC-Die"})
"""Types of zones whose figure is a constant."""


class Reader:
    """The highest temperature in °C."""

    def __init__(self, root: Path) -> None:
        """Files below ``root``."""
        self._class = root / "sys/class"

    def read(self) -> float | None:
        """``None`` without a sensor that tells anything."""
        zones = [zone / "temp" for zone in (self._class / "thermal").glob("thermal_zone*") if not _is_constant(zone)]
        degrees = _degrees(zones) or _degrees([*(self._class / "hwmon").glob("hwmon*/temp*_input")])
        return max(degrees, default=None)


def _degrees(files: list[Path]) -> list[float]:
    read = [milli / 1000.0 for file in files if (milli := number(file)) is not None]
    return [value for value in read if -60.0 < value < 200.0 and value]


def _is_constant(zone: Path) -> bool:
    try:
        return (zone / "type").read_text(encoding="utf-8", errors="replace").strip() in NO_SENSORS
    except OSError:
        return False
