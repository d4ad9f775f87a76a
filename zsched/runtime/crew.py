"""This node's workers as their processes, their tokens and the relay's matches show them, joined into one state each.

Knows: which process of a worker counts, by what it is seen to be ready. Does not know: how a process is started, what
follows from a state. Called from the supervisor's thread and the relay handle's.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.model import MAX_REASON, NodeId, TaskId
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.profile import WorkerState
from zsched.core.values.relay_protocol import WorkerMatched, WorkerSeen, WorkerTrouble
from zsched.core.values.words import Trouble
from zsched.host.clock import monotonic_s, wall_time
from zsched.host.guard import guarded
from zsched.host.workers.supervisor import WorkerSupervisor
from zsched.link.keyspace import Keyspace, counter
from zsched.runtime.sessions import SessionsRead

OTHERS: Final = (
    "somebody takes every node's inputs (a recorder?): whether a worker is there cannot be told by matching; "
    "output_deadline_s notices a dead one"
)
NO_TOKEN: Final = (
    "no token: without zsched.worker say `ready: matching`; with it, Worker.ready() on $ZSCHED_ZENOH_CONFIG declares"
)
OTHER_NETWORK: Final = "did it open $ZSCHED_ZENOH_CONFIG, or does it subscribe to another key?"
REJOIN_S: Final = 4.0
"""A worker that runs already is seen so soon after its relay's start: it dials at least once a second."""
MISSED_S: Final = 8.0
"""Who was ready and is not seen so long after its relay's start is gone; a busy machine may need more than usual."""
UNSEEN: Final = "the relay that was started since does not see its token"

_log = logging.getLogger("zsched.crew")


