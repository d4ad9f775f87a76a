from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zsched.core.values.fleet import Timing
from zsched.host.radio.network_profiler import Trace
from zsched.tasks.map_merge.cdr import encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Grid
from zsched_lab.fleet.recorder import Recorder
from zsched_lab.paper.arrivals import Arrival
from zsched_lab.paper.drive_clock import begun_before, smoothed
from zsched_lab.paper.metrics import (
    WALL_M,
    WORLD,
    Truth,
    brief,
    measure,
    messages,
    owners_within,
    served_s,
)
from zsched_lab.paper.places import scenario_path
from zsched_lab.paper.radio_bench import radio_figures
from zsched_lab.paper.record import Heard, StreamFile
from zsched_lab.paper.scenario import LoadLevel, NodeShare, Scenario, load_scenario

ZERO_NS = 1_700_000_000_000_000_000
SIDE = 0.05


def a_room() -> Grid:
    data = np.full((40, 60), FREE, dtype=np.int8)
    data[[0, -1], :] = OCCUPIED
    data[:, [0, -1]] = OCCUPIED
    return Grid(data=data, resolution=SIDE, origin=Pose2(x=1.0, y=-2.0))


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_coverage_does_not_depend_on_the_merged_map_s_resolution(factor: int) -> None:
    room = a_room()
    data = room.data.copy()
    data[:, 15:] = UNKNOWN
    fine = np.kron(data, np.ones((factor, factor), dtype=np.int8))
    merged = Grid(data=fine, resolution=SIDE / factor, origin=room.origin)
    assert Truth(room).coverage(encode_grid(merged)) == pytest.approx(0.25)


def test_walls_are_found_where_they_are_and_not_by_a_map_that_lies_elsewhere() -> None:
    """Turned by half a turn a room with a wall inside knows as much of the truth, and has its walls elsewhere."""
    room = a_room()
    data = room.data.copy()
    data[4:9, 4] = OCCUPIED
    with_wall = Grid(data=data, resolution=room.resolution, origin=room.origin)
    truth, cells = Truth(with_wall), int(with_wall.occupied.sum())
    assert truth.walls(encode_grid(with_wall)) == 1.0
    assert truth.walls(b"no map") == 0.0
    inner = Grid(data=np.where(room.data == OCCUPIED, room.data, data), resolution=room.resolution, origin=room.origin)
    turned = Grid(data=inner.data[::-1, ::-1].copy(), resolution=room.resolution, origin=room.origin)
    assert truth.coverage(encode_grid(turned)) == truth.coverage(encode_grid(with_wall))
    assert truth.walls(encode_grid(turned)) == pytest.approx((cells - 5) / cells)
    reach = round(WALL_M / room.resolution)
    for cells_off, is_found in ((reach, True), (reach + 1, False)):
        off = Pose2(x=room.origin.x + cells_off * room.resolution, y=room.origin.y)
        line = np.full(room.data.shape, UNKNOWN, dtype=room.data.dtype)
        line[4:9, 4] = OCCUPIED
        own = Truth(Grid(data=line, resolution=room.resolution, origin=room.origin))
        assert (own.walls(encode_grid(Grid(data=line, resolution=room.resolution, origin=off))) == 1.0) is is_found


def test_a_turned_map_is_held_against_the_truth_in_its_own_frame() -> None:
    room, frame = a_room(), Pose2(x=1.5, y=-0.5, yaw=math.pi)
    rows, columns = room.data.shape
    corner = frame.inverse().apply_point(room.origin.x + columns * SIDE, room.origin.y + rows * SIDE)
    turned = Grid(data=room.data[::-1, ::-1].copy(), resolution=SIDE, origin=Pose2(x=corner[0], y=corner[1]))
    truth, payload = Truth(room), encode_grid(turned)
    assert (truth.coverage(payload, frame), truth.walls(payload, frame)) == (1.0, 1.0)
    assert truth.coverage(payload) < 0.9
    assert truth.walls(payload) < 0.9


def test_maps_of_another_reference_are_moved_to_the_truth(tmp_path: Path, scenario: Scenario) -> None:
    """Where a robot whose start the merger was not told came first, its maps lie in that robot's frame."""
    frame, keys = Pose2(x=1.5, y=-0.5), ("coverage", "wall_f1", "ssim_rebased", "coverage_mean", "walls_mean")
    untold = {"robot2": {"x": frame.x, "y": frame.y, "yaw": 0.0}}

    def figures(name: str, **changed: Any) -> list[float]:
        (tmp_path / name).mkdir()
        found = measure(write_run(tmp_path / name, **changed), scenario, Truth(a_room()))
        return [found[key] for key in keys]

    wanted = pytest.approx(figures("first"))
    assert figures("second", reference="robot2", frame=frame, untold_frames=untold) == wanted
    assert figures("told", reference="robot1", untold_frames=untold) == wanted
    assert figures("unread", reference="robot2", frame=frame) != wanted


