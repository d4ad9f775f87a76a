"""`zsched logs`: what a task's worker has printed lately, wherever it runs, and what it prints now.

Knows: which node is meant, how lines are followed. Does not know: how they are kept.
"""

from __future__ import annotations

import contextlib
import re
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import Away, CliError, Json, check_known, nearest, print_json, warn
from zsched.commands.base.options import Answers, TaskArgument
from zsched.commands.base.page import clock_time
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s, wall_ns

SCHEMA: Final = "zsched.logs/1"
PAUSE_S: Final = 0.5
OWNER_S: Final = 2.0
"""How often is looked whether the followed task has another owner."""
LAG_S: Final = 1.0
"""A move is known here a little later than at the new owner, which has printed something by then."""
LEVELS: Final = ("debug", "info", "warning", "error", "critical")
_SAME: Final = {"warn": "warning", "fatal": "critical"}
_LOOKED_AT: Final = 200
"""Characters of a line in which a level is looked for; behind them is what the line is about."""
_WORD: Final = re.compile(r"\b(DEBUG|INFO|WARN|WARNING|ERROR|CRITICAL|FATAL)\b")
_FIELD: Final = re.compile(r"""["']?\b(?:level|levelname|severity)["']?\s*[=:]\s*["']?(\w+)""", re.IGNORECASE)


def level_of(text: str) -> str:
    """The level that a line tells of itself, as Python, ROS, and JSON or logfmt loggers write it; empty: none.

    >>> level_of("2026-11-24 12:00:00 WARNING camera lost"), level_of('{"level": "error", "msg": "no map"}')
    ('warning', 'error')
    >>> level_of("[FATAL] [node]: out of memory"), level_of("Traceback (most recent call last):"), level_of("ready")
    ('critical', 'error', '')
    """
    head = text[:_LOOKED_AT]
    if head.startswith("Traceback (most recent call last)"):
        return "error"
    field, word = _FIELD.search(head), _WORD.search(head)
    found = next((one[1].lower() for one in (field, word) if one is not None), "")
    found = _SAME.get(found, found)
    return found if found in LEVELS else ""


class Sieve:
    """Lines of at least a level; a line that tells none goes with the one before, and with none before it is shown."""

    def __init__(self, least: str | None) -> None:
        self._least = 0 if least is None else LEVELS.index(least)
        self._is_shown = True

    def of(self, lines: Iterable[Json]) -> list[Json]:
        """Those that are shown."""
        return [line for line in lines if self._passes(str(line["text"]))]

    def _passes(self, text: str) -> bool:
        level = level_of(text)
        if level:
            self._is_shown = LEVELS.index(level) >= self._least
        return self._is_shown


class LogsView(Struct, frozen=True, kw_only=True):
    """Which daemon to ask, and how to show the answer."""

    door: Door
    is_json: bool
    is_followed: bool
    most: int
    level: str | None = None
    """Only lines of at least this level."""


@dataclass(slots=True)
class _Reading:
    """How far a follower has come."""

    node: str
    after: int
    is_owner: bool
    """The owner is followed, not a node that was named."""


def show_logs(view: LogsView, task: str, whose: str | None) -> int:
    """Print the newest lines, and with ``is_followed`` those that come, until Ctrl-C; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or node, or no worker's output there.
    """
    if view.level is not None and view.level not in LEVELS:
        raise CliError(EXIT_USAGE, f"--level: there is no level {view.level!r}{nearest(view.level, LEVELS)}")
    sieve = Sieve(view.level)
    door = view.door
    node = worker_node(ask_door(door, {"verb": "status"}), task, whose)
    asked = door.to(node)
    kept, after = _all_lines(asked, task, 0)
    lines = sieve.of(kept)
    _print(view, node, task, lines[len(lines) - min(view.most, len(lines)) :])
    if not lines:
        least = "" if view.level is None else f" at {view.level} or above"
        since = "since the daemon there started"
        if kept and kept[0]["number"] > 1:
            since = f"in the {len(kept)} lines that its daemon keeps; older ones are in the journal there"
        warn(f"the worker of {task} on {node} has printed nothing{least} {since}")
    if view.is_followed:
        with contextlib.suppress(KeyboardInterrupt):
            _follow(view, door, task, _Reading(node=node, after=after, is_owner=whose is None), sieve)
    return EXIT_OK


