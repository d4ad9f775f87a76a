"""Hands answers that have passed a stream's gate to the application's callback, in a thread of its own.

Knows: the queue of each class, the key that the application knows an answer by. Does not know: gates, slots, where
answers come from. A callback that falls behind loses what a relay's application would lose: of class ``latest`` and
``best_effort`` older answers, of ``reliable`` the newest that do not fit, counted as ``overflow``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from zenoh import Sample, SampleKind, Timestamp

from zsched.core.route.wildcards import Rewriting
from zsched.core.values.plan import Route, StreamClass
from zsched.hop.weight import weight
from zsched.relay.streams.outlet import QUEUE_DEPTH
from zsched.relay.streams.tally import Tally
from zsched.sessions.send_queue import SendQueue
from zsched.stream.samples import Received


class Hand:
    """The way of one output stream to the application (`zsched.relay.streams.outputs.Way`)."""

    def __init__(self, route: Route, deliver: Callable[[Received], None]) -> None:
        """``deliver`` is called in this way's thread.

        Raises:
            ValueError: ``to`` cannot be filled from ``from``.
        """
        settings = route.settings
        is_reliable = settings.stream_class is StreamClass.RELIABLE
        self._deliver = deliver
        self._missed = 0
        self._is_given_up = False
        self._rewriting, self._to = Rewriting(route.from_expr, route.to_expr), route.to_expr
        self._queue = SendQueue(
            f"to {route.to_expr}",
            depth=max(settings.depth, QUEUE_DEPTH) if is_reliable else settings.depth,
            sheds=not is_reliable,
            keep_last=settings.keep_last if settings.stream_class is StreamClass.LATEST else settings.depth,
        )

    def also_from(self, from_expr: str) -> None:
        """Take answers of another owner, too.

        Raises:
            ValueError: ``to`` cannot be filled from its ``from``.
        """
        self._rewriting.also_from(from_expr)

    def key_of(self, sample: Sample) -> str:
        """The application's key of an answer (``""``: it does not fit)."""
        return self._rewriting.key(str(sample.key_expr)) or "" if self._rewriting.is_wild else self._to

    def send(
        self, sample: Sample, stamp: Timestamp | None = None, size: int | None = None, place: int = 0
    ) -> tuple[str, int]:
        """Queue one answer; answers (why something was dropped, how much of it)."""
        key = self.key_of(sample)
        if not key:
            return "no_key", 1
        received = Received(
            key=key,
            payload=sample.payload,
            attachment=sample.attachment,
            encoding=str(sample.encoding),
            timestamp=sample.timestamp or stamp,
            deleted=sample.kind == SampleKind.DELETE,
        )
        size = weight(sample) if size is None else size
        return "overflow", self._queue.send((key, place), partial(self._deliver, received), size)

    def keep_first(self) -> None:
        """Nothing is kept."""

    @property
    def is_empty(self) -> bool:
        """Whether the callback has returned for every answer."""
        return self._queue.is_empty

    def look_after(self) -> None:
        """Nothing waits for a time."""

    def take_missed(self) -> int:
        """Answers that were given up, since the last call; what does not fit is counted when it comes."""
        missed, self._missed = self._missed, 0
        return missed

    def give_up(self) -> int:
        """Hand nothing over any more; how many answers still waited."""
        left = self._queue.close()
        self._missed += left
        self._is_given_up = True
        return left

    def undeclare(self) -> Tally:
        """End the thread behind the answer that it has in hand; how many waited, unless they were given up."""
        left = self._queue.close()
        return Tally(waiting=0 if self._is_given_up else left)
