"""The relay process: its session, its threads, what passes between it and its daemon.

Knows: how commands become tasks' plans and roles, how reports leave, how to go on without a daemon for a while, how to
end within a second. Does not know: how a stream is carried, which daemon it obeys.

Without a daemon the streams run on: plans are obeyed as they are, and what owners put out passes (an exclusive one puts
out nothing without its lease). No worker gets a role: those of this node died with the daemon.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Final

import zenoh

from zsched.core.membership.relink import Introductions
from zsched.core.values import codec as wire
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import WireError
from zsched.core.values.events import FrameDropped, ProblemReported, RoleEnded, StreamsCounted
from zsched.core.values.model import MAX_REASON, NodeId, TaskId
from zsched.core.values.plan import Role, Route, RoutePlan
from zsched.core.values.relay_protocol import RelayReport, RelayStarted, RelayStop, TaskEnded, WorkerSeen, WorkerWatch
from zsched.host.clock import awake_s, monotonic_s
from zsched.host.guard import calmed, ends_within, guarded, on_failure
from zsched.host.heap import Leftovers
from zsched.link.keyspace import Keyspace
from zsched.link.pipe.frames import COMMANDS, write_frame
from zsched.link.pipe.protocol import RelayPulse
from zsched.link.sessions.closing import ALARM_S, CLOSE_S
from zsched.link.sessions.config import WORKERS_BY, lease_s, setting
from zsched.link.sessions.expulsion import MAX_DATA_SESSIONS, Expulsion, Refusal, members_of
from zsched.link.sessions.link_sockets import opened
from zsched.link.sessions.problems import why_not_open
from zsched.link.sessions.relink import Introducer
from zsched.relay.graph import GraphMirror
from zsched.relay.local_side import LocalSide
from zsched.relay.matching import Matching
from zsched.relay.mute_links import MuteLinks
from zsched.relay.open_streams import OpenStreams
from zsched.relay.roles import RoleServer
from zsched.relay.streams.acks import DEFAULT_LEASE_S, Acks
from zsched.relay.task import TaskRelay
from zsched.relay.tokens import Tokens
from zsched.relay.troubles import Troubles
from zsched.relay.visits import Daemon, RefusedError, Visits

COUNT_S: Final = 1.0
"""Period of the counters."""
PULSE_S: Final = 0.5
"""After this long without a report we tell the daemon that we live, whatever the streams' threads wait for."""
LEAVE_S: Final = 1.5
"""Before the data session is opened anew, samples under way arrive; after this time without any they are given up..."""
LEAVE_MAX_S: Final = 8.0
"""...and in any case after this time."""
END_S: Final = 3.0
"""The session has this time to close, and its port to be free."""
RETRY_S: Final = 0.05
FINISH_S: Final = 0.4
"""A relay that ends lets what is under way arrive, and closes its streams, within this time..."""
FINISH_SPARE_S: Final = 0.1
"""...of which this much is left for the closing."""
MAX_REPORTS: Final = 4096
SOURCE: Final = "relay"

_log = logging.getLogger("zsched.relay")


