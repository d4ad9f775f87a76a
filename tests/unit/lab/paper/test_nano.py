"""The blocks that were declared before their runs (`nano`, `nano_moves`, `heavy_all`), and what is said of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from zsched.config.load import load_fleet
from zsched.core.values.errors import ConfigError
from zsched_lab.explore.robot import parse as parse_explorer
from zsched_lab.paper.arrivals import Arrival, Streams
from zsched_lab.paper.bench import BenchOptions, InputsOf, planned
from zsched_lab.paper.cells import Cell, cells_of
from zsched_lab.paper.claims import (
    declared,
)
from zsched_lab.paper.led_metrics import (
    coverage_figures,
    led_of,
    mean_stood,
    merge_cpu_s,
    pose_errors,
    stood_figures,
)
from zsched_lab.paper.matrix import invalid_reason
from zsched_lab.paper.metrics import slam_places
from zsched_lab.paper.places import robots_scenario_path, scenario_path, shipped_names, shipped_scenario
from zsched_lab.paper.plan import AROUND_S, cell_s, plan_text
from zsched_lab.paper.remarks import declared_parts
from zsched_lab.paper.report import (
    report,
)
from zsched_lab.paper.robots import ODOMETRY, ExploreRobots, Place, slam_task
from zsched_lab.paper.roles import REST, RoleMeter, mean_shares, role_figures
from zsched_lab.paper.run import CellRun, Inputs
from zsched_lab.paper.scenario import MATRIX, NodeShare, Scenario, load_scenario
from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES

AUTHORS = {"slam": 0.352, "model": 0.60, "merge": 0.096, "navigation": 0.027}
"""Shares of a Jetson Nano's CPU: config/task_req.yaml of herolab-uga/ros-edge-orchestration, rounded."""


def shipped(name: str) -> Scenario:
    path = shipped_scenario(name)
    assert path is not None
    return load_scenario(path)


def options(tmp_path: Path, name: str, **given: Any) -> BenchOptions:
    path = shipped_scenario(name)
    assert path is not None
    exploring = {"is_exploring": True} | given
    return BenchOptions(out=tmp_path, scenario=path, robots_scenario=robots_scenario_path(), **exploring)


# --- what is declared ------------------------------------------------------------------------------------------------


def test_the_shipped_scenarios_are_found_by_name_and_nothing_else_is() -> None:
    assert shipped_names() == (
        "heavy-all",
        "nano",
        "nano-again",
        "nano-moves",
        "paper",
    )
    assert shipped_scenario("paper") == scenario_path()
    assert shipped_scenario("nono") is None
    assert shipped_scenario("../paper") is None


def test_nano_has_the_authors_demands_in_their_proportions() -> None:
    scenario = shipped("nano")
    loop, level = scenario.explore, scenario.levels[scenario.level]

    assert loop.slam_share == AUTHORS["slam"]
    assert loop.navigate_share == AUTHORS["navigation"]
    assert level.streams * level.share == pytest.approx(AUTHORS["model"])
    assert sum(AUTHORS.values()) > 1.07  # the tipping point: all of them are more than an edge
    assert sum(AUTHORS.values()) - AUTHORS["merge"] < 1.0  # and without the merger they are not
    assert len({(share.cpu_cores, share.overhead_cores, share.memory_mb) for share in scenario.nodes.values()}) == 1
    assert (scenario.merge.mode, scenario.merge.rate_hz, loop.speed) == ("estimate", 0.5, 0.22)
    assert (scenario.duration_s, loop.duration_s) == (300, 300)
    assert not loop.ends_at_target
    assert list(scenario.load.busy_s) == [30, 90]
    assert sorted(loop.slam_on.values()) == sorted(scenario.nodes)


