"""`zsched leave --to`: this machine leaves its fleet for another one of the site, and is ready there in the end.

Knows: the order of the steps, how each is seen to be done, what is said. Does not know: how a node is emptied and gives
its seat up (`zsched.commands.leave`), which files a machine keeps (`zsched.runtime.membership`, `next_cell`).

Both cells name the node from the first step to the last, so there is a way back until the next cell has taken it. Which
step is done is asked of both: the command can be broken off at any point, and given again.
"""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path
from typing import Final

from zsched import paths
from zsched.clock import monotonic_s
from zsched.commands.apply import OPEN_NETWORK
from zsched.commands.ask import Door, ask_door, door_of, fleet_here
from zsched.commands.common import CliError, Json, check_dangers, check_reason, nearest, warn
from zsched.commands.document import (
    ConflictError,
    InForce,
    ask_all,
    change,
    change_over,
    document_text,
    in_force,
    ordered,
    status_of,
    wait_until_settled,
)
from zsched.commands.entries import HERE
from zsched.commands.flags import LEAVE, NO_OTHER, DrainOrder, check_drain, check_in_force, drain, undrain
from zsched.commands.lacks import UselessError, wait_for
from zsched.commands.leave import (
    DANGERS,
    LeaveOrder,
    Way,
    accept,
    authority_danger,
    give_up_the_seat,
    members_of,
    others_of,
    own_door,
    stop_daemon,
    view_of,
    without,
)
from zsched.commands.membership import (
    Guest,
    Told,
    dial_order,
    fleet_of,
    how_to_start,
    invitation_for,
    protocol_of,
    read_invitation,
)
from zsched.commands.orders import OrderView, Row, begin
from zsched.commands.papers import refuse_open_network
from zsched.commands.renewing import authority_here, bring_advice
from zsched.config.editing import add_entries, add_names, is_list, node_entry
from zsched.config.load import check_bytes
from zsched.config.security import ENCRYPTED
from zsched.core.values.fleet import Cell, Fleet, dial_endpoint
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.errors import AdapterError, ConfigError
from zsched.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_UNREACHABLE, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.runtime import next_cell
from zsched.runtime.membership import belongings, papers_problem, whose
from zsched.runtime.next_cell import Change
from zsched.wire.invitation import Invitation

INVITE: Final = ".invite"
"""The end of an invitation's name, as the advice writes it."""
REACH_S: Final = 60.0
"""How long the next cell is asked by the node's new certificate: its daemons begin again in turns to let it in."""
TAKE_S: Final = 60.0
"""How long the next cell may take to count the node, once its daemon runs there; then it goes back."""
SYSTEMD: Final = Path("/run/systemd/system")
"""Where systemd runs."""


class _Next(Struct, frozen=True, kw_only=True):
    """The cell that is to take this machine."""

    fleet: str
    door: Door | None = None
    """To one of its gateways; ``None``: there is an invitation, which is all that is needed."""
    held: InForce | None = None
    invitation: Invitation | None = None
    is_invited: bool = False
    """Whether its document names this node."""


def change_cells(order: LeaveOrder, word: str) -> int:
    """Take this machine from its fleet into another one; the exit code.

    Args:
        order: what the operator has said.
        word: a cell of the site, or the file of an invitation into one.

    Raises:
        CliError: it was not agreed to, a step was not agreed, the next cell did not take it, or the deadline has come.
        ConfigError: a document would have faults, or cannot be used here.
        AdapterError: this machine is in no fleet, or a file cannot be read or written.
    """
    check_dangers(order.accepted, (*DANGERS, OPEN_NETWORK))
    check_reason(order.reason)
    going = next_cell.under_way(order.places.state)
    if going is not None and not _runs_in(order, going.former):
        return _resumed(order, going, word)
    fleet, me = whose(order.places.state)
    if word == fleet and going is not None:
        return _taken_back(order, me, going.invitation.fleet)
    if word == fleet:
        said = f"{order.places.state}: this machine is {me} of fleet {fleet} already: nothing to do"
        Told(fleet=fleet, node=me, outcome="unchanged", said=said).tell(is_json=order.is_json)
        return EXIT_OK
    door = own_door(order, me)
    status = ask_door(door, {"verb": "status"})
    if (status["fleet"], status["node"]) != (fleet, me):
        other = f"{status['node']} of fleet {status['fleet']}"
        raise CliError(EXIT_USAGE, f"the daemon here is {other}, and {order.places.state} is {me}'s; give --state-dir")
    view = view_of(order, door)
    files = belongings(order.places, is_purged=False)
    way = Way(order=order, view=view, me=me, began=monotonic_s(), files=files)
    there = _found(way, fleet, word, going)
    code = _agreed(way, status, there)
    if code is not None:
        return code
    going = _invited(way, there, going)
    _wait_for_the_next(way, going)
    code = _drained(way)
    if code != EXIT_OK:
        return code
    give_up_the_seat(way)
    _wait_for_the_next(way, going)
    check_in_force(way.door, LEAVE, me)
    stop_daemon(way, fleet, f"{me} has handed over what it does")
    return _arrive(way, going)


