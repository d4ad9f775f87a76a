from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from zsched.config.load import load_fleet
from zsched.host.clock import monotonic_s
from zsched_lab.explore.robot import parse as parse_explorer
from zsched_lab.fleet.children import Children
from zsched_lab.fleet.limits import LimitKind, NodeLimits
from zsched_lab.fleet.recorder import Recorder
from zsched_lab.maps.laser_log import malaga_path
from zsched_lab.paper import run as paper_run
from zsched_lab.paper.cells import Cell
from zsched_lab.paper.load import Loads
from zsched_lab.paper.node_state import is_calm, ready_workers
from zsched_lab.paper.places import robots_scenario_path, scenario_path
from zsched_lab.paper.robots import ExploreRobots, LogRobots, Place
from zsched_lab.paper.run import CellRun, Inputs, Seen
from zsched_lab.paper.scenario import LinkView, MergeTask, load_scenario
from zsched_lab.paper.schemes import SCHEMES
from zsched_lab.robots.app import parse


def a_place(records: Path, robot: str = "robot2", index: int = 1) -> Place:
    return Place(
        robot=robot,
        index=index,
        robots=3,
        seed=7,
        endpoint="tcp/127.0.0.1:7458",
        records=records,
        duration_s=30.0,
        target_coverage=0.8,
        begin_s=1234.5678,
    )


def test_a_log_robots_command_is_one_that_its_program_takes(tmp_path: Path) -> None:
    robots = LogRobots(log=malaga_path())

    options = parse(robots.command(a_place(tmp_path))[3:])

    assert (options.robot, options.index, options.robots, options.seed) == ("robot2", 1, 3, 7)
    assert (options.endpoint, options.replay_s, options.records) == ("tcp/127.0.0.1:7458", 30.0, tmp_path)
    assert options.begin_s == 1234.568
    assert robots.name == "log malaga-keyframes.csv.gz"
    assert len(robots.frames(3, 7)) == 3
    assert robots.frames(3, 7) == robots.frames(3, 7) != robots.frames(3, 8)
    assert not robots.ends_when_covered


def test_an_exploring_robots_command_is_one_that_its_program_takes(tmp_path: Path) -> None:
    robots = ExploreRobots(world="turtlebot3", speed=0.4)

    options = parse_explorer(robots.command(a_place(tmp_path))[3:])

    assert options.settings.robot == "robot2"
    assert options.settings.start == robots.frames(3, 7)[1]
    assert (options.settings.limits.speed, options.target, options.endpoint) == (0.4, 0.8, "tcp/127.0.0.1:7458")
    assert (options.begin_s, options.phase) == (1234.568, 1 / 3)
    assert robots.name == "explore turtlebot3"
    assert robots.ends_when_covered
    assert robots.truth().known.any()
    assert abs(robots.truth().resolution - 0.05) < 1e-9


def test_mapping_may_be_placed_on_other_nodes(tmp_path: Path) -> None:
    robots = ExploreRobots(world="turtlebot3", speed=0.4, slam_on={"robot2": "edge1"})

    ((node, command),) = robots.helpers({"edge1": "tcp/127.0.0.1:1", "robot2": "tcp/127.0.0.1:2"})

    assert not parse_explorer(robots.command(a_place(tmp_path))[3:]).settings.has_slam
    assert parse_explorer(robots.command(a_place(tmp_path, "robot1", 0))[3:]).settings.has_slam
    assert (node, command[2:]) == (
        "edge1",
        ["zsched_lab.explore.slam", "--resolution", "0.05", "--robot", "robot2", "--endpoint", "tcp/127.0.0.1:1"],
    )
    assert LogRobots(log=malaga_path()).helpers({}) == ()
    fine = replace(robots, resolution_m=0.02)
    assert parse_explorer(fine.command(a_place(tmp_path))[3:]).settings.resolution_m == 0.02


def test_the_task_is_over_when_every_robot_has_said_so(tmp_path: Path) -> None:
    seen = Seen(("robot1", "robot2"), tmp_path)
    with Recorder(tmp_path) as recorder:
        assert not seen.is_covered()
        recorder.write("robot1", {"kind": "covered", "t_s": 1.0})
        recorder.write("robot2", {"kind": "map", "t_s": 1.0})
        assert not seen.is_covered()
        recorder.write("robot2", {"kind": "covered", "t_s": 2.0})
        assert seen.is_covered()
        assert seen.is_covered()