@pytest.mark.parametrize("name", ["nano", "nano-again", "nano-moves"])
def test_every_program_s_demand_is_the_authors_and_its_worker_goes_to_the_tasks_group(name: str) -> None:
    scenario = shipped(name)
    fleet = load_fleet(scenario.fleet)
    for task in fleet.tasks:
        share = AUTHORS["merge" if task.name == "map_merge" else "slam"]
        assert task.demand.cpu_cores == pytest.approx(share * scenario.full_cores, rel=0.02)
        assert task.worker.command[:3] == ("python", "-m", "zsched_lab.paper.work_group")


def test_each_declared_block_is_all_that_its_scenario_runs() -> None:
    wanted = {
        "nano": (("fixed_e1", "fixed_e2", "fixed_e3", "dyna_cpu", "dyna_mem", "dyna_both", "zsched"), 5),
        "nano-again": (("fixed_e1", "dyna_cpu", "dyna_both", "zsched"), 5),
        "nano-moves": (("dyna_both", "dyna_both_slam", "zsched", "zsched_slam"), 5),
        "heavy-all": ((*FIXED_SCHEMES, *PAPER_SCHEMES, "zsched", "oracle"), 5),
    }
    limits, seeds = set(), set(range(20260, 20260 + 100))
    for name, (schemes, runs) in wanted.items():
        scenario = shipped(name)
        cells = cells_of(scenario, ())
        assert {cell.block for cell in cells} == {scenario.main} == {name.replace("-", "_")}
        assert sorted(cell.scheme.name for cell in cells) == sorted(schemes * runs)
        own = {scenario.run_seed(run) for run in range(runs)}
        assert not own & seeds, "seeds of its own"
        seeds |= own
        limits.add(scenario.pressure_limit)
        assert scenario.warm_up_s == 60
        assert cell_s(scenario, cells[0]) == scenario.duration_s + 60 + AROUND_S
    assert limits == {load_scenario(scenario_path()).pressure_limit}, "one limit"


def test_every_second_run_takes_the_schemes_in_reverse() -> None:
    scenario = shipped("heavy-all")
    order = [[cell.scheme.name for cell in cells_of(scenario, ()) if cell.run == run] for run in range(3)]
    assert order[0] == order[2] == order[1][::-1]
    assert abs(order[0].index("zsched") - order[0].index("dyna_both")) == 1


def test_quick_runs_the_first_block_of_the_readme(tmp_path: Path) -> None:
    scenario, cells, _ = planned(options(tmp_path, "paper", is_quick=True))
    assert [cell.name for cell in cells] == [f"heavy-{name}-1" for name in (*FIXED_SCHEMES, "dyna_both", "zsched")]
    assert sum(cell_s(scenario, cell) for cell in cells) < 6 * 60
    _, replayed, _ = planned(options(tmp_path, "paper", is_quick=True, is_exploring=False))
    assert {cell.block for cell in replayed} == {MATRIX}, "a log cannot be explored"


def test_the_plan_tells_the_warm_up_and_the_task() -> None:
    scenario = shipped("nano")
    cells = cells_of(scenario, ())
    text = plan_text(scenario, cells, cells, 0.0, {}, None)
    assert "1 min of warm-up in every run; quotas 0.945 cores" in text
    assert "mode estimate, at most 0.5 maps/s" in text


def test_a_block_for_robots_that_explore_does_not_replay_a_log(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nano"):
        planned(options(tmp_path, "nano", is_exploring=False))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("main: nono", "main"),
        ("quick: nono", "quick"),
        ("explore: {slam_share: 2}", "slam_share"),
        ("explore: {slam_share: 0.3}", "slam_on"),
        ("explore: {first: {robot1: [1, 0]}}", "robot1 is led by no SLAM"),
        ("explore: {slam_on: {r: e}, slam_share: 0.3, first: {r: [1]}}", r"give \[x, y\]"),
        ("explore: {slam_on: {r: e}, slam_share: 0.3, first: {r: [1, 1000]}}", "explore.first"),
        ("warm_up_s: -1", "warm_up_s"),
        ("idle_floor: 2", "idle_floor"),
        ("nodes: {e: {cpu_cores: 1.0, overhead_cores: 0.6, memory_mb: 512}}", "1.6 cores"),
    ],
)
def test_a_wrong_key_is_told(tmp_path: Path, line: str, told: str) -> None:
    path = tmp_path / "x.scenario.yml"
    path.write_text(
        f"name: x\nfleet: f.yaml\nduration_s: 10\nseed: 1\nruns: 1\nlevel: one\nlevels: {{one: {{}}}}\n{line}\n"
    )
    with pytest.raises(ConfigError, match=told):
        load_scenario(path)


