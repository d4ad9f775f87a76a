"""The library of an application that has its streams itself: no relay between it and the owner's worker.

Knows: the application's keys and callbacks, the session that workers dial, what the relay tells of the plans. Does not
know: how a stream keeps its promises (`zsched.relay.task` and below, which run here as they do in a relay).

    with Streams.join() as streams:
        streams.subscribe("robot1/plan", on_plan)
        jobs = streams.publisher("robot1/jobs")
        jobs.put(b"...")

The keys are those of the fleet file, as with a session that is the relay's client. What this process puts goes to the
owner's worker by a link of its own, and to nobody else; what others publish under the same key goes by the relay, as
before. So a sample goes one way only, and nothing has to be handed over when an application starts or ends.

Without a relay (it has died, the daemon is stopped) everything goes on as it was for `ALONE_S`, then the slots close.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, cast

import zenoh
from zenoh import Sample

from zsched.clock import monotonic_s
from zsched.core.events import ProblemReported, SlotDrained, SlotReady, StreamsCounted
from zsched.core.relay_protocol import RelayReport, SlotLost, TaskEnded, WorkerWatch
from zsched.core.route.keyexpr import fault, includes, is_wild
from zsched.core.values.model import MAX_REASON, TaskId
from zsched.core.values.plan import RoutePhase, RoutePlan
from zsched.errors import AdapterError
from zsched.guard import all_end_within, call_plain, ends_within, guarded, running
from zsched.ipc.protocol import DaemonGone, StreamKeys, StreamsTaken
from zsched.latch import Latch
from zsched.log_limit import limit_library
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.given import PLAIN, Given
from zsched.relay.streams.inputs import InputStream
from zsched.relay.tokens import Tokens
from zsched.sessions.closing import APPLICATION_CLOSE_S
from zsched.sessions.config import lease_s
from zsched.sessions.link_sockets import opened
from zsched.sessions.problems import why_not_open
from zsched.sessions.puts import Payload, put_arguments
from zsched.stream.link import Link, RefusedError, place_of
from zsched.stream.samples import Received
from zsched.stream.task import OwnTask
from zsched.wire.keyspace import Keyspace

COUNT_S: Final = 1.0
"""Period of the counters."""
AGAIN_S: Final = 0.2
"""A relay that is gone is looked for this often."""
ALONE_S: Final = 10.0
"""Without a relay the newest plans hold for this long."""
KNOWN_S: Final = 5.0
"""A key is known to be a stream's within this time of joining, also while the daemon starts."""
FED_S: Final = 1.0
"""A stream whose task has an owner leads there within this time; what is put before would be without a way."""
FREED_S: Final = 1.0
"""An application that has just ended is gone from its place within this time."""
FINISH_S: Final = 2.0
"""What was put is processed within this time of `Streams.close`, or counted as at most lost."""
ALIVE_S: Final = 1.0
"""Who waits for the thread that closes looks this often whether there is one: not in a process that was forked off."""
LOOK_S: Final = 0.01
MAX_KINDS: Final = 32
JOIN_S: Final = 0.3

_log = logging.getLogger("zsched.streams")

_Inputs = tuple[InputStream, ...]


class _Here(threading.local):
    """Says of each thread whether it is in a callback, or in a call of ours that a signal may interrupt (``with``).

    Closing waits for that, so that it must wait for no closing.
    """

    _depth = 0

    def __enter__(self) -> None:
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1

    @property
    def is_inside(self) -> bool:
        """Whether this thread is."""
        return self._depth > 0


