"""Hears from this node's daemon what the worker shall be, and shows in which epoch it works.

Knows: role keys, the question asked until there is an answer, the role's token. Does not know: what a role changes.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from zsched import wire
from zsched.core.plan import Role
from zsched.errors import WireError

ROLE_RETRY_S: Final = 0.5

_log = logging.getLogger("zsched.worker")


class RoleWatch:
    """The roles told under one key. ``on_role`` is called in zenoh's thread, or in that of `ask`."""

    def __init__(
        self, session: zenoh.Session, key: str, on_role: Callable[[Role], None], stop: threading.Event
    ) -> None:
        """``key`` is that of this node's role for the task; `start` subscribes."""
        self._session, self._key, self._on_role, self._stop = session, key, on_role, stop
        self._is_known = False
        self._token: zenoh.LivelinessToken | None = None
        self._watch: zenoh.Subscriber[None] | None = None

    def start(self) -> None:
        """Subscribe; `ask` gets the role of a worker that starts late."""
        self._watch = self._session.declare_subscriber(self._key, lambda sample: self._hear(sample.payload))

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

    def ask(self) -> None:
        """Ask until the first answer: our relay may start later than we do. Blocks."""
        while not self._is_known and not self._stop.is_set():
            replies = self._session.get(self._key, consolidation=zenoh.ConsolidationMode.NONE, timeout=ROLE_RETRY_S)
            for reply in replies:
                if reply.ok is not None and not self._is_known:
                    self._hear(reply.ok.payload)
            if not self._is_known:
                self._stop.wait(0.05)

    def undeclare(self) -> None:
        """Hear nothing any more."""
        if self._watch is not None:
            self._watch.undeclare()

    def _hear(self, payload: zenoh.ZBytes) -> None:
        try:
            role = wire.decode(payload.to_bytes(), Role)
        except WireError as error:
            _log.warning("an unreadable role was ignored (%s)", error)
            return
        self._is_known = True
        self._on_role(role)
