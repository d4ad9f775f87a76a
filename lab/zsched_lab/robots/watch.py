"""Follows what the robots' applications record: merged maps, gaps, drives, and the merger's word on each robot.

Knows: the records of `zsched_lab.robots.app`. Does not know: the fleet, pictures.
"""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zsched.core.values.model import NodeId
from zsched_lab.fleet.recorder import Follower, Record
from zsched_lab.fleet.view import MapView
from zsched_lab.maps.picture import MapPicture

RATE_WINDOW_S = 5.0


@dataclass(slots=True)
class RobotWatch:
    """One robot's story so far; times on the daemon's clock."""

    robot: NodeId
    follower: Follower
    map_times: list[float] = field(default_factory=list)
    progress: Record = field(default_factory=dict)
    status: Any = None
    """The merger's newest word, as decoded JSON."""
    picture: MapPicture | None = None
    """The newest that was recorded."""

    @classmethod
    def of(cls, robot: NodeId, records: Path) -> RobotWatch:
        """Follow the robot's file in ``records``."""
        return cls(robot=robot, follower=Follower(records / f"{robot}.ndjson"))

    def update(self) -> None:
        """Read what is new."""
        for record in self.follower.new():
            kind = record.get("kind")
            if kind == "map":
                self.map_times.append(float(record["t_s"]))
            elif kind == "progress":
                self.progress = record
            elif kind == "status":
                self.status = record.get("status")
            elif kind == "picture":
                self.picture = MapPicture.read(record)

    def view(self, now: float) -> MapView:
        """The robot's row at ``now``."""
        last = self.map_times[-1] if self.map_times else None
        return MapView(
            robot=self.robot,
            maps=len(self.map_times),
            rate_hz=self.rate_hz(now),
            age_s=None if last is None else now - last,
            gap_max_s=self.longest_gap_s(),
            scans=int(self.progress.get("scans", 0)),
            scans_total=int(self.progress.get("scans_total", 0)),
            picture=self.picture,
        )

    def rate_hz(self, now: float) -> float | None:
        """Maps per second in the last seconds; ``None`` before the first map."""
        if not self.map_times:
            return None
        window = min(RATE_WINDOW_S, max(1.0, now - self.map_times[0]))
        return sum(now - t_s < window for t_s in self.map_times[-1000:]) / window

    def mean_hz(self, end_s: float) -> float | None:
        """Maps per second from the first map to ``end_s``; ``None`` with fewer than two."""
        if len(self.map_times) < 2:
            return None
        return (len(self.map_times) - 1) / max(1e-3, end_s - self.map_times[0])

    def longest_gap_s(self, end_s: float | None = None) -> float | None:
        """The longest silence between two maps, up to ``end_s`` if given; ``None`` before there is one."""
        if not self.map_times:
            return None
        times = [*self.map_times, *([] if end_s is None else [max(end_s, self.map_times[-1])])]
        return max((b - a for a, b in itertools.pairwise(times)), default=None)

    def gap_around_s(self, t_s: float) -> float | None:
        """From the last map before ``t_s`` to the next one; ``None`` when there is none on either side."""
        index = bisect.bisect_right(self.map_times, t_s)
        if index in {0, len(self.map_times)}:
            return None
        return self.map_times[index] - self.map_times[index - 1]
