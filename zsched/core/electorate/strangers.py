"""Nodes of this fleet that count by another generation: a half that was recovered apart, or that stayed behind.

Nothing crosses generations by itself: no value, answer, beat or grant. A node changes sides only by its operator's word
(`zsched fleet recover --rejoin`), and starts blank there. So both sides show the stranger, and how it is brought over.

Knows: which generation a beat or an answer names. Does not know: what becomes of a stranger's frames.
"""

from __future__ import annotations

from functools import lru_cache

from zsched.core.electorate.founding import founded_id
from zsched.core.values.beat import Beat
from zsched.core.values.electorate import SAID_DIGITS, TOLD_DIGITS, FleetValue, generation_in
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

SHOWN_S = 10.0
"""A node of another generation that was not heard for this long is not shown any more."""
ASK_S = 5.0
"""A stranger is asked at most this often who has recovered its generation."""
KEPT = 16
"""Generations whose recovering node is remembered: a stranger may invent any number."""

_told_of_file = lru_cache(maxsize=8)(lambda fleet, generation: founded_id(fleet, generation)[:TOLD_DIGITS])


class Strangers(Struct):
    """The strangers that one node hears.

    Args:
        in_force: the fleet. After its ``suspect_s`` without a beat of this node's generation a stranger's other frames
            do not count. A single forged beat thus ends nothing.
    """

    in_force: InForce
    _heard: dict[NodeId, tuple[str, float]] = field(default_factory=dict)
    """{node: (its generation as told, when)}."""
    _ours_at: dict[NodeId, float] = field(default_factory=dict)
    """{node: when it last beat by this node's generation}."""
    _by: dict[str, str] = field(default_factory=dict)
    """{generation as told: who has recovered it; empty: nobody}."""
    _asked_at: dict[NodeId, float] = field(default_factory=dict)

    def hear(self, beat: Beat, ours: str, *, is_named: bool, now: float) -> bool:
        """Whether a beat is of another generation than ``ours``.

        Args:
            beat: of a node of the fleet.
            ours: id of this node's generation; empty: it does not know one yet.
            is_named: this node's generation has an id that its fleet file does not tell. Nodes that all go by their
                files are told apart by the generation that operators count.
            now: monotonic seconds.
        """
        told = self.told(beat, ours, is_named=is_named)
        if told is None:
            return False
        if told == ours[:TOLD_DIGITS]:
            self._ours_at[beat.node] = now
            if self._heard:
                self._heard.pop(beat.node, None)
            return False
        self._heard[beat.node] = told, now
        return True

    def told(self, beat: Beat, ours: str, *, is_named: bool) -> str | None:
        """The generation that a beat tells (`hear`); ``None``: it cannot be compared with ``ours``."""
        named = generation_in(beat.lease_terms)
        if not ours or not (named or is_named):
            return None
        return named or _told_of_file(self.in_force.fleet.name, beat.generation)

    def is_one(self, node: NodeId, now: float) -> bool:
        """Whether a node's other frames are a stranger's."""
        silence_s = self.in_force.timing.suspect_s
        return node in self._heard and now - self._ours_at.get(node, -silence_s) >= silence_s

    def must_ask(self, node: NodeId, now: float) -> bool:
        """Whether to ask a stranger by whom it was recovered; a yes counts as asked."""
        told, _ = self._heard[node]
        if told in self._by or now - self._asked_at.get(node, -ASK_S) < ASK_S:
            return False
        self._asked_at[node] = now
        return True

    def on_learnt(self, learnt: Learnt, ours: FleetValue | None, *, is_named: bool) -> bool:
        """Whether learnt values are of another generation; then who has recovered it is remembered."""
        value = learnt.fleet
        if ours is None or not (value is not None or is_named):
            return False
        told = founded_id(self.in_force.fleet.name, learnt.generation) if value is None else value.generation_id
        if told == ours.generation_id:
            return False
        if len(self._by) < KEPT:
            self._by[told[:TOLD_DIGITS]] = "" if value is None else value.recovered_by
        return True

    def forget(self, now: float) -> None:
        """Strangers that are not heard any more are not shown."""
        for node, (_, at) in tuple(self._heard.items()):
            if now - at >= SHOWN_S:
                del self._heard[node]

    def problems(self, ours: FleetValue | None) -> dict[NodeId, str]:
        """{node: which node is a stranger, and what brings it or this node over}."""
        if ours is None or not self._heard:
            return {}
        here = _called(ours.generation_id, ours.recovered_by)
        return {
            node: (
                f"{node} counts by another generation of this fleet, {_called(told, self._by.get(told, ''))}; this "
                f"node by {here}; nothing passes between them. The side that has a quorum stays. To bring {node} over: "
                f"`zsched fleet recover --rejoin {ours.generation_id[:SAID_DIGITS]}` there; only where this side has "
                f"no quorum, to bring this node over: `zsched fleet recover --rejoin {told[:SAID_DIGITS]}` here"
            )
            for node, (told, _) in sorted(self._heard.items())
        }


def _called(generation_id: str, recovered_by: str) -> str:
    """A generation in words."""
    return generation_id[:SAID_DIGITS] + (f" (recovered by {recovered_by})" if recovered_by else "")
