"""A machine on which no thread is to be had for a moment (a limit of its own, or of its user)."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def no_threads(count: int = 1_000_000) -> Iterator[None]:
    """None of the next ``count`` threads starts."""
    start, left = threading.Thread.start, [count]

    def refuse(self: threading.Thread) -> None:
        left[0] -= 1
        if left[0] < 0:
            start(self)
            return
        raise RuntimeError("can't start new thread")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        yield
