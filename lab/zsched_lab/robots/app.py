"""One robot's applications: drives through its part of a laser log, maps it, publishes the map, uses the merged one.

Knows: its log, its own keys (``<robot>/map``, ``<robot>/global_map``, ``<robot>/map_merge/status``), the endpoint of
its robot. Does not know: zsched. It is a plain zenoh client, like any robot program, and never notices a move.

Started as ``python -m zsched_lab.robots.app`` (see `parse`). Records go to ``<records>/<robot>.ndjson``: ``progress``
and ``picture`` once a second, ``map`` per merged map, ``status`` per change of the merger's word on the robots. When it
is stopped it writes the last merged map and its own, as received and as sent: ``<records>/<robot>-global_map.cdr``,
``-map.cdr``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import zenoh

from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.cdr import CdrError, decode_grid, encode_grid
from zsched_lab.fleet import application
from zsched_lab.fleet.recorder import Record, Recorder
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.maps.laser_log import LaserLog, Scan, load_log, malaga_path, split_log
from zsched_lab.maps.mapping import GridMapper, displacements
from zsched_lab.maps.picture import MapPicture

MAP_PERIOD_S = 1.0
PROGRESS_PERIOD_S = 1.0
PICTURE_PERIOD_S = 1.0
POLL_S = 0.02
"""How often the subscribers are looked at: the error of an arrival time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotOptions:
    """What one robot replays and where; times on the daemon's clock."""

    robot: str
    index: int
    robots: int
    seed: int
    log: Path
    endpoint: str
    records: Path
    replay_s: float
    """Real seconds in which the whole part is driven: the speed factor follows from it."""
    begin_s: float | None = None
    """When it begins, on the machine's monotonic clock; ``None``: at once."""


class Drive:
    """The robot's part of the log as scans with due times, equally spaced (logs step back in time, and pause)."""

    def __init__(self, part: LaserLog, replay_s: float) -> None:
        self._scans = part.scans
        self._period_s = replay_s / len(part.scans)
        self._next = 0

    @property
    def done(self) -> int:
        """Scans taken so far."""
        return self._next

    @property
    def total(self) -> int:
        """Scans of the whole part."""
        return len(self._scans)

    def due(self, since_start_s: float) -> Scan | None:
        """The next scan when its time has come, else ``None``."""
        if self._next >= len(self._scans) or since_start_s < self._next * self._period_s:
            return None
        self._next += 1
        return self._scans[self._next - 1]

    def wait_s(self, since_start_s: float) -> float:
        """Seconds until the next scan; infinite after the last."""
        if self._next >= len(self._scans):
            return float("inf")
        return self._next * self._period_s - since_start_s


