"""What tests of verbs share: a folder with no word from the environment, and a daemon that answers there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from support.recorded_daemon import Daemon


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty runtime folder that the verbs look into, and no other word from the environment."""
    for name in ("ZSCHED_NODE", "ZSCHED_CONFIG", "ZSCHED_STATE_DIR", "STATE_DIRECTORY", "RUNTIME_DIRECTORY", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    runtime = tmp_path / "run"
    runtime.mkdir()
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(runtime))
    return runtime


@pytest.fixture
def daemon(folder: Path) -> Iterator[Daemon]:
    with Daemon(folder) as running:
        yield running
