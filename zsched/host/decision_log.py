"""The decision log: one line of JSON for every story of the daemon, in two files of the state folder.

A line tells what happened, when by this machine's wall clock, and in which life of the daemon. A judgement that has
changed carries all of its figures, so that `zsched explain --replay` can make it again. At rest nothing is written.

The loop only puts stories into a bounded queue; a thread makes the lines and appends them. A file that is full becomes
the older one, so both together never hold more than twice `FILE_BYTES`. A disk that refuses costs lines, which are
counted and told; the daemon goes on. Lines are not synced: a power cut may cost the last ones.

Knows: files, lines, the fields of a line. Does not know: what a story means.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.decision import Decision, HistoryLine, Move
from zsched.core.values.errors import WireError
from zsched.core.values.instructions import RecordStory
from zsched.core.values.messages import HistoryTold
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.host.clock import wall_s
from zsched.host.guard import guarded
from zsched.host.state_file import hand_over

SCHEMA = "zsched.event/1"
NAME, OLD_NAME = "decisions.ndjson", "decisions.1.ndjson"
NAMES = OLD_NAME, NAME
FILE_BYTES = 2 * 1024 * 1024
MAX_DIGITS = 15
"""No file is longer than such a number of bytes; a cursor's offset of more digits is none."""
PAGE_BYTES = 512 * 1024
"""One answer tells of at most this much of a file, so that a question keeps a daemon busy for milliseconds only."""
TOLD_BYTES = 64 * 1024
"""A node's history goes to another machine in pieces of about this much of a log, of which a frame takes two."""
ASKED_LIMIT = 4
"""Questions of other machines that may wait for the log's thread."""
QUEUE_LIMIT = 1000
RESERVE_BYTES = 8 * 1024 * 1024
"""The last bytes of a disk are the state's, of which a save needs a second one."""
CLOSE_S = 0.5
RETRY_S = 5.0
"""A disk that refuses lines is asked again after this time, also where there is no new one."""
_BODY = b',"decision":'
"""Where a judgement's figures begin; in a string its quotes would be escaped."""

_HEAD = b'{"schema":"zsched.event/'
"""How every line begins."""

Json = dict[str, Any]


class Entry(Struct, frozen=True, kw_only=True):
    """One line."""

    schema: str
    at: float
    """Seconds since the Unix epoch, by the wall clock of ``node``."""
    node: NodeId
    life: int
    """The daemon's incarnation."""
    stage: str
    text: str
    task: str = ""
    epoch: int = 0
    move: Move | None = None
    took_s: float | None = None
    gap_s: float | None = None
    rehearsal: str = ""
    is_rollout: bool = False
    by: str = ""
    decision: Decision | None = None
    """Last, for readers that do without it."""


class _Question(Struct, frozen=True, kw_only=True):
    """Another machine asks for the history."""

    cursor: str
    answer: Callable[[HistoryTold | None], None]


