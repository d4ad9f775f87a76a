"""Puts a stream's outputs to all its applications, and leaves behind the one that takes too little.

Knows: whose link has room (`zsched.link.sessions.link_sockets`), which sessions are workers', when to wait.
Does not know: zenoh's queues, which stream this is, who of those that are linked receives it: whose link fills up
receives something.

zenoh hands a sample to one receiver after the other: a put that waits (BLOCK) for a frozen one makes all of them wait,
for seconds. So, where there are two or more, each put first waits until every link has room. A receiver whose link has
none is *left behind*, while another one is ready, when it has taken nothing for `NO_ROOM_S`, or when the others have
waited this long for it and the queue before the put runs full. As long as somebody is left behind, puts do not wait
(DROP): zenoh drops for this receiver alone. What it may have missed is counted. After a rest, and when its link has
room again, it is waited for like the others; of class ``latest`` the newest sample is then put once more. While nobody
has room nothing is put, until the queue is full: a put that waits is not to be taken back, and zenoh ends the link that
it waits for.

A link that ends takes along what its sockets held. When its client dials again, what was put since it was last heard
counts as missed: what it had read of that nobody knows.

A sample that is larger than what a link holds may have begun when the receiver froze: nothing ends such a put but the
link's end. `Crowd.look_after` ends the link, when the receiver has taken nothing for `STUCK_S`; it then dials again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Final

from zenoh import Sample, Session, Timestamp

from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.link.sessions.link_sockets import LinkSocket, LinkSockets, with_room
from zsched.link.sessions.send_queue import NO_ROOM_S
from zsched.relay.streams.lanes import Lane

LOOK_S: Final = 1.0
"""How old our knowledge of the links may be."""
STUCK_S: Final = 0.5
SLICE_S: Final = 0.02
"""How long to wait for room before looking again at everything else."""
FORGIVEN_RATIO: Final = 0.5
REST_S, MAX_REST_S = 1.0, 8.0
"""A receiver is left behind for at least this long; for twice as long when it is left again soon."""
TOLD_BYTES: Final = 192 << 10
"""After so much a link that was sent next to nothing of it leads to nobody who receives the stream..."""
MIN_SHARE: Final = 32
"""...less than the 32nd part: a receiver may take some of a stream's keys only."""
SLOW_PUT_S: Final = 0.005
MAX_CHARGE_S: Final = 0.5

MAX_KNOWN: Final = 1024

_feeders: dict[str, None] = {}
"""Sessions of workers, in order; of this process."""

_log = logging.getLogger("zsched.relay")


class Reader(Struct, eq=False):
    """A link that may lead to an application that receives the stream."""

    link: LinkSocket
    looked_at: float
    """When it was last seen to have no room, or to have it."""
    is_full: bool = False
    taken: int = 0
    moved_at: float = 0.0
    """Since when it is full and has taken nothing."""
    cost_s: float = 0.0
    """How long the others have waited for it; half of the time that passes is forgiven."""
    left_until: float | None = None
    """It is left behind, at least until then (monotonic seconds)."""
    rest_s: float = 0.0
    back_at: float = 0.0
    receives: bool = True
    """Not, while its link is sent next to nothing of what is put..."""
    sent: tuple[int, int] = (0, 0)
    """...since (bytes put, bytes sent by its link)."""

    def compare(self, put: int) -> None:
        """Whether it receives the stream, of which so many bytes have been put; nobody knows while it has no room."""
        told = self.link.account()
        if told is not None and not self.is_full and put - self.sent[0] >= TOLD_BYTES:
            before, self.sent = self.sent, (put, told.acked + told.held)
            self.receives = MIN_SHARE * (self.sent[1] - before[1]) >= put - before[0]

    def look(self, now: float, *, has_room: bool) -> None:
        """Note whether it takes anything, and what that costs the others."""
        passed, self.looked_at = now - self.looked_at, now
        was_full, self.is_full = self.is_full, not has_room
        self.cost_s = max(0.0, self.cost_s - passed * FORGIVEN_RATIO)
        if has_room:
            return
        taken = self.link.taken()
        if not was_full or taken != self.taken:
            self.taken, self.moved_at = taken, now

    def leave(self, now: float) -> None:
        """Wait for it no more, for a while."""
        is_soon = now - self.back_at < MAX_REST_S
        self.rest_s = min(2 * self.rest_s, MAX_REST_S) if is_soon and self.rest_s else REST_S
        self.left_until, self.cost_s = now + self.rest_s, 0.0

    def come_back(self, now: float) -> None:
        """Wait for it again, if it has rested."""
        if self.left_until is not None and now > self.left_until:
            self.left_until, self.back_at = None, now


