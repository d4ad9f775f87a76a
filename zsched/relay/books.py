"""Keeps a relay's counters where the next one finds them, however this one ends.

Knows: two files in the runtime folder. The books are written with every count that differs. Beside them stands how many
samples each input has taken: a mapped page, which the kernel keeps when a process is killed. Does not know: streams,
why a relay ends.

A relay that is killed has no last word. What it had in hand by its books, and what it has taken since they were
written, its successor counts as at most lost. Both files go with the last relay of a service that stops, and with the
machine's memory: then all counters begin with 0 (docs/decisions/0109-the-books-outlive-a-relay.md).
"""

from __future__ import annotations

import json
import logging
import mmap
import os
import threading
from pathlib import Path
from typing import Any, Final

from zsched.core.events import StreamsCounted
from zsched.core.hop.books import added, closed
from zsched.core.values.model import TaskId
from zsched.core.values.plan import StreamCount
from zsched.core.values.struct import Struct, field, replace
from zsched.errors import WireError
from zsched.ipc.takeover import fresh_file, taken_file
from zsched.wire import codec as wire

NAME_BYTES: Final = 120
RECORD: Final = NAME_BYTES + 8
MAX_CELLS: Final = 511
"""Inputs that have a cell; of more that are open at one time, a kill loses what came since the last count unseen."""
SIZE: Final = (MAX_CELLS + 1) * RECORD

_log = logging.getLogger("zsched.relay")

Cell = memoryview
"""One number, which outlives the process: how many samples an input has taken."""


class _Found(Struct, frozen=True):
    """What a relay has left."""

    life: str = ""
    counts: tuple[StreamCount, ...] = ()
    taken: dict[str, int] = field(default_factory=dict)
    """{input: how many samples of its own count these counters have}."""


