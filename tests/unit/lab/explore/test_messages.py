from __future__ import annotations

import struct

import numpy as np
import pytest

from zsched.core.values.errors import WireError
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.frontier import Claim
from zsched_lab.explore.laser import RANGE_M, LaserScan
from zsched_lab.explore.messages import decode_claim, decode_scan, encode_claim, encode_scan

POSE = Pose2(x=1.5, y=-2.0, yaw=0.25)


def scan() -> LaserScan:
    echo = np.array([True, False, True])
    return LaserScan(ranges=np.array([1.0, RANGE_M, 2.5], dtype=np.float32), echo=echo, stamp_ns=123)


def test_claims_come_back() -> None:
    claim = Claim(robot="robot2", x=1.25, y=-3.0, way_m=4.5)
    assert decode_claim(encode_claim("robot2", claim)) == ("robot2", claim)
    assert decode_claim(encode_claim("robot2", None)) == ("robot2", None)


def test_scans_come_back_with_their_pose() -> None:
    back, pose = decode_scan(encode_scan(scan(), POSE))
    assert pose == POSE
    assert back.stamp_ns == 123
    assert np.array_equal(back.ranges, scan().ranges)
    assert np.array_equal(back.echo, scan().echo)


def test_bytes_that_are_no_scan_are_refused() -> None:
    good = encode_scan(scan(), POSE)
    nowhere = good[:12] + struct.pack("<d", float("inf")) + good[20:]
    for payload in (b"", good[:-1], good + b"x", b"XSC1" + good[4:], nowhere):
        with pytest.raises(WireError):
            decode_scan(payload)
