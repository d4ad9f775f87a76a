"""Scan matching: where a robot stands in its own map, by its odometry and what its laser sees there.

Knows: walls as a likelihood field, hypotheses, the CPU time that a match may take. Does not know: processes, messages.

Two steps. A correlative search looks at every hypothesis of a small window round the pose that odometry predicts
(Olson, "Real-time correlative scan matching", ICRA 2009). Then rounds of hypotheses are drawn round the best one, ever
closer, and the mean of all that were drawn, each weighted by how well it fits, is the pose (Grisetti, Stachniss &
Burgard, "Improved techniques for grid mapping with Rao-Blackwellized particle filters", IEEE T-RO 2007, sec. III-B).
As with gmapping's particles, more hypotheses make a better pose for more CPU. So the work of one match is set by its
CPU time: it draws until that is spent, at least `LEAST_ROUNDS` rounds.

Along a corridor without doors nothing tells how far the robot has come: there odometry's own word decides.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.geometry import FloatArray, Pose2, wrap_angle
from zsched_lab.explore.laser import RANGE_M, LaserScan
from zsched_lab.explore.mapper import ScanMapper

SEARCH_M, SEARCH_STEP_M = 0.15, 0.05
SEARCH_RAD, SEARCH_STEP_RAD = 0.12, 0.03
WALL_M = 0.07
"""How far an echo lies from its wall's cell, as a standard deviation: half a cell, the laser's noise, old drift."""
FAR_M = 0.5
"""Echoes that lie further from any wall say nothing: they are of walls that the map does not know."""
ODOMETRY_M, ODOMETRY_RAD = 0.05, 0.03
"""How much odometry is trusted between two scans, as standard deviations: it decides where the walls do not."""
ROUND = 64
"""Hypotheses of one round."""
LEAST_ROUNDS = 4
CLOSEST_M, CLOSEST_RAD = 0.004, 0.002
SHARPNESS = 12.0
"""How much a better fit weighs: a scan's echoes are not independent, so it counts as this many, not as 360."""
LEAST_ECHOES = 12
"""With fewer, odometry is all there is."""

_Field = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """One scan's place in the map frame; ``fit`` in [0, 1] is the mean likelihood of its echoes.

    ``hypotheses`` were looked at; with none of them (too few echoes, no map yet) the pose is the predicted one.
    """

    pose: Pose2
    fit: float
    hypotheses: int


class Walls:
    """The likelihood of an echo at every place near a pose: the walls of a map, blurred."""

    def __init__(self, mapper: ScanMapper, near: Pose2) -> None:
        """Take the walls that a scan from ``near`` can meet."""
        reach = RANGE_M + SEARCH_M + FAR_M
        self._resolution = mapper.resolution
        occupied, self._low_x, self._low_y = mapper.walls(near, reach)
        self.is_empty = not bool(occupied.any())
        far = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        metres = np.minimum(far * np.float32(self._resolution), np.float32(FAR_M))
        self._field: _Field = np.exp(-0.5 * (metres / np.float32(WALL_M)) ** 2).astype(np.float32)

    def likelihood(self, x: FloatArray, y: FloatArray) -> _Field:
        """Of echoes at ``x``, ``y`` (m, map frame, any shape), between the middles of cells; 0 outside."""
        rows, columns = self._field.shape
        u = np.clip(x / self._resolution - self._low_x - 0.5, 0.0, columns - 1.001)
        v = np.clip(y / self._resolution - self._low_y - 0.5, 0.0, rows - 1.001)
        column, row = u.astype(np.int32), v.astype(np.int32)
        right, up = (u - column).astype(np.float32), (v - row).astype(np.float32)
        flat, at = self._field.ravel(), row * np.int32(columns) + column
        low = flat[at] * (1 - right) + flat[at + 1] * right
        high = flat[at + columns] * (1 - right) + flat[at + columns + 1] * right
        found: _Field = low * (1 - up) + high * up
        return found


