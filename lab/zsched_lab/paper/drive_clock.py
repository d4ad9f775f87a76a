"""Finds where in its drive each robot was when a run began: a daemon begins a drive at its own first reading.

Knows: the drive's readings, and what a daemon said of them (smoothed, so late). Does not know: schemes, owners.

Schemes smooth differently. To score all of them by the same signal, it is read from the drive itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from zsched.config.load import load_fleet
from zsched.core.values.fleet import LinkSpec
from zsched.core.values.model import NodeId
from zsched.core.values.profile import LinkSource
from zsched.host.radio.network_profiler import Trace, parse_trace, read_text

STEP_S = 0.1
LONGEST_START_S = 60.0
"""No run takes longer from a daemon's first reading to the robots' start."""
Series = Sequence[tuple[float, float]]


class DriveClock:
    """One robot's drive by the run's time."""

    def __init__(self, trace: Trace, offset_s: float, begun_s: float) -> None:
        self._trace, self._offset_s = trace, offset_s
        self.begun_s = begun_s
        """How long before the run's zero the drive began."""

    def at(self, t_s: float) -> float | None:
        """The recorded signal (dBm) at ``t_s`` of the run; ``None`` where nothing was recorded."""
        return self._trace.at(t_s + self.begun_s + self._offset_s)


def clocks(folder: Path, said: Mapping[NodeId, Series]) -> dict[NodeId, DriveClock]:
    """Every robot's drive in the run of ``folder``, aligned with what its daemon said of it.

    Raises:
        ConfigError: the folder's fleet file cannot be read.
        OSError: a drive is gone.
        ValueError: a robot follows no drive.
    """
    fleet = load_fleet(folder / "fleet.yaml")
    found = {}
    for robot, series in sorted(said.items()):
        spec = own_drive(fleet.node(robot).links)
        trace = parse_trace(read_text(Path(spec.value)), spec.column)
        begun_s = begun_before(series, trace, spec.offset_s, fleet.timing.smoothing_s)
        found[robot] = DriveClock(trace, spec.offset_s, begun_s)
    return found


def own_drive(links: Sequence[LinkSpec]) -> LinkSpec:
    """The drive that the robot's own way follows. Raises `ValueError` when there is none."""
    for link in links:
        if link.source is LinkSource.TRACE and link.peer is None:
            return link
    raise ValueError("the robot's own way follows no drive")


def begun_before(said: Series, trace: Trace, offset_s: float, smoothing_s: float) -> float:
    """How long before time 0 of ``said`` the drive began: the lead (s) at which the smoothed drive is nearest to it.

    Nearest: the least mean distance in dB. ``said`` [(t_s, dBm)] is what the daemon smoothed with ``smoothing_s``.

    Raises:
        ValueError: nothing was said from time 0 on.
    """
    inside = [(t_s, dbm) for t_s, dbm in said if t_s >= 0.0]
    if not inside:
        raise ValueError("no robot's signal was recorded")
    places = np.array([round(t_s / STEP_S) for t_s, _ in inside])
    values = np.array([dbm for _, dbm in inside])
    leads = int(LONGEST_START_S / STEP_S)
    smooth = smoothed(trace, offset_s, smoothing_s, int(places.max()) + leads + 1)
    far = [float(np.abs(smooth[places + lead] - values).mean()) for lead in range(leads)]
    return int(np.argmin(far)) * STEP_S


def smoothed(trace: Trace, offset_s: float, smoothing_s: float, steps: int) -> np.ndarray:
    """The drive every `STEP_S` from its begin on, smoothed as daemons do (`zsched.core.profile.profile.Ewma`)."""
    keep = math.exp(-STEP_S / smoothing_s) if smoothing_s > 0.0 else 0.0
    value = math.nan
    found = np.empty(steps)
    for step in range(steps):
        read = trace.at(step * STEP_S + offset_s)
        if read is not None:
            value = read if math.isnan(value) else keep * value + (1.0 - keep) * read
        found[step] = value
    first = found[np.isfinite(found)]
    return np.nan_to_num(found, nan=float(first[0]) if first.size else 0.0)
