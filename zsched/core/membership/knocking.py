"""Membership, unknown nodes: which names beat in this fleet but are not in its file?

A fleet file with a new node does not reach all machines at once. The new node sees another hash and reports it; the
others do not know the node and would report nothing. Such beats only lead to a line in the status.

Knows: names and beats of unknown nodes. Does not know: the other content of their beats.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zsched.core.membership.identity import ONE_FILE, QUIET_S, here
from zsched.core.values.model import Beat, NodeId

SHOWN_AFTER_S = 5.0
"""A node that leaves beats for a moment after it is out of the document; one that goes on for longer is told."""
KNOCKERS_KEPT = 4
"""Unknown names that status shows; a stranger may invent any number."""


@dataclass(slots=True)
class Knocking:
    """The unknown nodes that one node hears, with its own fleet file's hash."""

    fleet_file: str
    _heard: dict[NodeId, tuple[Beat, float, float]] = field(default_factory=dict)
    """{name: (newest beat, when, since when without a long break)}."""

    def adopt(self, fleet_file: str, nodes: frozenset[NodeId]) -> None:
        """The fleet file has this hash and names these nodes, from now on."""
        self.fleet_file = fleet_file
        self._heard = {name: known for name, known in self._heard.items() if name not in nodes}

    def on_beat(self, beat: Beat, now: float) -> None:
        """A beat of a node that the fleet file does not name."""
        self._heard = {name: known for name, known in self._heard.items() if now < known[1] + QUIET_S}
        if beat.node in self._heard or len(self._heard) < KNOCKERS_KEPT:
            known = self._heard.get(beat.node)
            self._heard[beat.node] = (beat, now, now if known is None else known[2])

    def problems(self, now: float, path: str = "", *, is_agreed: bool = False) -> tuple[str, ...]:
        """The status lines about unknown nodes that were heard lately.

        Args:
            now: monotonic seconds.
            path: where our own fleet file is.
            is_agreed: the fleet goes by an agreed document, not by a file on each machine.
        """
        heard = [
            (name, beat)
            for name, (beat, at, since) in sorted(self._heard.items())
            if now < at + QUIET_S and at >= since + SHOWN_AFTER_S
        ]
        if is_agreed:
            return tuple(
                f"fleet/{name}: {name} beats in this fleet, and the agreed document does not name it: `zsched leave` "
                f"on that machine if it was taken out, `zsched invite {name}` here if it shall come"
                for name, _ in heard
            )
        ours = here(self.fleet_file, path)
        return tuple(
            f"fleet/{name}: {name} beats in this fleet, goes by another fleet file ({beat.fleet_file or 'not told'}, "
            f"{ours}), and is in no line of this one: {ONE_FILE}"
            for name, beat in heard
        )
