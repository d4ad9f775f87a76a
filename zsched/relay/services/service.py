"""Carries one service of this node to the task's owner: each request goes to one owner, and always gets an answer.

Knows: which slots are open, which one is asked, which requests are at the owner. Does not know: why a task moves.

A request that reached an owner is never sent again, unless its rule says ``retry: true``: an owner that did not answer
may have done the work. Only when it is certain that nobody took the request (no queryable matches, the worker says
that it is not the owner, or our session was closed before it went out) does it wait a moment for the next owner. What
the application gets instead of an answer is an error reply, its first words one of `ServiceProblem`:

=============  =======================================================================================================
busy           ``max_pending`` requests are at the owner already, or this machine has no thread for one more
no owner       nobody has taken the request within ``hold_s``: it was not carried out
owner gone     the owner died, or its link or this relay did, before it answered
moved          the task moved and the old owner's drain time ended before it answered
timeout        the owner did not answer within ``timeout_s``
=============  =======================================================================================================

zenoh ends a request when its owner's link ends, but not one that left within the next milliseconds, before the link's
queryables went with it: that would wait for its whole time. So `ServiceStream.look_after` ends what nobody can answer.

A thread per request, at most ``max_pending`` of them: a plain callback would serialise all requests, and a stalled
asker may block its own thread only. One more thread tells those that are turned away.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterable
from enum import Enum
from typing import Final

import zenoh
from zenoh import Query, Reply, Sample, SampleKind, Session

from zsched.core.hop.books import add_to, added, closed
from zsched.core.route.keyexpr import is_wild
from zsched.core.route.wildcards import Rewriter, capture_fault, rewriter
from zsched.core.values.plan import Route, StreamCount
from zsched.core.values.relay_protocol import ERROR_ENCODING, REFUSED_ENCODING, ServiceProblem
from zsched.core.values.struct import Struct, field
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, note, tolerant
from zsched.link.sessions.matching import is_matched
from zsched.relay.services.replies import Replies
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.receive import Declared, undeclare

LOOK_AGAIN_S: Final = 0.02
"""How often a waiting request looks for an owner; a flip wakes it at once."""
UNSERVED_GRACE_S: Final = 0.2
"""A request whose owner answers no more under its key gets this long: last answers may still be in our queues."""
JOIN_S: Final = 0.3
MAX_TURNED_AWAY: Final = 64
"""So many wait to be told that all is busy; further ones are told nothing."""
MAX_KEYS: Final = 256
"""Keys of a wildcard service that are looked after; of further ones it is only known when a request has no answer."""

_log = logging.getLogger("zsched.relay")


class _Outcome(Enum):
    ANSWERED = "answered"
    REFUSED = "refused"
    LEFT = "left"
    OWNER_GONE = "owner gone"
    TIMED_OUT = "timed out"


class _Asked(Struct, eq=False):
    """One request at the owner."""

    key: str
    """The owner's."""
    replies: Replies
    unserved_since: float | None = None
    """When nobody was found to answer under the key, and nobody since."""


class _ServiceSlot(Struct, eq=False):
    """One owner of the service. The queriers only tell whether anybody is there: requests have their own time."""

    session: Session
    owner_key: str
    forwards: Rewriter
    """From a key that was asked for to the owner's..."""
    backwards: Rewriter | None
    """...and back; ``None``: several keys become one on the way."""
    queriers: dict[str, zenoh.Querier] = field(default_factory=dict)
    pending: set[_Asked] = field(default_factory=set)
    is_closed: bool = False

    @property
    def is_matching(self) -> bool:
        return self.serves(self.owner_key)

    def key_for(self, asked: str) -> str:
        """The owner's key for one that was asked for."""
        return self.forwards(asked) or self.owner_key

    def serves(self, key: str) -> bool:
        """True when somebody answers under ``key``, and for keys with wildcards, of which zenoh cannot tell."""
        if is_wild(key) or (key not in self.queriers and len(self.queriers) >= MAX_KEYS):
            return True
        querier = self.queriers.get(key)
        if querier is None:
            querier = self.queriers[key] = self.session.declare_querier(key)
        return is_matched(querier)


