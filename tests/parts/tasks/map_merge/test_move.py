"""A move in mode estimate: the new owner's first map is whole already, for it was given the transforms."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.waiting import free_endpoint, until
from zsched.core.values import codec as wire
from zsched.core.values.plan import Role, WorkerRole
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import data_config, worker_config
from zsched.tasks.map_merge.cdr import encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid

_FLEET, _TASK = "test", "map_merge"
_KEYS = Keyspace(_FLEET)
_WINDOWS = {"robot1": (0.0, 0.0, 15.0, 16.0), "robot2": (7.0, 0.0, 24.0, 16.0)}
_FRAMES = {"robot1": Pose2(), "robot2": Pose2(x=1.2, y=-3.4, yaw=0.5)}
View = Callable[[tuple[float, float, float, float], Pose2], Grid]


class _Hub:
    """Tells two real workers their roles and feeds them maps, as their relays would."""

    def __init__(self, folder: Path) -> None:
        endpoint = free_endpoint()
        text = data_config(listen=(endpoint,), connect=(), shared_memory=False)
        self.session = zenoh.open(zenoh.Config.from_json5(text))
        self.roles: dict[str, Role] = {}
        self.tokens: set[str] = set()
        self.statuses: list[tuple[str, dict[str, Any]]] = []
        self._kept = [
            self.session.declare_queryable(_KEYS.role("*", "*"), self._answer),
            self.session.liveliness().declare_subscriber(f"@zsched/{_FLEET}/**", self._token, history=True),
            self.session.declare_subscriber(f"*/{_TASK}/*/status", self._status),
        ]
        self.workers = [self._worker(folder, node, endpoint) for node in ("edge1", "edge2")]
        for node in ("edge1", "edge2"):
            key = _KEYS.worker(node, _TASK, 1)
            until(partial(self.tokens.__contains__, key), f"worker of {node}")

    @staticmethod
    def _worker(folder: Path, node: str, endpoint: str) -> subprocess.Popen[bytes]:
        config = folder / f"{node}.json5"
        config.write_text(worker_config(connect=(endpoint,), shared_memory=False))
        env = os.environ | {
            "ZSCHED_FLEET": _FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": _TASK,
            "ZSCHED_INCARNATION": "1",
            "ZSCHED_ZENOH_CONFIG": str(config),
        }
        return subprocess.Popen([sys.executable, "-m", "zsched.tasks.map_merge", "--mode", "estimate"], env=env)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for key, role in tuple(self.roles.items()):
                if query.key_expr.intersects(key):
                    query.reply(key, wire.encode(role))

    def _token(self, sample: zenoh.Sample) -> None:
        act = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
        act(str(sample.key_expr))

    def _status(self, sample: zenoh.Sample) -> None:
        self.statuses.append((str(sample.key_expr).split("/")[0], json.loads(sample.payload.to_bytes())))

    def tell(self, node: str, role: WorkerRole, epoch: int, predecessor: str | None = None) -> None:
        value = Role(task=_TASK, role=role, epoch=epoch, predecessor=predecessor)
        key = _KEYS.role(node, _TASK)
        self.roles[key] = value
        self.session.put(key, wire.encode(value), congestion_control=zenoh.CongestionControl.BLOCK)

    def feed(self, node: str, view: View) -> None:
        for robot, window in _WINDOWS.items():
            key = f"{node}/{_TASK}/{robot}/map"
            content = encode_grid(view(window, _FRAMES[robot]))
            self.session.put(key, content, congestion_control=zenoh.CongestionControl.BLOCK)

    def of(self, node: str) -> list[dict[str, Any]]:
        return [status for name, status in tuple(self.statuses) if name == node]

    def attached(self, node: str) -> list[dict[str, Any]]:
        """The node's statuses since it knows how robot2's map lies."""
        return [status for status in self.of(node) if status["robots"].get("robot2", {}).get("state") == "attached"]

    def stop(self) -> None:
        for worker in self.workers:
            worker.kill()
            worker.wait(60)
        self.session.close()


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[_Hub]:
    made = _Hub(tmp_path)
    try:
        yield made
    finally:
        made.stop()


def _first_merge(hub: _Hub, node: str) -> dict[str, Any]:
    """The first status of a node that knows robot2 (on a busy machine its map may come behind the very first merge)."""
    found: dict[str, Any] = until(
        lambda: next((status for status in hub.of(node) if "robot2" in status["robots"]), None),
        f"the first merge of {node}",
    )
    return found


def test_a_planned_move_costs_no_search_and_a_crash_does(hub: _Hub, view: View) -> None:
    """The first merge of a new owner has both robots, with the state; alone, it would have to search first."""
    hub.tell("edge1", WorkerRole.ACTIVE, 1)
    hub.feed("edge1", view)
    assert _first_merge(hub, "edge1")["robots"]["robot2"]["state"] != "attached", "nobody could know yet"
    until(lambda: hub.attached("edge1"), "edge1 has found how the maps lie")
    before = hub.attached("edge1")[0]

    hub.feed("edge2", view)  # the relay's warm-up
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    first = _first_merge(hub, "edge2")
    assert first["robots"]["robot2"]["state"] == "attached"
    assert first["reference"] == before["reference"]
    assert first["robots"]["robot2"]["pose"] == pytest.approx(before["robots"]["robot2"]["pose"], abs=0.05)
    assert not any(status["is_searching"] for status in hub.of("edge2"))


def test_merge_now_answers_with_the_status_of_the_owner_only(hub: _Hub, view: View) -> None:
    hub.tell("edge1", WorkerRole.ACTIVE, 1)
    hub.feed("edge1", view)
    merges = _first_merge(hub, "edge1")["merges"]
    key = f"{_TASK}/robot1/merge_now"
    (reply,) = hub.session.get(f"edge1/{key}", timeout=60.0)
    assert reply.ok is not None
    assert json.loads(reply.ok.payload.to_bytes())["schema"] == "zsched.map_merge.status/1"
    until(lambda: hub.of("edge1")[-1]["merges"] > merges, "one more merge, though nothing has changed")
    (refused,) = hub.session.get(f"edge2/{key}", timeout=60.0)
    assert refused.err is not None
    assert refused.err.payload.to_string().startswith("not owner")