class Reporter:
    """Writes reports to the daemon from a thread of its own; when the daemon stalls, counters are the first to go.

    While there is no daemon reports are dropped; `attach` tells the next one what still holds.
    """

    def __init__(self) -> None:
        self._link: socket.socket | None = None
        self._queue: queue.Queue[RelayReport | None] = queue.Queue(MAX_REPORTS)
        self._writing = threading.Lock()
        self._problems: dict[str, ProblemReported] = {}
        self._still_s: float | None = None
        """How long nothing was counted, as far as we ran; ``None``: the session is not open yet."""
        self._thread = guarded(self._run, name="reports")
        self._thread.start()

    def report(self, value: RelayReport) -> None:
        """Send a report; never blocks."""
        if isinstance(value, StreamsCounted):
            self._still_s = 0.0
            if self._queue.qsize() > MAX_REPORTS // 2:
                return
        if isinstance(value, RelayStarted):
            self._still_s = 0.0
        if isinstance(value, ProblemReported):
            self._problems[value.source] = value
        try:
            self._queue.put_nowait(value)
        except queue.Full:
            _log.error("the daemon does not read: a report was dropped (%s)", value)

    def attach(self, link: socket.socket) -> None:
        """Report to a daemon from now on; lasting problems are reported again."""
        with self._writing:  # no frame may begin on one link and end on another
            self._link = link
        for problem in tuple(self._problems.values()):
            if problem.problem is not None:
                self.report(problem)

    def detach(self) -> None:
        """The daemon has gone: its link is closed."""
        with self._writing:
            link, self._link = self._link, None
        if link is not None:
            link.close()

    def flush(self, deadline_s: float) -> None:
        """Send what is queued, for at most this long."""
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        self._thread.join(deadline_s)

    def _run(self) -> None:
        while True:
            began = awake_s()
            try:
                value: RelayReport | RelayPulse | None = self._queue.get(timeout=PULSE_S)
            except queue.Empty:
                value = RelayPulse(counted_s=self._still_s or 0.0)
            if value is None:
                return
            if self._still_s is not None:  # what it took longer we did not run ourselves, and nor did the streams
                self._still_s += min(awake_s() - began, 2 * PULSE_S)
            self._write(value)

    def _write(self, value: RelayReport | RelayPulse) -> None:
        try:
            frame = wire.encode(value)
        except WireError as error:
            _log.error("a report is too large: %s", error)
            return
        with self._writing, contextlib.suppress(OSError):  # the daemon is gone: the end of our commands says so too
            if self._link is not None:
                write_frame(self._link.fileno(), frame)


