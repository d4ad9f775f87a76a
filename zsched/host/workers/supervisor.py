"""Starts, watches, restarts and stops this node's workers, one process per task, from one thread of its own.

| phase | left by | to |
| --- | --- | --- |
| idle | `start` | starting |
| starting | `mark_ready` / exit or start-up deadline: a failure | ready / backoff, failed |
| ready | exit, `report_hung` (SIGKILL): a failure / `mark_gone` | backoff, failed / starting |
| backoff | its delay | starting |
| stopping (SIGINT, SIGTERM, SIGKILL, each after a grace) | exit | idle; after a failure backoff, failed |
| failed | `renew` | idle |

A failure is any end of a worker that is wanted, but for one that `renew` asked for. `max_failures` of them within
`failure_window_s`, or one exit with status 78 ("I cannot run here"), make it failed. The restart delay doubles per
failure in the window, with jitter.

Knows: phases, deadlines, the order of signals. Does not know: why a task starts or stops, zenoh, readiness itself
(its caller says so), or how a process is made (`zsched.host.workers.process`).
"""

from __future__ import annotations

import logging
import math
import os
import random
import re
import signal
from collections import deque
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Final, Protocol

from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import MAX_REASON, NodeId, TaskId, as_reason
from zsched.core.values.profile import WorkerState
from zsched.core.values.struct import Struct, field
from zsched.host.clock import awake_s
from zsched.host.guard import guarded
from zsched.host.workers.comparison import lacking
from zsched.host.workers.kept_lines import KeptLines
from zsched.host.workers.launch import EXIT_CANNOT
from zsched.host.workers.process import ProcessWatch, WorkerGuard, WorkerProcess

log = logging.getLogger("zsched.worker")

BLIND_S = 1.0
"""While nobody sees who is ready, a worker's time to be so is looked at this often."""
INCARNATIONS_PER_DAEMON = 100_000
MAX_LINE = 200
"""Characters of a worker's last line that go into the reason of its exit."""
KILL = signal.SIGKILL
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, KILL)
NOT_INHERITED = frozenset({"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID", "LISTEN_FDS", "LISTEN_PID"})
"""systemd talks to the daemon, not to its workers."""


class WorkerEvents(Protocol):
    """The receiver of the supervisor's reports; called from its thread, so an implementation only enqueues."""

    def on_started(self, task: TaskId, pid: int, incarnation: int) -> None:
        """A worker process runs; it is not ready yet."""

    def on_exited(self, task: TaskId, incarnation: int, returncode: int, reason: str) -> None:
        """A worker process has ended (``returncode`` as in `subprocess`: negative is a signal)."""

    def on_failed(self, task: TaskId, reason: str) -> None:
        """The worker is not started again until `WorkerSupervisor.renew`."""

    def on_reset(self, task: TaskId) -> None:
        """The worker may be started again: its failures are forgotten."""

    def on_stopped(self, task: TaskId) -> None:
        """The worker had ended, and is not started again: it was stopped while it waited for that."""

    def on_compared(self, task: TaskId, *, is_old: bool) -> None:
        """The worker's process runs by an old recipe, or does not any more."""


class WorkerContext(Struct, frozen=True, kw_only=True):
    """What every worker of this daemon gets through its environment."""

    fleet: str
    node: NodeId
    incarnation: int
    """The daemon's: a worker's own is this times 100 000 plus a count, so no two ever share one."""


class RestartPolicy(Struct, frozen=True, kw_only=True):
    """Delay before restart ``n`` (1, 2, ...): ``first_s * 2**(n-1)``, at most ``most_s``, +- ``jitter_ratio`` of it."""

    first_s: float = 0.1
    most_s: float = 10.0
    jitter_ratio: float = 0.2

    def delay_s(self, failures: int, rng: random.Random) -> float:
        """Seconds to wait after the ``failures``-th failure in the window."""
        plain_s = min(self.most_s, self.first_s * 2.0 ** (failures - 1))
        return plain_s * (1.0 + self.jitter_ratio * rng.uniform(-1.0, 1.0))


class _Phase(StrEnum):
    IDLE = "idle"
    STARTING = "starting"
    READY = "ready"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    FAILED = "failed"


_SHOWN = {_Phase.STARTING: WorkerState.STARTING, _Phase.READY: WorkerState.READY, _Phase.FAILED: WorkerState.FAILED}

_OF_ITS_START = frozenset({"ZENOH_RUNTIME"})
"""Variables that a process keeps from its start: zenoh's threads follow the number of nodes and tasks.

A node or a task that comes is no reason to start every worker of the fleet again.
"""


