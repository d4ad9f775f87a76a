"""Reads recorded laser logs: the shipped Malaga keyframes (CSV) and any CARMEN log (FLASER lines).

Knows: the two text formats and what a reading at the range limit means. Does not know: grids or robots.

CARMEN (``.log``, ``.log.gz``): ``FLASER n r_1 .. r_n x y theta odom_x odom_y odom_theta ipc_timestamp host
logger_timestamp``; metres, radians, seconds; beam i points at theta - pi/2 + i * step, where step is pi / n for 180 or
360 beams and pi / (n - 1) for 181 or 361. Every other known line is skipped. Time stamps may step back in recorded
logs: the order of the lines is the order of the scans.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from zsched.core.values.errors import ConfigError
from zsched.host.files import read_packed
from zsched.tasks.map_merge.geometry import FloatArray, Pose2

MAX_LOG_BYTES = 256 << 20
CARMEN_MAX_RANGE_M = 20.0
"""Longer readings are dropped: the limits of the recorded sensors (about 50 or 81 m) mean "no echo"."""
MALAGA_MAX_RANGE_M = 30.0
MALAGA = "malaga-keyframes.csv.gz"

_CARMEN_SKIPPED = frozenset({"PARAM", "SYNC", "NEFF", "ODOM", "RLASER", "TRUEPOS", "MARKER"})
_CARMEN_TRAILER = 9  # x y theta, three odometry fields, two time stamps and the host


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One laser scan: only the beams that came back.

    ``t_s`` seconds since the first scan; ``pose`` of the laser in the log's map frame; ``angles`` (rad, in the laser's
    frame, counter-clockwise) and ``ranges`` (m), one entry per echo.
    """

    t_s: float
    pose: Pose2
    angles: FloatArray
    ranges: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserLog:
    """A recorded drive: its scans in the order in which they were written."""

    name: str
    scans: tuple[Scan, ...]

    @property
    def duration_s(self) -> float:
        """Seconds from the earliest scan to the latest; 0 for one scan."""
        times = [scan.t_s for scan in self.scans]
        return max(times) - min(times)


def malaga_path() -> Path:
    """The log that ships with the package (BSD-3-Clause, see data/NOTICE)."""
    return Path(str(resources.files("zsched_lab") / "data" / MALAGA))


def load_log(path: Path) -> LaserLog:
    """Read a laser log, the format told by the name: ``.csv[.gz]`` as Malaga keyframes, anything else as CARMEN.

    Raises:
        ConfigError: the file cannot be read, a line is malformed, or it holds no scan (file:line and why).
    """
    stem = path.name.removesuffix(".gz")
    read = _malaga_scan if stem.endswith(".csv") else _carmen_scan
    scans: list[Scan] = []
    for number, line in enumerate(_lines(path), start=1):
        scan = _parsed(read, line, path, number)
        if scan is not None:
            scans.append(scan)
    if not scans:
        raise ConfigError(f"{path}: no laser scan in it. Give a CARMEN log (FLASER lines) or the Malaga CSV.")
    first = min(scan.t_s for scan in scans)
    name = stem.removesuffix(".csv").removesuffix(".log").removesuffix("-corrected").removesuffix("-keyframes")
    return LaserLog(
        name=name,
        scans=tuple(
            Scan(t_s=scan.t_s - first, pose=scan.pose, angles=scan.angles, ranges=scan.ranges) for scan in scans
        ),
    )


def split_log(log: LaserLog, n: int) -> tuple[LaserLog, ...]:
    """Cut a log into ``n`` consecutive drives of equal numbers of scans (to one): robots 1..n.

    Each part keeps the log's time; a player subtracts its first stamp.

    Raises:
        ValueError: ``n`` is under 1 or above the number of scans.
    """
    count = len(log.scans)
    if not 1 <= n <= count:
        raise ValueError(f"a log of {count} scans cannot be split into {n} parts")
    cuts = [count * part // n for part in range(n + 1)]
    return tuple(
        LaserLog(name=f"{log.name}[{part + 1}/{n}]", scans=log.scans[cuts[part] : cuts[part + 1]]) for part in range(n)
    )


def _lines(path: Path) -> Iterator[str]:
    try:
        yield from io.StringIO(read_packed(path, MAX_LOG_BYTES).decode("ascii"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not readable as a laser log: {error}") from error


def _parsed(read: Callable[[str], Scan | None], line: str, path: Path, number: int) -> Scan | None:
    try:
        return read(line)
    except ValueError as error:
        raise ConfigError(f"{path}:{number}: {error}") from error


def _carmen_scan(line: str) -> Scan | None:
    word, _, rest = line.strip().partition(" ")
    if not word or word.startswith("#") or word in _CARMEN_SKIPPED:
        return None
    if word != "FLASER":
        skipped = ", ".join(sorted(_CARMEN_SKIPPED))
        raise ValueError(f"unknown CARMEN message {word[:20]!r}; known are FLASER, and as skipped {skipped}")
    fields = rest.split()
    if not fields or not fields[0].isdecimal():
        raise ValueError("FLASER without a number of beams")
    beams = int(fields[0])
    if beams < 2 or len(fields) != 1 + beams + _CARMEN_TRAILER:
        raise ValueError(f"FLASER {beams} has {len(fields) - 1} fields, expected {beams + _CARMEN_TRAILER}")
    ranges = _floats(fields[1 : 1 + beams])
    x, y, yaw = _floats(fields[1 + beams : 4 + beams])
    (t_s,) = _floats([fields[-3]])
    step = math.pi / (beams - 1 if beams % 2 else beams)
    return _scan(t_s, Pose2(x=x, y=y, yaw=yaw), ranges, step, CARMEN_MAX_RANGE_M)


def _malaga_scan(line: str) -> Scan | None:
    text = line.strip()
    if not text or text.startswith(("#", "t_s,")):
        return None
    fields = _floats(text.split(","))
    beams = len(fields) - 4
    if beams < 2:
        raise ValueError(f"{len(fields)} columns, expected t_s,x,y,yaw and at least two ranges")
    pose = Pose2(x=fields[1], y=fields[2], yaw=fields[3])
    return _scan(float(fields[0]), pose, fields[4:], math.pi / (beams - 1), MALAGA_MAX_RANGE_M)


def _floats(texts: list[str]) -> FloatArray:
    try:
        values = np.array(texts, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"not a number: {error}") from error
    if not np.isfinite(values).all():
        raise ValueError("not a finite number")
    return values


def _scan(t_s: float, pose: Pose2, ranges: FloatArray, step: float, max_range: float) -> Scan:
    angles = -math.pi / 2 + step * np.arange(len(ranges), dtype=np.float64)
    echo = (ranges > 0.0) & (ranges < max_range)
    pose = Pose2(x=float(pose.x), y=float(pose.y), yaw=float(pose.yaw))
    return Scan(t_s=float(t_s), pose=pose, angles=angles[echo], ranges=ranges[echo])