def test_a_robot_is_served_while_its_newest_map_is_fresh() -> None:
    def served(*maps: tuple[float, float]) -> float:
        return served_s([Arrival(t_s, latency_s, 1, 0.0) for t_s, latency_s in maps], 10.0)

    assert served() == 0.0, "without a map nobody is"
    assert served((1.0, 0.1)) == pytest.approx(0.4)
    assert served((1.0, 0.1), (1.1, 0.1)) == pytest.approx(0.5), "what two maps serve counts once"
    assert served((1.0, 0.1), (1.1, 0.4)) == pytest.approx(0.4), "an older one that comes behind adds nothing"
    assert served((1.0, 0.6), (2.0, 0.5)) == 0.0, "what comes too late serves nobody"
    assert served((-0.2, 0.1)) == pytest.approx(0.2), "what came before the drive serves in it"
    assert served((9.9, 0.1)) == pytest.approx(0.1)
    assert served((10.2, 0.1)) == 0.0


def part_of_room(share: float, stamp_ns: int = 0, margin: int = 0, frame: Pose2 = WORLD) -> bytes:
    """The room's left part, in a canvas with a margin around it: as a merged map that grows.

    It lies in ``frame``, a pose in the room that is not turned.
    """
    room = a_room()
    data = room.data.copy()
    data[:, int(share * data.shape[1]) :] = UNKNOWN
    data = np.pad(data, margin, constant_values=UNKNOWN)
    origin = Pose2(x=room.origin.x - margin * SIDE - frame.x, y=room.origin.y - margin * SIDE - frame.y)
    return encode_grid(Grid(data=data, resolution=SIDE, origin=origin, stamp_ns=stamp_ns))


@pytest.fixture
def scenario() -> Scenario:
    shares = {"edge1": NodeShare(cpu_cores=0.3, memory_mb=512), "edge2": NodeShare(cpu_cores=0.3, memory_mb=512)}
    return replace(load_scenario(scenario_path()), nodes=shares, target_coverage=0.8)


def write_run(folder: Path, reference: str | None = None, frame: Pose2 = WORLD, **changed: Any) -> Path:
    """A run of 10 s with two robots: a merged map each second that knows a tenth more; edge1 to edge2 at 4.5 s.

    ``frame``: in which merged maps lie, that of ``reference``, which is told from the third second on.
    """
    moves = [(-0.5, "edge1"), (4.5, "edge2")]
    run = {
        "scheme": "zsched", "family": "zsched", "block": "matrix", "level": "one", "run": 0, "seed": 1,
        "mode": "known", "input": "x",
        "links": "simulated", "host": {"pressure": 0.1, "idle_ratio": 0.3}, "duration_s": 10.0, "zero_wall_ns": ZERO_NS,
        "zero_s": 50.0,
        "robots": ["robot1", "robot2"], "shares": {"edge1": {}, "edge2": {}},
        "loads": [{"node": "edge1", "start_s": 4.0, "end_s": 10.0}],
        "allocations": [{"t_s": t_s, "node": node} for t_s, node in moves],
        "streams": {"robot1": [{"lost": 1, "at_most_lost": 2, "drops": {"full": 3}}], "robot2": None},
        **changed,
    }  # fmt: skip
    with Recorder(folder / "records") as recorder:
        for step in range(20):
            node = {"cpu_ratio": None if step == 0 else 0.5 + 0.5 * (step == 7), "memory_ratio": 0.2}
            recorder.write("nodes", {"t_s": step / 2, "edge1": node, "edge2": {"cpu_ratio": 0.25, "memory_ratio": 0.4}})
    with (folder / "streams.mcap").open("wb") as stream:
        file = StreamFile(stream)
        for second in range(1, 10):
            at_ns = ZERO_NS + second * 10**9
            for index, robot in enumerate(("robot1", "robot2")):
                file.write(Heard(f"{robot}/map", b"x" * 100, at_ns - 5 * 10**8))
                payload = part_of_room(second / 10, stamp_ns=at_ns - 2 * 10**8, margin=second, frame=frame)
                file.write(Heard(f"{robot}/global_map", payload, at_ns + index * 10**8))
                told = json.dumps({"reference": reference if second > 2 else None}).encode()
                file.write(Heard(f"{robot}/map_merge/status", told, at_ns))
        file.close()
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def test_a_runs_figures_by_their_definitions(tmp_path: Path, scenario: Scenario) -> None:
    figures = measure(write_run(tmp_path), scenario, Truth(a_room()))

    assert figures["is_done"]
    assert figures["task_latency_s"] == pytest.approx(8.1)  # robot2 gets the eighth map a tenth later
    assert figures["map_hz"] == pytest.approx(0.9)
    assert figures["merge_latency_p50_s"] == pytest.approx(0.2)
    assert figures["merge_latency_p99_s"] == pytest.approx(0.3)
    assert figures["served_ratio"] == pytest.approx(9 * (0.3 + 0.2) / 2 / 10)
    assert figures["coverage"] == pytest.approx(0.9)
    assert figures["moves"] == 1
    assert figures["wasted_moves"] == 0
    assert figures["move_gap_max_s"] == pytest.approx(1.0)
    assert (figures["lost"], figures["lost_per_move"], figures["dropped"]) == (3, 3.0, 3)
    assert figures["drops"] == {"full": 3}
    assert figures["held_ssim_rebased"] < figures["ssim_rebased"] <= 1.0
    assert brief(figures).startswith("0.90 maps/s")