# --- what is where ---------------------------------------------------------------------------------------------------


def _runs_in(order: LeaveOrder, fleet: str) -> bool:
    """Whether the daemon of this machine runs, and goes by that fleet."""
    with contextlib.suppress(CliError, AdapterError):
        name, me = whose(order.places.state)
        return name == fleet and ask_door(own_door(order, me), {"verb": "status"})["fleet"] == fleet
    return False


def _taken_back(order: LeaveOrder, me: NodeId, fleet: str) -> int:
    """End a change that has not gone further than the former cell's flag."""
    door = own_door(order, me)
    view = view_of(order, door)
    code = undrain(view, [me])
    if code == EXIT_OK and not order.is_plan:
        next_cell.end(order.places.state)
        warn(f"{fleet} names {me} until somebody there says: zsched node forget {me}")
    return code


def _resumed(order: LeaveOrder, going: Change, word: str) -> int:
    """Go on with a change after the former cell's daemon has ended here: to the next cell, or back."""
    fleet, me = going.invitation.fleet, going.invitation.node
    way = Way(
        order=order,
        view=OrderView(door=Door(socket=Path()), is_json=order.is_json, is_yes=order.is_yes, reason=order.reason),
        me=me,
        began=monotonic_s(),
        files=(),
    )
    is_back = word == going.former
    if word not in (going.former, fleet):
        under_way = f"{me} is on its way from {going.former} to {fleet}: name one of them"
        if not Path(word).is_file():
            raise CliError(EXIT_USAGE, under_way)
        given = read_invitation(word)
        if (given.fleet, given.node) != (fleet, me):
            raise CliError(EXIT_USAGE, f"{word} invites {given.node} into fleet {given.fleet}, and {under_way}")
    if not is_back and next_cell.has_seat(order.places.state, going.former, me):
        start = "; ".join(how_to_start(me, order.places))
        told = f"{me} is an elector of {going.former} still, and its daemon does not run"
        raise CliError(EXIT_UNREACHABLE, f"{told}: {start}; then give `{order.verb}` again")
    rows: tuple[Row, ...] = ((me, "member", f"between {going.former} and {fleet}", going.former if is_back else fleet),)
    view = OrderView(door=way.door, is_json=order.is_json, is_yes=order.is_yes, is_plan=order.is_plan)
    code = begin(view, rows, _planned(going.former, me), is_change=True)
    if code is not None:
        return code
    return _go_back(way, going, "as you said") if is_back else _arrive(way, going)


def _planned(fleet: str, me: NodeId) -> Json:
    return {"schema": "zsched.member/1", "fleet": fleet, "node": me, "outcome": "planned", "files": [], "next": []}


