"""VOTE, a changed tuning in the fleet file: one node proposes it to the task's register, for all robots at once.

A task's tuning is agreed: the file's counts for its first value only. When a node takes over a file with another
tuning, it wants these fields changed in the agreed one. All nodes that take the file over want the same. So they try
one after another, by rank, and the first success ends it for all. A tuning that somebody else has changed meanwhile is
left as it is: the newer word counts. What an earlier file wants, and is not agreed yet, is wanted with the rest. Some
settings are the file's unless an operator has set them; a file that changes such a setting ends what the operator has
set. A node that was away and takes over what the others go by already wants nothing: they have had it agreed, and what
operators have tuned since is newer.

Knows: which fields differ, whose turn it is, who had a newer document when it was first heard. Does not know: how a
value is agreed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from zsched.core.values.change import Retune
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, NodeId, TaskId, Tuning
from zsched.core.values.struct import Struct, field, replace

RANK_S = 0.5
"""The next node in rank proposes a changed tuning of the fleet file this much later."""
AGAIN_S = 5.0
"""A changed tuning of the fleet file that found no quorum is proposed again this much later."""


class _Wish(Struct):
    seen: tuple[Tuning, ...]
    """The agreed tuning when the file was taken over, and what earlier files wanted of it: that may be agreed yet."""
    wanted: Tuning
    at: float

    @property
    def is_back(self) -> bool:
        """Whether it may be agreed already while the wish of an earlier file, which it takes back, is under way."""
        return len(self.seen) > 1 and self.wanted in self.seen


class Retuning(Struct):
    """What one node wants changed in agreed tunings."""

    me: NodeId
    in_force: InForce
    _wishes: dict[TaskId, _Wish] = field(default_factory=dict)
    _heard: dict[NodeId, None] = field(default_factory=dict)
    """The peers that are heard, or were until a moment ago."""
    _ahead: dict[NodeId, int] = field(default_factory=dict)
    """{peer: its fleet value's revision} of those that had a newer one when they were first heard, while we lack it."""

    def __post_init__(self) -> None:
        self._heard, self._ahead = self.in_force.by_node(), self.in_force.by_node()
        self._wishes = self.in_force.by_task()

    def hear(self, peer: NodeId, revision: int, ours: int) -> None:
        """A peer's beat tells the revision of its fleet value; ``ours`` is this node's."""
        if peer not in self._heard:
            self._heard[peer] = None
            if revision > ours:
                self._ahead[peer] = revision
        elif peer in self._ahead:
            self._ahead[peer] = min(revision, self._ahead[peer])  # revisions only rise: what falls was no true word
            if ours >= self._ahead[peer]:
                del self._ahead[peer]

    def on_gone(self, peer: NodeId) -> None:
        """A peer is gone: what it has when it is heard again may be old for all others."""
        self._heard.pop(peer, None)
        self._ahead.pop(peer, None)

    def want(self, old: Fleet, values: Mapping[TaskId, Allocation], now: float) -> None:
        """Want what differs from ``old``; a task that was never agreed begins with the tuning in force."""
        known = {task.name: task for task in old.tasks}
        rank = list(self.in_force.nodes).index(self.me)
        for task in self.in_force.fleet.tasks:
            value = values[task.name]
            changed = _changed(known.get(task.name, task), task)
            if changed and value.revision > 0 and not self._ahead:
                seen: tuple[Tuning, ...] = (value.tuning,)
                before = self._wishes.get(task.name)
                if before is not None and value.tuning in before.seen:  # it is not agreed yet
                    seen = (*before.seen, before.wanted)
                wanted = replace(seen[-1], **changed)
                self._wishes[task.name] = _Wish(seen=seen, wanted=wanted, at=now + rank * RANK_S)

    def due(self, values: Mapping[TaskId, Allocation], now: float) -> Iterator[tuple[TaskId, Retune]]:
        """The changes to propose now."""
        for task, wish in tuple(self._wishes.items()):
            value = values[task]
            is_there = value.tuning == wish.wanted and (now >= wish.at + AGAIN_S or not wish.is_back)
            if value.tuning not in wish.seen or is_there:
                del self._wishes[task]
            elif now >= wish.at and value.tuning != wish.wanted:
                wish.at = now + AGAIN_S
                yield task, Retune(base_revision=value.revision, tuning=wish.wanted)

    @property
    def is_idle(self) -> bool:
        """Whether nothing is wanted."""
        return not self._wishes


def _changed(before: TaskSpec, after: TaskSpec) -> dict[str, Any]:
    """What a changed file wants of the agreed tuning; a setting that the file keeps for itself is left to it again."""
    old, new = before.in_force(before.tuning), after.in_force(after.tuning)
    differing = {one.name for one in fields(Tuning) if getattr(old, one.name) != getattr(new, one.name)}
    return {one.name: getattr(after.tuning, one.name) for one in fields(Tuning) if one.name in differing}
