"""Membership, this node's own name: is it ours alone, and do all nodes have the same fleet file?

Knows: beats in our own name, peers' answers about it, hashes of fleet files. Does not know: what follows (the node
stands down, or reports it).

Two machines with one name must not both vote as one elector. The younger daemon (with fewer beats) leaves at its start.
If both stay, both stop being electors, on disk, until the operator settles the dispute. Beats alone prove no second
machine, since anybody can send one: without a liveliness token of that life they are only a complaint. Twins without a
link between them learn of each other from a node that hears both (`zsched.core.membership.namesakes`). A peer's beat
only makes them ask, and only answers count, over `TOLD_FOR_S`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum

from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

YOUNG_S = 3.0
"""A daemon that finds its own name alive within this time after its start leaves again."""
TOLD_YOUNG_S = 10.0
"""The same when a peer reports it: the peer must hear both for a while first."""
TOLD_FOR_S = 1.0
"""Peers' answers about a twin must hold for this long, so that all peers have seen it."""
ASK_TWINS_S = 0.5
"""A peer whose beats say that our name lives twice is asked at most this often."""
STAYS_S = 5.0
"""A twin that stays for this long disputes the name."""


QUIET_S = 10.0
"""Older beats in our name are no complaint any more."""


def here(fleet_file: str, path: str) -> str:
    """Our own fleet file in words: its hash, and its path where that is known."""
    return f"here {fleet_file}{' of ' if path else ''}{path}"


ONE_FILE = (
    "compare them (`zsched check` tells a file's hash), give all nodes the same one, and `systemctl reload zsched` "
    "where another was. If they name other electors, restart no daemon: docs/guide/service.md, Add or remove a machine"
)
"""The advice for two different fleet files."""


class Verdict(StrEnum):
    """The verdict on a beat in our own name."""

    OURS = "ours"  # our own, or the echo of an earlier life
    TWIN = "twin"  # somebody else, wait and see
    LEAVE = "leave"  # we came later
    DISPUTE = "dispute"  # neither leaves


class Identity(Struct):
    """This node's knowledge about its own name and file."""

    me: NodeId
    in_force: InForce
    incarnation: int
    started_at: float
    _twin: tuple[int, int, float] | None = field(default=None)
    """(incarnation, first sequence, since when) of another daemon with our name."""
    _tokens: set[int] = field(default_factory=set)
    """Incarnations of other daemons with our name that have a token."""
    _heard_at: float = -math.inf
    _told: tuple[NodeId, float] = ("", -math.inf)
    """(peer that last answered that it hears another daemon of our name, when)."""
    _asked_at: dict[NodeId, float] = field(default_factory=dict)

    def complaint(self, now: float) -> str | None:
        """The complaint that status shows; ``None``: nobody else uses the name."""
        peer, told_at = self._told
        is_told = now < told_at + QUIET_S
        if self._tokens or is_told:
            heard, asked = (f": {peer} hears it", peer) if is_told else ("", "NODE")
            return (
                f"another daemon calls itself {self.me!r}{heard}; stop it, or give this machine a name of its own "
                f"(`zsched status --node {asked}` shows the addresses of both)"
            )
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
        """Whether to ask a peer whose beat says that our name lives twice; a yes counts as asked."""
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
        """The verdict on another life of our name whose newest beat is ``sequence``."""
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
        lived_s = (sequence - self._twin[1]) * self.in_force.timing.beat_s  # beats also count how long it has stayed
        return Verdict.DISPUTE if min(now - self._twin[2], lived_s) >= STAYS_S else Verdict.TWIN

    def file_complaint(self, beat: Beat, path: str = "", *, is_agreed: bool = False) -> str | None:
        """How a peer's fleet file differs from ours, at ``path``; ``None``: it is the same, or the peer names none.

        ``is_agreed``: the fleet goes by an agreed document, and no file counts.
        """
        if beat.fleet_file in ("", self.in_force.file):
            return None
        if is_agreed:
            return (
                f"{beat.node} does not go by the agreed document that this node goes by ({beat.fleet_file}, here "
                f"{self.in_force.file}): if that lasts, `zsched status` on that machine says why (its disk may be full)"
            )
        ours = here(self.in_force.file, path)
        return f"{beat.node} goes by another fleet file ({beat.fleet_file}, {ours}): {ONE_FILE}"
