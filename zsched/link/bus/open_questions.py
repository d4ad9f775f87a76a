"""The questions that others have asked over zenoh and the loop has not answered yet, by number.

Knows: zenoh's queries, how long and how many are kept. Does not know: what is asked, who answers.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import zenoh

from zsched.core.values import codec as wire
from zsched.host.clock import monotonic_s

QUESTION_TTL_S = 5.0
MAX_QUESTIONS = 1024
Seal = Callable[[str, bytes, bytes], bytes | None]
"""(key, frame, the question's attachment) -> the answer's attachment."""


def _no_seal(_key: str, _frame: bytes, _question: bytes) -> None:
    return None


class Questions:
    """Open zenoh queries by number, until they are answered or too old."""

    def __init__(self, seal: Seal = _no_seal) -> None:
        self._seal = seal
        self._numbers = itertools.count(1)
        self._open: dict[int, tuple[zenoh.Query, str, float]] = {}
        """{number: (the query, the answer's key, until when it is kept)}."""
        self._lock = threading.Lock()

    def keep(self, query: zenoh.Query, reply_key: str, ttl_s: float = QUESTION_TTL_S) -> int:
        """Remember a query for ``ttl_s``; the oldest are dropped when there are too many, and those too old."""
        now = monotonic_s()
        with self._lock:
            number = next(self._numbers)
            self._open[number] = (query, reply_key, now + ttl_s)
            expired = [n for n, (_, _, until) in self._open.items() if now > until]
            expired += list(self._open)[: max(len(self._open) - MAX_QUESTIONS, 0)]
            dropped = [self._open.pop(n)[0] for n in expired if n in self._open]
        for old in dropped:
            old.drop()
        return number

    def answer(self, number: int, value: object) -> None:
        """Reply and let go; too late is no error."""
        with self._lock:
            entry = self._open.pop(number, None)
        if entry is None:
            return
        query, reply_key, _ = entry
        try:
            frame = wire.encode(value)
            question = b"" if query.attachment is None else query.attachment.to_bytes()
            query.reply(reply_key, frame, attachment=self._seal(reply_key, frame, question))
        finally:
            query.drop()

    def drop(self, number: int) -> None:
        """Let a question end without an answer."""
        with self._lock:
            entry = self._open.pop(number, None)
        if entry is not None:
            entry[0].drop()

    def clear(self) -> None:
        """Let go of everything (the session closes)."""
        with self._lock:
            entries, self._open = list(self._open.values()), {}
        for query, _, _ in entries:
            query.drop()
