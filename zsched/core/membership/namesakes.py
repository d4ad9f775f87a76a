"""Membership, peers' names: does a peer's name live twice?

Twins that hear each other find it out themselves (`zsched.core.membership.identity`). Twins without a link between them
never would. So a node that hears both reports it to the operator, and to the twins in its beats and answers.

One frame proves nothing: both lives must have a token here, and the beats of both must rise side by side for a while. A
restarted node also shows two tokens for a moment, and its old link delivers the rest of its beats at once.

Knows: tokens and beats of every life of a name. Does not know: which of the two is right, what the twins do.
"""

from __future__ import annotations

import math

from zsched.core.membership.identity import QUIET_S
from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

BESIDE_S = 1.0
"""Two lives are twins when both have beaten side by side for this long..."""
BESIDE_BEATS = 3
"""...and for this many beats."""
LIVES_KEPT = 8
"""Tokens of one name that are kept; a stranger may show any number."""
TWINS_TOLD = 4
"""Names of twins in one beat."""
WHERE_EVERY_S = 2.0
"""A name that lives twice is asked for its addresses at most this often."""


class _Life(Struct):
    sequence: int
    at: float
    since: float | None = None
    """First beat beside another life's."""
    where: str = ""

    def stays_s(self) -> float:
        return 0.0 if self.since is None else self.at - self.since


class _Name(Struct):
    tokens: set[int] = field(default_factory=set)
    lives: dict[int, _Life] = field(default_factory=dict)
    """{incarnation: life}, of those that have beaten since there were two tokens."""
    twins_at: float = -math.inf
    """When two lives were last seen beside each other."""
    told: str = ""
    """Those two lives."""
    asked_at: float = -math.inf


class Namesakes:
    """The daemons with a shared name that one node hears."""

    def __init__(self, in_force: InForce) -> None:
        self._in_force = in_force
        self._names: dict[NodeId, _Name] = in_force.by_node()
        self._watched: dict[NodeId, _Name] = in_force.by_node()
        """Names with two tokens: usually none. The set is kept because thirty beats a second are looked up."""

    @property
    def _beside_s(self) -> float:
        return max(BESIDE_S, BESIDE_BEATS * self._in_force.timing.rest_beat_s)

    def on_token(self, node: NodeId, incarnation: int, *, is_present: bool) -> None:
        """A peer's token came or went."""
        name = self._names.get(node)
        if name is None:
            if not is_present:
                return
            name = self._names[node] = _Name()
        if not is_present:
            name.tokens.discard(incarnation)
            name.lives.pop(incarnation, None)
        elif len(name.tokens) < LIVES_KEPT:
            name.tokens.add(incarnation)
        if len(name.tokens) > 1:
            self._watched[node] = name
        elif self._watched.pop(node, None) is not None:
            name.lives.clear()

    def on_beat(self, beat: Beat, now: float) -> bool:
        """A beat came, believed or not; whether this showed that its name lives twice."""
        if beat.node not in self._watched:
            return False
        name = self._watched[beat.node]
        if beat.incarnation not in name.tokens:
            return False
        life = name.lives.get(beat.incarnation)
        if life is None:
            life = name.lives[beat.incarnation] = _Life(beat.sequence, now)
        elif beat.sequence <= life.sequence:
            return False
        life.sequence, life.at = beat.sequence, now
        if life.since is None and len(name.lives) > 1:
            life.since = now
        twins = self._beside(name, now)
        if len(twins) < 2:
            return False
        was_known = now < name.twins_at + QUIET_S
        name.twins_at, name.told = now, self._text(beat.node, name, twins)
        return not was_known

    def _beside(self, name: _Name, now: float) -> list[int]:
        """The lives that have beaten side by side for long enough, and still do."""
        lives = name.lives.items()
        return sorted(one for one, life in lives if life.stays_s() >= self._beside_s > now - life.at)

    def on_answer(self, node: NodeId, incarnation: int, where: str) -> None:
        """A daemon has answered with its address."""
        name = self._watched.get(node)
        if name is not None and where and incarnation in name.lives:
            name.lives[incarnation].where = where

    def must_ask(self, node: NodeId, now: float) -> bool:
        """Whether to ask a name's daemons for their addresses; a yes counts as asked."""
        name = self._watched.get(node)
        if name is None or now - name.asked_at < WHERE_EVERY_S:
            return False
        if now - name.twins_at >= self._beside_s or all(name.lives[one].where for one in self._beside(name, now)):
            return False
        name.asked_at = now
        return True

    def names(self, now: float) -> tuple[NodeId, ...]:
        """The names that live twice right now, for a beat."""
        if not self._watched:
            return ()
        return tuple(sorted(node for node, name in self._watched.items() if len(self._beside(name, now)) > 1))[
            :TWINS_TOLD
        ]

    def lives(self, now: float) -> tuple[tuple[NodeId, int, int], ...]:
        """(name, incarnation, number of the newest beat) of every daemon of these names, for an answer."""
        watched = self._watched
        return tuple(
            (node, one, watched[node].lives[one].sequence)
            for node in self.names(now)
            for one in self._beside(watched[node], now)
        )

    def problems(self, now: float) -> tuple[str, ...]:
        """The status lines; a twin that a service manager restarts returns before it is forgotten."""
        return tuple(name.told for _, name in sorted(self._names.items()) if now < name.twins_at + QUIET_S)

    def _text(self, node: NodeId, name: _Name, twins: list[int]) -> str:
        places = [f"{name.lives[one].where or 'somewhere'} (incarnation {one})" for one in twins]
        return (
            f"{len(twins)} daemons call themselves {node!r}: {', '.join(places)}; "
            "stop one, or give its machine a name of its own"
        )
