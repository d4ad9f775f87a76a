"""What may be changed in a fleet value, and when: one elector at a time, and only on a settled value.

Knows: the rules of a change. Does not know: rounds (`zsched.core.register.register`), who wants the change and why.

* A change of the electors adds one or removes one, never the last. It raises the number and unsettles the value.
* A change of the lease's length raises the number, too: an elector of the number before waits for another length.
* Both need a settled value. A change of the document is allowed at any time; it keeps number and ``settled``, unless it
  brings another length of leases.
* A fleet that goes by its files agrees a document first: without one, nobody knows its leases and registers.
* A task that is created gets the next number of all creations, so a register that was removed never comes back.

A change that its rule forbids is no error: `apply` returns what was read, and its round ends as unchanged.
"""

from __future__ import annotations

from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct, replace


class AddElector(Struct, frozen=True, kw_only=True):
    """Change: one more elector."""

    base_revision: int
    name: NodeId
    disk: str
    reason: str = "an elector is added"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        return _unsettled(read) or (f"{self.name} is an elector" if read.electorate.seat(self.name) else "")

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with one more elector, under the next number."""
        if self.fault(read):
            return read
        added = Elector(name=self.name, disk=self.disk, joining=read.number + 1)
        return _renumbered(read, tuple(sorted((*read.electors, added), key=lambda one: one.name)))


class RemoveElector(Struct, frozen=True, kw_only=True):
    """Change: one elector less."""

    base_revision: int
    name: NodeId
    reason: str = "an elector is removed"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        if read.electorate.seat(self.name) is None:
            return f"{self.name} is no elector"
        return _unsettled(read) or ("" if len(read.electors) > 1 else f"{self.name} is the last elector")

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with one elector less, under the next number."""
        if self.fault(read):
            return read
        return _renumbered(read, tuple(one for one in read.electors if one.name != self.name))


class SetLease(Struct, frozen=True, kw_only=True):
    """Change: another length of leases."""

    base_revision: int
    lease_s: float
    reason: str = "the lease has another length"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        return _unsettled(read)

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with another lease, under the next number."""
        if self.fault(read) or self.lease_s == read.lease_s:
            return read
        return _relet(replace(read, revision=read.revision + 1), read, self.lease_s)


class AdoptDocument(Struct, frozen=True, kw_only=True):
    """Change: the first document of a fleet that has gone by its files. Registers stay; the number rises.

    It rises because the lease is agreed by it: until then each node has gone by the length in its own file.
    """

    base_revision: int
    document: str
    tasks: tuple[tuple[TaskId, bool], ...]
    """(task, whether it is exclusive) of every task of the document."""
    lease_s: float
    file_lease_s: float = 0.0
    """Of the fleet file before: leases of that length may still run."""
    reason: str = "the fleet's file is agreed"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        return "a document is agreed already" if read.document else ""

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with this document, under the next number."""
        if self.fault(read):
            return read
        number = read.creations
        tasks = tuple(Creation(task=task, number=number, exclusive=is_one) for task, is_one in sorted(self.tasks))
        return replace(
            _renumbered(read, read.electors),
            document=self.document,
            tasks=tasks,
            lease_s=self.lease_s,
            guard_lease_s=max(self.lease_s, self.file_lease_s),
        )


class SetDocument(Struct, frozen=True, kw_only=True):
    """Change: another document. Tasks that stay keep their registers; those that come get new ones."""

    base_revision: int
    document: str
    tasks: tuple[tuple[TaskId, bool], ...]
    """(task, whether it is exclusive) of every task of the document."""
    lease_s: float | None = None
    """The document's length of leases; ``None``: as it is."""
    reason: str = "the fleet is changed"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        if not read.document:
            return "no document is agreed yet"
        return _unsettled(read) if self._is_of_lease(read) else ""

    def _is_of_lease(self, read: FleetValue) -> bool:
        return self.lease_s is not None and self.lease_s != read.lease_s

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with this document; electors stay, and so do number and ``settled`` unless the lease changes."""
        if self.fault(read):
            return read
        creations, tasks = read.creations, []
        for task, exclusive in sorted(self.tasks):
            known = read.creation(task)
            if known is None:
                creations += 1
            number = creations if known is None else known.number
            tasks.append(Creation(task=task, number=number, exclusive=exclusive))
        if self.document == read.document and tuple(tasks) == read.tasks:
            return read
        changed = replace(
            read, revision=read.revision + 1, creations=creations, tasks=tuple(tasks), document=self.document
        )
        if self.lease_s is None or not self._is_of_lease(read):
            return changed
        return _relet(changed, read, self.lease_s)


class SetAway(Struct, frozen=True, kw_only=True):
    """Change: which robots are away, and do not count in votes."""

    base_revision: int
    away: tuple[NodeId, ...]
    """Sorted."""
    reason: str = "robots are away, or back"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        return "" if read.document else "no document is agreed yet"

    def apply(self, read: FleetValue) -> FleetValue:
        """The value with these robots away; electors, number and ``settled`` stay."""
        if self.fault(read) or self.away == read.away:
            return read
        return replace(read, revision=read.revision + 1, away=self.away)


class Settle(Struct, frozen=True, kw_only=True):
    """Change: these electors hold all that was chosen before them (`zsched.core.electorate.settling`)."""

    base_revision: int
    number: int
    """Under which the electors were asked: of any other number nothing is known."""
    has_waited: bool = False
    """A guard time has passed. Without an exclusive task nobody waits: leases of one that has gone may still run."""
    reason: str = "the electors are settled"

    def fault(self, read: FleetValue) -> str:
        """Why this change cannot be made now; empty: it can."""
        return "" if read.number == self.number and not read.settled else "another number, or settled already"

    def apply(self, read: FleetValue) -> FleetValue:
        """The value, settled."""
        if self.fault(read):
            return read
        longest = read.lease_s if self.has_waited else read.guard_lease_s
        return replace(read, revision=read.revision + 1, settled=True, guard_lease_s=longest)


FleetChange = AdoptDocument | AddElector | RemoveElector | SetLease | SetDocument | SetAway | Settle


def _unsettled(read: FleetValue) -> str:
    if not read.document:
        return "no document is agreed yet"
    return "" if read.settled else f"number {read.number} is not settled: a majority of its electors must answer first"


def _renumbered(read: FleetValue, electors: tuple[Elector, ...]) -> FleetValue:
    return replace(read, revision=read.revision + 1, number=read.number + 1, electors=electors, settled=False)


def _relet(changed: FleetValue, read: FleetValue, lease_s: float) -> FleetValue:
    """The value with another length of leases, under the next number; until that is settled, longer ones may run."""
    longest = max(lease_s, read.guard_lease_s)
    return replace(changed, number=read.number + 1, settled=False, lease_s=lease_s, guard_lease_s=longest)
