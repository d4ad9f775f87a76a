"""What integration tests share as fixtures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def folder() -> Iterator[Path]:
    """With a short name: of a fleet in each of two folders of ``tmp_path`` a socket's path can be too long (107)."""
    with tempfile.TemporaryDirectory(prefix="cells-") as name:
        yield Path(name)