class Books:
    """One relay's books, which begin with those of the relay before."""

    def __init__(self, path: Path | None) -> None:
        """``path``: of the books, in the runtime folder; ``None``: they end with this process."""
        self._path = path
        self._lock = threading.Lock()
        self._life = os.urandom(8).hex()
        self._past: dict[str, StreamCount] = {}
        self._written: tuple[StreamCount, ...] | None = None
        self._cells: dict[str, tuple[int, Cell]] = {}
        """{input: (where its record begins, its cell)}."""
        self._free: dict[str, None] = {}
        """Inputs that are closed, the oldest first: their cells go to others when there is no other one left."""
        self._table: memoryview | None = None
        self._has_failed = self._is_closed = False
        if path is not None:
            self._inherit(path)
            self.write((), ())  # before the cells: cells of another life than the books' say nothing
            self._table = self._made(taken_file(path))

    def cell(self, stream: str) -> Cell | None:
        """Where an input counts what it takes; a stream that comes again goes on in its own."""
        name = stream.encode()
        with self._lock:
            self._free.pop(stream, None)
            if stream in self._cells:
                return self._cells[stream][1]
            is_full = len(self._cells) >= MAX_CELLS
            if self._table is None or (is_full and not self._free) or len(name) > NAME_BYTES:
                return None
            at = self._given_back() if is_full else (1 + len(self._cells)) * RECORD
            made = self._table[at + NAME_BYTES : at + RECORD].cast("Q")
            self._cells[stream] = at, made
            self._table[at : at + NAME_BYTES] = name.ljust(NAME_BYTES, b"\0")
            return made

    def _given_back(self) -> int:
        """Where the record begins of an input that is closed; it counts nothing any more."""
        oldest = next(iter(self._free))
        del self._free[oldest]
        at, cell = self._cells.pop(oldest)
        cell[0] = 0
        return at

    def leave(self, stream: str) -> None:
        """An input is closed, and what it has taken stands in the books: its cell is another one's if need be."""
        with self._lock:
            if stream in self._cells:
                self._free.pop(stream, None)
                self._free[stream] = None

    def added(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """Our counters with those of the relays before."""
        return added(counts, self._past)

    def write(self, own: tuple[StreamCount, ...], counts: tuple[StreamCount, ...], *, is_last: bool = False) -> None:
        """Put down what we have counted: ``own`` by our streams, ``counts`` with what else must outlive us."""
        with self._lock:
            if self._path is not None and not self._is_closed:
                self._write(self._path, own, counts)
            self._is_closed |= is_last

    def _write(self, path: Path, own: tuple[StreamCount, ...], counts: tuple[StreamCount, ...]) -> None:
        told = {count.stream: count for count in self.added(counts)}
        kept = tuple(_still(count) for _, count in sorted({**self._past, **told}.items()))
        if kept == self._written:
            return
        taken = {count.stream: count.messages for count in own if count.in_flight is not None}
        try:
            head = json.dumps({"life": self._life, "taken": taken}).encode()
            _replace(path, head + b"\n" + wire.encode(StreamsCounted(counts=kept)))
            self._written = kept
        except (OSError, WireError) as error:
            if not self._has_failed:
                _log.warning("%s cannot be written (%s): what a kill loses will be counted too high", path, error)
            self._has_failed = True

    def forget(self, task: TaskId) -> None:
        """The task has left the fleet."""
        for stream in [stream for stream in self._past if stream.startswith(f"{task}/")]:
            del self._past[stream]

    def keep(self, tasks: frozenset[TaskId]) -> None:
        """Forget what was counted of other tasks than these."""
        for task in {stream.partition("/")[0] for stream in self._past} - tasks:
            self.forget(task)

    # --- the relay before --------------------------------------------------------------------------------------------

    def _inherit(self, path: Path) -> None:
        found = _read(path)
        if found is None:
            return
        life, now = _read_cells(taken_file(path))
        untold = {
            stream: max(0, number - found.taken.get(stream, 0))
            for stream, number in now.items()
            if life == found.life  # else no cells had been made yet
        }
        counts = {count.stream: count for count in found.counts}
        for stream, number in untold.items():
            if number and stream not in counts:  # it is younger than the books
                counts[stream] = StreamCount(stream=stream, in_flight=0)
        self._past = {stream: closed(count, untold.get(stream, 0)) for stream, count in counts.items()}
        in_hand = sum(self._past[stream].at_most_lost - count.at_most_lost for stream, count in counts.items())
        if in_hand:
            _log.warning("the relay before this one had up to %d samples in hand: they are at most lost", in_hand)

    def _made(self, path: Path) -> memoryview | None:
        """A new table of cells in the place of the one before."""
        fresh = fresh_file(path)
        try:
            descriptor = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, SIZE)  # a page that is not there would kill us when it is written
                table = memoryview(mmap.mmap(descriptor, SIZE))
            finally:
                os.close(descriptor)
            life = self._life.encode()
            table[: len(life)] = life
            fresh.rename(path)
        except OSError as error:
            _log.warning("%s cannot be made (%s): samples of a last second are not counted after a kill", path, error)
            return None
        return table


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


def _read(path: Path) -> _Found | None:
    try:
        head, _, frame = path.read_bytes().partition(b"\n")
        said: dict[str, Any] = json.loads(head)
        taken = {str(stream): int(number) for stream, number in said["taken"].items()}
        return _Found(str(said["life"]), wire.decode(frame, StreamsCounted).counts, taken)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, WireError) as error:
        _log.warning("%s is not to be understood (%s): counters begin with 0", path, error)
        return None


def _read_cells(path: Path) -> tuple[str, dict[str, int]]:
    """(whose they are, {input: how many samples it has taken})."""
    try:
        content = path.read_bytes()
    except OSError:
        return "", {}
    records = [content[at : at + RECORD] for at in range(0, len(content) - RECORD + 1, RECORD)]
    cells = {}
    for record in records[1:]:
        name = record[:NAME_BYTES].rstrip(b"\0").decode(errors="replace")
        if not name:
            break
        cells[name] = memoryview(record[NAME_BYTES:]).cast("Q")[0]
    return (records[0].rstrip(b"\0").decode(errors="replace") if records else ""), cells
