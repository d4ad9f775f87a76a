"""`zsched history` and `zsched events`: what daemons have written into their decision logs.

Knows: pages of a log, ages, text, the schemas ``zsched.history/1`` and ``zsched.event/1``. Does not know: files.

Times are by the wall clock of the node that wrote them. Ages are from the same clock, so the two always fit together.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Container, Iterable, Iterator
from datetime import UTC, datetime
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import Away, CliError, Json, check_known, nearest, print_json, say
from zsched.commands.base.options import AgeOption, Answers, Local
from zsched.commands.base.page import duration_s, span
from zsched.commands.base.report import millis
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.struct import Struct
from zsched.core.values.words import shown

SCHEMA = "zsched.history/1"
FOLLOW_S = 0.5
AGE_COLUMNS: Final = 12
"""Of a move's line: what does not fit goes on behind them."""
MOVE: Final = "move"
STAGES: Final = ("scheduler", "vote", "executor", "route", "membership", "log")
"""As a line names what has told it (`zsched.core.values.instructions.RecordStory`)."""
TYPES: Final = (MOVE, *STAGES)
TOLD: Final = ("moves", "rehearsals", "rollouts", "changes")
"""What a history has, beside whose log it is."""


def subject_of(word: str) -> tuple[str | None, str | None]:
    """The (task, node) of ``task/NAME`` or ``node/NAME``; the one that is not meant is ``None``.

    Raises:
        CliError: it is another word.
    """
    kind, _, name = word.partition("/")
    if kind not in ("task", "node") or not name:
        raise CliError(EXIT_USAGE, f"--about {word}: expected task/NAME or node/NAME")
    return (name, None) if kind == "task" else (None, name)


def types_of(text: str) -> tuple[str, ...]:
    """The types of events that a list of words names.

    >>> types_of("move,vote")
    ('move', 'vote')

    Raises:
        CliError: a word is no type.
    """
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    for word in words:
        if word not in TYPES:
            raise CliError(EXIT_USAGE, f"--types: no event is of type {word!r}{nearest(word, TYPES)}")
    return words


class Past(Struct, frozen=True, kw_only=True):
    """Which part of a history is asked for."""

    task: str | None = None
    about: str | None = None
    """Only moves to this node or away from it."""
    since_s: float | None = None
    """None that are older."""

    @property
    def words(self) -> str:
        """What is asked for, behind "no move and no order"."""
        whose = (f" of {self.task}" if self.task else "") + (f" to {self.about} or away from it" if self.about else "")
        return whose + ("" if self.since_s is None else f" of the last {span(self.since_s)}")

    def read(self, door: Door) -> Json:
        """What the log of the node at the door tells of it: ``node``, and each of `TOLD`.

        Raises:
            CliError: nobody answers, or the log cannot be read.
        """
        node, now, entries, _ = read_log(door, is_moves=True)
        entries = [entry for entry in entries if self.since_s is None or entry["at"] >= now - self.since_s]
        moves = [move for move in moves_of(entries, now, self.task) if self.about in (None, move["from"], move["to"])]
        rehearsals = list(rehearsals_of(entries, now, self.task)) if self.about is None else []
        rollouts = list(rollouts_of(entries, now, self.task)) if self.about is None else []
        others = [entry for entry in entries if self.about is None or names(entry, self.about)]
        changes = list(changes_of(others, now, self.task))
        return {"node": node, "moves": moves, "rehearsals": rehearsals, "rollouts": rollouts, "changes": changes}


