"""Fetches what publishers still hold of a key: the cached values that a late subscriber has missed.

Knows: the tokens and caches of advanced publishers, how long to wait for an answer. Does not know: streams, slots,
which publisher is asked next (`Questions`).

Zenoh's own advanced subscriber would do it too, but holds back every live sample of the stream while such a query is
open, for 10 s when the publisher is frozen (1.10.2; the time has no parameter in Python). Here live samples never wait:
a query lasts `TIMEOUT_S` at most, in a thread of ours, and what it brings is let in only where it is newer than what
has come live.
"""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import zenoh
from zenoh import Sample, SampleKind, Session

from zsched.core.hop.serial import number_near
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, tolerant
from zsched.relay.streams.places import PublisherId
from zsched.relay.streams.questions import ADVANCED, Publisher, Question, Questions, publisher_of

TIMEOUT_S: Final = 0.5
MAX_FETCHES: Final = 8
"""Queries at one time in this process; further ones wait."""
MAX_ASKERS: Final = 4
"""Threads of one expression; a frozen publisher holds one for `TIMEOUT_S`."""
MAX_SOURCES: Final = 4096
UNNUMBERED: Final = "uhlc"
"""In the token of a publisher whose samples have times instead of numbers."""

_log = logging.getLogger("zsched.relay")
_turn = threading.BoundedSemaphore(MAX_FETCHES)

_Source = tuple[str, str, int]