class RelayProcess:
    """One node's relay on an open data session.

    With ``local_config`` the host's applications are on a side of their own; plans wait until that side is there.
    """

    def __init__(
        self,
        session: zenoh.Session,
        fleet: str,
        node: NodeId,
        reporter: Reporter,
        local_config: str = "",
        introducer: Introducer | None = None,
        link_lease_s: float = DEFAULT_LEASE_S,
        members: frozenset[str] | None = None,
    ) -> None:
        """``link_lease_s``: zenoh's, on the session's links. ``members``: the common names that it lets in, if any."""
        self._session, self._fleet = session, fleet
        self._counting, self._refused = threading.Lock(), Counter[Refusal]()
        self._expulsion = self._expel_from(session, members)
        self._lock = threading.Lock()  # plans come from the pipe, the local side from a thread of its own
        self._graph: GraphMirror | None = None
        self._local: zenoh.Session | None = None
        self._waiting: dict[TaskId, RoutePlan] = {}
        self._standbys: dict[TaskId, tuple[Route, ...]] = {}
        self._unowned: dict[TaskId, tuple[Route, ...]] = {}
        self._node = node
        self._reporter = reporter
        self._introducer = introducer
        self._tasks: dict[TaskId, TaskRelay] = {}
        self._own_ids = frozenset({str(session.zid())})
        keyspace = Keyspace(fleet)
        self._acks = Acks(session, keyspace, node, self._has_worker, link_lease_s)
        self._roles = RoleServer(session, keyspace, node)
        self._matching = Matching(session, reporter.report)
        self._mute_links = MuteLinks(session, keyspace)
        self._troubles = Troubles(session, keyspace, node, reporter.report)
        self._tokens = Tokens(session, keyspace, self._worker_seen, self._role_ended, self._wake)
        self._token = self._shown(session)
        guarded(self._count, name="counters").start()
        if not local_config:
            self._begin(None)
        self._local_side = LocalSide(local_config, reporter.report, self._begin) if local_config else None

    def close(self) -> None:
        """Close both sessions; may take as long as a stopped peer holds them."""
        self._acks.flush()  # what we have had, the next life of this relay need not be sent
        if self._local_side is not None:
            self._local_side.close()
        if self._introducer is not None:
            self._introducer.close()
        self._session.close()

    def finish(self) -> None:
        """Take nothing more, let what is under way arrive for a moment, and tell what became of all samples."""
        until = monotonic_s() + FINISH_S
        for is_done in [task.finish(until - FINISH_SPARE_S) for task in tuple(self._tasks.values())]:
            is_done.wait(max(0.0, until - monotonic_s()))
        self._tell_counts()

    def reopen(self, config: str) -> None:
        """Open the data session anew, by another configuration; the host's own side, and what comes there, stays.

        What is under way arrives first, what comes meanwhile waits (`TaskRelay.leave`).

        Raises:
            zenoh.ZError, ValueError, TimeoutError: it cannot be; then this relay has to end.
        """
        began = awake_s()
        with self._lock:
            tasks = tuple(self._tasks.values())
            for has_left in [task.leave(LEAVE_S, LEAVE_MAX_S) for task in tasks]:
                has_left.wait(LEAVE_MAX_S + END_S)
            self._acks.flush()
            self._tokens.leave()
            self._close_data()
            left_at = awake_s()
            self._session = session = _opened_in_time(config)
            lease = lease_s(config)
            self._expulsion = self._expel_from(session, members_of(config))
            self._introducer = None if self._introducer is None else Introducer(config)
            self._own_ids = frozenset({str(one.zid()) for one in (session, self._local) if one is not None})
            self._acks.rejoin(session, lease)
            for part in (self._roles, self._matching, self._troubles, self._tokens, self._graph):
                if part is not None:
                    part.rejoin(session)
            for task in tasks:
                task.rejoin(session, self._own_ids)
            self._token = self._shown(session)
            self._mute_links = MuteLinks(session, Keyspace(self._fleet))
        _log.warning(
            "the data session is opened anew: streams waited %.2f s for what was under way, it took %.2f s",
            left_at - began,
            awake_s() - left_at,
        )

    def _shown(self, session: zenoh.Session) -> zenoh.LivelinessToken:
        """The token of this life: workers wait for nothing of the one before that is not closed (`worker.lives`)."""
        return session.liveliness().declare_token(Keyspace(self._fleet).relay(self._node, str(session.zid())))

    def _expel_from(self, session: zenoh.Session, members: frozenset[str] | None) -> Expulsion | None:
        if members is None:
            return None
        return Expulsion(session, self._fleet, members, self._refuse, MAX_DATA_SESSIONS, has_streams=True)

    def _refuse(self, why: Refusal, _name: str) -> None:
        with self._counting:
            self._refused[why] += 1

    def _tell_refused(self) -> None:
        with self._counting:
            refused, self._refused = self._refused, Counter()
        for why, count in refused.items():
            self._reporter.report(FrameDropped(kind="data_link", reason=why, count=count))

    def _close_data(self) -> None:
        if self._expulsion is not None:
            self._expulsion.close()
        if self._introducer is not None:
            self._introducer.close()
        if not ends_within(END_S, self._session.close, name="close"):
            raise TimeoutError(f"the session before does not close within {END_S:g} s")

    def keep(self, tasks: Collection[TaskId]) -> None:
        """End what is carried for other tasks: they have left the fleet."""
        with self._lock:
            known = {*self._tasks, *self._waiting, *self._standbys, *self._unowned}
        for name in sorted(known - set(tasks)):
            self._end(name)

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
            for task, routes in self._unowned.items():
                self._listen(task, routes, self._graph)
            for task, routes in self._standbys.items():
                self._graph.set_routes(_standbys_of(task), routes)

    def obey(self, frame: bytes) -> bool:
        """Do what the daemon says; false once that is to end."""
        try:
            command = wire.decode(frame, *COMMANDS)
        except WireError as error:
            self._reporter.report(ProblemReported(source=SOURCE, problem=f"unreadable command: {error}"[:MAX_REASON]))
            return True
        if isinstance(command, RelayStop):
            return False
        self._do(command)
        return True

    def go_on_alone(self) -> None:
        """The daemon is gone, and nobody says what holds: see the module's first lines."""
        self._roles.forget()
        for task in tuple(self._tasks.values()):
            task.lose_daemon()

    def begin(self) -> None:
        """A daemon has come, and knows nothing of us: name the workers that are there; its plans follow."""
        self._reporter.report(RelayStarted(pid=os.getpid(), zid=str(self._session.zid())))
        for seen in self._tokens.seen():
            self._reporter.report(seen)

    def _do(self, command: RoutePlan | Role | WorkerWatch | TaskEnded) -> None:
        if isinstance(command, TaskEnded):
            self._end(command.task)
            return
        if isinstance(command, Role):
            self._roles.set(command)
            return
        if isinstance(command, WorkerWatch):
            self._watch(command)
            return
        with self._lock:
            if self._graph is None:
                self._waiting[command.task] = command
            else:
                self._apply(command, self._graph)

    def _watch(self, watch: WorkerWatch) -> None:
        if watch.inputs or watch.services or not (watch.standbys or watch.unowned):
            self._matching.watch(watch)
        with self._lock:
            self._standbys[watch.task] = watch.standbys
            self._unowned[watch.task] = watch.unowned
            if self._graph is not None:
                self._graph.set_routes(_standbys_of(watch.task), watch.standbys)
                self._listen(watch.task, watch.unowned, self._graph)

    def _end(self, name: TaskId) -> None:
        self._roles.end(name)
        self._matching.forget(name)
        with self._lock:
            for table in (self._waiting, self._standbys, self._unowned):
                table.pop(name, None)
            if self._graph is not None:
                self._graph.set_routes(_standbys_of(name), ())
            task = self._tasks.pop(name, None)
        if task is not None:
            task.end()

    def _listen(self, task: TaskId, routes: tuple[Route, ...], graph: GraphMirror) -> None:
        if routes or task in self._tasks:
            self._task(task, graph).listen(routes)

    def _apply(self, plan: RoutePlan, graph: GraphMirror) -> None:
        self._task(plan.task, graph).apply(plan)

    def _task(self, name: TaskId, graph: GraphMirror) -> TaskRelay:
        task = self._tasks.get(name)
        if task is None:
            task = TaskRelay(
                self._session,
                name,
                self._tokens,
                self._acks,
                self._reporter.report,
                graph,
                OpenStreams(self._session, self._own_ids, self._local),
                self._local,
            )
            self._tasks[name] = task
        return task

    def _has_worker(self, node: NodeId, task: TaskId, incarnation: str) -> bool:
        return self._tokens.has_worker(node, task, incarnation)

    def _worker_seen(self, seen: WorkerSeen) -> None:
        self._reporter.report(seen)
        if seen.is_present and seen.node == self._node:
            self._roles.tell(seen.task)

    def _role_ended(self, node: NodeId, ended: RoleEnded) -> None:
        if node == self._node:
            self._reporter.report(ended)
            self._roles.remind(ended.task, ended.epoch)

    def _wake(self) -> None:
        for task in tuple(self._tasks.values()):
            task.wake()

    def _count(self) -> None:
        due = awake_s()
        pause = threading.Event()
        introductions, leftovers = Introductions(), Leftovers()
        while True:
            due = max(due + COUNT_S, awake_s())  # none is made up for
            pause.wait(due - awake_s())
            leftovers.tend(awake_s())
            self._tell_counts()
            self._tell_refused()
            for kind in calmed(monotonic_s()):
                self._reporter.report(ProblemReported(source=_of_thread(kind), problem=None))
            missed = {node for task in tuple(self._tasks.values()) if (node := task.missed) is not None}
            if introductions.is_due(awake_s(), is_missing=bool(missed)) and self._introducer is not None:
                self._introducer.introduce()
            self._mute_links.look(missed - {self._node}, awake_s())

    def _tell_counts(self) -> None:
        counts = tuple(count for task in tuple(self._tasks.values()) for count in task.counts())
        self._reporter.report(StreamsCounted(counts=counts))


