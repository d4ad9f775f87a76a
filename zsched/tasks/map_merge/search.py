"""Proposes alignments of two maps without any prior: by features, and by correlating walls over all rotations.

Knows: images of grids. Does not know: what is accepted (`merger`). Every candidate still has to be refined and judged.

Features: ORB (Rublee et al., 2011) with ratio test and RANSAC, the scale forced to 1; about 50 ms, dependable above
50 % overlap. Correlation: occupied cells at 0.2 m, every 2 degrees, FFT cross-correlation of one map's walls with the
other's "walls minus 0.35 x free" (in the spirit of Carpin, "Fast and accurate map merging for multi-robot systems",
Autonomous Robots 25, 2008); a third of a second to a second, dependable from 15 % overlap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt

from zsched.core.values.struct import Struct
from zsched.tasks.map_merge.align import Fit, WallMap, fit, refine
from zsched.tasks.map_merge.compose import resample
from zsched.tasks.map_merge.geometry import FloatArray, Pose2, difference
from zsched.tasks.map_merge.grid import Grid

COARSE_M = 0.2
MAX_COARSE_CELLS = 600
"""Longest side of a map in the correlation: over 120 m it is searched more coarsely, so that a search stays short."""
STEP_RAD = math.radians(2.0)
FREE_WEIGHT = 0.35
PEAKS = 6
PEAKS_PER_ANGLE = 2
FEATURES = 3000
MIN_FEATURE_CELLS = 64
"""ORB shrinks the image eight times by 1.2 and fails on what is then under a pixel; a patch alone takes 31."""
RATIO = 0.75
DISTINCT_M = 1.0
DISTINCT_RAD = math.radians(10.0)
"""Two candidates are distinct when they put the middle of the map, or its heading, this far apart."""

_Signal = npt.NDArray[np.float32]


class Estimate(Struct, frozen=True, kw_only=True):
    """The best alignment found, and how clearly it is the best.

    ``margin`` = its quality over that of the next distinct candidate; ``None`` when there is no other candidate at all.
    """

    best: Fit
    margin: float | None


def estimate(a: WallMap, b: WallMap, known: Pose2 | None = None) -> Estimate | None:
    """Search for the pose of b's map frame in a's; ``None`` when nothing is worth judging.

    ``known`` is an alignment in use, if there is one: it stands as one candidate among the others.

    Both searches always run: the features find the right place more often than not, but only the correlation finds the
    *other* places where the map would fit as well, and the margin over them is what tells right from wrong.
    """
    if len(a.walls) < 50 or len(b.walls) < 50:
        return None
    held = () if known is None else (known,)
    starts = [*held, *feature_candidates(a.grid, b.grid), *correlation_candidates(a.grid, b.grid)]
    fits = sorted((fit(a, b, refine(a, b, start)) for start in starts), key=lambda f: f.quality, reverse=True)
    if not fits or fits[0].agreeing == 0:
        return None
    best = fits[0]
    rival = next((other for other in fits[1:] if _is_distinct(best.a_t_b, other.a_t_b, b.centre)), None)
    margin = None if rival is None or rival.quality <= 0.0 else best.quality / rival.quality
    return Estimate(best=best, margin=margin)


def _is_distinct(a: Pose2, b: Pose2, centre: tuple[float, float]) -> bool:
    metres, radians = difference(a, b, centre)
    return metres > DISTINCT_M or radians > DISTINCT_RAD


# --- features --------------------------------------------------------------------------------------------------------


def feature_candidates(a: Grid, b: Grid) -> list[Pose2]:
    """At most one candidate, by ORB features of the grids drawn as grey images."""
    points_a, descriptors_a = _features(a)
    points_b, descriptors_b = _features(b)
    if len(points_a) < 8 or len(points_b) < 8:
        return []
    matches = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors_b, descriptors_a, k=2)
    good = [pair[0] for pair in matches if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    if len(good) < 6:
        return []
    source = np.array([points_b[match.queryIdx] for match in good])
    target = np.array([points_a[match.trainIdx] for match in good])
    affine, _inliers = cv2.estimateAffinePartial2D(
        source, target, method=cv2.RANSAC, ransacReprojThreshold=3 * a.resolution
    )
    matrix = np.asarray(affine, dtype=np.float64)
    if matrix.shape != (2, 3):  # RANSAC found nothing (None, which the stubs do not tell)
        return []
    return _rigid_part(matrix, source.mean(axis=0))


def _rigid_part(affine: FloatArray, centre: FloatArray) -> list[Pose2]:
    """The similarity with its scale forced to 1 around ``centre``; nothing when the scale says that it is nonsense."""
    scale = math.hypot(affine[0, 0], affine[1, 0])
    if not 0.8 < scale < 1.25:
        return []
    yaw = math.atan2(affine[1, 0], affine[0, 0])
    target = affine[:, :2] @ centre + affine[:, 2]
    turned_x, turned_y = Pose2(yaw=yaw).apply_point(float(centre[0]), float(centre[1]))
    return [Pose2(x=float(target[0]) - turned_x, y=float(target[1]) - turned_y, yaw=yaw)]


def _features(grid: Grid) -> tuple[FloatArray, npt.NDArray[np.uint8]]:
    """Key points (N, 2) in the map frame in metres, and their descriptors."""
    nothing = np.zeros((0, 2)), np.zeros((0, 32), dtype=np.uint8)
    if min(grid.data.shape) < MIN_FEATURE_CELLS:
        return nothing
    image = np.full(grid.data.shape, 127, dtype=np.uint8)
    image[grid.free] = 254
    image[grid.occupied] = 0
    orb = cv2.ORB_create(nfeatures=FEATURES)  # type: ignore[attr-defined]  # missing in OpenCV's stubs
    keys, descriptors = orb.detectAndCompute(image, None)
    if descriptors is None:
        return nothing
    pixels = np.array([key.pt for key in keys], dtype=np.float64)
    return grid.origin.apply((pixels + 0.5) * grid.resolution), descriptors


# --- correlation -----------------------------------------------------------------------------------------------------


class _Peak(Struct, frozen=True):
    value: float
    a_t_b: Pose2


def correlation_candidates(a: Grid, b: Grid) -> list[Pose2]:
    """Up to `PEAKS` distinct candidates over all rotations, the strongest first."""
    longest = max(max(grid.width, grid.height) * grid.resolution for grid in (a, b))
    cell = max(COARSE_M, longest / MAX_COARSE_CELLS)
    coarse_a, coarse_b = resample(a, cell), resample(b, cell)
    # Only b's walls are correlated: with its free space too, two wide open maps agree best where they hide each other.
    signal_a, signal_b = _signal(coarse_a), _walls(coarse_b)
    side_b = math.ceil(math.hypot(*signal_b.shape)) + 2
    shape = (
        cv2.getOptimalDFTSize(signal_a.shape[0] + side_b),
        cv2.getOptimalDFTSize(signal_a.shape[1] + side_b),
    )
    spectrum_a = np.fft.rfft2(signal_a, shape)
    radius = max(1, round(DISTINCT_M / cell))
    peaks: list[_Peak] = []
    for turn in range(round(math.tau / STEP_RAD)):
        yaw = turn * STEP_RAD
        turned = _turned(signal_b, yaw, side_b)
        correlation = np.fft.irfft2(spectrum_a * np.conj(np.fft.rfft2(turned, shape)), shape)
        peaks.extend(
            _Peak(value, _pose(coarse_a, coarse_b, yaw, shift, side_b))
            for value, shift in _maxima(correlation, signal_a.shape, radius)
        )
    centre = coarse_b.origin.apply_point(coarse_b.width * cell / 2, coarse_b.height * cell / 2)
    return _distinct(peaks, centre)


def _walls(grid: Grid) -> _Signal:
    return cv2.GaussianBlur(grid.occupied.astype(np.float32), (3, 3), 0.8).astype(np.float32, copy=False)


def _signal(grid: Grid) -> _Signal:
    return (_walls(grid) - FREE_WEIGHT * grid.free).astype(np.float32)


def _turned(signal: _Signal, yaw: float, side: int) -> _Signal:
    """The signal turned by ``yaw`` about its middle, on a square that holds every rotation."""
    height, width = signal.shape
    cos, sin = math.cos(yaw), math.sin(yaw)
    middle_x, middle_y, centre = (width - 1) / 2, (height - 1) / 2, (side - 1) / 2
    matrix = np.array(
        [
            [cos, -sin, centre - cos * middle_x + sin * middle_y],
            [sin, cos, centre - sin * middle_x - cos * middle_y],
        ]
    )
    return cv2.warpAffine(signal, matrix, (side, side), flags=cv2.INTER_LINEAR).astype(np.float32, copy=False)


def _maxima(
    correlation: npt.NDArray[np.floating], size_a: tuple[int, ...], radius: int
) -> Iterable[tuple[float, tuple[int, int]]]:
    """The strongest shifts (columns, rows) of one rotation, over ``radius`` cells apart; shifts may be negative."""
    image = np.ascontiguousarray(correlation, dtype=np.float32)
    rows, columns = image.shape
    for _ in range(PEAKS_PER_ANGLE):
        _low, value, _where, (column, row) = cv2.minMaxLoc(image)
        if value <= 0.0:
            return
        shift_x = column if column < size_a[1] else column - columns
        shift_y = row if row < size_a[0] else row - rows
        yield float(value), (shift_x, shift_y)
        image[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1] = -np.inf


def _pose(a: Grid, b: Grid, yaw: float, shift: tuple[int, int], side_b: int) -> Pose2:
    """The pose of b's map frame in a's when b's turned square lies at ``shift`` cells in a's grid."""
    middle_a = ((shift[0] + side_b / 2) * a.resolution, (shift[1] + side_b / 2) * a.resolution)
    middle_b = Pose2(x=b.width * b.resolution / 2, y=b.height * b.resolution / 2)
    grid_a_t_grid_b = Pose2(x=middle_a[0], y=middle_a[1], yaw=yaw).compose(middle_b.inverse())
    return a.origin.compose(grid_a_t_grid_b).compose(b.origin.inverse())


def _distinct(peaks: list[_Peak], centre: tuple[float, float]) -> list[Pose2]:
    kept: list[Pose2] = []
    for peak in sorted(peaks, key=lambda p: p.value, reverse=True):
        if all(_is_distinct(peak.a_t_b, other, centre) for other in kept):
            kept.append(peak.a_t_b)
        if len(kept) == PEAKS:
            break
    return kept
