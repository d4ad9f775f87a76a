"""Recovery by an operator's word: one survivor becomes the only elector of a new generation, and others change sides.

Knows: what speaks against it, which dangers the operator accepts, which states and document the new generation begins
with. Does not know: files, who was asked and how, how anything is shown.

The values of the new generation are the newest ones, accepted or learnt, of all states that are given. Nobody else is
told: every other node stays where it is until its operator says `rejoin` there. It then starts blank, for what it has
promised belongs to its generation, and knows only which generation it is to follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum

from zsched.core.electorate.founding import Agreed, founded, founded_id, newest_fleet, recovered
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import SAID_DIGITS, FleetValue
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import NodeId, RegisterState
from zsched.core.values.quorum import majority
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import Struct, replace

MOVED = "it has changed sides to another generation, and has no seat there"
"""Why a node that rejoins is no elector until it is added as one."""
NEW_DISK = "its disk is new, and has no seat"
"""Why a node that begins with a blank disk, where others know its name as an elector, is none until it is added."""


class Danger(StrEnum):
    """What an operator accepts by its name."""

    OFF = "old-electors-are-off"
    LOST = "newest-may-be-lost"
    FILE = "file-as-document"
    HALF = "another-half"


class Found(Struct, frozen=True, kw_only=True):
    """What was found before a recovery."""

    fleet: Fleet
    """The fleet file of this machine."""
    me: NodeId
    own: DurableState | None
    """This node's state; ``None``: it has none that is whole."""
    others: tuple[DurableState, ...]
    """States of other nodes' disks, or of this node's backup, that the operator has brought."""
    answers: tuple[Snapshot, ...]
    """Of every other node that answers."""
    documents: Mapping[str, Fleet]
    """{hash: what it says} of the documents beside the states."""
    file_hash: str
    """Hash of the fleet file as a document."""

    @property
    def states(self) -> tuple[DurableState, ...]:
        """All states, this node's own first."""
        return (() if self.own is None else (self.own,)) + self.others


class Recovery(Struct, frozen=True, kw_only=True):
    """A recovery that may go on once its dangers are accepted."""

    found: Found
    before: FleetValue
    agreed: Agreed | None
    """The fleet file as the document; ``None``: the document of ``before`` stays."""
    dangers: tuple[tuple[Danger, str], ...]
    """(which, what is accepted with it)."""

    @property
    def document(self) -> Fleet:
        """What the new generation goes by."""
        return self.found.fleet if self.agreed is not None else self.found.documents[self.before.document]

    def carry_out(self, *, generation_id: str, disk: str, incarnation: int, hardware: str) -> DurableState:
        """The state with which the new generation begins.

        Args:
            generation_id: random.
            disk: random; used where this node has no state.
            incarnation: of this start, by the wall clock.
            hardware: of this machine.
        """
        found, own = self.found, self.found.own
        disk = disk if own is None or not own.disk else own.disk
        granted_s = _granted_s(found)
        value, registers = recovered(
            self.before,
            found.me,
            disk=disk,
            generation_id=generation_id,
            states=[register for state in found.states for register in registers_of(state)],
            agreed=self.agreed,
            granted_s=granted_s,
        )
        lives = [state.incarnation for state in found.states]
        return DurableState(
            fleet=found.fleet.name,
            node=found.me,
            incarnation=max(incarnation, *lives),
            generation=found.states[0].generation,
            hardware=hardware,
            electorate=electorate_hash(found.fleet),
            registers=registers,
            lease_s=value.guard_lease_s,
            votes=0 if own is None else own.votes,
            disk=disk,
            fleet_register=RegisterState(task=found.fleet.name, learnt=value),
        )


def _granted_s(found: Found) -> float:
    """The longest lease that any elector may have granted before (seconds)."""
    return max(found.fleet.timing.lease_s, *(state.lease_s for state in found.states))


