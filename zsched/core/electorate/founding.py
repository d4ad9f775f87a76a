"""The fleet value with which a generation begins: of a fleet file, created on a first machine, or recovered.

Knows: what a first value says. Does not know: random ids (they are passed in), disks, how an operator asks for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, Ballot, NodeId, RegisterState, TaskId
from zsched.core.values.struct import Struct, replace


def founded(fleet: str, generation: int, electors: Iterable[NodeId]) -> FleetValue:
    """What every node makes of today's file and state, without a word from another.

    The file names neither disks nor creations, and files may differ in all but the electors: so the value says nothing
    of tasks, document and lease. Its generation id hangs on fleet and generation, which operators count.
    """
    return FleetValue(
        fleet=fleet,
        generation_id=founded_id(fleet, generation),
        revision=1,
        number=1,
        electors=tuple(Elector(name=name) for name in sorted(set(electors))),
        settled=True,
        lease_s=0.0,
        guard_lease_s=0.0,
        creations=generation,
    )


def created(fleet: Fleet, me: NodeId, *, disk: str, generation_id: str, document: str) -> FleetValue:
    """What the first machine of a new fleet begins with: a document is agreed, and this machine is the only elector.

    Args:
        fleet: what the document says.
        me: the first machine.
        disk: its disk's id.
        generation_id: random: two fleets of one name never mix.
        document: the document's hash.
    """
    tasks = tuple(
        Creation(task=task.name, number=index, exclusive=task.exclusive)
        for index, task in enumerate(fleet.tasks, start=1)
    )
    return FleetValue(
        fleet=fleet.name,
        generation_id=generation_id,
        revision=1,
        number=1,
        electors=(Elector(name=me, disk=disk, joining=1),),
        settled=True,
        lease_s=fleet.timing.lease_s,
        guard_lease_s=fleet.timing.lease_s,
        creations=len(tasks),
        tasks=tasks,
        document=document,
    )


def founded_id(fleet: str, generation: int) -> str:
    """The generation id of a fleet that began with a fleet file, in this generation of operators' counting."""
    drawn = hashlib.blake2s(f"{fleet}/{generation}".encode(), digest_size=16, person=b"zsched1", salt=b"founded")
    return drawn.hexdigest()


class Agreed(Struct, frozen=True, kw_only=True):
    """The document by which a recovered generation goes."""

    document: str
    """Its hash."""
    tasks: tuple[tuple[TaskId, bool], ...]
    """(task, whether it is exclusive) of every task of the document."""
    lease_s: float
    """Its length of leases (seconds)."""


def recovered(
    before: FleetValue,
    me: NodeId,
    *,
    disk: str,
    generation_id: str,
    states: Iterable[RegisterState],
    agreed: Agreed | None = None,
    granted_s: float = 0.0,
) -> tuple[FleetValue, tuple[RegisterState, ...]]:
    """A new generation with one elector: its fleet value, and the states of its tasks' registers.

    Every task is created anew, so that its epochs rise; its value is the newest one, accepted or learnt, of all
    ``states``. The value is not settled: the first change waits for the leases of the generation before.

    Args:
        before: the newest fleet value that the survivor has.
        me: the survivor.
        disk: its disk's id.
        generation_id: random.
        states: of tasks' registers, of as many nodes as can be asked.
        agreed: the document; ``None``: that of ``before``.
        granted_s: the longest lease that an elector before may have granted by a fleet file (seconds).
    """
    newest = _newest(before, states)
    listed = agreed.tasks if agreed is not None else tuple((one.task, one.exclusive) for one in before.tasks)
    tasks = tuple(
        Creation(task=task, number=before.creations + index, exclusive=exclusive)
        for index, (task, exclusive) in enumerate(sorted(listed), start=1)
    )
    number = before.number + 1
    lease_s = before.lease_s if agreed is None else agreed.lease_s
    value = replace(
        before,
        generation_id=generation_id,
        parent_id=before.generation_id,
        recovered_by=me,
        revision=before.revision + 1,
        number=number,
        electors=(Elector(name=me, disk=disk, joining=number),),
        settled=False,
        lease_s=lease_s,
        guard_lease_s=max(lease_s, before.guard_lease_s, granted_s),
        creations=before.creations + len(tasks),
        tasks=tasks,
        document=before.document if agreed is None else agreed.document,
        away=tuple(name for name in before.away if name != me),
    )
    return value, tuple(_begun(one, newest[one.task]) for one in tasks if one.task in newest)


def newest_fleet(states: Iterable[RegisterState[FleetValue]]) -> FleetValue | None:
    """The newest fleet value that any of these states has learnt or accepted; ``None``: none of them holds one.

    An accepted one that is newer than all learnt ones may have been chosen, and then it must not be lost. If it was
    not, nobody has gone by it.
    """
    found: list[tuple[tuple[int, bool, Ballot], FleetValue]] = []
    for state in states:
        found += [] if state.learnt is None else [((state.learnt.revision, True, NO_BALLOT), state.learnt)]
        held = state.accepted
        found += [] if held is None else [((held.value.revision, False, held.ballot), held.value)]
    return max(found, key=lambda one: one[0])[1] if found else None


def _newest(before: FleetValue, states: Iterable[RegisterState]) -> Mapping[TaskId, Allocation]:
    """{task: the value of the highest revision}; of one revision the learnt one, else that of the highest ballot."""
    found: dict[TaskId, tuple[tuple[int, bool, Ballot], Allocation]] = {}
    for state in states:
        if state.creation != _creation_of(before, state.task):
            continue
        ranked = [] if state.learnt is None else [((state.learnt.revision, True, NO_BALLOT), state.learnt)]
        held = state.accepted
        ranked += [] if held is None else [((held.value.revision, False, held.ballot), held.value)]
        for rank, value in ranked:
            if state.task not in found or rank > found[state.task][0]:
                found[state.task] = rank, value
    return {task: value for task, (_, value) in found.items()}


def _creation_of(before: FleetValue, task: TaskId) -> int | None:
    """The number of a task's creation; ``None``: the document does not list it. By files it is the generation."""
    if not before.document and not before.tasks:
        return before.creations
    creation = before.creation(task)
    return None if creation is None else creation.number


def _begun(creation: Creation, value: Allocation) -> RegisterState:
    """The state of a register that begins with ``value``: accepted, too, for a majority has it by that."""
    first = replace(value, revision=creation.start + 1, epoch=creation.start + 1)
    held: Acceptance = Acceptance(ballot=NO_BALLOT, value=first)
    return RegisterState(task=creation.task, creation=creation.number, accepted=held, learnt=first)
