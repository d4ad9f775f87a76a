"""Ends links whose other end may say nothing here, has more tokens or sessions than it needs, or looks on too slowly.

zenoh keeps each key and token that comes by a link until the link ends, and the time for one grows with their number;
no access rule forbids the keys. So what ends is the link. Whoever dialled it dials again at once, 40 times a second,
each time with a handshake. So a link is *held* first: zenoh reads nothing more of it, and it ends after `HOLD_S`.

A put that must not lose anything waits for each receiver. Nodes are waited for, since what they do is what the streams
are for; who only looks is not.

Knows: which certificate is at the other end of a link, who is let in, how many tokens each node shows. Does not know:
access rules, what tokens mean.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import queue
import threading
from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Final

import zenoh

from zsched.core.values.certificates import Role, parse_common_name
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, tolerant
from zsched.link.sessions.config import WORKERS_BY
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets, with_room

MAX_SHOWN: Final = 64
"""Tokens of one node: it has one for each of its lives, and of those that have ended some may not be gone yet."""
SHUT_OUT_S: Final = 30.0
"""Who has shown more gets no link for so long: each one would bring the tokens again before it is held."""
MAX_SESSIONS: Final = 32
"""Of one certificate: a daemon has one, and each verb that asks one more. zenoh takes 1000 in all, then nobody."""
MAX_DATA_SESSIONS: Final = 128
"""...at a relay: also each worker of that node, and each verb that looks at streams."""
HOLD_S: Final = 0.8
"""A link that is held reads nothing, so zenoh ends it itself after its lease (1 s or more)."""
MAX_HELD: Final = 16
"""More are ended at once: what has come by a link that is held waits in the kernel, up to some MiB."""
SLOW_S: Final = 0.3
"""So much longer without room than with it, and the link of one who only looks ends."""
SLOW_OUT_S: Final = 1.0
"""Then it gets no other link for this long, as a radio that fades needs; twice as long each time soon after that."""
SLOW_LOOK_S: Final = 0.05
LOOK_AGAIN_S: Final = 0.05
LOOKS: Final = 10
"""A link is told of before it is in zenoh's list."""
MAX_WAITING: Final = 256

_log = logging.getLogger("zsched.control")


class Refusal(StrEnum):
    """Why a link ends."""

    STRANGER = "stranger"  # its certificate is not let in
    TOO_MANY = "too_many"  # its certificate has too many sessions here
    SHUT_OUT = "shut_out"  # its holder has just shown too many tokens, or was too slow
    SLOW = "slow"  # it only looks, and takes what it reads too slowly


def members_of(config: str) -> frozenset[str] | None:
    """The common names that a session of this configuration (JSON) lets in; ``None``: it goes by no such rules."""
    rules = json.loads(config).get("access_control") or {}
    if not rules.get("enabled"):
        return None
    subjects = rules.get("subjects") or ()
    return frozenset(name for subject in subjects for name in subject.get("cert_common_names") or ())


