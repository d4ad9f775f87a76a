"""Reads the machine's gauges, one file each, in a thread of their own: a driver that hangs must not stop the profile.

Knows: that the gauge called NAME (`zsched.core.values.gauges`) is read by ``Reader`` in NAME.py, how often, how long a
reading counts. Does not know: what a reading is worth.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from pathlib import Path
from typing import Final, Protocol

from zsched.core.profile.means import STALE_S
from zsched.core.values.gauges import GAUGES
from zsched.core.values.words import Readings
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

LOOK_S: Final = 2.0
REST_S: Final = 30.0
"""Between two looks at a machine that has never had one of the gauges."""


class Reader(Protocol):
    """One gauge of this machine."""

    def read(self) -> float | None:
        """The reading in the gauge's unit; ``None`` without one. May raise `OSError` and `ValueError`: no reading."""


def readers(root: Path = Path("/")) -> dict[str, Reader]:
    """{gauge: its reader} of all gauges, for files below ``root``."""
    return {gauge.name: importlib.import_module(f"{__name__}.{gauge.name}").Reader(root) for gauge in GAUGES}


def number(file: Path) -> float | None:
    """The number in a file of sysfs; ``None`` when there is none, or the driver has none now."""
    try:
        return float(file.read_bytes())
    except (OSError, ValueError):
        return None


class GaugeWatch:
    """Reads all gauges again and again."""

    def __init__(self, root: Path = Path("/")) -> None:
        """Files below ``root`` ("/" but in tests)."""
        self._readers = readers(root)
        self._stop = threading.Event()
        self._kept: dict[str, tuple[float, float]] = {}
        """{gauge: (its newest reading, when it was read)}."""
        self._thread = guarded(self._run, name="zsched-gauges")

    def start(self) -> None:
        """Begin reading."""
        self._thread.start()

    def stop(self) -> None:
        """End reading; a driver that hangs is not waited for."""
        self._stop.set()

    def newest(self, now: float) -> Readings:
        """The newest reading of every gauge, unless it is older than `STALE_S`: a driver may miss one."""
        kept = self._kept
        return tuple((name, reading) for name, (reading, at) in kept.items() if now - at <= max(STALE_S, LOOK_S))

    def look(self) -> Readings:
        """Read all gauges now."""
        found = []
        for name, reader in self._readers.items():
            with contextlib.suppress(OSError, ValueError):
                reading = reader.read()
                if reading is not None:
                    found.append((name, reading))
        now = monotonic_s()
        self._kept = {**self._kept, **{name: (reading, now) for name, reading in found}}
        return tuple(found)

    def _run(self) -> None:
        while not self._stop.is_set():
            self.look()
            self._stop.wait(LOOK_S if self._kept else REST_S)
