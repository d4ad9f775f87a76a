"""What streams keep is bounded by payloads and attachments: an application may have its data in either."""

from __future__ import annotations

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values.plan import Direction, OnCrash, Route, StreamClass, StreamSettings
from zsched.relay.streams import inputs, outputs
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.outputs import OutputStream

SENT = 20
BOUND = 10_000
FITS = 9
"""So many attachments of 1000 bytes, each with a payload of 1 byte."""


@pytest.mark.parametrize("direction", [Direction.INPUT, Direction.OUTPUT])
def test_attachments_count_for_what_waits_for_an_owner(direction: Direction, monkeypatch: pytest.MonkeyPatch) -> None:
    """4096 samples of 1 byte with 100 kB of attachment each took 390 MiB, where 64 MiB was the bound."""
    monkeypatch.setattr(inputs, "MAX_BYTES", BOUND)
    monkeypatch.setattr(outputs, "HOLD_BYTES", BOUND)
    settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100, on_crash=OnCrash.REPLAY)
    route = Route(stream="t/x/0", direction=direction, from_expr="from/a", to_expr="to/a", settings=settings)
    with hub_and_neighbour() as (relay, outside):
        stream: InputStream | OutputStream
        if direction is Direction.INPUT:
            stream = InputStream(relay, route, frozenset({str(relay.zid())}))
        else:
            stream = OutputStream(relay, route, frozenset({str(relay.zid())}), lambda: None)
            stream.open(2, route)
        publisher = outside.declare_publisher("from/a", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: matches(publisher), "the stream takes it")
        for _ in range(SENT):
            publisher.put(b"x", attachment=bytes(1000))
        until(lambda: stream.count().messages == SENT, "all have come")
        assert dict(stream.count().drops) == {"overflow": SENT - FITS}
        assert stream.count().bytes == SENT, "status goes on telling the bytes of payloads"
        stream.close()
