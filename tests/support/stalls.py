"""How this machine was while a test ran: whether it stood still, how long its disk took, what processes waited for.

Knows: its own clock, one small file, Linux' pressure figures. Does not know: tests.

A fleet of real processes cannot tell a fault of its own from a machine that stands still. Whoever reads a red test can:
`tests/conftest.py` prints below it what is measured here.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONG_S = 1.0
"""What took less is not told."""
PERIOD_S = 0.1
DISK_PERIOD_S = 1.0
SLEPT = "this process did not run"
SYNCED = "4 KiB were on their way to the disk"
PRESSURE = Path("/proc/pressure")


@dataclass(frozen=True, slots=True)
class Moment:
    """A time (monotonic), and how long some process had waited by then for what, in seconds."""

    at: float
    waited: dict[str, float]


def now() -> Moment:
    """This moment."""
    return Moment(time.monotonic(), {kind: _waited(kind) for kind in ("cpu", "io", "memory")})


def _waited(kind: str) -> float:
    with contextlib.suppress(OSError, ValueError):
        some = (PRESSURE / kind).read_text().splitlines()[0]
        return int(some.rpartition("=")[2]) / 1e6
    return 0.0  # a kernel without these figures


class Stalls:
    """One thread sleeps and looks at the clock, one writes to the disk; both until `close`."""

    def __init__(self, file: Path) -> None:
        """``file``: on the disk that tests use; it is written every second."""
        self._file = file
        self._over = threading.Event()
        self._begun: dict[str, float] = {}
        """{what goes on now: since when}."""
        self._long: list[tuple[float, float, str]] = []
        """(begin, seconds, what)."""
        self._threads = [threading.Thread(target=look, daemon=True) for look in (self._sleep, self._write)]
        for thread in self._threads:
            thread.start()

    def _sleep(self) -> None:
        while not self._over.is_set():
            with self._timed(SLEPT, expected_s=PERIOD_S):
                time.sleep(PERIOD_S)

    def _write(self) -> None:
        while not self._over.wait(DISK_PERIOD_S):
            with self._timed(SYNCED), contextlib.suppress(OSError), self._file.open("wb") as file:
                file.write(bytes(4096))
                file.flush()
                os.fsync(file.fileno())

    @contextlib.contextmanager
    def _timed(self, what: str, expected_s: float = 0.0) -> Iterator[None]:
        self._begun[what] = begun = time.monotonic()
        yield
        del self._begun[what]
        took_s = time.monotonic() - begun - expected_s
        if took_s >= LONG_S:
            self._long.append((begun, took_s, what))

    def told(self, since: Moment) -> str:
        """What there is to say of the time since then, some lines."""
        until = now()
        lasts = [(begun, until.at - begun, f"{what}, and still") for what, begun in tuple(self._begun.items())]
        found = [one for one in (*self._long, *lasts) if one[0] + one[1] >= since.at and one[1] >= LONG_S]
        took_s = max(until.at - since.at, 0.001)
        shares = [f"{kind} {(until.waited[kind] - since.waited[kind]) / took_s:.0%}" for kind in until.waited]
        load = " ".join(f"{one:.1f}" for one in os.getloadavg())
        lines = [
            f"load {load} on {os.cpu_count()} cores; of {took_s:.0f} s some process waited for {', '.join(shares)}"
        ]
        lines += [f"{begun - until.at:+.1f} s: {what} for {long_s:.1f} s" for begun, long_s, what in sorted(found)]
        return "\n".join(lines)

    def close(self) -> None:
        """End both threads and remove the file."""
        self._over.set()
        for thread in self._threads:
            thread.join(60)
        self._file.unlink(missing_ok=True)
