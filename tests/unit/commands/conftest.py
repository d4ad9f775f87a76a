"""A terminal of 80 columns, for tests of what verbs print there; and words as a shell gives them to the program."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from typer.testing import CliRunner, Result


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> int:
    """People look, in so many columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("zsched.host.screen.is_screen", lambda _stream: True)
    return 80


@pytest.fixture(autouse=True)
def given_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """The words of a runner are the program's: it says them again where the command must be given once more."""
    invoke = CliRunner.invoke

    def run(runner: CliRunner, program: Any, args: Any = None, **more: Any) -> Result:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", ["zsched", *(args or ())])
            return invoke(runner, program, args, **more)

    monkeypatch.setattr(CliRunner, "invoke", run)
