"""The fleet value with which a generation begins: of a fleet file, created on a first machine, or recovered.

Knows: what a first value says. Does not know: random ids (they are passed in), disks, how an operator asks for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import replace

from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, Ballot, NodeId, RegisterState, TaskId


def founded(fleet: str, generation: int, electors: Iterable[NodeId]) -> FleetValue:
    """What every node makes of today's file and state, without a word from another.

    The file names neither disks nor creations, and files may differ in all but the electors: so the value says nothing
    of tasks, document and lease. Its generation id hangs on fleet and generation, which operators count.
    """
    drawn = hashlib.blake2s(f"{fleet}/{generation}".encode(), digest_size=16, person=b"zsched1", salt=b"founded")
    return FleetValue(
        fleet=fleet,
        generation_id=drawn.hexdigest(),
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


def recovered(
    before: FleetValue, me: NodeId, *, disk: str, generation_id: str, states: Iterable[RegisterState]
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
    """
    newest = _newest(before, states)
    tasks = [
        replace(one, number=before.creations + index) for index, one in enumerate(before.tasks, start=1)
    ]  # in the order of their names
    number = before.number + 1
    value = replace(
        before,
        generation_id=generation_id,
        parent_id=before.generation_id,
        revision=before.revision + 1,
        number=number,
        electors=(Elector(name=me, disk=disk, joining=number),),
        settled=False,
        creations=before.creations + len(tasks),
        tasks=tuple(tasks),
    )
    return value, tuple(_begun(one, newest[one.task]) for one in tasks if one.task in newest)


def _newest(before: FleetValue, states: Iterable[RegisterState]) -> Mapping[TaskId, Allocation]:
    """{task: the value of the highest revision}; of one revision the learnt one, else that of the highest ballot."""
    found: dict[TaskId, tuple[tuple[int, bool, Ballot], Allocation]] = {}
    for state in states:
        creation = before.creation(state.task)
        if creation is None or creation.number != state.creation:
            continue
        ranked = [] if state.learnt is None else [((state.learnt.revision, True, NO_BALLOT), state.learnt)]
        held = state.accepted
        ranked += [] if held is None else [((held.value.revision, False, held.ballot), held.value)]
        for rank, value in ranked:
            if state.task not in found or rank > found[state.task][0]:
                found[state.task] = rank, value
    return {task: value for task, (_, value) in found.items()}


def _begun(creation: Creation, value: Allocation) -> RegisterState:
    """The state of a register that begins with ``value``: accepted, too, for a majority has it by that."""
    first = replace(value, revision=creation.start + 1, epoch=creation.start + 1)
    held: Acceptance = Acceptance(ballot=NO_BALLOT, value=first)
    return RegisterState(task=creation.task, creation=creation.number, accepted=held, learnt=first)
