"""Membership: which peers are alive, suspect or gone, by beats, tokens and second observers.

Knows: deadlines, confirmation, incarnations, its own lag. Does not know: what follows when a peer is gone.

A beat comes out of the peer's decision loop and is the only proof of life. The liveliness token goes within
milliseconds of a kill, but it stays while a wedged process keeps its link, so it can only accuse. Silence or a lost
token make a peer *suspect*. It is *gone* when a second, living observer suspects it too, or when no node speaks for it
during the confirmation time. In fleets of more than three nodes a living observer that still hears it keeps it suspect
(a partial cut). Any beat refutes.

A node whose own loop lags mistrusts itself first: the lag factor lengthens its deadlines, at most threefold (after
Lifeguard, arXiv 1707.00788). An observer that has watched for a while without ever hearing a peer accuses it as well:
it must not speak for a peer that it does not know.

Links that lose packets hold beats up: TCP sends them again, and then several come at once. Where that happens again and
again, a longer silence is needed to suspect (`LOSS_FACTOR`).

The first peer that is heard after a cut is heard before the others behind the same cut. While its beats do not accuse
them, they are *suspect*, not gone. Otherwise a robot that hears the first node of a healed network would flee from an
owner that all others hear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from zsched.core.values.beat import Beat
from zsched.core.values.fleet import Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, PeerState, TaskId
from zsched.core.values.sequence import Order, Track
from zsched.core.values.struct import Struct, field

NEW_TIMES = 2.0
"""A peer that has restarted has listened for long enough after so many times ``suspect_s``."""
SMALL_FLEET = 3
"""Up to this size nobody waits for a second observer: there is at most one, and it may be the next to go."""
MAX_LAG_FACTOR = 3.0
LATE_BEATS = 2.5
"""A beat that comes later than so many periods is late: up to two wait until the receiver's loop is awake."""
CALM_LAG_FACTOR = 1.1
"""Below it this node's loop does not lag."""
LOSS_FACTOR = 1.4
"""How much longer a peer may be silent while links hold beats up."""
HELD_UP = (0.5, 2.0)
"""A beat was held up on its way when it is the next one and comes after a silence of these shares of ``suspect_s``: a
longer one is a cut..."""
SENDERS_LAG = 0.25
"""...of which less than this share is its sender's lag."""
LOSSY_S = 15.0
"""Beats that are held up twice within this time make the links lossy, for as long behind the last of them."""
IN_FLIGHT_S = 0.03
"""A beat this soon after its sender's token went was sent before that: it refutes nothing."""

_NOBODY: frozenset[NodeId] = frozenset()


class Transition(Struct, frozen=True, kw_only=True):
    """A peer's state changed."""

    node: NodeId
    before: PeerState
    after: PeerState
    reason: str


class _Peer(Struct):
    state: PeerState = PeerState.UNKNOWN
    track: Track = field(default_factory=Track)
    order: Order = Order.NEW
    """Order of the last beat."""
    beat_at: float = -math.inf
    suspect_since: float = math.inf
    vouched_until: float = -math.inf
    """When to judge a suspect again for which another node speaks."""
    token_lost: bool = False
    token_lost_at: float = -math.inf
    has_been_gone: bool = False
    """Gone since it was last alive, even if another node's word has made it suspect again."""
    back_at: float = -math.inf
    """When it last came back from gone in the same life."""
    accuses: Mapping[NodeId, float] = field(default_factory=dict)
    """{node that it suspects or takes for gone: since when its beats say so}."""
    learnt: tuple[tuple[TaskId, int, int], ...] = ()
    """What its newest beat says of values (`Beat.learnt`)."""
    accused_before: Mapping[NodeId, float] = field(default_factory=dict)
    """The same of its life before: one that has just started accuses nobody, because it is new."""
    is_new_until: float = -math.inf
    is_calm: bool = False
    """Its newest beat said so: the next one may come at the slow pace."""
    has_missed: bool = False
    """A beat of its was missing just before the newest."""


