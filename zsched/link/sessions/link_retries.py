"""Lets the links of a session that carries little send again what was lost after equal waits.

TCP doubles its wait with each loss in succession: where every fifth packet is lost, a link is silent for 1.5 s and more
about once a minute, and nothing is wrong with either end. Linux keeps the waits equal for links with few packets under
way, if it is asked to (its Documentation/networking/tcp-thin). ``benchmarks/link_retries.py`` shows the difference.

Knows: which links of the session are new. Does not know: what they carry, sockets.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import zenoh
from zenoh import Session

from zsched.host.guard import tolerant
from zsched.link.sessions.link_sockets import Ends, ends_of, retry_steadily

MAX_NEW: Final = 4096


class LinkRetries:
    """Of one session; `look` is called by one thread."""

    def __init__(self, session: Session) -> None:
        """Note each link from now on, those there are included; nothing is done to them before the first `look`."""
        self._new: deque[Ends] = deque(maxlen=MAX_NEW)
        self._watch = session.info.declare_link_events_listener(tolerant(self._on_link, "link"), history=True)

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        ends = ends_of(event.link) if event.kind == zenoh.SampleKind.PUT else None
        if ends is not None:
            self._new.append(ends)

    def look(self) -> None:
        """See to the links that are new since the last call; costs nothing while there are none.

        While this process has no descriptor left they wait for the next one.
        """
        found = set()
        while self._new:
            found.add(self._new.popleft())
        try:
            retry_steadily(found)
        except OSError:
            self._new.extend(found)
