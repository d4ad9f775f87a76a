"""The figures' own properties: what scores 1, what 0, and what order wrong maps come in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import Merger, MergerSettings, Mode
from zsched_lab.maps.laser_log import load_log, malaga_path, split_log
from zsched_lab.maps.mapping import displacements, map_scans, truth_grid
from zsched_lab.maps.metrics import pose_errors, score_map, ssim


@pytest.fixture(scope="module")
def truth() -> Grid:
    """A room of 15 m x 10 m with some walls, unknown around it."""
    data = np.full((240, 340), -1, dtype=np.int8)
    data[20:220, 20:320] = 0
    for rows, columns in (
        (slice(20, 22), slice(20, 320)),
        (slice(218, 220), slice(20, 320)),
        (slice(20, 220), slice(20, 22)),
        (slice(20, 220), slice(318, 320)),
        (slice(20, 140), slice(120, 122)),
        (slice(100, 102), slice(180, 318)),
    ):
        data[rows, columns] = 100
    return Grid(data=data, resolution=0.05, origin=Pose2(x=-3.0, y=1.0))


def _shifted(grid: Grid, cells: int) -> Grid:
    return replace(grid, origin=Pose2(x=grid.origin.x + cells * grid.resolution, y=grid.origin.y))


def test_perfect_map_scores_one_in_everything(truth: Grid) -> None:
    score = score_map(truth, truth)
    assert score.ssim_rebased == pytest.approx(1.0)
    assert (score.wall_f1, score.coverage) == (1.0, 1.0)
    assert score.ssim_crop == pytest.approx(1.0)


@pytest.mark.parametrize("is_none", [True, False])
def test_no_map_scores_zero_rebased_though_its_plain_ssim_is_high(truth: Grid, is_none: bool) -> None:
    blank = None if is_none else replace(truth, data=np.full_like(truth.data, -1))
    score = score_map(blank, truth)
    assert score.ssim_rebased == pytest.approx(0.0, abs=1e-12)
    assert (score.wall_f1, score.coverage) == (0.0, 0.0)
    assert score.ssim_crop > 0.3


def test_worse_maps_score_lower(truth: Grid) -> None:
    scores = [score_map(_shifted(truth, cells), truth).ssim_rebased for cells in (0, 1, 5, 20)]
    assert scores == sorted(scores, reverse=True)
    assert scores[3] < 0.6 < scores[1]


@pytest.mark.parametrize(("cells", "is_near"), [(2, True), (8, False)])
def test_wall_f1_forgives_two_cells(truth: Grid, cells: int, is_near: bool) -> None:
    score = score_map(_shifted(truth, cells), truth)
    assert (score.wall_f1 == pytest.approx(1.0)) is is_near


def test_wall_precision_and_recall_tell_extra_from_missing(truth: Grid) -> None:
    missing = np.where(np.arange(340) > 150, np.minimum(truth.data, 0), truth.data).astype(np.int8)
    extra = truth.data.copy()
    extra[160:190, 60:90] = 100
    assert score_map(replace(truth, data=missing), truth).wall_precision == 1.0
    assert score_map(replace(truth, data=missing), truth).wall_recall < 0.7
    assert score_map(replace(truth, data=extra), truth).wall_recall == 1.0
    assert score_map(replace(truth, data=extra), truth).wall_precision < 0.9


def test_coverage_is_the_share_of_the_truths_known_cells(truth: Grid) -> None:
    half = truth.data.copy()
    half[:, 170:] = -1
    assert score_map(replace(truth, data=half), truth).coverage == pytest.approx(0.5, abs=0.01)


def test_coverage_does_not_count_what_the_truth_does_not_know(truth: Grid) -> None:
    known_more = np.where(truth.data < 0, 0, truth.data).astype(np.int8)
    score = score_map(replace(truth, data=known_more), truth)
    assert score.coverage == 1.0
    assert score.ssim_rebased < 1.0


def test_frame_of_the_merged_map_is_taken_into_account(truth: Grid) -> None:
    displacement = Pose2(x=2.0, y=-1.0, yaw=math.pi / 2)
    elsewhere = replace(truth, origin=displacement.inverse().compose(truth.origin))
    assert score_map(elsewhere, truth, displacement).wall_f1 == pytest.approx(1.0)
    assert score_map(elsewhere, truth).wall_f1 < 0.5


def test_truth_without_a_known_cell_is_refused(truth: Grid) -> None:
    with pytest.raises(ValueError, match="truth"):
        score_map(truth, replace(truth, data=np.full_like(truth.data, -1)))


def _plain_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """The definition, window by window."""
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    values = []
    for row in range(a.shape[0] - 6):
        for column in range(a.shape[1] - 6):
            x, y = (image[row : row + 7, column : column + 7].astype(float).ravel() for image in (a, b))
            cov = np.cov(x, y)
            luminance = (2 * x.mean() * y.mean() + c1) / (x.mean() ** 2 + y.mean() ** 2 + c1)
            values.append(luminance * (2 * cov[0, 1] + c2) / (cov[0, 0] + cov[1, 1] + c2))
    return float(np.mean(values))


def test_ssim_equals_its_definition() -> None:
    generator = np.random.default_rng(0)
    a = generator.choice(np.array([0, 127, 254], dtype=np.uint8), size=(20, 25))
    b = np.where(generator.random((20, 25)) < 0.3, 127, a).astype(np.uint8)
    assert ssim(a, b) == pytest.approx(_plain_ssim(a, b), abs=1e-9)
    assert ssim(a, a) == pytest.approx(1.0)


def test_pose_errors_are_relative_to_the_reference() -> None:
    true = {"robot1": Pose2(x=1.0, yaw=0.5), "robot2": Pose2(x=4.0, y=2.0, yaw=-1.0)}
    common = Pose2(x=10.0, y=-7.0, yaw=2.0)  # the merged world may lie anywhere
    estimated = {robot: common.compose(pose) for robot, pose in true.items()}
    errors = pose_errors(estimated, true, "robot1")
    assert errors["robot2"] == pytest.approx((0.0, 0.0), abs=1e-9)
    estimated["robot2"] = estimated["robot2"].compose(Pose2(x=0.3, y=0.4, yaw=math.radians(2.0)))
    assert pose_errors(estimated, true, "robot1")["robot2"] == pytest.approx((0.5, 2.0))


def test_thirds_of_the_shipped_log_merge_to_the_demos_figures() -> None:
    """Mode known: coverage >= 0.9 and wall F1 >= 0.8 against the grid of the whole log."""
    log = load_log(malaga_path())
    names = ("robot1", "robot2", "robot3")
    frames = dict(zip(names, displacements(3, 7), strict=True))
    merger = Merger(MergerSettings(mode=Mode.KNOWN, poses=frames))
    for name, part in zip(names, split_log(log, 3), strict=True):
        merger.update(name, map_scans(part.scans, displacement=frames[name]))
    score = score_map(merger.merge().grid, truth_grid(log))
    assert score.coverage >= 0.9
    assert score.wall_f1 >= 0.8
    assert score.ssim_rebased > 0.4