def _found(way: Way, fleet: str, word: str, going: Change | None) -> _Next:
    """The cell that a word names, as it is now.

    Raises:
        CliError: there is none, it does not answer, another machine has the name there, or the file is for another.
    """
    me = way.me
    here = fleet_here(way.door, way.order.places.config)
    cell = next((one for one in here.cells if one.name == word), None)
    is_closed = cell is None or any(gateway.startswith(ENCRYPTED) for gateway in cell.gateways)
    if is_closed and going is not None and going.invitation.fleet == word:
        return _Next(fleet=word, invitation=going.invitation, is_invited=True)
    if cell is None:
        if not Path(word).exists():
            if "/" in word or word.endswith(INVITE):
                raise CliError(EXIT_USAGE, f"--to: there is no file {word}; give the invitation's path")
            known = [one.name for one in here.cells]
            hint = nearest(word, known) if known else f"; fleet {fleet} names no cell under `site:`"
            raise CliError(EXIT_USAGE, f"--to: {word!r} is no cell of the site, and no invitation{hint}")
        invitation = read_invitation(word)
        if invitation.node != me or invitation.fleet == fleet:
            told = f"{word} invites {invitation.node} into fleet {invitation.fleet}"
            raise CliError(EXIT_USAGE, f"{told}, and this machine is {me} of {fleet}: zsched invite {me} in the other")
        papers = invitation.papers
        if fleet_of(invitation.document.text).security is not None and (papers is None or not papers.key):
            raise CliError(
                EXIT_FAILED, f"{word} holds no certificate with its key; {_invite(way.order, invitation.fleet, me)}"
            )
        if why := papers_problem(invitation):
            raise CliError(EXIT_FAILED, f"{word}: its {why}; {_invite(way.order, invitation.fleet, me)}")
        return _Next(fleet=invitation.fleet, invitation=invitation, is_invited=True)
    if is_closed:
        told = f"{cell.name} is secured, and takes {me} by an invitation"
        raise CliError(EXIT_FAILED, f"{told}; {_invite(way.order, cell.name, me)}")
    door = door_of(cell, fleet, way.door)
    status = status_of(door)
    state = next((str(one["state"]) for one in status["nodes"] if one["name"] == me), None)
    if state in HERE:
        raise CliError(EXIT_FAILED, _taken(cell.name, me, state))
    if not status["quorum"]["ok"]:
        raise CliError(EXIT_FAILED, f"nothing was changed: {cell.name} has no quorum, and can take nobody now")
    held = in_force(door)
    document_text(held)
    is_invited = state is not None
    kept = going.invitation if is_invited and going is not None and going.invitation.fleet == cell.name else None
    return _Next(fleet=cell.name, door=door, held=held, invitation=kept, is_invited=is_invited)


def _invite(order: LeaveOrder, fleet: str, me: NodeId) -> str:
    file = f"{me}{INVITE}"
    again = f"sudo {order.leaving_for(file)}"
    return f"where {fleet}'s authority is: zsched invite {me} > {file}; then here: {again}"


def _agreed(way: Way, status: Json, there: _Next) -> int | None:
    """Show what follows, and ask; the exit code when nothing is to be done now, else ``None``."""
    order, me = way.order, way.me
    held = in_force(way.door)
    members = members_of(held, status)
    why = _why_not(held, status, members, me)
    if why:
        raise CliError(EXIT_FAILED, f"nothing was changed: {why}")
    without(document_text(held), me)  # its faults come before anything is done
    if there.held is not None and not there.is_invited:
        _text_with(way, there.held)
    accept(order, *authority_danger(order, held.fleet, held.text))
    rows: tuple[Row, ...] = ((me, "member", held.fleet, there.fleet),)
    if not there.is_invited:
        rows = (*rows, (me, f"invited by {there.fleet}", "-", "yes"))
    if any(name == me for name, _ in held.electors):
        rows = (*rows, (me, "elector", ", ".join(name for name, _ in held.electors), others_of(held, me)))
    if not order.is_json or order.is_plan:
        shown = Way(order=order, view=_planning(way.view), me=me, began=way.began, files=way.files)
        drain(shown.view, _order_of(way, more_rows=rows))
    if order.is_plan:
        said = f"{me} would leave {held.fleet}, and join {there.fleet}"
        told = Told(fleet=there.fleet, node=me, outcome="planned", said=said, files=way.files)
        told.tell(is_json=order.is_json, is_line=True)
        return EXIT_WOULD_CHANGE
    check_drain(way.view, _order_of(way))
    return begin(way.view, (), {}, is_change=True)


def _why_not(held: InForce, status: Json, members: tuple[str, ...], me: NodeId) -> str:
    """What keeps this machine's fleet from letting it go; empty: nothing."""
    quorum = status["quorum"]
    if members == (me,):
        return f"{me} is the only node of {held.fleet}, which would end; `zsched leave`, then `zsched join` there"
    if not held.document:
        return f"{held.fleet} goes by the file on each machine; agree a document first: zsched apply FILE"
    if me not in members:
        return f"{held.fleet} names {me} no more; `zsched leave`, then `zsched join` there"
    if not quorum["ok"]:
        return (
            f"{quorum['alive']} of {quorum['electors']} electors of {held.fleet} can answer, {quorum['needed']} needed"
        )
    return ""


