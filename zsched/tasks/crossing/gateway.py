"""One gateway of another cell: a client's session to its relay, and the question whether a taker takes a parcel.

Knows: zenoh sessions, the answers of takers. Does not know: other gateways, how often it is asked, roles.
"""

from __future__ import annotations

import contextlib
from typing import Final

import zenoh

from zsched.guard import ends_within
from zsched.sessions.closing import CLOSE_S
from zsched.sessions.problems import why_not_open
from zsched.tasks.crossing.parcels import ANY_TAKER, TAKEN, Parcel, given_key, is_lasting, parts_of

ANSWER_S: Final = 2.0
"""A gateway that is silent for so long is frozen, cut off or too slow: the next one is asked."""
BYTES_S: Final = 250_000
"""...and for as long as a link of so many bytes a second needs for the sample."""
NOBODY: Final = "nobody takes: that node runs no taker for this cell, or does not let us in"
MAX_WHY: Final = 160
_TIMEOUT: Final = "Timeout"
"""zenoh's own answer where somebody has not answered in time."""


class Gateway:
    """One session, opened when it is needed, and anew after a silence: a certificate is read when it opens."""

    def __init__(self, endpoint: str, cell: str, config: str) -> None:
        """``cell``: the giver's own; ``config``: of the session (JSON5 text)."""
        self.endpoint = endpoint
        self._cell, self._config = cell, config
        self._session: zenoh.Session | None = None
        self._has_ended = False
        self._taker = ANY_TAKER
        """Who took last: with several candidates only that one is sent the sample."""
        self._is_silent = False
        """To the newest question nobody has said anything."""

    def give(self, parcel: Parcel) -> str:
        """Empty: a taker has put it; else why not."""
        return self._ask(parcel.selector(self._taker, self._cell), parcel)

    def reach(self) -> str:
        """Empty: some taker answers, the owner or a standby; else why not."""
        return self._ask(given_key(ANY_TAKER, self._cell, "**"), None)

    def end(self) -> None:
        """End the session, for good."""
        self._has_ended = True
        self._close()

    def _close(self) -> None:
        """End the session; the next question opens another one."""
        session, self._session = self._session, None
        if session is not None:
            ends_within(CLOSE_S, _close, session, name="crossing close")

    def _ask(self, selector: str, parcel: Parcel | None) -> str:
        if self._has_ended:
            return "the session has ended"
        try:
            if self._session is None:
                self._session = zenoh.open(zenoh.Config.from_json5(self._config))
            why = self._answer(self._session, selector, parcel)
        except zenoh.ZError as error:
            self._close()
            return why_not_open(self._config, error).partition(";")[0][:MAX_WHY]
        if self._is_silent:
            self._close()
        return why

    def _answer(self, session: zenoh.Session, selector: str, parcel: Parcel | None) -> str:
        timeout_s = ANSWER_S + (0 if parcel is None else len(parcel.payload) / BYTES_S)
        replies = session.get(
            selector,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            payload=None if parcel is None else parcel.payload,
            attachment=None if parcel is None else parcel.attachment,
            encoding=None if parcel is None else parcel.encoding or None,
        )
        self._taker, self._is_silent, why = ANY_TAKER, True, NOBODY
        for reply in replies:
            said = reply.ok.payload if reply.ok is not None else reply.err.payload  # type: ignore[union-attr] # one is
            text = said.to_string()
            if text == _TIMEOUT:
                why = f"nobody answers within {timeout_s:.0f} s" if self._is_silent else why
                continue
            self._is_silent = False
            if reply.ok is not None and text == TAKEN:
                self._taker = parts_of(str(reply.ok.key_expr))[0]
            if parcel is None or text == TAKEN:
                return ""
            why = text[:MAX_WHY]
            if is_lasting(why):
                return why  # the owner's word; standbys say only that they are none
        return why


def _close(session: zenoh.Session) -> None:
    with contextlib.suppress(zenoh.ZError):
        session.close()
