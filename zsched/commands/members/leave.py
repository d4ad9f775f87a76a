"""`zsched leave`: this machine hands over what it does, gives its seat up, goes out of the document, and stops.

Knows: the order of these steps, what must be true before the next one, what is said. Does not know: which elector goes
when (`zsched.core.electorate.pilot`), how a node is emptied (`zsched.commands.act.flags`), which files a machine keeps
(`zsched.commands.members.belongings`).

Each step is agreed before the next one begins, so the command can be broken off and given again at any point.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.act.flags import (
    LEAVE,
    NO_OTHER,
    TITLES,
    DrainOrder,
    check_in_force,
    drain_nodes,
    has_flag,
    told_over,
)
from zsched.commands.base.ask import Door, ask_door, find_door
from zsched.commands.base.change import (
    DOCUMENT,
    HERE,
    NOTHING,
    QUESTION,
    UNKNOWING,
    InForce,
    OrderView,
    OverError,
    Plan,
    ask_all,
    change,
    check_said,
    consent,
    document_text,
    fleet_of,
    in_force,
    ordered,
    until,
)
from zsched.commands.base.common import CliError, Json, again, check_dangers, check_taken, say, warn
from zsched.commands.base.options import (
    AcceptOption,
    Files,
    JsonOption,
    PlanOption,
    ReasonOption,
    RuntimeOption,
    YesOption,
)
from zsched.commands.base.page import Row, duration_s, lined, span
from zsched.commands.base.places import Places
from zsched.commands.base.renewing import HOLDS_AUTHORITY, authority_here, bring_advice, left_behind
from zsched.commands.members.belongings import (
    Written,
    belongings,
    check_ended,
    is_out,
    note_out,
    put_away,
    whose,
)
from zsched.commands.members.membership import Told
from zsched.config.difference import names_electors
from zsched.config.editing import remove_node
from zsched.config.load import check_bytes
from zsched.core.electorate.pilot import may_go
from zsched.core.values.codec import from_plain
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import AdapterError, ConfigError
from zsched.core.values.exits import (
    EXIT_FAILED,
    EXIT_OK,
    EXIT_TIMED_OUT,
    EXIT_UNREACHABLE,
    EXIT_USAGE,
    EXIT_WOULD_CHANGE,
)
from zsched.core.values.problems import Problem, of_kind
from zsched.core.values.struct import Struct, replace
from zsched.host import paths
from zsched.host.clock import monotonic_s

LAST: Final = "last-node"
"""The danger: the fleet has no other node, and ends."""
NOT_TOLD: Final = "not-told"
"""The danger: the others cannot be told, and count this node until somebody has them forget it."""
DANGERS: Final = (NO_OTHER, LAST, NOT_TOLD, HOLDS_AUTHORITY)
STOP_S: Final = 20.0
"""How long a daemon may take to end: it hands over, and stops its workers and its relay."""
LEARN_S: Final = 10.0
"""How long the other nodes may take to learn that this one is gone."""


class Way(Struct, frozen=True, kw_only=True):
    """One node on its way out, and what the operator has said."""

    places: Places
    is_purged: bool
    deadline_s: float
    view: OrderView
    """Without a door until the daemon is found."""
    fleet: str
    me: str
    began: float
    files: tuple[Written, ...]
    """Of this machine, with what becomes of them."""

    @property
    def door(self) -> Door:
        """To its daemon."""
        return self.view.door

    def tell(self, text: str) -> None:
        """A step that is done, for people; programs read the events and the end."""
        if not self.view.is_json:
            say(text)

    def until(self, look: Callable[[], Iterable[str]], still: str = "") -> None:
        """Wait until nothing is missing; ``still``: in front of what is.

        Raises:
            OverError: the leave was taken back.
            CliError: the deadline has come (5).
        """
        left_s = self.deadline_s - (monotonic_s() - self.began)
        for lack in until(look, left_s)[:1]:
            advice = f"give `{again()}` again to go on, or take it back: zsched undrain {self.me}"
            took = span(monotonic_s() - self.began)
            raise CliError(EXIT_TIMED_OUT, f"{self.me} has not left after {took}: {still}{lack}; {advice}")


def leave(
    here: Files,
    purge: Annotated[
        bool,
        typer.Option("--purge", help="Delete this machine's files of the fleet, its key too; else they are renamed."),
    ] = False,
    deadline: Annotated[
        str, typer.Option("--deadline", metavar="DURATION", help="How long to wait in all: 90s, 10m, 2h.")
    ] = "10m",
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    runtime_dir: RuntimeOption = None,
) -> int:
    """Take this machine out of its fleet: its tasks move away, its seat among the electors too, and its daemon ends.

    Example: sudo zsched leave

    Nothing of the others' streams is lost; in a secured fleet they pause while the daemons begin again. Exits with 5 at
    the deadline: the leave stays in force, and the same command goes on with it; `zsched undrain NODE` takes it back.
    Another machine is taken out by `zsched node forget`.
    """
    accepted = tuple(accept or ())
    check_dangers(accepted, DANGERS)
    check_said(reason, None)
    view = OrderView(
        door=Door(socket=Path()),
        is_json=json_,
        is_yes=yes,
        is_plan=plan,
        reason=reason,
        accepted=accepted,
        is_lines=True,
    )
    places = here.places()
    fleet, me = whose(places.state)
    way = Way(
        places=places,
        is_purged=purge,
        deadline_s=duration_s(deadline),
        view=view,
        fleet=fleet,
        me=me,
        began=monotonic_s(),
        files=belongings(places, is_purged=purge),
    )
    try:
        door = own_door(runtime_dir, me)
        status = ask_door(door, {"verb": "status"})
    except CliError as error:
        if error.code != EXIT_UNREACHABLE:
            raise
        return _without_daemon(way, error)
    if (status["fleet"], status["node"]) != (fleet, me):
        other = f"{status['node']} of fleet {status['fleet']}"
        raise CliError(EXIT_USAGE, f"the daemon here is {other}, and {places.state} is {me}'s; give --state-dir")
    way = replace(way, view=replace(view, door=door))
    code = _take_leave(way, status)
    if code != EXIT_OK:
        return code
    stop_daemon(way, f"{me} has left {fleet}")
    return _end(way, is_last=[str(one["name"]) for one in status["nodes"]] == [me])


def _without_daemon(way: Way, error: CliError) -> int:
    """Put the files away where no daemon runs, which the others may not know; the exit code."""
    rows: tuple[Row, ...] = ()
    if not is_out(way.fleet, way.me, way.places.state):
        told = f"{error}. The others are not told: `zsched node forget {way.me}` tells them"
        accept_all(way, (NOT_TOLD, told), *authority_danger(way))
        rows = ((way.me, "member", way.fleet, NOTHING),)
    else:
        way.tell(f"{way.me} is no node of {way.fleet} any more, and its daemon has ended")
        _warn(way, authority_danger(way))  # it has happened: there is nothing to accept
    code = _asked(way, rows)
    return _end(way) if code is None else code


def own_door(runtime_dir: Path | None, me: str) -> Door:
    """To the daemon of this machine.

    Raises:
        CliError: it does not run (3).
    """
    door = find_door(runtime_dir, me)
    if door.node is not None:
        raise CliError(EXIT_UNREACHABLE, f"no daemon of {me} runs on this machine")
    return door


def _asked(way: Way, rows: tuple[Row, ...]) -> int | None:
    """Show what becomes of this machine, and ask, where no drain does so; the exit code when nothing is to be done now.

    ``rows``: what is lost beside the files.

    Raises:
        CliError: off a terminal, without --yes.
    """
    if way.view.is_plan:
        for line in lined(TITLES, rows) if not way.view.is_json else ():
            say(line)
        return _planned(way)
    return consent(way.view, Plan(rows=(*rows, *map(_file_row, way.files)), body={}, titles=TITLES))


def _file_row(one: Written) -> Row:
    what, _, fate = one.what.rpartition(", ")
    return str(one.path), "file", what, fate


def accept_all(way: Way, *dangers: tuple[str, str]) -> None:
    """Go on only if each danger is accepted by its name; each is a name and what it means.

    Raises:
        CliError: one is not.
    """
    if not way.view.is_plan:
        check_taken(dangers, way.view.accepted)
    _warn(way, dangers)


def _warn(way: Way, dangers: tuple[tuple[str, str], ...]) -> None:
    if not way.view.is_json:
        for name, means in dangers:
            warn(f"{name}: {means}")


def authority_danger(way: Way, text: str = "") -> tuple[tuple[str, str], ...]:
    """The danger that nobody renews the certificates of a fleet that goes on; empty: there is none.

    ``text``: its document.
    """
    folder = authority_here(way.fleet, way.places.config, text)
    return () if folder is None else ((HOLDS_AUTHORITY, left_behind(folder, way.fleet)),)


# --- while the daemon runs -------------------------------------------------------------------------------------------


def _take_leave(way: Way, status: Json) -> int:
    """Have the fleet agree, step by step; the exit code."""
    me = way.me
    if of_kind(status, Problem.TAKEN_OUT):  # the others may not answer it any more
        way.tell(f"{me} is no node of {status['fleet']} any more: it was taken out")
        return _go_alone(way, int(status["fleet_revision"]) + 1)
    held = _newest(way, status)
    members = members_of(held, status)
    danger = _danger(way, status, held, members)
    if danger is not None:
        more = () if danger[0] == LAST else authority_danger(way, held.text)
        accept_all(way, danger, *more)
        return _go_alone(way, None)
    if me not in members:
        way.tell(f"{me} is no node of {held.fleet} since revision {held.revision}")
        return _go_alone(way, held.revision)
    without(document_text(held), me)  # its faults come before anything is done
    accept_all(way, *authority_danger(way, held.text))
    rows: tuple[Row, ...] = ((me, "member", held.fleet, "-"),)
    if any(name == me for name, _ in held.electors):
        rows = (*rows, (me, "elector", ", ".join(name for name, _ in held.electors), others_of(held, me)))
    drained = DrainOrder(nodes=(me,), kind=LEAVE, deadline_s=way.deadline_s, more_rows=rows)
    ours = tuple(name for name in way.view.accepted if name == NO_OTHER)
    code = drain_nodes(replace(way.view, accepted=ours), drained, status)
    if way.view.is_plan and code == EXIT_WOULD_CHANGE:
        return _planned(way)
    if way.view.is_plan or code != EXIT_OK:
        return EXIT_WOULD_CHANGE if way.view.is_plan and code == EXIT_OK else code
    _note(way, _go_out(way, give_up_the_seat(way)))
    return EXIT_OK


def _go_alone(way: Way, out: int | None) -> int:
    """Where the others agree nothing: ask, and note that they are without this node; the exit code.

    ``out``: the revision from which on they are; ``None``: they are not.
    """
    me = way.me
    if out is not None:
        _warn(way, authority_danger(way))
    rows: tuple[Row, ...] = () if out is not None else ((me, "member", way.fleet, NOTHING),)
    code = _asked(way, (*rows, (me, "daemon", "runs", "ended")))
    if code is None and out is not None:
        _note(way, out)
    return EXIT_OK if code is None else code


def _note(way: Way, revision: int) -> None:
    """Keep that the fleet is without this node, so that the command goes on when it is broken off after the daemon."""
    with contextlib.suppress(AdapterError):  # a full disk keeps nobody from leaving
        note_out(way.fleet, way.me, revision, way.places.state)


def others_of(held: InForce, me: str) -> str:
    """The electors without this node, in words."""
    return ", ".join(name for name, _ in held.electors if name != me) or "another node"


def _newest(way: Way, status: Json) -> InForce:
    """The newest document that some node of the fleet has: this one may have been taken out of it."""
    held = in_force(way.door)
    if held.text:
        return held
    names = [str(one["name"]) for one in status["nodes"] if one["name"] != way.me and one["state"] in HERE]
    answers = ask_all(way.door, names, QUESTION).items()
    for name, answer in answers:
        if not isinstance(answer, CliError) and answer.get("revision") is not None:
            there = in_force(way.door.to(name))
            if there.revision >= held.revision and there.text:
                return there
    return held


def members_of(held: InForce, status: Json) -> tuple[str, ...]:
    """The nodes of the document, or of the file by which each machine goes."""
    if not held.document:
        return tuple(str(node["name"]) for node in status["nodes"])
    return _nodes_of(document_text(held))


def _nodes_of(text: str) -> tuple[str, ...]:
    return tuple(node.name for node in fleet_of(text).nodes)


def _danger(way: Way, status: Json, held: InForce, members: tuple[str, ...]) -> tuple[str, str] | None:
    """(name, what it means) of what keeps the fleet from agreeing; ``None``: it can."""
    me, quorum = way.me, status["quorum"]
    if members == (me,):
        return LAST, f"{me} is the only node of {held.fleet}, which ends with it"
    if me not in members:
        return None
    if not held.document:
        told = f"{held.fleet} goes by the file on each machine: take {me} out of it there, or agree a document first"
        return NOT_TOLD, f"{told} (zsched apply {way.places.config})"
    if not quorum["ok"]:
        told = f"{quorum['alive']} of {quorum['electors']} electors can answer, {quorum['needed']} needed"
        return NOT_TOLD, f"{told}. The others are not told: `zsched node forget {me}` tells them"
    return None


def without(text: str, me: str) -> str:
    """The document without this node.

    Raises:
        ConfigError: it would have faults.
    """
    shorter = remove_node(text, me)
    result = check_bytes(shorter.encode(), f"{DOCUMENT} without {me}")
    if result.fleet is None:
        raise ConfigError(f"nothing was changed: {result.report()}\nchange it first: zsched edit")
    return shorter


def give_up_the_seat(way: Way) -> int:
    """Wait until this node knows that the electors have settled without it (rule of `may_go`); its revision then.

    By itself an elector that leaves is removed; one that the operator has named is removed by this command.

    Raises:
        CliError: the leave was taken back, or the deadline has come (5).
    """
    told = ""
    since = 0

    def look() -> list[str]:
        nonlocal told, since
        answer = ask_door(way.door, {"verb": "fleet"})
        why = UNKNOWING
        if answer["revision"] is not None:  # else its daemon has begun anew
            value = from_plain(answer["value"], FleetValue)
            held = check_in_force(way.door, LEAVE, way.me)
            since = held.revision
            if may_go(value, way.me):
                if told:
                    way.tell(f"{way.me}: no elector any more; electors: {', '.join(value.electorate.names)}")
                return []
            why = _ask_for_the_seat(way, held)  # on the revision at which the leave is in force
        if why != told:
            told = why
            way.tell(f"{way.me} is an elector still: {why}")
        return [why]

    way.until(look, "it is an elector still: ")
    return since


def _ask_for_the_seat(way: Way, held: InForce) -> str:
    """Why the seat is not given up yet."""
    if not held.is_settled:
        return f"number {held.number} is being settled"
    if not held.text or not names_electors(held.text):
        return str(ask_door(way.door, {"verb": "status"})["quorum"].get("pilot") or "the electors are about to change")
    try:
        change(way.door, {"remove_elector": way.me, "base_revision": held.revision, **_ordered(way)})
    except CliError as error:
        return str(error)
    return "it is removed"


def _go_out(way: Way, since: int) -> int:
    """Have this node taken out of the document, and wait until the others know; the revision without it.

    One of them proposes it: this node would not store a document that does not name it.
    ``since``: a revision that has the leave.

    Raises:
        CliError: the leave was taken back, or the deadline has come (5).
    """
    turns, revision = itertools.count(), 0

    def look() -> list[str]:
        nonlocal revision
        others = _alive(way)
        held = in_force(way.door.to(others[next(turns) % len(others)]) if others else way.door)
        revision = _left_out(way, held, since)
        return []

    way.until(look)
    way.tell(f"{way.fleet}: revision {revision} is agreed, and {way.me} is no node of it")
    _wait_until_known(way, revision)
    return revision


def _left_out(way: Way, held: InForce, since: int) -> int:
    """Have the node that told ``held`` propose it without this one; the revision that is without it.

    It may be so already: the answer of the try before was lost, or somebody else was first.

    Raises:
        OverError: the leave was taken back.
        CliError: it is not agreed, or that node is behind.
    """
    text = document_text(held)
    if way.me not in _nodes_of(text):
        return held.revision
    if not has_flag(held, LEAVE, way.me):
        if held.revision >= since:
            raise OverError(EXIT_FAILED, told_over(LEAVE, [way.me]))
        raise CliError(EXIT_FAILED, f"{held.node} does not know yet that {way.me} leaves")
    flags = [flag for flag in held.flags if flag["subject"] != way.me]
    what = {"text": without(text, way.me), "flags": flags, "rollouts": list(held.rollouts)}
    answer = change(way.door.to(held.node), {**what, "base_revision": held.revision, **_ordered(way)})
    return int(answer["revision"])


def _alive(way: Way) -> list[str]:
    """The other nodes that are alive, electors first."""
    status = ask_door(way.door, {"verb": "status"})
    electors = status["quorum"]["names"]
    names = [str(one["name"]) for one in status["nodes"] if one["name"] != way.me and one["state"] == "alive"]
    return sorted(names, key=lambda name: name not in electors)


def _wait_until_known(way: Way, revision: int) -> None:
    """Wait until the others have that document; a node that does not in time learns it from them."""
    waiting = _alive(way)

    def look() -> list[str]:
        nonlocal waiting
        answers = ask_all(way.door, waiting, {"verb": "fleet"})
        waiting = [name for name, answer in answers.items() if not _knows(answer, revision)]
        return waiting

    if until(look, LEARN_S):
        warn(f"{', '.join(waiting)}: not heard yet that {way.me} has left; the others tell")


def _knows(answer: Json | CliError, revision: int) -> bool:
    """Whether a node goes by a value of at least this revision, and has its document."""
    if isinstance(answer, CliError) or answer.get("revision") is None:
        return False
    return int(answer["revision"]) >= revision and bool(answer["text"])


def _ordered(way: Way) -> Json:
    return ordered("leave", way.view.asked)


# --- the end ---------------------------------------------------------------------------------------------------------


def stop_daemon(way: Way, done: str) -> None:
    """End the daemon, and wait until it has given its state folder back; ``done``: what has been done so far.

    Raises:
        CliError: it does not end.
    """
    ask_door(way.door, {"verb": "leave"})

    def look() -> list[str]:
        try:
            check_ended(way.fleet, way.me, way.places)
        except AdapterError as error:
            return [str(error)]
        return []

    for lack in until(look, STOP_S):
        advice = f"stop it, then give `{again()}` again"
        raise CliError(EXIT_TIMED_OUT, f"{done}, and its daemon does not end: {lack}; {advice}")
    way.tell(f"{way.me}: the daemon has ended")


def _end(way: Way, *, is_last: bool = False) -> int:
    """Put the files away; ``is_last``: the fleet had no other node."""
    fleet, me = way.fleet, way.me
    folder = None if is_last else authority_here(fleet, way.places.config)
    done = put_away(fleet, me, way.places, is_purged=way.is_purged)
    back = f"it comes back by `zsched invite {me}` on another node"
    if is_last:
        back = f"{fleet} has no node any more; `zsched fleet create NAME` makes a new fleet"
    service = "sudo systemctl disable zsched: it would find no fleet at the next boot"
    advice = (
        *((service,) if way.places.config == paths.SYSTEM_CONFIG else ()),
        *(() if folder is None else (bring_advice(folder, fleet),)),
        back,
    )
    told = Told(fleet=fleet, node=me, outcome="left", said=f"{me} has left {fleet}", files=done, next=advice)
    return told.tell(is_json=way.view.is_json, is_line=True)


def _planned(way: Way) -> int:
    said = f"{way.me} would leave {way.fleet}"
    told = Told(fleet=way.fleet, node=way.me, outcome="planned", said=said, files=way.files)
    return told.tell(is_json=way.view.is_json, is_line=True)