class Recipe(Struct, frozen=True, kw_only=True):
    """What a worker's process is made with, and must be started again for when it changes."""

    command: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    session: str = ""
    """The text of the session that it opens, as JSON."""
    starter: Path | None = None
    """Who starts it, as another user (`zsched.host.workers.hired`); ``None``: the daemon."""

    def is_old(self, new: Recipe) -> bool:
        """Whether a process that was made by this one lacks something of ``new``.

        Of sessions only what is missing counts: a robot that has gone is no reason to start again.
        """
        made, now = ((one.command, one.environment, one.starter) for one in (self, new))
        return made != now or bool(lacking(self.session, new.session))


class _Worker(Struct, kw_only=True):
    """The supervisor's record of one task; touched by its thread only."""

    task: TaskId
    spec: WorkerSpec
    logger: logging.Logger
    kept: KeptLines = field(default_factory=KeptLines)
    phase: _Phase = _Phase.IDLE
    is_wanted: bool = False
    process: WorkerProcess | None = None
    incarnation: int = 0
    deadline_s: float | None = None
    failures: deque[float] = field(default_factory=deque)
    has_been_ready: bool = False
    """This process has."""
    ready_at: float = -math.inf
    """When one of its processes was last ready: only failures before that are ever forgotten."""
    failure: str = ""
    """While stopping: why, when the stop is not the operator's wish."""
    why_again: str = ""
    """Since its last failure, until it is ready: which one that was, and that it is started again."""
    stop_step: int = 0
    stop_grace_s: float = 0.0
    is_kept: bool = True
    """False: it left the fleet file, and is forgotten once it has stopped."""
    is_there: bool = False
    """One that somebody else has started is seen to be ready."""
    made_by: Recipe = Recipe()
    """The recipe of this process."""
    is_old: bool = False
    """This process runs by another recipe than the next one will; as it was told."""


