from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from zsched.tasks.map_merge.cdr import encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Grid
from zsched_lab.demo.evaluate import RunFacts, evaluate, print_summary
from zsched_lab.fleet.recorder import Follower
from zsched_lab.fleet.view import Load, Move
from zsched_lab.robots.watch import RobotWatch

START_S = 1000.0
FRAMES = {"robot1": Pose2(x=2.0, y=-1.0, yaw=0.0), "robot2": Pose2(x=-1.0, y=0.5, yaw=0.0)}


def a_room(width: int = 80, height: int = 60) -> Grid:
    """A room of 4 m x 3 m with a pillar, in a wide unknown."""
    data = np.full((height + 40, width + 40), UNKNOWN, dtype=np.int8)
    data[20:-20, 20:-20] = FREE
    data[20:-20, [20, -21]] = OCCUPIED
    data[[20, -21], 20:-20] = OCCUPIED
    data[40:46, 50:56] = OCCUPIED
    return Grid(data=data, resolution=0.05, origin=Pose2(x=-3.0, y=-2.5))


def the_facts(out: Path, mode: str = "known", **changes: object) -> RunFacts:
    records = out / "records"
    records.mkdir(parents=True, exist_ok=True)
    watch = RobotWatch(robot="robot1", follower=Follower(records / "robot1.ndjson"))
    watch.map_times = [START_S + 2.0 + second for second in range(18)]
    watch.progress = {"scans": 33, "scans_total": 33, "maps_sent": 20, "bytes_sent": 1000, "bytes_received": 2000}
    attached = {"state": "attached", "reason": "", "with": None, "score": 0.9, "overlap": 0.5, "margin": None}
    off = {"x": 0.0, "y": 0.0, "yaw": 0.0}
    robots = {"robot1": attached | {"pose": off}, "robot2": attached | {"pose": {"x": -3.0, "y": 1.6, "yaw": 0.0}}}
    watch.status = {"merges": 18, "reference": "robot1", "robots": robots}
    silent = RobotWatch(robot="robot2", follower=Follower(records / "robot2.ndjson"))
    facts: dict[str, object] = {
        "out": out,
        "log_name": "malaga",
        "mode": mode,
        "seed": 3,
        "policy": "push",
        "limits": "none",
        "start_s": START_S,
        "duration_s": 20.0,
        "task": "map_merge",
        "kinds": {"robot1": "robot", "robot2": "robot", "edge1": "edge", "edge2": "edge"},
        "candidates": ("edge1", "edge2"),
        "frames": FRAMES,
        "moves": (
            Move(task="map_merge", epoch=1, node="edge1", t_s=1.0, reason="the first"),
            Move(task="map_merge", epoch=2, node="edge2", t_s=9.0, reason="edge1 is busy"),
        ),
        "loads": (Load(node="edge1", start_s=6.0, end_s=12.0),),
        "cpu": {"edge1": [(1.0, 0.2), (7.0, 1.0)]},
        "memory": {"edge1": [(1.0, 0.25)]},
        "robots": (watch, silent),
        "truth": records / "truth.cdr",
    }
    (records / "truth.cdr").write_bytes(encode_grid(a_room()))
    return RunFacts(**(facts | changes))  # type: ignore[arg-type]  # a test's shorthand


def give_map(out: Path, grid: Grid) -> None:
    (out / "records" / "robot1-global_map.cdr").write_bytes(encode_grid(grid))


def test_a_perfect_run_is_summarised_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = the_facts(tmp_path)
    give_map(tmp_path, a_room())

    summary = evaluate(facts)
    print_summary(summary, tmp_path)

    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert summary["schema"] == "zsched.demo/1"
    wanted = {
        "duration_s": 20.0,
        "moves": 1,
        "merges": 18,
        "seed": 3,
        "mode": "known",
        "log": "malaga",
        "gap_max_s": 1.0,
    }
    assert {key: summary[key] for key in wanted} == wanted
    assert summary["merge_hz"] == pytest.approx(17 / 18, abs=1e-3)
    assert (summary["coverage"], summary["wall_f1"], summary["ssim_rebased"]) == (1.0, 1.0, 1.0)
    assert summary["allocations"][1] == {
        "task": "map_merge", "epoch": 2, "node": "edge2", "t_s": 9.0, "reason": "edge1 is busy", "gap_s": 1.0,
    }  # fmt: skip
    assert summary["nodes"]["edge1"]["cpu_peak"] == 1.0
    assert summary["nodes"]["edge1"]["owned_s"] == 8.0
    assert summary["nodes"]["edge2"]["owned_s"] == 11.0
    assert summary["nodes"]["edge2"]["cpu_mean"] is None
    assert summary["robots"]["robot1"]["attach"]["state"] == "attached"
    assert summary["robots"]["robot2"]["merge_hz"] is None
    assert summary["robots"]["robot2"]["pose_error_m"] == pytest.approx(0.1)
    for name in ("map.png", "timeline.png"):
        assert np.asarray(cv2.imread(str(tmp_path / name))).std() > 10
    assert "edge1 is busy" in capsys.readouterr().out


def test_no_map_at_all_scores_as_a_blank_and_is_still_drawn(tmp_path: Path) -> None:
    facts = the_facts(tmp_path, robots=(), moves=(), loads=(), cpu={})

    summary = evaluate(facts)

    assert (summary["moves"], summary["merges"], summary["coverage"], summary["wall_f1"]) == (0, 0, 0.0, 0.0)
    assert (summary["merge_hz"], summary["gap_max_s"], summary["ssim_rebased"]) == (None, None, 0.0)
    assert (tmp_path / "map.png").exists()
    assert (tmp_path / "timeline.png").exists()


def test_in_mode_estimate_the_map_lies_in_the_reference_robots_frame(tmp_path: Path) -> None:
    facts = the_facts(tmp_path, mode="estimate")
    seen = a_room()
    frame = FRAMES["robot1"].inverse().compose(seen.origin)
    give_map(tmp_path, Grid(data=seen.data, resolution=seen.resolution, origin=frame))

    assert evaluate(facts)["wall_f1"] == 1.0