class DecisionLog:
    """This daemon's log; `put` and `ask` are the loop's, all else other threads'."""

    def __init__(
        self,
        folder: Path,
        node: NodeId,
        life: int,
        on_problem: Callable[[str | None], None],
        file_bytes: int = FILE_BYTES,
    ) -> None:
        """``on_problem`` is told why lines are lost, and with ``None`` that none are any more."""
        self._folder, self._node, self._life = folder, node, life
        self._on_problem, self._file_bytes = on_problem, file_bytes
        self._queue: queue.SimpleQueue[tuple[float, RecordStory] | _Question | None] = queue.SimpleQueue()
        self._askers = threading.BoundedSemaphore(ASKED_LIMIT)
        self._lost = self._crowded_out = 0
        self._is_failing = False
        self._is_whole = False
        """Whether the file is known to end with a whole line; a life begins without knowing."""
        self._thread = guarded(self._run, name="zsched-decision-log")

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def put(self, story: RecordStory) -> None:
        """Take a story; never waits. What the queue has no room for is counted."""
        if self._queue.qsize() >= QUEUE_LIMIT:
            self._crowded_out += 1
        else:
            self._queue.put((wall_s(), story))

    def ask(self, cursor: str, answer: Callable[[HistoryTold | None], None]) -> bool:
        """Have a page of the history told to ``answer`` by the log's thread; false: too many wait for that already.

        ``answer`` gets ``None`` where the log cannot be read.
        """
        if not self._askers.acquire(blocking=False):
            return False
        self._queue.put(_Question(cursor=cursor, answer=answer))
        return True

    def close(self) -> None:
        """Write what has been put, for at most `CLOSE_S`."""
        self._queue.put(None)
        if self._thread.is_alive():
            self._thread.join(CLOSE_S)

    # --- writing (its thread) ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (item := self._next()) is not None:
            if isinstance(item, _Question):
                self._tell(item)
                continue
            at, story = item
            crowded_out, self._crowded_out = self._crowded_out, 0
            self._lost += crowded_out
            self._write(at, story)

    def _next(self) -> tuple[float, RecordStory] | _Question | None:
        """The next item; a disk that refuses is asked again meanwhile, for at rest no line comes for hours."""
        while self._is_failing:
            try:
                return self._queue.get(timeout=RETRY_S)
            except queue.Empty:
                self._write(wall_s(), None)
        return self._queue.get()

    def _tell(self, question: _Question) -> None:
        try:
            told = self.history(question.cursor)
        except OSError:
            told = None
        self._askers.release()
        question.answer(told)

    def _write(self, at: float, story: RecordStory | None) -> None:
        """Write what is owed, and a story if there is one."""
        try:
            if self._lost:
                text = f"{self._lost} lines of this log are lost: the disk refused them, or they came too fast"
                self._append(self._line(at, RecordStory(stage="log", text=text)))
                self._lost = 0
            if story is not None:
                self._append(self._line(at, story))
        except OSError as error:
            self._lost += story is not None
            if not self._is_failing:
                path = self._folder / NAME
                self._on_problem(f"the decision log {path} is not written: {error.strerror}; see `df {self._folder}`")
            self._is_failing = True
        else:
            if self._is_failing:
                self._on_problem(None)
            self._is_failing = False

    def append(self, story: RecordStory) -> None:
        """Write a story at once, of a log that was not started.

        Raises:
            OSError: the disk refused.
        """
        self._append(self._line(wall_s(), story))

    def _line(self, at: float, story: RecordStory) -> bytes:
        entry = Entry(
            schema=SCHEMA,
            at=at,
            node=self._node,
            life=self._life,
            stage=story.stage,
            text=story.text,
            task=story.task,
            epoch=story.epoch,
            move=story.move,
            took_s=story.took_s,
            gap_s=story.gap_s,
            rehearsal=story.rehearsal,
            is_rollout=story.is_rollout,
            by=story.by,
            decision=story.decision,
        )
        return json.dumps(as_plain(entry), separators=(",", ":")).encode() + b"\n"

    def _append(self, line: bytes) -> None:
        """Append a line whole or not at all; in a full file's place begins a new one.

        What a power cut has torn stays a line of its own.
        """
        disk = os.statvfs(self._folder)
        if disk.f_bavail * disk.f_frsize < RESERVE_BYTES:
            raise OSError(errno.ENOSPC, "the disk is full, and its last bytes are the state's")
        path = self._folder / NAME
        if path.exists() and path.stat().st_size + len(line) > self._file_bytes:
            path.replace(self._folder / OLD_NAME)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW
        with os.fdopen(os.open(path, flags, 0o640), "wb", buffering=0) as file:
            before = os.fstat(file.fileno()).st_size
            if not before:
                hand_over(file.fileno(), self._folder)
            if before and not self._is_whole:
                with path.open("rb") as there:
                    there.seek(-1, os.SEEK_END)
                    line = line if there.read(1) == b"\n" else b"\n" + line
            try:
                written = 0
                while written < len(line):
                    written += file.write(line[written:])
            except OSError:
                os.ftruncate(file.fileno(), before)
                raise
            self._is_whole = True

    # --- reading (an operator's thread) ------------------------------------------------------------------------------

    def answer(self, request: Json) -> Json:
        """A page of the log: ``cursor`` is where the page before ended, ``moves`` leaves out all but moves.

        With ``judgement`` (a ``task``, and an ``epoch`` or ``until``) no entries but the page's newest judgement before
        that, whole, and the move to that epoch.
        """
        cursor, is_moves, wish = request.get("cursor"), bool(request.get("moves")), request.get("judgement")
        lines, cursor, has_more = read_page(self._folder, cursor if isinstance(cursor, str) else "")
        if isinstance(wish, dict):
            found = judged_before(lines, wish)
            return {"node": self._node, "now": wall_s(), **found, "cursor": cursor, "more": has_more}
        wanted = [line for line in map(without_figures, lines) if not is_moves or _is_of_move(line)]
        entries = [entry for line in wanted if (entry := _parsed(line)) is not None]
        return {"node": self._node, "now": wall_s(), "entries": entries, "cursor": cursor, "more": has_more}

    def history(self, cursor: str) -> HistoryTold:
        """What the log tells of moves behind ``cursor``, as much as one frame takes.

        Raises:
            OSError: it cannot be read.
        """
        told: list[HistoryLine] = []
        taken = looked = 0
        has_more = True
        while has_more and taken < TOLD_BYTES and looked < PAGE_BYTES:
            lines, cursor, has_more = read_page(self._folder, cursor, TOLD_BYTES)
            for line in map(without_figures, lines):
                if _is_of_move(line) and (one := _history_line(line)) is not None:
                    taken += len(line)
                    told.append(one)
            looked += TOLD_BYTES
        return HistoryTold(node=self._node, now=wall_s(), lines=tuple(told), cursor=cursor, has_more=has_more)