def _drained(way: Way) -> int:
    """Have the flag agreed, and wait until this machine is empty.

    Of electors that come first a drain takes care itself. What an operator has changed meanwhile is looked at once: two
    machines may leave at the same time.
    """
    order = _order_of(way, is_shown=True)
    try:
        return drain(way.view, order)
    except ConflictError:
        return drain(way.view, order)


def _planning(view: OrderView) -> OrderView:
    return OrderView(door=view.door, is_json=view.is_json, is_plan=True, reason=view.reason)


def _order_of(way: Way, *, is_shown: bool = False, more_rows: tuple[Row, ...] = ()) -> DrainOrder:
    return DrainOrder(
        nodes=(way.me,),
        kind=LEAVE,
        deadline_s=way.order.deadline_s,
        accepted=tuple(name for name in way.order.accepted if name == NO_OTHER),
        more_rows=more_rows,
        is_shown=is_shown,
    )


# --- into the next cell ----------------------------------------------------------------------------------------------


def _text_with(way: Way, held: InForce) -> str:
    """The next cell's document with this node, as its own fleet describes it.

    Raises:
        ConfigError: it would have faults.
    """
    text = document_text(held)
    fleet = fleet_of(text)
    entry = node_entry(document_text(in_force(way.door)), way.me, protocol_of(fleet))
    text = add_entries(text, "nodes", entry, f"the name {way.me}")
    node = next(one for one in fleet_of(text).nodes if one.name == way.me)
    if fleet.security is None and node.host:
        refuse_open_network((node.host,), [name for name in way.order.accepted if name == OPEN_NETWORK])
    if all(end and dial_endpoint(end, node.host) for end in (node.listen_control, node.listen_data)):
        known = fleet.seeds if is_list(text, ("seeds",)) else ()
        text = add_names(text, ("seeds",), [*(name for name in dial_order(fleet) if name not in known), way.me])
    result = check_bytes(text.encode(), f"the document of {held.fleet} with {way.me}")
    if result.fleet is None:
        advice = f"invite it by hand there, and give the invitation: {way.order.leaving_for(f'{way.me}{INVITE}')}"
        raise ConfigError(f"nothing was changed: {result.report()}\n{advice}")
    return text


def _invited(way: Way, there: _Next, going: Change | None) -> Change:
    """Have the next cell name this node, and keep its invitation here; nothing of it is done twice."""
    invitation = there.invitation
    if invitation is None:
        assert there.door is not None
        assert there.held is not None
        if not there.is_invited:
            kept = {"flags": list(there.held.flags), "rollouts": list(there.held.rollouts)}
            what = {"text": _text_with(way, there.held), **kept, **_ordered(way)}
            answer = change_over(there.door, what, there.held)
            wait_until_settled(there.door, int(answer["revision"]))
            way.tell(f"{there.fleet}: revision {answer['revision']} is agreed, and {way.me} may join")
        invitation = invitation_for(there.door, Guest(name=way.me), b"")
    text, state = document_text(in_force(way.door)), way.order.places.state
    fleet = _parsed(text, way.order.places.config)
    if going is not None and going.invitation == invitation:
        return next_cell.refreshed(state, fleet, text, going)
    return next_cell.begin(state, fleet, text, invitation)


def _parsed(text: str, file: Path) -> Fleet:
    result = check_bytes(text.encode(), str(file))
    if result.fleet is None:
        raise ConfigError(result.report())
    return result.fleet


def _wait_for_the_next(way: Way, going: Change) -> None:
    """Wait until a node of the next cell answers this one's new name and certificate.

    Raises:
        CliError: none does in time: nothing was taken from this machine.
    """
    door = _door_by(going.invitation.fleet, going.invitation.addresses, going.next_file)
    fleet = going.invitation.fleet

    def look() -> str:
        status = status_of(door)
        state = next((str(one["state"]) for one in status["nodes"] if one["name"] == way.me), None)
        if state in HERE:
            raise _TakenError(EXIT_FAILED, _taken(fleet, way.me, state))
        return "" if state is not None else f"{status['node']} of {fleet} does not name {way.me}"

    back = f"{way.me} works on in {going.former}; `{way.order.leaving_for(going.former)}` takes back what was begun"
    asked = f"{fleet} is asked to let {way.me} in, for at most {REACH_S:g} s"
    try:
        lack = wait_for(look, REACH_S, lambda lack, _left_s: way.tell(f"{asked}: {lack}"), is_told_once=True)
    except KeyboardInterrupt:
        warn(f"broken off while {asked}; {back}, and the same command goes on")
        raise
    if lack:
        papers = going.invitation.papers
        is_old = f"; its key may be of an earlier invitation: there `zsched invite {way.me}`" if papers else ""
        raise CliError(EXIT_FAILED, f"{fleet} does not let {way.me} in: {lack}{is_old}; {back}")