class ScanMatcher:
    """Matches scans to one map. ``cpu_s`` of CPU time for each match (0: the least); ``spent_s`` is the CPU clock."""

    def __init__(
        self, random: np.random.Generator, *, cpu_s: float = 0.0, spent_s: Callable[[], float] = time.thread_time
    ) -> None:
        self._random = random
        self._cpu_s = cpu_s
        self._spent_s = spent_s

    def match(self, mapper: ScanMapper, scan: LaserScan, predicted: Pose2, began_s: float | None = None) -> Match:
        """The pose of ``scan`` in the map, near the ``predicted`` one.

        The CPU time counts from ``began_s`` on the CPU clock: what was spent since the last scan counts, too.
        """
        until_s = (self._spent_s() if began_s is None else began_s) + self._cpu_s
        angles = np.flatnonzero(scan.echo) * scan.step
        ranges = scan.ranges[scan.echo].astype(np.float64)
        walls = Walls(mapper, predicted)
        if ranges.size < LEAST_ECHOES or walls.is_empty:
            return Match(pose=predicted, fit=0.0, hypotheses=0)
        fits = _Fits(walls, ranges * np.cos(angles), ranges * np.sin(angles), predicted)
        best, looked = _search(fits, predicted)
        return self._drawn(fits, best, looked, until_s)

    def _drawn(self, fits: _Fits, best: FloatArray, looked: int, until_s: float) -> Match:
        """Rounds of hypotheses round the best one, and the weighted mean of all."""
        spread = np.array([SEARCH_STEP_M / 2, SEARCH_STEP_M / 2, SEARCH_STEP_RAD / 2])
        closest = np.array([CLOSEST_M, CLOSEST_M, CLOSEST_RAD])
        best_fit = float(fits.of(best[None, :])[0])
        weights, total, rounds = np.zeros(3), 0.0, 0
        before_s = after_s = self._spent_s()
        while rounds < LEAST_ROUNDS or after_s + (after_s - before_s) / 2 < until_s:  # no half a round too many
            before_s = after_s
            drawn = best + self._random.standard_normal((ROUND, 3)) * spread
            fit = fits.of(drawn)
            top = int(fit.argmax())
            if fit[top] > best_fit:
                rise = math.exp(SHARPNESS * (best_fit - float(fit[top])))
                weights, total = weights * rise, total * rise
                best, best_fit = drawn[top], float(fit[top])
            weight = np.exp(SHARPNESS * (fit - best_fit) * fits.echoes / 10)
            weights, total = weights + weight @ drawn, total + float(weight.sum())
            spread = np.maximum(spread * 0.8, closest)
            rounds += 1
            after_s = self._spent_s()
        x, y, yaw = (weights / total).tolist() if total > 0.0 else best.tolist()
        pose = Pose2(x=x, y=y, yaw=wrap_angle(yaw))
        return Match(pose=pose, fit=float(fits.plain(np.array([[x, y, yaw]]))[0]), hypotheses=looked + rounds * ROUND)


class _Fits:
    """How well hypotheses (N, 3: x, y in m and yaw in rad, map frame) fit the walls and odometry."""

    def __init__(self, walls: Walls, x: FloatArray, y: FloatArray, predicted: Pose2) -> None:
        step = max(1, x.size // 180)
        self._walls, self._x, self._y = walls, x[::step], y[::step]
        self._predicted = np.array([predicted.x, predicted.y, predicted.yaw])
        self.echoes = self._x.size

    def plain(self, hypotheses: FloatArray) -> FloatArray:
        """The mean likelihood of the echoes alone."""
        cos, sin = np.cos(hypotheses[:, 2])[:, None], np.sin(hypotheses[:, 2])[:, None]
        x = hypotheses[:, :1] + cos * self._x - sin * self._y
        y = hypotheses[:, 1:2] + sin * self._x + cos * self._y
        found: FloatArray = self._walls.likelihood(x, y).mean(axis=1).astype(np.float64)
        return found

    def of(self, hypotheses: FloatArray) -> FloatArray:
        """The same, less what odometry says against a hypothesis."""
        off = (hypotheses - self._predicted) / np.array([ODOMETRY_M, ODOMETRY_M, ODOMETRY_RAD])
        found: FloatArray = self.plain(hypotheses) - 0.5 * (off**2).sum(axis=1) / SHARPNESS / 4
        return found


def _search(fits: _Fits, predicted: Pose2) -> tuple[FloatArray, int]:
    """The best hypothesis of the whole window, and how many there were."""
    way = np.arange(-SEARCH_M, SEARCH_M + 1e-9, SEARCH_STEP_M)
    turn = np.arange(-SEARCH_RAD, SEARCH_RAD + 1e-9, SEARCH_STEP_RAD)
    x, y, yaw = (part.ravel() for part in np.meshgrid(way, way, turn, indexing="ij"))
    window = np.stack((predicted.x + x, predicted.y + y, predicted.yaw + yaw), axis=1)
    return window[int(fits.of(window).argmax())], window.shape[0]