def test_a_machine_that_did_not_idle_could_not_keep_its_quotas() -> None:
    scenario = replace(shipped("nano"), idle_floor=0.15)
    assert invalid_reason(scenario, {"pressure": 0.1, "idle_ratio": 0.2}) is None
    assert "idle for 0.10" in (invalid_reason(scenario, {"pressure": 0.1, "idle_ratio": 0.1}) or "")
    assert "pressure" in (invalid_reason(scenario, {"pressure": 0.2, "idle_ratio": 0.9}) or "")
    assert invalid_reason(replace(scenario, idle_floor=0.0), {"pressure": 0.1, "idle_ratio": 0.0}) is None


def test_zsched_s_own_cpu_comes_on_top_of_an_edge() -> None:
    share = NodeShare(cpu_cores=0.28, overhead_cores=0.035, memory_mb=1024)
    assert share.quota_cores == pytest.approx(0.315)
    assert replace(share, work_cores=0.02).quota_cores == pytest.approx(0.335)
    assert shipped("nano").full_cores == 0.28, "shares are of the edge, not of its quota"


# --- what is started -------------------------------------------------------------------------------------------------


def a_place(records: Path) -> Place:
    return Place(
        robot="robot2",
        index=1,
        robots=3,
        seed=5,
        endpoint="tcp/127.0.0.1:1",
        records=records,
        duration_s=30.0,
        target_coverage=0.7,
        begin_s=10.0,
        drive_s=70.0,
    )


def the_robots(name: str, tmp_path: Path) -> ExploreRobots:
    given = options(tmp_path, name)
    scenario, cells, _ = planned(given)
    robots = InputsOf(given, scenario).of(cells[0]).robots
    assert isinstance(robots, ExploreRobots)
    return robots


def test_nano_s_robots_are_led_by_slam_and_navigation_on_their_edges(tmp_path: Path) -> None:
    robots = the_robots("nano", tmp_path)
    endpoints = {f"edge{number}": f"tcp/127.0.0.1:{number}" for number in (1, 2, 3)}

    started = robots.helpers(endpoints)
    given = parse_explorer(robots.command(a_place(tmp_path))[3:])

    assert sorted((node, command[2].rpartition(".")[2]) for node, command in started) == [
        (f"edge{number}", what) for number in (1, 2, 3) for what in ("navigate", "slam")
    ]
    first = started[0][1]
    assert first[first.index("--match") + 1] == f"{0.352 * 0.28:g}"
    last = started[-1][1]
    assert last[last.index("--cores") + 1] == f"{0.027 * 0.28:g}"
    assert (given.settings.is_led, given.settings.has_slam, given.slam_task) == (True, False, "")
    assert (given.begin_s, given.settings.hold_until_s, given.settings.drift) == (10.0, 70.0, ODOMETRY)
    assert not robots.ends_when_covered


def test_slam_that_is_a_task_is_not_started_beside(tmp_path: Path) -> None:
    robots = the_robots("nano-moves", tmp_path)
    endpoints = {f"edge{number}": f"tcp/127.0.0.1:{number}" for number in (1, 2, 3)}
    assert {command[2] for _, command in robots.helpers(endpoints)} == {"zsched_lab.explore.navigate"}
    assert parse_explorer(robots.command(a_place(tmp_path))[3:]).slam_task == "slam_robot2"