class Crowd:
    """The applications that receive one output stream. `put` and `take_owed` belong to one thread, the rest to any."""

    def __init__(
        self,
        session: Session,
        expr: str,
        is_pressed: Callable[[], bool],
        may_wait: Callable[[int], bool],
        *,
        is_latest: bool,
    ) -> None:
        """``is_pressed`` says whether samples wait before `put`, so many that some will be dropped for all.

        ``may_wait``: whether a sample of this size could wait there, too; if not, the next one is dropped for all.
        """
        self._session = session
        self._expr = expr
        self._is_pressed, self._may_wait = is_pressed, may_wait
        self._is_latest = is_latest
        self._sockets = LinkSockets(session)
        self._readers: dict[LinkSocket, Reader] = {}
        self._looked_at = -LOOK_S
        self._cared_at = 0.0
        self._lock = threading.Lock()
        self._looking = threading.Lock()
        self._is_smooth = True
        """Everybody had room at the last look, and nobody is left behind."""
        self._is_closed = False
        self._put_count = self._put_before = self._put_bytes = 0
        """All samples put so far, those until the last look at the links, and all bytes."""
        self._heard: dict[str, tuple[int, int]] = {}
        """{session: how many had been put when it was heard and its link stayed, and when it was last heard}."""
        self._putting_since: float | None = None
        self._owed: dict[Lane, tuple[Sample, Timestamp | None]] = {}
        self._missed = 0

    def put(self, lane: Lane, sample: Sample, stamp: Timestamp | None, size: int) -> None:
        """Put a sample, waiting for every receiver that is not left behind."""
        left = self._wait(size)
        self._put_count, self._put_bytes = self._put_count + 1, self._put_bytes + size
        self._putting_since = monotonic_s()
        try:
            if left:
                lane.put_dropping(self._session, sample, stamp)
            else:
                lane.put(sample, stamp)
        finally:
            self._putting_since = None
        self._note_missed(len(left))
        if left and self._is_latest:
            self._owed[lane] = (sample, stamp)
        elif self._owed:
            self._owed.pop(lane, None)

    def close(self) -> None:
        """Wait for nobody any more."""
        self._is_closed = True

    def forget(self, lane: Lane) -> None:
        """A lane is given back: what somebody has missed of it is counted already (`put`'s thread)."""
        self._owed.pop(lane, None)

    def take_missed(self) -> int:
        """How many samples single receivers may have missed since the last time, summed over them."""
        with self._lock:
            missed, self._missed = self._missed, 0
        return missed

    def _note_missed(self, count: int) -> None:
        with self._lock:
            self._missed += count

    @property
    def owes(self) -> bool:
        """Whether somebody may have missed samples that are still the newest, and nobody is left behind any more."""
        if not self._owed:
            return False
        self._full()
        return all(reader.left_until is None for reader in tuple(self._readers.values()))

    def take_owed(self) -> list[tuple[Lane, Sample, Timestamp | None]]:
        """Those samples; what `put` has put since is newer."""
        if not self.owes:
            return []
        owed, self._owed = self._owed, {}
        return [(lane, sample, stamp) for lane, (sample, stamp) in owed.items()]

    def look_after(self) -> None:
        """See for which receiver a put under way waits; call it a few times a second.

        A receiver that froze in the middle of a sample loses its link, if others wait for it.
        """
        since, now = self._putting_since, monotonic_s()
        period_s, self._cared_at = now - self._cared_at, now
        is_slow = since is not None and now - since >= SLOW_PUT_S
        self._look(now, SLOW_PUT_S if is_slow else LOOK_S)  # it may wait for one that has just come
        if since is None or not is_slow:
            return
        full = self._full()
        self._charge(full, min(period_s, MAX_CHARGE_S))
        if now - since < STUCK_S or not self._has_ready_receiver():
            return
        for reader in full:
            if now - reader.moved_at >= STUCK_S and reader.link.cut():
                _log.warning("%s: %s took nothing of a sample: its link is ended", self._expr, reader.link.name)
                self._note_missed(1)

    # --- one put -----------------------------------------------------------------------------------------------------

    def _look(self, now: float, period_s: float = LOOK_S) -> None:
        """Know the links, now and then."""
        with self._looking:
            if now - self._looked_at >= period_s:
                links = [link for link in self._sockets.links() if link.zid not in _feeders]
                self._count_returned(links, now - self._looked_at)
                self._readers = {link: self._readers.get(link) or Reader(link, now) for link in links}
                self._looked_at, self._put_before = now, self._put_count
                for reader in () if self._is_latest else self._readers.values():  # `latest` may go by shared memory
                    reader.compare(self._put_bytes)

    def _count_returned(self, links: list[LinkSocket], passed_s: float) -> None:
        """Nodes and their workers are peers, and receive nothing here."""
        before = self._put_before
        for link in links:
            known, newest = self._heard.get(link.zid, (self._put_count, before))
            if link not in self._readers:
                peers = {str(zid) for zid in self._session.info.peers_zid()}
                self._note_missed(0 if link.zid in peers else self._put_count - known)
                self._heard[link.zid] = (before, before)
            elif 0 < link.silent_s() < passed_s:  # 0: it is gone
                self._heard[link.zid] = (newest, before)
        while len(self._heard) > MAX_KNOWN:
            self._heard.pop(next(iter(self._heard)))

    def _wait(self, size: int) -> tuple[Reader, ...]:
        """Wait for room at every link; returns the receivers that are left behind and have none.

        Before a sample would be dropped for all, one is dropped for those that have no room.
        """
        looked_at = monotonic_s()
        while True:
            self._look(monotonic_s())
            full = self._full()
            now = monotonic_s()
            self._charge(full, now - looked_at)
            looked_at = now
            waiting = [reader for reader in full if reader.left_until is None]
            has_other = len(full) < len(self._readers)
            if not waiting or self._is_closed or (has_other and not self._may_wait(size)):
                return tuple(full)
            _ready(waiting, SLICE_S)

    def _full(self) -> list[Reader]:
        """The receivers without room now; one that has rested and has room is waited for again."""
        with self._lock:
            readers = tuple(self._readers.values())
            ready = _ready(readers, 0.0)  # one that is closed is ready, too: nothing waits for it
            if len(ready) == len(readers) and self._is_smooth:
                return []
            now = monotonic_s()
            for reader in readers:
                reader.look(now, has_room=reader.link.fd in ready)
                if not reader.is_full:
                    reader.come_back(now)
            self._is_smooth = not any(reader.is_full or reader.left_until is not None for reader in readers)
            return [reader for reader in readers if reader.is_full]

    def _charge(self, full: list[Reader], waited_s: float) -> None:
        """Leave behind receivers that are stalled, or have cost the others too much; ``full``: those without room."""
        if not full or not self._has_ready_receiver():
            return  # nobody waits for them
        now, is_pressed = monotonic_s(), self._is_pressed()
        for reader in full:
            reader.cost_s += waited_s
            is_stalled = now - reader.moved_at > NO_ROOM_S
            if reader.left_until is None and (is_stalled or (is_pressed and reader.cost_s > NO_ROOM_S)):
                reader.leave(now)
                what = "stalled" if is_stalled else "too slow"
                _log.info("%s: %s is %s: nobody waits for it", self._expr, reader.link.name, what)

    def _has_ready_receiver(self) -> bool:
        return any(reader.receives and not reader.is_full for reader in tuple(self._readers.values()))


def note_feeder(zid: str) -> None:
    """A session puts answers to this process: it is a worker's, and none of those that receive outputs."""
    if zid in _feeders:
        return
    if len(_feeders) >= MAX_KNOWN:
        _feeders.pop(next(iter(_feeders)))
    _feeders[zid] = None


def _ready(readers: Iterable[Reader], wait_s: float) -> set[int]:
    return with_room((reader.link for reader in readers), wait_s)