def history(
    asked: Answers,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="Only what was done to it.")] = None,
    about: Annotated[
        str | None,
        typer.Option(
            "--about", metavar="node/NAME", help="Only moves to this node or away from it, and orders that name it."
        ),
    ] = None,
    since: AgeOption = None,
    site: Annotated[bool, typer.Option("--site", help="Of every fleet of the site, merged by age.")] = False,
) -> int:
    """Show every change of owner in a node's decision log: when, from where to where, why, and who voted for it.

    Example: zsched history map_merge --since 1d

    It also tells what operators have changed, with their names.

    With --site one node of each fleet of the site is asked. A fleet that does not answer is named, and the others are
    shown; exits with 3 when none answers.
    """
    of_task, of_node = (None, None) if about is None else subject_of(about)
    if task is not None and of_task not in (None, task):
        raise CliError(EXIT_USAGE, f"{task} and --about {about} are two tasks; name one")
    past = Past(task=task or of_task, about=of_node, since_s=None if since is None else duration_s(since))
    if site:
        return _show_site(asked, past)
    door = asked.door()
    told = past.read(door)
    if not any(told[key] for key in TOLD):
        _check_names(door, past)
    if asked.json_:
        print_json({"schema": SCHEMA, **told})
        return EXIT_OK
    lines = lines_of(told)
    if not lines:
        say(f"no move and no order{past.words} in the log of {told['node']}")
    print_lines(lines)
    return EXIT_OK


def _show_site(asked: Answers, past: Past) -> int:
    """Print the moves of all cells by their age, the newest last, and who is silent; returns the exit code.

    Each cell's moves are told by one of its nodes, with ages by that node's clock: no two clocks are compared.
    """
    from zsched.commands.look.cells import alone, ask_site  # noqa: PLC0415 - only a site has them

    fleet, cells = ask_site(asked, past.read, {"node": None, **{key: [] for key in TOLD}})
    silent = [cell for cell in cells if cell["error"] is not None]
    heard = [cell for cell in cells if cell["error"] is None]
    if asked.json_:
        merged = {key: [{**one, "cell": cell["name"]} for cell in cells for one in cell[key]] for key in TOLD}
        ordered = {key: sorted(found, key=lambda one: -float(one["age_s"])) for key, found in merged.items()}
        told = [{key: cell[key] for key in ("name", "node", "error")} for cell in cells]
        first = next((cell["node"] for cell in heard), "")
        print_json({"schema": SCHEMA, "node": first, **ordered, "cells": told})
    else:
        width = max(len(cell["name"]) for cell in cells)
        lines = [line for cell in cells for line in lines_of(cell, f"{cell['name']:<{width}}  ")]
        print_lines(lines)
        if not lines and heard:
            say(f"no move and no order{past.words} in {', '.join(cell['name'] for cell in heard)}")
        said = [f"  {cell['name']}: {cell['error']}" for cell in silent]
        for line in (*(("PROBLEMS", *said) if said else ()), *alone(fleet)):
            say(line, indent=4)
    return EXIT_OK if heard else EXIT_UNREACHABLE


def _check_names(door: Door, past: Past) -> None:
    """Refuse a task or a node of which nothing is told, and which the fleet has not (2); one that is gone has a past.

    Raises:
        CliError: there is none of that name, or nobody answers.
    """
    if past.task is not None or past.about is not None:
        status = ask_door(door, {"verb": "status"})
        check_known(status, "task", past.task)
        check_known(status, "node", past.about)


def lines_of(told: Json, before: str = "") -> list[tuple[float, str]]:
    """(age, text behind ``before``) of all that a log has told."""
    lines = [(move["age_s"], f"{before}{_move_line(move)}") for move in told["moves"]]
    others = (*told["rehearsals"], *told["rollouts"], *told["changes"])
    return [*lines, *((one["age_s"], f"{before}{_told_line(one)}") for one in others)]


def print_lines(lines: Iterable[tuple[float, str]]) -> None:
    """Print them, the newest last."""
    for _, text in sorted(lines, key=lambda line: -line[0]):
        say(text, indent=AGE_COLUMNS)