@pytest.mark.parametrize(
    ("scheme", "wanted"),
    [
        ("zsched", {"slam_robot1": ("edge1",), "slam_robot3": ("edge3",)}),
        ("zsched_slam", {"slam_robot1": ("edge1", "edge2", "edge3"), "slam_robot3": ("edge1", "edge2", "edge3")}),
        ("dyna_both_slam", {"slam_robot2": ("edge1", "edge2", "edge3")}),
    ],
)
def test_a_scheme_moves_slam_only_where_it_says_so(
    tmp_path: Path, scheme: str, wanted: dict[str, tuple[str, ...]]
) -> None:
    given = options(tmp_path, "nano-moves")
    scenario, _, _ = planned(given)
    cell = Cell(scheme=SCHEMES[scheme], level="one", run=0, block="nano_moves")
    lab = CellRun(scenario, cell, Inputs(robots=the_robots("nano-moves", tmp_path)), tmp_path).write_fleet()

    tasks = {task.name: task for task in load_fleet(lab.path).tasks}

    assert (lab.task, sorted(lab.others)) == ("map_merge", [slam_task(f"robot{number}") for number in (1, 2, 3)])
    assert set(tasks["map_merge"].candidates) == {"edge1", "edge2", "edge3"}
    assert {name: tuple(sorted(tasks[name].candidates)) for name in wanted} == wanted
    command = list(tasks["slam_robot1"].worker.command)
    assert command[command.index("--match") + 1] == f"{0.352 * scenario.full_cores:g}"
    assert "0.5" in tasks["map_merge"].worker.command
    is_papers = scheme.startswith("dyna")
    assert (tasks["slam_robot1"].tuning.score.value == "paper") == is_papers


def test_a_robot_is_led_only_by_a_node(tmp_path: Path) -> None:
    robots = ["--robot", "robot1", "--world", "turtlebot3", "--endpoint", "x", "--records", str(tmp_path)]
    for wrong in (["--led"], ["--slam-on", "edge1", "--slam-task", "slam_robot1"]):
        with pytest.raises(SystemExit):
            parse_explorer([*robots, *wrong])


# --- whose CPU it was ------------------------------------------------------------------------------------------------


def a_process(proc: Path, pid: int, command: str, ticks: int) -> None:
    folder = proc / str(pid)
    folder.mkdir(exist_ok=True)
    (folder / "cmdline").write_bytes(command.replace(" ", "\0").encode())
    (folder / "stat").write_text(f"{pid} (a) b) S 1 1 1 0 -1 0 0 0 0 0 {ticks} {ticks} 0 0 20 0 4 0 9 9 9\n")


def test_processes_are_told_apart_by_their_programs_and_the_dead_are_remembered(tmp_path: Path) -> None:
    pids = [1, 2, 3, 4, 5, 6]
    meter = RoleMeter(lambda: pids, tmp_path)
    names = ("explore.slam --robot r", "explore.navigate", "paper.cameras", "explore.slam_worker")
    for pid, name in enumerate(names, start=1):
        a_process(tmp_path, pid, f"python -m zsched_lab.{name}", 100)
    a_process(tmp_path, 5, "python -m zsched.tasks.map_merge --mode estimate", 50)
    a_process(tmp_path, 6, "python -I -S launch.py", 1)

    first = meter.read()
    pids.remove(3)
    a_process(tmp_path, 6, "zsched up", 300)
    a_process(tmp_path, 1, "python -m zsched_lab.explore.slam --robot r", 150)
    second = meter.read()
    pids.append(77)  # gone before it was looked at

    assert first == {"merge": 1.0, "model": 2.0, "navigation": 2.0, "slam": 4.0, REST: 0.02}
    assert second == {"merge": 1.0, "model": 2.0, "navigation": 2.0, "slam": 5.0, REST: 6.0}
    assert meter.read() == second