def registers_of(state: DurableState) -> tuple[RegisterState, ...]:
    """A state's registers with their creations: one of a fleet that goes by its files names none."""
    return tuple(replace(one, creation=one.creation or state.generation) for one in state.registers)


def generation_of(state: DurableState) -> str:
    """The id of a state's generation."""
    value = None if state.fleet_register is None else state.fleet_register.learnt
    if value is not None:
        return value.generation_id
    return state.joins or founded_id(state.fleet, state.generation)


def consider(found: Found) -> Recovery | str:
    """A recovery, or why there can be none, and what to do instead."""
    if not found.states:
        return (
            f"{found.me} has no state here, and none is given; run it on a node that has one, or name the state file "
            "of a dead one with --from"
        )
    mixed = _why_no_one_generation(found)
    if mixed:
        return mixed
    held = [state.fleet_register for state in found.states if state.fleet_register is not None]
    first = found.states[0]
    first_value = founded(first.fleet, first.generation, found.fleet.electors)
    before = newest_fleet(held) or first_value
    learnt = newest_fleet(replace(one, accepted=None) for one in held) or first_value
    ours = [answer for answer in found.answers if _is_of(answer, before, first.generation)]
    against = _why_not(found, learnt, before, ours)
    if against:
        return against
    agreed, by_file = _agreed(found, before)
    if isinstance(agreed, str):
        return agreed
    dangers = _dangers(found, before, [answer for answer in found.answers if answer not in ours])
    return Recovery(found=found, before=before, agreed=agreed, dangers=(*dangers, *by_file))


def _why_no_one_generation(found: Found) -> str:
    first = found.states[0]
    named = generation_of(first)
    for state in found.states:
        if state.fleet != found.fleet.name:
            return f"the state of {state.node} is of the fleet {state.fleet}, not of {found.fleet.name}: leave it out"
        if generation_of(state) != named:
            return (
                f"the state of {state.node} is of generation {generation_of(state)[:SAID_DIGITS]}, that of "
                f"{first.node} of {named[:SAID_DIGITS]}: halves that were recovered apart never mix, leave one out"
            )
    if all(state.joins and state.fleet_register is None for state in found.states):
        return f"{first.node} was to join generation {named[:SAID_DIGITS]} and knows nothing of it yet: recover another"
    if found.own is not None and found.own.disputed:
        return f"{found.own.disputed}; `zsched fleet recover --settle` comes first"
    return ""


def _is_of(answer: Snapshot, before: FleetValue, generation: int) -> bool:
    """Whether a node that answers counts by the generation that is to be recovered."""
    told = answer.quorum.generation_id
    return told == before.generation_id if told else answer.quorum.generation == generation


def _why_not(found: Found, learnt: FleetValue, before: FleetValue, ours: Sequence[Snapshot]) -> str:
    """Why the fleet needs no recovery, or not this one; empty: it may need it.

    A change that was only accepted (``before``) takes a majority of the electors from which it was asked (``learnt``).
    """
    newer = [answer for answer in ours if answer.fleet_revision > before.revision]
    if newer:
        told = max(newer, key=lambda answer: answer.fleet_revision)
        return (
            f"{told.node} knows revision {told.fleet_revision} of the fleet, and the states given here only "
            f"{before.revision}: start zsched here, it learns that; or recover on {told.node}"
        )
    able = [(_able(found, value, ours), len(value.electors)) for value in (learnt, before)]
    if any(len(names) < majority(count) for names, count in able):
        return ""
    names, count = able[-1]
    return (
        f"{', '.join(names)} can agree, {majority(count)} of {count} electors are needed: nothing is lost; "
        "start zsched here, and see `zsched status`"
    )


def _able(found: Found, value: FleetValue, ours: Sequence[Snapshot]) -> list[NodeId]:
    """The electors of a value that can answer, sorted."""
    names, own = value.electorate.names, found.own
    able = {answer.node for answer in ours if answer.node in names and answer.quorum.this_node == "elector"}
    seat = value.electorate.seat(found.me)
    if seat is not None and own is not None and not own.lost and seat.is_held_by(found.me, own.disk):
        able.add(found.me)
    return sorted(able)


