"""The hottest sensor of the machine: thermal zones and processors' own sensors, or else whatever hwmon has.

Knows: sensors that report no temperature of the machine: a zone that is off (the kernel's -274 °C, or 0), Jetson's
PMIC-Die, which always says 100 °C; drivers of processors, for on AMD's the only zone may be the firmware's, which can
stand still. Does not know: what else a sensor belongs to; a board's open pins may say 127 °C, so they come last.
"""

from __future__ import annotations

from pathlib import Path

from zsched.host.machine.gauges import number

NO_SENSORS = frozenset({"PMIC-Die"})
"""Types of zones whose figure is a constant."""
OF_PROCESSORS = frozenset({"k10temp", "zenpower", "coretemp", "cpu_thermal"})
"""Names in hwmon of drivers that read the processor itself."""


class Reader:
    """The highest temperature in °C."""

    def __init__(self, root: Path) -> None:
        """Files below ``root``."""
        self._class = root / "sys/class"

    def read(self) -> float | None:
        """``None`` without a sensor that tells anything."""
        thermal, hwmon = (self._class / "thermal").glob("thermal_zone*"), self._class / "hwmon"
        zones = [zone / "temp" for zone in thermal if _word(zone / "type") not in NO_SENSORS]
        own = [folder for folder in hwmon.glob("hwmon*") if _word(folder / "name") in OF_PROCESSORS]
        inside = [file for folder in own for file in folder.glob("temp*_input")]
        return max(_degrees([*zones, *inside]) or _degrees([*hwmon.glob("hwmon*/temp*_input")]), default=None)


def _degrees(files: list[Path]) -> list[float]:
    read = [milli / 1000.0 for file in files if (milli := number(file)) is not None]
    return [value for value in read if -60.0 < value < 200.0 and value]


def _word(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
