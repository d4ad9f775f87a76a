"""The value of the fleet register: which fleet this is, who elects, which tasks have a register.

Knows: the fields of a fleet value and their ranges. Does not know: how one is changed and agreed
(`zsched.core.electorate`), what stands in the document.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cached_property
from itertools import pairwise

from zsched.core.values.model import NodeId, TaskId, check_counter, check_name
from zsched.core.values.struct import Struct
from zsched.core.values.words import CREATION_STEP, check_range

MAX_LEASE_S = 3600.0
TOLD_DIGITS = 16
"""Beats have this many digits of a generation id, which are enough to name one."""
SAID_DIGITS = 8
"""A sentence has this many digits of a generation id."""
_ID = re.compile(r"[0-9a-f]{0,32}")


def check_id(field: str, value: str) -> None:
    """Raise `ValueError` unless ``value`` is at most 32 hex digits."""
    if _ID.fullmatch(value) is None:
        raise ValueError(f"{field}: {value!r} is not an id (at most 32 hex digits)")


class Elector(Struct, frozen=True, kw_only=True):
    """One seat: a node may answer for it only with this disk. Its promises belong to this joining."""

    name: NodeId
    disk: str = ""
    """Id of the disk; empty: of a fleet file, which names no disks, so whichever node keeps a state of this name."""
    joining: int = 0
    """The number under which it was added; 0: by a fleet file."""

    def __post_init__(self) -> None:
        check_name("elector.name", self.name)
        check_id("elector.disk", self.disk)
        check_counter("elector.joining", self.joining)

    def is_held_by(self, name: NodeId, disk: str) -> bool:
        """Whether the node with this name and disk may answer for the seat."""
        return self.name == name and self.disk in ("", disk)


class Creation(Struct, frozen=True, kw_only=True):
    """One task of the document: its register is named by task and number."""

    task: TaskId
    number: int
    exclusive: bool = False

    def __post_init__(self) -> None:
        check_name("creation.task", self.task)
        check_counter("creation.number", self.number)

    @property
    def start(self) -> int:
        """Revision and epoch of the register's first value."""
        return self.number * CREATION_STEP


class Electorate(Struct, frozen=True, kw_only=True, dict=True):
    """With whom a round counts: it belongs to one number of one generation.

    What follows from its fields is worked out once (``dict``): every beat asks for it.
    """

    generation_id: str = ""
    number: int = 0
    electors: tuple[Elector, ...] = ()

    def __post_init__(self) -> None:
        check_id("electorate.generation_id", self.generation_id)
        check_counter("electorate.number", self.number)

    def seat(self, name: NodeId) -> Elector | None:
        """The seat of ``name``; ``None``: it is no elector."""
        return next((one for one in self.electors if one.name == name), None)

    @cached_property
    def is_founding(self) -> bool:
        """Whether these are a fleet file's electors, which no change has touched; nodes compare their files then."""
        return self.number <= 1 and all(one.joining == 0 for one in self.electors)

    @cached_property
    def names(self) -> tuple[NodeId, ...]:
        """The electors' names."""
        return tuple(one.name for one in self.electors)


def terms_of(generation_id: str, number: int) -> str:
    """How beats tell a generation and a number.

    >>> terms_of("8d3f0a1152b64c70aa", 3)
    '8d3f0a1152b64c70/3'
    """
    return f"{generation_id[:TOLD_DIGITS]}/{number}"


def generation_in(terms: str) -> str:
    """The generation that a beat's terms name; empty: they are of a fleet file, which names none.

    >>> generation_in("8d3f0a1152b64c70/3, clock in doubt"), generation_in("0123456789abcdef")
    ('8d3f0a1152b64c70', '')
    """
    named, is_named, _ = terms.partition("/")
    return named if is_named else ""


def electorate_of(names: Iterable[NodeId]) -> Electorate:
    """Electors without a number: of a register that no fleet value governs."""
    return Electorate(electors=tuple(Elector(name=name) for name in names))


class FleetValue(Struct, frozen=True, kw_only=True, dict=True):
    """What the fleet register holds.

    ``revision`` rises by one with every change, ``number`` only when the electors or the lease length change.
    What follows from the fields is worked out once (``dict``): every beat asks for it.
    """

    fleet: str
    generation_id: str
    """Random, drawn when the generation began: two generations never have the same."""
    revision: int
    number: int
    electors: tuple[Elector, ...]
    """Sorted by name."""
    settled: bool
    """A majority of these electors holds what was chosen before them, and no lease by the number before is left."""
    lease_s: float
    guard_lease_s: float
    """The longest lease that may still run: of this number or, until somebody has waited a guard time, of one before.
    Who settles waits only where a task is exclusive; else it stays, for a task that comes back as an exclusive one."""
    creations: int = 0
    """How many tasks were ever created in this fleet: the next one's number is one more."""
    tasks: tuple[Creation, ...] = ()
    """Sorted by task: the registers that electors answer for."""
    document: str = ""
    """Hash of the document's content; empty: each node goes by its own fleet file."""
    parent_id: str = ""
    """Generation from which this one was recovered; empty: from none."""
    away: tuple[NodeId, ...] = ()
    """Sorted: robots that do not count in votes, because the electors have not heard them for long."""
    recovered_by: NodeId = ""
    """The node on which an operator has recovered this generation; empty: it was founded."""

    def __post_init__(self) -> None:
        check_name("fleet.fleet", self.fleet)
        for what in ("generation_id", "document", "parent_id"):
            check_id(f"fleet.{what}", getattr(self, what))
        for what in ("revision", "number", "creations"):
            check_counter(f"fleet.{what}", getattr(self, what))
        check_range("fleet.lease_s", self.lease_s, 0.0, MAX_LEASE_S)
        check_range("fleet.guard_lease_s", self.guard_lease_s, self.lease_s, MAX_LEASE_S)
        _check_sorted("fleet.electors", [one.name for one in self.electors])
        _check_sorted("fleet.tasks", [one.task for one in self.tasks])
        _check_sorted("fleet.away", list(self.away))
        if self.recovered_by:
            check_name("fleet.recovered_by", self.recovered_by)
        if not self.electors:
            raise ValueError("fleet.electors: a fleet has at least one elector")
        if any(one.joining > self.number for one in self.electors):
            raise ValueError("fleet.electors: an elector joined under a later number")
        if any(one.number > self.creations for one in self.tasks):
            raise ValueError("fleet.tasks: a task has a number that no creation has had")

    @property
    def task(self) -> str:
        """The name of its register: the fleet's."""
        return self.fleet

    @cached_property
    def electorate(self) -> Electorate:
        """With whom rounds under this value count."""
        return Electorate(generation_id=self.generation_id, number=self.number, electors=self.electors)

    @property
    def terms(self) -> str:
        """What leases hang on, as beats tell it: the generation, and the number in it."""
        return terms_of(self.generation_id, self.number)

    @property
    def is_founding(self) -> bool:
        """Whether its electorate is one that no change has touched (`Electorate.is_founding`)."""
        return self.electorate.is_founding

    def creation(self, task: TaskId) -> Creation | None:
        """The creation of ``task``; ``None``: the document does not list it."""
        return next((one for one in self.tasks if one.task == task), None)

    @property
    def is_exclusive(self) -> bool:
        """Whether any task is exclusive."""
        return any(one.exclusive for one in self.tasks)


def _check_sorted(field: str, names: list[str]) -> None:
    if any(one >= other for one, other in pairwise(names)):
        raise ValueError(f"{field}: not sorted by name, or a name stands twice")