def _agreed(found: Found, before: FleetValue) -> tuple[Agreed | str | None, tuple[tuple[Danger, str], ...]]:
    """(the fleet file as the document, if it is to be, or why nothing can be, its danger)."""
    document = found.documents.get(before.document)
    if document is not None:
        is_named = any(node.name == found.me for node in document.nodes)
        return None if is_named else f"the agreed document names no node {found.me!r}: recover on one that it names", ()
    fleet = found.fleet
    agreed = Agreed(
        document=found.file_hash,
        tasks=tuple((task.name, task.exclusive) for task in fleet.tasks),
        lease_s=fleet.timing.lease_s,
    )
    if not before.document:
        return agreed, ()
    means = (
        f"the agreed document {before.document[:SAID_DIGITS]} is on none of the disks given: this machine's fleet file "
        "takes its place"
    )
    return agreed, ((Danger.FILE, means),)


def _dangers(found: Found, before: FleetValue, strangers: Sequence[Snapshot]) -> list[tuple[Danger, str]]:
    names = before.electorate.names
    others = [name for name in names if name != found.me]
    given = {state.node for state in found.states if _has_seat(before, state) and not state.lost}
    dangers = []
    if others:
        means = (
            f"{', '.join(others)} decide no more: if a majority of {', '.join(names)} lives on somewhere, that is a "
            "second fleet with second owners, of exclusive tasks, too"
        )
        dangers.append((Danger.OFF, means))
    missing = [name for name in names if name not in given]
    if len(given) < majority(len(names)):
        means = (
            f"what was agreed without {found.me} is lost: no states of {', '.join(missing)} are given "
            "(--from STATE_FILE keeps what is on a dead machine's disk)"
        )
        dangers.append((Danger.LOST, means))
    if strangers:
        told = ", ".join(f"{one.node} ({one.quorum.generation_id[:SAID_DIGITS] or 'older'})" for one in strangers)
        newest = next((one.quorum.generation_id for one in strangers if one.quorum.recovered_by), "")
        means = f"{told} count by another generation already, and this would be one more"
        means += f"; `zsched fleet recover --rejoin {newest[:SAID_DIGITS]}` brings this node over" if newest else ""
        dangers.append((Danger.HALF, means))
    return dangers


def _has_seat(before: FleetValue, state: DurableState) -> bool:
    seat = before.electorate.seat(state.node)
    return seat is not None and seat.is_held_by(state.node, state.disk)


# --- changing sides --------------------------------------------------------------------------------------------------


class Sides(Struct, frozen=True, kw_only=True):
    """The generation that a node is to follow, and who follows it already."""

    generation_id: str
    generation: int
    """As operators count it (`zsched fleet recover --generation`)."""
    nodes: tuple[NodeId, ...]
    """Who has answered, sorted."""
    recovered_by: NodeId
    electors: tuple[NodeId, ...]


def sides_of(answers: Sequence[Snapshot]) -> tuple[Sides, ...]:
    """The generations of the nodes that have answered, those of the most nodes first."""
    found: dict[str, list[Snapshot]] = {}
    for answer in answers:
        if answer.quorum.generation_id:
            found.setdefault(answer.quorum.generation_id, []).append(answer)
    sides = [
        Sides(
            generation_id=named,
            generation=of[0].quorum.generation,
            nodes=tuple(sorted(answer.node for answer in of)),
            recovered_by=next((answer.quorum.recovered_by for answer in of if answer.quorum.recovered_by), ""),
            electors=max(of, key=lambda answer: answer.fleet_revision).quorum.names,
        )
        for named, of in found.items()
    ]
    return tuple(sorted(sides, key=lambda side: (-len(side.nodes), side.generation_id)))


