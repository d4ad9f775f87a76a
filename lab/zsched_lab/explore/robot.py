"""One exploring robot in wall time: a plain zenoh client of its robot's data endpoint, like any robot program.

Knows: its keys, the endpoint, the records. Does not know: zsched. It never notices a move of the merger, but by what a
late map costs it.

    python -m zsched_lab.explore.robot --robot robot1 --world office:1 --index 0 --robots 3 --seed 1
        --endpoint tcp/127.0.0.1:7458 --records DIR [--start x,y,yaw] [--target 0.9] [--speed 0.5] [--slam-on edge1]

With ``--led`` SLAM and navigation on a node lead it (`zsched_lab.explore.slam --match`, `zsched_lab.explore.navigate`).

    out  <robot>/map                nav_msgs/msg/OccupancyGrid, CDR, 2 Hz (not with --slam-on)
         <robot>/scan               with --slam-on: its scans, 5 Hz (`zsched_lab.explore.slam` maps them)
         explore/<robot>/claim      where it goes, 2 Hz (not with --led)
         <robot>/bump               with --led: it has met a wall
    in   <robot>/global_map         the merged map: the only one it plans on
         <robot>/map_merge/tf       where the merger has placed its map frame: without it the robot stands
         <robot>/map_merge/status   recorded
         explore/*/claim            the others' claims
         <robot>/pose, <robot>/way  with --led: corrections of its pose, and where to drive
         <robot>/TASK/pose, /map    with --slam-task TASK: both from a task; it hands them on

With ``--slam-task`` its scans go to ``<robot>/TASK/scan``.

The merger's ``--pose <robot>=x,y,yaw`` is the robot's start: ``load_world(world).starts(robots)[index]``.

Records go to ``<records>/<robot>.ndjson`` as those of `zsched_lab.robots.app` (``map``, ``status``, ``progress``), and
besides ``start`` (once), ``path`` (2 Hz, true pose and belief) and ``covered``: once, when the merged map that this
robot holds first knows ``--target`` of the world. Then the robot goes on until it is stopped (SIGTERM, SIGINT); at the
end it writes ``<robot>-global_map.cdr`` and ``<robot>-map.cdr``. ``t_s`` is the daemon's clock.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import zenoh

from zsched.core.values.errors import ConfigError, WireError
from zsched.core.values.exits import EXIT_CONFIG
from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.__main__ import metres_per_cell
from zsched.tasks.map_merge.cdr import CdrError, decode_grid, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.explore.agent import Agent, Outputs, RobotSettings
from zsched_lab.explore.body import Drift, Limits
from zsched_lab.explore.messages import (
    decode_claim,
    decode_correction,
    decode_way,
    encode_claim,
    encode_scan,
    pose_of_map,
)
from zsched_lab.explore.referee import Referee
from zsched_lab.explore.world import World
from zsched_lab.explore.worlds import load_world
from zsched_lab.fleet import application
from zsched_lab.fleet.recorder import Record, Recorder
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.maps.mapping import RESOLUTION_M

TICK_S = 0.1
PATH_PERIOD_S = 0.5
PROGRESS_PERIOD_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What one robot explores, and where it is connected."""

    settings: RobotSettings
    world: World
    phase: float
    endpoint: str
    records: Path
    target: float
    begin_s: float | None = None
    """When it begins, on the machine's monotonic clock; ``None``: at once."""
    slam_task: str = ""
    """The task that its SLAM is; empty: a program that runs on one node."""


