"""Lets one application of this node have streams itself: tells it the plans, takes its word of slots and its counters.

Knows: a unix socket in the runtime folder, one connection at a time, its threads. Does not know: what of a plan is the
application's, what its words are worth (`zsched.core.route.shares`), how streams are carried (`zsched.stream`).

Who may write the socket's file may speak: the same users as may ask the operator socket beside it. The application
lives on when this relay ends, and comes to the next one; it ends by itself what nobody tells it of for a while.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from zsched.clock import monotonic_s
from zsched.core.events import ProblemReported, SlotDrained, StreamsCounted
from zsched.core.relay_protocol import RelayReport, TaskEnded
from zsched.core.route.shares import Shares, Told
from zsched.core.values.model import MAX_REASON, NodeId, TaskId
from zsched.core.values.plan import Route, RoutePlan, StreamCount
from zsched.core.values.struct import replace
from zsched.errors import WireError
from zsched.guard import guarded
from zsched.ipc.pipe import OF_APPLICATIONS, read_frame, write_frame
from zsched.ipc.protocol import DaemonGone, RelayRefused, StreamKeys, StreamsHere, StreamsTaken
from zsched.ipc.takeover import set_timeout
from zsched.sessions.config import application_config
from zsched.wire import codec as wire

HELLO_S: Final = 1.0
"""An application says its keys within this time."""
MAX_WAITING: Final = 1024
"""Frames that wait for an application; one that does not read is not told any more, and may come again."""
END_S: Final = 2.0
"""A writer whose connection has ended ends within this time."""
BACKLOG: Final = 4
RETRY_S: Final = 0.2
SOURCE: Final = "relay/application"

_log = logging.getLogger("zsched.relay")

_Frame = Told | TaskEnded | StreamsTaken | DaemonGone


class _Link:
    """The connection to the application, and the thread that writes to it."""

    def __init__(self, connection: socket.socket, pid: int) -> None:
        self.connection, self.pid = connection, pid
        self._queue: queue.Queue[bytes | None] = queue.Queue(MAX_WAITING)
        self._writer = guarded(self._write, name="to application", is_lasting=False)

    def start(self) -> None:
        self._writer.start()

    def tell(self, frame: bytes) -> None:
        """Queue a frame; one that does not read loses its connection."""
        try:
            self._queue.put_nowait(frame)
        except queue.Full:
            self.hang_up()

    def hang_up(self) -> None:
        """End the connection for both sides."""
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the writer, and wait for it: the descriptor may be another file's as soon as it is given back."""
        self.hang_up()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        if self._writer.is_alive():
            self._writer.join(END_S)

    def _write(self) -> None:
        while (frame := self._queue.get()) is not None:
            try:
                write_frame(self.connection.fileno(), frame)
            except (OSError, ValueError):
                self.hang_up()
                return


