"""The merger over grids: modes, acceptance, what is published, what is kept, snapshots."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import MAX_ROBOTS, Merger, MergeResult, MergerSettings, Mode, RobotState, RobotStatus

View = Callable[[tuple[float, float, float, float], Pose2], Grid]
_FRAMES = {
    "robot1": Pose2(x=2.0, y=-1.0, yaw=0.4),
    "robot2": Pose2(x=-3.0, y=2.0, yaw=-2.2),
    "robot3": Pose2(x=1.0, y=4.0, yaw=1.5),
}
_VIEWS = {
    "robot1": (0.0, 0.0, 12.0, 16.0),
    "robot2": (6.0, 0.0, 18.0, 16.0),
    "robot3": (12.0, 0.0, 24.0, 16.0),
}


def _merger(mode: Mode, poses: dict[str, Pose2] | None = None) -> Merger:
    return Merger(MergerSettings(mode=mode, poses=poses or {}))


def _fed(merger: Merger, view: View, robots: tuple[str, ...] = ("robot1", "robot2", "robot3")) -> Merger:
    for robot in robots:
        assert merger.update(robot, view(_VIEWS[robot], _FRAMES[robot])) == ""
    return merger


def _settled(merger: Merger) -> MergeResult:
    result = merger.merge()
    for _ in range(10):
        if not result.is_search_due:
            return result
        result = merger.merge()
    raise AssertionError("searches never end")


def _status(result: MergeResult, robot: str) -> RobotStatus:
    return next(status for status in result.statuses if status.robot == robot)


def _states(result: MergeResult) -> dict[str, RobotState]:
    return {status.robot: status.state for status in result.statuses}


def _errors(result: MergeResult) -> dict[str, float]:
    """Metres at the office's middle, relative to robot1."""
    base = _FRAMES["robot1"].inverse()
    return {
        robot: difference(
            result.transforms["robot1"].inverse().compose(pose), base.compose(_FRAMES[robot]), (10.0, 8.0)
        )[0]
        for robot, pose in result.transforms.items()
    }


# --- known -----------------------------------------------------------------------------------------------------------


def test_known_merges_by_the_given_poses_in_their_frame(view: View, office: Grid) -> None:
    result = _fed(_merger(Mode.KNOWN, _FRAMES), view).merge()
    assert set(_states(result).values()) == {RobotState.ATTACHED}
    assert result.transforms == _FRAMES
    assert result.grid is not None
    column, row = round(-result.grid.origin.x / 0.05), round(-result.grid.origin.y / 0.05)
    merged = result.grid.data[row : row + office.height, column : column + office.width]
    assert (merged == -1).mean() < 0.02
    assert np.count_nonzero((merged == 100) & (office.data == 100)) > 0.75 * np.count_nonzero(office.data == 100)


def test_known_without_pose_waits_and_is_left_out(view: View) -> None:
    poses = {"robot1": _FRAMES["robot1"], "robot9": Pose2()}
    result = _fed(_merger(Mode.KNOWN, poses), view, ("robot1", "robot2")).merge()
    assert list(result.transforms) == ["robot1"]
    assert _status(result, "robot2").state is RobotState.WAITING
    assert "--pose" in _status(result, "robot2").reason
    assert "no map received" in _status(result, "robot9").reason


def test_canvas_only_grows_and_cells_stay_in_place(view: View) -> None:
    merger = _merger(Mode.KNOWN, _FRAMES)
    first = _fed(merger, view, ("robot2",)).merge().grid
    second = _fed(merger, view, ("robot1", "robot3")).merge().grid
    merger.update("robot1", replace(view((0, 0, 3, 3), _FRAMES["robot1"]), stamp_ns=9))
    third = merger.merge().grid
    assert first is not None
    assert second is not None
    assert third is not None
    assert second.data.shape == third.data.shape
    for grid in (first, second, third):
        assert grid.origin.x / 0.05 == pytest.approx(round(grid.origin.x / 0.05))
        assert grid.origin.yaw == 0.0
    column = round((first.origin.x - second.origin.x) / 0.05)
    row = round((first.origin.y - second.origin.y) / 0.05)
    inside = second.data[row : row + first.height, column : column + first.width]
    assert (inside >= first.data).all()


