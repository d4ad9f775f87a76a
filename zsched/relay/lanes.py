"""One publisher of a stream: numbers what it puts, and remembers what the receiver has not acknowledged.

Knows: how a sample is put on with everything it had, its number, what was sent and what came of it. Does not know:
queues, slots, when to send again. Its outlet's lock guards what `acknowledge` and `keep` touch.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import zenoh
from zenoh import CongestionControl, Sample, SampleKind, Session, Timestamp, ext

from zsched.core.relay_protocol import StreamAck

KEPT_SAMPLES: Final = 2048
KEPT_BYTES: Final = 16 << 20
"""Bounds of what one publisher keeps until it is acknowledged."""
KEPT_BYTES_LATEST: Final = 256 << 10
"""Class ``latest``: so much besides the newest ``keep_last`` samples; large ones are not worth a radio's time again."""
RESEND_S: Final = 0.3
MAX_RESEND_S: Final = 10.0
"""Bounds of the time without progress after which what is not acknowledged is put again."""

_DELETE: Final = SampleKind.DELETE
_Plain = zenoh.Publisher
_SourceInfo = zenoh.SourceInfo


class Sent(NamedTuple):
    """A sample that went out under ``number`` and is kept (a tuple: one is made for every sample)."""

    number: int
    sample: Sample
    stamp: Timestamp | None
    size: int
    at: float
    """When its put had returned (monotonic seconds)."""
    took_s: float
    """How long the put waited for the link."""


@dataclass(slots=True, eq=False)
class Lane:
    """A concrete key with one priority and express flag."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    source_id: zenoh.EntityGlobalId
    eid: int
    count: int = 0
    """Samples put so far, and the number of the next one."""
    ack: StreamAck | None = None
    incarnation: str = ""
    kept: deque[Sent] = field(default_factory=deque)
    kept_bytes: int = 0
    resend_from: int | None = None
    moved_at: float = 0.0
    """When something was last sent or newly acknowledged (monotonic seconds)."""
    pause_s: float = RESEND_S
    """How long nothing may move before it is put again: twice what acknowledgements take here, or as long as a put
    takes; doubled each time."""

    def put(self, sample: Sample, stamp: Timestamp | None) -> None:
        """Put a sample on under the next number, with everything that zenoh lets us keep."""
        publisher = self.publisher
        if sample.kind == _DELETE:
            self._delete(sample, stamp)
        elif isinstance(publisher, _Plain):
            publisher.put(
                sample.payload,
                encoding=sample.encoding,
                attachment=sample.attachment,
                timestamp=stamp,
                source_info=_SourceInfo(self.source_id, self.count),
            )
        else:
            publisher.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment, timestamp=stamp)
        self.count += 1

    def _delete(self, sample: Sample, stamp: Timestamp | None) -> None:
        publisher = self.publisher
        if isinstance(publisher, zenoh.Publisher):
            source = zenoh.SourceInfo(self.source_id, self.count)
            publisher.delete(attachment=sample.attachment, timestamp=stamp, source_info=source)
        else:
            publisher.delete(attachment=sample.attachment, timestamp=stamp)

    def put_again(self, session: Session, sent: Sent) -> None:
        """Put a kept sample on under the number it had (never into a cache a second time)."""
        sample, publisher = sent.sample, self.publisher
        source = zenoh.SourceInfo(self.source_id, sent.number)
        if sample.kind == _DELETE:
            session.delete(
                self.key,
                attachment=sample.attachment,
                timestamp=sent.stamp,
                source_info=source,
                congestion_control=CongestionControl.BLOCK,
                priority=publisher.priority,
            )
            return
        session.put(
            self.key,
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            timestamp=sent.stamp,
            source_info=source,
            congestion_control=CongestionControl.BLOCK,
            priority=publisher.priority,
        )

    # --- what came of it ---------------------------------------------------------------------------------------------

    def keep(self, sent: Sent, *, samples: int, least: int, size: int) -> None:
        """Keep what was just put: at most so many ``samples`` and ``size`` bytes, but ``least`` of them; oldest go."""
        self.kept.append(sent)
        self.kept_bytes += sent.size
        self.moved_at, self.pause_s = sent.at, max(self.pause_s, min(sent.took_s, MAX_RESEND_S))
        while len(self.kept) > samples or (self.kept_bytes > size and len(self.kept) > least):
            self.kept_bytes -= self.kept.popleft().size

    def is_late(self, now: float) -> bool:
        """Whether what is not acknowledged should be put again.

        As TCP's retransmission timer (RFC 6298): a slow radio takes its time for every large sample, and sending it
        twice would make it slower.
        """
        return self.arrived < self.count and now - self.moved_at > self.pause_s

    def ask_again(self, start: int, now: float) -> None:
        """Have everything from ``start`` on put again; the next time with twice the patience, while nothing moves."""
        self.resend_from, self.moved_at = start, now
        self.pause_s = min(2 * self.pause_s, MAX_RESEND_S)

    def acknowledge(self, ack: StreamAck, incarnation: str, now: float) -> bool:
        """Take an acknowledgement; ``True`` when it is of another life of the worker, which starts anew."""
        is_other = bool(self.incarnation) and incarnation != self.incarnation
        self.incarnation = incarnation
        if is_other or self.ack is None or ack.processed >= self.ack.processed:
            self.ack = ack
        newest: Sent | None = None
        while self.kept and self.kept[0].number < ack.arrived:
            newest = self.kept.popleft()
            self.kept_bytes -= newest.size
        if newest is not None:
            self.pause_s = min(max(2 * (now - newest.at), newest.took_s, RESEND_S), MAX_RESEND_S)
        return is_other

    @property
    def arrived(self) -> int:
        """Number of the sample the receiver waits for; everything, while it never acknowledged."""
        return self.count if self.ack is None else min(self.ack.arrived, self.count)

    @property
    def in_flight(self) -> int:
        """Samples sent and not processed yet, as far as we know."""
        return 0 if self.ack is None else max(0, self.count - self.ack.processed)

    def is_full(self) -> bool:
        """True when nothing more may be sent before an acknowledgement (class ``reliable``)."""
        if self.ack is None:
            return False
        return self.count - self.ack.processed >= KEPT_SAMPLES or self.kept_bytes >= KEPT_BYTES