def test_what_was_dropped_keeps_its_reasons(tmp_path: Path, scenario: Scenario) -> None:
    """Else nobody can tell an old owner's answers behind a move from a queue that was full."""
    both: dict[str, Any] = {"robot1": [{"drops": {"cut": 2}}, {"drops": {"overflow": 1, "cut": 1}}], "robot2": [{}]}
    figures = measure(write_run(tmp_path, streams=both), scenario, Truth(a_room()))
    assert figures["drops"] == {"cut": 3, "overflow": 1}
    assert (figures["dropped"], figures["lost"]) == (4, 0)


def test_a_nodes_figures_are_its_own(tmp_path: Path, scenario: Scenario) -> None:
    figures = measure(write_run(tmp_path), scenario, Truth(a_room()))
    edge1, edge2 = figures["nodes"]["edge1"], figures["nodes"]["edge2"]

    assert edge1["cpu_peak"] == pytest.approx(0.75)  # of one second: one half second was full
    assert edge2["cpu_mean"] == pytest.approx(0.25)
    assert (edge1["memory_mean"], edge2["memory_peak"]) == (pytest.approx(0.2), pytest.approx(0.4))
    assert figures["memory_mean_spread"] == pytest.approx(0.2)
    assert (edge1["owned_s"], edge2["owned_s"]) == (4.5, 5.5)
    total = edge1["throughput_mb_s"] + edge2["throughput_mb_s"]
    assert total == pytest.approx(figures["throughput_mb_s"])
    assert edge2["throughput_mb_s"] > edge1["throughput_mb_s"] > 0


def test_a_run_that_does_not_get_there_counts_with_its_whole_duration(tmp_path: Path, scenario: Scenario) -> None:
    figures = measure(write_run(tmp_path), replace(scenario, target_coverage=0.95), Truth(a_room()))

    assert not figures["is_done"]
    assert figures["task_latency_s"] == 10.0


def test_regret_is_what_the_owner_lacked(tmp_path: Path, scenario: Scenario) -> None:
    late = measure(write_run(tmp_path / "late"), scenario, Truth(a_room()))["regret"]
    stuck = [{"t_s": 0.0, "node": "edge1"}]
    stays = measure(write_run(tmp_path / "stays", allocations=stuck), scenario, Truth(a_room()))["regret"]
    away = [{"t_s": 0.0, "node": "edge2"}]
    best = measure(write_run(tmp_path / "best", allocations=away), scenario, Truth(a_room()))["regret"]

    assert best == pytest.approx(0.0)
    assert 0.0 < late < stays < 1.0


def test_regret_by_hand(tmp_path: Path, scenario: Scenario) -> None:
    level = LoadLevel(streams=1, share=0.6, memory_mb=189.0)
    scenario = replace(scenario, levels={"one": level}, blocks={})
    found = measure(write_run(tmp_path), scenario, Truth(a_room()))["regret"]

    free = 0.5 * (0.3 - 0.15) / 0.3 + 0.5 * (512 - 110) / 512
    loaded = 0.0 + 0.5 * (512 - 110 - 189) / 512  # 0.6 of 0.3 cores and the task's 0.15 are more than there is
    # Of 10 s, edge1 is loaded from 4 s on and left at 4.5 s: half a second on the worse node.
    assert found == pytest.approx(0.5 * (free - loaded) / (10.0 * free))