def read_log(door: Door, *, is_moves: bool, cursor: str = "") -> tuple[str, float, list[Json], str]:
    """(node, its wall clock, entries, where they end) from ``cursor`` to the end of the log.

    Another machine tells its moves only.

    Raises:
        CliError: nobody answers, the log cannot be read there, or another machine is asked for more than its moves.
    """
    is_far = door.node is not None or bool(door.endpoint)
    if is_far and not is_moves:
        instead = f"--about node/{door.node} shows what this machine's log tells of it"
        raise CliError(EXIT_USAGE, f"the log of {door.node} lies on its machine: ask there; {instead}")
    found: list[Json] = []
    while True:
        answer = ask_door(door, {"verb": "history" if is_far else "log", "moves": is_moves, "cursor": cursor})
        if "entries" not in answer:
            raise CliError(EXIT_FAILED, str(answer.get("detail", "no history came")))
        found += answer["entries"]
        if door.cell is not None:
            door = door.to(str(answer["node"]))  # the cursor is a place in its log only
        cursor = str(answer["cursor"])
        if not answer["more"]:
            return str(answer["node"]), float(answer["now"]), found, cursor


# --- moves -----------------------------------------------------------------------------------------------------------


def moves_of(entries: Iterable[Json], now: float, task: str | None) -> Iterator[Json]:
    """The changes of owner among a log's entries, as ``zsched.history/1`` has them; ``now``: the node's wall clock."""
    entries = list(entries)
    took = {(entry["task"], entry["epoch"], entry["life"]): entry["took_s"] for entry in entries if "took_s" in entry}
    gaps: dict[tuple[str, int], float] = {}
    for entry in entries:
        if "gap_s" in entry:
            key = (entry["task"], entry["epoch"])
            gaps[key] = max(entry["gap_s"], gaps.get(key, 0.0))
    for entry in entries:
        move = entry.get("move")
        if move is None or task not in (None, entry["task"]):
            continue
        yield {
            **when_of(entry, now),
            "task": entry["task"],
            "epoch": move["epoch"],
            "revision": move["revision"],
            "from": move["left"],
            "to": move["owner"],
            "is_known": is_known(move),
            "reason": move["reason"],
            "votes": dict(move.get("votes", ())),
            "switched_s": took.get((entry["task"], move["epoch"], entry["life"])),
            "gap_s": gaps.get((entry["task"], move["epoch"])),
            "by": entry.get("by") or None,
        }


def when_of(entry: Json, now: float) -> Json:
    """When a line of a log was written, by the wall clock there, and how long ago."""
    return {"at": wall_text(entry["at"]), "age_s": max(now - entry["at"], 0.0)}


def is_known(move: Json) -> bool:
    """Whether no owner changed: the daemon had begun anew, and found the task where it was."""
    return bool(move.get("is_known"))


def where_of(move: Json) -> str:
    """From whom to whom, of a move as ``zsched.history/1`` has it; one that is only known came from nobody."""
    to = str(move["to"] or "nobody")
    return to if move["is_known"] else f"{move['from'] or 'nobody'} -> {to}"


def rehearsals_of(entries: Iterable[Json], now: float, task: str | None) -> Iterator[Json]:
    """The rehearsals among a log's entries."""
    for entry in entries:
        if entry.get("rehearsal") and task in (None, entry["task"]):
            told = {"task": entry["task"], "rehearsal": entry["rehearsal"], "text": entry["text"]}
            yield {**when_of(entry, now), **told}


def rollouts_of(entries: Iterable[Json], now: float, task: str | None) -> Iterator[Json]:
    """What was said of changed workers that wait for a look, among a log's entries."""
    for entry in entries:
        if entry.get("is_rollout") and task in (None, entry["task"]):
            told = {"task": entry["task"], "text": entry["text"]}
            yield {**when_of(entry, now), **told}


def changes_of(entries: Iterable[Json], now: float, task: str | None) -> Iterator[Json]:
    """What operators have changed beside moves and rehearsals, among a log's entries."""
    for entry in entries:
        if not entry.get("by") or "move" in entry or entry.get("rehearsal"):
            continue
        about = entry.get("task") or None
        if task in (None, about):
            told = {"task": about, "by": entry["by"], "text": entry["text"]}
            yield {**when_of(entry, now), **told}


