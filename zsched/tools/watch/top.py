"""The full screen of `zsched top` as text: nodes, tasks, utilities over time, streams, moves, problems (pure).

Knows: what stands where, and what is left out first where the screen is low. Does not know: terminals, keys, sockets.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from enum import IntEnum
from itertools import groupby
from operator import itemgetter
from typing import Final

from zsched.commands.base.common import Json
from zsched.commands.base.page import Cell, Page, clock_time, missed_of, name_room, short_name, size, span
from zsched.commands.base.report import header, millis, node_rows, per_second, task_rows, troubles
from zsched.core.values.struct import Struct
from zsched.tools.watch.feed import Past, Point

LEVELS: Final = "▁▂▃▄▅▆▇█"
TOP: Final = 1.0
"""A utility for which a bar is full; with the bonus it may be a little more."""
MOST_CANDIDATES: Final = 5
"""Of a task with more, the owner and the best are shown."""
GAP: Final = 2
"""A judgement stays for this many columns when no other follows it."""
LEAST_MOVES: Final = 3
"""This many moves are shown before streams are."""
WAY: Final = 20
"""Columns of a move's ends."""
REASON: Final = 45
"""The column of a move's reason."""
MIN_WIDTH, MIN_HEIGHT = 60, 12


class Detail(IntEnum):
    """How much is shown of each task."""

    LINE = 0
    BARS = 1
    STREAMS = 2


class Frame(Struct, frozen=True, kw_only=True):
    """Where and when a screen is shown."""

    width: int
    height: int
    is_colored: bool
    now: float
    """Seconds since 1970, by the clock of this machine."""
    first_task: int = 0
    """Tasks that were scrolled away."""
    period_s: float = 1.0
    """What one column of the bars stands for."""
    is_live: bool = True
    """Keys are taken and the screen is drawn again; else it is printed once."""


def render_top(past: Past, frame: Frame) -> list[str]:
    """The lines of one screen: at most ``frame.height``, none wider than ``frame.width``."""
    if frame.width < MIN_WIDTH or frame.height < MIN_HEIGHT:
        told = f"this window has {frame.width} columns and {frame.height} lines: {MIN_WIDTH} and {MIN_HEIGHT} at least"
        return [*textwrap.wrap(told, frame.width), "q ends"[: frame.width]][: frame.height]
    status = past.status
    if status is None:
        return [past.why[: frame.width], "asking again; q ends"][: frame.height]
    head = _head(status, frame)
    tail = _problems(status, frame)
    foot = [_foot(past, status, frame)] if frame.is_live or past.why else []
    moves = _moves(past, frame)
    room = frame.height - len(head) - len(tail) - len(foot)
    least = min(len(moves), LEAST_MOVES + 1)
    body = _tasks(past, status, frame, max(room - least, 1))
    left = max(room - len(body), 0)
    whole = _moves(past, frame, is_whole=True)
    moves = whole if len(whole) <= left else moves
    # the title stays, and the newest moves come first
    lines = [*head, *body, *(moves[:left] if left > 1 else [])]
    lines += [""] * (frame.height - len(lines) - len(tail) - len(foot) if frame.is_live else 0)
    return [*lines, *tail, *foot][: frame.height]


def _page(frame: Frame) -> Page:
    return Page(frame.width, frame.is_colored, frame.now)


