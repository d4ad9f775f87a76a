"""What operators have said of nodes: which nodes take nothing new, which of them hand over what they own, until when.

Knows: the flags of the document in force, since when this node has known each of them. Does not know: how a document is
agreed (`zsched.core.electorate.orders`), what a judgement makes of a flag (`zsched.core.scheduler.decision`).

No wall time is agreed, for clocks are not compared. Every node counts a flag's time from the moment when it learnt the
flag, and the first whose time is over proposes a document without it. A node that restarts counts anew. So a flag never
ends early, and it ends late when every node was restarted meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

SPREAD_S = 0.5
"""A node proposes the end this much later than the node before it in the fleet file: usually one proposal is enough."""
AGAIN_S = 5.0
"""The end of a flag that was not agreed is proposed again after this time."""

HANDS_OVER = (FlagKind.DRAIN, FlagKind.LEAVE)
"""A node with one of these hands over what it owns."""

Known = tuple[FlagKind, NodeId, int]
"""(kind, node, revision): one order of one operator."""


class NodeFlags(Struct):
    """All nodes' flags at one node.

    ``rank`` is this node's place in the fleet file. Times are monotonic seconds.
    """

    rank: int
    flags: tuple[Flag, ...] = ()
    """Of the document in force."""
    closed: Mapping[NodeId, str] = field(default_factory=dict)
    """{node: why it takes nothing new}."""
    drained: Mapping[NodeId, str] = field(default_factory=dict)
    """{node: why it hands over what it owns}."""
    _known: dict[Known, float] = field(default_factory=dict)
    _due: dict[Known, float] = field(default_factory=dict)

    def take(self, flags: tuple[Flag, ...], now: float) -> tuple[str, ...]:
        """Another document is in force; what has changed, in sentences."""
        before, self.flags = self.flags, flags
        if flags == before:
            return ()
        known = self._known
        self._known = {_key(flag): known.get(_key(flag), now) for flag in flags}
        self._due = {
            _key(flag): self._known[_key(flag)] + flag.for_s + self.rank * SPREAD_S
            for flag in flags
            if flag.for_s is not None
        }
        drained = {flag.subject: told_flag(flag) for flag in flags if flag.kind in HANDS_OVER}
        closed = {flag.subject: told_flag(flag) for flag in flags if flag.kind is FlagKind.INELIGIBLE}
        self.drained, self.closed = drained, {**closed, **drained}
        return tuple(_changes(before, flags))

    def since(self, flag: Flag) -> float | None:
        """Since when this node knows a flag; ``None``: it does not."""
        return self._known.get(_key(flag))

    def next_deadline(self) -> float:
        """When `due` has something to say; infinity when never."""
        return min(self._due.values(), default=math.inf)

    def due(self, now: float) -> tuple[Flag, ...]:
        """The flags that stay when those are taken off whose time is over; it is told again after `AGAIN_S`."""
        over = [key for key, at in self._due.items() if now >= at]
        for key in over:
            self._due[key] = now + AGAIN_S
        return tuple(flag for flag in self.flags if not self._is_over(flag, now))

    def _is_over(self, flag: Flag, now: float) -> bool:
        return flag.for_s is not None and now >= self._known[_key(flag)] + flag.for_s


def told_flag(flag: Flag) -> str:
    """A flag in a few words, without its node and its age.

    >>> told_flag(Flag(kind=FlagKind.DRAIN, subject="edge1", by="ada@robot1", reason="new fan"))
    'drained by ada@robot1 (new fan)'
    >>> told_flag(Flag(kind=FlagKind.INELIGIBLE, subject="edge1"))
    'takes nothing new, by an operator'
    """
    who = flag.by or "an operator"
    who = f"{who} ({flag.reason})" if flag.reason else who
    return f"{_SAID[flag.kind]} {who}"


_SAID = {
    FlagKind.DRAIN: "drained by",
    FlagKind.INELIGIBLE: "takes nothing new, by",
    FlagKind.LEAVE: "leaving the fleet, by",
}
_ENDED = {
    FlagKind.DRAIN: "is not drained any more",
    FlagKind.INELIGIBLE: "may get tasks again",
    FlagKind.LEAVE: "does not leave the fleet any more",
}


def _key(flag: Flag) -> Known:
    return flag.kind, flag.subject, flag.revision


def _changes(before: tuple[Flag, ...], after: tuple[Flag, ...]) -> Iterator[str]:
    was, now = ({(flag.subject, flag.kind): flag for flag in flags} for flags in (before, after))
    for place, flag in now.items():
        if was.get(place) != flag:
            yield f"{flag.subject} {'is ' if flag.kind in HANDS_OVER else ''}{told_flag(flag)}"
    for place, flag in was.items():
        if place not in now:
            other = flag.subject in {one.subject for one in after}
            yield f"{flag.subject} {_ENDED[flag.kind]}{', and still takes nothing new' if other else ''}"
