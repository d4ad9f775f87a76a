"""A terminal of 80 columns, for tests of what verbs print there."""

from __future__ import annotations

import pytest


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> int:
    """People look, in so many columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("zsched.screen.is_screen", lambda _stream: True)
    return 80
