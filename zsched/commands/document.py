"""The fleet's document, as a node tells it: asks for it, proposes another one, and waits until it is in force.

Knows: the questions of the operator socket, what each outcome means for the exit code. Does not know: what a change
does to the fleet (`zsched.config.difference`), how it is agreed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, warn
from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import Struct
from zsched.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT

UNKNOWING = "it does not know the fleet's generation yet"
"""Of a node that tells no revision: its daemon has just begun."""
QUESTION: Json = {"verb": "fleet", "with_document": False}
"""What a node goes by, without its document."""
AT_ONCE = 8
"""Nodes asked at a time: one that is silent takes 3 s to be given up, and the socket has 16 places."""
PAUSE_S = 0.1
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
ADVICE = {
    "conflict": "the fleet was changed meanwhile; look at it again with --plan",
    "no_quorum": "nothing was changed; `zsched fleet show` names the electors",
    "unknown": "it may or may not have been agreed: `zsched fleet show` tells the revision",
}


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
    raise kind(CODES.get(outcome, EXIT_FAILED), told_refusal(outcome, detail, ADVICE))


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
    base, until = held.revision, monotonic_s() + OVERTAKEN_S
    while True:
        try:
            return change(door, {**what, "base_revision": base})
        except ConflictError:
            now = in_force(door)
            is_same = (now.document, now.flags, now.rollouts) == (held.document, held.flags, held.rollouts)
            if not is_same or monotonic_s() > until:
                raise
        if now.revision == base:
            time.sleep(PAUSE_S)  # the node has yet to learn what came first
        base = now.revision


def wait_until_settled(door: Door, revision: int) -> InForce:
    """Wait until the node at the door knows a settled value of at least ``revision``, and has its document.

    Raises:
        CliError: it does not in time, or does not answer (5); the change is agreed all the same.
    """
    start = monotonic_s()
    is_told = False
    while True:
        try:
            held = in_force(door)
        except CliError as error:
            lack = str(error)
        else:
            if held.revision >= revision and held.is_settled and (held.text or not held.document):
                return held
            why = "has not fetched its document" if held.is_settled else f"number {held.number} is not settled"
            lack = f"{held.node} {why} yet"
        if not is_told and monotonic_s() > start + TELL_S:
            is_told = True
            warn(f"revision {revision} is agreed, and is being settled; Ctrl-C takes nothing back")
        if monotonic_s() > start + IN_FORCE_S:
            raise CliError(EXIT_TIMED_OUT, f"revision {revision} is agreed, but {lack}; see `zsched fleet show`")
        time.sleep(PAUSE_S)
