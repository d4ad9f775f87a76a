"""Fit, ICP and search on a synthetic office where the true transform is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from zsched.tasks.map_merge.align import fit, prepare, refine
from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.search import correlation_candidates, estimate, feature_candidates

View = Callable[[tuple[float, float, float, float], Pose2], Grid]
_A, _B = Pose2(x=2.0, y=-1.0, yaw=0.4), Pose2(x=-3.0, y=2.0, yaw=-2.2)
_A_T_B = _A.inverse().compose(_B)
_LEFT, _RIGHT = (0.0, 0.0, 16.0, 16.0), (8.0, 0.0, 24.0, 16.0)


def _error(found: Pose2, centre: tuple[float, float]) -> tuple[float, float]:
    metres, radians = difference(found, _A_T_B, centre)
    return metres, math.degrees(radians)


def test_fit_of_the_truth_is_near_one_and_overlap_is_the_shared_area(view: View) -> None:
    a, b = prepare(view(_LEFT, _A), 0.05), prepare(view(_RIGHT, _B), 0.05)
    found = fit(a, b, _A_T_B)
    assert found.score > 0.95
    assert found.overlap == pytest.approx(0.5, abs=0.05)
    assert found.agreeing > 600


@pytest.mark.parametrize("resolution", [0.05, 0.1])
@pytest.mark.parametrize("offset", [Pose2(x=0.3, y=-0.2, yaw=0.03), Pose2(x=-0.2, y=0.3, yaw=-0.05)])
def test_refine_finds_the_truth_from_nearby(view: View, offset: Pose2, resolution: float) -> None:
    a, b = prepare(view(_LEFT, _A), resolution), prepare(view(_RIGHT, _B), resolution)
    x, y = b.centre
    about_centre = Pose2(x=x, y=y).compose(offset).compose(Pose2(x=-x, y=-y))
    metres, degrees = _error(refine(a, b, _A_T_B.compose(about_centre)), b.centre)
    assert metres < 0.2 * resolution
    assert degrees < 0.1


def test_both_searches_find_the_truth_without_prior(view: View) -> None:
    a, b = prepare(view(_LEFT, _A), 0.05), prepare(view(_RIGHT, _B), 0.05)
    (feature,) = feature_candidates(a.grid, b.grid)
    assert _error(refine(a, b, feature), b.centre)[0] < 0.01
    strongest = correlation_candidates(a.grid, b.grid)[0]
    assert _error(strongest, b.centre)[0] < 0.5
    assert _error(refine(a, b, strongest), b.centre)[0] < 0.01


def test_estimate_finds_the_truth_with_a_clear_margin(view: View) -> None:
    a, b = prepare(view(_LEFT, _A), 0.05), prepare(view(_RIGHT, _B), 0.05)
    found = estimate(a, b)
    assert found is not None
    assert _error(found.best.a_t_b, b.centre)[0] < 0.01
    assert found.best.score > 0.9
    assert found.margin is not None
    assert found.margin > 1.5


def test_estimate_of_a_repeating_building_has_no_margin() -> None:
    """Identical rooms in a row: each shift by one room fits, so the margin must say "not clear"."""
    data = np.zeros((120, 480), dtype=np.int8)
    data[:2], data[-2:] = 100, 100
    data[:, ::60] = 100
    data[:, 1::60] = 100
    a = prepare(Grid(data=data, resolution=0.05), 0.05)
    b = prepare(Grid(data=data[:, :300].copy(), resolution=0.05), 0.05)
    found = estimate(a, b)
    assert found is not None
    assert found.margin is not None
    assert found.margin < 1.3