class Publisher:
    """One key of the application that inputs of tasks take; `put` from any thread."""

    def __init__(self, key: str, inputs: Callable[[], _Inputs], closing: Latch, here: _Here) -> None:
        """``inputs`` are those of all tasks as they are now."""
        self.key = key
        self._inputs, self._closing, self._here = inputs, closing, here
        self._found: tuple[_Inputs, _Inputs] = ((), ())
        """(All inputs there were, those of them that take our key)."""

    def put(
        self,
        payload: Payload,
        *,
        attachment: Payload | None = None,
        encoding: zenoh.Encoding | str = PLAIN,
        timestamp: zenoh.Timestamp | None = None,
    ) -> bool:
        """Put one sample on its way to the owner; ``False``: it went nowhere (streams closed, or the rule is gone).

        Where several rules take the key it goes to the owner of each, as from a client of the relay. Class ``reliable``
        waits while the queue towards the owner is full, and once for a link that has become full.

        Raises:
            TypeError: an argument is of another type.
        """
        sent, attached, encoded, stamp = put_arguments(payload, attachment, encoding, timestamp)
        given = Given(self.key, sent, encoded or PLAIN, attached, stamp)
        with self._here:
            return self._give(given)

    def _give(self, given: Given) -> bool:
        streams = self._streams()
        missed = [stream for stream in streams if not self._give_to(stream, given)]
        if streams and not missed:
            return True
        # what has closed since we looked may have another place
        tasks = {_task_of(stream) for stream in missed}
        others = [stream for stream in self._streams() if stream not in streams]
        heirs = [stream for stream in others if not streams or _task_of(stream) in tasks]
        has_heir = [self._give_to(stream, given) for stream in heirs]
        return any(has_heir) or len(missed) < len(streams)

    def _give_to(self, stream: InputStream, given: Given) -> bool:
        return not self._closing.is_set() and stream.give(cast("Sample", given))

    def _streams(self) -> _Inputs:
        """The inputs that take our key: rules may change their places, tasks may come, and come again."""
        there = self._inputs()
        if there != self._found[0]:
            self._found = there, tuple(one for one in there if includes(one.route.from_expr, self.key))
        return self._found[1]


def _task_of(stream: InputStream) -> TaskId:
    return stream.route.stream.partition("/")[0]