def _of_thread(kind: str) -> str:
    return f"{SOURCE}/thread/{kind}"


def _standbys_of(task: TaskId) -> str:
    """Under which name the routes to a task's standbys stand beside those of its slots (no task is called so)."""
    return f"{task}@standbys"


def _opened(config: str) -> zenoh.Session:
    session = opened(config)
    for end in setting(config, "listen/endpoints"):
        if end.startswith(f"{WORKERS_BY}/"):
            with contextlib.suppress(OSError):  # zenoh could not listen there
                Path(Endpoint.of(end).address).chmod(0o666)  # its folder says who comes so far
    return session


def _opened_in_time(config: str) -> zenoh.Session:
    """A session; its port may be free a moment later only.

    Raises:
        zenoh.ZError, ValueError: it cannot be opened.
    """
    until = awake_s() + END_S
    while True:
        try:
            return _opened(config)
        except zenoh.ZError:
            if awake_s() >= until:
                raise
            time.sleep(RETRY_S)


def run(visits: Visits, daemon: Daemon, alone_s: float) -> int:
    """Serve one daemon after the other; the exit code: 0 stopped, 1 the session could not be opened.

    ``alone_s``: the relay ends when no daemon has come for so long.
    """
    reporter = Reporter()
    on_failure(lambda kind, text: reporter.report(ProblemReported(source=_of_thread(kind), problem=text)))
    reporter.attach(daemon.link)
    hello, config = daemon.hello, daemon.session
    try:
        session = _opened(config)
    except (zenoh.ZError, ValueError) as error:
        problem = f"its data session {why_not_open(config, error)}"
        reporter.report(ProblemReported(source=SOURCE, problem=problem))
        reporter.flush(CLOSE_S)
        return 1
    relay = RelayProcess(
        session,
        hello.fleet,
        hello.node,
        reporter,
        daemon.local,
        Introducer(config),
        lease_s(config),
        members_of(config),
    )
    try:
        return _serve(relay, reporter, visits, daemon, alone_s)
    finally:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, FINISH_S + ALARM_S)
        try:
            relay.finish()
        except Exception:  # noqa: BLE001 - it ends all the same
            _log.exception("the last counts are missing")
        reporter.flush(0.1)
        ends_within(CLOSE_S, relay.close, name="close")