class ServiceStream:
    """One service rule on this node; slots are named by their epoch. Every method may be called from any thread."""

    def __init__(self, session: Session, route: Route, local: Session | None = None) -> None:
        """Declare the queryable under the robot's own key, on ``local``, the host's own side, if there is one.

        Raises:
            zenoh.ZError: ``from`` is no key expression.
        """
        self.route = route
        self._session = session
        self._lock = threading.Condition()
        self._counter = StreamCounter(route.stream)
        self._slots: dict[int, _ServiceSlot] = {}
        self._active: _ServiceSlot | None = None
        self._running = 0
        self._turned_away: deque[tuple[Query, str]] = deque()
        self._has_teller = False
        """A thread tells them."""
        self._is_closed = False
        self._ended = threading.Event()
        take = zenoh.handlers.Callback(tolerant(self._take, "asked"), self._ended.set)
        self._queryable: Declared | None = (local or session).declare_queryable(
            route.from_expr, take, complete=True, allowed_origin=zenoh.Locality.REMOTE
        )

    def open(self, epoch: int, route: Route) -> None:
        """Make a slot ready; it is not asked yet.

        Raises:
            ValueError: ``to`` cannot be filled from ``from``.
            zenoh.ZError: ``to`` is no key expression.
        """
        forwards = rewriter(route.from_expr, route.to_expr)
        is_lossy = capture_fault(route.to_expr, route.from_expr) is not None
        backwards = None if is_lossy else rewriter(route.to_expr, route.from_expr)
        slot = _ServiceSlot(session=self._session, owner_key=route.to_expr, forwards=forwards, backwards=backwards)
        slot.serves(route.to_expr)  # zenoh learns from now on which servers are there
        with self._lock:
            self._slots[epoch] = slot

    def has_slot(self, epoch: int) -> bool:
        """Whether a slot is open."""
        return epoch in self._slots

    def is_matching(self, epoch: int) -> bool:
        """True when somebody answers under the slot's key."""
        slot = self._slots.get(epoch)
        return slot is not None and slot.is_matching

    def flip(self, epoch: int) -> None:
        """Ask this slot from now on; what is at the old owner stays there until it is answered or its slot closes."""
        with self._lock:
            self._active = self._slots.get(epoch, self._active)
            self._lock.notify_all()

    def hold(self) -> None:
        """Ask nobody any more until the next `flip`: requests that come wait, as long as their rule says."""
        with self._lock:
            self._active = None

    def rejoin(self, session: Session) -> None:
        """Ask by another session; every slot is closed."""
        self._session = session

    def has_ended(self, epoch: int) -> bool:
        """True when the slot has answered every request."""
        slot = self._slots.get(epoch)
        return slot is None or not slot.pending

    @property
    def is_still(self) -> bool:
        """Whether nobody has asked for a while (`StreamCounter.is_still`), and nobody waits for an answer."""
        return self._counter.is_still and not self._running

    @property
    def is_asked(self) -> bool:
        """Whether somebody waits for an answer."""
        return self._running > 0

    def look_after(self) -> None:
        """End the requests that nobody has been there to answer for `UNSERVED_GRACE_S`."""
        now = monotonic_s()
        with self._lock:
            for slot in self._slots.values():
                for asked in slot.pending:
                    if asked.replies.is_stopped:
                        continue  # why it was stopped stays as it is
                    if slot.serves(asked.key):
                        asked.unserved_since = None
                    elif asked.unserved_since is None:
                        asked.unserved_since = now
                    elif now - asked.unserved_since >= UNSERVED_GRACE_S:
                        asked.replies.stop()

    def close_slot(self, epoch: int) -> None:
        """Forget a slot; requests it has not answered get an error, or go to the next owner (``retry``)."""
        with self._lock:
            slot = self._slots.pop(epoch, None)
            if slot is None:
                return
            slot.is_closed = True
            if slot is self._active:
                self._active = None
            for asked in slot.pending:
                if asked.unserved_since is None and not slot.serves(asked.key):
                    asked.unserved_since = monotonic_s()
                asked.replies.stop()
        for querier in slot.queriers.values():
            undeclare(querier)

    def stop(self) -> None:
        """Take no more requests."""
        queryable, self._queryable = self._queryable, None
        if queryable is not None:
            undeclare(queryable)

    def close(self, *, is_end: bool = False) -> None:
        """Take no more requests and close every slot; those under way get an error, and are counted, within a moment.

        ``is_end``: this relay ends; the owners do not.
        """
        self.stop()
        with self._lock:
            self._is_closed = True
            for slot in self._slots.values() if is_end else ():
                for asked in slot.pending:
                    asked.unserved_since = asked.unserved_since or monotonic_s()
        for epoch in tuple(self._slots):
            self.close_slot(epoch)
        with self._lock:
            self._lock.notify_all()
            self._lock.wait_for(lambda: not self._running, JOIN_S)
        self._ended.wait(JOIN_S)

    def count(self) -> StreamCount:
        """The counters now: requests, their bytes, and how many ended otherwise than with the owner's answer."""
        with self._lock:
            return self._counter.value()

    # --- requests ----------------------------------------------------------------------------------------------------

    def _take(self, query: Query) -> None:
        with self._lock:
            self._counter.seen(len(query.payload) if query.payload is not None else 0)
            is_full = self._running >= self.route.service.max_pending
            self._running += not is_full
        if is_full:
            self._turn_away(query, f"{self.route.service.max_pending} requests are being answered")
            return
        try:
            guarded(self._serve, query, name=self.route.stream, kind="request", is_lasting=False).start()
        except RuntimeError as error:
            with self._lock:
                self._running -= 1
            note("request", error)
            with query:
                self._fail(query, ServiceProblem.BUSY, f"{error}: it was not done")

    def _turn_away(self, query: Query, text: str) -> None:
        """Have an asker told that all is busy, for its link may be full: zenoh's thread waits for nobody."""
        with self._lock:
            has_room, needs_teller = len(self._turned_away) < MAX_TURNED_AWAY, not self._has_teller
            if has_room:
                self._turned_away.append((query, text))
                self._has_teller = True
            else:
                self._counter.dropped("busy")
        if not has_room:
            query.drop()
        elif needs_teller:
            try:
                guarded(self._tell_turned_away, name=self.route.stream, kind="turned away", is_lasting=False).start()
            except RuntimeError as error:
                note("turned away", error)
                self._tell_turned_away()

    def _tell_turned_away(self) -> None:
        while True:
            with self._lock:
                if not self._turned_away:
                    self._has_teller = False
                    return
                query, text = self._turned_away.popleft()
            try:
                with query:
                    self._fail(query, ServiceProblem.BUSY, text)
            except zenoh.ZError as error:
                _log.info("%s: an answer could not be given (%s)", self.route.stream, error)
            except BaseException:
                with self._lock:
                    self._has_teller = False  # the next one begins another thread
                raise

    def _serve(self, query: Query) -> None:
        try:
            with query:  # a query that is kept alive hangs its asker
                self._answer(query)
        except zenoh.ZError as error:
            _log.info("%s: an answer could not be given (%s)", self.route.stream, error)
        finally:
            with self._lock:
                self._running -= 1
                self._lock.notify_all()

    def _answer(self, query: Query) -> None:
        """Ask one owner after the other, as far as that is allowed, until there is an answer or an error."""
        settings = self.route.service
        until = monotonic_s() + settings.timeout_s
        hold_until = until if settings.retry else min(until, monotonic_s() + settings.hold_s)
        problem = ServiceProblem.NO_OWNER, f"nobody serves {self.route.from_expr}: it was not done"
        has_had_owner = False
        while True:
            slot = self._await_owner(str(query.key_expr), hold_until)
            if slot is None:
                self._fail(query, *problem)
                return
            outcome = self._ask(query, slot, max(0.01, until - monotonic_s()))
            if outcome is _Outcome.ANSWERED:
                return
            is_refused = outcome is _Outcome.REFUSED
            if not (is_refused and has_had_owner):  # else nobody may say that it was not done
                problem = _problem(outcome, slot)
            has_had_owner |= not is_refused
            may_go_on = is_refused or settings.retry
            if not may_go_on or outcome is _Outcome.TIMED_OUT or monotonic_s() >= hold_until:
                self._fail(query, *problem)
                return
            with self._lock:
                self._counter.dropped("retried")
                self._lock.wait(LOOK_AGAIN_S)

    def _await_owner(self, asked: str, until: float) -> _ServiceSlot | None:
        """The slot to ask, as soon as there is somebody in it."""
        with self._lock:
            while True:
                slot = self._active
                if self._is_closed:
                    return None
                if slot is not None and slot.serves(slot.key_for(asked)):
                    return slot
                left = until - monotonic_s()
                if left <= 0:
                    return None
                self._lock.wait(min(left, LOOK_AGAIN_S))

    def _ask(self, query: Query, slot: _ServiceSlot, timeout_s: float) -> _Outcome:
        """Send the request to one owner and hand its answers on."""
        asked = _Asked(slot.key_for(str(query.key_expr)), Replies(timeout_s))
        with self._lock:  # a slot that closes from here on stops it
            if slot.is_closed:
                return _Outcome.REFUSED
            slot.pending.add(asked)
        try:
            try:
                asked.replies.send(
                    self._session,
                    zenoh.Selector(asked.key, query.parameters),
                    payload=query.payload,
                    encoding=query.encoding,
                    attachment=query.attachment,
                )
            except zenoh.ZError:  # the session was closed beneath us, for the next one
                return _Outcome.REFUSED
            return self._hand_on(query, asked, slot)
        finally:
            with self._lock:
                slot.pending.remove(asked)

    def _hand_on(self, query: Query, asked: _Asked, slot: _ServiceSlot) -> _Outcome:
        replies, answers = asked.replies, 0
        for reply in replies:
            error = reply.err
            if error is not None and str(error.encoding) == REFUSED_ENCODING and not answers:
                return _Outcome.REFUSED
            self._pass_on(query, reply, slot)
            answers += 1
        if replies.has_timed_out:
            outcome = _Outcome.TIMED_OUT
        elif replies.is_stopped and asked.unserved_since is None:
            outcome = _Outcome.LEFT
        else:
            outcome = _Outcome.OWNER_GONE
        if not answers:
            return outcome
        if replies.has_timed_out or replies.is_stopped:
            self._fail(query, *_problem(outcome, slot))  # the rest of a long answer
        elif replies.has_overflowed:
            self._fail(query, ServiceProblem.BUSY, "the asker is slower than the answers, some of them are missing")
        return _Outcome.ANSWERED

    def _pass_on(self, query: Query, reply: Reply, slot: _ServiceSlot) -> None:
        error, sample = reply.err, reply.ok
        key = self._key_for(query, sample, slot)
        if error is not None:
            query.reply_err(error.payload, encoding=error.encoding)
        elif sample is not None and sample.kind == SampleKind.DELETE:
            query.reply_del(key, attachment=sample.attachment, timestamp=sample.timestamp, express=sample.express)
        elif sample is not None:
            _reply(query, key, sample)

    def _key_for(self, query: Query, sample: Sample | None, slot: _ServiceSlot) -> str:
        """The key to answer under: the rule's, or, when that has wildcards, the one that was asked for.

        Where that has wildcards itself, it is the answer's own: else the asker could not tell two answers apart, and
        zenoh would hand it the last one.
        """
        asked = str(query.key_expr)
        if not is_wild(self.route.from_expr):
            return self.route.from_expr
        if sample is None or slot.backwards is None or not is_wild(asked):
            return asked
        own = slot.backwards(str(sample.key_expr))
        return own if own is not None and query.key_expr.intersects(own) else asked

    def _fail(self, query: Query, problem: ServiceProblem, text: str) -> None:
        with self._lock:
            self._counter.dropped(problem.name.lower())
        query.reply_err(f"{problem.value}: {text}", encoding=ERROR_ENCODING)