class Applications:
    """The mapping node, the map's publisher and the map's users, on one session."""

    def __init__(self, options: RobotOptions, session: zenoh.Session, recorder: Recorder) -> None:
        self._options = options
        self._recorder = recorder
        log = load_log(options.log)
        frames = displacements(options.robots, options.seed)
        self._mapper = GridMapper(displacement=frames[options.index], frame_id=f"{options.robot}/map")
        self._drive = Drive(split_log(log, options.robots)[options.index], options.replay_s)
        robot = options.robot
        # BLOCK_FIRST: a map is many fragments, which DROP loses on a slow link; one map waits, none piles up behind it.
        congestion = zenoh.CongestionControl.BLOCK_FIRST
        self._publisher = session.declare_publisher(f"{robot}/map", congestion_control=congestion)
        self._maps = session.declare_subscriber(f"{robot}/global_map", zenoh.handlers.RingChannel(4))
        self._states = session.declare_subscriber(f"{robot}/map_merge/status", zenoh.handlers.RingChannel(4))
        self._sent = self._sent_bytes = self._received = self._received_bytes = 0
        self._last_map = self._last_sent = b""
        self._last_map_s: float | None = None
        self._last_state = b""
        self._next_picture_s = 0.0

    def run(self, stop: StopFlag) -> None:
        """Drive, map, publish and listen until stopped."""
        application.wait_until(self._options.begin_s, stop)
        start = next_progress = monotonic_s()
        # Robots are not in step; spread evenly, runs can be compared (maps that come together are merged together).
        next_map = start + MAP_PERIOD_S * self._options.index / self._options.robots
        while not stop.is_set:
            now = monotonic_s()
            scan = self._drive.due(now - start)
            if scan is not None:
                self._mapper.add(scan)
            self._listen()
            if now >= next_map:
                self._publish()
                next_map = max(next_map + MAP_PERIOD_S, now)
            if now >= next_progress:
                self._progress(now)
                next_progress = max(next_progress + PROGRESS_PERIOD_S, now)
            time.sleep(max(0.0, min(POLL_S, self._drive.wait_s(monotonic_s() - start))))
        self._progress(monotonic_s())

    def save(self) -> None:
        """Write the last merged map and the last own map."""
        for name, payload in (("global_map", self._last_map), ("map", self._last_sent)):
            if payload:
                (self._options.records / f"{self._options.robot}-{name}.cdr").write_bytes(payload)

    def _publish(self) -> None:
        payload = encode_grid(self._mapper.grid(stamp_ns=time.time_ns()))
        self._publisher.put(payload)
        self._sent += 1
        self._sent_bytes += len(payload)
        self._last_sent = payload

    def _listen(self) -> None:
        while (sample := self._maps.try_recv()) is not None:
            self._take_map(bytes(sample.payload), monotonic_s())
        while (sample := self._states.try_recv()) is not None:
            self._take_state(bytes(sample.payload), monotonic_s())

    def _take_map(self, payload: bytes, now: float) -> None:
        try:
            grid = decode_grid(payload)
        except CdrError as error:
            self._write({"kind": "bad_map", "t_s": now, "why": str(error)})
            return
        gap = None if self._last_map_s is None else now - self._last_map_s
        self._received += 1
        self._received_bytes += len(payload)
        self._last_map, self._last_map_s = payload, now
        area = round(grid.known_area_m2, 1)
        self._write({"kind": "map", "t_s": now, "gap_s": gap, "bytes": len(payload), "known_m2": area})
        if now >= self._next_picture_s:
            self._next_picture_s = now + PICTURE_PERIOD_S
            self._write({"kind": "picture", "t_s": now, **MapPicture.of(grid).record()})

    def _take_state(self, payload: bytes, now: float) -> None:
        if payload == self._last_state:
            return
        self._last_state = payload
        try:
            word = json.loads(payload)
        except ValueError:
            word = None
        self._write({"kind": "status", "t_s": now, "status": word})

    def _progress(self, now: float) -> None:
        self._write(
            {
                "kind": "progress",
                "t_s": now,
                "scans": self._drive.done,
                "scans_total": self._drive.total,
                "maps_sent": self._sent,
                "bytes_sent": self._sent_bytes,
                "maps_received": self._received,
                "bytes_received": self._received_bytes,
            }
        )

    def _write(self, record: Record) -> None:
        self._recorder.write(self._options.robot, record)


def parse(arguments: list[str]) -> RobotOptions:
    """The command line as options; argparse exits 2 on a wrong one."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.robots.app", description="A lab robot's applications.")
    parser.add_argument("--robot", required=True, help="the robot's name: the first chunk of its keys")
    parser.add_argument("--index", type=int, required=True, help="which part of the log, from 0")
    parser.add_argument("--robots", type=int, required=True, help="into how many parts the log is cut")
    parser.add_argument("--seed", type=int, default=1, help="of the robots' map frames")
    parser.add_argument("--log", type=Path, default=malaga_path())
    parser.add_argument("--endpoint", required=True, help="the robot's data endpoint, e.g. tcp/127.0.0.1:7458")
    parser.add_argument("--records", type=Path, required=True, help="folder for what the robot saw")
    parser.add_argument("--replay-s", type=float, default=50.0, help="seconds for the whole drive")
    parser.add_argument("--begin-s", type=float, help="when to begin, on the machine's monotonic clock (at once)")
    given = vars(parser.parse_args(arguments))
    if not 0 <= given["index"] < given["robots"] or given["replay_s"] <= 0:
        parser.error("--index must be in [0, robots) and --replay-s above 0")
    return RobotOptions(**given)


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 1 when the robot's data endpoint never answered."""
    options = parse(sys.argv[1:] if arguments is None else arguments)

    def work(session: zenoh.Session, stop: StopFlag) -> None:
        with Recorder(options.records) as recorder:
            applications = Applications(options, session, recorder)
            applications.run(stop)
            applications.save()

    return application.run(f"robot_app: {options.robot}", options.endpoint, work)


if __name__ == "__main__":
    raise SystemExit(main())
