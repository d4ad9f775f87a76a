"""Ends links whose other end may say nothing here, or shows more tokens or has more sessions than a node needs.

zenoh keeps each key and token that comes by a link until the link ends, and the time for one grows with their number;
no access rule forbids the keys. So what is cut is the link.

Knows: which certificate is at the other end of a link, how many tokens each node shows. Does not know: who is let in.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from zsched.core.values.certificates import parse_common_name
from zsched.guard import guarded
from zsched.sessions.link_sockets import LinkSockets

MAX_SHOWN: Final = 64
"""Tokens of one node: it has one for each of its lives, and of those that have ended some may not be gone yet."""
MAX_SESSIONS: Final = 32
"""Of one certificate: a daemon has one, and each verb that asks one more. zenoh takes 1000 in all, then nobody."""
LOOK_AGAIN_S: Final = 0.05
LOOKS: Final = 10
"""A link is told of before it is in zenoh's list."""
MAX_WAITING: Final = 256

_log = logging.getLogger("zsched.control")


class Expulsion:
    """Of one session. `expel`, `shows` and `links` may be called from any thread, and never block."""

    def __init__(self, session: zenoh.Session, fleet: str) -> None:
        """Nothing runs before the first link is to be ended."""
        self._session, self._fleet = session, fleet
        self._sockets = LinkSockets(session)
        self._queue: queue.Queue[Callable[[zenoh.Link], bool]] = queue.Queue(MAX_WAITING)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._shown: dict[str, int] = {}
        """{node: tokens}; whoever shows one in a node's name has its certificate."""
        self._linked: dict[str, set[str]] = {}
        """{common name: its sessions}."""

    def expel(self, zid: str) -> None:
        """End the links to a session."""
        self._end(lambda link: str(link.zid) == zid)

    def shows(self, node: str, *, is_present: bool) -> bool:
        """A token of a node came or went; ``False``: it shows too many, and its links are ended."""
        count = self._shown[node] = max(0, self._shown.get(node, 0) + (1 if is_present else -1))
        if not count:
            del self._shown[node]
        if not is_present or count <= MAX_SHOWN:
            return True
        if count % MAX_SHOWN == 1:
            self._end(lambda link: self._holder(link) == node)
        return False

    def links(self, name: str, zid: str, *, is_present: bool) -> bool:
        """A session of a certificate came or went; ``False``: it has too many, and this one is ended."""
        held = self._linked.setdefault(name, set())
        if not is_present:
            held.discard(zid)
            if not held:
                del self._linked[name]
            return True
        if len(held) >= MAX_SESSIONS and zid not in held:
            self.expel(zid)
            return False
        held.add(zid)
        return True

    def _holder(self, link: zenoh.Link) -> str:
        held = parse_common_name(link.auth_identifier or "", self._fleet)
        return "" if held is None else held.name

    def _end(self, is_meant: Callable[[zenoh.Link], bool]) -> None:
        with self._lock:
            if self._thread is None:
                self._thread = guarded(self._run, name="expulsion")
                self._thread.start()
        with contextlib.suppress(queue.Full):  # so many are ended already, and those that are left come again
            self._queue.put_nowait(is_meant)

    def _run(self) -> None:
        pause = threading.Event()
        while True:
            is_meant = self._queue.get()
            for _ in range(LOOKS):
                if self._cut(is_meant):
                    break
                pause.wait(LOOK_AGAIN_S)

    def _cut(self, is_meant: Callable[[zenoh.Link], bool]) -> bool:
        """End the links that are meant; whether there were any."""
        try:
            zids = {str(link.zid): link.auth_identifier for link in self._session.info.links() if is_meant(link)}
        except zenoh.ZError:
            return True  # the session closes
        ended = [link for link in self._sockets.links() if link.zid in zids and link.cut()]
        for link in ended:
            _log.warning("the link to %s is ended: certificate=%r", link.name, zids[link.zid])
        return bool(ended)
