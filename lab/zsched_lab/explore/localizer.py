"""What a robot believes of its pose when SLAM elsewhere corrects its odometry, and when it must stop.

Knows: its own odometry of the last seconds, the newest correction, time as an argument. Does not know: maps, messages.

A correction says where the robot *was*. What it has driven since is odometry's own word, put on top.
"""

from __future__ import annotations

from collections import deque

from zsched.tasks.map_merge.geometry import Pose2

LOST_S = 1.0
"""With a last correction older than this, a robot no longer knows where it is: it stands."""
KEPT = 256
"""Scans whose odometry is kept: 51 s of them."""


class Localizer:
    """One robot's pose in its map frame."""

    def __init__(self) -> None:
        self._odometry: deque[tuple[int, Pose2]] = deque(maxlen=KEPT)
        self._map_t_odometry: Pose2 | None = None
        self._corrected_ns: int | None = None

    def note(self, stamp_ns: int, odometry: Pose2) -> None:
        """A scan has been taken there."""
        self._odometry.append((stamp_ns, odometry))

    def take(self, stamp_ns: int, pose: Pose2) -> bool:
        """Take a correction; returns whether it is of a scan that is still known, and newer than the last one."""
        if self._corrected_ns is not None and stamp_ns <= self._corrected_ns:
            return False
        odometry = next((kept for stamp, kept in reversed(self._odometry) if stamp == stamp_ns), None)
        if odometry is None:
            return False
        self._map_t_odometry, self._corrected_ns = pose.compose(odometry.inverse()), stamp_ns
        return True

    def belief(self, odometry: Pose2) -> Pose2:
        """Where the robot is, by its odometry now; before the first correction that is all it has."""
        return odometry if self._map_t_odometry is None else self._map_t_odometry.compose(odometry)

    def age_s(self, now_ns: int) -> float | None:
        """How old the last correction is, from its scan on; ``None`` before the first."""
        return None if self._corrected_ns is None else (now_ns - self._corrected_ns) / 1e9

    def is_lost(self, now_ns: int) -> bool:
        """Whether the robot must stand."""
        age_s = self.age_s(now_ns)
        return age_s is None or age_s > LOST_S