def _told_line(one: Json) -> str:
    about = f"{one['task']} " if one["task"] else ""
    return f"{span(one['age_s']):>6} ago  {one['at']}  {about}{one['text']}"


def _move_line(move: Json) -> str:
    camps: dict[str, list[str]] = {}
    for voter, choice in move["votes"].items():
        camps.setdefault(choice, []).append(voter)
    votes = "; ".join(f"{', '.join(voters)} for {choice}" for choice, voters in camps.items())
    switched = "" if move["switched_s"] is None else f", streams switched in {millis(move['switched_s'])}"
    switched += "" if move["gap_s"] is None else f", answers {millis(move['gap_s'])} apart"
    head = f"{span(move['age_s']):>6} ago  {move['at']}  {move['task']} epoch {shown(move['epoch'])}  {where_of(move)}"
    return f"{head}: {move['reason']}{f' ({votes})' if votes else ''}{switched}"


# --- events ----------------------------------------------------------------------------------------------------------


def events(
    asked: Local,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until Ctrl-C.")] = False,
    since: AgeOption = None,
    about: Annotated[
        str | None, typer.Option("--about", metavar="task/NAME", help="Or node/NAME: only what is about it.")
    ] = None,
    types: Annotated[
        str | None, typer.Option("--types", metavar="A,B", help="Only moves, or stages: move, vote, executor, ...")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="One JSON object per line.")] = False,
) -> int:
    """Show what the decision log tells: judgements that changed, votes, moves, steps of handovers, workers, peers.

    Example: zsched events -f --types move,vote
    """
    of_task, of_node = (None, None) if about is None else subject_of(about)
    of_types, since_s = () if types is None else types_of(types), None if since is None else duration_s(since)
    door, away = asked.door(), Away("events", "until Ctrl-C")
    _, now, entries, cursor = read_log(door, is_moves=False)
    entries = [entry for entry in entries if since_s is None or entry["at"] >= now - since_s]
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            for entry in entries:
                is_about = of_task in (None, entry.get("task", "")) and (of_node is None or names(entry, of_node))
                if is_about and (not of_types or _is_of(entry, of_types)):
                    _print(entry, is_json=json_)
            if not follow:
                break
            time.sleep(FOLLOW_S)
            entries = []
            try:
                _, _, entries, cursor = read_log(door, is_moves=False, cursor=cursor)
            except CliError as error:
                if error.code != EXIT_UNREACHABLE:
                    raise
                away.tell(str(error))
            else:
                away.tell("")
    return EXIT_OK


def _print(entry: Json, *, is_json: bool) -> None:
    if is_json:
        print_json({**entry, "at": wall_text(entry["at"])}, is_line=True)
        return
    where = f"task={entry['task']} epoch={shown(entry.get('epoch', 0))} " if entry.get("task") else ""
    say(f"{wall_text(entry['at'])} {entry['stage']:<10} {where}{entry['text']}", indent=4)


def _is_of(entry: Json, types: Container[str]) -> bool:
    return entry["stage"] in types or (MOVE in types and is_move(entry))


def is_move(entry: Json) -> bool:
    """Whether a line of the log tells of a change of owner."""
    move = entry.get("move")
    return move is not None and not is_known(move)


def names(entry: Json, node: str) -> bool:
    """Whether a line tells of this node: its move comes or leaves there, or its text has the name as a whole word."""
    move = entry.get("move") or {}
    word = rf"(?<![a-z0-9_-]){re.escape(node)}(?![a-z0-9_-])"
    return node in (move.get("left"), move.get("owner")) or re.search(word, str(entry.get("text", ""))) is not None


def wall_text(at: float) -> str:
    """RFC 3339 in UTC, to the millisecond."""
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
