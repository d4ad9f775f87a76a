"""SCHEDULER, several tasks: one move at a time, so that no two tasks flock to the node that both see idle.

Knows: which votes are open and which commits are under way at this robot. Does not know: who is better.

Planned moves and first placements take turns; after each the figures are read again, with what the moved task will use
at its new owner (`zsched.core.scheduler.usage.Bookings`). Escapes never wait; they count the room that others are about
to take (`zsched.core.scheduler.claims`). Robots that call votes for two tasks at the same moment are settled by name: a
commit that is under way goes first, then the vote for the lower name. A vote that was won counts as a commit under way,
whoever makes it, until its value is learnt or `Turn.awaited_until`. Nothing unsafe happens when both get through all
the same (messages may be lost); then two tasks have moved by the same figures, once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from zsched.core.values.model import NodeId, TaskId


class Turn(Protocol):
    """What a task's voting shows of a move that is under way."""

    @property
    def opened_at(self) -> float | None:
        """Since when a vote on a move is open."""

    @property
    def commit(self) -> object | None:
        """A change that this robot will or does propose to the register."""

    @property
    def awaited_until(self) -> float:
        """Until when the value of a vote that was won should be learnt; in the past: nothing is awaited."""

    @property
    def called_at(self) -> float:
        """When this robot last proposed a planned move of it, first tries in vain left out."""

    def going_to(self, now: float) -> NodeId | None:
        """The node that it is about to go to; ``None``: to none that this robot knows of."""


def who_moves_first(tasks: Mapping[TaskId, Turn], mine: TaskId, *, is_called: bool, now: float) -> TaskId | None:
    """The other task whose move ``mine`` must wait for, or ``None``.

    Args:
        tasks: {task: its voting at this robot}.
        mine: whose planned move this robot would propose.
        is_called: another robot has called the vote on it already; then only a lower name's vote goes first.
        now: monotonic seconds.
    """
    others = [(name, turn) for name, turn in tasks.items() if name != mine]
    for name, turn in others:
        if turn.commit is not None or now < turn.awaited_until:
            return name
    for name, turn in others:
        if turn.opened_at is not None and (not is_called or name < mine):
            return name
    return None


def in_turn(tasks: Mapping[TaskId, Turn]) -> list[TaskId]:
    """The order in which a round judges: who has proposed longest ago first, so that nobody waits for ever.

    A first try counts only once it has succeeded, so that the second one follows it
    (`zsched.core.vote.voting.Voting.call`).
    """
    return sorted(tasks, key=lambda name: (tasks[name].called_at, name))
