"""The real worker process behind real relays: maps in at the robot, merged map out at the robot."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from support.sessions import matches
from support.waiting import free_endpoint, until
from zsched.core.values.events import SlotFlipped, SlotReady
from zsched.core.values.plan import (
    Direction,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamSettings,
    WorkerRole,
)
from zsched.core.values.plan import ReadyWhen as Ready
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.sessions.config import data_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched.tasks.map_merge.cdr import decode_grid, decode_transforms, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.fleet.relays import hello_of

_FLEET, _TASK, _ROBOT, _EDGE, _EPOCH = "test", "map_merge", "robot1", "edge1", 3
View = Callable[[tuple[float, float, float, float], Pose2], Grid]


def _route(name: str, direction: Direction, from_expr: str, to_expr: str) -> Route:
    settings = StreamSettings(stream_class=StreamClass.LATEST, keep_last=1)
    return Route(stream=name, direction=direction, from_expr=from_expr, to_expr=to_expr, settings=settings)


def _slot() -> Slot:
    owner = f"{_EDGE}/{_TASK}"
    outputs = tuple(
        _route(f"out/{name}", Direction.OUTPUT, f"{owner}/{_EPOCH}/{name}", f"{_ROBOT}/{name}")
        for name in ("global_map", "tf", "status")
    )
    map_in = _route("in/0", Direction.INPUT, f"{_ROBOT}/map", f"{owner}/{_ROBOT}/map")
    return Slot(epoch=_EPOCH, owner=_EDGE, routes=(map_in, *outputs), ready_when=Ready.TOKEN)


class _Rig:
    """The relays of one robot and one edge, the edge's worker, and an application beside the robot."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.folder = folder
        self.reports: list[HandleReport] = []
        robot, edge = free_endpoint(), free_endpoint()
        self.relays = {
            _ROBOT: self._relay(_ROBOT, robot, (), self.reports.append),
            _EDGE: self._relay(_EDGE, edge, (robot,), lambda _report: None),
        }
        self.app = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(robot,), shared_memory=False)))
        config = folder / "worker.json5"
        config.write_text(worker_config(connect=(edge,), shared_memory=False))
        self.worker = self._start_worker(config, arguments)

    def _relay(
        self, node: str, listen: str, connect: tuple[str, ...], on_report: Callable[[HandleReport], None]
    ) -> RelayHandle:
        config = data_config(listen=(listen,), connect=connect, shared_memory=False)
        handle = RelayHandle(
            hello=hello_of(_FLEET, node), path=self.folder / f"{node}.relay", zenoh_config=config, on_report=on_report
        )
        handle.start()
        return handle

    @staticmethod
    def _start_worker(config: Path, arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
        env = os.environ | {
            "ZSCHED_FLEET": _FLEET,
            "ZSCHED_NODE": _EDGE,
            "ZSCHED_TASK": _TASK,
            "ZSCHED_INCARNATION": "1",
            "ZSCHED_ZENOH_CONFIG": str(config),
        }
        return subprocess.Popen([sys.executable, "-m", "zsched.tasks.map_merge", *arguments], env=env)

    def move_in(self) -> None:
        """Make the worker the owner, by the executor's steps."""
        self.relays[_EDGE].set_role(Role(task=_TASK, role=WorkerRole.ACTIVE, epoch=_EPOCH))
        for phase, report in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self.relays[_ROBOT].apply(RoutePlan(task=_TASK, phase=phase, current=_slot()))
            self._await(report)

    def _await(self, kind: type[HandleReport]) -> None:
        until(lambda: any(isinstance(one, kind) for one in tuple(self.reports)), kind.__name__)

    def stop(self) -> None:
        self.worker.kill()
        self.worker.wait(60)
        self.app.close()
        for relay in self.relays.values():
            relay.stop()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[_Rig]:
    made = _Rig(tmp_path, "--mode", "known", "--pose", "robot1=2,-1,0.4")
    yield made
    made.stop()


def test_map_goes_in_and_merged_map_comes_out_at_the_robot(rig: _Rig, view: View) -> None:
    """Map, transforms and status come back on the robot's own keys; a bad map only counts; SIGTERM ends it cleanly."""
    seen: dict[str, tuple[bytes, bytes | None]] = {}

    def keep(sample: zenoh.Sample) -> None:
        attachment = None if sample.attachment is None else sample.attachment.to_bytes()
        seen[str(sample.key_expr)] = (sample.payload.to_bytes(), attachment)

    def status() -> dict[str, Any]:
        found: dict[str, Any] = json.loads(seen.get(f"{_ROBOT}/status", (b'{"robots": {}}', None))[0])
        return found

    watch = rig.app.declare_subscriber(f"{_ROBOT}/*", keep)
    grid = view((0.0, 0.0, 12.0, 16.0), Pose2(x=2.0, y=-1.0, yaw=0.4))
    block = zenoh.CongestionControl.BLOCK
    publisher = rig.app.declare_publisher(f"{_ROBOT}/map", congestion_control=block)
    rig.move_in()
    until(lambda: matches(publisher), "the application sees the relay's subscription")
    publisher.put(encode_grid(grid))
    payload, attachment = until(lambda: seen.get(f"{_ROBOT}/global_map"), "a merged map at the robot")
    merged = decode_grid(payload)
    assert np.count_nonzero(merged.occupied) > 0.7 * np.count_nonzero(grid.occupied)
    assert attachment is not None
    assert json.loads(attachment)["inputs"] == {"robot1": 7}
    (transform,) = decode_transforms(until(lambda: seen.get(f"{_ROBOT}/tf"), "transforms")[0])
    assert transform.child == "robot1/map"
    assert transform.pose.yaw == pytest.approx(0.4)
    publisher.put(b"no map at all")
    until(lambda: status()["robots"].get("robot1", {}).get("bad") == 1, "the bad map in the status")
    assert status()["robots"]["robot1"]["state"] == "attached"
    watch.undeclare()
    rig.worker.send_signal(signal.SIGTERM)
    assert rig.worker.wait(60) == 0


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--pose", "robot1"], 78, "--pose robot1"),
        ([], 78, "ZSCHED_FLEET"),
        (["--mode", "guess"], 2, "--mode"),
        (["--resolution", "0"], 2, "--resolution"),
    ],
)
def test_bad_arguments_end_with_a_code_and_a_reason(arguments: list[str], code: int, words: str) -> None:
    env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCHED_")}
    command = [sys.executable, "-m", "zsched.tasks.map_merge", *arguments]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == code
    assert words in done.stderr