def test_throughput_by_hand(tmp_path: Path, scenario: Scenario) -> None:
    figures = measure(write_run(tmp_path), scenario, Truth(a_room()))

    sizes = [len(part_of_room(second / 10, margin=second)) for second in range(1, 10)]
    assert figures["received_mb_s"] == pytest.approx(2 * sum(sizes) / 10.0 / 1e6)
    assert figures["throughput_mb_s"] == pytest.approx((2 * sum(sizes) + 2 * 9 * 100) / 10.0 / 1e6)
    assert figures["mb_per_map"] == pytest.approx(sum(sizes) / 9 / 1e6)
    # Until 4.5 s edge1 owned: four merged maps each, and the robots' own of 0.5 to 3.5 s.
    assert figures["nodes"]["edge1"]["throughput_mb_s"] == pytest.approx((2 * sum(sizes[:4]) + 2 * 4 * 100) / 10 / 1e6)


def test_a_recorder_beside_each_robot_says_the_same_as_one_for_all(tmp_path: Path, scenario: Scenario) -> None:
    together = measure(write_run(tmp_path), scenario, Truth(a_room()))
    whole = tmp_path / "streams.mcap"
    heard = list(messages([whole]))
    for robot in ("robot1", "robot2"):
        with (tmp_path / f"streams-{robot}.mcap").open("wb") as stream:
            file = StreamFile(stream)
            for topic, at_ns, _, data in heard:
                if topic.startswith(robot):
                    file.write(Heard(topic, data, at_ns))
            file.close()
    whole.unlink()

    assert measure(tmp_path, scenario, Truth(a_room())) == together


def test_coverage_is_cell_on_cell_wherever_the_canvas_begins() -> None:
    truth = Truth(a_room())

    assert truth.coverage(part_of_room(1.0)) == pytest.approx(1.0)
    assert truth.coverage(part_of_room(0.5, margin=7)) == pytest.approx(0.5)
    far = Grid(data=a_room().data, resolution=SIDE, origin=Pose2(x=100.0, y=0.0))
    assert truth.coverage(encode_grid(far)) == 0.0
    cut = Grid(data=a_room().data[10:, 10:], resolution=SIDE, origin=Pose2(x=1.5, y=-1.5))
    assert truth.coverage(encode_grid(cut)) == pytest.approx(30 * 50 / 2400)
    assert truth.coverage(b"no map") == 0.0


def test_what_was_decided_before_the_drive_and_after_it_does_not_count(tmp_path: Path, scenario: Scenario) -> None:
    """Rules without restraint move every second while the workers start; zsched does not."""
    at = [(-3.0, "edge2"), (-2.0, "edge1"), (-1.0, "edge2"), (-0.5, "edge1"), (4.5, "edge2"), (10.5, "edge1")]
    moves = [{"t_s": t_s, "node": node} for t_s, node in at]
    assert owners_within(moves, 10.0) == [(0.0, "edge1"), (4.5, "edge2")]
    assert owners_within(moves[4:], 10.0) == [(4.5, "edge2")]

    truth = Truth(a_room())
    figures = measure(write_run(tmp_path, allocations=moves), scenario, truth)
    assert (figures["moves"], figures["wasted_moves"]) == (1, 0)
    assert figures["lost_per_move"] == pytest.approx(3 / 5)  # the relays counted through all five
    assert figures["owners"] == [[0.0, "edge1"], [4.5, "edge2"]]


def test_a_robot_without_a_map_counts_as_one_with_a_blank_map(tmp_path: Path, scenario: Scenario) -> None:
    two = measure(write_run(tmp_path / "two"), scenario, Truth(a_room()))
    three = measure(write_run(tmp_path / "three", robots=["robot1", "robot2", "robot3"]), scenario, Truth(a_room()))

    for name in ("ssim_rebased", "held_ssim_rebased", "coverage"):
        assert three[name] == pytest.approx(two[name] * 2 / 3)


