"""A stand-in for a daemon behind its operator socket, for tests of verbs that run in the test's own process."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from zsched.host.operator_socket import Json, OperatorSocket

STATUS: Final[Json] = json.loads(
    (Path(__file__).parents[1] / "unit" / "commands" / "recorded_status" / "healthy.json").read_text()
)
"""A recorded answer of a healthy fleet."""


@contextlib.contextmanager
def answering(
    answer: Callable[[Json], Json], folder: Path, monkeypatch: pytest.MonkeyPatch, node: str = "robot1"
) -> Iterator[None]:
    """While it lasts, verbs find one daemon, of ``node``, which answers each request by ``answer``."""
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(folder))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    with contextlib.closing(OperatorSocket(folder / f"{node}.sock", answer)) as door:
        door.open()
        yield


def living(name: str, kind: str, *tasks: str) -> Json:
    """A node of a status: alive, with a ready worker for each of the tasks."""
    recorded = STATUS["nodes"][0]
    workers = [{**recorded["workers"][0], "task": task, "state": "ready"} for task in tasks]
    return {**recorded, "name": name, "kind": kind, "state": "alive", "draining": False, "workers": workers}
