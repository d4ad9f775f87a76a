"""The one way in which a verb changes something: a plan, a question, an order, and a look until a condition holds.

A verb makes a `Plan` of what the daemon tells, `consent` shows it before and after and asks, the verb gives its order,
and `until` watches what comes of it. What was agreed is in the fleet's registers: the terminal may end at any moment.

Knows: rows, questions, dangers, deadlines, outcomes as exit codes; how the fleet's document is asked for, and another
one proposed. Does not know: any verb, what a change does to the fleet (`zsched.config.difference`), how it is agreed.
"""

from __future__ import annotations

import os
import pwd
import socket
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Final

from zsched.commands.base.ask import Door, ask_door, operator_at
from zsched.commands.base.common import (
    CliError,
    Json,
    check_reason,
    check_taken,
    confirm,
    print_json,
    say,
    told_task,
    warn,
)
from zsched.commands.base.page import Row, lined, span
from zsched.commands.base.report import millis
from zsched.core.values.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import MAX_FOR_S
from zsched.core.values.struct import Struct
from zsched.core.values.words import MAX_ASKER, shown
from zsched.host.clock import monotonic_s

UNKNOWING: Final = "it does not know the fleet's generation yet"
"""Of a node that tells no revision: its daemon has just begun."""
QUESTION: Json = {"verb": "fleet", "with_document": False}
"""What a node goes by, without its document."""
AT_ONCE = 8
"""Nodes asked at a time: one that is silent takes 3 s to be given up, and the socket has 16 places."""
IN_FORCE_S = 10.0
"""How long a change that is agreed is waited for at the node that was asked."""
OVERTAKEN_S = 5.0
"""For this long a document is asked for while the fleet changes its electors by itself."""
DOCUMENT = "the fleet's document"
HERE = ("alive", "suspect")
"""States of a node that is there."""
CODES = {
    "ok": EXIT_OK,
    "unchanged": EXIT_OK,
    "conflict": EXIT_FAILED,
    "no_quorum": EXIT_DEGRADED,
    "invalid": EXIT_FAILED,
    "unknown": EXIT_TIMED_OUT,
}
"""{what has become of an order: exit code}."""
TELL_S = 1.0
"""After this time it says what it waits for."""
FLEET_ADVICE: Final = {
    "conflict": "the fleet was changed meanwhile; look at it again with --plan",
    "no_quorum": "nothing was changed; `zsched fleet show` names the electors",
    "unknown": "it may or may not have been agreed: `zsched fleet show` tells the revision",
}


PAUSE_S: Final = 0.2
"""Between two looks at what has become of an order."""
ADVICE: Final = {
    "conflict": "look at `zsched status`, then try again",
    "no_quorum": "nothing was changed, and `zsched status` tells why",
    "unknown": "it may or may not have been agreed: `zsched status` shows which",
}
NOTHING: Final = "-"


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
    is_lines: bool = False
    """Its JSON is a line for each thing that happens."""
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


class Plan(Struct, frozen=True, kw_only=True):
    """What an order would change, before anything is done."""

    body: Json
    """The plan as the verb's JSON."""
    rows: Sequence[Row] = ()
    titles: Row = ("TASK", "WHAT", "NOW", "AFTER")
    text: str = ""
    """For people, in place of rows."""
    is_change: bool = True
    question: str = "Do it?"
    warning: str = ""
    """What is said in front of the question."""
    dangers: Sequence[tuple[str, str]] = ()
    """(name, what it means) of each that the operator must accept by its name."""
    can_ask: bool = True
    """Stdin is not the plan's own text."""


def consent(view: OrderView, plan: Plan) -> int | None:
    """Show a plan, and ask; the exit code where nothing is to be done now, else ``None``.

    Raises:
        CliError: a danger is not accepted, nobody can be asked (2), or the answer is no (1).
    """
    out = warn if view.is_data else say
    if view.is_json and view.is_plan:
        print_json(plan.body, is_line=view.is_lines)
    elif not view.is_json:
        if view.is_plan:
            for name, means in plan.dangers if not plan.text else ():
                out(f"{name}: {means}")
        for line in [plan.text] if plan.text else lined(plan.titles, plan.rows):
            out(line, indent=6 if plan.text else 2)
    if view.is_plan:
        return EXIT_WOULD_CHANGE if plan.is_change else EXIT_OK
    if not plan.is_change:
        if view.is_json:
            return None
        out("Nothing would change.")
        return EXIT_OK
    check_taken(plan.dangers, view.accepted)
    question = f"{plan.warning}{' ' if plan.warning else ''}{plan.question}"
    stream = sys.stderr if view.is_data else sys.stdout
    confirm(question, is_sure=view.is_yes, can_ask=plan.can_ask and not view.is_json, stream=stream)
    return None


class OverError(CliError):
    """What a command waits for cannot come any more: going on does not help."""