def test_shares_of_an_edge_are_told_by_what_was_on_it() -> None:
    records = [
        {"t_s": 0.0, "loaded": [], "roles": {"edge1": {"slam": 0.0}}},
        {"t_s": 10.0, "loaded": ["edge1"], "roles": {"edge1": {"slam": 1.0}}},
        {"t_s": 20.0, "loaded": ["edge1"], "roles": {"edge1": {"slam": 1.5, "model": 1.0}}},
        {"t_s": 30.0, "loaded": ["edge1"], "roles": {"edge1": {"slam": 2.5, "model": 3.0, "merge": 0.2}}},
        {"t_s": 40.0, "loaded": []},
    ]
    found = role_figures(records, {"edge1": {"cpu_cores": 0.5}}, lambda t_s: "edge1" if t_s >= 20.0 else None)

    assert found == {
        "edge1": {
            "idle": {"s": 10.0, "slam": 0.2},
            "model": {"s": 10.0, "model": 0.2, "slam": 0.1},
            "both": {"s": 10.0, "merge": 0.04, "model": 0.4, "slam": 0.2},
        }
    }
    both = mean_shares([found, {"edge2": {"both": {"s": 30.0, "slam": 0.6}}}], "both")
    assert both["slam"] == pytest.approx((0.2 * 10 + 0.6 * 30) / 40)
    assert mean_shares([found], "merge") == {}
    assert merge_cpu_s(records, 2) == pytest.approx(0.1)
    assert merge_cpu_s(records[:1], 2) is None
    assert merge_cpu_s(records, 0) is None


# --- coverage over time ----------------------------------------------------------------------------------------------


def test_coverage_over_time_is_the_mean_of_what_the_robots_hold() -> None:
    maps = {
        "robot1": [Arrival(-3.0, 0.1, 1, 0.1), Arrival(6.0, 0.1, 1, 0.5)],
        "robot2": [Arrival(10.0, 0.1, 1, 0.4), Arrival(11.0, 0.1, 1, 0.9)],
    }
    found = coverage_figures(Streams(maps=maps), 11.0, 11.0, area_m2=200.0)

    assert found["coverage_curve"] == [[0.0, 0.05], [5.0, 0.05], [10.0, 0.45], [11.0, 0.7]]
    first, second = (0.1 * 6 + 0.5 * 5) / 11, 0.4 * 1 / 11
    assert found["coverage_mean"] == pytest.approx((first + second) / 2)
    assert found["explored_m2"] == pytest.approx(140.0)
    assert found["walls_mean"] == 0.0
    walls = {"robot1": [Arrival(-3.0, 0.1, 1, 0.1, 0.05), Arrival(6.0, 0.1, 1, 0.5, 0.2)]}
    assert coverage_figures(Streams(maps=walls), 11.0, 11.0, area_m2=200.0)["walls_mean"] == pytest.approx(1.3 / 11)


def test_a_run_that_is_done_sooner_covers_more_on_the_way() -> None:
    """What it knew at its end holds for as long as a run may take; what came behind its end does not count."""
    maps = {"robot1": [Arrival(-1.0, 0.1, 1, 0.2, 0.1), Arrival(6.0, 0.1, 1, 0.8, 0.6), Arrival(6.5, 0.1, 1, 0.9, 0.7)]}
    found = coverage_figures(Streams(maps=maps), 6.2, 12.0, area_m2=100.0)

    assert found["coverage_curve"] == [[0.0, 0.2], [5.0, 0.2], [10.0, 0.8], [12.0, 0.8]]
    assert found["coverage_mean"] == pytest.approx((0.2 * 6 + 0.8 * 6) / 12)
    assert found["walls_mean"] == pytest.approx((0.1 * 6 + 0.6 * 6) / 12)
    assert found["explored_m2"] == pytest.approx(80.0)


