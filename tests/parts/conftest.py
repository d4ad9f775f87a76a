"""For tests of parts: what tests of several modules begin with."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.hand_relay import Relay


@pytest.fixture
def relay() -> Iterator[Relay]:
    made = Relay()
    try:
        yield made
    finally:
        made.session.close()
