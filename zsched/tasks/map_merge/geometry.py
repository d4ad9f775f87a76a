"""Poses and rigid transforms in the plane.

Knows: SE(2). Does not know: grids, robots or messages.

``a_t_b`` names the pose of frame b in frame a; it takes points of b to a, and ``a_t_b.compose(b_t_c)`` is ``a_t_c``.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from zsched.core.values.struct import Struct

FloatArray = npt.NDArray[np.float64]


def wrap_angle(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau


class Pose2(Struct, frozen=True, kw_only=True):
    """A pose in the plane: metres, and radians counter-clockwise."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def compose(self, other: Pose2) -> Pose2:
        """This pose followed by ``other``, which is given in this pose's frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Pose2(
            x=self.x + cos * other.x - sin * other.y,
            y=self.y + sin * other.x + cos * other.y,
            yaw=wrap_angle(self.yaw + other.yaw),
        )

    def inverse(self) -> Pose2:
        """The pose of the parent frame in this one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Pose2(
            x=-cos * self.x - sin * self.y,
            y=sin * self.x - cos * self.y,
            yaw=wrap_angle(-self.yaw),
        )

    def apply(self, points: FloatArray) -> FloatArray:
        """Take points (N, 2) of this frame to the parent frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = points[:, 0], points[:, 1]
        moved: FloatArray = np.empty_like(points)
        moved[:, 0] = cos * x - sin * y + self.x
        moved[:, 1] = sin * x + cos * y + self.y
        return moved

    def apply_point(self, x: float, y: float) -> tuple[float, float]:
        """Take one point of this frame to the parent frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y

    def matrix(self) -> FloatArray:
        """The homogeneous matrix (3, 3)."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cos, -sin, self.x], [sin, cos, self.y], [0.0, 0.0, 1.0]])

    @property
    def is_finite(self) -> bool:
        """Whether every component is a number."""
        return math.isfinite(self.x) and math.isfinite(self.y) and math.isfinite(self.yaw)


def difference(a: Pose2, b: Pose2, at: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """How far two transforms put the point ``at`` (of their common child frame) apart: (metres, radians >= 0).

    Two transforms must be compared at the middle of the map that they move: far from it, a harmless angle is metres.
    """
    ax, ay = a.apply_point(*at)
    bx, by = b.apply_point(*at)
    return math.hypot(ax - bx, ay - by), abs(wrap_angle(a.yaw - b.yaw))
