"""Gives each data link the send buffer that its speed allows (`zsched.core.hop.room`), and steady waits after a loss.

Knows: the sockets beneath a session, what Linux counts about them, which size they began with. Does not know: streams,
which size is right.

zenoh sets a buffer's size when a link begins, not for a link that it dials by gossip, and never looks at it again. A
link with another size than ours at first (the operator's own ``so_sndbuf``) is left alone.
"""

from __future__ import annotations

import logging
import threading
from typing import Final

import zenoh
from zenoh import Session

from zsched.core.hop.room import OWN, SMALL, Room
from zsched.host.clock import monotonic_s
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets

LOOK_S: Final = 0.04
"""A look that comes sooner than this after another one does nothing..."""
REST_S: Final = 0.25
"""...or than this, when for `CALM_S` no link has taken so much as a small buffer holds between two looks."""
CALM_S: Final = 1.0
STILL_LOOK_S: Final = 1.0
"""...or than this, when nothing is carried at all: each link costs five system calls."""

_log = logging.getLogger("zsched.streams")


class LinkBuffers:
    """The send buffers of one session's links. `look` may be called from any thread, and has no thread of its own."""

    def __init__(self, session: Session) -> None:
        """Nothing is looked at before the first `look`."""
        self._sockets = LinkSockets(session)
        self._rooms: dict[LinkSocket, Room | None] = {}
        """``None``: its buffer is not ours to size."""
        self._acked: dict[LinkSocket, int] = {}
        self._looked_at = 0.0
        self._moved_at = 0.0
        self._lock = threading.Lock()

    def look(self, *, at_once: bool = False, is_still: bool = False) -> None:
        """See how fast each link has been, and size its buffer.

        Args:
            at_once: however soon after the look before.
            is_still: for seconds nothing has been carried by these links.
        """
        now = monotonic_s()
        rest_s = STILL_LOOK_S if is_still else REST_S
        pause_s = rest_s if now - self._moved_at > CALM_S else LOOK_S
        if (now - self._looked_at < pause_s and not at_once) or not self._lock.acquire(blocking=False):
            return
        try:
            self._looked_at = now
            self._look(now)
        except (zenoh.ZError, RuntimeError):
            return  # the session closes
        finally:
            self._lock.release()

    def _look(self, now: float) -> None:
        rooms, self._rooms = self._rooms, {}
        before, self._acked = self._acked, {}
        for link in self._sockets.links():
            room = self._rooms[link] = rooms[link] if link in rooms else _room(link)
            account = None if room is None else link.account()
            if room is None or account is None:
                continue
            self._acked[link] = account.acked
            if account.acked - before.get(link, account.acked) >= SMALL or account.held > SMALL // 2:
                self._moved_at = now
            size = room.size
            if room.look(account, now) != size and link.set_send_buffer(room.size):
                told = "the kernel's own size" if room.size == OWN else f"{room.size} bytes"
                _log.debug("the link to %s has a send buffer of %s", link.name, told)


def _room(link: LinkSocket) -> Room | None:
    link.retry_steadily()
    size = link.send_buffer()
    if size == OWN:
        link.set_send_buffer(SMALL)
    return Room() if size in (OWN, SMALL) else None
