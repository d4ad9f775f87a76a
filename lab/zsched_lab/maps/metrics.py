"""Figures for a merged map against the truth: SSIM that is worth something, wall F1, coverage, pose errors.

Knows: two grids and what lies between them. Does not know: how either came about.

Plain SSIM is useless here: an entirely unknown map scores 0.87 to 0.89, because canvas and empty space dominate, and a
map that is wrong by a metre scores less than that. So the crop's SSIM is rebased on the blank map: 0 = as good as no
map, 1 = perfect, negative = worse than no map. Even a perfect merge of three separately built grids reaches only about
0.9 crop SSIM against the grid of the joint log (hits and misses accumulate differently).

SSIM: Wang et al., "Image quality assessment: from error visibility to structural similarity", IEEE TIP 13(4), 2004;
uniform window of 7, sample covariance, data range 255, border of 3 cells cut (scikit-image's defaults).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from zsched.tasks.map_merge.compose import compose, extent_of
from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.grid import Grid, Mask, crop_known

WALL_TOLERANCE_CELLS = 2
SSIM_WINDOW = 7
SSIM_RANGE = 255.0
_GREY_OCCUPIED, _GREY_UNKNOWN, _GREY_FREE = 0, 127, 254

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapScore:
    """How good a merged map is; every figure over the crop to the truth's known cells and the map's own.

    ``ssim_rebased`` <= 1 (0: as good as no map); ``wall_f1``, ``wall_precision``, ``wall_recall`` in [0, 1] with a
    tolerance of 2 cells; ``coverage`` in [0, 1], the share of the truth's known cells that are known;
    ``ssim_crop`` plain SSIM of the crop, for comparison with papers only.
    """

    ssim_rebased: float
    wall_f1: float
    wall_precision: float
    wall_recall: float
    coverage: float
    ssim_crop: float


def score_map(merged: Grid | None, truth: Grid, world_t_merged: Pose2 | None = None) -> MapScore:
    """Hold a merged map against the truth, on the truth's own cells.

    Args:
        merged: the map; ``None`` or an empty one scores as a blank.
        truth: the grid of the whole log; its frame is the world.
        world_t_merged: the pose of the merged map's frame in the world, identity by default (mode known). With a
            reference robot it is that robot's displacement.

    Raises:
        ValueError: the truth knows nothing.
    """
    crop_truth = crop_known(truth)
    if crop_truth is None:
        raise ValueError("the truth has no known cell")
    crop_merged = None if merged is None else crop_known(merged)
    pose = world_t_merged or Pose2()
    extent = extent_of(crop_truth, Pose2(), truth.resolution)
    if crop_merged is not None:
        extent = extent.union(extent_of(crop_merged, pose, truth.resolution))
    reference = compose([(crop_truth, Pose2())], extent, truth.resolution)
    layers = [] if crop_merged is None else [(crop_merged, pose)]
    return _score(compose(layers, extent, truth.resolution), reference)


def pose_errors(
    estimated: Mapping[str, Pose2], true: Mapping[str, Pose2], reference: str
) -> dict[str, tuple[float, float]]:
    """How far each attached robot's map frame is off, as (metres, degrees), relative to the reference robot's.

    Args:
        estimated: {robot: pose of its map frame in the merged world}, the attached robots.
        true: {robot: displacement}, at least the attached ones.
        reference: the robot that both are held relative to; its own error is 0.
    """
    errors = {}
    for robot, pose in estimated.items():
        found = estimated[reference].inverse().compose(pose)
        metres, radians = difference(found, true[reference].inverse().compose(true[robot]))
        errors[robot] = (metres, math.degrees(radians))
    return errors


def grey(grid: Grid) -> Image:
    """The grid as a grey image (row 0 at the bottom of the map): occupied 0, unknown 127, free 254."""
    image = np.full(grid.data.shape, _GREY_UNKNOWN, dtype=np.uint8)
    image[grid.free] = _GREY_FREE
    image[grid.occupied] = _GREY_OCCUPIED
    return image


def ssim(a: Image, b: Image) -> float:
    """Structural similarity of two equally large grey images, in [-1, 1].

    Raises:
        ValueError: the sizes differ, or a side is under the window's 7 pixels.
    """
    if a.shape != b.shape or min(a.shape) < SSIM_WINDOW:
        raise ValueError(f"ssim: {a.shape} and {b.shape} are not equal, or under {SSIM_WINDOW} pixels")
    c1, c2 = (0.01 * SSIM_RANGE) ** 2, (0.03 * SSIM_RANGE) ** 2
    x, y = a.astype(np.float64), b.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    samples = SSIM_WINDOW**2
    unbiased = samples / (samples - 1)
    var_x = unbiased * (_window_mean(x * x) - mean_x * mean_x)
    var_y = unbiased * (_window_mean(y * y) - mean_y * mean_y)
    covariance = unbiased * (_window_mean(x * y) - mean_x * mean_y)
    similarity = ((2 * mean_x * mean_y + c1) * (2 * covariance + c2)) / (
        (mean_x * mean_x + mean_y * mean_y + c1) * (var_x + var_y + c2)
    )
    border = SSIM_WINDOW // 2
    return float(similarity[border:-border, border:-border].mean())


def _score(merged: Grid, truth: Grid) -> MapScore:
    image, reference = grey(merged), grey(truth)
    blank = np.full_like(reference, _GREY_UNKNOWN)
    plain, floor = _padded_ssim(image, reference), _padded_ssim(blank, reference)
    precision = _near_share(merged.occupied, truth.occupied)
    recall = _near_share(truth.occupied, merged.occupied)
    known = truth.known
    return MapScore(
        ssim_rebased=(plain - floor) / (1.0 - floor) if floor < 1.0 else 0.0,
        wall_f1=2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        wall_precision=precision,
        wall_recall=recall,
        coverage=float(np.count_nonzero(known & merged.known) / np.count_nonzero(known)),
        ssim_crop=plain,
    )


def _padded_ssim(a: Image, b: Image) -> float:
    """SSIM with an unknown border as wide as the cut, so that the outermost cells count too."""
    pad = SSIM_WINDOW // 2
    return ssim(*(np.pad(image, pad, constant_values=_GREY_UNKNOWN) for image in (a, b)))


def _near_share(walls: Mask, others: Mask) -> float:
    """The share of ``walls`` that have one of the ``others`` within `WALL_TOLERANCE_CELLS`; 0 without walls."""
    count = np.count_nonzero(walls)
    if count == 0 or not others.any():
        return 0.0
    distance = cv2.distanceTransform(np.where(others, 0, 255).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(np.count_nonzero(distance[walls] <= WALL_TOLERANCE_CELLS + 1e-3) / count)


def _window_mean(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return cv2.blur(image, (SSIM_WINDOW, SSIM_WINDOW)).astype(np.float64, copy=False)