def _follow(view: LogsView, door: Door, task: str, reading: _Reading, sieve: Sieve) -> None:
    """Print what comes; with `_Reading.is_owner` of the task's owner, whichever node that is by then."""
    away, looked_s = Away("logs", "until Ctrl-C"), monotonic_s()
    while True:
        time.sleep(PAUSE_S)
        now = monotonic_s()
        try:
            if reading.is_owner and now - looked_s >= OWNER_S:
                since_s, looked_s = looked_s, now
                _change_over(view, door, task, reading, sieve, now - since_s + LAG_S)
            lines, reading.after = _all_lines(door.to(reading.node), task, reading.after)
        except CliError as error:
            away.tell(str(error))
            continue
        away.tell("")
        _print(view, reading.node, task, sieve.of(lines))


def _change_over(view: LogsView, door: Door, task: str, reading: _Reading, sieve: Sieve, age_s: float) -> None:
    """Go on at the owner, if that is another node by now, with its lines that are no older than ``age_s``.

    Raises:
        CliError: who is asked does not answer, or the task has left the fleet.
    """
    tasks = {str(known["name"]): known for known in ask_door(door, {"verb": "status"})["tasks"]}
    owner = tasks[task]["owner"] if task in tasks else None
    if owner is None or owner == reading.node:
        return
    with contextlib.suppress(CliError):  # it may be gone
        _print(view, reading.node, task, sieve.of(_all_lines(door.to(reading.node), task, reading.after)[0]))
    warn(f"{task} is on {owner} now; `zsched logs {task} {reading.node}` has what {reading.node} printed")
    reading.node, reading.after = str(owner), 0
    lines, reading.after = _all_lines(door.to(reading.node), task, 0)
    _print(view, reading.node, task, sieve.of([line for line in lines if line["age_s"] <= age_s]))


def worker_node(status: Json, task: str, whose: str | None) -> str:
    """The node whose worker is meant: the one that is named, else the owner.

    Raises:
        CliError: there is no such task or node, or nobody owns the task and no node is named.
    """
    tasks = {str(known["name"]): known for known in status["tasks"]}
    check_known(status, "task", task)
    check_known(status, "node", whose)
    node = whose or tasks[task]["owner"]
    if node is None:
        able = ", ".join(tasks[task]["candidates"])
        raise CliError(EXIT_FAILED, f"{task} has no owner; name a node, there are {able}")
    return str(node)


def _all_lines(door: Door, task: str, after: int) -> tuple[list[Json], int]:
    """Every line behind number ``after``, and the number of the newest."""
    found: list[Json] = []
    while True:
        answer = ask_door(door, {"verb": "lines", "task": task, "after": after})
        if not answer["is_here"]:
            raise CliError(
                EXIT_FAILED,
                f"{answer['node']} starts no worker of {task}: it is no candidate, or the task has no `command`; "
                "who starts it has its output",
            )
        newest: int = answer["newest"]
        if newest < after:  # another daemon, which counts from 1
            found, after = [], 0
            continue
        found += answer["lines"]
        after = found[-1]["number"] if answer["lines"] else newest
        if after >= newest:
            return found, after


def _print(view: LogsView, node: str, task: str, lines: list[Json]) -> None:
    now = wall_ns() / 1e9
    for line in lines:
        if view.is_json:
            print_json({"schema": SCHEMA, "node": node, "task": task, **line}, is_line=True)
        else:
            sys.stdout.write(f"{clock_time(now - line['age_s'], now)} {line['text']}\n")
    sys.stdout.flush()


def logs(
    asked: Answers,
    task: TaskArgument,
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Also what it prints from now on.")] = False,
    lines: Annotated[int, typer.Option("--lines", min=0, max=400, metavar="N", help="The newest N.")] = 100,
    level: Annotated[
        str | None, typer.Option("--level", metavar="LEVEL", help="At least: debug, info, warning, error, critical.")
    ] = None,
) -> int:
    """Show what a task's worker has printed lately, on whichever node it runs.

    Example: zsched logs map_merge -f --level warning

    A daemon keeps the last 400 lines of each of its workers since its own start; that machine's journal has older ones.
    """
    view = LogsView(door=asked.door(), is_json=asked.json_, is_followed=follow, most=lines, level=level)
    return show_logs(view, task, whose)
