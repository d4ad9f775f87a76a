"""Poses in the plane."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.tasks.map_merge.geometry import Pose2, difference

_metres = st.floats(-1e3, 1e3)
_poses = st.builds(Pose2, x=_metres, y=_metres, yaw=st.floats(-math.pi, math.pi))


@given(_poses)
def test_pose_composed_with_its_inverse_is_identity(pose: Pose2) -> None:
    metres, radians = difference(pose.compose(pose.inverse()), Pose2())
    assert metres < 1e-9
    assert radians < 1e-9


def test_difference_grows_with_distance_from_the_frame() -> None:
    turned = Pose2(yaw=math.radians(1.0))
    assert difference(turned, Pose2()) == pytest.approx((0.0, math.radians(1.0)))
    assert difference(turned, Pose2(), (50.0, 0.0))[0] == pytest.approx(0.8727, abs=1e-3)
