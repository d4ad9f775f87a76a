"""When the electors of a new number are settled: what an elector does for it, and how far it is.

Knows: the registers of the document, what was written under which number, the guard time, whose turn it is. Does not
know: how a round goes (`zsched.core.register.register`), whether somebody else settles (several do no harm).

1. An identity round of every task's register under the new number. It writes what it reads: from then on a majority of
   the new electors holds it, and no majority of the old ones can choose anything any more. A blank register needs no
   write.
2. When a task is exclusive, or leased: the guard time on this node's clock, by the longer lease of both numbers. What
   electors granted under the number before has then ended, also to an owner that never hears of the change.
3. The value says that it is settled, for exactly this number. A change of the document that came first is no reason to
   begin again. A settler that restarts does begin again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from zsched.core.electorate.changes import Settle
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.electorate import Electorate, FleetValue
from zsched.core.values.fleet import Timing
from zsched.core.values.lease import hold_s
from zsched.core.values.todo import ToDo


class Settling:
    """One elector's work for one number."""

    def __init__(self, clocks: Callable[[], Timing]) -> None:
        self._clocks = clocks
        self._of: Electorate | None = None
        self._whole_at: float | None = None
        """When the last identity round of this number ended."""
        self._ask_at = self._say_at = math.inf
        """When identity rounds that are missing, and the word that all is settled, are tried (again)."""

    @property
    def _pause_s(self) -> float:
        """What is missing is tried again after this time."""
        return 2 * self._clocks().ballot_s

    def begin(self, value: FleetValue, at: float, rank: int) -> None:
        """A fleet value is learnt: work for its number, from ``at`` on, unless it is settled.

        The first in ``rank`` begins then. The others would only ask the same again, so they wait until it should be
        done, one after another.
        """
        if value.settled:
            self._of, self._whole_at = None, None
        elif self._of != value.electorate:
            at += rank * self._pause_s + (_guard_s(value) if rank else 0.0)
            self._of, self._whole_at, self._ask_at, self._say_at = value.electorate, None, at, at

    def due(self, value: FleetValue, registers: Iterable[TaskRegister]) -> float:
        """When `tick` has something to do; minus infinity as soon as the last identity round has ended."""
        if self._of is None:
            return math.inf
        if _missing(value, registers):
            return self._ask_at
        return -math.inf if self._whole_at is None else self._say_at

    def tick(self, value: FleetValue, registers: Iterable[TaskRegister], todo: ToDo, now: float) -> Settle | None:
        """Do what is missing; the change to propose when nothing is."""
        missing = _missing(value, registers)
        for register in missing:
            register.settle(todo, now)
        if missing:
            self._ask_at = now + self._pause_s
            return None
        if self._whole_at is None:
            self._whole_at = now
            # Leased is what has a lease: a task may be exclusive no more by the document, and leased for a while yet.
            is_leased = any(register.value.leased for register in registers)
            self._say_at = now + (hold_s(value.guard_lease_s) if is_leased else _guard_s(value))
        if now < self._say_at:
            return None
        self._say_at = now + self._pause_s
        has_waited = now >= self._whole_at + hold_s(value.guard_lease_s)
        return Settle(base_revision=value.revision, number=value.number, has_waited=has_waited)


def _guard_s(value: FleetValue) -> float:
    """What electors granted under the number before has ended after this time (seconds)."""
    return hold_s(value.guard_lease_s) if value.is_exclusive else 0.0


def _missing(value: FleetValue, registers: Iterable[TaskRegister]) -> list[TaskRegister]:
    """The registers whose identity round under this number is still to come."""
    return [register for register in registers if register.written_under != value.electorate]
