"""Poses in the plane."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.tasks.map_merge.geometry import Pose2, difference, wrap_angle

_metres = st.floats(-1e3, 1e3)
_poses = st.builds(Pose2, x=_metres, y=_metres, yaw=st.floats(-math.pi, math.pi))


@given(_poses)
def test_pose_composed_with_its_inverse_is_identity(pose: Pose2) -> None:
    metres, radians = difference(pose.compose(pose.inverse()), Pose2())
    assert metres < 1e-9
    assert radians < 1e-9


@given(_poses, _poses)
def test_compose_agrees_with_matrices(a: Pose2, b: Pose2) -> None:
    assert np.allclose(a.compose(b).matrix(), a.matrix() @ b.matrix(), atol=1e-6)


def test_apply_takes_points_of_the_child_to_the_parent() -> None:
    pose = Pose2(x=1.0, y=2.0, yaw=math.pi / 2)
    assert np.allclose(pose.apply(np.array([[1.0, 0.0], [0.0, 1.0]])), [[1.0, 3.0], [0.0, 2.0]])
    assert pose.apply_point(1.0, 0.0) == pytest.approx((1.0, 3.0))


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (3 * math.pi, math.pi), (7.0, 7.0 - math.tau)],
)
def test_wrap_angle_stays_in_range(angle: float, wrapped: float) -> None:
    assert wrap_angle(angle) == pytest.approx(wrapped)


def test_difference_grows_with_distance_from_the_frame() -> None:
    turned = Pose2(yaw=math.radians(1.0))
    assert difference(turned, Pose2()) == pytest.approx((0.0, math.radians(1.0)))
    assert difference(turned, Pose2(), (50.0, 0.0))[0] == pytest.approx(0.8727, abs=1e-3)
