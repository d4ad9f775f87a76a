"""The streams of one task on this node that are open, and what each of them has counted, closed ones included.

Knows: by which sessions a stream is opened, when another key or class makes it another stream. Does not know: slots.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from typing import TypeVar

import zenoh
from zenoh import Session

from zsched.core.hop.books import add_to, added, closed
from zsched.core.values.plan import Route, StreamClass, StreamCount
from zsched.relay.streams.answer_times import AnswerTimes
from zsched.relay.streams.inputs import InputStream, KeptValues
from zsched.relay.streams.outputs import OutputStream

_Stream = TypeVar("_Stream", InputStream, OutputStream)


class OpenStreams:
    """Changed by the task's thread alone; `counts` and `under_way` may be read by any."""

    def __init__(self, session: Session, own_ids: frozenset[str], local: Session | None = None) -> None:
        """``session`` is the fleet's, ``local`` the one of the host's own side, if it has one.

        ``own_ids`` are those of all sessions of this process.
        """
        self._session, self._local, self._own_ids = session, local, own_ids
        self._times = AnswerTimes()
        self.wake: Callable[[], None] = lambda: None
        """Called, in any thread, when the end of an output has come."""
        self.inputs: dict[str, InputStream] = {}
        self.outputs: dict[str, OutputStream] = {}
        self._closed: dict[str, StreamCount] = {}
        """What streams have counted that were closed, and may come again by the same name..."""
        self._changing = threading.Lock()
        """...which a reader of counters sees in one of both places."""
        self._left: dict[str, KeptValues] = {}
        """{key expression: what inputs kept that were closed since `keep`}: rules may change places, and settings."""
        self._late: set[str] = set()
        """Those of them whose next input could not be opened for a moment: it is tried again."""

    def all(self) -> list[InputStream | OutputStream]:
        """Inputs, then outputs."""
        return [*self.inputs.values(), *self.outputs.values()]

    def input_of(self, route: Route) -> InputStream:
        """The open input of a route; one of the same name that takes another key, or otherwise, is closed first.

        Raises:
            ValueError, zenoh.ZError: it cannot be opened.
            RuntimeError: no thread is to be had.
        """
        return self._of(self.inputs, route, self._take_input)

    def output_of(self, route: Route) -> OutputStream:
        """The open output of a route; one of the same name that puts out elsewhere, or otherwise, is closed first.

        Raises:
            ValueError, zenoh.ZError: it cannot be opened.
            RuntimeError: no thread is to be had.
        """
        return self._of(self.outputs, route, self._take_output)

    def keep(self, names: Collection[str]) -> None:
        """Close all others."""
        for streams in (self.inputs, self.outputs):
            for stream in tuple(streams):
                if stream not in names:
                    self._end(streams, stream)
        self._left = {expr: kept for expr, kept in self._left.items() if expr in self._late}

    def keep_inputs(self, names: Collection[str]) -> None:
        """Close all other inputs."""
        self.keep({*names, *self.outputs})

    def close(self) -> None:
        """Close all; they stay in the table, and whoever asks now hears their last counts."""
        for stream in self.all():
            stream.close()

    def rejoin(self, session: Session, own_ids: frozenset[str]) -> Iterator[str]:
        """Open all by another data session; a problem of each that could not be."""
        self._session, self._own_ids = session, own_ids
        for stream in self.all():
            try:
                stream.rejoin(session, own_ids)
            except (ValueError, zenoh.ZError, RuntimeError) as error:  # RuntimeError: no thread is to be had
                yield f"{stream.route.stream}: {error}"

    def counts(self) -> tuple[StreamCount, ...]:
        """The counters of every stream."""
        with self._changing:
            return added(tuple(stream.count() for stream in self.all()), self._closed)

    @property
    def under_way(self) -> int:
        """Samples that have no acknowledgement yet."""
        return sum(source.under_way() for source in tuple(self.inputs.values()))

    @property
    def is_still(self) -> bool:
        """Whether none has carried anything for a while."""
        return all(stream.is_still for stream in self.all())

    @property
    def is_counted(self) -> bool:
        """True when something may have to be sent (again) without a sample coming in."""
        return any(stream.route.settings.stream_class is not StreamClass.BEST_EFFORT for stream in self.all())

    def _take_input(self, route: Route) -> InputStream:
        kept = self._kept(route)
        self._late.discard(route.from_expr)
        try:
            return InputStream(self._session, route, self._own_ids, self._local, self._times, kept=kept)
        except RuntimeError:
            self._late.add(route.from_expr)
            self._left[route.from_expr] = kept
            raise

    def _kept(self, route: Route) -> KeptValues:
        """What a stream of the same keys has kept, beside which this one comes, or in its place."""
        same = (one.kept() for one in self.inputs.values() if one.route.from_expr == route.from_expr)
        return next((kept for kept in same if kept), ()) or self._left.pop(route.from_expr, ())

    def _take_output(self, route: Route) -> OutputStream:
        return OutputStream(self._session, route, self._own_ids, self.wake, self._local, self._times)

    def _of(self, streams: dict[str, _Stream], route: Route, take: Callable[[Route], _Stream]) -> _Stream:
        one = streams.get(route.stream)
        if one is None or (one.route.near, one.route.settings) != (route.near, route.settings):
            self._end(streams, route.stream)
            one = streams[route.stream] = take(route)
        return one

    def _end(self, streams: dict[str, InputStream] | dict[str, OutputStream], stream: str) -> None:
        one = streams.get(stream)
        if one is None:
            return
        one.close()
        with self._changing:
            del streams[stream]
            add_to(self._closed, closed(one.count()))
        if not isinstance(one, InputStream):
            return
        if kept := one.kept():
            self._left[one.route.from_expr] = kept