class WorkerSupervisor:
    """Supervises one worker per task. All methods may be called from any thread and return at once (`close` waits)."""

    def __init__(
        self,
        *,
        specs: Mapping[TaskId, WorkerSpec],
        context: WorkerContext,
        events: WorkerEvents,
        environment: Callable[[TaskId], Mapping[str, str]] = lambda _task: {},
        rng: random.Random | None = None,
        policy: RestartPolicy | None = None,
        why_not_ready: Callable[[TaskId], str] = lambda _task: "",
        session: Callable[[TaskId], str] = lambda _task: "",
        starter: Callable[[TaskId], Path | None] = lambda _task: None,
    ) -> None:
        """Start the supervisor's thread; no worker yet.

        Args:
            specs: one per task; an empty command means somebody else runs the worker: only the ``mark_*`` calls act.
            context: what all workers get.
            events: told about starts, ends and failures.
            environment: called at every start (in the supervisor's thread) for the task's own variables, such as
                ``ZSCHED_ZENOH_CONFIG``.
            rng: the source of the jitter; seed it in tests.
            policy: delays between restarts.
            session: called at every start: the text of the session that the worker opens.
            starter: called at every start: who starts the worker, as another user; ``None``: this process.
            why_not_ready: asked when a start-up deadline is over: what the worker lacks, in words.
        """
        self._workers = {
            task: _Worker(task=task, spec=spec, logger=log.getChild(task)) for task, spec in sorted(specs.items())
        }
        self._early: set[TaskId] = set()
        """What is wanted and not known yet: those who adopt another fleet failed with it, and will try again."""
        self._context, self._events, self._environment = context, events, environment
        self._rng, self._policy = rng or random.Random(), policy or RestartPolicy()
        self._why_not_ready, self._session, self._starter = why_not_ready, session, starter
        self._started = 0
        self._is_blind = False
        self._guard = WorkerGuard()
        self._commands: deque[Callable[[], None]] = deque()
        self._watch = ProcessWatch()
        self._close_by_s: float | None = None
        self._snapshot: tuple[Mapping[TaskId, int], Mapping[TaskId, WorkerState]] = ({}, {})
        self._publish()
        self._thread = guarded(self._run, name="zsched-workers")
        self._thread.start()

    # --- what the daemon says ---

    def start(self, task: TaskId) -> None:
        """Want ``task``'s worker running (nothing happens while it is failed, or when it runs already).

        One that is not known yet, or has no command, starts once `adopt` brings both.
        """
        self._command(self._on_start, task)

    def stop(self, task: TaskId) -> None:
        """Want ``task``'s worker stopped: SIGINT, after the grace SIGTERM, after the grace SIGKILL, to its group."""
        self._command(self._on_stop, task)

    def mark_ready(self, task: TaskId, incarnation: int) -> None:
        """The worker of ``incarnation`` takes inputs (its token was seen); an older one's word is ignored."""
        self._command(self._on_ready, task, incarnation)

    def mark_gone(self, task: TaskId, incarnation: int) -> None:
        """The token of ``incarnation`` went while its process may live: it must become ready again in time."""
        self._command(self._on_gone, task, incarnation)

    def lose_sight(self) -> None:
        """Nobody sees who is ready: until `regain_sight` no worker is ended for not being so."""
        self._command(self._on_sight, None)

    def regain_sight(self, within_s: float) -> None:
        """Somebody looks who is ready: each worker that is not has at least so long to be seen."""
        self._command(self._on_sight, within_s)

    def report_hung(self, task: TaskId, incarnation: int, reason: str) -> None:
        """The worker of ``incarnation`` makes no progress: kill it, count a failure, start it again.

        Asking it to stop would only cost time: it does not come to the place where it would hear it.
        """
        self._command(self._on_hung, task, incarnation, reason)

    def renew(self, task: TaskId) -> None:
        """Stop ``task``'s worker as `stop` does, and start it again, without its failures; that counts as none."""
        self._command(self._on_renew, task)

    def keep(self, specs: Mapping[TaskId, WorkerSpec]) -> None:
        """Keep these workers from now on, with these settings.

        No process ends by it but one whose task has no ``command`` any more: a worker that is not among ``specs`` goes
        with its next `stop`, one that runs by an old recipe is reported (`WorkerEvents.on_compared`). Failures of a
        worker whose recipe has changed are forgotten.
        """
        self._command(self._on_adopt, dict(specs))

    def output(self, task: TaskId) -> KeptLines | None:
        """What ``task``'s worker has printed lately; ``None`` where this supervisor starts none."""
        worker = self._workers.get(task)
        return worker.kept if worker is not None and worker.spec.command else None

    def pids(self) -> Mapping[TaskId, int]:
        """The process of every worker that has one."""
        return self._snapshot[0]

    def states(self) -> Mapping[TaskId, WorkerState]:
        """Every task's worker as of the supervisor's last step."""
        return self._snapshot[1]

    def why_again(self, task: TaskId) -> str:
        """Which failure ``task``'s worker is started again after; empty once it is ready, or nobody starts it again."""
        worker = self._workers.get(task)
        return "" if worker is None else worker.why_again

    def close(self, within_s: float = 1.5) -> None:
        """Stop every worker within ``within_s`` seconds (SIGTERM after half, SIGKILL after 80 %) and end the thread."""
        self._command(self._on_close, within_s)
        self._thread.join(timeout=within_s + 2.0)

    def _command(self, call: Callable[..., None], *arguments: object) -> None:
        self._commands.append(partial(call, *arguments))
        self._watch.wake()

    # --- the thread ---

    def _run(self) -> None:
        while not self._is_done():
            self._watch.wait(self._next_deadline_s())
            while self._commands:
                self._commands.popleft()()
            now = awake_s()
            for worker in tuple(self._workers.values()):
                self._advance(worker, now)
            self._publish()
        self._guard.close()
        self._watch.close()

    def _is_done(self) -> bool:
        if self._close_by_s is None:
            return False
        running = [worker.task for worker in self._workers.values() if worker.process is not None]
        if not running:
            return True
        if awake_s() < self._close_by_s:
            return False
        log.error("workers_not_stopped tasks=%s why=kernel does not end them; they die with this process", running)
        return True

    def _next_deadline_s(self) -> float | None:
        times = [worker.deadline_s for worker in self._workers.values() if worker.deadline_s is not None]
        if self._close_by_s is not None:
            times.append(self._close_by_s)
        return min(times, default=None)

    def _publish(self) -> None:
        workers = self._workers.values()
        pids = {worker.task: worker.process.pid for worker in workers if worker.process is not None}
        states = {worker.task: _SHOWN.get(worker.phase, WorkerState.STOPPED) for worker in workers}
        self._snapshot = (pids, states)

    # --- commands, in the thread ---

    def _on_adopt(self, specs: Mapping[TaskId, WorkerSpec]) -> None:
        kept = {
            task: self._workers.get(task) or _Worker(task=task, spec=spec, logger=log.getChild(task))
            for task, spec in specs.items()
        }
        leaving = {task: worker for task, worker in self._workers.items() if task not in kept}
        for worker in leaving.values():
            worker.is_kept = False
        self._workers = dict(sorted({**kept, **leaving}.items()))
        for task, worker in kept.items():
            has_changed = worker.spec != specs[task]
            worker.spec, worker.is_kept = specs[task], True
            if worker.phase in {_Phase.FAILED, _Phase.BACKOFF} and (
                has_changed or worker.made_by.is_old(self._recipe_of(worker))
            ):
                self._on_reset(task)
            if worker.spec.command and worker.process is None and worker.phase is _Phase.READY:
                worker.phase = _Phase.IDLE  # somebody else's was ready, and ours is to be started from now on
            if not worker.spec.command:
                self._on_stop(task)
                self._go_by_sight(worker)
            elif task in self._early:
                self._early.discard(task)
                self._on_start(task)
        for worker in self._workers.values():
            self._compare(worker)

    def _compare(self, worker: _Worker) -> None:
        """Tell whether the process runs by an old recipe, when that has changed."""
        is_old = worker.process is not None and worker.made_by.is_old(self._recipe_of(worker))
        if is_old is not worker.is_old:
            worker.is_old = is_old
            self._tell(partial(self._events.on_compared, is_old=is_old), worker.task)

    def _recipe_of(self, worker: _Worker) -> Recipe:
        if not worker.is_kept:
            return worker.made_by
        made = {name: value for name, value in self._environment(worker.task).items() if name not in _OF_ITS_START}
        environment = {**made, **dict(worker.spec.env)}
        return Recipe(
            command=worker.spec.command,
            environment=tuple(sorted(environment.items())),
            session=self._session(worker.task),
            starter=self._starter(worker.task),
        )

    def _on_start(self, task: TaskId) -> None:
        worker = self._workers.get(task)
        if worker is None or not (worker.is_kept and worker.spec.command):
            self._early.add(task)
        else:
            worker.is_wanted = self._close_by_s is None

    def _on_stop(self, task: TaskId) -> None:
        self._early.discard(task)
        worker = self._workers.get(task)
        if worker is None:
            return
        worker.is_wanted, worker.why_again = False, ""
        if worker.phase in {_Phase.STARTING, _Phase.READY} and worker.process is not None:
            self._begin_stop(worker, worker.spec.stop_grace_s)
        elif worker.phase is _Phase.BACKOFF:
            worker.phase, worker.deadline_s = _Phase.IDLE, None
            self._tell(self._events.on_stopped, task)

    def _on_ready(self, task: TaskId, incarnation: int) -> None:
        worker = self._workers.get(task)
        if worker is None:
            return
        if not worker.spec.command:
            worker.is_there = True
            self._go_by_sight(worker)
        elif worker.phase is _Phase.STARTING and incarnation == worker.incarnation:
            worker.phase, worker.deadline_s, worker.has_been_ready = _Phase.READY, None, True
            worker.why_again, worker.ready_at = "", awake_s()

    def _on_gone(self, task: TaskId, incarnation: int) -> None:
        worker = self._workers.get(task)
        if worker is None:
            return
        if not worker.spec.command or incarnation != worker.incarnation:
            worker.is_there = False
        if not worker.spec.command:
            self._go_by_sight(worker)
        elif worker.phase is _Phase.READY and incarnation == worker.incarnation:
            worker.phase, worker.deadline_s = _Phase.STARTING, awake_s() + worker.spec.start_deadline_s

    def _go_by_sight(self, worker: _Worker) -> None:
        """A worker that somebody else starts is ready while it is seen; ours, from before, has to be stopped first."""
        if worker.process is None:
            worker.phase = _Phase.READY if worker.is_there else _Phase.IDLE

    def _on_sight(self, within_s: float | None) -> None:
        self._is_blind = within_s is None
        for worker in self._workers.values():
            if worker.phase is _Phase.STARTING and worker.deadline_s is not None and within_s is not None:
                worker.deadline_s = max(worker.deadline_s, awake_s() + within_s)

    def _on_hung(self, task: TaskId, incarnation: int, reason: str) -> None:
        worker = self._workers.get(task)
        if worker is None:
            return
        is_running = worker.process is not None and worker.phase in {_Phase.STARTING, _Phase.READY}
        if is_running and incarnation == worker.incarnation:
            self._begin_stop(worker, worker.spec.stop_grace_s, failure=reason, first_step=STOP_SIGNALS.index(KILL))

    def _on_renew(self, task: TaskId) -> None:
        worker = self._workers.get(task)
        if worker is None:
            return
        self._on_reset(task)
        if worker.phase in {_Phase.STARTING, _Phase.READY} and worker.process is not None:
            self._begin_stop(worker, worker.spec.stop_grace_s)  # whose end leads to a start, for it is still wanted

    def _on_reset(self, task: TaskId) -> None:
        worker = self._workers.get(task)
        if worker is None:
            return
        worker.failures.clear()
        worker.why_again = ""
        if worker.phase in {_Phase.FAILED, _Phase.BACKOFF}:
            worker.phase, worker.deadline_s = _Phase.IDLE, None
            self._tell(self._events.on_reset, task)

    def _on_close(self, within_s: float) -> None:
        self._close_by_s = awake_s() + within_s + 0.5
        for worker in self._workers.values():
            worker.is_wanted = False
            if worker.process is not None:
                self._begin_stop(worker, within_s * 0.5, next_grace_s=within_s * 0.3)
            elif worker.phase is _Phase.BACKOFF:
                worker.phase, worker.deadline_s = _Phase.IDLE, None

    # --- one worker's next step ---

    def _advance(self, worker: _Worker, now: float) -> None:
        if worker.process is not None and worker.process.has_exited():
            self._on_exit(worker, worker.process, now)
        if worker.deadline_s is not None and now >= worker.deadline_s:
            self._on_deadline(worker, now)
        if worker.phase is _Phase.IDLE and worker.is_wanted:
            self._spawn(worker, now)
        if not worker.is_kept and worker.process is None and not worker.is_wanted:
            del self._workers[worker.task]

    def _on_deadline(self, worker: _Worker, now: float) -> None:
        worker.deadline_s = None
        if worker.phase is _Phase.STARTING and self._is_blind:
            worker.deadline_s = now + BLIND_S
        elif worker.phase is _Phase.BACKOFF:
            self._spawn(worker, now)
        elif worker.phase is _Phase.STARTING:
            why = self._why_not_ready(worker.task)
            again = "again " if worker.has_been_ready else ""
            reason = f"not ready {again}within {worker.spec.start_deadline_s:g} s{': ' if why else ''}{why}"
            self._begin_stop(worker, worker.spec.stop_grace_s, failure=reason)
        elif worker.phase is _Phase.STOPPING:
            self._signal_stop(worker, min(worker.stop_step + 1, len(STOP_SIGNALS) - 1), now)

    def _spawn(self, worker: _Worker, now: float) -> None:
        self._started += 1
        worker.incarnation = self._context.incarnation * INCARNATIONS_PER_DAEMON + self._started
        process: WorkerProcess | None = None
        try:
            worker.made_by = self._recipe_of(worker)
            process = self._process_of(worker)
            self._guard.add(process.group)
        except Exception as error:  # noqa: BLE001 - whatever stops a start is that worker's failure, never the daemon's
            if process is not None:
                self._guard.discard(process.group)
                process.finish(now)
            reason = f"cannot start: {error}"
            self._after_failure(worker, reason, now, is_last=self._count_failure(worker, reason, None, now))
            return
        worker.process, worker.phase, worker.has_been_ready = process, _Phase.STARTING, False
        worker.deadline_s = now + worker.spec.start_deadline_s
        self._watch.add(process)
        self._compare(worker)
        user = "" if worker.made_by.starter is None else f" user={worker.made_by.starter.stem}"
        log.info("worker_started task=%s pid=%d incarnation=%d%s", worker.task, process.pid, worker.incarnation, user)
        self._tell(self._events.on_started, worker.task, process.pid, worker.incarnation)

    def _process_of(self, worker: _Worker) -> WorkerProcess:
        made, command = worker.made_by, worker.spec.command
        environment = self._environment_of(worker)
        return WorkerProcess(command, environment, worker.logger, worker.kept, made.starter, made.session)

    def _environment_of(self, worker: _Worker) -> dict[str, str]:
        is_ours = worker.made_by.starter is None  # another user's has the variables of its unit
        inherited = {name: value for name, value in os.environ.items() if is_ours and name not in NOT_INHERITED}
        own = {
            "PYTHONUNBUFFERED": "1",
            "ZSCHED_FLEET": self._context.fleet,
            "ZSCHED_NODE": self._context.node,
            "ZSCHED_TASK": worker.task,
            "ZSCHED_INCARNATION": str(worker.incarnation),
        }
        return inherited | own | dict(self._environment(worker.task)) | dict(worker.spec.env)

    def _begin_stop(
        self,
        worker: _Worker,
        grace_s: float,
        *,
        next_grace_s: float | None = None,
        failure: str = "",
        first_step: int = 0,
    ) -> None:
        if worker.phase is _Phase.STARTING and not failure:  # no handlers yet: SIGINT would be a traceback in the log
            first_step = max(first_step, STOP_SIGNALS.index(signal.SIGTERM))
        if worker.phase is not _Phase.STOPPING:
            worker.failure = failure
        worker.phase = _Phase.STOPPING
        now = awake_s()
        worker.stop_grace_s = grace_s
        self._signal_stop(worker, first_step, now)
        worker.stop_grace_s = grace_s if next_grace_s is None else next_grace_s

    def _signal_stop(self, worker: _Worker, step: int, now: float) -> None:
        assert worker.process is not None
        worker.stop_step = step
        worker.process.signal_group(STOP_SIGNALS[step])
        worker.deadline_s = now + max(worker.stop_grace_s, 0.05)

    def _on_exit(self, worker: _Worker, process: WorkerProcess, now: float) -> None:
        self._watch.discard(process)
        self._guard.discard(process.group)
        returncode = process.finish(now)
        worker.process, worker.deadline_s = None, None
        self._compare(worker)
        if worker.phase is _Phase.STOPPING and not worker.failure:
            worker.phase = _Phase.IDLE
            if not worker.spec.command:
                self._go_by_sight(worker)
            reason = f"stopped by {STOP_SIGNALS[worker.stop_step].name}"
            self._tell(self._events.on_exited, worker.task, worker.incarnation, returncode, reason)
            return
        reason = worker.failure or _describe_exit(returncode, process.last_line)
        is_last = self._count_failure(worker, reason, returncode, now)  # the receiver of this report asks what follows
        self._tell(self._events.on_exited, worker.task, worker.incarnation, returncode, reason)
        self._after_failure(worker, reason, now, is_last=is_last)

    def _count_failure(self, worker: _Worker, reason: str, returncode: int | None, now: float) -> bool:
        """Whether that was one too many."""
        worker.failure = ""
        worker.failures.append(now)
        oldest = now - worker.spec.failure_window_s
        while worker.failures[0] < min(oldest, worker.ready_at):
            worker.failures.popleft()
        count, most = len(worker.failures), worker.spec.max_failures
        is_last = returncode == EXIT_CANNOT or count >= most
        is_again = worker.is_wanted and not is_last
        worker.why_again = _told_again(reason, count, most) if is_again else ""
        return is_last

    def _after_failure(self, worker: _Worker, reason: str, now: float, *, is_last: bool) -> None:
        count = len(worker.failures)
        if is_last:
            worker.phase, worker.deadline_s = _Phase.FAILED, None
            log.error("worker_failed task=%s failures=%d reason=%r", worker.task, count, reason)
            self._tell(self._events.on_failed, worker.task, reason)
            return
        if not worker.is_wanted:
            worker.phase = _Phase.IDLE
            return
        delay_s = self._policy.delay_s(count, self._rng)
        worker.phase, worker.deadline_s = _Phase.BACKOFF, now + delay_s
        log.warning("worker_ended task=%s failures=%d restart_in_s=%.2f reason=%r", worker.task, count, delay_s, reason)

    def _tell(self, call: Callable[..., None], *arguments: object) -> None:
        try:
            call(*arguments)
        except Exception:
            log.exception("event_handler_failed handler=%s", getattr(call, "__name__", call))


def _told_again(reason: str, count: int, most: int) -> str:
    """Which failure is followed by a start; without the count where that would cost the reason its end."""
    told = f"restarting (failure {count} of {most}): {reason}"
    return told if len(told) <= MAX_REASON else f"restarting: {reason}"


_LACKS_ROS: Final = re.compile(
    r"No module named '(rclpy|ament_\w+|\w+_msgs|std_srvs)\b"
    r"|\blibrcl\w*\.so|cannot run 'ros2'|\bros2: (command )?not found"
)
"""How a program ends that was started without ROS's environment."""


def _describe_exit(returncode: int, last_line: str) -> str:
    if returncode < 0:
        return f"killed by signal {-returncode} ({signal.strsignal(-returncode)})"
    said = f": {as_reason(last_line, MAX_LINE)}" if last_line else ""
    if _LACKS_ROS.search(last_line):
        said += "; is ROS there, and its setup.bash sourced in the command?"
    return f"exited with status {returncode}{said}"
