"""The watch over stalled links: what it outlives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from zsched.link.sessions.link_sockets import LinkSockets
from zsched.link.sessions.stalled_links import StalledLinks


def test_a_session_that_closes_while_a_put_waits_is_no_fault_of_the_watch(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was told as a thread that has failed, for good."""

    def closed(_sockets: LinkSockets) -> None:
        raise zenoh.ZError("session closed")

    monkeypatch.setattr(LinkSockets, "links", closed)
    stalled = StalledLinks(cast("Any", SimpleNamespace()), 1.5)
    stalled._puts[1] = 0.0
    stalled._look(10.0)
    assert stalled.ended == 0