def test_map_that_would_blow_up_the_canvas_is_refused_and_others_go_on(view: View) -> None:
    merger = _fed(_merger(Mode.KNOWN, _FRAMES), view, ("robot1", "robot2"))
    merger.update("robot3", replace(view(_VIEWS["robot3"], _FRAMES["robot3"]), origin=Pose2(x=1e7)))
    result = merger.merge()
    assert list(result.transforms) == ["robot1", "robot2"]
    assert _status(result, "robot3").state is RobotState.REFUSED
    assert "too large" in _status(result, "robot3").reason


def test_other_resolution_is_resampled(view: View) -> None:
    from zsched.tasks.map_merge.compose import resample

    merger = _fed(_merger(Mode.KNOWN, _FRAMES), view, ("robot1",))
    merger.update("robot2", resample(view(_VIEWS["robot2"], _FRAMES["robot2"]), 0.1))
    result = merger.merge()
    assert result.grid is not None
    assert result.grid.resolution == 0.05
    assert set(result.transforms) == {"robot1", "robot2"}


# --- estimate --------------------------------------------------------------------------------------------------------


def test_estimate_attaches_a_chain_and_the_reference_is_the_lowest_name(view: View) -> None:
    """robot1 and robot3 share no wall: robot3 hangs on robot1 through robot2."""
    result = _settled(_fed(_merger(Mode.ESTIMATE), view))
    assert result.reference == "robot1"
    assert result.transforms["robot1"] == Pose2()
    assert set(_states(result).values()) == {RobotState.ATTACHED}
    assert max(_errors(result).values()) < 0.05
    status = _status(result, "robot3")
    assert status.partner == "robot2"
    assert status.score is not None
    assert status.score > 0.9
    assert status.margin is not None
    assert status.margin > 1.3


