"""Membership, unknown nodes: which names beat in this fleet but are not in its file?

A fleet file with a new node does not reach all machines at once. The new node sees another hash and reports it; the
others do not know the node and would report nothing. Such beats only lead to a line in the status.

A node that counts by another generation may also be one that our document has ceased to name, or does not name yet: a
half that was recovered goes by the document that it knew.

Knows: names and beats of unknown nodes. Does not know: the other content of their beats.
"""

from __future__ import annotations

from zsched.core.membership.identity import ONE_FILE, QUIET_S, here
from zsched.core.values.beat import Beat
from zsched.core.values.electorate import SAID_DIGITS
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId
from zsched.core.values.problems import Problem, ProblemKey
from zsched.core.values.struct import Struct, field

SHOWN_AFTER_S = 5.0
"""A node that leaves beats for a moment after it is out of the document; one that goes on for longer is told."""
KNOCKERS_KEPT = 4
"""Unknown names that status shows; a stranger may invent any number."""


class Knocking(Struct):
    """The unknown nodes that one node hears, with its own fleet file's hash."""

    in_force: InForce
    _heard: dict[NodeId, _Knock] = field(default_factory=dict)

    def on_beat(self, beat: Beat, now: float, *, generation: str = "") -> None:
        """A beat of a node that the fleet file does not name; ``generation`` if it tells of another one than ours."""
        self._heard = {name: known for name, known in self._heard.items() if now < known.at + QUIET_S}
        if beat.node in self._heard or len(self._heard) < KNOCKERS_KEPT:
            known = self._heard.get(beat.node)
            since = now if known is None else known.since
            self._heard[beat.node] = _Knock(beat=beat, at=now, since=since, generation=generation)

    def problems(self, now: float, path: str = "", *, is_agreed: bool = False) -> dict[ProblemKey, str]:
        """What to say of unknown nodes that were heard lately.

        Args:
            now: monotonic seconds.
            path: where our own fleet file is.
            is_agreed: the fleet goes by an agreed document, not by a file on each machine.
        """
        said = dict[ProblemKey, str]()
        for name, known in sorted(self._heard.items()):
            is_named = name in self.in_force.nodes
            if is_named or now >= known.at + QUIET_S or known.at < known.since + SHOWN_AFTER_S:
                continue
            if known.generation:
                said[Problem.GENERATION, name] = self._apart(name, known.generation, path, is_agreed=is_agreed)
            else:
                said[Problem.FLEET, name] = self._unnamed(name, known.beat, path, is_agreed=is_agreed)
        return said

    def _unnamed(self, name: NodeId, beat: Beat, path: str, *, is_agreed: bool) -> str:
        """A node of our own generation, or of none."""
        if is_agreed:
            return (
                f"{name} beats in this fleet, and the agreed document does not name it: `zsched leave` "
                f"on that machine if it was taken out, `zsched invite {name}` here if it shall come"
            )
        return (
            f"{name} beats in this fleet, goes by another fleet file ({beat.fleet_file or 'not told'}, "
            f"{here(self.in_force.file, path)}), and is in no line of this one: {ONE_FILE}"
        )

    def _apart(self, name: NodeId, generation: str, path: str, *, is_agreed: bool) -> str:
        """A stranger that our document does not name: an order there would change its half, not ours."""
        ours = "the document agreed here" if is_agreed else f"this node's fleet file ({here(self.in_force.file, path)})"
        return (
            f"{name} counts by another generation of this fleet, {generation[:SAID_DIGITS]}, and "
            f"{ours} does not name it; nothing passes between them. The side that has a quorum stays. To bring {name} "
            f"over: `zsched node add` here, then `zsched fleet recover --rejoin` there; only where this side has "
            f"no quorum, to bring this node over: `zsched fleet recover --rejoin {generation[:SAID_DIGITS]}` here"
        )


class _Knock(Struct, frozen=True, kw_only=True):
    """What was heard of one unknown node."""

    beat: Beat
    """The newest."""
    at: float
    """When it came."""
    since: float
    """Since when without a long break."""
    generation: str
    """What the beat tells of another generation than ours; empty: nothing."""
