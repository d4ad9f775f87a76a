"""What introductions say of themselves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from support.waiting import until
from zsched.link.sessions import relink
from zsched.link.sessions.relink import Introducer


def test_a_machine_that_is_missed_for_good_is_logged_ever_more_seldom(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One that is switched off is missed once a minute."""
    opened: list[str] = []

    @contextmanager
    def open_none(_config: Any) -> Iterator[None]:
        opened.append("opened")
        yield

    monkeypatch.setattr(zenoh, "open", open_none)
    monkeypatch.setattr(relink, "STAY_S", 0.0)
    introducer = Introducer("{}")
    introducer.__dict__["_config"] = "{}"
    with caplog.at_level("INFO"):
        for count in range(1, 10):
            introducer.introduce()
            until(lambda count=count: len(opened) == count, "an introduction")  # type: ignore[misc]
            until(lambda: not introducer.is_under_way, "its end")
    introducer.close()
    assert [record.args for record in caplog.records if "introducing" in record.message] == [(1,), (2,), (4,), (8,)]
