"""Injects load into nodes by a seeded schedule: real neural inference inside the node's own share, and memory ballast.

Knows: windows, levels, the processes that make the load. Does not know: schemes, or who owns the task.

The schedule depends on the seed only, not on the scheme and not on the level: a stronger level puts more into the same
windows. A load is a process that is started at the window's start (its model's loading is part of the load, as it was
in the paper) and killed at its end. Run as ``python -m zsched_lab.paper.load MIB`` it is the ballast: so much memory,
touched and kept.
"""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from zsched.core.values.model import NodeId
from zsched_lab.fleet.children import Child, Children
from zsched_lab.fleet.limits import NodeLimits
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.fleet.view import Load
from zsched_lab.paper.scenario import LoadLevel, LoadPlan, NodeShare

Tell = Callable[[float, str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """Load on ``node`` from ``start_s`` to ``end_s``, in seconds since the robots started."""

    node: NodeId
    start_s: float
    end_s: float


def schedule(plan: LoadPlan, nodes: Iterable[NodeId], duration_s: float, seed: int) -> tuple[Window, ...]:
    """The windows of a run, by start: on nodes drawn at random, never two on one node at a time.

    >>> one, two = (schedule(LoadPlan(), ("e1", "e2", "e3"), 60.0, 7) for _ in range(2))
    >>> one == two
    True
    """
    generator = random.Random(seed)
    names = sorted(nodes)
    if not names:
        return ()
    starts = [plan.first_s + generator.uniform(*plan.idle_s) for _ in range(min(plan.lanes, len(names)))]
    windows: list[Window] = []
    while starts and min(starts) < duration_s:
        lane = starts.index(min(starts))
        start = starts[lane]
        length, pause = generator.uniform(*plan.busy_s), generator.uniform(*plan.idle_s)
        free = [name for name in names if all(name != w.node or w.end_s <= start for w in windows)]
        end = min(start + length, duration_s)
        if free:
            windows.append(Window(node=generator.choice(free), start_s=start, end_s=end))
        starts[lane] = end + max(pause, 0.1)
    return tuple(windows)


def loaded_at(windows: Iterable[Window], t_s: float) -> frozenset[NodeId]:
    """The nodes that are loaded at ``t_s``."""
    return frozenset(window.node for window in windows if window.start_s <= t_s < window.end_s)


class Loads:
    """Carries a schedule out, several loads at a time. For the main thread only (see `Children`)."""

    def __init__(
        self,
        windows: tuple[Window, ...],
        level: LoadLevel,
        full_cores: float,
        children: Children,
        limits: NodeLimits,
        records: Path,
        tell: Tell,
    ) -> None:
        self._waiting = list(windows)
        self._level, self._full_cores = level, full_cores
        self._children, self._limits = children, limits
        self._records, self._tell = records, tell
        self._running: dict[NodeId, tuple[Window, Child, float]] = {}
        self._past: list[Load] = []

    @property
    def loaded(self) -> frozenset[NodeId]:
        """The nodes that are loaded now."""
        return frozenset(self._running)

    @property
    def past(self) -> tuple[Load, ...]:
        """The windows as they really were, those that are over."""
        return tuple(self._past)

    def ballast(self, node: NodeId, share: NodeShare) -> None:
        """Fill so much of the node's memory for the whole run; nothing without ballast."""
        if share.ballast_mb <= 0.0:
            return
        command = [sys.executable, "-m", "zsched_lab.paper.load", f"{share.ballast_mb:g}"]
        self._limits.put_work(node, self._children.start(f"ballast-{node}", command).process.pid)

    def tick(self, t_s: float) -> None:
        """Do what is due at ``t_s``."""
        for node, (window, _, _) in tuple(self._running.items()):
            if t_s >= window.end_s:
                self._stop(node, t_s)
        while self._waiting and t_s >= self._waiting[0].start_s:
            window = self._waiting.pop(0)
            if t_s < window.end_s:
                self._start(window, t_s)

    def stop(self, t_s: float) -> None:
        """End every load."""
        for node in tuple(self._running):
            self._stop(node, t_s)

    def _start(self, window: Window, t_s: float) -> None:
        name = f"load-{len(self._past) + len(self._running) + 1}-{window.node}"
        level = self._level
        command = [sys.executable, "-m", "zsched_lab.paper.cameras", "--streams", str(level.streams)]
        command += ["--cores", f"{level.share * self._full_cores:g}", "--side", str(level.side)]
        child = self._children.start(name, command, output=self._records / f"{name}.ndjson")
        self._limits.put_work(window.node, child.process.pid)
        self._running[window.node] = (window, child, t_s)
        self._tell(t_s, f"load on {window.node} until {window.end_s:.1f} s")

    def _stop(self, node: NodeId, t_s: float) -> None:
        _, child, start_s = self._running.pop(node)
        self._children.stop(child, grace_s=0.0)  # under a quota a polite end would take seconds of the next window
        self._past.append(Load(node=node, start_s=start_s, end_s=t_s))
        self._tell(t_s, f"load on {node} ends")


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the ballast: 0 after a stop signal."""
    given = sys.argv[1:] if arguments is None else arguments
    stop = StopFlag()
    stop.install()
    kept = bytearray(int(float(given[0]) * 1024 * 1024))
    kept[::4096] = b"\x01" * len(kept[::4096])  # touched, or it is only a promise of memory
    while not stop.is_set:
        time.sleep(0.1)
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
