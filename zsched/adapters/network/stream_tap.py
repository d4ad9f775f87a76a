"""Listens to keys of the data network for a while: a client session of its own, beside everybody else's.

Knows: zenoh sessions and subscribers, arrival times. Does not know: nodes, streams, what is made of the samples.
"""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Final, Self

import zenoh

from zsched.clock import monotonic_s
from zsched.core.route.ros2 import decode_attachment
from zsched.core.values.struct import Struct
from zsched.errors import AdapterError
from zsched.guard import ends_within, guarded

DEPTH: Final = 10_000
"""Samples that may wait for the reader; beyond it the oldest go, and `StreamTap.missed` stays honest."""
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
    payload: zenoh.ZBytes
    source: str = ""
    """Which publisher's it is: what the sample says of it, by zenoh's own means or rmw_zenoh's; empty: nothing."""


class StreamTap:
    """Subscribers on one session per side. A context manager: leaving it closes the sessions."""

    def __init__(self, sides: Mapping[str, str], keys: Sequence[str]) -> None:
        """Open the sessions (``sides``: name -> zenoh configuration as JSON) and subscribe to ``keys``.

        Raises:
            AdapterError: a session cannot be opened, or a key is none.
        """
        self.missed = 0
        self._samples: queue.Queue[Tapped] = queue.Queue(DEPTH)
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
            # a channel and a thread of ours: a callback's thread would hold the process at its end
            subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(DEPTH))
            self._subscribers.append(subscriber)
            guarded(self._run, side, subscriber.handler, name=f"tap {key}", kind="tap").start()

    def _run(self, side: str, handler: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        for sample in handler:
            attachment = sample.attachment
            tapped = Tapped(
                side=side,
                key=str(sample.key_expr),
                at=monotonic_s(),
                size=len(sample.payload),
                kind="delete" if sample.kind == zenoh.SampleKind.DELETE else "put",
                encoding=str(sample.encoding),
                attachment_size=0 if attachment is None else len(attachment),
                payload=sample.payload,
                source=_source(sample),
            )
            try:
                self._samples.put_nowait(tapped)
            except queue.Full:
                self.missed += 1

    def until(self, end: float) -> Iterator[Tapped]:
        """What comes until ``end`` (`monotonic_s`), in order of arrival."""
        while (left := end - monotonic_s()) > 0:
            try:
                yield self._samples.get(timeout=left)
            except queue.Empty:
                return

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
