"""Listens to keys of the data network for a while: a client session of its own, beside everybody else's.

Knows: zenoh sessions and subscribers, arrival times. Does not know: nodes, streams, what is made of the samples.

Who only looks must not hold up what he looks at. What waits for a reader that stands still (a terminal that is held, a
pager) is bounded in number and in bytes; what is dropped by that is counted. What comes faster than our thread takes it
zenoh drops without a count: then the reader hears that more may be missing.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Final, Self

import zenoh

from zsched.core.route.ros2 import decode_attachment
from zsched.core.values.errors import AdapterError
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import ends_within, guarded

RING: Final = 100_000
"""Samples that zenoh keeps for our thread; beyond it the oldest go, and zenoh does not say how many."""
DEPTH: Final = 10_000
HELD_BYTES: Final = 32 << 20
"""Samples, and bytes of theirs, that may wait for the reader; newer ones are dropped and counted."""
CLOSE_S: Final = 0.5
"""Closing a session towards a stopped peer can take seconds; we wait for at most this long."""


class Tapped(Struct, frozen=True, kw_only=True):
    """One sample as it passed. ``at`` is when it came, seconds of `monotonic_s`."""

    side: str
    key: str
    at: float
    size: int
    kind: str
    encoding: str
    attachment_size: int
    payload: bytes
    """As much of it as the tap keeps."""
    source: str = ""
    """Which publisher's it is: what the sample says of it, by zenoh's own means or rmw_zenoh's; empty: nothing."""


class StreamTap:
    """Subscribers on one session per side. A context manager: leaving it closes the sessions."""

    def __init__(self, sides: Mapping[str, str], keys: Sequence[str], *, kept_bytes: int | None = 0) -> None:
        """Open the sessions and subscribe.

        Args:
            sides: {name: zenoh configuration as JSON}.
            keys: key expressions.
            kept_bytes: so much of each payload is kept; ``None``: all of it.

        Raises:
            AdapterError: a session cannot be opened, or a key is none.
        """
        self.missed = 0
        """Samples that came faster than the reader took them."""
        self.may_miss_more = False
        """They came faster than our thread took them, too: what zenoh has dropped nobody counts."""
        self._kept_bytes = kept_bytes
        self._samples: deque[Tapped] = deque()
        self._held_bytes = 0
        self._came = threading.Condition()
        self._sessions: list[zenoh.Session] = []
        self._subscribers: list[Any] = []
        try:
            for side, config in sides.items():
                self._open(side, config, keys)
        except (zenoh.ZError, ValueError) as error:
            self.close()
            raise AdapterError(f"the data network cannot be joined: {error}; is the node's relay running?") from error

    def _open(self, side: str, config: str, keys: Sequence[str]) -> None:
        session = zenoh.open(zenoh.Config.from_json5(config))
        self._sessions.append(session)
        for key in keys:
            # a channel and a thread of ours: a callback's thread would hold the process at its end, and a channel
            # that is full would hold up the relay
            subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(RING))
            self._subscribers.append(subscriber)
            guarded(self._run, side, subscriber.handler, name=f"tap {key}", kind="tap").start()

    def _run(self, side: str, handler: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        for sample in self._each(handler):
            attachment, payload = sample.attachment, sample.payload.to_bytes() if self._kept_bytes != 0 else b""
            tapped = Tapped(
                side=side,
                key=str(sample.key_expr),
                at=monotonic_s(),
                size=len(sample.payload),
                kind="delete" if sample.kind == zenoh.SampleKind.DELETE else "put",
                encoding=str(sample.encoding),
                attachment_size=0 if attachment is None else len(attachment),
                payload=payload[: self._kept_bytes],
                source=_source(sample),
            )
            self._put(tapped)

    def _each(self, handler: zenoh.handlers.Handler[zenoh.Sample]) -> Iterator[zenoh.Sample]:
        """Each sample as it comes, and whether the ring may have dropped some.

        It drops only while it is full, and what it is full of is taken in a row then, without finding it empty.
        """
        in_a_row = 0
        while True:
            try:
                sample = handler.try_recv()
                if sample is None:
                    in_a_row = 0
                    sample = handler.recv()
            except zenoh.ZError:
                return  # undeclared
            in_a_row += 1
            self.may_miss_more |= in_a_row >= RING
            yield sample

    def _put(self, tapped: Tapped) -> None:
        with self._came:
            # one sample may be larger than all that is held
            is_full = len(self._samples) >= DEPTH or self._held_bytes + len(tapped.payload) > HELD_BYTES
            if self._samples and is_full:
                self.missed += 1
                return
            self._samples.append(tapped)
            self._held_bytes += len(tapped.payload)
            self._came.notify()

    def told(self, done: str) -> str:
        """What was missed, in words; empty: nothing. ``done``: what is made of samples."""
        if not self.missed:
            return f"maybe some samples came faster than they could be {done}" if self.may_miss_more else ""
        more = ", and maybe more" if self.may_miss_more else ""
        return f"{self.missed} samples{more} came faster than they could be {done}"

    def until(self, end: float) -> Iterator[Tapped]:
        """What comes until ``end`` (`monotonic_s`), in order of arrival."""
        while (left := end - monotonic_s()) > 0:
            with self._came:
                if not self._came.wait_for(lambda: bool(self._samples), left):
                    return
                tapped = self._samples.popleft()
                self._held_bytes -= len(tapped.payload)
            yield tapped

    def close(self) -> None:
        """Close the sessions, within `CLOSE_S`."""
        ends_within(CLOSE_S, self._close, name="tap close")

    def _close(self) -> None:
        for entity in (*self._subscribers, *self._sessions):
            with contextlib.suppress(zenoh.ZError):
                (entity.close if isinstance(entity, zenoh.Session) else entity.undeclare)()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _source(sample: zenoh.Sample) -> str:
    info, attachment, stamp = sample.source_info, sample.attachment, sample.timestamp
    if info is not None:
        return f"{info.source_id.zid}/{info.source_id.eid}"
    ros = None if attachment is None else decode_attachment(attachment.to_bytes())
    if ros is not None:
        return ros.gid.hex()
    return "" if stamp is None else str(stamp.get_id())
