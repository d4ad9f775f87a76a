"""Keeps a relay's counters where the next one finds them, however this one ends.

Knows: one file in the runtime folder, written with every count that differs. Does not know: streams, why a relay ends.

A relay that is killed has no last word: what it had in hand by its books, its successor counts as at most lost. The
books go with the last relay of a service that stops, and with the machine's memory: then all counters begin with 0
(docs/decisions/0109).
"""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path

from zsched.core.events import StreamsCounted
from zsched.core.hop.books import added, closed
from zsched.core.values.model import TaskId
from zsched.core.values.plan import StreamCount
from zsched.core.values.struct import replace
from zsched.errors import WireError
from zsched.ipc.takeover import fresh_file
from zsched.wire import codec as wire

_log = logging.getLogger("zsched.relay")


class Books:
    """One relay's books, which begin with those of the relay before."""

    def __init__(self, path: Path | None) -> None:
        """``path``: of the books, in the runtime folder; ``None``: they end with this process."""
        self._path = path
        self._lock = threading.Lock()
        self._written: tuple[StreamCount, ...] | None = None
        self._has_failed = self._is_closed = False
        self._past = {} if path is None else {count.stream: closed(count) for count in _read(path)}

    def added(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """Our counters with those of the relays before."""
        return added(counts, self._past)

    def write(self, counts: tuple[StreamCount, ...], *, is_last: bool = False) -> None:
        """Put down what we have counted, with what else must outlive us."""
        with self._lock:
            if self._path is not None and not self._is_closed:
                self._write(self._path, counts)
            self._is_closed |= is_last

    def _write(self, path: Path, counts: tuple[StreamCount, ...]) -> None:
        told = {count.stream: count for count in self.added(counts)}
        kept = tuple(_still(count) for _, count in sorted({**self._past, **told}.items()))
        if kept == self._written:
            return
        try:
            _replace(path, b"\n" + wire.encode(StreamsCounted(counts=kept)))  # earlier versions have a line before it
            self._written = kept
        except (OSError, WireError) as error:
            if not self._has_failed:
                _log.warning("%s cannot be written (%s): a kill loses what was counted since", path, error)
            self._has_failed = True

    def forget(self, task: TaskId) -> None:
        """The task has left the fleet."""
        for stream in [stream for stream in self._past if stream.startswith(f"{task}/")]:
            del self._past[stream]

    def keep(self, tasks: frozenset[TaskId]) -> None:
        """Forget what was counted of other tasks than these."""
        for task in {stream.partition("/")[0] for stream in self._past} - tasks:
            self.forget(task)


def _still(count: StreamCount) -> StreamCount:
    """Without what is a time."""
    return replace(count, last_seen_s=None, answer_s=None, gap_s=None, move_gap_s=None, move_epoch=0)


def _replace(path: Path, content: bytes) -> None:
    """Whole or not at all, whenever we are killed."""
    fresh = fresh_file(path)
    descriptor = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        left = memoryview(content)
        while left:  # a full disk takes a part, and says so at the next one
            left = left[os.write(descriptor, left) :]
    finally:
        os.close(descriptor)
    fresh.rename(path)


def _read(path: Path) -> tuple[StreamCount, ...]:
    try:
        return wire.decode(path.read_bytes().partition(b"\n")[2], StreamsCounted).counts
    except FileNotFoundError:
        return ()
    except (OSError, WireError) as error:
        _log.warning("%s is not to be understood (%s): counters begin with 0", path, error)
        return ()