class Application:
    """The place of one application. Every method may be called from any thread, and none waits for it."""

    def __init__(
        self, fleet: str, node: NodeId, path: Path | None, listen: str, report: Callable[[RelayReport], None]
    ) -> None:
        """``path`` is the socket's (``None``: no application may have streams itself); ``listen`` where it listens.

        `open` begins; until then plans are only noted.
        """
        self._here = StreamsHere(fleet=fleet, node=node)
        self._path, self._listen = path, listen
        self._report = report
        self.counts: Callable[[], tuple[StreamCount, ...]] = tuple
        """What the relay's own streams have counted by now."""
        self._lock = threading.Lock()
        self._shares = Shares()
        self._link: _Link | None = None
        self._times: dict[str, StreamCount] = {}
        """By stream, what was read between two counts: its times are told with the next one."""
        self._session = ""
        self._is_orphaned = False

    def open(self, data_session: str) -> None:
        """Let an application in, whose session is made of ours (its configuration); a problem is reported.

        Nothing where no application may have streams itself.
        """
        if self._path is None:
            return
        is_first = not self._session
        self._session = application_config(data_session, self._listen)
        if not is_first:
            with self._lock:
                if self._link is not None:
                    self._link.hang_up()  # it comes again, for another session
            return
        try:
            listener = _listening(self._path)
        except OSError as error:
            problem = f"no application can have its streams itself: {self._path}: {error.strerror or error}"
            self._report(ProblemReported(source=SOURCE, problem=problem[:MAX_REASON]))
            return
        guarded(self._accept, listener, name="applications").start()

    # --- what the relay knows ----------------------------------------------------------------------------------------

    def plan(self, plan: RoutePlan) -> None:
        """The newest plan of a task."""
        with self._lock:
            self._is_orphaned = False
            self._tell(self._shares.note_plan(plan))

    def unowned(self, task: TaskId, routes: tuple[Route, ...]) -> None:
        """The inputs of a task before it has an owner."""
        with self._lock:
            self._tell(self._shares.note_unowned(task, routes))

    def end(self, task: TaskId) -> None:
        """The task has left the fleet."""
        with self._lock:
            if self._shares.end(task):
                self._put(TaskEnded(task=task))

    def lose_daemon(self) -> None:
        """Nobody tells us of another owner until the next plan."""
        with self._lock:
            self._is_orphaned = True
            self._put(DaemonGone())

    def report(self, word: RelayReport) -> None:
        """Hand on what our own streams say; that a slot has drained, when the application has drained it, too."""
        if isinstance(word, SlotDrained):
            with self._lock:
                drained = self._shares.relay_drained(word)
            if drained is None:
                return
        self._report(word)

    def apart(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """Our own counters, without answers that an application has had itself; `settled` and `added` take these."""
        with self._lock:
            timed = tuple(_with_times(count, self._times.get(count.stream)) for count in counts)
            self._times = {}
            return self._shares.apart(timed)

    def settled(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """Our own counters with those of applications that have gone."""
        with self._lock:
            return self._shares.settled(counts)

    def added(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """Our own counters with the application's."""
        with self._lock:
            return self._shares.added(counts, monotonic_s())

    def _tell(self, told: tuple[Told, ...]) -> None:
        for one in told:
            self._put(one)
        if self._link is not None:
            self._put(StreamsTaken(keys=self._shares.taken()))

    def _put(self, frame: _Frame) -> None:
        if self._link is None:
            return
        try:
            self._link.tell(wire.encode(frame))
        except WireError as error:
            _log.error("the application is not told of a plan: %s", error)

    # --- the connection ----------------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        pause = threading.Event()
        while True:
            try:
                connection, _ = listener.accept()
                guarded(self._serve, connection, name="application", is_lasting=False).start()
            except (OSError, RuntimeError):  # no descriptors, no thread
                pause.wait(RETRY_S)

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            set_timeout(connection, HELLO_S)
            try:
                frame = read_frame(connection.fileno())
                first = None if frame is None else wire.decode(frame, StreamKeys)
                link = None if first is None else self._let_in(connection, first)
                if link is None:
                    return
            except (OSError, RuntimeError, WireError) as error:  # RuntimeError: no thread
                _log.warning("an application was not let in: %s", error)
                return
            try:
                self._listen_to(connection)
            except (OSError, WireError) as error:
                _log.warning("the application (pid %d) is heard no more: %s", link.pid, error)
            finally:
                self._let_go(link)

    def _let_in(self, connection: socket.socket, first: StreamKeys) -> _Link | None:
        self._look()
        with self._lock:
            other = self._link
            if other is not None:
                reason = f"the process {other.pid} has streams of {self._here.node} itself; one may at a time"
                write_frame(connection.fileno(), wire.encode(RelayRefused(reason=reason)))
                return None
            link = _Link(connection, first.pid)
            link.tell(wire.encode(self._here))
            link.tell(self._session.encode())
            self._link = link
            self._tell(self._shares.name(first.keys))
            if self._is_orphaned:
                self._put(DaemonGone())
        try:
            set_timeout(connection, 0.0)
            link.start()
        except (OSError, RuntimeError):
            self._let_go(link)
            raise
        _log.info("an application (pid %d) has streams itself", first.pid)
        return link

    def _listen_to(self, connection: socket.socket) -> None:
        while (frame := read_frame(connection.fileno())) is not None:
            word = wire.decode(frame, *OF_APPLICATIONS)
            if isinstance(word, ProblemReported):
                self._report(ProblemReported(source=SOURCE, problem=word.problem))
                continue
            if isinstance(word, StreamKeys):
                self._look()
            with self._lock:
                if isinstance(word, StreamKeys):
                    self._tell(self._shares.name(word.keys))
                    continue
                if isinstance(word, StreamsCounted):
                    self._shares.note_counts(word.counts, monotonic_s())
                    continue
                heard = self._shares.heard(word)
            for one in heard:
                self._report(one)

    def _look(self) -> None:
        """Know the relay's own counters of this moment, at which an application begins or ends to count some itself."""
        counts = self.counts()  # not below our lock: streams have locks of their own
        with self._lock:
            self._shares.apart(counts)
            self._times = {count.stream: _with_times(count, self._times.get(count.stream)) for count in counts}

    def _let_go(self, link: _Link) -> None:
        self._look()
        with self._lock:
            heard = self._shares.go(monotonic_s())
            self._link = None
        link.close()
        for one in heard:
            self._report(one)
        self._report(ProblemReported(source=SOURCE, problem=None))
        _log.info("the application (pid %d) has gone", link.pid)


def _with_times(count: StreamCount, before: StreamCount | None) -> StreamCount:
    """``count``, which was read behind ``before``, with the times of both: those that are read begin anew."""
    if before is None:
        return count
    gaps = [one.gap_s for one in (before, count) if one.gap_s is not None]
    newest = before if count.answer_s is None else count
    return replace(count, gap_s=max(gaps, default=None), answer_s=newest.answer_s, paired_hz=newest.paired_hz)


def _listening(path: Path) -> socket.socket:
    """A listener in the place of whoever listened there: one relay runs at a time."""
    fresh = path.with_name(f"{path.name}.next")
    fresh.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(str(fresh))
        fresh.chmod(0o660)
        listener.listen(BACKLOG)
        fresh.rename(path)
    except OSError:
        listener.close()
        raise
    return listener
