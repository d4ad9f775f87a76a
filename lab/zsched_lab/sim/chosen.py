"""What has been chosen, seen from above: the judge of machines whose electors change.

Knows: which elector has had which acceptance on disk, and with which electors its ballot counts. Does not know: why a
machine did anything.

A value is chosen the moment a majority of the electorate of its ballot has it on disk, whether anybody learns that or
not. What must hold:

* a register has one chosen value in a revision, also over changes of the electors;
* a newer choice never falls behind an older one: what was chosen is not forgotten;
* whatever a machine has learnt was chosen;
* a ballot carries one value.
"""

from __future__ import annotations

from collections.abc import Iterable

from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.messages import Accept, Prepare
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, Ballot, NodeId, RegisterState
from zsched.core.values.quorum import majority
from zsched.core.values.words import CREATION_STEP

Name = tuple[str, str, int]
"""(generation, register, creation); the fleet register's creation is -1."""
Value = Allocation | FleetValue


class ChosenError(AssertionError):
    """What must hold does not."""


class Chosen:
    """All choices of all registers."""

    def __init__(self, first: FleetValue) -> None:
        self.values: dict[Name, dict[int, Value]] = {}
        """{register: {revision: its chosen value}}."""
        self.electors: dict[tuple[str, int], tuple[Elector, ...]] = {}
        """{(generation, number): its electors}."""
        self._numbers: dict[tuple[Name, Ballot], int] = {}
        """{(register, ballot): the number under which it was asked for}."""
        self._carried: dict[tuple[Name, Ballot], Value] = {}
        self._held: dict[tuple[Name, Ballot], set[tuple[NodeId, str]]] = {}
        """{(register, ballot): (name, disk) of every machine that has had it on disk}."""
        self._newest: dict[Name, int] = {}
        self._newest_ballot: dict[Name, tuple[int, Ballot]] = {}
        """{register: (number, ballot) of the newest choice}."""
        self._done: set[tuple[Name, Ballot]] = set()
        self.begin(first, ())

    def begin(self, value: FleetValue, registers: Iterable[RegisterState]) -> None:
        """A generation begins with this value."""
        self._choose(_of_fleet(value), value)
        for state in registers:
            if state.learnt is not None:
                self._choose((value.generation_id, state.task, state.creation), state.learnt)

    def newest_fleet(self, generation_id: str) -> FleetValue:
        """The fleet value of the highest revision that was chosen."""
        known = self.values[generation_id, "", -1]
        value = known[max(known)]
        assert isinstance(value, FleetValue)
        return value

    def note(self, question: Prepare | Accept | Accept[FleetValue]) -> None:
        """A question leaves: its ballot counts with the electors of its number."""
        if isinstance(question, Prepare):
            return
        value: Value = question.acceptance.value
        creation = -1 if isinstance(value, FleetValue) else question.creation
        name = question.generation_id, "" if creation < 0 else question.task, creation
        key = name, question.acceptance.ballot
        if self._carried.setdefault(key, value) != value:
            raise ChosenError(f"{key[1]} carries two values: {_text(self._carried[key])} and {_text(value)}")
        self._numbers[key] = question.number

    def on_disk(
        self, machine: NodeId, disk: str, fleet: RegisterState[FleetValue], registers: Iterable[RegisterState]
    ) -> None:
        """A machine has written its state."""
        assert fleet.learnt is not None
        generation = fleet.learnt.generation_id
        self._accepted((generation, "", -1), fleet.accepted, machine, disk)
        for state in registers:
            self._accepted((generation, state.task, state.creation), state.accepted, machine, disk)
        self._learnt((generation, "", -1), fleet.learnt, machine)
        for state in registers:
            self._learnt((generation, state.task, state.creation), state.learnt, machine)

    def hear(self, machine: NodeId, problems: Iterable[str]) -> None:
        """A machine complains of its registers."""
        for problem in problems:
            raise ChosenError(f"{machine}: {problem}")

    def _accepted(
        self, name: Name, held: Acceptance | Acceptance[FleetValue] | None, machine: NodeId, disk: str
    ) -> None:
        if held is None or held.ballot == NO_BALLOT:
            return
        key = name, held.ballot
        if key not in self._numbers and (("", *name[1:]), held.ballot) in self._numbers:
            return  # asked for while the fleet file was in force, written just after the document: nobody judges those
        holders = self._held.setdefault(key, set())
        if (machine, disk) in holders:
            return
        holders.add((machine, disk))
        number = self._numbers[key]
        electors = self.electors.get((name[0], number))
        if electors is None:
            raise ChosenError(f"{machine} accepted under number {number}, which was never chosen")
        count = sum(any(one.is_held_by(*holder) for holder in holders) for one in electors)
        if count >= majority(len(electors)) and key not in self._done:
            self._done.add(key)
            newest = self._newest.get(name, 0)
            if self._is_late(key, held.value):
                return
            if held.value.revision < newest:
                raise ChosenError(f"{name[1:]}: revision {newest} is forgotten: {_text(held.value)} is chosen")
            self._choose(name, held.value)

    def _is_late(self, key: tuple[Name, Ballot], value: Value) -> bool:
        """Whether a value that was chosen before is chosen once more, in a ballot below that of the newest choice.

        The proposer of the newer one has read it, so nothing is forgotten. The fleet register begins again under each
        number: there a later ballot of an earlier number is below, too.
        """
        name, ballot = key
        newest = self._newest_ballot.setdefault(name, (0, NO_BALLOT))
        is_below = (self._numbers[key], ballot) < newest
        self._newest_ballot[name] = max(newest, (self._numbers[key], ballot))
        return is_below and self.values.get(name, {}).get(value.revision) == value

    def _choose(self, name: Name, value: Value) -> None:
        known = self.values.setdefault(name, {})
        if known.setdefault(value.revision, value) != value:
            other = known[value.revision]
            raise ChosenError(f"{name[1:]}: two values of revision {value.revision}: {_text(other)}, {_text(value)}")
        self._newest[name] = max(self._newest.get(name, 0), value.revision)
        if isinstance(value, FleetValue):
            first = self.electors.setdefault((value.generation_id, value.number), value.electors)
            if first != value.electors:
                raise ChosenError(f"number {value.number} has two electorates")

    def _learnt(self, name: Name, value: Value | None, machine: NodeId) -> None:
        if value is None:
            return
        if isinstance(value, Allocation) and value.revision == name[2] * CREATION_STEP:
            return  # a register's first value is nobody's choice
        if self.values.get(name, {}).get(value.revision) != value:
            raise ChosenError(f"{machine} learnt {_text(value)} of {name[1:]}, which was never chosen")


def _of_fleet(value: FleetValue) -> Name:
    return value.generation_id, "", -1


def _text(value: Value) -> str:
    if isinstance(value, FleetValue):
        return f"r{value.revision} n{value.number} {','.join(value.electorate.names)} settled={value.settled}"
    return f"r{value.revision % CREATION_STEP} {value.owner}"