def _serve(relay: RelayProcess, reporter: Reporter, visits: Visits, daemon: Daemon, alone_s: float) -> int:
    while True:
        if daemon.hello.tasks is not None:
            relay.keep(daemon.hello.tasks)
        relay.begin()
        if _obey(relay, visits, daemon):
            return 0
        _log.warning("the daemon is gone: carrying on for %g s", alone_s)
        reporter.detach()
        relay.go_on_alone()
        try:
            following = visits.next_daemon(alone_s)
        except RefusedError as error:
            _log.warning("another relay is needed: %s", error)
            return 1
        if following is None:
            _log.warning("no daemon came: ends")
            return 0
        _log.warning("another daemon has come")
        reporter.attach(following.link)
        if daemon.reopens(following) and not _reopen(relay, reporter, following.session):
            return 1
        daemon = following


def _obey(relay: RelayProcess, visits: Visits, daemon: Daemon) -> bool:
    """Do what the daemon says until it says stop (true) or is gone (false)."""
    try:
        while (frame := visits.next_frame(daemon.link)) is not None:
            if not relay.obey(frame):
                return True
    except (WireError, OSError) as error:
        _log.error("the link to the daemon is broken: %s", error)
    return False


def _reopen(relay: RelayProcess, reporter: Reporter, text: str) -> bool:
    """Open the data session by another configuration; ``False``, and told why: it cannot be."""
    try:
        relay.reopen(text)
    except (zenoh.ZError, OSError, ValueError) as error:
        problem = f"its data session is not opened anew: {why_not_open(text, error)}"
        reporter.report(ProblemReported(source=SOURCE, problem=problem[:MAX_REASON]))
        reporter.flush(CLOSE_S)
        return False
    return True
