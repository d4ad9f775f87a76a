"""The relay process: its session, its threads, its pipe to the daemon.

Knows: how commands become tasks' plans and roles, how reports leave, how to end within a second. Does not know: how a
stream is carried.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import signal
import threading
from typing import Final

import zenoh

from zsched import wire
from zsched.clock import monotonic_s
from zsched.core.events import ProblemReported, RoleEnded, StreamsCounted
from zsched.core.model import NodeId, TaskId
from zsched.core.plan import Role, RoutePlan
from zsched.core.relay_protocol import RelayReport, RelayStarted, RelayStop, WorkerSeen
from zsched.errors import WireError
from zsched.keyspace import Keyspace
from zsched.relay.acks import Acks
from zsched.relay.graph import GraphMirror
from zsched.relay.local_side import LocalSide
from zsched.relay.roles import RoleServer
from zsched.relay.task import TaskRelay
from zsched.relay.tokens import Tokens
from zsched.relay_pipe import COMMANDS, read_frame, write_frame

COUNT_S: Final = 1.0
"""Period of the counters, which are also this process's sign of life."""
CLOSE_S: Final = 0.6
"""Closing a session towards a stopped peer can take seconds: so long we wait, then the process ends anyway."""
ALARM_S: Final = 0.9
"""...and should zenoh hold Python's global lock meanwhile, the kernel ends it."""
MAX_REPORTS: Final = 4096

_log = logging.getLogger("zsched.relay")


class Reporter:
    """Writes reports to the daemon from a thread of its own; when the daemon stalls, counters are the first to go."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._queue: queue.Queue[RelayReport | None] = queue.Queue(MAX_REPORTS)
        self._thread = threading.Thread(target=self._run, name="reports", daemon=True)
        self._thread.start()

    def report(self, value: RelayReport) -> None:
        """Send a report; never blocks."""
        if isinstance(value, StreamsCounted) and self._queue.qsize() > MAX_REPORTS // 2:
            return
        try:
            self._queue.put_nowait(value)
        except queue.Full:
            _log.error("the daemon does not read: a report was dropped (%s)", value)

    def flush(self, deadline_s: float) -> None:
        """Send what is queued, at most for so long."""
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        self._thread.join(deadline_s)

    def _run(self) -> None:
        while (value := self._queue.get()) is not None:
            try:
                write_frame(self._descriptor, wire.encode(value))
            except OSError:
                return  # the daemon is gone; the end of our stdin says so too
            except WireError as error:
                _log.error("a report is too large: %s", error)


class RelayProcess:
    """One node's relay on an open data session.

    With ``local_config`` the host's applications are on a side of their own; plans wait until that side is there.
    """

    def __init__(
        self, session: zenoh.Session, fleet: str, node: NodeId, reporter: Reporter, local_config: str = ""
    ) -> None:
        self._session = session
        self._lock = threading.Lock()  # plans come from the pipe, the local side from a thread of its own
        self._graph: GraphMirror | None = None
        self._local: zenoh.Session | None = None
        self._waiting: dict[TaskId, RoutePlan] = {}
        self._node = node
        self._reporter = reporter
        self._tasks: dict[TaskId, TaskRelay] = {}
        self._own_ids = frozenset({str(session.zid())})
        keyspace = Keyspace(fleet)
        self._acks = Acks(session, keyspace, node)
        self._roles = RoleServer(session, keyspace, node)
        self._tokens = Tokens(session, keyspace, self._worker_seen, self._role_ended, self._wake)
        reporter.report(RelayStarted(pid=os.getpid(), zid=str(session.zid())))
        threading.Thread(target=self._count, name="counters", daemon=True).start()
        if not local_config:
            self._begin(None)
        self._local_side = LocalSide(local_config, reporter.report, self._begin) if local_config else None

    def close(self) -> None:
        """Close both sessions; may take as long as a stopped peer holds them."""
        if self._local_side is not None:
            self._local_side.close()
        self._session.close()

    def _begin(self, local: zenoh.Session | None) -> None:
        """Both sides are there: carry out the plans that have come meanwhile."""
        with self._lock:
            if local is not None:
                self._own_ids |= {str(local.zid())}
            self._local = local
            self._graph = GraphMirror(self._session, local, self._node)
            for plan in self._waiting.values():
                self._apply(plan, self._graph)
            self._waiting.clear()

    def obey(self, commands: int) -> None:
        """Read commands until the daemon says stop or is gone."""
        while True:
            try:
                frame = read_frame(commands)
            except WireError as error:
                _log.error("the daemon's pipe is broken: %s", error)
                return
            if frame is None:
                return
            try:
                command = wire.decode(frame, *COMMANDS)
            except WireError as error:
                self._reporter.report(ProblemReported(source="relay", problem=f"unreadable command: {error}"[:400]))
                continue
            if isinstance(command, RelayStop):
                return
            self._do(command)

    def _do(self, command: RoutePlan | Role) -> None:
        if isinstance(command, Role):
            self._roles.set(command)
            return
        with self._lock:
            if self._graph is None:
                self._waiting[command.task] = command
            else:
                self._apply(command, self._graph)

    def _apply(self, plan: RoutePlan, graph: GraphMirror) -> None:
        task = self._tasks.get(plan.task)
        if task is None:
            task = TaskRelay(
                self._session,
                plan.task,
                self._tokens,
                self._acks,
                self._own_ids,
                self._reporter.report,
                graph,
                self._local,
            )
            self._tasks[plan.task] = task
        task.apply(plan)

    def _worker_seen(self, seen: WorkerSeen) -> None:
        self._reporter.report(seen)
        if seen.is_present and seen.node == self._node:
            self._roles.tell(seen.task)

    def _role_ended(self, node: NodeId, ended: RoleEnded) -> None:
        if node == self._node:
            self._reporter.report(ended)

    def _wake(self) -> None:
        for task in tuple(self._tasks.values()):
            task.wake()

    def _count(self) -> None:
        due = monotonic_s()
        pause = threading.Event()
        while True:
            due += COUNT_S
            pause.wait(max(0.0, due - monotonic_s()))
            counts = tuple(count for task in tuple(self._tasks.values()) for count in task.counts())
            self._reporter.report(StreamsCounted(counts=counts))


def run(fleet: str, node: NodeId, commands: int, reports: int, *, has_local_side: bool = False) -> int:
    """Serve until told to stop; the exit code: 0 stopped, 1 the session could not be opened."""
    reporter = Reporter(reports)
    text = read_frame(commands)
    local = read_frame(commands) if has_local_side else b""
    if text is None or local is None:
        return 0
    try:
        session = zenoh.open(zenoh.Config.from_json5(text.decode()))
    except (zenoh.ZError, ValueError) as error:
        problem = f"the data session cannot be opened: {error}; is its port taken?"
        reporter.report(ProblemReported(source="relay", problem=problem[:400]))
        reporter.flush(CLOSE_S)
        return 1
    relay = RelayProcess(session, fleet, node, reporter, local.decode())
    try:
        relay.obey(commands)
    finally:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, ALARM_S)
        reporter.flush(0.1)
        closing = threading.Thread(target=relay.close, name="close", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
    return 0
