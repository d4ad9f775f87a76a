"""Carries a schedule out: starts and stops neural load where and when it says, and keeps what really happened.

Knows: the schedule, the load that runs now. Does not know: how a node is loaded (`FleetRunner.inject`), or who decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from zsched.core.values.model import NodeId
from zsched_lab.fleet.children import Child, Children
from zsched_lab.fleet.recorder import read_records
from zsched_lab.fleet.runner import FleetRunner
from zsched_lab.fleet.schedule import Injection
from zsched_lab.fleet.view import Load

Tell = Callable[[float, str], None]
"""(seconds since the start, what happened)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningLoad:
    """The load that runs now."""

    injection: Injection
    node: NodeId
    child: Child
    output: Path
    start_s: float


class Injector:
    """One load at a time, by the schedule."""

    def __init__(
        self, schedule: tuple[Injection, ...], runner: FleetRunner, children: Children, records: Path, tell: Tell
    ) -> None:
        self._waiting = list(schedule)
        self._runner = runner
        self._children = children
        self._records = records
        self._tell = tell
        self._running: RunningLoad | None = None
        self._past: list[Load] = []

    @property
    def loaded(self) -> frozenset[NodeId]:
        """The nodes that are loaded now."""
        return frozenset() if self._running is None else frozenset({self._running.node})

    @property
    def loads(self) -> tuple[Load, ...]:
        """The windows as they really were, those that are over."""
        return tuple(self._past)

    def tick(self, t_s: float, owner: NodeId | None) -> None:
        """Do what is due at ``t_s``; a window that wants the owner waits for there to be one."""
        if self._running is not None and t_s >= self._running.injection.end_s:
            self.stop(t_s)
        if self._running is not None or not self._waiting or t_s < self._waiting[0].start_s:
            return
        if t_s >= self._waiting[0].end_s:
            self._waiting.pop(0)
            return
        target = self._waiting[0].target or owner
        if target is not None:
            self._start(self._waiting.pop(0), target, t_s)

    def _start(self, injection: Injection, node: NodeId, t_s: float) -> None:
        output = self._records / f"load-{len(self._past) + 1}-{node}.ndjson"
        child = self._runner.inject(node, injection, output)
        self._running = RunningLoad(injection=injection, node=node, child=child, output=output, start_s=t_s)
        self._tell(t_s, f"neural load on {node} for {injection.end_s - t_s:.0f} s ({injection.threads} thread)")

    def stop(self, t_s: float) -> None:
        """End the running load, if there is one, and tell what it achieved."""
        running, self._running = self._running, None
        if running is None:
            return
        self._children.stop(running.child)
        self._past.append(Load(node=running.node, start_s=running.start_s, end_s=t_s))
        reports = read_records(running.output)
        if not reports:
            self._tell(t_s, f"load on {running.node} ends; it reported nothing, see {running.child.log}")
            return
        model, count = reports[-1].get("model"), reports[-1].get("frames")
        fps = sum(float(report.get("fps", 0.0)) for report in reports) / len(reports)
        self._tell(t_s, f"load on {running.node} ends: {model}, {count} frames, {fps:.1f}/s")