def _reply(query: Query, key: str, sample: Sample) -> None:
    query.reply(
        key,
        sample.payload,
        encoding=sample.encoding,
        attachment=sample.attachment,
        timestamp=sample.timestamp,
        express=sample.express,
    )


def _problem(outcome: _Outcome, slot: _ServiceSlot) -> tuple[ServiceProblem, str]:
    where = slot.owner_key
    if outcome is _Outcome.REFUSED:
        return ServiceProblem.NO_OWNER, f"the worker at {where} is not the owner: it was not done"
    if outcome is _Outcome.TIMED_OUT:
        return ServiceProblem.TIMEOUT, f"no answer from {where}; it may have been done"
    if outcome is _Outcome.LEFT:
        return ServiceProblem.MOVED, f"the task has left {where}, which had not answered; it may have been done"
    return ServiceProblem.OWNER_GONE, f"no answer from {where}; it may have been done"


class Services:
    """All services of one task on this node."""

    def __init__(self, session: Session, local: Session | None = None) -> None:
        self._session = session
        self._local = local
        self._streams: dict[str, ServiceStream] = {}
        self._closed: dict[str, StreamCount] = {}
        """What services have counted that were closed, and may come again by the same name..."""
        self._changing = threading.Lock()
        """...which a reader of counters sees in one of both places."""

    def open(self, epoch: int, route: Route) -> None:
        """Open a slot of one service, which begins to take requests if it is new.

        Raises:
            zenoh.ZError: an expression is none.
        """
        stream = self._streams.get(route.stream)
        if stream is None or (stream.route.from_expr, stream.route.service) != (route.from_expr, route.service):
            self._end(route.stream)
            stream = self._streams[route.stream] = ServiceStream(self._session, route, self._local)
        stream.open(epoch, route)

    def open_beside(self, epoch: int, route: Route) -> None:
        """Open a slot of a service that goes by other settings now.

        Raises:
            ValueError, zenoh.ZError: see `ServiceStream.open`.
        """
        self._streams[route.stream].open(epoch, route)

    def has_slot(self, epoch: int, route: Route) -> bool:
        """Whether a route's service has the slot, or is none any more that could have it."""
        stream = self._streams.get(route.stream)
        return stream is None or stream.route.from_expr != route.from_expr or stream.has_slot(epoch)

    def is_matching(self, epoch: int) -> bool:
        """True when every service that has a slot of the epoch would be answered there."""
        return all(stream.is_matching(epoch) for stream in self._streams.values())

    def flip(self, epoch: int) -> None:
        """Ask the slots of this epoch from now on."""
        for stream in self._streams.values():
            stream.flip(epoch)

    def has_ended(self, epoch: int) -> bool:
        """True when the epoch's owner has answered every request."""
        return all(stream.has_ended(epoch) for stream in self._streams.values())

    def hold(self) -> None:
        """Let requests that come from now on wait for an owner."""
        for stream in self._streams.values():
            stream.hold()

    def rejoin(self, session: Session, epochs: Iterable[int]) -> None:
        """Go on by another session, with no slot; what the owners have not answered gets an error.

        ``epochs``: of the slots that are open.
        """
        for epoch in epochs:
            self.close_slot(epoch)
        self._session = session
        for stream in self._streams.values():
            stream.rejoin(session)

    @property
    def is_still(self) -> bool:
        """Whether no service has carried anything for a while."""
        return all(stream.is_still for stream in self._streams.values())

    def look_after(self) -> None:
        """End the requests whose owner is gone without a word."""
        for stream in self._streams.values():
            stream.look_after()

    def close_slot(self, epoch: int) -> None:
        """Close the slots of one epoch."""
        for stream in self._streams.values():
            stream.close_slot(epoch)

    def close_stream(self, epoch: int, name: str) -> None:
        """Close one service's slot of one epoch."""
        if name in self._streams:
            self._streams[name].close_slot(epoch)

    def stop(self) -> None:
        """Take no more requests."""
        for stream in self._streams.values():
            stream.stop()

    @property
    def is_asked(self) -> bool:
        """Whether somebody waits for an answer."""
        return any(stream.is_asked for stream in self._streams.values())

    def finish(self) -> None:
        """This relay ends: close all; they stay in the table, and who asks now hears their last counts."""
        for stream in self._streams.values():
            stream.close(is_end=True)

    def keep(self, names: set[str]) -> None:
        """Close the services whose stream is not among ``names``."""
        for name in tuple(self._streams):
            if name not in names:
                self._end(name)

    def _end(self, name: str) -> None:
        stream = self._streams.get(name)
        if stream is None:
            return
        stream.close()
        with self._changing:
            del self._streams[name]
            add_to(self._closed, closed(stream.count()))

    def counts(self) -> tuple[StreamCount, ...]:
        """The counters of every service."""
        with self._changing:
            return added(tuple(stream.count() for stream in tuple(self._streams.values())), self._closed)
