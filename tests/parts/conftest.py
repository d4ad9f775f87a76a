"""For tests of parts: what tests of several modules begin with, and that no stream loses a sample silently."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from support.books import wait_for_balance
from support.hand_relay import Relay
from zsched.relay.streams.inputs import InputStream


@pytest.fixture
def relay() -> Iterator[Relay]:
    made = Relay()
    try:
        yield made
    finally:
        made.session.close()


@pytest.fixture(autouse=True)
def balanced_books(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every input stream that the test made accounts for every sample, also once it is closed."""
    made: list[InputStream] = []
    begin = InputStream.__init__

    def begun(stream: InputStream, *args: Any, **options: Any) -> None:
        begin(stream, *args, **options)
        made.append(stream)

    monkeypatch.setattr(InputStream, "__init__", begun)
    yield
    wait_for_balance(lambda: tuple(stream.count() for stream in made))