class HeldValues:
    """The caches behind one key expression. ``deliver`` is called under `HeldValues.lock`, from several threads."""

    def __init__(
        self,
        session: Session,
        expr: str,
        depth: int,
        deliver: Callable[[Sample], None],
        origin: zenoh.Locality = zenoh.Locality.REMOTE,
        *,
        asks: bool = True,
    ) -> None:
        """Watch for publishers; `start` begins to ask, unless they are only watched (``asks``).

        Raises:
            zenoh.ZError: ``expr`` is no key expression.
        """
        self._session = session
        self._expr = expr
        self._depth = max(1, depth)
        self._deliver = deliver
        self._origin = origin
        self._asks = asks
        self._there: dict[PublisherId, bool] = {}
        """Whose token has been seen, and whether it still is there."""
        self._own_id = str(session.zid())
        self._questions = Questions(expr, self._depth)
        self._asking = threading.Condition()
        self._sending = threading.Lock()
        """Held while `session.get` runs: a session that is closed meanwhile raises "Already borrowed"."""
        self._askers = 0
        self._waits = False
        """One of the askers waits until a question is due again."""
        self._is_closed = False
        self.lock = threading.Lock()
        self._newest: dict[_Source, int] = {}  # numbers that came either way
        self._fetched: dict[_Source, int] = {}  # numbers that caches brought
        self._live: OrderedDict[str, None] = OrderedDict()  # keys of what came live without a number, in order
        self._tokens: zenoh.Subscriber[None] | None = None

    def start(self) -> None:
        """Ask every cache there is, and later those of publishers that appear.

        The watch also tells of publishers that are there: who fails to answer is known, and is asked again.
        """
        watch = f"{self._expr}/{ADVANCED}/pub/**"
        with self._asking:
            if self._asks:
                self._questions.ask_all(monotonic_s())
                self._have_asked()
        self._tokens = self._session.liveliness().declare_subscriber(
            watch, tolerant(self._token, "history"), history=True
        )

    def close(self) -> None:
        """Ask nobody any more; answers on their way are dropped, and the session may be closed."""
        with self._sending, self._asking:
            self._is_closed = True
            self._asking.notify_all()
        if self._tokens is not None:
            self._tokens.undeclare()

    def is_there(self, publisher: PublisherId) -> bool | None:
        """Whether a publisher shows its token; ``None``: it never has."""
        return self._there.get(publisher)

    def live(self, sample: Sample) -> None:
        """A sample came the usual way: deliver it, unless the cache has brought it already."""
        with self.lock:
            info = sample.source_info
            if info is None:
                self._note_live(str(sample.key_expr))
            else:
                source = _source(sample, info)
                number = self._number(source, info)
                self._note(self._newest, source, number)
                if self._fetched and number <= self._fetched.get(source, -1):
                    return
            self._deliver(sample)

    def _number(self, source: _Source, info: zenoh.SourceInfo) -> int:
        """Whole, of which the lowest 32 bits came."""
        serial: int = info.source_sn
        newest = self._newest.get(source)
        return serial if newest is None else number_near(serial, newest)

    def _note_live(self, key: str) -> None:
        self._live[key] = None
        self._live.move_to_end(key)
        if len(self._live) > MAX_SOURCES:
            self._live.popitem(last=False)

    def _note(self, numbers: dict[_Source, int], source: _Source, number: int) -> None:
        if len(numbers) >= MAX_SOURCES and source not in numbers:
            numbers.pop(next(iter(numbers)))
        numbers[source] = max(number, numbers.get(source, -1))

    # --- asking ------------------------------------------------------------------------------------------------------

    def _token(self, sample: Sample) -> None:
        """A publisher with a cache came or went (zenoh's callback thread: start a thread, nothing else)."""
        key = str(sample.key_expr)
        is_there = sample.kind == SampleKind.PUT
        _, session, number = publisher_of(key)
        if number.isdecimal():  # else its samples have no numbers, and do not tell whose they are
            self._there[session, int(number)] = is_there
            if len(self._there) > MAX_SOURCES:
                self._there.pop(next(iter(self._there)))
        if not self._asks or self._own_id in key.split("/"):
            return
        with self._asking:
            if is_there:
                self._questions.appeared(key, monotonic_s())
                self._have_asked()
            else:
                self._questions.disappeared(key)

    def _have_asked(self) -> None:
        """See to it that somebody asks; `_asking` is held."""
        if self._is_closed:
            return
        self._asking.notify()
        if self._askers < MAX_ASKERS:
            guarded(self._fetch, name=f"history {self._expr}", kind="history", is_lasting=False).start()
            self._askers += 1

    def _fetch(self) -> None:
        while (question := self._next()) is not None:
            is_whole = False
            try:
                with _turn:
                    is_whole = self._take_answers(question)
            except zenoh.ZError as error:  # the session closes
                _log.debug("%s: %s", question.selector, error)
            finally:
                with self._asking:
                    self._questions.ended(question, monotonic_s(), is_whole=is_whole)
                    self._asking.notify()

    def _next(self) -> Question | None:
        """What to ask for; waits where something is due later; ``None`` and one asker less when there is nothing."""
        with self._asking:
            while not self._is_closed:
                now = monotonic_s()
                if (question := self._questions.next(now)) is not None:
                    return question
                due_s = self._questions.next_due_s()
                if due_s is None or self._waits:
                    break
                self._waits = True
                self._asking.wait(max(0.0, due_s - now))
                self._waits = False
            self._askers -= 1
            return None

    def _take_answers(self, question: Question) -> bool:
        """Whether all who were asked have answered."""
        with self._sending:
            if self._is_closed:
                return False
            answers = self._session.get(
                f"{question.selector}?_max={self._depth}",
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                allowed_destination=self._origin,
                timeout=TIMEOUT_S,
            )
        is_whole = True
        for answer in answers:
            if answer.ok is None:
                is_whole = False
            elif not self._is_closed:
                self._cached(answer.ok)
                publisher = _publisher(answer.ok, answer.replier_id)
                with self._asking:
                    question.answers[publisher] += 1
        return is_whole

    def _cached(self, sample: Sample) -> None:
        with self.lock:
            info = sample.source_info
            if info is None:
                if str(sample.key_expr) in self._live:
                    return
            else:
                source = _source(sample, info)
                number = self._number(source, info)
                if number <= self._newest.get(source, -1):
                    return
                for numbers in (self._newest, self._fetched):
                    self._note(numbers, source, number)
            self._deliver(sample)


def _source(sample: Sample, info: zenoh.SourceInfo) -> _Source:
    return str(sample.key_expr), str(info.source_id.zid), info.source_id.eid


def _publisher(sample: Sample, replier: zenoh.EntityGlobalId | None) -> Publisher:
    """The publisher that has answered, as its token names it."""
    info = sample.source_info
    if info is not None:
        return str(sample.key_expr), str(info.source_id.zid), str(info.source_id.eid)
    return str(sample.key_expr), "" if replier is None else str(replier.zid), UNNUMBERED
