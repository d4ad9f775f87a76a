"""Exploring robots as real processes on real zenoh: each at a peer of its own, as at its robot's relay.

The merger is the task's own, in this process: it answers with a merged map and transforms.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from support.programs import running
from zsched.tasks.map_merge.cdr import StampedTransform, decode_grid, encode_grid, encode_transforms
from zsched.tasks.map_merge.merger import Merger, MergerSettings, Mode
from zsched_lab.explore.worlds import load_world
from zsched_lab.fleet.loopback import free_endpoints
from zsched_lab.fleet.recorder import Record, read_records
from zsched_lab.maps.metrics import score_map

pytestmark = pytest.mark.long

ROBOTS = ("robot1", "robot2")
WORLD = "turtlebot3"
TARGET = 0.8
DEADLINE_S = 45.0


def peer(endpoint: str, others: tuple[str, ...]) -> zenoh.Session:
    config = {
        "mode": "peer",
        "listen": {"endpoints": [endpoint]},
        "connect": {"endpoints": list(others)},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


class Hub:
    """One peer per robot, meshed; merges what the robots publish and sends it back."""

    def __init__(self, endpoints: list[str]) -> None:
        self._sessions = {
            robot: peer(endpoint, tuple(endpoints[:index]))
            for index, (robot, endpoint) in enumerate(zip(ROBOTS, endpoints, strict=True))
        }
        starts = load_world(WORLD).starts(len(ROBOTS))
        self._merger = Merger(MergerSettings(mode=Mode.KNOWN, poses=dict(zip(ROBOTS, starts, strict=True))))
        self._maps = {
            robot: session.declare_subscriber(f"{robot}/map", zenoh.handlers.RingChannel(4))
            for robot, session in self._sessions.items()
        }

    def turn(self) -> None:
        for robot, maps in self._maps.items():
            while (sample := maps.try_recv()) is not None:
                assert self._merger.update(robot, decode_grid(bytes(sample.payload))) == ""
        result = self._merger.merge()
        if result.grid is None:
            return
        payload = encode_grid(result.grid)
        transforms = encode_transforms(
            tuple(
                StampedTransform(parent="world", child=f"{robot}/map", pose=pose, stamp_ns=0)
                for robot, pose in result.transforms.items()
            )
        )
        for robot, session in self._sessions.items():
            session.put(f"{robot}/map_merge/tf", transforms, congestion_control=zenoh.CongestionControl.BLOCK)
            session.put(f"{robot}/global_map", payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end, what
            self.turn()
            time.sleep(0.1)

    def close(self) -> None:
        for session in self._sessions.values():
            session.close()


@pytest.fixture
def endpoints() -> list[str]:
    return free_endpoints(len(ROBOTS))


@pytest.fixture
def hub(endpoints: list[str]) -> Iterator[Hub]:
    one = Hub(endpoints)
    yield one
    one.close()


def robot(index: int, endpoint: str, records: Path, *more: str) -> list[str]:
    command = ["zsched_lab.explore.robot", "--robot", ROBOTS[index], "--world", WORLD, "--index", str(index)]
    command += ["--robots", str(len(ROBOTS)), "--endpoint", endpoint, "--records", str(records)]
    return [*command, "--target", str(TARGET), *more]


def records_of(folder: Path, name: str, kind: str) -> list[Record]:
    path = folder / f"{name}.ndjson"
    return [record for record in read_records(path) if record["kind"] == kind] if path.exists() else []


def test_two_robots_explore_on_the_merged_map(hub: Hub, endpoints: list[str], tmp_path: Path) -> None:
    with running(*(robot(index, endpoint, tmp_path) for index, endpoint in enumerate(endpoints))):
        hub.until(
            lambda: all(records_of(tmp_path, name, "covered") for name in ROBOTS),
            "the robots did not cover the world",
        )
    merged = decode_grid((tmp_path / "robot1-global_map.cdr").read_bytes())
    score = score_map(merged, load_world(WORLD).truth())
    assert score.coverage >= TARGET - 0.01
    assert score.wall_f1 > 0.7
    for name in ROBOTS:
        last = records_of(tmp_path, name, "progress")[-1]
        assert last["way_m"] > 0.2
        assert last["claims_heard"] > 0, "claims do not get from one robot's peer to the other's"
        assert len(records_of(tmp_path, name, "covered")) == 1
        assert records_of(tmp_path, name, "map")[-1]["coverage"] >= TARGET
        path = records_of(tmp_path, name, "path")
        assert (path[0]["x"], path[0]["y"]) != (path[-1]["x"], path[-1]["y"])


def test_slam_on_an_edge_maps_for_a_robot_that_only_sends_scans(hub: Hub, endpoints: list[str], tmp_path: Path) -> None:
    slam = ["zsched_lab.explore.slam", "--robot", "robot1", "--endpoint", endpoints[1]]
    with running(robot(0, endpoints[0], tmp_path, "--slam-on", "edge1"), slam):
        hub.until(
            lambda: any(record["coverage"] > 0.4 for record in records_of(tmp_path, "robot1", "progress")),
            "no map grows out of the robot's scans",
        )
    assert not (tmp_path / "robot1-map.cdr").exists()


def test_a_world_that_is_not_there_exits_78(tmp_path: Path) -> None:
    command = [sys.executable, "-m", *robot(0, "tcp/127.0.0.1:1", tmp_path, "--world", "nowhere")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30.0, check=False)
    assert done.returncode == 78
    assert "turtlebot3" in done.stderr
