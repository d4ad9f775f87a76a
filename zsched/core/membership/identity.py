"""Membership's question about ourselves: is our name ours alone, and do all go by the same fleet file?

Knows: beats in our own name, what peers answer about it, hashes of fleet files. Does not know: what follows (the node
stands down, or says so).

Two machines with one name must not both vote as one elector. The younger daemon (it has beaten less often) leaves
again at its start; if both stay, both stop being electors, on disk, until the operator settles it. Beats alone prove no
second machine: anybody can put one. Without that life's liveliness token they are a complaint, and nothing else.
Twins without a link between them learn it from whoever hears both (`zsched.core.membership.namesakes`): a peer's beat
makes them ask it, and only answers count, over `TOLD_FOR_S`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from zsched.core.values.model import Beat, NodeId

YOUNG_S = 3.0
"""A daemon that finds its own name alive so soon after its start leaves again."""
TOLD_YOUNG_S = 10.0
"""...or that is told so by a peer, who must hear both for a while first."""
TOLD_FOR_S = 1.0
"""What peers answer about a twin must have held for so long: time for all of them to see it, too."""
ASK_TWINS_S = 0.5
"""A peer that says that our name lives twice is asked about it so often at most."""
STAYS_S = 5.0
"""A twin that stays so long disputes the name."""


QUIET_S = 10.0
"""Beats in our name that were heard so long ago are no complaint any more."""


def here(fleet_file: str, path: str) -> str:
    """Our own fleet file, to be found and compared: its hash, and its path where that is known."""
    return f"here {fleet_file}{' of ' if path else ''}{path}"


ONE_FILE = "compare them (`zsched check` tells a file's hash), give all nodes the same one, restart who had another"
"""What to do about two fleet files."""


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
    beat_s: float
    """Between two beats: how long another daemon has stayed is counted by its own beats, too."""
    _twin: tuple[int, int, float] | None = field(default=None)
    """(incarnation, first sequence, since when) of another daemon with our name."""
    _tokens: set[int] = field(default_factory=set)
    """Incarnations of other daemons with our name whose tokens are there."""
    _heard_at: float = -math.inf
    _told: tuple[NodeId, float] = ("", -math.inf)
    """(peer that last answered that it hears another daemon of our name, when)."""
    _asked_at: dict[NodeId, float] = field(default_factory=dict)

    def complaint(self, now: float) -> str | None:
        """How status says that the name is not ours alone; ``None``: nobody else uses it."""
        if self._tokens:
            return f"another daemon calls itself {self.me!r}"
        peer, told_at = self._told
        if now < told_at + QUIET_S:
            return f"another daemon calls itself {self.me!r}: {peer} hears it"
        if now < self._heard_at + QUIET_S:
            return f"somebody sends beats in the name of {self.me!r}, and no daemon of that name is seen"
        return None

    def on_token(self, incarnation: int, *, is_present: bool) -> None:
        """A token of our name came or went."""
        if incarnation != self.incarnation:
            (self._tokens.add if is_present else self._tokens.discard)(incarnation)

    def on_own_name(self, beat: Beat, my_sequence: int, now: float) -> Verdict:
        """Judge a beat in our own name.

        Args:
            beat: it.
            my_sequence: number of our own newest beat.
            now: monotonic seconds.
        """
        if beat.incarnation == self.incarnation:
            return Verdict.OURS
        self._heard_at = now
        verdict = self._judge(beat.incarnation, beat.sequence, my_sequence, now, YOUNG_S)
        # a stranger has no daemon
        return verdict if beat.incarnation in self._tokens else Verdict.TWIN

    def must_ask(self, peer: NodeId, now: float) -> bool:
        """A peer's beat says that our name lives twice: whether to ask it; then it is taken as asked."""
        if now - self._asked_at.get(peer, -math.inf) < ASK_TWINS_S:
            return False
        self._asked_at[peer] = now
        return True

    def on_told(self, peer: NodeId, lives: Mapping[int, int], my_sequence: int, now: float) -> Verdict:
        """Judge a peer's answer to our question.

        Args:
            peer: who has answered.
            lives: {incarnation: number of its newest beat} of the daemons of our name that it hears.
            my_sequence: number of our own newest beat.
            now: monotonic seconds.
        """
        others = [(sequence, incarnation) for incarnation, sequence in lives.items() if incarnation != self.incarnation]
        if self.incarnation not in lives or not others:
            return Verdict.OURS  # it has not heard this life: what it knows is of an earlier one
        self._told = (peer, now)
        sequence, incarnation = max(others)
        verdict = self._judge(incarnation, sequence, my_sequence, now, TOLD_YOUNG_S)
        is_lasting = self._twin is not None and now - self._twin[2] >= TOLD_FOR_S
        return verdict if is_lasting else Verdict.TWIN

    def _judge(self, incarnation: int, sequence: int, my_sequence: int, now: float, young_s: float) -> Verdict:
        """What another life of our name means whose newest beat is ``sequence``."""
        if self._twin is None or self._twin[0] != incarnation:
            self._twin = (incarnation, sequence, now)
            return Verdict.TWIN
        if sequence <= self._twin[1]:
            return Verdict.TWIN  # an echo of an earlier life does not rise
        # Beats are as many as a life is old: who has sent fewer came later.
        is_younger = (my_sequence, -self.incarnation) < (sequence, -incarnation)
        if is_younger and now - self.started_at < young_s:
            return Verdict.LEAVE
        # Of a node that stood still itself while the other one came and left, only the time between two beats is long.
        lived_s = (sequence - self._twin[1]) * self.beat_s
        return Verdict.DISPUTE if min(now - self._twin[2], lived_s) >= STAYS_S else Verdict.TWIN

    def file_complaint(self, beat: Beat, path: str = "") -> str | None:
        """How a peer's fleet file differs from ours, at ``path``; ``None``: it does not, or the peer does not say."""
        if beat.fleet_file in ("", self.fleet_file):
            return None
        ours = here(self.fleet_file, path)
        return f"{beat.node} goes by another fleet file ({beat.fleet_file}, {ours}): {ONE_FILE}"
