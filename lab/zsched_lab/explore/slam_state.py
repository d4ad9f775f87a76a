"""SLAM of one robot as plain state: scans with odometry go in, corrected poses and maps come out.

Knows: the map, the newest pose, when a map is due, its own state as bytes. Does not know: zenoh, processes, nodes.
"""

from __future__ import annotations

import json
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from zsched.core.values.errors import WireError
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.laser import SCAN_PERIOD_S, LaserScan
from zsched_lab.explore.mapper import ScanMapper
from zsched_lab.explore.matching import ScanMatcher
from zsched_lab.explore.messages import Correction
from zsched_lab.maps.mapping import RESOLUTION_M

SNAPSHOT_SCHEMA = "zsched.slam.snapshot/1"
_HEAD = struct.Struct("<4sI")
_MAGIC = b"ZSL1"
MAX_CELLS = 25_000_000
"""Of a snapshot's map: 250 m x 250 m at 0.05 m. More is not what a robot of the lab maps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlamSettings:
    """One robot's SLAM: ``map_period_s`` from map to map, ``resolution_m`` of its cells.

    ``cores``: the CPU that it takes while scans come at their 5 Hz, in cores (0: the least that matches a scan).
    """

    robot: str
    resolution_m: float = RESOLUTION_M
    cores: float = 0.0
    map_period_s: float = 2.0
    seed: int = 1


class Slam:
    """The state. ``spent_s`` is the CPU clock that the share is taken by: that of the whole process."""

    def __init__(self, settings: SlamSettings, *, spent_s: Callable[[], float] = time.process_time) -> None:
        self._settings = settings
        self._spent_s = spent_s
        self._mapper = ScanMapper(resolution=settings.resolution_m, frame_id=f"{settings.robot}/map")
        random = np.random.default_rng((settings.seed, *settings.robot.encode()))
        self._matcher = ScanMatcher(random, cpu_s=settings.cores * SCAN_PERIOD_S, spent_s=spent_s)
        self._last: tuple[Pose2, Pose2] | None = None
        """(odometry, pose) of the newest scan."""
        self._spent_until_s = spent_s()
        self._stamp_ns = 0
        self._next_map_s = float("-inf")
        self.scans = 0

    def take(self, scan: LaserScan, odometry: Pose2) -> Correction:
        """Work in one scan that was taken where ``odometry`` says; returns where the robot was."""
        if self._last is None:
            pose, fit = odometry, 0.0
        else:
            predicted = self._last[1].compose(self._last[0].inverse().compose(odometry))
            match = self._matcher.match(self._mapper, scan, predicted, self._spent_until_s)
            pose, fit = match.pose, match.fit
        self._spent_until_s = self._spent_s()  # what comes from here on, mapping included, is of the next scan's share
        self._mapper.add(pose, scan)
        self._last, self._stamp_ns = (odometry, pose), scan.stamp_ns
        self.scans += 1
        return Correction(stamp_ns=scan.stamp_ns, pose=pose, fit=fit)

    def due_map(self, now: float) -> Grid | None:
        """The map, when one is due at ``now`` (monotonic seconds) and there was a scan."""
        if self._last is None or now < self._next_map_s:
            return None
        period_s = self._settings.map_period_s
        late = self._next_map_s == float("-inf") or now > self._next_map_s + period_s
        self._next_map_s = (now if late else self._next_map_s) + period_s
        return self._mapper.grid(self._stamp_ns)

    # --- the state on its way to the next owner -----------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """Map and pose, for the next owner: it goes on where this one ended."""
        last = None if self._last is None else [[pose.x, pose.y, pose.yaw] for pose in self._last]
        body: dict[str, Any] = {"schema": SNAPSHOT_SCHEMA, "robot": self._settings.robot}
        body |= {"resolution": self._settings.resolution_m, "stamp_ns": self._stamp_ns, "scans": self.scans}
        cells, where = self._mapper.state()
        head = json.dumps(body | {"last": last} | where).encode()
        return _HEAD.pack(_MAGIC, len(head)) + head + zlib.compress(cells.tobytes(), 1)

    def restore(self, snapshot: bytes) -> None:
        """Take over the state of the owner before.

        Raises:
            WireError: the bytes are no snapshot of this robot's SLAM; the state is as it was.
        """
        try:
            body, cells = _read(snapshot, self._settings)
            last = None if body["last"] is None else _poses(body["last"])
            stamp_ns, scans = int(body["stamp_ns"]), int(body["scans"])
            self._mapper.restore(cells, body)
        except (struct.error, zlib.error, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise WireError("slam snapshot", repr(error)) from error
        self._last, self._stamp_ns, self.scans = last, stamp_ns, scans
        self._next_map_s = float("-inf")
        self._spent_until_s = self._spent_s()


def _read(snapshot: bytes, settings: SlamSettings) -> tuple[dict[str, Any], npt.NDArray[np.int8]]:
    """The head and the cells of a snapshot; raises what `Slam.restore` understands."""
    magic, size = _HEAD.unpack_from(snapshot)
    body = json.loads(snapshot[_HEAD.size : _HEAD.size + size])
    if magic != _MAGIC or body["schema"] != SNAPSHOT_SCHEMA:
        raise ValueError("another schema")
    if (body["robot"], body["resolution"]) != (settings.robot, settings.resolution_m):
        raise ValueError(f"of {body['robot']!r} at {body['resolution']!r} m per cell")
    rows, columns = (int(value) for value in body["shape"])
    if rows < 0 or columns < 0 or rows * columns > MAX_CELLS:
        raise ValueError(f"{rows} x {columns} cells")
    data = zlib.decompressobj().decompress(snapshot[_HEAD.size + size :], rows * columns + 1)
    return body, np.frombuffer(data, dtype=np.int8).reshape(rows, columns)


def _poses(raw: Any) -> tuple[Pose2, Pose2]:
    odometry, pose = (Pose2(x=float(x), y=float(y), yaw=float(yaw)) for x, y, yaw in raw)
    if not (odometry.is_finite and pose.is_finite):
        raise ValueError("poses that are not finite")
    return odometry, pose
