"""One output of a worker: stamped with the epoch, numbered, ended by a marker.

Knows: publishers per epoch, how many samples went out. Does not know: roles (it asks for the epoch), inputs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import zenoh
from zenoh import CongestionControl, ext

from zsched.clock import monotonic_s
from zsched.core.relay_protocol import EndMarker
from zsched.keyspace import END_CHUNK
from zsched.relay_pipe import encode_end

REPEAT_AFTER_S: Final = 0.5
"""Silence after which a ``latest`` value that came in a burst is put once more: under congestion the newest of a burst
is the one that is dropped. (No heartbeats for that: see `zsched.relay.outlet`.)"""
KEPT_EPOCHS: Final = 2
"""Publishers of older epochs are given back: nobody admits them any more."""


@dataclass(slots=True, eq=False)
class _Stamped:
    """The publisher of one epoch."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    count: int = 0


class Output:
    """An output declared with `Worker.publisher`; `put` may be called from any thread."""

    def __init__(
        self,
        session: zenoh.Session,
        template: str,
        *,
        latest: bool,
        reliable: bool,
        keep_last: int,
        epoch_now: Callable[[], int | None],
    ) -> None:
        self._session = session
        self._template = template
        self.is_latest = latest
        """Whether the last value is kept for who comes late."""
        self._keep_last = keep_last
        self._congestion = CongestionControl.BLOCK if reliable else CongestionControl.BLOCK_FIRST
        self._epoch_now = epoch_now
        self._lock = threading.Lock()
        self._epochs: dict[int, _Stamped] = {}
        self._last: tuple[Any, Any, Any] | None = None
        self._last_at = -REPEAT_AFTER_S
        self.sent = 0
        """Samples that went out."""
        self.withheld = 0
        """Samples that went nowhere, since this worker is not the owner."""

    def put(self, payload: Any, *, attachment: Any = None, encoding: Any = None) -> bool:
        """Publish (``bytes`` or ``zenoh.ZBytes``); ``False``, and counted, while this worker is not the owner."""
        with self._lock:
            epoch = self._epoch_now()
            if epoch is None:
                self.withheld += 1
                return False
            stamped = self._epochs.get(epoch) or self._declare(epoch)
            self._put(stamped, payload, attachment, encoding)
            self.sent += 1
            now = monotonic_s()
            is_burst = self.is_latest and now - self._last_at < REPEAT_AFTER_S
            self._last = (payload, attachment, encoding) if is_burst else None
            self._last_at = now
            return True

    def repeat_if_silent(self) -> None:
        """Put the last value once more when a burst has ended a while ago (class ``latest``)."""
        with self._lock:
            if self._last is None or monotonic_s() - self._last_at < REPEAT_AFTER_S:
                return
            last, self._last = self._last, None
            epoch = self._epoch_now()
            if epoch in self._epochs:
                self._put(self._epochs[epoch], *last)

    def send_end(self, epoch: int) -> None:
        """Put the end marker behind the last sample of an epoch (also when there was none)."""
        with self._lock:
            stamped = self._epochs.get(epoch) or self._declare(epoch)
            self._session.put(
                f"{stamped.key}/{END_CHUNK}",
                encode_end(EndMarker(epoch=epoch, count=stamped.count)),
                congestion_control=CongestionControl.BLOCK,
                source_info=zenoh.SourceInfo(stamped.publisher.id, stamped.count),
            )

    def _declare(self, epoch: int) -> _Stamped:
        key = self._template.replace("{epoch}", str(epoch))
        publisher: zenoh.Publisher | ext.AdvancedPublisher
        if self.is_latest:
            publisher = ext.declare_advanced_publisher(
                self._session,
                key,
                congestion_control=self._congestion,
                cache=ext.CacheConfig(max(1, self._keep_last)),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=self._congestion)
        stamped = self._epochs[epoch] = _Stamped(key=key, publisher=publisher)
        for old in sorted(self._epochs)[:-KEPT_EPOCHS]:
            self._epochs.pop(old).publisher.undeclare()  # type: ignore[no-untyped-call] # zenoh's stubs
        return stamped

    def _put(self, stamped: _Stamped, payload: Any, attachment: Any, encoding: Any) -> None:
        publisher = stamped.publisher
        if isinstance(publisher, zenoh.Publisher):
            source = zenoh.SourceInfo(publisher.id, stamped.count)
            publisher.put(payload, attachment=attachment, encoding=encoding, source_info=source)
        else:
            publisher.put(payload, attachment=attachment, encoding=encoding)
        stamped.count += 1
