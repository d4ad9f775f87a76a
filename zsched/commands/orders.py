"""What all orders share: who gives one, how it is shown before and after, its outcome as an exit code.

Knows: rows, questions, codes. Does not know: any order (`zsched.commands.move`, `hold`, `tune` and others), how a
change is agreed.
"""

from __future__ import annotations

import os
import pwd
import socket
import sys
from collections.abc import Mapping, Sequence
from typing import Final

from zsched.commands.ask import Door, operator_at
from zsched.commands.common import CliError, Json, again, check_reason, nearest, print_json, say, says_yes, warn
from zsched.commands.document import CODES, ask_all, told_refusal
from zsched.commands.page import span
from zsched.core.values.model import MAX_FOR_S
from zsched.core.values.struct import Struct
from zsched.core.values.words import MAX_ASKER, shown
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE

PAUSE_S: Final = 0.2
"""Between two looks at what has become of an order."""
ADVICE: Final = {
    "conflict": "look at `zsched status`, then try again",
    "no_quorum": "nothing was changed, and `zsched status` tells why",
    "unknown": "it may or may not have been agreed: `zsched status` shows which",
}
NOTHING: Final = "-"
Row = tuple[str, str, str, str]
"""(task, what, before, after)."""


class OrderView(Struct, frozen=True, kw_only=True):
    """Which daemon to ask, and what the operator has said beside the order itself."""

    door: Door
    is_json: bool = False
    is_yes: bool = False
    is_plan: bool = False
    reason: str = ""
    revision: int | None = None
    """The only one that may be changed; ``None``: whichever is in force."""
    for_s: float | None = None
    accepted: tuple[str, ...] = ()
    """Names of dangers."""
    words: tuple[str, ...] = ()
    """Of a change of the document: the verb with its arguments, for the fleet's history."""
    is_data: bool = False
    """Stdout is for something else: messages go to stderr."""
    pause_after: int | None = None
    """The number of candidates of each task that run a changed worker while the others wait; ``None``: none waits."""

    @property
    def asked(self) -> Json:
        """Who gives the order, as a request carries it."""
        return {"by": asker(self.door), "reason": self.reason}


def asker(door: Door) -> str:
    """Who runs this program, as orders carry it: the name in an operator's certificate, or else user@node.

    In another cell it is user@fleet/node.
    """
    if operator := operator_at(door):
        return operator  # nodes would write it in place of any other name
    place = door.asked_from or door.socket.stem or socket.gethostname()  # no daemon of this machine is asked
    return f"{user_name()}@{place}"[:MAX_ASKER]


def user_name(env: Mapping[str, str] = os.environ) -> str:
    """The user that runs this program; under sudo the caller.

    >>> user_name({"SUDO_USER": "ada"}) if os.getuid() == 0 else "ada"
    'ada'
    """
    uid = os.getuid()
    if uid == 0 and env.get("SUDO_USER"):
        return env["SUDO_USER"]
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def check_said(view: OrderView) -> None:
    """Refuse a reason or a duration that no order can carry.

    Raises:
        CliError: one is too long, or the reason is not one line.
    """
    check_reason(view.reason)
    if view.for_s is not None and not 1.0 <= view.for_s <= MAX_FOR_S:
        raise CliError(EXIT_USAGE, f"--for: {span(view.for_s)} is not from 1s to 366d")


def statuses_of(door: Door, first: Json, names: Sequence[str]) -> tuple[dict[str, Json], dict[str, str]]:
    """({node: its status}, {node: that it does not answer, and why}) of the nodes in ``names``.

    ``first`` is the status of the node at the door.
    """
    answers = ask_all(door, [name for name in names if name != first["node"]], {"verb": "status"})
    found: dict[str, Json] = {}
    silent: dict[str, str] = {}
    for name in names:
        answer = answers.get(name, first)
        if isinstance(answer, CliError):
            silent[name] = f"{name} does not answer: {answer}"
        else:
            found[name] = answer
    return found, silent


def tell_uncounted(silent: Mapping[str, str]) -> None:
    """Say that nodes had no figures before the order: so nobody takes what is told afterwards for all of it."""
    if silent:
        warn(f"{', '.join(silent)}: no answer before the order, so what is lost there is not counted")