def test_estimate_without_overlap_publishes_the_reference_only_and_says_why(view: View) -> None:
    result = _settled(_fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot3")))
    assert list(result.transforms) == ["robot1"]
    status = _status(result, "robot3")
    assert status.state is RobotState.REFUSED
    assert status.reason
    assert status.agreeing is not None
    assert result.grid is not None
    alone = _fed(_merger(Mode.ESTIMATE), view, ("robot1",)).merge().grid
    assert alone is not None
    assert np.array_equal(result.grid.data, alone.data)


def test_repeating_building_is_refused_for_its_margin() -> None:
    data = np.zeros((120, 480), dtype=np.int8)
    data[:2], data[-2:] = 100, 100
    data[:, ::60] = 100
    merger = _merger(Mode.ESTIMATE)
    merger.update("robot1", Grid(data=data, resolution=0.05))
    merger.update("robot2", Grid(data=data[:, :300].copy(), resolution=0.05))
    status = _status(_settled(merger), "robot2")
    assert status.state is RobotState.REFUSED
    assert "margin" in status.reason


def test_accepted_transform_is_kept_when_the_new_map_does_not_confirm_it(view: View) -> None:
    merger = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    before = _settled(merger).transforms["robot2"]
    weak = view(_VIEWS["robot2"], _FRAMES["robot2"])
    merger.update("robot2", replace(weak, data=np.where(weak.data == 100, 0, weak.data).astype(np.int8)))
    result = _settled(merger)
    assert result.transforms["robot2"] == before
    assert "kept" in _status(result, "robot2").reason


def test_map_that_starts_anew_loses_its_alignment(view: View) -> None:
    merger = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    assert set(_settled(merger).transforms) == {"robot1", "robot2"}
    merger.update("robot2", view((6.0, 0.0, 8.0, 2.0), Pose2(yaw=1.0)))
    result = _settled(merger)
    assert list(result.transforms) == ["robot1"]
    merger.update("robot2", view(_VIEWS["robot2"], Pose2(x=5.0, yaw=-1.0)))
    assert set(_settled(merger).transforms) == {"robot1", "robot2"}


def test_removed_map_leaves_the_chain_connected(view: View) -> None:
    merger = _fed(_merger(Mode.ESTIMATE), view)
    _settled(merger)
    merger.remove("robot2")
    result = _settled(merger)
    assert set(result.transforms) == {"robot1", "robot3"}


# --- track -----------------------------------------------------------------------------------------------------------


def test_track_refines_the_given_poses_without_searching(view: View) -> None:
    rough = {robot: pose.compose(Pose2(x=0.2, y=-0.15, yaw=0.02)) for robot, pose in _FRAMES.items()}
    rough["robot1"] = _FRAMES["robot1"]
    result = _fed(_merger(Mode.TRACK, rough), view).merge()
    assert not result.is_search_due
    assert difference(result.transforms["robot1"], _FRAMES["robot1"])[0] < 1e-9
    assert max(_errors(result).values()) < 0.05


def test_track_does_not_trust_a_pose_that_the_maps_contradict(view: View) -> None:
    wrong = {**_FRAMES, "robot2": _FRAMES["robot2"].compose(Pose2(x=4.0, y=3.0))}
    result = _fed(_merger(Mode.TRACK, wrong), view, ("robot1", "robot2")).merge()
    assert list(result.transforms) == ["robot1"]
    assert _status(result, "robot2").state is RobotState.REFUSED


def test_track_without_poses_searches_once(view: View) -> None:
    merger = _fed(_merger(Mode.TRACK), view, ("robot1", "robot2"))
    result = _settled(merger)
    assert set(result.transforms) == {"robot1", "robot2"}
    merger.update("robot2", view((6.0, 0.0, 22.0, 16.0), _FRAMES["robot2"]))
    result = merger.merge()
    assert not result.is_search_due
    assert max(_errors(result).values()) < 0.05


# --- snapshots -------------------------------------------------------------------------------------------------------


def test_restored_merger_attaches_at_once_without_searching(view: View) -> None:
    first = _fed(_merger(Mode.ESTIMATE), view)
    before = _settled(first)
    second = _merger(Mode.ESTIMATE)
    assert second.restore(first.snapshot()) == ""
    after = _fed(second, view).merge()
    assert after.reference == "robot1"
    assert set(after.transforms) == set(before.transforms)
    assert after.grid is not None
    assert before.grid is not None
    assert after.grid.data.shape == before.grid.data.shape
    assert max(_errors(after).values()) < 0.05


def test_reference_survives_in_the_snapshot_though_a_lower_name_comes(view: View) -> None:
    first = _fed(_merger(Mode.ESTIMATE), view, ("robot2",))
    first.merge()
    second = _merger(Mode.ESTIMATE)
    assert second.restore(first.snapshot()) == ""
    assert _fed(second, view, ("robot1", "robot2")).merge().reference == "robot2"


def test_an_owner_that_comes_back_forgets_an_alignment_that_its_successor_no_longer_has(view: View) -> None:
    """robot2 has started again meanwhile, in another frame; its new map is over half as large as the old one."""
    first = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    _settled(first)
    second = _fed(_merger(Mode.ESTIMATE), view, ("robot1",))
    assert second.restore(first.snapshot()) == ""
    frame = Pose2(x=30.0, y=-20.0, yaw=2.0)
    for width in (0.5, 8.0):
        assert second.update("robot2", view((6.0, 0.0, 6.0 + width, 16.0), frame)) == ""
        second.merge()
    assert first.restore(second.snapshot()) == ""
    assert first.update("robot2", view((6.0, 0.0, 14.0, 16.0), frame)) == ""
    result = _settled(first)
    if "robot2" in result.transforms:
        found = result.transforms["robot1"].inverse().compose(result.transforms["robot2"])
        assert difference(found, _FRAMES["robot1"].inverse().compose(frame), (10.0, 8.0))[0] < 0.5


def test_an_owner_that_comes_back_keeps_what_its_successor_has_aligned_with_smaller_maps(view: View) -> None:
    first = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    _settled(first)
    frame, part = Pose2(x=30.0, y=-20.0, yaw=2.0), (6.0, 0.0, 11.0, 16.0)
    second = _merger(Mode.ESTIMATE)
    assert second.update("robot1", view(_VIEWS["robot1"], _FRAMES["robot1"])) == ""
    assert second.update("robot2", view(part, frame)) == ""
    assert set(_settled(second).transforms) == {"robot1", "robot2"}
    assert first.restore(second.snapshot()) == ""
    assert first.update("robot1", view(_VIEWS["robot1"], _FRAMES["robot1"])) == ""
    assert first.update("robot2", view(part, frame)) == ""
    searches, result = first.searches, first.merge()
    assert set(result.transforms) == {"robot1", "robot2"}
    assert first.searches == searches
    found = result.transforms["robot1"].inverse().compose(result.transforms["robot2"])
    assert difference(found, _FRAMES["robot1"].inverse().compose(frame), (10.0, 8.0))[0] < 0.5


def test_an_alignment_that_was_handed_over_is_searched_again_when_a_map_has_grown(view: View) -> None:
    """As one's own: the first one may be a little wrong, or plausible and wrong."""
    first = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    _settled(first)
    second = _merger(Mode.ESTIMATE)
    assert second.restore(first.snapshot()) == ""
    _settled(_fed(second, view, ("robot1", "robot2")))
    assert second.searches == 0, "a move costs no search"
    assert second.update("robot2", view((6.0, 0.0, 24.0, 16.0), _FRAMES["robot2"])) == ""
    _settled(second)
    assert second.searches == 1


def test_a_map_that_has_become_too_large_shows_though_an_older_one_is_merged(
    view: View, monkeypatch: pytest.MonkeyPatch
) -> None:
    merger = _fed(_merger(Mode.ESTIMATE), view, ("robot1", "robot2"))
    assert _states(_settled(merger))["robot2"] is RobotState.ATTACHED
    with monkeypatch.context() as smaller:
        smaller.setattr("zsched.tasks.map_merge.merger.MAX_ALIGNED_CELLS", 1000)
        refusal = merger.update("robot2", view(_VIEWS["robot2"], _FRAMES["robot2"]))
        assert merger.update("robot3", view(_VIEWS["robot3"], _FRAMES["robot3"])) != ""
    result = merger.merge()
    shown = _status(result, "robot2")
    assert (shown.state, shown.reason) == (RobotState.REFUSED, refusal)
    assert "robot2" in result.transforms, "an older one is in the map"
    assert "too large" in _status(result, "robot3").reason
    _fed(merger, view, ("robot2",))
    assert _states(merger.merge())["robot2"] is RobotState.ATTACHED


def test_snapshot_of_another_mode_or_shape_is_refused(view: View) -> None:
    good = _fed(_merger(Mode.KNOWN, _FRAMES), view)
    good.merge()
    raw = good.snapshot()
    assert "mode" in _merger(Mode.TRACK).restore(raw)
    for broken in (b"", b"[]", b"{", b"null", b'{"schema": 3}', raw.replace(b'"extent"', b'"extant"')):
        assert _merger(Mode.KNOWN).restore(broken)
    state = json.loads(raw)
    for name, end in (("high_x", 10**9), ("high_x", math.inf)):
        state["extent"][name] = end
        assert _merger(Mode.KNOWN).restore(json.dumps(state).encode())
    state = json.loads(raw)
    assert _merger(Mode.KNOWN).restore(json.dumps(state | {"revision": math.inf}).encode()), "JSON may have 1e999"
    for areas in ({"a": -1.0}, {"a": math.nan}, [1.0], dict.fromkeys(map(str, range(MAX_ROBOTS + 1)), 1.0)):
        assert _merger(Mode.KNOWN).restore(json.dumps(state | {"areas": areas}).encode())
    older = {key: value for key, value in state.items() if key != "areas"}
    assert _merger(Mode.KNOWN).restore(json.dumps(older).encode()) == "", "an older version's has none"
    state["edges"] = [{"pair": ["a", "b"], "margin": None, "fit": {"a_t_b": {"x": math.nan, "y": 0, "yaw": 0}}}]
    assert _merger(Mode.KNOWN).restore(json.dumps(state).encode())