def choose_side(fleet: Fleet, own: DurableState | None, sides: Sequence[Sides], wanted: str) -> Sides | str:
    """The generation that a node changes to, or why there is none.

    A node that changes sides starts blank: it hears those only that its fleet file names.

    Args:
        fleet: the node's fleet file.
        own: the node's state.
        sides: of the nodes that have answered.
        wanted: the beginning of a generation id; empty: the only one that is not this node's.
    """
    here = "" if own is None else generation_of(own)
    others = [side for side in sides if side.generation_id != here and side.generation_id.startswith(wanted)]
    if len(others) == 1:
        return others[0] if is_named_in(fleet, others[0]) else _unknown(others[0])
    told = "; ".join(f"{side.generation_id[:SAID_DIGITS]}: {', '.join(side.nodes)}" for side in sides)
    if not sides:
        return "no other node answers, so there is no generation to join; start one that counts by it"
    if others:
        return f"name the generation to join; there are {told}"
    if wanted and here.startswith(wanted):
        return f"this node is of generation {here[:SAID_DIGITS]} already: start zsched, it follows by itself"
    if wanted:
        return f"no node that answers is of a generation {wanted}; there are {told}"
    return f"all nodes that answer are of this node's generation: start zsched, it follows by itself ({told})"


def is_named_in(fleet: Fleet, side: Sides) -> bool:
    """Whether a fleet file names a node that counts by a generation."""
    return any(node.name in side.nodes for node in fleet.nodes)


def _unknown(side: Sides) -> str:
    names = ", ".join(side.nodes)
    return (
        f"the fleet file here names none of {names}, so this daemon would not hear them; first bring the fleet's "
        f"document as that file: `zsched fleet export` on {side.nodes[0]}"
    )


def new_member(me: NodeId, generation: int, answers: Sequence[Snapshot]) -> Sides | None:
    """The generation that a node with a blank disk comes into as another member; ``None``: it begins by its file.

    The fleet goes by an agreed document, and lives in one generation. Where the node's name has a seat there, with
    which it has voted, `NEW_DISK` in its state keeps it from answering for that seat, so no vote is given twice. Where
    it has none (its seat went with its disk, or it never had one), the electors of its file are none any more: by them
    it would found a second fleet.

    Args:
        me: the node.
        generation: as the operator counts it; 0: not named.
        answers: of the other nodes.
    """
    agreed = [one for one in answers if one.quorum.number]
    sides = sides_of(answers)
    if not agreed or len(sides) != 1 or generation not in (0, sides[0].generation):
        return None
    has_seat = any(me in one.quorum.names for one in agreed)
    has_voted = any(me in one.quorum.names and me in one.quorum.voted for one in agreed)
    return sides[0] if has_voted or not has_seat else None


def rejoined(
    fleet: Fleet,
    me: NodeId,
    own: DurableState | None,
    side: Sides,
    *,
    disk: str,
    incarnation: int,
    hardware: str,
    why: str = MOVED,
) -> DurableState:
    """The blank state of a node that changes sides: it knows the generation that it is to follow, and no more.

    It votes only once it is added as an elector there, whatever its fleet file says.

    Args:
        fleet: the fleet file.
        me: the node.
        own: its state before; ``None``: none.
        side: the generation.
        disk: random: as a member of that generation it is another one.
        incarnation: of this start, by the wall clock.
        hardware: of this machine.
        why: it is no elector, though its file or that generation names it as one.
    """
    has_name = me in fleet.electors or me in side.electors
    return DurableState(
        fleet=fleet.name,
        node=me,
        incarnation=incarnation if own is None else max(incarnation, own.incarnation),
        generation=side.generation,
        hardware=hardware,
        electorate=electorate_hash(fleet),
        lease_s=0.0 if own is None else own.lease_s,
        disk=disk,
        joins=side.generation_id,
        lost=why if has_name else "",
    )
