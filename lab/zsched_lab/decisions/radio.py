"""Decides what signal a driving robot has: path loss, shadowing that keeps for metres, fading that changes at once.

Knows: log-distance path loss, Gudmundson's shadowing (Electronics Letters 27(23), 1991), Rician fading, recorded
drives. Does not know: what a signal is worth, who decides by it.

The constants fit the recorded drives: -80 .. -40 dBm in a hall, single readings 2.5 - 2.9 dB about their mean.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from zsched.host.radio.network_profiler import parse_trace, read_text

Array = npt.NDArray[np.float64]

AT_1_M_DBM = -36.0
EXPONENT = 2.8
"""Of the path loss, indoors with obstacles."""
SHADOWING_DB = 4.0
DECORRELATION_M = 5.0
"""Over this distance the correlation of the shadowing falls to 1/e."""
RICE_K = 5.5
"""Power of the direct path over the scattered ones: 2.75 dB of scatter."""
SPEED_M_S = 0.5
FLOOR_DBM, CEILING_DBM = -98.0, -20.0


def walk(steps: int, dt_s: float, side_m: float, rng: np.random.Generator) -> Array:
    """Positions [steps, 2] in metres of a robot that drives from one random waypoint to the next."""
    corners, arrivals = [rng.uniform(0.0, side_m, 2)], [0.0]
    while arrivals[-1] < steps * dt_s:
        corners.append(rng.uniform(0.0, side_m, 2))
        arrivals.append(arrivals[-1] + float(np.hypot(*(corners[-1] - corners[-2]))) / SPEED_M_S)
    at_s = np.arange(steps) * dt_s
    way = np.asarray(corners)
    return np.stack([np.interp(at_s, arrivals, way[:, axis]) for axis in (0, 1)], axis=1)


def shadowing(moved_m: Array, rng: np.random.Generator) -> Array:
    """Shadowing in dB along a way: ``rho = exp(-distance / decorrelation)`` from each step to the next (Gudmundson).

    Args:
        moved_m: metres from the step before, [steps].
        rng: seeded.
    """
    keep = np.exp(-moved_m / DECORRELATION_M)
    fresh = rng.normal(0.0, SHADOWING_DB, len(moved_m)) * np.sqrt(1.0 - keep**2)
    out = np.empty(len(moved_m))
    value = rng.normal(0.0, SHADOWING_DB)
    for index, (share, new) in enumerate(zip(keep.tolist(), fresh.tolist(), strict=True)):
        value = share * value + new
        out[index] = value
    return out


def path_loss_dbm(distance_m: Array) -> Array:
    """Mean signal by distance: ``-36 dBm - 28 log10(d)``, d at least 1 m."""
    return AT_1_M_DBM - 10.0 * EXPONENT * np.log10(np.maximum(distance_m, 1.0))


def fading_db(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Rician fading of single readings in dB, with mean 0: a new one every reading (they are 0.2 s apart)."""
    scattered = rng.normal(0.0, math.sqrt(0.5), (2, *shape))
    power = (math.sqrt(RICE_K) + scattered[0]) ** 2 + scattered[1] ** 2
    decibels = 10.0 * np.log10(np.maximum(power, 1e-6))
    faded: Array = decibels - decibels.mean()
    return faded


def hall_signals(
    steps: int, dt_s: float, robots: int, stations: int, rng: np.random.Generator, side_m: float = 30.0
) -> Array:
    """Local mean signals [steps, robots, stations] in dBm, of robots driving among fixed stations in a hall."""
    places = rng.uniform(0.0, side_m, (stations, 2))
    out = np.empty((steps, robots, stations))
    for robot in range(robots):
        way = walk(steps, dt_s, side_m, rng)
        moved = np.hypot(*np.diff(way, axis=0, prepend=way[:1]).T)
        for station in range(stations):
            distance = np.hypot(*(way - places[station]).T)
            out[:, robot, station] = path_loss_dbm(distance) + shadowing(moved, rng)
    return np.clip(out, FLOOR_DBM, CEILING_DBM)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """A recorded drive at an even step: signal (NaN: none) and round-trip delay (NaN: none) by time."""

    name: str
    dt_s: float
    rssi_dbm: Array
    delay_ms: Array

    def shifted(self, seconds: float) -> Drive:
        """The same drive, begun ``seconds`` later (it starts again at its end)."""
        steps = -round(seconds / self.dt_s)
        return Drive(
            name=f"{self.name}+{seconds:g}s",
            dt_s=self.dt_s,
            rssi_dbm=np.roll(self.rssi_dbm, steps),
            delay_ms=np.roll(self.delay_ms, steps),
        )


def read_drive(path: Path, dt_s: float = 0.2, rssi_column: str = "c_rssi") -> Drive:
    """Read a drive's CSV (see `zsched.host.radio.network_profiler.parse_trace`; the signal is read by that code).

    Raises:
        OSError: the file cannot be read.
        ValueError: a column is missing.
    """
    text = read_text(path)
    signal = parse_trace(text, rssi_column)
    steps = int(signal.duration_s / dt_s)
    values = [signal.at(step * dt_s) for step in range(steps)]
    return Drive(
        name=path.name.split(".")[0],
        dt_s=dt_s,
        rssi_dbm=np.asarray([math.nan if value is None else value for value in values]),
        delay_ms=_delays(text, steps, dt_s),
    )


def _delays(text: str, steps: int, dt_s: float) -> Array:
    """Round-trip delays in ms at each step: the newest within 2 s, NaN where there is none."""
    rows = list(csv.reader(text.splitlines()))
    header = [name.strip() for name in rows[0]]
    if "network_delay" not in header:
        return np.full(steps, math.nan)
    time_at, delay_at = header.index("time_stamp"), header.index("network_delay")
    first: float | None = None
    out = np.full(steps, math.nan)
    for row in rows[1:]:
        try:
            stamp_s, delay_ms = float(row[time_at]) / 1e9, float(row[delay_at])
        except (ValueError, IndexError):
            continue
        first = stamp_s if first is None else min(first, stamp_s)
        begin = int((stamp_s - first) / dt_s) + 1
        if delay_ms > 0.0:
            out[begin : begin + round(2.0 / dt_s)] = delay_ms
    return out