def until(look: Callable[[], Iterable[str]], timeout_s: float | None) -> list[str]:
    """Look again and again until nothing is missing, or the time is over; what is missing then.

    A node that does not answer is something missing. ``timeout_s``: ``None`` is for as long as it takes.

    Raises:
        OverError: of ``look``.
    """
    began = monotonic_s()
    while True:
        try:
            lacks = list(look())
        except OverError:
            raise
        except CliError as error:
            lacks = [str(error)]
        if not lacks or (timeout_s is not None and monotonic_s() - began >= timeout_s):
            return lacks
        time.sleep(PAUSE_S)


def check_revision(view: OrderView, held: InForce) -> None:
    """Refuse to change another revision than the one that the operator means (`CliError`)."""
    if view.revision is not None and view.revision != held.revision:
        raise CliError(EXIT_FAILED, f"revision {view.revision} is overtaken: {held.fleet} has revision {held.revision}")


def check_said(reason: str, for_s: float | None) -> None:
    """Refuse a reason or a duration that no order can carry.

    Raises:
        CliError: one is too long, or the reason is not one line.
    """
    check_reason(reason)
    if for_s is not None and not 1.0 <= for_s <= MAX_FOR_S:
        raise CliError(EXIT_USAGE, f"--for: {span(for_s)} is not from 1s to 366d")


# --- what came of it -------------------------------------------------------------------------------------------------


def statuses_of(door: Door, first: Json, also: Sequence[str] = ()) -> tuple[dict[str, Json], dict[str, str]]:
    """({node: its status}, {node: that it does not answer, and why}) of all robots, and of ``also``, that live.

    ``first`` is the status of the node at the door, which is the first of them.
    """
    alive = [one for one in first["nodes"] if one["state"] == "alive"]
    names = [str(one["name"]) for one in alive if one["kind"] == "robot" or one["name"] in also]
    found, silent = {str(first["node"]): first}, dict[str, str]()
    for name, answer in ask_all(door, [name for name in names if name not in found], {"verb": "status"}).items():
        if isinstance(answer, CliError):
            silent[name] = f"{name} does not answer: {answer}"
        else:
            found[name] = answer
    return found, silent


def counted_before(door: Door, first: Json, also: Sequence[str] = ()) -> dict[str, Json]:
    """The statuses before an order; it says of which nodes there is none, so what is lost there is not counted."""
    found, silent = statuses_of(door, first, also)
    if silent:
        warn(f"{', '.join(silent)}: no answer before the order, so what is lost there is not counted")
    return found


def lost_since(before: Mapping[str, Json], now: Mapping[str, Json], task: str) -> dict[str, int | None]:
    """What hops of a task's streams have lost and doubled meanwhile, over the nodes in both; ``None``: no node is."""
    nodes = [name for name in now if name in before]

    def counts(statuses: Mapping[str, Json], key: str) -> int:
        tasks = [told_task(statuses[node], task) for node in nodes]
        return sum(int(stream[key]) for one in tasks if one for stream in one["streams"])

    return {key: max(counts(now, key) - counts(before, key), 0) if nodes else None for key in ("lost", "doubled")}


def told_switch(switched_s: float | None, gap_s: float | None, losses: Mapping[str, int | None]) -> str:
    """What a handover took and lost, as the end of a line. What came twice was dropped, so nobody got it."""
    took = "" if switched_s is None else f", streams switched in {millis(switched_s)}"
    took += "" if gap_s is None else f", answers at most {millis(gap_s)} apart"
    return took + ("" if losses["lost"] is None else f", lost {losses['lost']}")


def agreed(task: str, result: Json) -> Json:
    """The result of an order that was agreed, or changes nothing.

    Raises:
        CliError: it was not agreed.
    """
    if result["outcome"] in ("ok", "unchanged"):
        return result
    raise refused(task, result)


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


# --- the fleet's document ---------------------------------------------------------------------------------------------


class ConflictError(CliError):
    """The fleet's value had changed meanwhile."""


class InForce(Struct, frozen=True, kw_only=True):
    """What one node goes by."""

    node: str
    """Who tells it."""
    fleet: str
    revision: int
    number: int
    is_settled: bool
    electors: tuple[tuple[str, str], ...]
    """(name, id of its disk; empty: not known)."""
    document: str
    """Hash of the document; empty: none is agreed, and each node goes by its own fleet file."""
    text: str
    """Of the document; empty while none is agreed, or while this node is still fetching it."""
    flags: tuple[Json, ...] = ()
    """What operators have said of nodes: a document that takes this one's place keeps them."""
    rollouts: tuple[Json, ...] = ()
    """Changed workers that wait for a look: kept alike."""


def in_force(door: Door) -> InForce:
    """What the node at the door goes by.

    Raises:
        CliError: nobody answers, or the node knows no fleet value yet.
    """
    told = ask_door(door, {"verb": "fleet"})
    if told["revision"] is None:
        advice = "wait until it hears an elector; `zsched status` shows which are away"
        raise CliError(EXIT_DEGRADED, f"{told['node']} does not know the fleet's generation yet; {advice}")
    return InForce(
        node=str(told["node"]),
        fleet=str(told["fleet"]),
        revision=int(told["revision"]),
        number=int(told["number"]),
        is_settled=bool(told["settled"]),
        electors=tuple((str(one["name"]), str(one["disk"])) for one in told["electors"]),
        document=str(told["document"]),
        text=str(told["text"]),
        flags=tuple(told["flags"]),
        rollouts=tuple(told.get("rollouts", ())),  # a daemon of an older program tells none
    )


