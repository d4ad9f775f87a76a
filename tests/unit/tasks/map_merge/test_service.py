"""The service over bytes: rate, roles, bad messages, status, and the maps that come out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from zsched.tasks.map_merge.cdr import MAX_STAMP_NS, decode_grid, decode_transforms, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import MAX_ROBOTS, MergerSettings, Mode
from zsched.tasks.map_merge.service import STATUS_SCHEMA, MapMergeService, Output

View = Callable[[tuple[float, float, float, float], Pose2], Grid]
_POSES = {"robot1": Pose2(x=2.0, y=-1.0, yaw=0.4), "robot2": Pose2(x=-3.0, y=2.0, yaw=-2.2)}
_THIRD = Pose2(x=1.0, y=1.0)
_NOW_NS = 1_700_000_000 * 10**9
_WEEK_NS = 7 * 86_400 * 10**9
_PARTS = {"robot1": (0.0, 0.0, 14.0, 16.0), "robot2": (7.0, 0.0, 24.0, 16.0)}


@dataclass
class _Wire:
    """A transport that keeps what went out, and a clock that stands until it is moved."""

    now_s: float = 100.0
    sent: list[tuple[Output, bytes, bytes | None]] = field(default_factory=list)

    def publish(self, output: Output, payload: bytes, attachment: bytes | None = None) -> bool:
        self.sent.append((output, payload, attachment))
        return True

    def clock(self) -> float:
        return self.now_s

    def last(self, output: Output) -> tuple[bytes, bytes | None]:
        return next((payload, extra) for kind, payload, extra in reversed(self.sent) if kind is output)

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.last(Output.STATUS)[0])
        return found


def _service(wire: _Wire, mode: Mode = Mode.KNOWN) -> MapMergeService:
    settings = MergerSettings(mode=mode, poses={**_POSES, "robot3": _THIRD} if mode is Mode.KNOWN else {})
    return MapMergeService(
        settings, wire.publish, clock=wire.clock, rate_hz=4.0, spawn=lambda work: work(), wall_clock=lambda: _NOW_NS
    )


def _feed(service: MapMergeService, view: View, *robots: str) -> None:
    for number, robot in enumerate(robots, start=1):
        grid = replace(view(_PARTS[robot], _POSES[robot]), stamp_ns=number * 1000)
        service.receive(robot, encode_grid(grid))


def test_first_merge_waits_a_moment_so_that_the_lowest_name_becomes_the_reference(view: View) -> None:
    wire = _Wire()
    service = _service(wire, Mode.ESTIMATE)
    _feed(service, view, "robot2")
    assert not service.step(is_active=True)
    wire.now_s += 0.1
    _feed(service, view, "robot1")
    assert not service.step(is_active=True)
    wire.now_s += 0.25
    assert service.step(is_active=True)
    assert wire.status()["reference"] == "robot1"


def test_maps_that_waited_while_idle_are_merged_at_once(view: View) -> None:
    wire = _Wire()
    service = _service(wire, Mode.ESTIMATE)
    _feed(service, view, "robot2", "robot1")
    wire.now_s += 0.4
    assert service.step(is_active=True)


def test_merge_publishes_map_transforms_and_status(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1", "robot2")
    assert service.step(is_active=True)
    payload, attachment = wire.last(Output.GLOBAL_MAP)
    grid = decode_grid(payload)
    assert grid.frame_id == "world"
    assert np.count_nonzero(grid.occupied) > 1000
    assert attachment is not None
    assert json.loads(attachment) == {"merge": 1, "inputs": {"robot1": 1000, "robot2": 2000}}
    transforms = decode_transforms(wire.last(Output.TF)[0])
    assert [(one.parent, one.child) for one in transforms] == [("world", "robot1/map"), ("world", "robot2/map")]
    assert transforms[0].pose.x == pytest.approx(2.0)
    status = wire.status()
    assert status["schema"] == STATUS_SCHEMA
    assert (status["mode"], status["merges"], status["revision"]) == ("known", 1, 1)
    assert status["robots"]["robot1"]["state"] == "attached"
    assert status["robots"]["robot1"]["map_age_s"] == 0.0


@pytest.mark.parametrize("wrong_ns", [_NOW_NS + _WEEK_NS, _NOW_NS - _WEEK_NS, 0, -5, MAX_STAMP_NS])
@pytest.mark.parametrize("robots", [2, 3])
def test_a_wrong_clock_does_not_date_the_merged_map(view: View, wrong_ns: int, robots: int) -> None:
    wire = _Wire()
    service = _service(wire)
    names = [f"robot{number}" for number in range(1, robots + 1)]
    for name in names:
        stamp_ns = wrong_ns if name == "robot1" else _NOW_NS - 1000
        service.receive(name, encode_grid(replace(view(_PARTS["robot1"], _POSES["robot1"]), stamp_ns=stamp_ns)))
    assert service.step(is_active=True)
    assert abs(decode_grid(wire.last(Output.GLOBAL_MAP)[0]).stamp_ns - _NOW_NS) <= 1000
    attachment = wire.last(Output.GLOBAL_MAP)[1]
    assert attachment is not None
    assert json.loads(attachment)["inputs"]["robot1"] == wrong_ns, "what came is told as it came"


def test_a_robot_that_is_silent_does_not_hold_the_time_up(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    for after_s, robot in ((0.0, "robot1"), (60.0, "robot2")):
        wire.now_s += after_s
        grid = replace(view(_PARTS[robot], _POSES[robot]), stamp_ns=_NOW_NS + round((after_s - 60) * 1e9))
        service.receive(robot, encode_grid(grid))
    assert service.step(is_active=True)
    assert decode_grid(wire.last(Output.GLOBAL_MAP)[0]).stamp_ns == _NOW_NS


def test_a_map_frame_that_names_its_robot_is_the_child_frame(view: View) -> None:
    """Every robot hears all transforms: a `map` that each has would be placed where another robot's is."""
    frames = {"robot1": "robot1_map", "robot2": "map"}
    wire = _Wire()
    service = _service(wire)
    for robot, frame_id in frames.items():
        service.receive(robot, encode_grid(replace(view(_PARTS[robot], _POSES[robot]), frame_id=frame_id)))
    service.step(is_active=True)
    transforms = decode_transforms(wire.last(Output.TF)[0])
    assert [one.child for one in transforms] == ["robot1_map", "robot2/map"]
    assert [wire.status()["robots"][robot]["frame"] for robot in frames] == ["robot1_map", "robot2/map"]


