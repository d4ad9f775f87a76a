"""Watches the fleet through its daemons' operator sockets, from a thread of its own: a wedged daemon stalls nothing.

Knows: which worker answered when, and which allocations were ever told. Does not know: what is done with it.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from zsched.core.values.errors import ZschedError
from zsched.core.values.model import NodeId, TaskId
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched_lab.fleet.runner import Ask
from zsched_lab.fleet.view import Move, Status, merge_moves, past_allocations

PERIOD_S = 0.5
ANSWER_S = 0.5
FORGET_S = 3.0
"""A snapshot older than this is no longer shown as the node's own word."""


class Observer:
    """Asks every daemon for its status twice a second; read from any thread. A context: leaving it ends the thread."""

    def __init__(self, sockets: Mapping[NodeId, Path], task: TaskId, ask: Ask, others: tuple[TaskId, ...] = ()) -> None:
        self._sockets = dict(sockets)
        self._task = task
        self._ask = ask
        self._lock = threading.Lock()
        self._statuses: dict[NodeId, tuple[float, Status]] = {}
        self._moves: dict[TaskId, dict[int, Move]] = {name: {} for name in (task, *others)}
        self._stop = threading.Event()
        self._thread = guarded(self._run, name="observer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=2 * ANSWER_S)

    def statuses(self) -> dict[NodeId, Status]:
        """The newest snapshot of every node that answered lately."""
        now = monotonic_s()
        with self._lock:
            return {node: status for node, (at_s, status) in self._statuses.items() if now - at_s < FORGET_S}

    def heard_s(self) -> dict[NodeId, float]:
        """When each node last answered, on the daemon's clock."""
        with self._lock:
            return {node: at_s for node, (at_s, _) in self._statuses.items()}

    def moves(self, task: TaskId | None = None) -> list[Move]:
        """Every allocation of a task (``None``: the first) told so far, by epoch; times on the daemon's clock."""
        with self._lock:
            found = self._moves[task or self._task]
            return [found[epoch] for epoch in sorted(found)]

    def _run(self) -> None:
        while not self._stop.is_set():
            started = monotonic_s()
            for node, path in self._sockets.items():
                self._look(node, path)
                if self._stop.is_set():
                    return
            self._stop.wait(max(0.05, PERIOD_S - (monotonic_s() - started)))

    def _look(self, node: NodeId, path: Path) -> None:
        try:
            status = self._ask(path, {"verb": "status"}, ANSWER_S)
        except (OSError, ValueError, ZschedError):
            return  # not up yet, or in trouble: the view shows "no answer"
        if "error" in status:
            return
        now = monotonic_s()
        told = {task: past_allocations(status, task, now) for task in self._moves}
        with self._lock:
            self._statuses[node] = (now, status)
            self._moves = {task: merge_moves(known, told[task]) for task, known in self._moves.items()}
