"""One development run: starts the nodes, tells what happens to the tasks, restarts workers, obeys keys, ends.

Knows: the order of a run, what each key does. Does not know: where the fleet file comes from, how lines
are shown.
"""

from __future__ import annotations

import os
import re
import selectors
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import IO, Final

from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.core.values.fleet import Standby
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.problems import Problem, of_kind
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import shown
from zsched.host.clock import monotonic_s
from zsched.host.latch import Latch
from zsched.tools.dev.nodes import Json, Nodes
from zsched.tools.dev.terminal import Keys
from zsched.tools.dev.watch import Watched

TICK_S: Final = 0.1
LOOK_S: Final = 0.5
WATCH_S: Final = 1.0
AWAY_S: Final = 5.0
"""How long a node that was killed stays away."""
TELLS_S: Final = 2.0
"""After a restart: how long a status may still tell of the worker before."""
LASTING_S: Final = 5.0
"""A problem is told once it has lasted for so long: a start, a move and a kill make shorter ones."""
NUMBER: Final = re.compile(r"\b\d[\d.]*")
KEPT_LINES: Final = 8
READ_BYTES: Final = 65_536
WORKER: Final = "zsched.worker"
ENDED: Final = re.compile(
    r"worker_(?:ended|failed) task=(?P<task>\S+) failures=(?P<count>\d+)(?: restart_in_s=(?P<wait>[\d.]+))? "
    r"reason=(?P<quote>['\"])(?P<reason>.*)(?P=quote)"
)
KEYS: Final = "m moves the task, k kills its owner, l loads its owner, s shows the status, q ends"


class Rollout(Struct, kw_only=True):
    """The restart of one task's workers: standbys first, and the owner's only if they become ready."""

    waiting: deque[NodeId]
    node: NodeId | None = None
    pid: int | None = None
    """Of the worker before."""
    since: float = 0.0


class Log(Struct, kw_only=True):
    """A daemon's log as it comes."""

    node: NodeId
    pipe: IO[bytes]
    partial: bytes = b""
    last: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT_LINES))


class Lasting:
    """Problems as they come and go: each is told once when it has lasted, and again when it comes back."""

    def __init__(self) -> None:
        self._since: dict[str, float] = {}
        self._told: set[str] = set()

    def told(self, problems: Iterable[str], now: float) -> list[str]:
        """Those that are to be told now of ``problems``, all that there are; a count that rises makes no new one."""
        here = {NUMBER.sub("#", text): text for text in problems}
        self._since = {kind: self._since.get(kind, now) for kind in here}
        self._told &= here.keys()
        due = [kind for kind, at in self._since.items() if now - at >= LASTING_S and kind not in self._told]
        self._told.update(due)
        return [here[kind] for kind in due]


