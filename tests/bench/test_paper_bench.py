"""One cell of the paper's matrix with real daemons, workers, load and recorder, from fleet file to figures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.netns import why_not
from zsched_lab.fleet.recorder import read_records
from zsched_lab.maps.laser_log import malaga_path
from zsched_lab.paper.bench import BenchOptions, InputsOf
from zsched_lab.paper.cells import Cell, bandwidth_of, world_of
from zsched_lab.paper.metrics import Truth, measure
from zsched_lab.paper.places import robots_scenario_path, scenario_path, shipped_scenario
from zsched_lab.paper.robots import ExploreRobots, LogRobots
from zsched_lab.paper.run import CellRun, Inputs
from zsched_lab.paper.scenario import LoadPlan, load_scenario
from zsched_lab.paper.schemes import SCHEMES

pytestmark = pytest.mark.long

WHY_NOT = LimitedGroup.why_not()
NO_SPACES = WHY_NOT or why_not()
DRIVE_S = 5.0


@pytest.mark.root
@pytest.mark.skipif(WHY_NOT is not None, reason=f"no control groups: {WHY_NOT}")
def test_a_cell_is_run_and_measured_and_leaves_nothing(tmp_path: Path) -> None:
    plan = LoadPlan(lanes=1, busy_s=(3.0, 3.0), idle_s=(0.0, 0.0), first_s=1.0)
    scenario = replace(load_scenario(scenario_path()), duration_s=DRIVE_S, load=plan, target_coverage=0.01)
    cell = Cell(scheme=SCHEMES["random"], level="one", run=0)
    folder = tmp_path / "cell"

    robots = LogRobots(log=malaga_path())
    one = CellRun(scenario, cell, Inputs(robots=robots), folder)
    run = one.run()
    figures = measure(folder, scenario, Truth(robots.truth()))

    assert run == json.loads((folder / "run.json").read_text()) | {"robots": tuple(run["robots"])}
    assert run["allocations"][0]["node"] in {"edge1", "edge2", "edge3"}
    assert [load["node"] for load in run["loads"]] == [window["node"] for window in run["windows"]]
    # Under the lot of `random` the first owner is whoever the robots agreed on, then the lot's, all by commits.
    assert [move["epoch"] for move in run["allocations"]] == list(range(1, len(run["allocations"]) + 1))
    assert (folder / "plan.json").exists()
    assert figures["map_hz"] > 0
    assert figures["is_done"]
    assert all(figures["nodes"][node]["cpu_mean"] is not None for node in scenario.nodes)
    assert all(figures["nodes"][node]["memory_mean"] > 0.02 for node in scenario.nodes)
    with (folder / "streams.mcap").open("rb") as stream:
        topics = {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert {f"{robot}/{name}" for robot in run["robots"] for name in ("map", "global_map")} <= topics
    decisions = read_records(folder / "records" / "decisions.ndjson")
    assert {record["node"] for record in decisions} == set(run["robots"])
    assert any(record["decision"] and record["decision"]["utilities"] for record in decisions)
    assert one.left_behind == []


@pytest.mark.root
@pytest.mark.skipif(WHY_NOT is not None, reason=f"no control groups: {WHY_NOT}")
def test_a_cell_whose_slam_are_tasks_leads_its_robots_from_the_edges(tmp_path: Path) -> None:
    path = shipped_scenario("nano-moves")
    assert path is not None
    load = LoadPlan(lanes=1, busy_s=(20.0, 20.0), idle_s=(0.0, 0.0), first_s=1.0)
    scenario = replace(load_scenario(path), duration_s=12.0, warm_up_s=3.0, load=load)
    options = BenchOptions(out=tmp_path, scenario=path, robots_scenario=robots_scenario_path(), is_exploring=True)
    cell = Cell(scheme=SCHEMES["zsched_slam"], level="one", run=0, block="nano_moves")
    inputs, folder = InputsOf(options, scenario).of(cell), tmp_path / "cell"

    one = CellRun(scenario, cell, inputs, folder)
    run = one.run()
    figures = measure(folder, scenario, Truth(inputs.robots.truth()))

    assert sorted(run["others"]) == ["slam_robot1", "slam_robot2", "slam_robot3"]
    assert all(moves[0]["node"] in scenario.nodes for moves in run["others"].values())
    assert figures["corrections_hz"] > 1.0
    assert figures["pose_error_m"] < 0.5
    assert figures["coverage_mean"] > 0.0
    assert figures["merge_cpu_s"] is not None
    roles = {role for states in figures["roles"].values() for row in states.values() for role in row}
    assert {"slam", "navigation", "merge", "model"} <= roles
    assert run["warm_up_s"] == 3.0
    assert one.left_behind == []


@pytest.mark.root
@pytest.mark.skipif(NO_SPACES is not None, reason=f"no control groups or namespaces: {NO_SPACES}")
def test_a_cell_in_closed_loop_behind_narrow_links_ends_at_its_target(tmp_path: Path) -> None:
    scenario = replace(load_scenario(scenario_path()), duration_s=60.0, target_coverage=0.3)
    cell = Cell(scheme=SCHEMES["fixed_e2"], level="half", run=1, block="narrow")
    loop = scenario.explore
    robots = ExploreRobots(world=world_of(scenario, cell), speed=loop.speed, slam_on=loop.slam_on)
    folder = tmp_path / "cell"

    one = CellRun(scenario, cell, Inputs(robots=robots), folder)
    run = one.run()
    figures = measure(folder, scenario, Truth(robots.truth()))

    assert run["bandwidth_mbit"] == bandwidth_of(scenario, cell) == 9.8
    assert run["input"] == f"explore office:{scenario.seed + 1}"
    assert figures["is_done"]
    assert figures["task_latency_s"] <= run["duration_s"] < 60.0  # it ended when every robot held its target
    assert sorted(path.name for path in folder.glob("*.mcap")) == [f"streams-{robot}.mcap" for robot in run["robots"]]
    assert figures["map_hz"] > 0
    assert {move["node"] for move in run["allocations"]} == {"edge2"}
    assert one.left_behind == []
