"""Ends links of a machine whose worker is missed here, if they are up and bring nothing but signs of life.

Where the old link of a session ended behind the beginning of its new one, zenoh (1.10) may have lost what the other end
has declared: the link stays, and nothing mends it but another one. Nobody dials a worker (docs/decisions/0036), and it
dials again at once when its link ends. Nobody knows which link is whose worker's, so all quiet ones of that machine end
but its relay's: an idle worker loses nothing by it. One to which samples go is not mute.

Knows: which machines' workers are missed, who is at the other end of each link. Does not know: streams, why one is
missed. The times are those of the control network (`zsched.core.membership.relink`).
"""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Set as AbstractSet
from typing import Final

from zenoh import Sample, SampleKind, Session, ZError

from zsched.core.membership.relink import Introductions
from zsched.core.values.model import NodeId
from zsched.host.guard import tolerant
from zsched.link.keyspace import Keyspace, parse
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets
from zsched.relay.tokens import MAX_OF_NODE

QUIET_BYTES: Final = 200
"""Each way between two looks, a second apart: signs of life, also within TLS, are fewer."""

_log = logging.getLogger("zsched.relay")


class MuteLinks:
    """Of one session; `look` is called by one thread."""

    def __init__(self, session: Session, keyspace: Keyspace) -> None:
        self._sockets, self._due = LinkSockets(session), Introductions()
        self._moved: dict[LinkSocket, tuple[int, int]] = {}
        """{link: (bytes that it has brought, bytes that have gone by it)}."""
        self._relays: dict[str, NodeId] = {}
        """{session: whose relay's}."""
        note = tolerant(self._note, "relays")
        self._watch = session.liveliness().declare_subscriber(keyspace.relay("*", "*"), note, history=True)

    def _note(self, sample: Sample) -> None:
        key = parse(str(sample.key_expr))
        if key is None or len(key.rest) != 1:
            return
        if sample.kind != SampleKind.PUT:
            self._relays.pop(key.rest[0], None)
        elif len(self._relays) < MAX_OF_NODE:
            self._relays[key.rest[0]] = key.owner

    def look(self, missed: AbstractSet[NodeId], now: float) -> None:
        """Once a second. ``missed``: the machines whose worker is not seen here."""
        before, self._moved = self._moved, {}
        try:
            for link in self._of_workers(missed) if missed else ():
                self._moved[link] = (link.brought(), link.taken())
        except ZError:
            return  # the session closes
        known = ((link, moved, before[link]) for link, moved in self._moved.items() if link in before)
        quiet = [link for link, at, was in known if max(at[0] - was[0], at[1] - was[1]) < QUIET_BYTES]
        if (quiet or not missed) and self._due.is_due(now, is_missing=bool(missed)):  # pauses grow with each end only
            for link in quiet:
                if link.cut():
                    _log.warning("%s brings nothing, and a worker there is missed: its link is ended", link.name)

    def _of_workers(self, nodes: AbstractSet[NodeId]) -> list[LinkSocket]:
        """The links to these machines that are no relay's, as far as they are other machines' than ours."""
        links, relays = self._sockets.links(), dict(self._relays)
        hosts = {link.ends[1][0] for link in links if relays.get(link.zid) in nodes}
        remote = {host for host in hosts if not ipaddress.ip_address(host).is_loopback}
        return [link for link in links if link.ends[1][0] in remote and link.zid not in relays]