def note(folder: Path, node: NodeId, life: int, story: RecordStory) -> None:
    """Append one line while no daemon runs in that folder; a full file is left for the daemon to set aside.

    Raises:
        OSError: the disk refused.
    """
    log = DecisionLog(folder, node, life, on_problem=lambda _: None, file_bytes=sys.maxsize)
    log.append(story)


def _history_line(line: bytes) -> HistoryLine | None:
    """A line as it travels; ``None`` for one that is torn, or that this version does not read."""
    try:
        return from_plain(_parsed(line), HistoryLine)
    except WireError:
        return None


def is_torn(line: bytes) -> bool:
    """Whether this is only the beginning of a line, as a power cut leaves it.

    >>> is_torn(b'{"schema":"zsched.event/1","at":17'), is_torn(b'{"sche'), is_torn(b'{"schema":"zsched.event/1"}')
    (True, True, False)
    >>> is_torn(b"something else")
    False
    """
    text = line.rstrip(b"\0")  # some file systems fill up what they have not written
    if not (text.startswith(_HEAD) or _HEAD.startswith(text)):
        return False
    try:
        json.loads(text)
    except ValueError:
        return True
    return False


def _parsed(line: bytes) -> Json | None:
    """The line's object; ``None`` for one that a power cut has torn."""
    try:
        entry = json.loads(line)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) and isinstance(entry.get("at"), int | float) else None


def _is_of_move(line: bytes) -> bool:
    marks = (b',"move":', b',"took_s":', b',"gap_s":', b',"rehearsal":', b',"is_rollout":', b',"by":')
    return any(mark in line for mark in marks)


def judged_before(lines: list[bytes], wish: Json) -> Json:
    """The newest judgement of ``wish["task"]`` in these lines that came before a point, and the move there.

    The point is ``wish["epoch"]``, which a move began, or the wall time ``wish["until"]``. Either may be ``None``.
    """
    task, epoch, until = wish.get("task"), wish.get("epoch"), wish.get("until")
    judgement, move, epochs = None, None, set()
    for line in lines:
        entry = _parsed(without_figures(line))
        if entry is None or entry.get("task") != task:
            continue
        begun = entry["move"].get("epoch") if isinstance(entry.get("move"), dict) else None
        if begun is not None:
            epochs.add(begun)
        is_early = entry["at"] <= until if isinstance(until, int | float) else True
        if isinstance(epoch, int):
            is_early = is_early and entry.get("epoch", 0) < epoch
            move = entry if begun == epoch and (move is None or not entry["move"].get("is_known")) else move
        if is_early and _BODY in line:
            judgement = line
    known = [min(epochs), max(epochs)] if epochs else []
    return {"judgement": None if judgement is None else _parsed(judgement), "move": move, "epochs": known}


def without_figures(line: bytes) -> bytes:
    """A line without a judgement's figures.

    >>> without_figures(b'{"text":"stay","decision":{"figures":{}}}')
    b'{"text":"stay"}'
    """
    head, mark, _ = line.partition(_BODY)
    return head + b"}" if mark else line


def read_page(folder: Path, cursor: str, most_bytes: int = PAGE_BYTES) -> tuple[list[bytes], str, bool]:
    """(whole lines, where they end, whether there are more) from ``cursor`` on; ``""``: from the oldest line on.

    A cursor whose file is gone, or shorter by now, goes on with the oldest line that is left. A log that is not there
    is empty.

    Raises:
        OSError: a file cannot be read.
    """
    mark, _, offset_text = cursor.partition(":")
    with contextlib.ExitStack() as stack:
        found = {str(os.fstat(file.fileno()).st_ino): file for file in _opened(folder, stack)}
        marks = list(found)
        is_place = mark in marks and offset_text.isdecimal() and len(offset_text) <= MAX_DIGITS
        offset = int(offset_text) if is_place else 0
        if offset > (os.fstat(found[mark].fileno()).st_size if mark in marks else 0):
            mark, offset = "", 0  # another file has its number by now, or somebody has emptied it
        first = marks.index(mark) if mark in marks else 0
        for here in marks[first:]:
            found[here].seek(offset)
            data = found[here].read(most_bytes)
            if len(data) == most_bytes and b"\n" not in data:
                data += found[here].readline()
            whole = data[: data.rfind(b"\n") + 1]
            at, offset = offset + len(whole), 0
            if whole:
                is_last = here == marks[-1] and len(data) < most_bytes
                return whole.splitlines(), f"{here}:{at}", not is_last
            cursor = f"{here}:{at}"
    return [], cursor, False


def _opened(folder: Path, stack: contextlib.ExitStack) -> list[BinaryIO]:
    """The log's files that are there, the older one first.

    The newer one is opened first: set aside meanwhile, it is found by both names, and none is left out.
    """
    found: list[BinaryIO] = []
    for name in reversed(NAMES):
        with contextlib.suppress(FileNotFoundError):
            found.insert(0, stack.enter_context((folder / name).open("rb")))
    return found