class _TakenError(UselessError):
    """Another machine has the name in the next cell: waiting does not help."""


def _taken(fleet: str, me: NodeId, state: str) -> str:
    return f"{fleet} has a node {me}, and it is {state}: another machine has that name"


def _door_by(fleet: str, addresses: tuple[str, ...], file: Path) -> Door:
    """To a cell, with what this machine keeps of it."""
    return door_of(Cell(name=fleet, gateways=addresses, file=str(file)), fleet, None)


# --- from here on the former daemon has ended ------------------------------------------------------------------------


def _arrive(way: Way, going: Change) -> int:
    """As `_taken_over`; whoever interrupts it hears where the machine is."""
    try:
        return _taken_over(way, going)
    except KeyboardInterrupt:
        back = way.order.leaving_for(going.former)
        told = f"{way.me} is between {going.former} and {going.invitation.fleet}, and may have no daemon"
        warn(f"\n{told}: give `{way.order.verb}` again to go on, or `{back}` to go back")
        raise


def _taken_over(way: Way, going: Change) -> int:
    """Become the node of the next cell, wait until it is taken there, and have the former one forget it."""
    order, me, fleet = way.order, way.me, going.invitation.fleet
    if not _runs(way, fleet):
        files = next_cell.go_over(going, order.places)
        way.tell(f"{me}: {len(files)} files of {fleet} are written" if files else f"{me}: the files are {fleet}'s")
        if not _started(way):
            return _go_back(way, going, "its daemon does not start there")
    lack = wait_for(lambda: "" if _runs(way, fleet) else "its daemon does not run", _left_s(way))
    if lack:
        start = "; ".join(how_to_start(me, order.places))
        again = f"then give `{order.verb}` again, or `{order.leaving_for(going.former)}` to go back"
        raise CliError(EXIT_TIMED_OUT, f"{me}: {lack}: {start}; {again}")
    way.tell(f"{me}: its daemon runs in {fleet}")
    lack = wait_for(lambda: _not_taken(way, fleet), TAKE_S)
    if lack:
        return _go_back(way, going, f"{fleet} has not taken it: {lack}")
    way.tell(f"{me}: {fleet} counts it, and its streams are settled")
    lack = wait_for(lambda: _not_forgotten(way, going), REACH_S)
    if lack:
        told = f"{me} is ready in {fleet}, and {going.former} still names it: {lack}"
        raise CliError(EXIT_TIMED_OUT, f"{told}; give `{order.verb}` again, or there: zsched node forget {me}")
    folder = authority_here(going.former, going.former_file)
    advice = () if folder is None else (bring_advice(folder, going.former),)
    next_cell.end(order.places.state)
    said = f"{me} has left {going.former}, and is ready in {fleet}"
    Told(fleet=fleet, node=me, outcome="joined", said=said, next=advice).tell(is_json=order.is_json, is_line=True)
    return EXIT_OK


def _left_s(way: Way) -> float:
    return max(way.order.deadline_s - (monotonic_s() - way.began), 0.0)


def _runs(way: Way, fleet: str) -> bool:
    """Whether this machine's daemon runs, and in that fleet."""
    with contextlib.suppress(CliError):
        return bool(status_of(own_door(way.order, way.me))["fleet"] == fleet)
    return False


def _started(way: Way) -> bool:
    """Start the daemon, or say how; false: it does not start."""
    if way.order.places.config == paths.SYSTEM_CONFIG and SYSTEMD.exists():
        done = subprocess.run(["systemctl", "start", "zsched"], check=False)
        return done.returncode == 0
    _tell_how_to_start(way)
    return True


def _tell_how_to_start(way: Way) -> None:
    for line in how_to_start(way.me, way.order.places):
        warn(f"start its daemon now, this command waits for it: {line}")


