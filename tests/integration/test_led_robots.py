"""Robots that are led from elsewhere, as real processes on real zenoh: SLAM gives the pose, navigation the way.

And SLAM as a task of a real fleet: it moves with its map.
"""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from support.programs import running
from support.verbs import move
from zsched.tasks.map_merge.cdr import decode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.laser import Laser
from zsched_lab.explore.localizer import LOST_S
from zsched_lab.explore.messages import decode_correction, encode_scan
from zsched_lab.explore.worlds import load_world
from zsched_lab.fleet.loopback import free_endpoints
from zsched_lab.fleet.recorder import Record, read_records
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

WORLD = "office:3"
DEADLINE_S = 45.0
SLIP_M = 0.02
"""What the wheels of a robot that stands tell too much at every scan."""
SLAM_WORKER = ("python", "-m", "zsched_lab.explore.slam_worker", "--robot", "robot1")


def until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A peer that all of the robot's programs are clients of."""
    (one,) = free_endpoints(1)
    config = {
        "mode": "peer",
        "listen": {"endpoints": [one]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):
        yield one


def test_a_robot_drives_by_its_slam_and_stands_while_that_is_silent(endpoint: str, tmp_path: Path) -> None:
    """It is not placed in any merged map here, so navigation plans on its own one."""
    robot = ["zsched_lab.explore.robot", "--robot", "robot1", "--world", WORLD, "--endpoint", endpoint]
    robot += ["--records", str(tmp_path), "--slam-on", "edge1", "--led", "--drift-yaw", "0.02", "--drift-way", "0.02"]
    slam = ["zsched_lab.explore.slam", "--robot", "robot1", "--endpoint", endpoint, "--match", "0.02"]
    navigate = ["zsched_lab.explore.navigate", "--robot", "robot1", "--endpoint", endpoint, "--cores", "0.01"]

    def newest() -> Record:
        found = [record for record in read_records(tmp_path / "robot1.ndjson") if record["kind"] == "progress"]
        return found[-1] if found else {"way_m": 0.0, "stopped_s": 0.0, "corrections": 0}

    with running(robot, slam, navigate) as (_, matcher, _):
        until(lambda: newest()["way_m"] > 2.0, "SLAM and navigation do not lead the robot")
        matcher.send_signal(signal.SIGSTOP)
        time.sleep(LOST_S + 2.0)
        standing = newest()
        until(lambda: newest()["stopped_s"] > standing["stopped_s"] + 1.0, "the robot does not stand")
        still = newest()
        matcher.send_signal(signal.SIGCONT)
        until(lambda: newest()["way_m"] > still["way_m"] + 0.5, "the robot does not drive on")

    assert still["way_m"] == standing["way_m"]
    assert still["corrections"] == standing["corrections"] > 10
    path = [record for record in read_records(tmp_path / "robot1.ndjson") if record["kind"] == "path"]
    start = load_world(WORLD).starts(3)[0]
    for record in path:
        believed = start.compose(Pose2(x=record["belief_x"], y=record["belief_y"]))
        assert math.dist((believed.x, believed.y), (record["x"], record["y"])) < 0.4


class StandingRobot(threading.Thread):
    """A robot that stands and looks, ten times a second, while its wheels slip: odometry creeps, the truth does not."""

    def __init__(self, session: zenoh.Session) -> None:
        super().__init__(daemon=True)
        world = load_world(WORLD)
        self._start, self._laser = world.starts(1)[0], Laser(world, np.random.default_rng(1))
        self._scan = session.declare_publisher("robot1/in")
        self.slipped_m = 0.0
        self.is_over = threading.Event()

    def run(self) -> None:
        while not self.is_over.wait(0.1):
            scan = self._laser.scan(self._start, time.time_ns())
            self._scan.put(encode_scan(scan, Pose2(x=self.slipped_m)))
            self.slipped_m += SLIP_M


def test_a_slam_that_moves_takes_its_map_along(tmp_path: Path) -> None:
    """A new owner without it would believe the wheels: more than half a metre off by then."""
    rules = {
        "inputs": [{"from": "{robot}/in", "to": "{target}/echo/{robot}/scan", "class": "latest"}],
        "outputs": [
            {"from": "{target}/echo/{epoch}/{robot}/pose", "to": "{robot}/pose", "class": "latest"},
            {"from": "{target}/echo/{epoch}/{robot}/map", "to": "{robot}/map", "class": "latest"},
        ],
    }
    with Testbed(tmp_path, echo_fleet(robots=1, edges=2, worker=SLAM_WORKER, task=rules)) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        session = bed.app("robot1")
        poses: list[tuple[int, Pose2]] = []
        maps: list[bytes] = []

        def on_pose(sample: zenoh.Sample) -> None:
            correction = decode_correction(sample.payload.to_bytes())
            poses.append((correction.stamp_ns, correction.pose))

        kept = [
            session.declare_subscriber("robot1/pose", on_pose),
            session.declare_subscriber("robot1/map", lambda sample: maps.append(sample.payload.to_bytes())),
        ]
        robot = StandingRobot(session)
        robot.start()
        until(lambda: robot.slipped_m > 0.6 and bool(maps) and len(poses) > 10, "no poses or no map")
        stopped_ns = time.time_ns()

        other = next(name for name in ("edge1", "edge2") if name != owner)
        move(bed, other)
        until(lambda: bool(poses) and poses[-1][0] > stopped_ns + 2_000_000_000, "no poses from the next owner")
        robot.is_over.set()
        robot.join()
        seen = len(maps)

        assert bed.wait_settled() == other
        far = [(stamp, pose) for stamp, pose in poses if math.hypot(pose.x, pose.y) >= 0.15]
        assert not far, (
            f"{len(far)} of {len(poses)}, {sum(one[0] > stopped_ns for one in far)} of them after the move: {far[:3]}"
        )
        assert decode_grid(maps[-1]).known_area_m2 >= 0.95 * decode_grid(maps[0]).known_area_m2
        assert seen > 1
        del kept
