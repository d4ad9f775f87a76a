"""Watches whether what open sessions were opened with still holds, and says when this daemon begins anew for it.

A session keeps its access rules, its certificate, whom it dials, and the addresses at which others learn that it
listens. When one of them is another, the daemon opens its sessions anew, in its turn.

Knows: the certificate's file, this machine's addresses, who is dialled where it is not. Does not know: whose turn it is
(`zsched.runtime.reopening`), how a daemon begins anew (`zsched.daemon`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from zsched.config.load import load_fleet, require_node
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.messages import CommandResult
from zsched.core.values.model import NodeId
from zsched.core.values.problems import Problem
from zsched.link.bus.sealing import seals_of
from zsched.link.sessions import tls as daemon_tls
from zsched.link.sessions.access_rules import Side
from zsched.link.sessions.endpoints import Endpoints, is_here
from zsched.link.sessions.roaming import Roaming, addresses_towards, gone_from, numeric, places_of
from zsched.link.sessions.secured import digest_of, require_own
from zsched.runtime import renewal
from zsched.runtime.reopening import Moved, Reopening, first_wait_s, turns

LOOK_S = 30.0
"""How often the certificate's files are looked at."""
PLACE_LOOK_S = 1.0
"""How often a node looks which address it has."""
SESSIONS = "sessions"
"""Of the problem that sessions cannot be opened again."""
TURN = "turn"
"""Of the problem that this node waits to begin anew, for a task of its would have no owner."""
ADDRESS = "address"
"""Of the problem that this machine is not where the others dial it."""


class SessionWatch:
    """Of one process, called by the daemon's loop."""

    def __init__(
        self,
        fleet: Fleet,
        me: NodeSpec,
        points: Endpoints,
        *,
        certificate: str,
        config: Path,
        state_dir: Path,
        post: Callable[[ev.Event], None],
    ) -> None:
        """The sessions are about to be opened.

        Args:
            fleet: in force now.
            me: this node.
            points: where its sessions listen and whom they dial.
            certificate: digest of the one that they listen with; empty: none.
            config: the fleet file, by which a daemon that begins anew starts.
            state_dir: where a renewed certificate is kept.
            post: takes what the node is to hear.
        """
        self._fleet, self._config, self._state_dir, self._post = fleet, config, state_dir, post
        self._certificate = certificate
        self._reopening = Reopening(me.name)
        self._lets_in_others = False
        """Open sessions go by other access rules than the fleet in force."""
        self._moved, self._left = Moved(), frozenset[NodeId]()
        """Whom open sessions dial where it is not any more; those of them that are gone from there."""
        self._next_look = 0.0
        self._places: tuple[str, ...] = ()
        """The addresses towards which this machine looks for its own; none: the fleet file says where it is."""
        self._roaming = Roaming(began_at=())
        self._home = ""
        """The address at which the others dial this machine, if it had it at the start."""
        self._has_roamed, self._next_place = False, 0.0
        if points.data_by_gossip or points.control_by_gossip:
            self._places = places_of(node.host for node in fleet.nodes if node is not me)
            self._roaming = Roaming(began_at=addresses_towards(self._places))
        elif me.host and is_here(me.host):
            self._home = numeric(me.host)
        self.gossiped = self._roaming.began_at if points.data_by_gossip else ()
        """The addresses at which others learn by gossip that this node's data session listens."""

    def note(self, lets_in_others: bool, moved: tuple[NodeId, ...]) -> None:
        """Another fleet is in force: whether open sessions let in others than it says, and who of it has moved."""
        self._lets_in_others, self._next_look = lets_in_others, 0.0
        self._moved.take(moved)

    def take_certificate(self, pem: str) -> CommandResult:
        """Keep a newer certificate of this node; the sessions are opened anew with it."""
        result = renewal.take(self._fleet, self._state_dir, pem)
        self._next_look = 0.0
        return result

    def look_around(self, node: Node, now: float) -> None:
        """Whether this machine is where the others know it: by the fleet file, or else by its sessions."""
        if now < self._next_place:
            return
        self._next_place = now + PLACE_LOOK_S
        if self._places:
            self._has_roamed = self._roaming.is_elsewhere(addresses_towards(self._places), now)
        elif self._home:
            node.set_problem(ADDRESS, None if is_here(self._home) else gone_from(self._home))

    def is_due(self, node: Node, now: float) -> bool:
        """Whether the sessions hold no more and it is this node's turn to open them anew; problems are told."""
        if not self._may_begin_anew:
            node.set_problem(SESSIONS, None)
            return False
        electors, alive = node.fleet.electors, node.membership.alive()
        lives = {name: node.membership.incarnation(name) for name in alive}
        left, before = self._moved.left(lives), self._left
        self._left = left
        if now >= self._next_look or left != before:
            self._next_look = now + LOOK_S
            with contextlib.suppress(ConfigError):  # it is being replaced
                node.set_problem(Problem.CERTIFICATE, renewal.problem(self._fleet, renewal.now_utc()))
            if self._lets_in_others or left or self._has_another_certificate(node):
                candidates = [task.candidates for task in node.fleet.tasks]
                order = turns((*alive, node.me), electors, node.in_force.voters, candidates)
                self._reopening.want(order, lives, now, first_s=first_wait_s(node.fleet.timing))
            elif not self._has_roamed:
                self._reopening.forget()
                node.set_problem(SESSIONS, None)  # what was wanted is wanted no more
        if self._has_roamed:
            self._reopening.want(((node.me,),), lives, now, first_s=0.0)  # nobody else begins again for it
        lacks = () if self._reopening.due_at is None else node.lacking(now)
        awaited = [name for name in electors if name not in left]  # who has left is heard again only afterwards
        is_due = self._reopening.is_due(awaited, lives, now, lack=[lack.sparing for lack in lacks])
        texts = [] if is_due else [f"{lack.task}: {lack.why}" for lack in lacks]
        node.set_problem(TURN, f"it waits to open its sessions anew ({'; '.join(texts)})" if texts else None)
        if not is_due:
            return False
        why_not = self._why_not_anew(node)
        self._post(ev.ProblemReported(source=SESSIONS, problem=why_not))
        if why_not is not None:
            self._reopening.put_off(now)
        return why_not is None

    @property
    def _may_begin_anew(self) -> bool:
        is_wanted = self._has_roamed or self._reopening.due_at is not None
        return is_wanted or self._fleet.security is not None or self._moved.is_any

    def _has_another_certificate(self, node: Node) -> bool:
        try:
            return node.fleet.security is not None and digest_of(node.fleet.security) != self._certificate
        except ConfigError:
            return False  # it is being replaced, or cannot be used: the one that is used goes on

    def _why_not_anew(self, node: Node) -> str | None:
        """What would keep a daemon from starting by the fleet in force; ``None``: nothing."""
        security = node.fleet.security
        try:
            require_node(load_fleet(self._config), node.me, self._config)
            if security is not None:
                require_own(node.fleet, security, node.me)
                seals_of(node.fleet)
            for side in Side:
                daemon_tls.session_text(node.fleet, side)
        except ConfigError as error:
            return f"its sessions let in or dial others than the fleet says, and cannot be opened anew: {error}"
        return None