class SlowLoads(Loads):
    """Loads whose start takes a moment; meanwhile every robot finds that its map covers the target."""

    said_s = math.inf

    def tick(self, t_s: float) -> None:
        super().tick(t_s)
        if self.said_s < math.inf:
            return
        time.sleep(0.02)
        self.said_s = monotonic_s()
        with Recorder(self._records) as recorder:
            for robot in ("robot1", "robot2", "robot3"):
                recorder.write(robot, {"kind": "covered", "t_s": self.said_s})


def test_a_run_ends_no_sooner_than_the_word_that_ended_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the last robot's word comes after the end, and a run that ended because it was done counts as not done."""
    monkeypatch.setattr(paper_run, "SETTLE_S", 0.0)
    scenario = load_scenario(scenario_path())
    robots = ExploreRobots(world="office", speed=1.0)
    cell = Cell(scheme=SCHEMES["zsched"], level=scenario.level, run=0)
    run: Any = CellRun(scenario, cell, Inputs(robots=robots), tmp_path)  # its loop by itself, without any fleet
    run._next_sample_s = math.inf
    level, limits = scenario.levels[scenario.level], NodeLimits(LimitKind.NONE, "no shares")
    with Children(tmp_path / "logs") as children:
        loads = SlowLoads((), level, 1.0, children, limits, tmp_path / "records", print)
        parts = SimpleNamespace(fleet=run.write_fleet(), loads=loads)
        run._zero_s = zero_s = monotonic_s()
        end_s = run._drive(children, parts)

    assert 0.0 < loads.said_s - zero_s <= end_s < scenario.duration_s


def test_each_robot_hears_the_others_where_the_scenario_says_so(tmp_path: Path) -> None:
    scenario = load_scenario(robots_scenario_path())
    inputs = Inputs(robots=LogRobots(log=malaga_path()))
    folders = {view: tmp_path / view.value for view in LinkView}
    for view, folder in folders.items():
        folder.mkdir()
        cell = Cell(scheme=SCHEMES["zsched"], level=scenario.level, run=0)
        CellRun(replace(scenario, link_view=view), cell, inputs, folder).write_fleet()
    direct, point = (load_fleet(folders[view] / "fleet.yaml") for view in (LinkView.DIRECT, LinkView.ACCESS_POINT))

    heard = {link.peer: Path(link.value).name for link in direct.node("robot1").links}
    assert heard == {None: "drive-robot1.csv", "robot2": "drive-robot2.csv", "robot3": "drive-robot3.csv"}
    assert [link.peer for link in point.node("robot1").links] == [None]
    assert {link.offset_s for link in direct.node("robot1").links if link.peer == "robot3"} == {120.0}


@pytest.mark.parametrize(("mode", "told"), [("known", 3), ("track", 3), ("estimate", 1)])
def test_the_merger_is_told_the_task_and_only_the_poses_that_its_mode_needs(
    tmp_path: Path, mode: str, told: int
) -> None:
    scenario = load_scenario(scenario_path())
    merge = MergeTask(mode=mode, rate_hz=8.0, resolution_m=0.02, min_agreeing=150)
    cell = Cell(scheme=SCHEMES["zsched"], level=scenario.level, run=0)
    run = CellRun(replace(scenario, merge=merge), cell, Inputs(robots=LogRobots(log=malaga_path())), tmp_path)
    run.write_fleet()

    command = list(load_fleet(tmp_path / "fleet.yaml").tasks[0].worker.command)
    given = {option: command[command.index(option) + 1] for option in ("--mode", "--rate", "--resolution")}
    assert given == {"--mode": mode, "--rate": "8", "--resolution": "0.02"}
    assert command[command.index("--min-agreeing") + 1] == "150"
    poses = [command[index + 1] for index, word in enumerate(command) if word == "--pose"]
    assert [pose.split("=")[0] for pose in poses] == ["robot1", "robot2", "robot3"][:told]


def test_nobody_starts_with_a_handicap() -> None:
    worker = {"task": "map_merge", "state": "ready"}
    edge1 = {"name": "edge1", "cpu_ratio": 0.1, "workers": [worker]}
    edge2 = {"name": "edge2", "cpu_ratio": 0.9, "workers": [worker | {"state": "starting"}]}
    statuses = {"edge1": {"nodes": [edge1, edge2]}, "edge2": {"nodes": [edge1, edge2]}}

    assert ready_workers(statuses["edge1"], "map_merge") == {"edge1"}
    assert ready_workers(statuses["edge1"], "other") == set()
    assert is_calm(statuses, ("edge1",))
    assert not is_calm(statuses, ("edge1", "edge2"))
    assert not is_calm({}, ("edge1",))
    assert not is_calm({"edge1": {"nodes": [{"name": "edge1", "cpu_ratio": None}]}}, ("edge1",))
    assert is_calm({}, ())
