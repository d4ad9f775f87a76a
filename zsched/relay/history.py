"""Fetches what publishers still hold of a key: the cached values that a late subscriber has missed.

Knows: the tokens and caches of advanced publishers, how long to wait for an answer. Does not know: streams, slots.

Zenoh's own advanced subscriber would do it too, but holds back every live sample of the stream while such a query is
open, for 10 s when the publisher is frozen (1.10.2; the time has no parameter in Python). Here live samples never wait:
a query lasts `TIMEOUT_S` at most, in a thread of ours, and what it brings is let in only where it is newer than what
has come live.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh
from zenoh import Sample, SampleKind, Session

from zsched.core.serial import number_near
from zsched.guard import guarded, tolerant

TIMEOUT_S: Final = 0.5
MAX_FETCHES: Final = 8
"""Queries at one time in this process; further ones wait."""
MAX_PENDING: Final = 64
"""Keys of one expression that wait to be asked; behind that one question for all is less work."""
MAX_ASKERS: Final = 4
"""Threads of one expression; a frozen publisher holds one for `TIMEOUT_S`."""
MAX_SOURCES: Final = 4096
ADVANCED: Final = "@adv"

_log = logging.getLogger("zsched.relay")
_turn = threading.BoundedSemaphore(MAX_FETCHES)

_Source = tuple[str, str, int]


class History:
    """The caches behind one key expression. ``deliver`` is called under `History.lock`, from several threads."""

    def __init__(
        self,
        session: Session,
        expr: str,
        depth: int,
        deliver: Callable[[Sample], None],
        origin: zenoh.Locality = zenoh.Locality.REMOTE,
    ) -> None:
        """Watch for publishers; `start` begins to ask.

        Raises:
            zenoh.ZError: ``expr`` is no key expression.
        """
        self._session = session
        self._expr = expr
        self._depth = max(1, depth)
        self._deliver = deliver
        self._origin = origin
        self._own_id = str(session.zid())
        self._everything = f"{expr}/{ADVANCED}/**"
        self._asking = threading.Lock()
        self._wanted: dict[str, None] = {}  # in order
        self._askers = 0
        self._is_closed = False
        self.lock = threading.Lock()
        self._newest: dict[_Source, int] = {}  # numbers that came either way
        self._fetched: dict[_Source, int] = {}  # numbers that caches brought
        self._live: set[str] = set()
        self._tokens: zenoh.Subscriber[None] | None = None

    def start(self) -> None:
        """Ask every cache there is, and later those of publishers that appear.

        The watch comes first: a publisher that was linked between a question and the watch would never be asked.
        """
        watch = f"{self._expr}/{ADVANCED}/pub/**"
        self._tokens = self._session.liveliness().declare_subscriber(
            watch, tolerant(self._token, "history"), history=False
        )
        self._ask(self._everything)

    def close(self) -> None:
        """Ask nobody any more; answers on their way are dropped."""
        self._is_closed = True
        if self._tokens is not None:
            self._tokens.undeclare()

    def live(self, sample: Sample) -> None:
        """A sample came the usual way: deliver it, unless the cache has brought it already."""
        with self.lock:
            info = sample.source_info
            if info is None:
                self._live.add(str(sample.key_expr))
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

    def _note(self, numbers: dict[_Source, int], source: _Source, number: int) -> None:
        if len(numbers) >= MAX_SOURCES and source not in numbers:
            numbers.pop(next(iter(numbers)))
        numbers[source] = max(number, numbers.get(source, -1))

    # --- asking ------------------------------------------------------------------------------------------------------

    def _token(self, sample: Sample) -> None:
        """A publisher with a cache came (zenoh's callback thread: start a thread, nothing else)."""
        key = str(sample.key_expr)
        if sample.kind == SampleKind.PUT and self._own_id not in key.split("/"):
            self._ask(key)

    def _ask(self, key: str) -> None:
        """Have a key's caches asked; where too many wait, one question for all of them takes their place."""
        with self._asking:
            if self._is_closed or self._everything in self._wanted:
                return
            if len(self._wanted) >= MAX_PENDING:
                self._wanted.clear()
                key = self._everything
            self._wanted[key] = None
            if self._askers >= MAX_ASKERS:
                return
            self._askers += 1
        guarded(self._fetch, name=f"history {self._expr}", kind="history", is_lasting=False).start()

    def _fetch(self) -> None:
        while (key := self._next()) is not None:
            try:
                with _turn:
                    self._take_answers(key)
            except zenoh.ZError as error:  # the session closes
                _log.debug("%s: %s", key, error)

    def _next(self) -> str | None:
        """What to ask for now; ``None`` and one asker less when that is nothing."""
        with self._asking:
            key = None if self._is_closed else next(iter(self._wanted), None)
            if key is None:
                self._askers -= 1
            else:
                del self._wanted[key]
            return key

    def _take_answers(self, key: str) -> None:
        answers = self._session.get(
            f"{key}?_max={self._depth}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            allowed_destination=self._origin,
            timeout=TIMEOUT_S,
        )
        for answer in answers:
            if answer.ok is not None and not self._is_closed:
                self._cached(answer.ok)

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
