"""One span for each move: from the judgement that called it to the end of its handover, out of a decision log (pure).

Knows: which lines of a log belong to a move, when a move is over. Does not know: OpenTelemetry, sockets.

A trace is named by fleet, task and epoch: what several nodes tell of one move comes together in one trace.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from typing import Final

from zsched.commands.common import Json
from zsched.commands.history import is_move
from zsched.core.values.struct import Struct, field

OVERDUE_S: Final = 60.0
"""A move that is not settled by then is reported as far as it came."""
MOST_LINES: Final = 100


class Span(Struct, frozen=True, kw_only=True):
    """One move as one node saw it; times in seconds since 1970, by that node's clock."""

    node: str
    task: str
    epoch: int
    left: str | None
    owner: str | None
    reason: str
    begin: float
    end: float
    switched_s: float | None
    """How long the streams took to switch, ``None`` where they have not, or the node has none."""
    lines: tuple[tuple[float, str, str], ...]
    """(time, stage, text)."""


def trace_id(fleet: str, task: str, epoch: int) -> int:
    """The 128 bits that name a move's trace, the same on every node."""
    return int.from_bytes(hashlib.sha256(f"{fleet}/{task}/{epoch}".encode()).digest()[:16], "big") or 1


class _Open(Struct):
    """A move that is not over."""

    entry: Json
    lines: list[Json] = field(default_factory=list)
    switched_s: float | None = None


class Moves:
    """Takes the lines of one node's log in their order, and gives the moves that are over."""

    def __init__(self) -> None:
        self._before: dict[str, list[Json]] = {}
        """Of each task the lines that may belong to its next move."""
        self._open: dict[str, _Open] = {}

    def take(self, entries: Iterable[Json]) -> Iterator[Span]:
        """The moves that end with these lines."""
        for entry in entries:
            task = str(entry.get("task", ""))
            if not task:
                continue
            if "move" in entry and not is_move(entry):
                yield from self._close(task)  # the daemon has begun anew: no lines of its earlier life follow
            elif "move" in entry:
                yield from self._close(task)
                self._open[task] = _Open(entry, [*self._before.pop(task, []), entry])
            elif task in self._open and entry.get("epoch") == self._open[task].entry["epoch"]:
                yield from self._go_on(task, entry)
            else:
                self._wait(task, entry)

    def overdue(self, now: float) -> Iterator[Span]:
        """The moves that have waited for their end for `OVERDUE_S`; ``now``: the node's clock."""
        for task in [task for task, one in self._open.items() if now - one.entry["at"] > OVERDUE_S]:
            yield from self._close(task)

    def rest(self) -> Iterator[Span]:
        """The moves that are not over, as far as they came."""
        for task in list(self._open):
            yield from self._close(task)

    def _wait(self, task: str, entry: Json) -> None:
        """A move begins with the judgement that calls for it: one that does not, ends what was before."""
        lines = self._before.setdefault(task, [])
        if entry["stage"] == "scheduler" and not entry["text"].startswith("propose"):
            lines.clear()
        else:
            lines.append(entry)
            del lines[:-MOST_LINES]

    def _go_on(self, task: str, entry: Json) -> Iterator[Span]:
        one = self._open[task]
        if entry["stage"] == "scheduler":  # the first judgement under the new owner is no part of the move
            self._wait(task, entry)
            return
        one.lines.append(entry)
        del one.lines[MOST_LINES:]
        one.switched_s = entry.get("took_s", one.switched_s)
        is_drained = "took_s" in entry and not entry["text"].endswith(" drains")
        if is_drained or entry["text"].startswith("settled"):
            yield from self._close(task)

    def _close(self, task: str) -> Iterator[Span]:
        one = self._open.pop(task, None)
        if one is None:
            return
        move = one.entry["move"]
        times = [float(line["at"]) for line in one.lines]
        yield Span(
            node=one.entry["node"],
            task=task,
            epoch=move["epoch"],
            left=move["left"],
            owner=move["owner"],
            reason=move["reason"],
            begin=min(times),
            end=max(times),
            switched_s=one.switched_s,
            lines=tuple((float(line["at"]), str(line["stage"]), str(line["text"])) for line in one.lines),
        )