class Membership:
    """This node's view of every other configured node's state."""

    def __init__(self, me: NodeId, in_force: InForce) -> None:
        self._me, self._in_force = me, in_force
        self._peers = in_force.by_node(lambda _name: _Peer(), but=me)
        self._lag_factor = 1.0
        self._held_up_at = -math.inf
        """When a beat that was held up came last."""
        self._lossy_until = -math.inf
        self._was_lossy = False
        self._started_at = math.inf
        self._has_heard = False
        self.has_watched = False
        """Whether this node has listened for as long as silence takes to mean something."""
        self._deadline: float | None = None
        """`next_deadline`, until a peer changes it; by another fleet's clocks from the next beat on."""

    @property
    def _timing(self) -> Timing:
        return self._in_force.timing

    @property
    def _has_suspect(self) -> bool:
        return any(peer.state is PeerState.SUSPECT for peer in self._peers.values())

    # --- queries -----------------------------------------------------------------------------------------------

    def state(self, node: NodeId) -> PeerState:
        """A node's state; this node is alive to itself, a stranger unknown."""
        if node == self._me:
            return PeerState.ALIVE
        peer = self._peers.get(node)
        return PeerState.UNKNOWN if peer is None else peer.state

    def is_known(self, node: NodeId) -> bool:
        """Whether the fleet file names ``node``."""
        return node == self._me or node in self._peers

    def states(self) -> dict[NodeId, PeerState]:
        """{node: state} of the whole fleet, this node included, sorted by name."""
        return {name: self.state(name) for name in self._in_force.nodes}

    def incarnation(self, node: NodeId) -> int | None:
        """The newest incarnation that a peer's beat showed, or ``None``."""
        peer = self._peers.get(node)
        return None if peer is None or peer.track.incarnation < 0 else peer.track.incarnation

    def learnt(self, node: NodeId, task: TaskId) -> int:
        """The revision of a task that a peer has learnt, by its newest beat; 0: it tells of none."""
        peer = self._peers.get(node)
        told = () if peer is None else peer.learnt
        return next((revision for name, revision, _ in told if name == task), 0)

    def is_doubtful(self, node: NodeId) -> bool:
        """Whether the peer's last beat is not believed."""
        return self._peers[node].order is Order.DOUBTFUL

    def is_newest(self, node: NodeId) -> bool:
        """Whether the peer's last beat is believed, and is no repeat and no late one."""
        return self._peers[node].order is Order.NEW

    def alive(self) -> tuple[NodeId, ...]:
        """The living peers, sorted, without this node."""
        return tuple(name for name, peer in self._peers.items() if peer.state is PeerState.ALIVE)

    def in_grace(self) -> frozenset[NodeId]:
        """The suspects within their confirmation time: at its end they have beaten again, are gone, or are cut off."""
        if not self._has_suspect:
            return _NOBODY
        suspects = ((name, peer) for name, peer in self._peers.items() if peer.state is PeerState.SUSPECT)
        return frozenset(name for name, peer in suspects if peer.vouched_until == -math.inf)

    def suspects(self) -> tuple[NodeId, ...]:
        """The nodes that this node accuses: suspect, gone, or never heard after it has listened for long enough."""
        excused = (PeerState.ALIVE,) if self.has_watched else (PeerState.ALIVE, PeerState.UNKNOWN)
        return tuple(name for name, peer in self._peers.items() if peer.state not in excused)

    def misses(self, observer: NodeId, node: NodeId, now: float, for_s: float) -> bool:
        """Whether ``observer`` has told for as long as ``for_s`` (seconds, >= 0) that it does not hear ``node``.

        An observer that is not heard here says nothing; for one that has just started its life before speaks.
        """
        if observer == self._me:
            peer = self._peers.get(node)
            if peer is None or peer.state is PeerState.ALIVE:
                return False
            is_young = peer.state is PeerState.SUSPECT and now < peer.suspect_since + for_s
            return not is_young and (self.has_watched or peer.state is not PeerState.UNKNOWN)
        told = self._peers.get(observer)
        if told is None or told.state is not PeerState.ALIVE:
            return False
        before = told.accused_before if now < told.is_new_until else {}
        return now >= min(told.accuses.get(node, math.inf), before.get(node, math.inf)) + for_s

    @property
    def misses_anybody(self) -> bool:
        """Whether some node of the fleet file is not heard."""
        return any(peer.state is not PeerState.ALIVE for peer in self._peers.values())

    @property
    def are_calm(self) -> bool:
        """Whether every living peer's newest beat says that nothing goes on there."""
        return all(peer.is_calm for peer in self._peers.values() if peer.state is PeerState.ALIVE)

    def is_uneasy(self, now: float) -> bool:
        """Whether somebody is suspect, a beat was missing or is late, or this node's own loop lags."""
        if self._has_suspect or self._lag_factor > CALM_LAG_FACTOR:
            return True
        living = (peer for peer in self._peers.values() if peer.state is PeerState.ALIVE)
        return any(peer.has_missed or now >= peer.beat_at + LATE_BEATS * self._period_s(peer) for peer in living)

    def _period_s(self, peer: _Peer) -> float:
        """How soon its next beat is due."""
        return self._timing.rest_beat_s if peer.is_calm else self._timing.beat_s

    @property
    def gone(self) -> tuple[NodeId, ...]:
        """Who is gone, in the order of the fleet file."""
        return tuple(name for name, peer in self._peers.items() if peer.state is PeerState.GONE)

    @property
    def has_heard(self) -> bool:
        """Whether any peer was ever heard; also true of a node without peers."""
        return self._has_heard or not self._peers

    # --- what changes it ---------------------------------------------------------------------------------------

    def note_lag(self, lag_s: float) -> None:
        """Note how late this node's own loop woke up (seconds, >= 0), before it judges any peer."""
        if lag_s > 0.0:
            self._lag_factor = max(self._lag_factor, min(1.0 + lag_s / self._timing.beat_s, MAX_LAG_FACTOR))
            self._deadline = None

    def fade_lag_factor(self) -> None:
        """A beat was sent: the excess of the lag factor over 1 halves."""
        if self._lag_factor > 1.0:
            self._lag_factor = 1.0 + (self._lag_factor - 1.0) / 2
            self._deadline = None

    def absorb_beat(self, beat: Beat, now: float) -> tuple[Transition, ...]:
        """A peer's loop is alive: the beat refutes every accusation. Old and doubtful beats (`Track`) are ignored."""
        peer = self._peers.get(beat.node)
        if peer is None:
            return ()
        known, sequence, silent_s = peer.track.incarnation, peer.track.sequence, now - peer.beat_at
        peer.order = peer.track.judge(
            beat.incarnation, beat.sequence, now, may_begin=self._may_begin(peer, beat.incarnation, now)
        )
        if peer.order is not Order.NEW:
            return ()
        restarted = 0 <= known < beat.incarnation
        if peer.token_lost and not restarted and now < peer.token_lost_at + IN_FLIGHT_S:
            return ()
        before, is_back = peer.state, peer.has_been_gone and not restarted
        self._deadline = None
        peer.beat_at = now
        self._has_heard = True
        if restarted:
            peer.accused_before, peer.is_new_until = peer.accuses, now + NEW_TIMES * self._timing.suspect_s
        peer.accuses = {name: peer.accuses.get(name, now) for name in beat.suspects}
        peer.learnt, peer.token_lost = beat.learnt, False
        if known == beat.incarnation and beat.sequence == sequence + 1:
            self._note_way(silent_s, beat.loop_lag_s, now)
        peer.is_calm, peer.has_missed = beat.calm, sequence >= 0 and not restarted and beat.sequence > sequence + 1
        changes = []
        if before is not PeerState.ALIVE:
            changes.append(self._change(beat.node, PeerState.ALIVE, "beats again" if restarted else "beats", now))
            if is_back:
                peer.back_at = now
            if is_back and before is PeerState.GONE:
                changes += self._take_word(beat, now)
        elif restarted:
            changes.append(Transition(node=beat.node, before=before, after=before, reason="restarted"))
        return (*changes, *self._hear_accusers(now)) if self._has_suspect else tuple(changes)

    def _note_way(self, silent_s: float, senders_lag_s: float, now: float) -> None:
        """A beat has followed the one before after so long a silence: its sender, its way or this node was slow."""
        least, most = (share * self._timing.suspect_s for share in HELD_UP)
        is_way = senders_lag_s < SENDERS_LAG * silent_s and self._lag_factor < CALM_LAG_FACTOR
        if not (is_way and least <= silent_s <= most) or now < self._held_up_at + self._timing.suspect_s:
            return  # what one cut holds up by several links, comes at once
        if now < self._held_up_at + LOSSY_S:
            self._lossy_until = now + LOSSY_S
        self._held_up_at = now

    def way_changes(self, now: float) -> bool | None:
        """Whether links hold beats up, if that has changed since the last call; ``None``: it has not."""
        is_lossy = now < self._lossy_until
        if is_lossy is self._was_lossy:
            return None
        self._was_lossy = is_lossy
        return is_lossy

    def _take_word(self, beat: Beat, now: float) -> list[Transition]:
        """A lost peer is back. Lost peers that it does not accuse should be heard soon."""
        changes = []
        accused = {name for peer in self._peers.values() if peer.state is PeerState.ALIVE for name in peer.accuses}
        for name, peer in self._peers.items():
            if peer.state is PeerState.GONE and name not in accused:
                changes.append(self._change(name, PeerState.SUSPECT, f"{beat.node} is back and hears it", now))
                peer.vouched_until = now + self._timing.suspect_s * self._lag_factor
        return changes

    def _may_begin(self, peer: _Peer, incarnation: int, now: float) -> bool:
        """Whether another life may begin with its first beat.

        It may when the known life misses its beats. For a silent peer a lower incarnation may also begin (its state was
        made anew).
        """
        if incarnation > peer.track.incarnation:
            return peer.state is not PeerState.ALIVE or now >= peer.beat_at + 2 * self._period_s(peer)
        is_silent = peer.state is PeerState.GONE or now >= peer.beat_at + self._timing.suspect_s
        return is_silent and peer.state is not PeerState.ALIVE

    def absorb_token_lost(self, node: NodeId, incarnation: int, now: float) -> tuple[Transition, ...]:
        """A peer's token went: suspect at once, if it is the token of the life we know.

        Just after a peer has come back this is most likely the old link's token: the beats come by a new link, and
        zenoh ends the old token when it notices. So for one lease only silence counts.
        """
        peer = self._peers.get(node)
        if peer is None or peer.track.incarnation != incarnation or peer.state is not PeerState.ALIVE:
            return ()
        if now < peer.back_at + self._timing.control_lease_s:
            return ()
        peer.token_lost, peer.token_lost_at = True, now
        return (self._change(node, PeerState.SUSPECT, "its token went", now), *self._hear_accusers(now))

    def tick(self, now: float) -> tuple[Transition, ...]:
        """Time has passed."""
        changes = []
        limit = self._timing.suspect_s * self._lag_factor
        self._started_at = min(self._started_at, now)
        self.has_watched = self.has_watched or now >= self._started_at + limit
        if now < self.next_deadline():
            return ()  # silence and reviews have their times; a peer's word is reviewed when it comes
        self._deadline = None
        for name, peer in self._peers.items():
            if peer.state is PeerState.ALIVE and now >= self._peer_deadline(peer, limit):
                silent = now - peer.beat_at
                changes.append(self._change(name, PeerState.SUSPECT, f"silent for {silent:.2f} s", now))
        return (*changes, *self._review(now))

    def next_deadline(self) -> float:
        """When `tick` may have something to say; infinity when never."""
        if self._deadline is None:
            limit, due = self._timing.suspect_s * self._lag_factor, math.inf
            for peer in self._peers.values():
                due = min(due, self._peer_deadline(peer, limit))
            self._deadline = due
        return self._deadline

    def _peer_deadline(self, peer: _Peer, limit: float) -> float:
        if peer.state is PeerState.ALIVE:
            lossy_until = min(self._lossy_until, peer.beat_at + LOSS_FACTOR * limit)
            return max(peer.beat_at + limit, lossy_until)
        if peer.state is PeerState.SUSPECT:
            return self._review_at(peer)
        return math.inf

    def _review_at(self, peer: _Peer) -> float:
        return max(peer.suspect_since + self._grace(peer), peer.vouched_until)

    def _grace(self, peer: _Peer) -> float:
        """How long a suspect stays so before it is gone without another observer."""
        if len(self._in_force.nodes) <= SMALL_FLEET:
            return 1.5 * self._timing.beat_s * self._lag_factor if peer.token_lost else 0.0
        return self._timing.confirm_s * self._lag_factor

    def _hear_accusers(self, now: float) -> list[Transition]:
        """Turn suspects into gone that another living node misses, too. Time is not judged: beats may wait."""
        return self._end_suspicions(lambda name, _peer: self._accused_by(name), now)

    def _review(self, now: float) -> list[Transition]:
        """Turn suspects into gone where another node, or their silence, confirms it."""
        return self._end_suspicions(lambda name, peer: self._verdict(name, peer, now), now)

    def _end_suspicions(self, judge: Callable[[NodeId, _Peer], str], now: float) -> list[Transition]:
        changes = []
        for name, peer in self._peers.items():
            if peer.state is PeerState.SUSPECT and (reason := judge(name, peer)):
                changes.append(self._change(name, PeerState.GONE, reason, now))
        return changes

    def _observers(self, name: NodeId) -> list[tuple[NodeId, _Peer]]:
        return [(other, at) for other, at in self._peers.items() if other != name and at.state is PeerState.ALIVE]

    def _accused_by(self, name: NodeId) -> str:
        """Why a suspect is gone by another node's word; empty: nobody else misses it."""
        accusers = (other for other, observer in self._observers(name) if name in observer.accuses)
        return next((f"{other} misses it too" for other in accusers), "")

    def _verdict(self, name: NodeId, peer: _Peer, now: float) -> str:
        if (reason := self._accused_by(name)) or now < self._review_at(peer):
            return reason
        is_heard = any(at.beat_at > peer.suspect_since for _, at in self._observers(name))
        if len(self._in_force.nodes) > SMALL_FLEET and is_heard:
            # A living node still hears it: a cut between it and us, not its end. A silent node speaks for no peer.
            peer.vouched_until = now + self._timing.beat_s
            return ""
        return "nobody speaks for it"

    def _change(self, node: NodeId, after: PeerState, reason: str, now: float) -> Transition:
        peer = self._peers[node]
        before, peer.state = peer.state, after
        if after is not PeerState.SUSPECT:
            peer.has_been_gone = after is PeerState.GONE
        self._deadline = None
        peer.suspect_since = now if after is PeerState.SUSPECT else math.inf
        peer.vouched_until = -math.inf
        return Transition(node=node, before=before, after=after, reason=reason)
