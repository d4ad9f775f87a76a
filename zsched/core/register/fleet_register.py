"""The fleet register: what a round must know of a fleet value.

Knows: which counters a fleet value has, to whom its questions go. Does not know: the rules of a round
(`zsched.core.register.register`), which value a node follows (`zsched.core.electorate.roll`).
"""

from __future__ import annotations

from collections.abc import Callable

from zsched.core.register.register import Register
from zsched.core.values.change import Rewrite, RoundOutcome
from zsched.core.values.electorate import Electorate, FleetValue
from zsched.core.values.instructions import AskElectors
from zsched.core.values.messages import Accept, Prepare
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP


class FleetRegister(Register[FleetValue]):
    """The fleet register on one node; it begins under each number with the value that brought this number.

    What was accepted under a number before is dropped: either it is the value that was learnt, or it can be chosen no
    more. Every elector that answers under a number has learnt its first value, so a blank one reads as that.
    """

    holds: Callable[[FleetValue], bool] = staticmethod(lambda _value: True)
    """Whether the document of a value is stored here: only then this node accepts it, or asks others to accept it."""
    lacking: FleetValue | None = None
    """The newest value that a majority was found to hold, and whose document is not stored here."""

    def count_with(self, count: Electorate, *, is_elector: bool, is_blank: bool, now: float) -> None:
        """Begin under another number with what is learnt."""
        self._initial = self.value
        super().count_with(count, is_elector=is_elector, is_blank=is_blank, now=now)

    def _highest(self, value: FleetValue) -> int:
        return max(value.revision, value.number, value.creations * CREATION_STEP)

    def _prevails(self, value: FleetValue) -> bool:
        del value
        return False

    def _replaces(self, change: Rewrite[FleetValue]) -> bool:
        del change
        return False

    def _may_carry(self, value: FleetValue) -> bool:
        may = self.holds(value)
        self.lacking = None if may else value
        return may

    def _named(self, value: FleetValue) -> str:
        return f"number {value.number} with {', '.join(value.electorate.names)}"

    def _ask(self, question: Prepare | Accept[FleetValue], todo: ToDo) -> None:
        may_join = isinstance(question, Prepare) and self._running().is_ahead and self._may_join
        ask = AskElectors(to=self._count.names, question=question, deadline_s=self._ballot_s, may_join=may_join)
        todo.fleet.append(ask)

    def _hand_on(self, value: FleetValue, why: str | None, todo: ToDo) -> None:
        """The roll looks for it itself, at once: nothing may be answered before its registers count by it."""

    def _end(self, change: Rewrite[FleetValue], outcome: RoundOutcome, todo: ToDo) -> None:
        todo.fleet_ended.append((change, outcome))