class Run:
    """The loop of one run. ``say`` takes a line, ``show`` a status; ``stop`` ends it."""

    def __init__(
        self,
        nodes: Nodes,
        watched: Watched,
        *,
        say: Callable[[str], None],
        show: Callable[[Json], None],
        stop: Latch,
        is_verbose: bool = False,
    ) -> None:
        self._nodes, self._watched = nodes, watched
        self._say, self._show, self._stop = say, show, stop
        self._is_verbose = is_verbose
        self._specs = {task.name: task for task in nodes.fleet.tasks}
        self._task = next(iter(self._specs))
        self._owners: dict[TaskId, tuple[NodeId | None, int]] = {}
        self._start_at: dict[NodeId, float] = {}
        self._logs: dict[NodeId, Log] = {}
        self._failed: set[tuple[NodeId, TaskId]] = set()
        self._rollouts: dict[TaskId, Rollout] = {}
        self._status: Json | None = None
        self._lasting = Lasting()
        self._is_over = False
        self._code = EXIT_OK
        self._selector = selectors.DefaultSelector()

    def run(self, keys: Keys) -> int:
        """Run until somebody ends it; the exit code."""
        with self._selector:
            if keys.is_there:
                self._selector.register(keys.descriptor, selectors.EVENT_READ, keys)
            for node in self._nodes.names:
                self._start(node)
            next_look = next_watch = monotonic_s()
            while not self._is_over and not self._stop.is_set():
                for key, _ in self._selector.select(TICK_S):
                    self._hear(key)
                now = monotonic_s()
                self._reap(now)
                if now >= next_look and not self._is_over:
                    next_look = now + LOOK_S
                    self._look(now)
                if now >= next_watch:
                    next_watch = now + WATCH_S
                    self._watch()
        return self._code

    # --- what comes in -----------------------------------------------------------------------------------------------

    def _start(self, node: NodeId) -> None:
        self._logs[node] = Log(node=node, pipe=self._nodes.start(node))
        self._selector.register(self._logs[node].pipe, selectors.EVENT_READ, self._logs[node])

    def _close_log(self, node: NodeId) -> None:
        """Take what is left in the log of a daemon that has ended."""
        log = self._logs[node]
        if not log.pipe.closed:
            self._read(log)
        if not log.pipe.closed:
            self._selector.unregister(log.pipe)
            log.pipe.close()

    def _hear(self, key: selectors.SelectorKey) -> None:
        if isinstance(key.data, Keys):
            pressed = key.data.read()
            if not pressed:
                self._selector.unregister(key.fileobj)
            for one in pressed:
                self._obey(one)
            return
        self._read(key.data)

    def _read(self, log: Log) -> None:
        try:
            chunk = os.read(log.pipe.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        if not chunk:
            self._selector.unregister(log.pipe)
            log.pipe.close()
            return
        *lines, log.partial = (log.partial + chunk).split(b"\n")
        for line in lines:
            self._pass_on(log, line.decode(errors="replace"))

    def _pass_on(self, log: Log, line: str) -> None:
        """A worker's own lines, and what is wrong with workers; everything where the user wants it."""
        log.last.append(line)
        level, name, text = _parts(line)
        if self._is_verbose:
            self._say(f"{log.node} | {line}")
        elif text.startswith("worker_ended ") and any(one.node == log.node for one in self._rollouts.values()):
            return  # we have ended it; one that fails again and again is reported when it has failed for good
        elif name.startswith(f"{WORKER}.") or (name == WORKER and level in ("WARNING", "ERROR")):
            self._say(_of_a_worker(log.node, text))

    def _reap(self, now: float) -> None:
        """Take notice of daemons that have ended, and start those whose time has come."""
        for node, (code, was_asked) in self._nodes.ended().items():
            self._close_log(node)
            if not was_asked:
                self._say(f"{node} has ended by itself with {code}; its last lines:")
                for line in self._logs[node].last:
                    self._say(f"{node} | {line}")
                self._code, self._is_over = EXIT_FAILED, True
                return
            self._start_at.setdefault(node, now)
        for node in [node for node, at in self._start_at.items() if now >= at and not self._nodes.is_up(node)]:
            del self._start_at[node]
            self._say(f"{node} starts again")
            self._start(node)

    # --- messages ---------------------------------------------------------------------------------------------------

    def _look(self, now: float) -> None:
        status = self._nodes.status()
        if status is None:
            return
        self._status = status
        for task in status["tasks"]:
            self._tell_owner(task)
        for node in status["nodes"]:
            for worker in node["workers"]:
                self._tell_worker(node["name"], worker["task"], worker["state"])
        for problem in self._lasting.told(self._problems(status), now):
            self._say(problem)
        for task, rollout in tuple(self._rollouts.items()):
            self._roll_on(task, rollout, status, now)

    def _tell_owner(self, task: Json) -> None:
        name, now = task["name"], (task["owner"], task["epoch"])
        before = self._owners.get(name)
        if before is not None and now[1] <= before[1]:
            return  # the same, or a node that has just started and learns what has been
        if now[0] is None:
            return
        self._owners[name] = now
        reason = next((past["reason"] for past in task["history"] if past["epoch"] == now[1]), "")
        where = f"{before[0]} -> {now[0]}" if before else f"on {now[0]}"
        self._say(f"{name}: {where} (epoch {shown(now[1])}{': ' if reason else ''}{reason})")

    def _tell_worker(self, node: NodeId, task: TaskId, state: str) -> None:
        if state == "failed" and (node, task) not in self._failed:
            self._failed.add((node, task))
            retry = f"mend it, then `zsched restart {task} {node} --runtime-dir {self._nodes.folder} --node {node}`"
            again = "mend it and save it, and it is started again" if self._watched.files.get(task) else retry
            self._say(f"{task}: its worker on {node} has failed; {again}")
        elif state == "ready":
            self._failed.discard((node, task))

    def _problems(self, status: Json) -> Iterator[str]:
        """What the tasks' status calls wrong, but for workers that have failed: these have lines of their own."""
        for task in status["tasks"]:
            failed = of_kind(task, Problem.WORKER_FAILED)
            yield from (f"{task['name']}: {text}" for text in task["problems"] if text not in failed)

    # --- workers that have changed -----------------------------------------------------------------------------------

    def _watch(self) -> None:
        for task, file in self._watched.changed().items():
            owner = self._owner(task)
            standbys = [node for node in self._specs[task].candidates if node != owner]
            self._rollouts[task] = Rollout(waiting=deque([*standbys, *([owner] if owner else [])]))
            self._say(f"{task}: {file} was saved; its workers start again, the owner's last")

    def _roll_on(self, task: TaskId, rollout: Rollout, status: Json, now: float) -> None:
        """Restart the next worker once the one before is ready."""
        if rollout.node is not None:
            state, pid = _worker_state(status, rollout.node, task), self._nodes.worker(rollout.node, task)
            is_told = now >= rollout.since + TELLS_S
            is_ready = is_told and state == "ready" and pid not in (None, rollout.pid)
            is_late = now >= rollout.since + self._specs[task].worker.start_deadline_s
            if not is_ready and not is_late and not (is_told and state == "failed"):
                return
            if not is_ready:
                del self._rollouts[task]
                kept = ", ".join(rollout.waiting)
                left = f"; {kept} keeps the worker that it has" if kept else ""
                why = f"{state or 'not there'} after {now - rollout.since:.0f} s"
                self._say(f"{task}: the new worker is not ready on {rollout.node} ({why}){left}")
                return
            rollout.node = None
        while rollout.waiting and not self._has_worker(rollout.waiting[0], task, status):
            rollout.waiting.popleft()  # it will start with the new file anyway
        if not rollout.waiting:
            del self._rollouts[task]
            self._say(f"{task}: every worker runs what was saved")
            return
        node = rollout.waiting.popleft()
        rollout.node, rollout.pid, rollout.since = node, self._nodes.worker(node, task), now
        self._nodes.restart_worker(node, task)

    def _has_worker(self, node: NodeId, task: TaskId, status: Json) -> bool:
        """Whether there is one to start again: a node may be away, and a cold standby has none."""
        is_there = self._nodes.worker(node, task) is not None or _worker_state(status, node, task) == "failed"
        return is_there and self._nodes.is_up(node)

    # --- keys --------------------------------------------------------------------------------------------------------

    def _obey(self, key: str) -> None:
        if key == "q":
            self._is_over = True
        elif key == "s":
            self._show_status()
        elif key == "t" and len(self._specs) > 1:
            names = list(self._specs)
            self._task = names[(names.index(self._task) + 1) % len(names)]
            self._say(f"keys are for {self._task} now")
        elif key in ("m", "k", "l"):
            self._obey_on_owner(key)
        elif key.isprintable() and not key.isspace():
            self._say(f"keys: {KEYS}" + ("; t chooses the task" if len(self._specs) > 1 else ""))

    def _show_status(self) -> None:
        status = self._nodes.status()
        if status is None:
            self._say("no node answers yet")
        else:
            self._show(status)

    def _obey_on_owner(self, key: str) -> None:
        owner = self._owner(self._task)
        loaded = self._nodes.loaded()
        if key == "l" and loaded:
            for node in loaded:
                self._nodes.unload(node)
            self._say(f"load: ended on {', '.join(loaded)}")
        elif owner is None:
            self._say(f"{self._task} has no owner yet")
        elif key == "l":
            count = self._nodes.load(owner)
            self._say(f"load: {count} busy processes on {owner}; l ends them")
        elif not self._nodes.is_up(owner):
            self._say(f"{owner} is on its way out already")
        elif key == "m" and (why := self._why_no_other(owner)):
            self._say(f"move: {self._task} stays on {owner}: {why}")
        elif key == "m":
            self._nodes.stop(owner)
            self._say(f"move: {owner} is told to stop, hands {self._task} over, and starts again")
        else:
            self._start_at[owner] = monotonic_s() + AWAY_S
            self._nodes.kill(owner)
            self._say(f"kill: {owner} is dead, daemon, relay and worker; it starts again in {AWAY_S:g} s")

    def _why_no_other(self, owner: NodeId) -> str:
        """What keeps every other candidate from the task, if none has a worker that is ready."""
        others = [node for node in self._specs[self._task].candidates if node != owner]
        if not others:
            return "it has no other candidate"
        is_cold = self._specs[self._task].worker.standby is Standby.COLD
        fit = ("ready", "stopped") if is_cold else ("ready",)
        told = []
        for node in others:
            state = _worker_state(self._status, node, self._task) if self._status and self._nodes.is_up(node) else ""
            if state in fit:
                return ""
            told.append(f"the worker on {node} is {state or 'away'}")
        return ", ".join(told)

    def _owner(self, task: TaskId) -> NodeId | None:
        return self._owners.get(task, (None, 0))[0]


def _of_a_worker(node: NodeId, text: str) -> str:
    """What a daemon's log tells of a worker, in words; a line of the worker's own as it is, behind its node."""
    match = ENDED.fullmatch(text)
    if match is None:
        return f"{node} | {text}"
    again = "" if match["wait"] is None else f"; it is started again after {float(match['wait']):.1f} s"
    return f"{match['task']}: its worker on {node} has ended, failure {match['count']}: {match['reason']}{again}"


def _parts(line: str) -> tuple[str, str, str]:
    """(level, logger, text) of a daemon's log line, which begins with day and time; of any other line the text."""
    words = line.split(" ", 4)
    if len(words) < 5 or words[2] not in ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"):
        return "", "", line
    return words[2], words[3], words[4]


def _worker_state(status: Json, node: NodeId, task: TaskId) -> str:
    workers: list[Json] = next((one["workers"] for one in status["nodes"] if one["name"] == node), [])
    return next((str(one["state"]) for one in workers if one["task"] == task), "")
