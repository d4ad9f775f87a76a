"""Membership's question about ourselves: is our name ours alone, and do all go by the same fleet file?

Knows: beats in our own name, hashes of fleet files. Does not know: what follows (the node stands down, or says so).

Two machines with one name must not both vote as one elector. The younger daemon (it has beaten less often) leaves
again at its start; if both stay, both stop being electors, on disk, until the operator settles it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from zsched.core.model import Beat, NodeId

YOUNG_S = 3.0
"""A daemon that finds its own name alive so soon after its start leaves again."""
STAYS_S = 5.0
"""A twin that stays so long disputes the name."""


class Verdict(StrEnum):
    """What a beat in our own name means."""

    OURS = "ours"  # our own, or the echo of an earlier life
    TWIN = "twin"  # somebody else, wait and see
    LEAVE = "leave"  # we came later
    DISPUTE = "dispute"  # neither leaves


@dataclass(slots=True)
class Identity:
    """What this node knows about its own name and file."""

    me: NodeId
    incarnation: int
    fleet_file: str
    started_at: float
    _twin: tuple[int, int, float] | None = field(default=None)
    """(incarnation, first sequence, since when) of another daemon with our name."""

    @property
    def complaint(self) -> str:
        """How status says that the name is not ours alone."""
        return f"another daemon calls itself {self.me!r}"

    def on_own_name(self, beat: Beat, my_sequence: int, now: float) -> Verdict:
        """Judge a beat in our own name.

        Args:
            beat: it.
            my_sequence: number of our own newest beat.
            now: monotonic seconds.
        """
        if beat.incarnation == self.incarnation:
            return Verdict.OURS
        if self._twin is None or self._twin[0] != beat.incarnation:
            self._twin = (beat.incarnation, beat.sequence, now)
            return Verdict.TWIN
        if beat.sequence <= self._twin[1]:
            return Verdict.TWIN  # an echo of an earlier life does not rise
        # Beats are as many as a life is old: who has sent fewer came later.
        is_younger = (my_sequence, -self.incarnation) < (beat.sequence, -beat.incarnation)
        if is_younger and now - self.started_at < YOUNG_S:
            return Verdict.LEAVE
        return Verdict.DISPUTE if now - self._twin[2] >= STAYS_S else Verdict.TWIN

    def file_complaint(self, beat: Beat) -> str | None:
        """How a peer's fleet file differs from ours; ``None`` when it does not, or the peer does not say."""
        if beat.fleet_file in ("", self.fleet_file):
            return None
        return f"{beat.node} goes by another fleet file ({beat.fleet_file}, here {self.fleet_file})"
