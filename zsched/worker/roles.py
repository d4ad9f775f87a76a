"""Hears from this node's daemon what role the worker has, and shows in which epoch it works.

Knows: role keys, the question asked until there is an answer, the role's token. Does not know: what a role changes.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from zsched.core.values import codec as wire
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import WireError
from zsched.core.values.plan import Role
from zsched.host.guard import guarded, tolerant

ROLE_RETRY_S: Final = 0.5
RETRY_S: Final = 0.02
MAX_RETRY_S: Final = 0.5
ASK_EVERY_S: Final = 0.02

_log = logging.getLogger("zsched.worker")


class RoleWatch:
    """The roles told under one key. ``on_role`` is called in a thread of its own.

    Any program on the data network can put under that key, in anybody's name. So a put is only a reason to ask, and
    an answer counts when it is of the session at the other end of our link to this node's relay.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        on_role: Callable[[Role], None],
        stop: threading.Event,
        relay: str = "",
        again_s: float | None = None,
    ) -> None:
        """``key`` is that of this node's role for the task; ``relay``: the endpoint of its relay, where we dial one.

        ``again_s``: it is asked for again so often, for a relay that tells it once: who declares no token while it is
        idle is not told anew when its link is back.
        """
        self._session, self._key, self._on_role, self._stop = session, key, on_role, stop
        self._relay = Endpoint.of(relay).place if relay else ""
        self._told = threading.Event()
        self._again_s = again_s
        self._token: zenoh.LivelinessToken | None = None
        self._watch: zenoh.Subscriber[None] | None = None
        self.strangers = 0
        """Answers that were not our relay's."""

    def start(self) -> None:
        """Subscribe, and ask until the first answer: our relay may start later than we do."""
        self._watch = self._session.declare_subscriber(self._key, tolerant(lambda _: self._told.set(), "role"))
        guarded(self._run, name="zsched roles").start()

    @property
    def is_shown(self) -> bool:
        """True while the token of an epoch is there."""
        return self._token is not None

    def show(self, epoch: int) -> None:
        """Declare the token that says in which epoch this worker works."""
        if self._token is None:
            self._token = self._session.liveliness().declare_token(f"{self._key}/{epoch}")

    def hide(self) -> None:
        """Take the token back."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None

    def undeclare(self) -> None:
        """Hear nothing any more."""
        self._told.set()
        if self._watch is not None:
            self._watch.undeclare()

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        is_answered, pause_s = False, RETRY_S
        while not self._stop.is_set():
            self._told.wait(self._again_s if is_answered else pause_s)
            self._told.clear()
            is_answered = self._is_answered()
            if is_answered:
                pause_s = RETRY_S
                self._stop.wait(ASK_EVERY_S)  # a worker that is flooded with puts does not ask for each of them
            else:
                pause_s = min(2 * pause_s, MAX_RETRY_S)

    def _is_answered(self) -> bool:
        try:
            return self._ask()
        except zenoh.ZError as error:
            if not self._stop.is_set():
                _log.warning("the role could not be asked for (%s)", error)
            return False

    def _ask(self) -> bool:
        """Ask once; whether our relay has answered."""
        replies = self._session.get(
            self._key,
            target=zenoh.QueryTarget.ALL,  # a stranger's may call itself complete, and would be the only one asked
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ROLE_RETRY_S,
        )
        relays = self._relays()
        for reply in replies:
            if reply.ok is None:
                continue
            if relays and (reply.replier_id is None or str(reply.replier_id.zid) not in relays):
                self.strangers += 1
                _log.warning("a role that our relay did not tell was ignored")
                continue
            self._hear(reply.ok.payload)
            return True
        return False

    def _relays(self) -> frozenset[str]:
        """The session at the other end of our link to the relay; none: we dial nobody, or the relay has dialled.

        Then any answer counts.
        """
        links = self._session.info.links() if self._relay else []
        return frozenset(str(link.zid) for link in links if Endpoint.of(str(link.dst)).place == self._relay)

    def _hear(self, payload: zenoh.ZBytes) -> None:
        try:
            role = wire.decode(payload.to_bytes(), Role)
        except WireError as error:
            _log.warning("an unreadable role was ignored (%s)", error)
            return
        self._on_role(role)
