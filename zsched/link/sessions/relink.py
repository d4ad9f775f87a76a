"""Introduces sessions that should be linked and are not: a session of a moment, which meets everybody.

Two peers without an address in the fleet file meet by gossip, and zenoh tells of a peer only while a link is new: if
the link between the two ends and their links to the seeds stay up (a short or a partial cut), neither dials again. A
peer that opens, dials the seeds and whomever it hears of through them tells each of all others, and of two that may
dial by gossip the one whose turn it is does so. It declares nothing and closes after a second.

Knows: zenoh sessions. Does not know: which node misses which, and when it is worth the effort
(`zsched.core.membership.relink`).
"""

from __future__ import annotations

import logging
import threading
from functools import cached_property

import zenoh

from zsched.host.guard import guarded
from zsched.link.sessions.config import introduction_config

STAY_S = 1.0
"""Measured: two peers had their link 0.03 s after the third had opened; the rest is for slow radios."""

_log = logging.getLogger("zsched.introduction")


class Introducer:
    """Introduces the peers of one session to each other when asked to."""

    def __init__(self, session_config: str) -> None:
        """``session_config`` is the configuration (JSON) of the session that may miss somebody."""
        self._session_config = session_config
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()
        self._count = 0
        """How often it has been done."""

    @cached_property
    def _config(self) -> str | None:
        """Worked out when somebody is missed for the first time, not at the start."""
        return introduction_config(self._session_config)

    def introduce(self) -> None:
        """Begin, and return at once; nothing while it is under way, or where zenoh redials everybody by itself."""
        if self._ended.is_set() or self.is_under_way or self._config is None:
            return
        self._thread = guarded(self._introduce, self._config, name="introduction", is_lasting=False)
        self._thread.start()

    @property
    def is_under_way(self) -> bool:
        """Whether it is under way."""
        return self._thread is not None and self._thread.is_alive()

    def close(self) -> None:
        """End what is under way."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(STAY_S)

    def _introduce(self, config: str) -> None:
        self._count += 1
        if self._count & (self._count - 1) == 0:  # a machine that is off is missed once a minute, for good
            _log.info("somebody is missing: introducing all peers to each other count=%d", self._count)
        try:
            with zenoh.open(zenoh.Config.from_json5(config)):
                self._ended.wait(STAY_S)
        except (zenoh.ZError, ValueError) as error:
            _log.warning("cannot introduce peers to each other: %s", error)