def test_how_a_robot_was_led_is_told_of_its_drive_only() -> None:
    run = {"zero_s": 100.0, "duration_s": 10.0}
    progress = [
        {"kind": "progress", "t_s": t, "stopped_s": s, "corrections": c, "correction_age_s": a}
        for t, s, c, a in ((90.0, 0.0, 1, 9.0), (100.0, 0.0, 50, 0.3), (105.0, 2.0, 70, 1.8), (110.0, 2.5, 95, 0.4))
    ]
    start = {"kind": "start", "t_s": 90.0, "x": 1.0, "y": 2.0, "yaw": 0.0}
    path = [{"kind": "path", "t_s": 95.0, "x": 1.0, "y": 2.0, "belief_x": 0.0, "belief_y": 0.0}] * 5
    path += [
        {"kind": "path", "t_s": 101.0 + n, "x": 1.0, "y": 2.0, "belief_x": 0.1 * n, "belief_y": 0.0} for n in range(3)
    ]

    found = led_of([start, *progress, *path], run)

    assert found == {
        "stopped_ratio": 0.25,
        "corrections_hz": 4.5,
        "correction_age_max_s": 1.8,
        "pose_error_m": pytest.approx(0.1),
    }
    assert led_of([start, {**progress[1], "corrections": 0}, {**progress[2], "corrections": 0}], run) is None
    assert pose_errors([], 0.0, 1.0) == [0.0]


def test_how_long_robots_stood_is_told_by_what_was_on_the_edge_of_their_slam(tmp_path: Path) -> None:
    """A model from 2 to 8 s, the merger from 4 s on; of the moments in which one came nothing is told."""
    (tmp_path / "records").mkdir()
    stopped = (0.0, 0.0, 0.5, 0.5, 1.0, 2.0, 2.5, 3.0, 3.0, 3.25, 3.25)
    lines = [
        {"kind": "progress", "t_s": 100.0 + t, "stopped_s": s, "corrections": 10 + 5 * t}
        for t, s in enumerate(stopped, -1)
    ]
    text = "".join(json.dumps(line) + "\n" for line in [{"kind": "start", "t_s": 99.0}, *lines])
    (tmp_path / "records/robot1.ndjson").write_text(text)
    run = {"zero_s": 100.0, "duration_s": 9.0, "loads": [{"node": "edge1", "start_s": 2.0, "end_s": 8.0}]}

    def owner(t_s: float) -> str:
        return "edge1" if t_s >= 4.0 else "edge2"

    found = stood_figures(tmp_path, run, slam_places(run, {"robot1": "edge1"}), owner)
    assert found == {
        "idle": {"s": 1.0, "stood": 0.5},
        "model": {"s": 1.0, "stood": 0.5},
        "both": {"s": 3.0, "stood": 0.3333},
        "merge": {"s": 1.0, "stood": 0.0},
    }
    places = [("edge1", -9.0), ("edge3", 4.5), ("edge2", 6.5)]
    moved = run | {"others": {"slam_robot1": [{"node": node, "t_s": t_s} for node, t_s in places]}}
    assert stood_figures(tmp_path, moved, slam_places(moved, {"robot1": "edge1"}), owner) == {
        "idle": {"s": 4.0, "stood": 0.3125},
        "model": {"s": 1.0, "stood": 0.5},
    }, "its edge is where SLAM is then; of the seconds in which it moved nothing is told"
    assert mean_stood([found, {"both": {"s": 6.0, "stood": 0.0}}], "both") == pytest.approx((9.0, 1.0 / 9.0), abs=0.01)
    assert mean_stood([{}], "both") is None
    assert stood_figures(tmp_path, run, {}, owner) == {}