def lost_since(before: Mapping[str, Json], now: Mapping[str, Json], task: str) -> dict[str, int | None]:
    """What hops of a task's streams have lost and doubled meanwhile, over the nodes in both; ``None``: no node is."""
    nodes = [name for name in now if name in before]
    both = [_counts([status[name] for name in nodes], task) for status in (before, now)]
    return {key: max(both[1][key] - both[0][key], 0) if nodes else None for key in both[0]}


def _counts(statuses: Sequence[Json], name: str) -> dict[str, int]:
    tasks = [task for status in statuses for task in status["tasks"] if task["name"] == name]
    streams = [stream for task in tasks for stream in task["streams"]]
    return {key: sum(int(stream[key]) for stream in streams) for key in ("lost", "doubled")}


def told_losses(losses: Mapping[str, int | None]) -> str:
    """What was lost, as the end of a line; empty: nobody has counted. What came twice was dropped, so nobody got it."""
    return "" if losses["lost"] is None else f", lost {losses['lost']}"


def check_name(status: Json, kind: str, name: str, known: Sequence[str]) -> None:
    """Refuse a name that the fleet has not (`CliError`), with the nearest one."""
    if name not in known:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no {kind} {name!r}{nearest(name, known)}")


def begin(
    view: OrderView,
    rows: Sequence[Row],
    plan: Json,
    *,
    is_change: bool,
    warning: str = "",
    titles: Row = ("TASK", "WHAT", "NOW", "AFTER"),
    is_line: bool = False,
) -> int | None:
    """Show before and after (``plan``, as JSON), and ask; the exit code when nothing is to be done now, else ``None``.

    Raises:
        CliError: off a terminal, without --yes.
    """
    if not view.is_json:
        show_rows(titles, rows)
    if view.is_plan:
        if view.is_json:
            print_json(plan, is_line=is_line)
        return EXIT_WOULD_CHANGE if is_change else EXIT_OK
    if not is_change:
        if not view.is_json:
            say("Nothing would change.")
            return EXIT_OK
        return None
    check_can_ask(view)
    if view.is_yes:
        return None
    if not says_yes(f"{warning}{' ' if warning else ''}Do it?", sys.stdout):
        say("Nothing was done.")
        return EXIT_FAILED
    return None


def check_can_ask(view: OrderView, told: str = "") -> None:
    """Refuse where nobody can be asked and nobody has said --yes; ``told``: what there is to say beside that.

    Raises:
        CliError: off a terminal, or with JSON.
    """
    if view.is_yes or (sys.stdin.isatty() and not view.is_json):
        return
    raise CliError(EXIT_USAGE, f"{told}nothing was done, for nobody can be asked here; to do it:\n{again('--yes')}")


def show_rows(titles: Row, rows: Sequence[Row]) -> None:
    """Print a table, nothing if it has no row."""
    if not rows:
        return
    shown = [titles, *rows]
    widths = [max(len(row[column]) for row in shown) for column in range(len(titles))]
    for row in shown:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        say("  ".join(cells).rstrip())


def refused(task: str, result: Json) -> CliError:
    """The error that tells of an order that was not agreed."""
    outcome, detail = str(result["outcome"]), str(result["detail"]).removeprefix(f"{task}: ")
    return CliError(CODES.get(outcome, EXIT_FAILED), f"{task}: {told_refusal(outcome, detail, ADVICE)}")


def tell_results(results: Mapping[str, Json]) -> int:
    """Print what became of each; the worst exit code.

    Raises:
        CliError: the only order was not agreed.
    """
    codes = [EXIT_OK]
    for name, result in results.items():
        code = CODES.get(str(result["outcome"]), EXIT_FAILED)
        codes.append(code)
        if code != EXIT_OK and len(results) == 1:
            raise refused(name, result)
        word = "agreed" if result["outcome"] == "ok" else str(refused(name, result)).removeprefix(f"{name}: ")
        revision = result["revision"]  # none is told of an order of which nobody knows what has become
        say(f"{name}: {word}{'' if revision is None else f' (revision {shown(revision)})'}")
    return max(codes)