def test_idle_keeps_the_newest_maps_and_the_owner_merges_them_at_once(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1", "robot2")
    assert not service.step(is_active=False)
    assert wire.sent == []
    assert service.step(is_active=True)
    assert decode_grid(wire.last(Output.GLOBAL_MAP)[0]).known_area_m2 > 300


def test_owner_again_waits_a_moment_for_a_new_map_of_every_robot_then_shows_what_it_has(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1", "robot2")
    service.step(is_active=True)
    service.step(is_active=False)
    wire.now_s += 60.0
    assert not service.step(is_active=True)
    _feed(service, view, "robot1")
    assert not service.step(is_active=True)
    wire.now_s += 0.31
    assert service.step(is_active=True)


def test_owner_again_merges_at_once_when_every_robots_newest_map_came_while_it_stood_by(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1", "robot2")
    service.step(is_active=True)
    service.step(is_active=False)
    wire.now_s += 60.0
    _feed(service, view, "robot2", "robot1")
    assert service.step(is_active=True)


def test_owner_again_takes_its_predecessors_transforms_and_keeps_the_larger_canvas(view: View) -> None:
    wire = _Wire()
    first, second = _service(wire, Mode.ESTIMATE), _service(wire, Mode.ESTIMATE)
    _feed(first, view, "robot1")
    wire.now_s += 1.0
    assert first.step(is_active=True)
    small = wire.status()["map"]
    second.restore(first.snapshot())
    first.step(is_active=False)
    _feed(second, view, "robot1", "robot2")
    while second.step(is_active=True):
        wire.now_s += 1.0
    large = wire.status()["map"]
    assert large["width"] * large["height"] > small["width"] * small["height"]
    first.restore(second.snapshot())
    _feed(first, view, "robot1")
    assert first.step(is_active=True)
    again = wire.status()["map"]
    assert (again["width"], again["height"]) == (large["width"], large["height"])


def test_rate_bounds_merges_and_no_input_no_merge(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1")
    assert service.step(is_active=True)
    _feed(service, view, "robot1")
    assert not service.step(is_active=True)
    wire.now_s += 0.26
    assert service.step(is_active=True)
    wire.now_s += 0.26
    assert not service.step(is_active=True)


def test_every_merge_is_a_job_told_how_many_could_have_been_made_since_it_was_due(view: View) -> None:
    """Four a second: a merger that comes back after a second has left three out, and none that nobody wanted."""
    wire, skipped = _Wire(), list[int]()

    def job(count: int) -> AbstractContextManager[object]:
        skipped.append(count)
        return nullcontext()

    settings = MergerSettings(mode=Mode.KNOWN, poses=_POSES)
    service = MapMergeService(settings, wire.publish, clock=wire.clock, rate_hz=4.0, job=job, spawn=lambda work: work())
    for number, (waits_s, late_s) in enumerate(((0.0, 0.0), (0.25, 0.0), (0.25, 0.8), (60.0, 0.0), (60.0, 0.3))):
        wire.now_s += waits_s
        _feed(service, view, "robot1")
        wire.now_s += late_s
        assert service.step(is_active=True)
        assert len(skipped) == number + 1
    assert skipped == [0, 0, 3, 0, 1]


def test_status_goes_on_while_nothing_comes_in(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1")
    service.step(is_active=True)
    wire.now_s += 5.0
    service.step(is_active=True)
    status = wire.status()
    assert status["robots"]["robot1"]["map_age_s"] == 5.0
    assert "no map received" in status["robots"]["robot2"]["reason"]


def test_bad_message_is_counted_shown_and_stalls_nobody(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1")
    service.receive("robot2", b"no map")
    assert service.step(is_active=True)
    status = wire.status()["robots"]
    assert (status["robot2"]["bad"], status["robot2"]["maps"]) == (1, 0)
    assert "encapsulation" in status["robot2"]["last_error"]
    assert status["robot1"]["state"] == "attached"
    _feed(service, view, "robot2")
    wire.now_s += 1.0
    assert service.step(is_active=True)
    assert wire.status()["robots"]["robot2"]["state"] == "attached"


def test_bad_message_keeps_the_last_good_map(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1")
    service.step(is_active=True)
    service.receive("robot1", b"\x00\x01\x00\x00")
    wire.now_s += 1.0
    service.step(is_active=True)
    assert wire.status()["robots"]["robot1"]["state"] == "attached"


def test_deleted_stream_leaves_the_map_out(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1", "robot2")
    service.step(is_active=True)
    service.receive("robot2", b"", is_deleted=True)
    wire.now_s += 1.0
    assert service.step(is_active=True)
    assert wire.status()["robots"]["robot2"]["state"] == "waiting"


def test_strangers_are_counted_not_kept(view: View) -> None:
    wire = _Wire()
    service = _service(wire)
    _feed(service, view, "robot1")
    service.receive("Not A Name", b"")
    for number in range(MAX_ROBOTS + 5):
        service.receive(f"r{number}", b"")
    service.step(is_active=True)
    status = wire.status()
    assert status["strangers"] == 7
    assert len(status["robots"]) <= MAX_ROBOTS + 2


def test_snapshot_is_handed_on(view: View) -> None:
    wire = _Wire()
    service = _service(wire, Mode.ESTIMATE)
    _feed(service, view, "robot1", "robot2")
    wire.now_s += 1.0
    while service.step(is_active=True):
        wire.now_s += 1.0
    assert wire.status()["robots"]["robot2"]["state"] == "attached"
    heir = _service(wire, Mode.ESTIMATE)
    heir.restore(service.snapshot())
    _feed(heir, view, "robot1", "robot2")
    assert heir.step(is_active=True)  # it knows the reference: nothing to wait for
    status = wire.status()
    assert status["robots"]["robot2"]["state"] == "attached"
    assert status["merges"] == 1


def test_broken_snapshot_changes_nothing(view: View) -> None:
    wire = _Wire()
    service = _service(wire, Mode.ESTIMATE)
    service.restore(b"{")
    _feed(service, view, "robot1")
    wire.now_s += 1.0
    assert service.step(is_active=True)
    assert wire.status()["robots"]["robot1"]["state"] == "attached"


def test_search_runs_beside_the_merge_and_is_taken_in_later(view: View) -> None:
    wire = _Wire()
    started: list[Callable[[], None]] = []
    settings = MergerSettings(mode=Mode.ESTIMATE)
    service = MapMergeService(settings, wire.publish, clock=wire.clock, spawn=started.append)
    _feed(service, view, "robot1", "robot2")
    wire.now_s += 1.0
    assert service.step(is_active=True)
    for _ in range(3):  # merges go on, and no second search starts
        _feed(service, view, "robot1")
        wire.now_s += 1.0
        assert service.step(is_active=True)
    assert len(started) == 1
    assert wire.status()["is_searching"]
    assert wire.status()["robots"]["robot2"]["state"] == "waiting"
    assert "under way" in wire.status()["robots"]["robot2"]["reason"]
    started[0]()
    wire.now_s += 1.0
    assert service.step(is_active=True)
    assert wire.status()["robots"]["robot2"]["state"] == "attached"
    assert not wire.status()["is_searching"]


def test_search_in_its_own_thread_comes_back(view: View) -> None:
    wire = _Wire()
    service = MapMergeService(MergerSettings(mode=Mode.ESTIMATE), wire.publish, clock=wire.clock)
    _feed(service, view, "robot1", "robot2")
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        wire.now_s += 1.0
        service.step(is_active=True)
        if wire.status()["robots"]["robot2"]["state"] == "attached":
            return
        time.sleep(0.01)
    raise AssertionError("the search never came back")


def test_search_outcome_of_a_map_that_started_anew_is_dropped(view: View) -> None:
    wire = _Wire()
    started: list[Callable[[], None]] = []
    service = MapMergeService(MergerSettings(mode=Mode.ESTIMATE), wire.publish, clock=wire.clock, spawn=started.append)
    _feed(service, view, "robot1", "robot2")
    wire.now_s += 1.0
    service.step(is_active=True)
    service.receive("robot2", encode_grid(view((7.0, 0.0, 9.0, 2.0), Pose2())))
    wire.now_s += 1.0
    service.step(is_active=True)
    started[0]()
    wire.now_s += 1.0
    service.step(is_active=True)
    assert wire.status()["robots"]["robot2"]["state"] != "attached"
