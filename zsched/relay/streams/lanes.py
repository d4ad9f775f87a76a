"""One publisher of a stream: puts samples under their numbers, with everything that they had.

Knows: zenoh's publishers, how a sample is put on, and put again. Does not know: what the numbers mean
(`zsched.core.hop.sender`), queues, slots, when to send again. Its outlet's lock guards the numbers.
"""

from __future__ import annotations

from typing import Final

import zenoh
from zenoh import CongestionControl, Sample, SampleKind, Session, Timestamp, ext

from zsched.core.hop.kept import Sent
from zsched.core.hop.sender import Sender
from zsched.core.hop.serial import serial_of

_DELETE: Final = SampleKind.DELETE
_Plain = zenoh.Publisher
_SourceInfo = zenoh.SourceInfo


class Lane(Sender, kw_only=True, eq=False):
    """A concrete key with one priority and express flag."""

    key: str
    publisher: zenoh.Publisher | ext.AdvancedPublisher
    source_id: zenoh.EntityGlobalId
    eid: int

    def put(self, sample: Sample, stamp: Timestamp | None) -> None:
        """Put a sample on under the next number (the caller counts), with everything that zenoh lets us keep."""
        publisher = self.publisher
        if sample.kind == _DELETE:
            self._delete(sample, stamp)
        elif isinstance(publisher, _Plain):
            publisher.put(
                sample.payload,
                encoding=sample.encoding,
                attachment=sample.attachment,
                timestamp=stamp,
                source_info=_SourceInfo(self.source_id, serial_of(self.count)),
            )
        else:
            publisher.put(sample.payload, encoding=sample.encoding, attachment=sample.attachment, timestamp=stamp)

    def _delete(self, sample: Sample, stamp: Timestamp | None) -> None:
        publisher = self.publisher
        if isinstance(publisher, zenoh.Publisher):
            source = zenoh.SourceInfo(self.source_id, serial_of(self.count))
            publisher.delete(attachment=sample.attachment, timestamp=stamp, source_info=source)
        else:
            publisher.delete(attachment=sample.attachment, timestamp=stamp)

    def put_again(self, session: Session, sent: Sent) -> None:
        """Put a kept sample on under the number it had (never into a cache a second time)."""
        sample, publisher = sent.sample, self.publisher
        source = zenoh.SourceInfo(self.source_id, serial_of(sent.number))
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