class Streams:
    """An application's part of its robot's streams. A context manager: leaving it ends them in order."""

    def __init__(self, path: Path, link: Link) -> None:
        """Open the session at which workers dial us; `join` is the usual way.

        Raises:
            AdapterError: the session cannot be opened.
        """
        limit_library()
        self._threads_before = running()
        self.node = link.node
        self._path, self._link = path, link
        self._config = link.session
        try:
            self._session = opened(link.session, is_guest=True)
        except (zenoh.ZError, ValueError) as error:
            link.hang_up()
            raise AdapterError(f"the streams' session {why_not_open(link.session, error)}") from error
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._keys: tuple[str, ...] = ()
        self._taken: frozenset[str] = frozenset()
        self._callbacks: tuple[tuple[str, Callable[[Received], None]], ...] = ()
        self._tasks: dict[TaskId, OwnTask] = {}
        self._drained: deque[SlotDrained] = deque(maxlen=64)
        """Said again to the next relay, which would wait for it."""
        self._closing, self._closed = Latch(), Latch()  # which a signal's handler sets, and waits for
        self._telling = threading.Lock()
        self._problems: dict[str, str] = {}
        """{task: what is wrong with its streams here}; of none: of the session."""
        keyspace = Keyspace(link.fleet)
        self._acks = Acks(
            self._session, keyspace, link.node, self._has_worker, lease_s(link.session), is_application=True
        )
        self._tokens = Tokens(self._session, keyspace, lambda _seen: None, lambda _node, _ended: None, self._wake)
        self._here = _Here()
        self._raised: set[tuple[str, str]] = set()
        self._is_hasty = False
        """Closing waits for nothing any more."""
        self._left = threading.Event()
        """The last counters are told: no relay is looked for any more."""
        self._is_counted = True
        """The relay that is there knows our streams, and takes their counters."""
        self._thread = guarded(self._run, name="zsched streams")
        self._thread.start()
        guarded(self._count, name="zsched counters").start()
        self._closer = guarded(self._end, name="zsched close", is_lasting=False)
        self._closer.daemon = False  # no interpreter ends in the middle of it
        self._closer.start()

    @classmethod
    def join(
        cls,
        *,
        node: str = "",
        runtime_dir: Path | None = None,
        wait_s: float = 10.0,
        env: Mapping[str, str] = os.environ,
    ) -> Self:
        """Join this machine's node, waiting at most ``wait_s`` for its relay.

        ``node`` says which where the machine has several (``ZSCHED_NODE`` too); ``runtime_dir`` is the daemon's.

        Raises:
            AdapterError: there is no such relay, another application has the streams, or the session cannot be opened.
        """
        began = monotonic_s()
        while True:
            try:
                path = place_of(runtime_dir, node or env.get("ZSCHED_NODE", ""), env)
                return cls(path, Link(path, ()))
            except AdapterError as error:
                is_refused = isinstance(error, RefusedError)
                if monotonic_s() - began >= (FREED_S if is_refused else wait_s):
                    raise
            time.sleep(AGAIN_S)

    # --- what an application does ------------------------------------------------------------------------------------

    def publisher(self, key: str) -> Publisher:
        """A key that an input of a task takes, such as ``robot1/jobs``.

        Raises:
            ValueError: it is no key without wildcards, no input rule of this robot takes it, or there are 256 already.
            AdapterError: the streams are closed.
        """
        self._check_open()
        if (wrong := fault(key)) is not None or is_wild(key):
            raise ValueError(f"{key!r} is no key that can be published: {wrong or 'it has wildcards'}")
        with self._here:
            return self._publisher(key)

    def _publisher(self, key: str) -> Publisher:
        self._name(key)
        until = monotonic_s() + KNOWN_S
        while monotonic_s() < until and not self._closing.is_set():
            is_told = key in self._taken  # behind the plans
            if is_told and any(includes(one.route.from_expr, key) for one in self._inputs()):
                fed_by = monotonic_s() + FED_S
                for task in tuple(self._tasks.values()):
                    task.wait_fed(key, fed_by)
                return Publisher(key, self._inputs, self._closing, self._here)
            time.sleep(LOOK_S)
        self._check_open()
        self._forget(key)
        raise ValueError(f"no input rule takes {key!r} on {self.node}: see `inputs` of the fleet file's tasks (`from`)")

    def subscribe(self, key_expr: str, on_sample: Callable[[Received], None]) -> None:
        """Take the answers under a key that an output of a task has, such as ``robot1/plan``.

        Call it before `publisher`: a worker that is greeted for a ``reliable`` input knows this subscription by then.
        ``on_sample`` runs in a thread of the output, one answer after another; what it raises is logged.

        Raises:
            ValueError: it is no key expression, no output rule of this robot has it, or there are 256 keys already.
            AdapterError: the streams are closed.
        """
        self._check_open()
        if (wrong := fault(key_expr)) is not None:
            raise ValueError(f"{key_expr!r} is no key expression: {wrong}")
        with self._here:
            self._subscribe(key_expr, on_sample)

    def _subscribe(self, key_expr: str, on_sample: Callable[[Received], None]) -> None:
        with self._lock:
            self._callbacks = (*self._callbacks, (key_expr, on_sample))
        try:
            self._name(key_expr)
        except ValueError:
            with self._lock:
                self._callbacks = tuple(one for one in self._callbacks if one != (key_expr, on_sample))
            raise
        with self._changed:
            if self._changed.wait_for(lambda: key_expr in self._taken, KNOWN_S):
                return
            self._callbacks = tuple(one for one in self._callbacks if one != (key_expr, on_sample))
        self._check_open()
        self._forget(key_expr)
        raise ValueError(
            f"no output rule has {key_expr!r} on {self.node}: see `outputs` of the fleet file's tasks (`to`)"
        )

    def close(self) -> None:
        """Put the ends behind what was put, wait for it to be processed (`FINISH_S`), and close the session.

        Any thread, and more than once: each waits until they are closed. A callback does not wait, since it is waited
        for: they are closed behind it; nor does a signal's handler that interrupts another call of ours. Ctrl-C ends
        the wait, and they close at once. In a process that was forked off nothing is closed: the streams are its
        parent's.
        """
        self._closing.set()
        if self._here.is_inside:
            return
        try:
            # no join: one that is interrupted takes the thread for ended (CPython 3.11)
            while self._closer.is_alive() and not self._closed.wait(ALIVE_S):
                continue
        except BaseException:
            self._is_hasty = True
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- keys --------------------------------------------------------------------------------------------------------

    def _check_open(self) -> None:
        if self._closing.is_set():
            raise AdapterError(f"the streams of {self.node} are closed")

    def _inputs(self) -> _Inputs:
        """Of all tasks, as they are now."""
        return tuple(stream for task in tuple(self._tasks.values()) for stream in task.inputs())

    def _name(self, key: str) -> None:
        with self._lock:
            if key in self._keys:
                return
            keys = (*self._keys, key)
            StreamKeys(keys=keys)  # which raises where they are too many: no later relay would let us in
            self._keys = keys
        self._say_keys()

    def _forget(self, key: str) -> None:
        with self._lock:
            self._keys = tuple(one for one in self._keys if one != key)
        self._say_keys()

    def _say_keys(self) -> None:
        with self._telling:  # who speaks last says the newest
            self._link.say(StreamKeys(keys=self._keys, pid=os.getpid()))

    def _end(self) -> None:
        """Close when we are told to: in a thread of its own, which no signal interrupts."""
        self._closing.wait()
        tasks = tuple(self._tasks.values())
        try:
            for task in tasks:
                task.end_inputs()
            until = monotonic_s() + FINISH_S
            while not self._is_over(tasks) and monotonic_s() < until and not self._is_hasty:
                time.sleep(LOOK_S)
            for stream, left in [one for task in tasks for one in task.give_up_answers().items()]:
                _log.warning("%s: %d answers had not been handed over when the streams closed", stream, left)
            self._acks.flush()
            self._say_counts()
        finally:
            self._left.set()
            self._link.hang_up()
            self._thread.join(JOIN_S)
            for task in tuple(self._tasks.values()):
                task.end()
            ends_within(APPLICATION_CLOSE_S, self._session.close, name="zsched session")
            self._acks.stalled.close()  # till now it has ended links that held the session up
            all_end_within(JOIN_S, besides=self._threads_before)
            self._closed.set()

    def _is_over(self, tasks: tuple[OwnTask, ...]) -> bool:
        return self._is_counted and all(
            task.has_ended() and not task.under_way() and task.has_handed() for task in tasks
        )

    def _deliver(self, received: Received) -> None:
        with self._here:
            for key_expr, on_sample in self._callbacks:
                if includes(key_expr, received.key):
                    try:
                        call_plain(on_sample, received)
                    except BaseException as error:  # noqa: BLE001 - no answer and no other callback misses theirs
                        self._note_raised(key_expr, error)

    def _note_raised(self, key_expr: str, error: BaseException) -> None:
        """Log it, with its traceback when the first of its kind: it may be the same for every answer."""
        kind = (key_expr, type(error).__name__)
        is_new = kind not in self._raised and len(self._raised) < MAX_KINDS
        if is_new:
            self._raised.add(kind)
        _log.warning("the callback of %s raised %s: %s", *kind, error, exc_info=error if is_new else None)

    # --- the relay's words -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._left.is_set():
            while (word := self._link.read()) is not None:
                self._take(word)
            self._link.close()
            if not self._left.is_set():
                self._come_again()
        self._link.close()

    def _take(self, word: Any) -> None:
        if isinstance(word, StreamsTaken):
            with self._changed:
                self._taken = frozenset(word.keys)
                self._is_counted |= self._taken.issuperset(self._keys)
                self._changed.notify_all()
        elif isinstance(word, DaemonGone):
            self._lose_daemon()
        elif isinstance(word, TaskEnded):
            if (task := self._tasks.pop(word.task, None)) is not None:
                task.end()
                self._note_problem(word.task, None)
        elif isinstance(word, WorkerWatch):
            self._task(word.task).listen(word.unowned)
        elif isinstance(word, RoutePlan):
            self._task(word.task).apply(word)

    def _task(self, name: TaskId) -> OwnTask:
        task = self._tasks.get(name)
        if task is None:
            task = OwnTask(self._session, self.node, name, self._tokens, self._acks, self._report, self._deliver)
            self._tasks[name] = task
        return task

    def _lose_daemon(self) -> None:
        for task in tuple(self._tasks.values()):
            task.lose_daemon()

    def _come_again(self) -> None:
        """The relay is gone: look for the next one, and end what nobody tells us of for too long."""
        self._lose_daemon()
        self._is_counted = not self._keys
        alone_since: float | None = monotonic_s()
        _log.warning("the relay of %s is gone: its plans hold for %g s", self.node, ALONE_S)
        while not self._left.wait(AGAIN_S):
            keys = self._keys
            try:
                self._link = Link(self._path, keys)
            except AdapterError as error:
                if alone_since is not None and monotonic_s() - alone_since > ALONE_S:
                    alone_since = None
                    _log.warning("%s: nobody tells who owns what: no sample goes out until it comes", error)
                    for name, task in tuple(self._tasks.items()):
                        task.apply(RoutePlan(task=name, phase=RoutePhase.CLOSE, current=None))
                continue
            if self._keys != keys:  # they were told to the link before, meanwhile
                self._say_keys()
            text = "its session is that of an earlier configuration: start the application again"
            self._note_problem("", text if self._link.session != self._config else None, is_anew=True)
            for drained in tuple(self._drained):
                self._link.say(drained)
            _log.warning("the relay of %s is there again", self.node)
            if self._left.is_set():
                self._link.hang_up()
            return

    # --- what we say -------------------------------------------------------------------------------------------------

    def _report(self, word: RelayReport) -> None:
        """A task's word (its thread)."""
        if isinstance(word, SlotDrained):
            self._drained.append(word)
        if isinstance(word, SlotDrained | SlotLost):
            self._link.say(word)
        elif isinstance(word, ProblemReported):
            self._note_problem(word.source.removeprefix("relay/"), word.problem)
        elif isinstance(word, SlotReady) and word.has_token is not None and not word.is_ready:
            text = f"{word.task}: the application does not see the owner's worker"
            _log.warning("%s: it hangs or has ended (`zsched status`), or does not dial our `listen: {streams}`", text)
            self._note_problem(word.task, text)
        elif isinstance(word, SlotReady) and word.is_ready:
            self._note_problem(word.task, None)

    def _note_problem(self, task: str, problem: str | None, *, is_anew: bool = False) -> None:
        """Tell the relay all that is wrong now; ``is_anew``: it is another one, and knows nothing of it."""
        with self._telling:
            before = self._problems.pop(task, None)
            if problem is not None:
                self._problems[task] = problem
            if problem != before or is_anew:
                text = "; ".join(text for _, text in sorted(self._problems.items()))
                self._link.say(ProblemReported(source="", problem=text[:MAX_REASON] or None))

    def _count(self) -> None:
        while not self._closing.wait(COUNT_S):
            self._say_counts()

    def _say_counts(self) -> None:
        counts = tuple(count for task in tuple(self._tasks.values()) for count in task.counts())
        self._link.say(StreamsCounted(counts=counts))

    def _has_worker(self, node: str, task: str, incarnation: str) -> bool:
        return self._tokens.has_worker(node, task, incarnation)

    def _wake(self) -> None:
        for task in tuple(self._tasks.values()):
            task.wake()