class Crew:
    """The workers of one daemon (it implements the supervisor's `WorkerEvents`)."""

    def __init__(self, post: Callable[[ev.Event], None], fleet: Fleet | None = None, node: NodeId = "") -> None:
        """``fleet`` says which workers show themselves by matching; without one all show tokens."""
        self._keys, self._node = Keyspace("" if fleet is None else fleet.name), node
        self._take(() if fleet is None else fleet.tasks)
        self._post = post
        self.supervisor: WorkerSupervisor | None = None
        """It reports to this crew, so it is made after it."""
        self._lives: dict[TaskId, int] = {}
        """{task: the running process's incarnation}, 0 once it has ended; none for somebody else's worker."""
        self._matches: dict[TaskId, WorkerMatched] = {}
        self._tokens: dict[TaskId, set[int]] = {}
        """{task: the incarnations of the tokens here}, also of tasks that have no worker here by the file."""
        self._kept: frozenset[TaskId] = frozenset()
        """The tasks whose worker the supervisor was told to keep."""
        self._strays: dict[TaskId, str] = {}
        """{task: the incarnation of a token here that is not the running process's}."""
        self._seen: set[TaskId] = set()
        """Whose worker has been ready: the running process, or somebody else's one at any time."""
        self._lost: dict[TaskId, str] = {}
        """{task: since when it is not ready any more, and what to look at}."""
        self.sessions: Mapping[TaskId, Path] = {}
        """{task: the file with the session that its worker opens}."""
        self.sessions_read: SessionsRead | None = None
        self._outdated: set[TaskId] = set()
        self._doubted: frozenset[TaskId] = frozenset()
        """Of which a problem says that matching does not tell whether the worker is there."""
        self._relay_at = -math.inf
        self._relays = 0
        """Which start or end of a relay was the newest."""
        self._lock = threading.Lock()  # an end and a token's end come from two threads

    def _take(self, tasks: tuple[TaskSpec, ...]) -> None:
        self._matching = frozenset(task.name for task in tasks if task.worker.ready_when is ReadyWhen.MATCHING)
        self._foreign = frozenset(task.name for task in tasks if not task.worker.command)

    def on_fleet(self, fleet: Fleet, sessions: Mapping[TaskId, Path]) -> None:
        """Take from another fleet file which workers show themselves how, and which ones somebody else starts."""
        known = self._foreign
        with self._lock:
            self._take(fleet.tasks)
            for task in self._foreign - known:
                self._lives.pop(task, None)  # lives of ours mean nothing any more
            self._outdated &= self._foreign
            self._doubt_only(self._doubted & self._foreign & self._matching)
        self.sessions = sessions
        self._say_missing(self._foreign - self._matching - known)

    def keep(self, tasks: Iterable[TaskId]) -> None:
        """Know that the supervisor was told to keep these workers; say which of the new ones are there already.

        A worker that somebody else starts may run on while its task, or this node's place in it, is away: its token
        comes once, and was no news then. Of one that is seen by matching the relay tells when it is asked again.
        """
        with self._lock:
            new, self._kept = frozenset(tasks) - self._kept, frozenset(tasks)
            self._doubt_only(self._doubted & self._kept)
            for task in sorted((new & self._foreign) - self._matching - self._lives.keys()):
                for life in sorted(self._tokens.get(task, ())):
                    if self.supervisor is not None:
                        self._tell(self.supervisor, task, life, is_ready=True, reason="its token")

    def life_of(self, task: TaskId) -> int:
        """The running process's incarnation, 0 when none runs."""
        with self._lock:
            return self._lives.get(task, 0)

    def why_not_ready(self, task: TaskId) -> str:
        """What its worker lacks, for an operator."""
        if (lost := self._lost.get(task)) is not None:
            return lost
        if task not in self._matching:
            return self._no_token(task)
        match = self._matches.get(task)
        missing = match.missing if match is not None else ""
        return f"{missing or 'nobody is seen to subscribe to all its inputs'}; {OTHER_NETWORK}"

    def _no_token(self, task: TaskId) -> str:
        """The key that it should be at, and one of the task that is at another: a worker by hand has an error there."""
        key = self._keys.worker(self._node, task, self._lives.get(task) or "NUMBER")
        stray = self._strays.get(task)
        if stray is None:
            return f"{NO_TOKEN} {key}"
        return f"its token ends in /{stray}, and should be {key} ($ZSCHED_INCARNATION)"

    def begin(self) -> None:
        """Say what is missing of the workers that somebody else starts; the relay says it of those seen by matching."""
        self._kept = frozenset(self.sessions)
        self._say_missing(self._foreign - self._matching)

    def _say_missing(self, tasks: frozenset[TaskId]) -> None:
        for task in sorted(tasks):
            if task in self.sessions:
                key = self._keys.worker(self._node, task, "NUMBER")
                reason = f"no token {key}: {self._start_it(task)}; without zsched.worker say `ready: matching`"
                self._post(ev.WorkerChanged(task=task, state=WorkerState.STOPPED, reason=reason))

    # --- the relay's handle ------------------------------------------------------------------------------------------

    def on_relay_started(self) -> None:
        """A relay runs: workers that join it in the next moments may have been there before it."""
        self._relay_at = monotonic_s()
        if self.supervisor is not None:
            self.supervisor.regain_sight(MISSED_S)
        with self._lock:
            self._relays += 1
            guarded(self._miss, self._relays, name="zsched missed", is_lasting=False).start()

    def _miss(self, relay: int) -> None:
        """Who was ready and does not come to this relay is not ready any more: what it never saw, it never sees go."""
        threading.Event().wait(MISSED_S)
        with self._lock:
            if relay != self._relays:  # it has ended since
                return
            for task in sorted(self._seen - self._lost.keys() - self._matching):
                life, tokens = self._lives.get(task), self._tokens.get(task, set())
                is_there = bool(tokens) if life is None else life in tokens
                supervisor = self._supervisor_of(task)
                if not is_there and supervisor is not None:
                    self._tell(supervisor, task, life or 0, is_ready=False, reason=UNSEEN)

    def on_relay_ended(self) -> None:
        """No relay runs: the next one tells anew whom it sees, some of them before it says that it runs."""
        with self._lock:
            self._relays += 1
            self._tokens.clear()
            self._matches.clear()
        if self.supervisor is not None:
            self.supervisor.lose_sight()

    def on_token(self, seen: WorkerSeen) -> None:
        """A token of a worker here; one of a process that has ended says nothing (its end was reported)."""
        task, is_present = seen.task, seen.is_present
        life = counter(seen.incarnation)
        if life is None:
            return
        with self._lock:
            self._note(task, life, is_present=is_present)
            supervisor = self._supervisor_of(task)
            if supervisor is None or task in self._matching:
                return
            current = self._lives.get(task)
            if current is None or life == current:
                reason = "its token" if is_present else "its token went"
                self._tell(supervisor, task, life, is_ready=is_present, reason=reason)
            elif is_present:
                self._strays[task] = seen.incarnation
            elif self._strays.get(task) == seen.incarnation:
                del self._strays[task]

    def _note(self, task: TaskId, life: int, *, is_present: bool) -> None:
        lives = self._tokens.setdefault(task, set())
        (lives.add if is_present else lives.discard)(life)
        if not lives:
            del self._tokens[task]

    def on_matched(self, match: WorkerMatched) -> None:
        """Somebody takes what goes to a worker here, or nobody does."""
        task = match.task
        supervisor = self._supervisor_of(task)
        if supervisor is None or task not in self._matching:
            return
        with self._lock:
            self._matches[task] = match
            self._doubt(match)
            life = self._lives.get(task, 0)
            if life or task in self._foreign:  # without its process no matching subscriber is the worker
                self._tell(supervisor, task, life, is_ready=match.is_matched, reason=match.missing)

    def on_trouble(self, trouble: WorkerTrouble) -> None:
        """A worker here says that its callbacks raise, for one; of a process that has ended that is no news."""
        with self._lock:
            if self._is_of(trouble.task, trouble.incarnation):
                task, count, text = trouble.task, trouble.count, trouble.text
                self._post(ev.WorkerTroubled(task=task, count=count, text=text, is_cold=trouble.is_cold))

    def is_ours(self, jobs: ev.WorkerJobs) -> bool:
        """Whether that is the word of a worker that runs here, or of one that somebody else started."""
        with self._lock:
            return self._is_of(jobs.task, jobs.incarnation)

    def _is_of(self, task: TaskId, incarnation: str) -> bool:
        """Whether that is the running process' life, or somebody else's worker's (under the lock)."""
        current = self._lives.get(task)
        return current is None or str(current) == incarnation

    def _supervisor_of(self, task: TaskId) -> WorkerSupervisor | None:
        """The supervisor, if it has a worker of the task, or will have one as soon as its thread has heard of it.

        Its thread may hear of a new task later than the relay, which tells once what it sees.
        """
        supervisor = self.supervisor
        is_known = supervisor is not None and (task in self._kept or task in supervisor.states())
        return supervisor if is_known else None

    def _doubt(self, match: WorkerMatched) -> None:
        """Say that nothing is certain where no process of ours would show a worker's end either."""
        is_unknown = match.is_matched and not match.is_certain and match.task in self._foreign
        self._doubt_only(self._doubted | {match.task} if is_unknown else self._doubted - {match.task})

    def _doubt_only(self, tasks: frozenset[TaskId]) -> None:
        """Tell of these that nothing is certain, and of no others any more."""
        before, self._doubted = self._doubted, tasks
        for task in sorted(before ^ tasks):
            self._post(ev.ProblemReported(source=f"worker/{task}", problem=OTHERS if task in tasks else None))

    def _tell(self, supervisor: WorkerSupervisor, task: TaskId, life: int, *, is_ready: bool, reason: str) -> None:
        (supervisor.mark_ready if is_ready else supervisor.mark_gone)(task, life)
        if is_ready:
            if task in self._foreign:
                self._look_what_it_has_read(task, life)
            self._seen.add(task)
            self._lost.pop(task, None)
            self._post(ev.WorkerChanged(task=task, state=WorkerState.READY, reason=reason))
            return
        is_ours, trouble = task in self._lives, Trouble.NONE
        if is_ours and (again := self._why_again(task)):
            trouble, reason = Trouble.AGAIN, again if reason in again else f"{again}; now {reason}"
        if task in self._seen and not (is_ours and supervisor.states().get(task) is WorkerState.STOPPED):
            trouble, reason = Trouble.LOST, self._lost.setdefault(task, self._not_any_more(task, reason))
        elif task in self._foreign:
            reason = f"{reason}: {self._start_it(task)}"
        state = WorkerState.STARTING if is_ours else WorkerState.STOPPED
        self._post(ev.WorkerChanged(task=task, state=state, trouble=trouble, reason=reason))

    def _look_what_it_has_read(self, task: TaskId, life: int) -> None:
        """Whether somebody else's worker, which is there, goes on with a session of before; say so, or take it back."""
        if self.sessions_read is None:
            return
        lack = self.sessions_read.seen(task, life, is_new=self._has_started_since(task, life, self.sessions_read))
        if not lack and task not in self._outdated:
            return
        reason = ""
        if lack:
            what = "seems to run since before its session changed"
            reason = f"{what}: {self._start_it(task, 'start it again')}; it lacks {lack}"
            _log.warning("task=%s the worker %s", task, reason)
        (self._outdated.add if lack else self._outdated.discard)(task)
        self._post(ev.WorkerOutdated(task=task, reason=reason))

    def _has_started_since(self, task: TaskId, life: int, read: SessionsRead) -> bool:
        """Whether somebody else's worker has started since this daemon did.

        By the number of its life, or because it was not there although it would have joined the relay long ago.
        """
        before = read.life(task)
        if life and before and life != before:
            return True
        was_away = task in self._lost or (task not in self._seen and not (life and before))
        return was_away and monotonic_s() - self._relay_at >= REJOIN_S

    def _not_any_more(self, task: TaskId, what: str) -> str:
        since = f"was ready until {wall_time()[11:19]} UTC, {what}"
        if task in self._foreign:
            return f"{since}: it has ended, hangs or is frozen; {self._start_it(task, 'start it again')}"
        pid = None if self.supervisor is None else self.supervisor.pids().get(task)
        return f"{since}: it may hang, be frozen or cut off; see its log{'' if pid is None else f' and process {pid}'}"

    def _start_it(self, task: TaskId, do: str = "start it") -> str:
        """Of a worker that somebody else starts: that the operator starts it, and with what."""
        session = self.sessions.get(task) or f"{self._node}-{task}.zenoh.json5"
        return f"{do} on {self._node} (the task has no `command`) with the session {session}"

    # --- the supervisor ----------------------------------------------------------------------------------------------

    def on_started(self, task: TaskId, pid: int, incarnation: int) -> None:
        """The supervisor: a worker process runs; it is not ready yet."""
        with self._lock:
            if task in self._foreign:
                return  # the supervisor has not heard yet that its `command` went, and is about to
            self._lives[task] = incarnation
            self._forget(task)
            again = self._why_again(task)
            longer = f"{again}; now it is pid {pid}" if again else f"pid {pid}"
            reason, trouble = longer if len(longer) <= MAX_REASON else again, Trouble.AGAIN if again else Trouble.NONE
            self._post(ev.WorkerChanged(task=task, state=WorkerState.STARTING, trouble=trouble, reason=reason))
            match = self._matches.get(task)
            if match is not None and match.is_matched and self.supervisor is not None:
                self._tell(self.supervisor, task, incarnation, is_ready=True, reason="it matches already")
            elif incarnation in self._tokens.get(task, ()) and self.supervisor is not None:
                self._strays.pop(task, None)  # a program that starts in no time is seen before we hear of its start
                self._tell(self.supervisor, task, incarnation, is_ready=True, reason="its token")

    def on_exited(self, task: TaskId, incarnation: int, returncode: int, reason: str) -> None:
        """The supervisor: a worker process has ended."""
        again = self._why_again(task)
        trouble, detail = Trouble.AGAIN if again else Trouble.NONE, again or reason or f"exit code {returncode}"
        with self._lock:
            if self._lives.get(task) == incarnation:
                self._lives[task] = 0
                self._forget(task)
                self._post(ev.WorkerChanged(task=task, state=WorkerState.STOPPED, trouble=trouble, reason=detail))

    def _why_again(self, task: TaskId) -> str:
        return "" if self.supervisor is None else self.supervisor.why_again(task)

    def _forget(self, task: TaskId) -> None:
        self._seen.discard(task)
        self._lost.pop(task, None)

    def on_failed(self, task: TaskId, reason: str) -> None:
        """The supervisor: the worker is not started again."""
        self._post(ev.WorkerChanged(task=task, state=WorkerState.FAILED, reason=reason))

    def on_compared(self, task: TaskId, *, is_old: bool) -> None:
        """The supervisor: the worker's process runs by an old recipe, or does not any more."""
        self._post(ev.RecipeCompared(task=task, is_old=is_old))

    def on_reset(self, task: TaskId) -> None:
        """The supervisor: the worker may be started again."""
        self._post(ev.WorkerChanged(task=task, state=WorkerState.STOPPED, reason="its failures are forgotten"))

    def on_stopped(self, task: TaskId) -> None:
        """The supervisor: the worker, which had ended, is not started again."""
        self._post(ev.WorkerChanged(task=task, state=WorkerState.STOPPED, reason="stopped before its next start"))