def test_a_move_after_which_no_map_came_has_a_gap_to_the_end(tmp_path: Path, scenario: Scenario) -> None:
    moves = [{"t_s": -0.5, "node": "edge1"}, {"t_s": 9.2, "node": "edge2"}]

    figures = measure(write_run(tmp_path, allocations=moves), scenario, Truth(a_room()))

    assert figures["move_gap_max_s"] == pytest.approx(1.0)  # the last maps came at 9.0 and 9.1 s, the run ended at 10


def test_an_exploring_robots_own_word_ends_the_task(tmp_path: Path, scenario: Scenario) -> None:
    """A run ends by that word; by the figures here it may lack a cell or two."""
    folder = write_run(tmp_path, zero_s=100.0)
    with Recorder(folder / "records") as recorder:
        recorder.write("robot1", {"kind": "start", "t_s": 100.0})
        recorder.write("robot1", {"kind": "covered", "t_s": 106.5, "coverage": 0.8001, "target": 0.8})
        recorder.write("robot2", {"kind": "covered", "t_s": 106.75, "coverage": 0.8001, "target": 0.8})

    figures = measure(folder, replace(scenario, target_coverage=0.99), Truth(a_room()))

    assert figures["is_done"]
    assert figures["task_latency_s"] == pytest.approx(6.75)


def test_the_radios_figures(tmp_path: Path) -> None:
    moves = [{"t_s": -1.0, "node": "robot1"}, {"t_s": 5.0, "node": "robot2"}]
    folder = write_run(tmp_path, allocations=moves)
    begun_s = 3.0  # the daemons began the drive so long before the run
    write_drives(folder, {"robot1": [(0, -50)], "robot2": [(0, -60), (begun_s + 5.0, -40)]})
    with Recorder(folder / "records") as recorder:
        for step in range(20):
            # What a daemon says is smoothed: it comes late, and later with the product's smoothing.
            risen = 0.0 if step < 10 else 1.0 - math.exp(-(step / 2 - 5.0 + 0.1) / Timing().smoothing_s)
            for robot, dbm in (("robot1", -50.0), ("robot2", -60.0 + 20.0 * risen)):
                recorder.write("decisions", {"node": robot, "t_s": step / 2, "links": [dbm]})

    figures = radio_figures(folder)

    assert figures["moves"] == 1
    assert figures["mean_dbm"] == pytest.approx(-45.0)
    assert figures["best_dbm"] == pytest.approx(-45.0)
    assert figures["under_best_db"] == pytest.approx(0.0)
    assert figures["best_fixed_dbm"] == pytest.approx(-50.0)
    assert figures["below_70_ratio"] == 0.0


def write_drives(folder: Path, drives: dict[str, list[tuple[float, int]]]) -> None:
    """A fleet file whose robots follow drives of 100 s: [(from when, dBm)]."""
    nodes = ""
    for index, (robot, steps) in enumerate(sorted(drives.items())):
        rows = ["time_stamp,c_rssi"]
        for tenth in range(1000):
            dbm = [value for start_s, value in steps if start_s <= tenth / 10 + 0.01][-1]
            rows.append(f"{(tenth + 1) * 10**8},{dbm}")
        path = folder / f"{robot}.csv"
        path.write_text("\n".join(rows) + "\n")
        listen = f"{{control: tcp/127.0.0.1:{7000 + index}, data: tcp/127.0.0.1:{7100 + index}}}"
        nodes += f"  {robot}: {{kind: robot, listen: {listen}, trace: {{file: {path}, column: c_rssi}}}}\n"
    task = "tasks:\n  t:\n    candidates: {kind: robot}\n    weights: {network: 1}\n"
    (folder / "fleet.yaml").write_text(f"fleet: x\ntiming: wifi\nseeds: [robot1]\nnodes:\n{nodes}{task}")


@pytest.mark.parametrize("smoothing_s", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("begun_s", [0.0, 4.2, 17.0])
def test_where_in_its_drive_a_robot_was_is_found_again(smoothing_s: float, begun_s: float) -> None:
    generator = np.random.default_rng(1)
    dbm = -60.0 + np.cumsum(generator.normal(0.0, 1.0, 600))
    trace = Trace(times_s=tuple(np.arange(600) * 0.2), rssi_dbm=tuple(dbm), duration_s=120.0)
    said = smoothed(trace, 20.0, smoothing_s, 900)
    series = [(step * 0.5, float(said[round(begun_s / 0.1) + 5 * step])) for step in range(80)]

    assert begun_before(series, trace, 20.0, smoothing_s) == pytest.approx(begun_s)


def test_a_run_without_signals_is_no_radio_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="signal"):
        radio_figures(write_run(tmp_path))
