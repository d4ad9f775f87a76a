"""VOTE, a task's register: what a round must know of an allocation.

Knows: allocations and their changes, which instructions a round's questions are. Does not know: the rules of a round
(`zsched.core.register.register`).
"""

from __future__ import annotations

from zsched.core.register.register import Register
from zsched.core.values.change import MoveOwner, Retune, Rewrite, RoundOutcome, SetHold, SetLeased
from zsched.core.values.instructions import SendAccept, SendPrepare
from zsched.core.values.messages import Accept, Prepare
from zsched.core.values.model import Allocation
from zsched.core.values.todo import ToDo


class TaskRegister(Register[Allocation]):
    """One task's register on one node.

    A change that leaves owner or tuning as they are writes nothing, so a higher epoch always means another owner.
    """

    @property
    def newest(self) -> Allocation | None:
        """The value of the higher revision among accepted and learnt; the learnt one when they are of the same."""
        accepted, learnt = self.state.accepted, self.state.learnt
        if accepted is None:
            return learnt
        return accepted.value if learnt is None or accepted.value.revision > learnt.revision else learnt

    def _highest(self, value: Allocation) -> int:
        return max(value.revision, value.epoch)

    def _prevails(self, value: Allocation) -> bool:
        """First values of a generation are equal but for their leases: what is not leased for one is so for nobody."""
        return not value.leased

    def _replaces(self, change: Rewrite[Allocation]) -> bool:
        return isinstance(change, MoveOwner)

    def _named(self, value: Allocation) -> str:
        return str(value.owner)

    def _ask(self, question: Prepare | Accept, todo: ToDo) -> None:
        if isinstance(question, Prepare):
            todo.add(SendPrepare(prepare=question, deadline_s=self._ballot_s, may_join=self._may_join))
        else:
            todo.add(SendAccept(accept=question, deadline_s=self._ballot_s, may_join=self._may_join))

    def _hand_on(self, value: Allocation, why: str | None, todo: ToDo) -> None:
        todo.learnt.append((value, why))

    def _end(self, change: Rewrite[Allocation], outcome: RoundOutcome, todo: ToDo) -> None:
        assert isinstance(change, MoveOwner | Retune | SetHold | SetLeased)
        todo.end(self.state.task, change, outcome)