def _not_taken(way: Way, fleet: str) -> str:
    """Why this node is not ready in its cell yet, as it and another node see it; empty: it is."""
    door = own_door(way.order, way.me)
    status = status_of(door)
    if not status["quorum"]["ok"]:
        return f"it hears {status['quorum']['alive']} of the {status['quorum']['electors']} electors of {fleet}"
    moving = [task["name"] for task in status["tasks"] if task["phase"] not in ("settled", "idle")]
    if moving:
        return f"the streams of {', '.join(moving)} are not settled here"
    others = [str(one["name"]) for one in status["nodes"] if one["name"] != way.me and one["state"] == "alive"]
    if not others:
        return f"it hears no other node of {fleet}"
    for answer in ask_all(door, others, {"verb": "status"}).values():
        if not isinstance(answer, CliError):
            mine = next((one for one in answer["nodes"] if one["name"] == way.me), None)
            if mine is not None and mine["state"] == "alive":
                return ""
    return f"none of {', '.join(others)} says that it hears {way.me}"


def _not_forgotten(way: Way, going: Change) -> str:
    """Why the former cell's document still names this node; empty: it does not."""
    door = _to_the_former(way, going)
    held = in_force(door)
    text = document_text(held)
    if way.me not in [one.name for one in fleet_of(text).nodes]:
        return ""
    flags = [flag for flag in held.flags if flag["subject"] != way.me]
    what = {"text": without(text, way.me), "flags": flags, "rollouts": list(held.rollouts)}
    answer = change(door, {**what, "base_revision": held.revision, **_ordered(way)})
    way.tell(f"{going.former}: revision {answer['revision']} is agreed, and {way.me} is no node of it")
    return ""


def _to_the_former(way: Way, going: Change) -> Door:
    fleet = _parsed(going.former_file.read_text(), going.former_file)
    ends = [dial_endpoint(one.listen_control, one.host) for one in fleet.nodes if one.name != way.me]
    return _door_by(going.former, tuple(filter(None, ends)), going.former_file)


def _has_forgotten(way: Way, going: Change) -> bool:
    """Whether the former cell says that this node is none of its nodes; one that does not answer does not say so."""
    with contextlib.suppress(CliError, AdapterError, ConfigError):
        text = document_text(in_force(_to_the_former(way, going)))
        return way.me not in [one.name for one in fleet_of(text).nodes]
    return False


def _ordered(way: Way) -> Json:
    return ordered(f"{way.me} changes cells", {**way.view.asked, "reason": way.order.reason})


def _go_back(way: Way, going: Change, why: str) -> int:
    """The next cell has not taken it: be the former one's node again, with what it did.

    Raises:
        CliError: always: it did not come about.
    """
    order, me, fleet = way.order, way.me, going.invitation.fleet
    if _has_forgotten(way, going):
        told = f"{going.former} names {me} no more, so there is no way back"
        raise CliError(EXIT_FAILED, f"{me}: {why}; {told}; give `{order.leaving_for(fleet)}` again once that is mended")
    warn(f"{me}: {why}; it goes back to {going.former}")
    if _runs(way, fleet):
        there = Way(order=order, view=OrderView(door=own_door(way.order, way.me)), me=me, began=way.began, files=())
        stop_daemon(there, fleet, f"{me} goes back")
    next_cell.go_back(going, order.places)
    if not _started(way):
        _tell_how_to_start(way)
    lack = wait_for(lambda: _not_back(way, going.former), max(_left_s(way), TAKE_S))
    if lack:
        told = f"{me} has its files of {going.former} again: {lack}"
        raise CliError(EXIT_TIMED_OUT, f"{told}; then: zsched undrain {me}")
    view = OrderView(door=own_door(way.order, way.me), is_yes=True, is_json=order.is_json, reason="it goes back")
    undrain(view, [me])
    next_cell.end(order.places.state)
    forget = f"{fleet} names it until somebody there says: zsched node forget {me}"
    raise CliError(EXIT_FAILED, f"{me} works in {going.former} as before, for {why}; {forget}")


def _not_back(way: Way, fleet: str) -> str:
    if not _runs(way, fleet):
        return f"its daemon does not run: {'; '.join(how_to_start(way.me, way.order.places))}"
    return (
        ""
        if status_of(own_door(way.order, way.me))["quorum"]["ok"]
        else f"it does not hear a majority of {fleet}'s electors"
    )