def document_text(held: InForce) -> str:
    """The text of the document in force.

    Raises:
        CliError: none is agreed, or this node has not fetched it yet.
    """
    if not held.document:
        advice = "agree one: zsched apply FILE, the one by which the fleet runs (`zsched dev` has none to keep)"
        raise CliError(EXIT_FAILED, f"{held.fleet} goes by the file on each machine, and has no document yet; {advice}")
    if not held.text:
        advice = "ask another node with --node, or again in a moment"
        raise CliError(EXIT_FAILED, f"{held.node} has not fetched document {held.document[:12]} yet; {advice}")
    return held.text


def fleet_of(text: str, file: str = DOCUMENT, folder: Path | None = None) -> Fleet:
    """The fleet of a document in force; ``folder``: beside which files are looked for, else beside ``file``.

    Raises:
        CliError: it has faults for this version.
    """
    from zsched.config.load import check_bytes  # noqa: PLC0415 - ruamel.yaml is slow to import

    fleet = check_bytes(text.encode(), file, folder).fleet
    if fleet is None:
        advice = "update zsched here; `zsched fleet export` shows the document"
        raise CliError(EXIT_FAILED, f"the document in force has faults for this version of zsched; {advice}")
    return fleet


def status_of(door: Door) -> Json:
    """The status of the node at the door.

    Raises:
        CliError: nobody answers.
    """
    return ask_door(door, {"verb": "status"})


def ask_all(door: Door, names: Sequence[str], request: Json) -> dict[str, Json | CliError]:
    """{node: its answer, or why there is none} of every node in ``names``."""
    with ThreadPoolExecutor(AT_ONCE) as errands:
        return dict(zip(names, errands.map(partial(_ask, door, request), names), strict=True))


def _ask(door: Door, request: Json, name: str) -> Json | CliError:
    try:
        return ask_door(door.to(name), request)
    except CliError as error:
        return error


def ordered(what: str, asked: Json) -> Json:
    """What a change is for, who orders it, and why, as `change` takes it."""
    return {"reason": what, "by": asked["by"], "why": asked["reason"]}


def change(door: Door, what: Json) -> Json:
    """Propose a change of the fleet, and return what became of it.

    Raises:
        ConflictError: the fleet is at another revision than the change's base.
        CliError: nobody answers, or the change did not come about (1, 4, 5).
    """
    answer = ask_door(door, {"verb": "change", **what})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    if outcome in ("ok", "unchanged"):
        return answer
    kind = ConflictError if outcome == "conflict" else CliError
    raise kind(CODES.get(outcome, EXIT_FAILED), told_refusal(outcome, detail, FLEET_ADVICE))


def told_refusal(outcome: str, detail: str, advice: Mapping[str, str]) -> str:
    """Why an order did not come about; a lack of votes is told by its detail alone: who did not answer."""
    word = "" if outcome == "no_quorum" else f"{outcome}: "
    return "; ".join(filter(None, (f"{word}{detail}", advice.get(outcome))))


def change_over(door: Door, what: Json, held: InForce) -> Json:
    """As `change`, of what was in force when it was looked at.

    A fleet also changes its electors by itself, several times in a row while it grows. That is no reason to refuse
    another document: it is asked for again on the newest revision, for `OVERTAKEN_S`, as long as the document and the
    orders are those that were looked at.

    Raises:
        ConflictError: somebody else was first, or the fleet does not come to rest.
        CliError: as of `change`.
    """
    base, end = held.revision, monotonic_s() + OVERTAKEN_S
    while True:
        try:
            return change(door, {**what, "base_revision": base})
        except ConflictError:
            now = in_force(door)
            is_same = (now.document, now.flags, now.rollouts) == (held.document, held.flags, held.rollouts)
            if not is_same or monotonic_s() > end:
                raise
        if now.revision == base:
            time.sleep(PAUSE_S)  # the node has yet to learn what came first
        base = now.revision


def wait_until_settled(door: Door, revision: int) -> InForce:
    """Wait until the node at the door knows a settled value of at least ``revision``, and has its document.

    Raises:
        CliError: it does not in time, or does not answer (5); the change is agreed all the same.
    """
    began, is_told, found = monotonic_s(), False, list[InForce]()

    def look() -> list[str]:
        nonlocal is_told
        if not is_told and monotonic_s() > began + TELL_S:
            is_told = True
            warn(f"revision {revision} is agreed, and is being settled; Ctrl-C takes nothing back")
        held = in_force(door)
        if held.revision >= revision and held.is_settled and (held.text or not held.document):
            found.append(held)
            return []
        why = "has not fetched its document" if held.is_settled else f"number {held.number} is not settled"
        return [f"{held.node} {why} yet"]

    for lack in until(look, IN_FORCE_S):
        raise CliError(EXIT_TIMED_OUT, f"revision {revision} is agreed, but {lack}; see `zsched fleet show`")
    return found[0]