class Applications:
    """The robot on one session: carries messages between the agent and zenoh, and keeps the records."""

    def __init__(self, options: Options, session: zenoh.Session, recorder: Recorder) -> None:
        """Declare everything; the robot does not move yet."""
        robot = options.settings.robot
        self._options = options
        self._recorder = recorder
        self._agent = Agent(options.settings, options.world, phase=options.phase)
        self._referee = Referee(options.world)
        # BLOCK_FIRST: a map is many fragments, which DROP loses on a slow link; one map waits, none piles up behind it.
        latest = zenoh.CongestionControl.BLOCK_FIRST
        self._map = session.declare_publisher(f"{robot}/map", congestion_control=latest)
        slam = f"{robot}/{options.slam_task}" if options.slam_task else robot
        self._scan = session.declare_publisher(f"{slam}/scan", congestion_control=zenoh.CongestionControl.DROP)
        self._is_led = options.settings.is_led
        if self._is_led:
            self._bump = session.declare_publisher(f"{robot}/bump")
            self._poses = session.declare_subscriber(f"{slam}/pose", zenoh.handlers.RingChannel(4))
            self._ways = session.declare_subscriber(f"{robot}/way", zenoh.handlers.RingChannel(1))
        if options.slam_task:
            self._own_maps = session.declare_subscriber(f"{slam}/map", zenoh.handlers.RingChannel(1))
            self._pose = session.declare_publisher(f"{robot}/pose")
        self._claim = session.declare_publisher(f"explore/{robot}/claim")
        self._maps = session.declare_subscriber(f"{robot}/global_map", zenoh.handlers.RingChannel(4))
        self._transforms = session.declare_subscriber(f"{robot}/map_merge/tf", zenoh.handlers.RingChannel(4))
        self._states = session.declare_subscriber(f"{robot}/map_merge/status", zenoh.handlers.RingChannel(4))
        self._claims = session.declare_subscriber("explore/*/claim", zenoh.handlers.RingChannel(64))
        self._sent = self._sent_bytes = self._received = self._received_bytes = self._claims_heard = 0
        self._last_sent = self._last_map = self._last_state = b""
        self._corrections = 0
        self._latest_s = 0.0
        """The oldest that a correction was when the next one came, since the last record of progress."""
        self._last_map_s: float | None = None
        self._merged_t_map: Pose2 | None = None
        self._coverage = 0.0
        self._is_covered = False

    def run(self, stop: StopFlag) -> None:
        """Explore until stopped."""
        application.wait_until(self._options.begin_s, stop)
        start = monotonic_s()
        settings, pose = self._options.settings, self._options.settings.start
        self._write({"kind": "start", "t_s": start, "x": pose.x, "y": pose.y, "yaw": pose.yaw, "seed": settings.seed})
        next_path = next_progress = start
        while not stop.is_set:
            now = monotonic_s()
            self._listen(now)
            self._send(self._agent.step(now, time.time_ns()))
            if now >= next_path:
                self._record_path(now)
                next_path = max(next_path + PATH_PERIOD_S, now)
            if now >= next_progress:
                self._record_progress(now)
                next_progress = max(next_progress + PROGRESS_PERIOD_S, now)
            time.sleep(max(0.0, TICK_S - (monotonic_s() - now)))
        self._record_progress(monotonic_s())

    def save(self) -> None:
        """Write the last merged map and the last own map."""
        for name, payload in (("global_map", self._last_map), ("map", self._last_sent)):
            if payload:
                (self._options.records / f"{self._options.settings.robot}-{name}.cdr").write_bytes(payload)

    def _send(self, outputs: Outputs) -> None:
        if outputs.grid is not None:
            self._send_map(encode_grid(outputs.grid))
        if self._is_led and self._agent.body.is_blocked:
            self._bump.put(b"")
        if outputs.scan is not None and not self._options.settings.has_slam:
            payload = encode_scan(outputs.scan, self._agent.body.belief)
            self._scan.put(payload)
            self._sent, self._sent_bytes = self._sent + 1, self._sent_bytes + len(payload)
        if outputs.is_claim_due:
            self._claim.put(encode_claim(self._options.settings.robot, outputs.claim))

    def _listen(self, now: float) -> None:
        if self._is_led:
            self._be_led()
        if self._options.slam_task:
            while (sample := self._own_maps.try_recv()) is not None:
                self._send_map(bytes(sample.payload))
        while (sample := self._transforms.try_recv()) is not None:
            self._take_transforms(bytes(sample.payload))
        while (sample := self._maps.try_recv()) is not None:
            self._take_map(bytes(sample.payload), now)
        while (sample := self._states.try_recv()) is not None:
            self._take_state(bytes(sample.payload), now)
        while (sample := self._claims.try_recv()) is not None:
            self._take_claim(bytes(sample.payload), now)

    def _be_led(self) -> None:
        """Take what SLAM and navigation say; what is no such message counts for nothing."""
        localizer, now_ns = self._agent.localizer, time.time_ns()
        while (sample := self._poses.try_recv()) is not None:
            payload = bytes(sample.payload)
            if self._options.slam_task:
                self._pose.put(payload)
            with contextlib.suppress(WireError):
                correction = decode_correction(payload)
                self._corrections += localizer.take(correction.stamp_ns, correction.pose)
        self._latest_s = max(self._latest_s, localizer.age_s(now_ns) or 0.0)
        while (sample := self._ways.try_recv()) is not None:
            with contextlib.suppress(WireError):
                self._agent.follower.take_way(decode_way(bytes(sample.payload)))

    def _send_map(self, payload: bytes) -> None:
        self._last_sent = payload
        self._map.put(payload)
        self._sent, self._sent_bytes = self._sent + 1, self._sent_bytes + len(payload)

    def _take_transforms(self, payload: bytes) -> None:
        pose = pose_of_map(payload, self._options.settings.robot)
        if pose is not None:
            self._merged_t_map = pose
            self._agent.explorer.take_transform(pose)

    def _take_map(self, payload: bytes, now: float) -> None:
        try:
            grid = decode_grid(payload)
        except CdrError as error:
            self._write({"kind": "bad_map", "t_s": now, "why": str(error)})
            return
        gap = None if self._last_map_s is None else now - self._last_map_s
        self._received, self._received_bytes = self._received + 1, self._received_bytes + len(payload)
        self._last_map, self._last_map_s = payload, now
        if not self._is_led:
            self._agent.explorer.take_map(grid)
        record: Record = {"kind": "map", "t_s": now, "gap_s": gap, "bytes": len(payload)}
        record["known_m2"] = round(grid.known_area_m2, 1)
        if self._merged_t_map is not None:
            world_t_merged = self._options.settings.start.compose(self._merged_t_map.inverse())
            self._coverage = round(self._referee.coverage(grid, world_t_merged), 4)
            record["coverage"] = self._coverage
        self._write(record)
        if self._coverage >= self._options.target and not self._is_covered:
            self._is_covered = True
            self._write({"kind": "covered", "t_s": now, "coverage": self._coverage, "target": self._options.target})

    def _take_state(self, payload: bytes, now: float) -> None:
        if payload == self._last_state:
            return
        self._last_state = payload
        try:
            word = json.loads(payload)
        except ValueError:
            word = None
        self._write({"kind": "status", "t_s": now, "status": word})

    def _take_claim(self, payload: bytes, now: float) -> None:
        try:
            robot, claim = decode_claim(payload)
        except WireError:
            return
        self._claims_heard += robot != self._options.settings.robot
        self._agent.explorer.hear_claim(robot, claim, now)

    def _record_path(self, now: float) -> None:
        true, belief = self._agent.body.pose, self._agent.belief
        record: Record = {"kind": "path", "t_s": now}
        record |= {name: round(getattr(true, name), 3) for name in ("x", "y", "yaw")}
        record |= {f"belief_{name}": round(getattr(belief, name), 3) for name in ("x", "y", "yaw")}
        self._write(record)

    def _record_progress(self, now: float) -> None:
        self._write(
            {
                "kind": "progress",
                "t_s": now,
                "scans": self._agent.scans,
                "maps_sent": self._sent,
                "bytes_sent": self._sent_bytes,
                "maps_received": self._received,
                "bytes_received": self._received_bytes,
                "claims_heard": self._claims_heard,
                "coverage": self._coverage,
                "state": "led" if self._is_led else self._agent.explorer.state.value,
                "goals": self._agent.explorer.goals,
                "way_m": round(self._agent.body.way_m, 2),
                "cpu_s": round(time.process_time(), 3),
                "stopped_s": round(self._agent.stopped_s, 2),
                "corrections": self._corrections,
                "correction_age_s": round(self._latest_s, 3),
            }
        )
        self._latest_s = 0.0

    def _write(self, record: Record) -> None:
        self._recorder.write(self._options.settings.robot, record)


