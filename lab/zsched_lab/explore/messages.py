"""The explorers' own messages as bytes: claims, scans for mapping elsewhere, and what comes back: poses and ways.

Knows: these layouts, and where a robot's map stands among the merger's transforms. Does not know: zenoh, which program
sends what when. Maps and transforms are ROS messages (`zsched.tasks.map_merge.cdr`).

A claim is JSON: ``{"robot", "x", "y", "way_m"}`` in the merged frame, without ``x`` when the robot goes nowhere. A scan
is, little endian: ``ZSC1``, the stamp in ns (int64), the robot's pose in its map frame x, y, yaw (float64), the number
of beams (uint16), and one float32 per beam from straight ahead counter-clockwise, infinite without an echo (as in
sensor_msgs/msg/LaserScan). A correction is, little endian: ``ZCR1``, the stamp of its scan in ns (int64), the robot's
pose then in its map frame x, y, yaw (float64), and how well the scan fits (float64, 0 to 1). A way is JSON:
``{"stamp_ns", "points": [[x, y], ...]}`` in the robot's map frame, without points when the robot is to stand.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zsched.core.values.errors import WireError
from zsched.tasks.map_merge.cdr import CdrError, decode_transforms
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.frontier import Claim
from zsched_lab.explore.laser import RANGE_M, LaserScan

_HEAD = struct.Struct("<4sqdddH")
_MAGIC = b"ZSC1"
MAX_BEAMS = 4096
_CORRECTION = struct.Struct("<4sqdddd")
_CORRECTION_MAGIC = b"ZCR1"
MAX_POINTS = 4096
Point = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """Where SLAM has found the robot: its pose in its map frame when the scan of ``stamp_ns`` was taken."""

    stamp_ns: int
    pose: Pose2
    fit: float = 0.0
    """The mean likelihood of the scan's echoes, 0 to 1."""


def encode_correction(correction: Correction) -> bytes:
    """A correction."""
    pose = correction.pose
    return _CORRECTION.pack(_CORRECTION_MAGIC, correction.stamp_ns, pose.x, pose.y, pose.yaw, correction.fit)


def decode_correction(payload: bytes) -> Correction:
    """The correction.

    Raises:
        WireError: the bytes are none.
    """
    if len(payload) != _CORRECTION.size:
        raise WireError("correction", f"{len(payload)} bytes, not {_CORRECTION.size}")
    magic, stamp_ns, x, y, yaw, fit = _CORRECTION.unpack(payload)
    pose = Pose2(x=x, y=y, yaw=yaw)
    if magic != _CORRECTION_MAGIC or not pose.is_finite or not 0.0 <= fit <= 1.0:
        raise WireError("correction", f"{pose} with fit {fit} is none")
    return Correction(stamp_ns=stamp_ns, pose=pose, fit=fit)


def encode_way(stamp_ns: int, points: Sequence[Point]) -> bytes:
    """A way in the robot's map frame, as of ``stamp_ns``."""
    return json.dumps({"stamp_ns": stamp_ns, "points": [[round(x, 3), round(y, 3)] for x, y in points]}).encode()


def decode_way(payload: bytes) -> tuple[Point, ...]:
    """The points of a way; none: stand.

    Raises:
        WireError: the bytes are none.
    """
    try:
        told = json.loads(payload)["points"]
        points = tuple((float(x), float(y)) for x, y in told[: MAX_POINTS + 1])
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise WireError("way", repr(error)) from error
    if len(points) > MAX_POINTS or not all(map(math.isfinite, (value for point in points for value in point))):
        raise WireError("way", "too many points, or one that is no finite number")
    return points


def encode_claim(robot: str, claim: Claim | None) -> bytes:
    """A robot's claim, or its word that it has none."""
    if claim is None:
        return json.dumps({"robot": robot}).encode()
    return json.dumps({"robot": robot, "x": claim.x, "y": claim.y, "way_m": claim.way_m}).encode()


def decode_claim(payload: bytes) -> tuple[str, Claim | None]:
    """Whose word it is, and the claim if there is one.

    Raises:
        WireError: the bytes are no claim.
    """
    try:
        told = json.loads(payload)
        robot = str(told["robot"])
        if "x" not in told:
            return robot, None
        numbers = [float(told[name]) for name in ("x", "y", "way_m")]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise WireError("claim", repr(error)) from error
    if not all(map(math.isfinite, numbers)):
        raise WireError("claim", "not a finite number")
    return robot, Claim(robot=robot, x=numbers[0], y=numbers[1], way_m=numbers[2])


def encode_scan(scan: LaserScan, belief: Pose2) -> bytes:
    """A scan and where it was taken, in the robot's map frame."""
    head = _HEAD.pack(_MAGIC, scan.stamp_ns, belief.x, belief.y, belief.yaw, scan.ranges.size)
    return head + np.where(scan.echo, scan.ranges, np.float32(np.inf)).astype("<f4").tobytes()


def decode_scan(payload: bytes) -> tuple[LaserScan, Pose2]:
    """The scan and its pose.

    Raises:
        WireError: the bytes are no scan.
    """
    if len(payload) < _HEAD.size:
        raise WireError("scan", f"{len(payload)} bytes are too few")
    magic, stamp_ns, x, y, yaw, beams = _HEAD.unpack_from(payload)
    pose = Pose2(x=x, y=y, yaw=yaw)
    if magic != _MAGIC or not 1 <= beams <= MAX_BEAMS or len(payload) != _HEAD.size + 4 * beams or not pose.is_finite:
        raise WireError("scan", f"{len(payload)} bytes with {beams} beams at {pose} are no scan")
    told = np.frombuffer(payload, dtype="<f4", offset=_HEAD.size).astype(np.float32)
    echo = np.isfinite(told) & (told >= 0.0) & (told <= RANGE_M)
    ranges = np.where(echo, told, np.float32(RANGE_M)).astype(np.float32)
    return LaserScan(ranges=ranges, echo=echo, stamp_ns=stamp_ns), pose


def pose_of_map(payload: bytes, robot: str) -> Pose2 | None:
    """Where the merger has placed a robot's map frame; ``None``: it has not, or the bytes are no transforms."""
    try:
        transforms = decode_transforms(payload)
    except CdrError:
        return None
    placed = [transform.pose for transform in transforms if transform.child == f"{robot}/map"]
    return placed[-1] if placed else None