def _head(status: Json, frame: Frame) -> list[str]:
    """The first line, and a line per node: at most a third of the screen."""
    page = _page(frame)
    header(page, status)
    node_rows(page, status, "NODE")
    most = max(frame.height // 3, 4)
    if len(page.lines) <= most:
        return page.lines
    return [*page.lines[: most - 1], f"... {len(page.lines) - most + 1} more nodes: a higher window shows them"]


def _problems(status: Json, frame: Frame) -> list[str]:
    """What is wrong: at most a quarter of the screen."""
    page = _page(frame)
    troubles(page, status)
    lines, most = page.lines[1:], max(frame.height // 4, 2)  # without its blank line
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"... {len(lines) - most + 1} more lines: `zsched status` shows them"]


def _foot(past: Past, status: Json, frame: Frame) -> str:
    page = _page(frame)
    if past.why:
        gone = f"no answer since {clock_time(past.answered_at, frame.now)}: {past.why}"
        page.row((gone, frame.width, "alarm"))
        return page.lines[0]
    keys = "q ends · arrows scroll tasks" if len(status["tasks"]) > 1 else "q ends"
    what = f"{keys} · bars: {span(frame.period_s)} a column, full at {TOP:g} · {clock_time(frame.now, frame.now)}"
    page.row((what, frame.width, "dim"))
    return page.lines[0]


# --- tasks -----------------------------------------------------------------------------------------------------------


def _tasks(past: Past, status: Json, frame: Frame, room: int) -> list[str]:
    """As much of the tasks as there is room for, in the most detail in which all have room; else those scrolled to."""
    tasks: list[Json] = status["tasks"]
    for detail in reversed(Detail):
        blocks = _blocks(past, status, frame, detail)
        lines = [line for block in blocks for line in block]
        if len(lines) <= room:
            return lines
    title, *rows = [line for block in blocks for line in block]
    first = min(max(frame.first_task, 0), max(len(tasks) - max(room - 2, 1), 0))
    kept = rows[first : first + max(room - 2, 1)]
    return [title, *kept, f"... {len(rows) - len(kept)} more tasks"][:room]


def _blocks(past: Past, status: Json, frame: Frame, detail: Detail) -> list[list[str]]:
    """The titles, and the lines of each task."""
    page = _page(frame)
    task_rows(page, status, frame.now)
    titles, *rows = page.lines
    blocks = [[titles]]
    for task, row in zip(status["tasks"], rows, strict=True):
        block = [row]
        if detail >= Detail.BARS:
            block += _bars(task, past.points.get(task["name"], ()), frame)
        if detail >= Detail.STREAMS:
            block += _streams(task, frame)
        blocks.append(block)
    return blocks


def _bars(task: Json, points: Sequence[Point], frame: Frame) -> list[str]:
    """A line per candidate: its utility, and how it has been; bright where it was the owner."""
    page = _page(frame)
    if not points:
        if task["decision"] is None:
            page.row(("", 1, ""), ("no judgement here; edges decide nothing: --node ROBOT", frame.width, "dim"))
        return page.lines
    newest = points[-1].totals
    best = sorted(task["candidates"], key=lambda name: (name != task["owner"], -newest.get(name, -1.0)))
    names = [name for name in task["candidates"] if name in best[:MOST_CANDIDATES]]
    room = name_room(frame.width, 6, *(len(name) + 1 for name in names))
    held = _held(points, frame.width - room - 22, frame)
    decision = task["decision"] or {}
    vetoed, owed = decision.get("vetoed", {}), decision.get("owed", {})
    for name in names:
        is_owner = name == task["owner"]
        text = short_name(name, room - is_owner) + "*" * is_owner
        label = page.paint(text.ljust(room), "bold" if is_owner else "")
        if name in newest:
            told = f"owed {owed[name]:.2f} s" if name in owed else ""  # an older daemon does not tell
            page.lines.append(f" {label} {newest[name]:.3f}  {told:11}  {_bar(held, name, page)}")
        else:
            page.row((" " * (room + 1), room + 1, ""), ("-", 5, ""), (vetoed.get(name, "not known"), 99, "yellow"))
            page.lines[-1] = f" {label}{page.lines[-1][room + 1 :]}"
    if len(best) > len(names):
        page.row(("", 1, ""), (f"... {len(best) - len(names)} more candidates", frame.width, "dim"))
    return page.lines


def _held(points: Sequence[Point], columns: int, frame: Frame) -> list[Point | None]:
    """The newest judgement of each period, the oldest first; ``None`` where there was none."""
    found: list[Point | None] = [None] * columns
    for point in points:
        at = columns - 1 - int(max(frame.now - point.at, 0.0) / frame.period_s)
        if 0 <= at < columns:
            found[at] = point
    for number in range(1, columns):  # rounds and columns do not keep step
        before = found[number - 1]
        if (
            found[number] is None
            and before is not None
            and frame.now - before.at < (columns - 1 - number + GAP) * frame.period_s
        ):
            found[number] = before
    first = next((number for number, point in enumerate(found) if point is not None), columns)
    return found[first:]


def _bar(held: Sequence[Point | None], name: str, page: Page) -> str:
    """One block character per period."""
    styled = [_block(point, name) for point in held]
    runs = groupby(styled, key=itemgetter(1))
    return "".join(page.paint("".join(char for char, _ in run), style) for style, run in runs)


def _block(point: Point | None, name: str) -> Cell:
    value = None if point is None else point.totals.get(name)
    if point is None or value is None:
        return " ", ""
    level = min(int(max(value, 0.0) / TOP * len(LEVELS)), len(LEVELS) - 1)
    return LEVELS[level], "green" if point.owner == name else "dim"


def _streams(task: Json, frame: Frame) -> list[str]:
    """A line per stream: how fast, how much waits, what was lost."""
    page = _page(frame)
    prefix = f"{task['name']}/"
    for stream in task["streams"]:
        hz, speed, answer_s = (stream.get(name) for name in ("hz", "bytes_per_s", "answer_s"))
        told = [] if hz is None else [per_second(hz)]
        told += [] if speed is None else [f"{size(round(speed))}/s"]
        told += [f"{stream['in_flight']} in flight"] if stream.get("in_flight") else []
        told += [] if answer_s is None else [f"{millis(answer_s)} behind its input"]
        missed = missed_of(stream)
        told += [f"{missed} missed"] if missed else []
        ends = f"{stream.get('from_expr', '')} -> {stream.get('to_expr', '')}" if stream.get("from_expr") else ""
        name = stream["stream"].removeprefix(prefix)
        unknown = "rate not known" if stream["messages"] else "nothing yet"
        page.row(("", 1, ""), (name, 6, ""), (" · ".join(told) or unknown, 44, ""), (ends, frame.width, "dim"))
    return page.lines


# --- moves -----------------------------------------------------------------------------------------------------------


def _moves(past: Past, frame: Frame, *, is_whole: bool = False) -> list[str]:
    """A title and a line per move, the newest first; ``is_whole``: more lines where its reason needs them."""
    page = _page(frame)
    moves = [move for move in past.moves() if not move["is_known"]]
    if not moves:
        return []
    page.row(("MOVES", frame.width, "stage"))
    for move in reversed(moves):
        where = _way(move["from"] or "nobody", move["to"] or "nobody", WAY)
        took = "" if move["switched_s"] is None else f" ({millis(move['switched_s'])})"
        cells: list[Cell] = [(f"{span(move['age_s'])} ago", ""), (short_name(move["task"], 12), "bold"), (where, "")]
        reason = f"{move['reason']}{took}"
        first, *rest = textwrap.wrap(reason, frame.width - REASON) if is_whole and reason else [reason]
        widths = (-10, 12, WAY, frame.width)
        page.row(*((text, wide, style) for (text, style), wide in zip([*cells, (first, "dim")], widths, strict=True)))
        for more in rest:
            page.row((more, frame.width, "dim"), indent=REASON)
    return page.lines


def _way(left: str, to: str, room: int) -> str:
    """From whom to whom, both with their end where both have no room.

    >>> _way("edge1", "edge2", 20), _way("hall-north-edge1", "hall-north-edge2", 20)
    ('edge1 -> edge2', '…h-edge1 -> …h-edge2')
    """
    way, half = f"{left} -> {to}", (room - 4) // 2
    return way if len(way) <= room else f"{short_name(left, half)} -> {short_name(to, half)}"