def parse(arguments: list[str]) -> Options:
    """The command line as options; argparse exits 2 on a wrong one.

    Raises:
        ConfigError: the world cannot be read, or has no room for the robots.
    """
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.explore.robot", description="An exploring lab robot.")
    add = parser.add_argument
    add("--robot", "--name", required=True, help="the robot's name: the first chunk of its keys")
    add("--world", default="office:1", help="turtlebot3, office:SEED[:LENGTH] or a map_server .yaml (office:1)")
    add("--index", type=int, default=0, help="which of the world's start places, from 0")
    add("--robots", type=int, default=3, help="how many robots explore (3)")
    add("--start", type=pose, help="x,y,yaw in the world instead of a start place (m, rad)")
    add("--seed", type=int, default=1, help="of the laser's noise and the drift")
    add("--endpoint", required=True, help="the robot's data endpoint, e.g. tcp/127.0.0.1:7458")
    add("--records", type=Path, required=True, help="folder for what the robot saw")
    add("--target", type=float, default=0.9, help="share of the world that counts as covered (0.9)")
    add("--speed", type=float, default=Limits().speed, help="m/s at most (0.5; a TurtleBot3 Burger does 0.22)")
    add("--drift-yaw", type=float, default=Drift().yaw, help="rad per square root of a metre (0.001)")
    add("--drift-way", type=float, default=Drift().way, help="m per square root of a metre (0.003)")
    add("--resolution", type=metres_per_cell, default=RESOLUTION_M, help="of its own map, metres per cell (0.05)")
    add("--slam-on", default="", metavar="NODE", help="map on this node (zsched_lab.explore.slam), send scans")
    add("--led", action="store_true", help="let SLAM and navigation on a node lead it; only with --slam-on")
    add("--slam-task", default="", metavar="TASK", help="the task that its SLAM is; only with --led")
    add("--hold-until-s", type=float, help="stand until then, on the machine's monotonic clock (do not)")
    add("--begin-s", type=float, help="when to begin, on the machine's monotonic clock (at once)")
    given = parser.parse_args(arguments)
    if not 0 <= given.index < given.robots or not 0.0 < given.speed <= 5.0:
        parser.error("--index must be in [0, robots) and --speed in (0, 5]")
    if (given.led and not given.slam_on) or (given.slam_task and not given.led):
        parser.error("--led goes with --slam-on, and --slam-task with --led")
    world = load_world(given.world)
    settings = RobotSettings(
        robot=given.robot,
        start=given.start or world.starts(given.robots)[given.index],
        seed=given.seed,
        limits=Limits(speed=given.speed),
        drift=Drift(yaw=given.drift_yaw, way=given.drift_way),
        resolution_m=given.resolution,
        has_slam=not given.slam_on,
        is_led=given.led,
        hold_until_s=given.hold_until_s,
    )
    phase = given.index / given.robots
    return Options(
        settings=settings,
        world=world,
        phase=phase,
        endpoint=given.endpoint,
        records=given.records,
        target=given.target,
        begin_s=given.begin_s,
        slam_task=given.slam_task,
    )


def pose(text: str) -> Pose2:
    """``x,y,yaw`` as a pose; raises what argparse understands."""
    values = [float(value) for value in text.split(",")]
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"{text} is not x,y,yaw")
    return Pose2(x=values[0], y=values[1], yaw=values[2])


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 1 when the robot's data endpoint never answered, 78 without a world."""
    cv2.setNumThreads(1)
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
    except ConfigError as error:
        sys.stderr.write(f"explore.robot: {error}\n")
        return EXIT_CONFIG

    def work(session: zenoh.Session, stop: StopFlag) -> None:
        with Recorder(options.records) as recorder:
            applications = Applications(options, session, recorder)
            applications.run(stop)
            applications.save()

    return application.run(f"explore.robot: {options.settings.robot}", options.endpoint, work)


if __name__ == "__main__":
    raise SystemExit(main())