class Expulsion:
    """Of one session. `shows` may be called from any thread, and never blocks."""

    def __init__(
        self,
        session: zenoh.Session,
        fleet: str,
        members: Iterable[str],
        tell: Callable[[Refusal, str], None],
        max_sessions: int | None = None,
        *,
        has_streams: bool = False,
    ) -> None:
        """Look at every link from now on.

        ``members``: common names that are let in; each has at most ``max_sessions`` (`MAX_SESSIONS`).
        ``tell`` hears of each link that is refused, and its common name, in zenoh's threads and ours. ``has_streams``:
        guests and operators must read quickly. Nothing runs before the first of them, or of the refused links.
        """
        self._session, self._fleet, self._members, self._tell = session, fleet, frozenset(members), tell
        self._max_sessions = MAX_SESSIONS if max_sessions is None else max_sessions
        self._has_streams = has_streams
        self._sockets = LinkSockets(session)
        self._queue: queue.Queue[Callable[[zenoh.Link], bool] | None] = queue.Queue(MAX_WAITING)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._held: dict[LinkSocket, float] = {}
        """{link: when it ends}; the thread's own."""
        self._shown: dict[str, int] = {}
        """{node: tokens}; whoever shows one in a node's name has its certificate."""
        self._shut_out: dict[str, float] = {}
        """{holder that has shown too many, or was too slow: until when}."""
        self._slow_out: dict[str, tuple[float, float]] = {}
        """{holder that was too slow: (for how long it was shut out, until when)}; the thread's own."""
        self._lookers: dict[str, str] = {}
        """{session: its holder, who is no node}, with streams; those that are shut out, too, while they are held."""
        self._slow: dict[LinkSocket, float] = {}
        """{its link: how much longer it has been without room than with it}; the thread's own."""
        self._looked_at = 0.0
        self._linked: dict[str, set[str]] = {}
        """{common name: its sessions}."""
        self._names: dict[str, str] = {}
        """{session that is let in: its common name}."""
        self._is_closed = False
        self._watch = session.info.declare_link_events_listener(tolerant(self._on_link, "link"), history=True)

    def close(self) -> None:
        """Look at nothing more; the session may be closed already."""
        self._is_closed = True
        self._put(None)

    def shows(self, node: str, *, is_present: bool) -> bool:
        """A token of a node came or went; ``False``: it shows too many, and its links are ended."""
        count = self._shown[node] = max(0, self._shown.get(node, 0) + (1 if is_present else -1))
        if not count:
            del self._shown[node]
        if not is_present or count <= MAX_SHOWN:
            return True
        self._shut_out[node] = monotonic_s() + SHUT_OUT_S
        if count % MAX_SHOWN == 1:
            self._end(lambda link: self._holder(link) == node)
        return False

    def contradicts(self, zid: str, node: str) -> bool:
        """Whether a session that is linked to this one has the certificate of somebody else than ``node``."""
        name = self._names.get(zid) or self._name_of(zid)
        holder = parse_common_name(name, self._fleet)
        return holder is not None and (holder.name, holder.role) != (node, Role.NODE)

    def _name_of(self, zid: str) -> str:
        """The common name at the other end of a link whose event is still on its way; empty: there is no such link."""
        with contextlib.suppress(zenoh.ZError):  # the session is being closed
            links = (link for link in self._session.info.links() if str(link.zid) == zid)
            return next((link.auth_identifier or "" for link in links), "")
        return ""

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        """Only linked nodes' names count here; zenoh's access rules check a frame's sender against its link."""
        name, zid, is_present = (
            event.link.auth_identifier or "",
            str(event.link.zid),
            event.kind == zenoh.SampleKind.PUT,
        )
        if name in self._members:
            holder = parse_common_name(name, self._fleet)
            if self._has_streams and holder is not None and holder.role is not Role.NODE:
                self._look_at(zid, holder.name, is_present=is_present)
            is_shut_out = holder is not None and self._shut_out.get(holder.name, 0.0) > monotonic_s()
            if is_present and is_shut_out:
                self._refuse(zid, Refusal.SHUT_OUT, name)
            elif not self._has_room(name, zid, is_present=is_present):
                self._refuse(zid, Refusal.TOO_MANY, name)
        elif is_present and not str(event.link.src).startswith(f"{WORKERS_BY}/"):  # its rules are by the protocol
            _log.warning("stranger certificate=%r address=%s: it may nothing here", name, event.link.dst)
            self._refuse(zid, Refusal.STRANGER, name)

    def _look_at(self, zid: str, holder: str, *, is_present: bool) -> None:
        if not is_present:
            self._lookers.pop(zid, None)
            return
        self._lookers[zid] = holder
        self._begin()
        self._put(None)

    def _refuse(self, zid: str, why: Refusal, name: str) -> None:
        self._tell(why, name)
        self._end(lambda link: str(link.zid) == zid)

    def _has_room(self, name: str, zid: str, *, is_present: bool) -> bool:
        """A session of a certificate came or went; ``False``: it has too many."""
        held = self._linked.setdefault(name, set())
        if not is_present:
            held.discard(zid)
            self._names.pop(zid, None)
            if not held:
                del self._linked[name]
            return True
        if len(held) >= self._max_sessions and zid not in held:
            return False
        held.add(zid)
        self._names[zid] = name
        return True

    def _holder(self, link: zenoh.Link) -> str:
        held = parse_common_name(link.auth_identifier or "", self._fleet)
        return "" if held is None else held.name

    def _end(self, is_meant: Callable[[zenoh.Link], bool]) -> None:
        self._begin()
        self._put(is_meant)

    def _begin(self) -> None:
        with self._lock:
            if self._thread is None:
                thread = guarded(self._run, name="expulsion")
                thread.start()  # where no thread is to be had the next link that is refused tries again
                self._thread = thread

    def _put(self, is_meant: Callable[[zenoh.Link], bool] | None) -> None:
        try:
            self._queue.put_nowait(is_meant)
        except queue.Full:  # so many are ended already, and those that are left come again
            return

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        pause = threading.Event()
        while True:
            try:
                is_meant = self._queue.get(timeout=self._wait_s())
            except queue.Empty:
                is_meant = None
            if self._is_closed:
                return
            self._end_slow()
            self._end_held()
            if is_meant is None:
                continue
            for _ in range(LOOKS):
                if self._halt(is_meant):
                    break
                self._end_held()
                self._end_slow()
                pause.wait(LOOK_AGAIN_S)

    def _wait_s(self) -> float | None:
        due = [self._looked_at + SLOW_LOOK_S] if self._lookers else []
        due += self._held.values()
        return max(0.0, min(due) - monotonic_s()) if due else None

    def _end_slow(self) -> None:
        """Look whether those who only look have room, and end the links of those that have none too often."""
        lookers, now = dict(self._lookers), monotonic_s()
        if now - self._looked_at < SLOW_LOOK_S or not (lookers or self._slow):
            return
        passed_s, self._looked_at = min(now - self._looked_at, 2 * SLOW_LOOK_S), now
        try:
            links = [link for link in self._sockets.links() if link.zid in lookers]
        except zenoh.ZError:
            return  # the session closes
        ready, before, self._slow = with_room(links, 0.0), self._slow, {}
        for link in links:
            lacks_s = before.get(link, 0.0) + (-passed_s if link.fd in ready else passed_s)
            if lacks_s >= SLOW_S:
                self._shut_out_slow(lookers[link.zid], now)
                self._held.pop(link, None)
                self._tell(Refusal.SLOW, self._names.get(link.zid, ""))
                if link.abort():
                    _log.warning("the link to %s is ended: %s reads too slowly", link.name, lookers[link.zid])
            elif lacks_s > 0.0:
                self._slow[link] = lacks_s

    def _shut_out_slow(self, holder: str, now: float) -> None:
        last_s, until = self._slow_out.get(holder, (0.0, -math.inf))
        if now < until:
            return  # another link of the same moment
        out_s = min(SHUT_OUT_S, 2 * last_s) if now < until + SHUT_OUT_S else SLOW_OUT_S
        self._slow_out[holder] = out_s, now + out_s
        self._shut_out[holder] = max(self._shut_out.get(holder, 0.0), now + out_s)

    def _end_held(self) -> None:
        now = monotonic_s()
        for link in [link for link, until in self._held.items() if now >= until]:
            del self._held[link]
            link.abort()

    def _halt(self, is_meant: Callable[[zenoh.Link], bool]) -> bool:
        """Hold the links that are meant, or end them; whether there were any."""
        try:
            zids = {str(link.zid): link.auth_identifier for link in self._session.info.links() if is_meant(link)}
            meant = [link for link in self._sockets.links() if link.zid in zids]
        except zenoh.ZError:
            return True  # the session closes
        self._held = {link: until for link, until in self._held.items() if link in meant or until > monotonic_s()}
        for link in meant:
            if link in self._held:
                continue
            if len(self._held) < MAX_HELD and link.hold():
                self._held[link] = monotonic_s() + HOLD_S
            else:
                link.abort()
            _log.warning("the link to %s is ended: certificate=%r", link.name, zids[link.zid])
        return bool(meant)
