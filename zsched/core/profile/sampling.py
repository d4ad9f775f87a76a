"""PROFILE: how soon this machine is measured again: often while anything changes, once a second while nothing does.

Means are weighted by the time that has passed (`zsched.core.profile.means`), so the samples may be uneven.

Knows: the raw samples. Does not know: how they are read, what work has come (it is told).
"""

from __future__ import annotations

import math
from typing import Final

from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource
from zsched.core.values.struct import Struct

REST_S: Final = 1.0
"""Period of the samples of a machine at rest."""
CHANGING_S: Final = 3.0
"""After the last change a machine is measured often for this long."""
BUSY_CORES: Final = 0.05
"""A worker that uses as much is at work."""
LOAD_CHANGE: Final = 0.1
"""This change of the share of the cores in use is one; below it are the kernel's ticks."""
MEMORY_CHANGE: Final = 0.02
PRESSURE: Final = 0.05
"""Some process lacks a CPU for this share of the time."""


class Sampling(Struct):
    """The times of one node's samples."""

    period_s: float
    """While anything changes."""
    _changed_at: float = -math.inf
    _like: DeviceSample | None = None
    """The sample that the next ones are held against: the one of the last change."""

    def hurry(self, now: float) -> None:
        """Something happens here: a worker starts, gets a role, or has done jobs."""
        self._changed_at = now

    def next_s(self, device: DeviceSample, links: tuple[LinkSample, ...], now: float, *, is_watched: bool) -> float:
        """How long to wait after this sample.

        Args:
            device: it.
            links: its links. A radio is measured often at all times.
            now: monotonic seconds.
            is_watched: the clocks must be compared often, for an exclusive task.
        """
        if self._like is None or _is_busy(device) or _has_changed(device, self._like):
            self._like, self._changed_at = device, now
        has_radio = any(link.source is not LinkSource.WIRED for link in links)
        if is_watched or has_radio or now < self._changed_at + CHANGING_S:
            return self.period_s
        return max(REST_S, self.period_s)


def _is_busy(device: DeviceSample) -> bool:
    if device.cpu_pressure is not None and device.cpu_pressure >= PRESSURE:
        return True
    return any((load.cpu_cores or 0.0) >= BUSY_CORES or load.wanted_cores is not None for load in device.workers)


def _has_changed(new: DeviceSample, old: DeviceSample) -> bool:
    if (new.cpu_cores, new.memory_mb) != (old.cpu_cores, old.memory_mb):
        return True
    if _states(new) != _states(old):
        return True
    load = _distance(new.cpu_used_cores, old.cpu_used_cores) / max(new.cpu_cores, 0.01)
    memory = _distance(new.memory_used_mb, old.memory_used_mb) / max(new.memory_mb, 1.0)
    return load >= LOAD_CHANGE or memory >= MEMORY_CHANGE


def _states(device: DeviceSample) -> tuple[tuple[str, str], ...]:
    return tuple((load.task, load.state.value) for load in device.workers)


def _distance(new: float | None, old: float | None) -> float:
    """How far two figures are apart; one that is measured is infinitely far from one that is not."""
    if new is None or old is None:
        return 0.0 if new is old else math.inf
    return abs(new - old)
