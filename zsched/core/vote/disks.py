"""VOTE: how long a save takes on the electors' disks, and whose disk refuses it.

An elector's loop stands still in a save, and its answer waits for it. The clocks of a vote leave room for that
(`Timing.paced`): a proposer that is quicker than the disks would begin again and again.

Knows: what nodes tell of their last saves. Does not know: disks, ballots.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from zsched.core.values.beat import Beat
from zsched.core.values.model import NodeId
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, field


class Disks(Struct):
    """The disks of one fleet, as one node knows them."""

    save_s: float = 0.0
    """Of this node: the last save, or half of the one before where that is longer."""
    refusal: str = ""
    """Why this node's disk has refused a save; empty: it has not."""
    _told: dict[NodeId, tuple[float, str]] = field(default_factory=dict)
    """{peer: (the same two, of its newest beat)}, of those that told any."""

    def on_saved(self, took_s: float) -> None:
        """This node's state is on disk."""
        self.save_s = max(took_s, self.save_s / 2)

    def hear(self, beat: Beat) -> bool:
        """A peer's beat; whether it tells something new."""
        told = beat.save_s, beat.disk_refusal
        if told == self._told.get(beat.node, (0.0, "")):
            return False
        self._told[beat.node] = told
        return True

    def pace_s(self, me: NodeId, electors: Collection[NodeId]) -> float:
        """How long a save takes until a majority of the electors has made it, and this node."""
        saves = sorted(self.save_s if name == me else self._told.get(name, (0.0, ""))[0] for name in electors)
        return max(self.save_s, saves[majority(len(saves)) - 1] if saves else 0.0)

    def refusals(self) -> Mapping[NodeId, str]:
        """{peer: why its disk refuses what must be saved}."""
        return {name: why for name, (_, why) in sorted(self._told.items()) if why}

    def slow(self, me: NodeId, limit_s: float) -> Mapping[NodeId, float]:
        """{node: how long a save takes there} where that is longer than ``limit_s``."""
        told = {**{name: save_s for name, (save_s, _) in self._told.items()}, me: self.save_s}
        return {name: save_s for name, save_s in sorted(told.items()) if save_s > limit_s}