def a_run(scheme: str, run: int, covered: float, **changed: Any) -> dict[str, Any]:
    curve = [[5.0 * n, round(covered * n / 12, 4)] for n in range(13)]
    figures = {"scheme": scheme, "block": "nano", "level": "one", "run": run, "coverage_curve": curve}
    figures |= {"coverage_mean": covered / 2, "explored_m2": 500 * covered, "stopped_ratio": 0.1, "moves": 2}
    figures |= {"move_gap_mean_s": 0.2, "move_gap_max_s": 0.3, "lost_per_move": 0.0, "map_hz": covered}
    figures |= {"roles": {"edge1": {"both": {"s": 30.0, "slam": 0.31, "model": 0.58, "zsched": 0.09}}}}
    figures |= {"nodes": {}, "host": {"pressure": 0.1}, "links": "simulated"}
    return figures | changed


def the_runs(count: int = 3) -> list[dict[str, Any]]:
    base = {"fixed_e1": 0.5, "fixed_e2": 0.6, "fixed_e3": 0.4, "dyna_both": 0.7, "zsched": 0.65}
    return [a_run(name, run, value + 0.01 * run) for name, value in base.items() for run in range(count)]


def test_what_was_declared_of_led_robots_is_printed_and_has_a_verdict_when_all_runs_are_done() -> None:
    runs = the_runs(5)
    told = dict(declared(runs))
    assert list(told) == ["the mean of the fixed schemes", "the best fixed one, fixed_e2", "dyna_both"]
    assert told["dyna_both"].runs == 5
    assert told["dyna_both"].high < 0.0 < told["the best fixed one, fixed_e2"].low
    assert declared([{**one, "stopped_ratio": None} for one in runs]) == [], "nobody leads them"
    moved = [a_run("zsched_slam", run, 0.5 + 0.02 * run) for run in range(5)]
    assert "zsched_slam" not in dict(declared(runs + moved)), "whose question it is stands first"
    ((against, worse),) = [one for one in declared(runs + moved, scheme="zsched_slam") if one[0] == "zsched"]
    assert worse.mine == pytest.approx(0.27)
    assert worse.theirs == pytest.approx(0.335)
    both_told = "\n".join(declared_parts({"nano": runs + moved}, {"blocks": {"nano": {"runs": 5}}}))
    assert f"| nano | {against} | 5 of 5 | 0.270 | 0.335 | {worse.text()} | **worse** |" in both_told
    assert both_told.index("| where | zsched against |") < both_told.index("| where | zsched_slam against |")

    results = results_of(runs)
    results["scenario"]["blocks"]["nano"]["runs"] = 5
    text = report(results, [])
    mean, both = (told[name] for name in ("the mean of the fixed schemes", "dyna_both"))
    row = f"| 5 of 5 | {mean.mine:.3f} | {mean.theirs:.3f} | {mean.text()} | **better** |"
    assert f"| nano | the mean of the fixed schemes {row}" in text
    assert f"{both.text()} | **worse** |" in text
    level = [{**one, "coverage_mean": 0.5 + 0.1 * (one["run"] % 2)} for one in runs]
    assert "| not told apart |" in "\n".join(declared_parts({"nano": level}, results["scenario"]))
    early = "\n".join(declared_parts({"nano": the_runs(3)}, results["scenario"]))
    assert "| 3 of 5 |" in early
    assert early.count("no verdict: too few runs") == 3
    assert declared_parts({"nano": []}, results["scenario"]) == []


def results_of(runs: list[dict[str, Any]], main: str = "nano") -> dict[str, Any]:
    scenario = {
        "name": "nano",
        "seed": 1,
        "level": "one",
        "levels": {"one": {"streams": 4, "share": 0.15, "side": 320}},
    }
    scenario |= {"main": main, "blocks": {"nano": {"schemes": [], "level": None}}, "merge": {}, "nodes": {}}
    scenario |= {"target_coverage": 0.6, "pressure_limit": 0.15, "warm_up_s": 60.0}
    return {
        "scenario": scenario,
        "runs": runs,
        "invalid": [],
        "command": "x",
        "input": "x",
        "version": "0",
        "machine": "x",
    }
