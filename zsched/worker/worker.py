"""The library a Python worker imports: its inputs, its epoch-stamped outputs, its role, its orderly end.

Knows: the worker's side of a handover (token, role, end markers). Does not know: what the task computes, who decides.

    with Worker.from_env() as worker:
        out = worker.publisher("{prefix}/{epoch}/global_map", latest=True)
        worker.subscribe(f"{worker.prefix}/*/map", on_map)
        worker.ready()
        while worker.wait(1.0):
            ...

Every sample goes through one dispatch thread, in order per key; zenoh's own threads only enqueue. A warm standby takes
and processes its inputs like an owner, but its outputs go nowhere (`Output.put` answers ``False``); what it took then
is processed once more when it becomes the owner. When the task moves away, each input ends with an in-band marker
behind its last sample; when all inputs seen have ended and their samples are processed, the worker sends the same
marker behind its last output: that is how the robots know that nothing is missing.

By hand, without a daemon: ``Worker.from_env(standalone="my_task")``.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from types import FrameType, TracebackType
from typing import Any, Final, Self

import zenoh

from zsched.core.hop.shared import STALLED_S
from zsched.core.route.keyexpr import fault, intersects
from zsched.core.values import codec as wire
from zsched.core.values.events import WorkerJobs
from zsched.core.values.model import as_reason
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import StreamAcks, WorkerTrouble
from zsched.host.clock import monotonic_s
from zsched.host.guard import ends_within, guarded, tolerant
from zsched.host.latch import Latch
from zsched.host.log_limit import limit_library
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end
from zsched.link.sessions.closing import ALARM_S, CLOSE_S
from zsched.link.sessions.config import lease_s, relay_endpoint
from zsched.link.sessions.stalled_links import StalledLinks
from zsched.worker.epochs import CARRY_LOOK_S, CARRY_S, Epochs, lets_out
from zsched.worker.errands import Errands
from zsched.worker.inputs import Dispatcher
from zsched.worker.jobs import Job, JobBook
from zsched.worker.keep import Debts, Keeper
from zsched.worker.keys import filled, output_key, untaken
from zsched.worker.lives import RelayLives
from zsched.worker.outputs import OUTPUT_DEPTH, Output, OutputOptions
from zsched.worker.roles import RoleWatch
from zsched.worker.samples import BY_CLASS, Input, KeepLast, Marker, Received
from zsched.worker.services import Handler, Service
from zsched.worker.snapshot import TIMEOUT_S, Offer, Restorer, StateBook, StateLink, fetch
from zsched.worker.start import open_session, surroundings
from zsched.worker.troubles import Troubles

FINISH_S: Final = 2.0
"""A worker that was told to stop does what has come, for at most so long, and until a second signal comes."""
STILL_S: Final = 0.08
"""It has all of it when nothing has come for so long: relays send nothing more once they miss its token."""
LOOK_S: Final = 0.01
MAX_REFUSALS: Final = 1024
"""Requests that may wait for being refused; of further ones their askers hear nothing but the end."""

_log = logging.getLogger("zsched.worker")


class Worker:
    """One worker process on the data network. Use it as a context manager: leaving it closes the session."""

    def __init__(
        self,
        *,
        fleet: str,
        node: str,
        task: str,
        incarnation: str,
        zenoh_config: str,
        is_standalone: bool = False,
        drains_itself: bool = False,
        deadline_s: float | None = None,
        output_keys: tuple[str, ...] = (),
    ) -> None:
        """Open the session (``zenoh_config``: JSON5 text). See `from_env` for the other arguments.

        Raises:
            ConfigError: zenoh refuses the configuration.
        """
        limit_library()
        self.prefix = f"{node}/{task}"
        self._keyspace = Keyspace(fleet)
        self._node, self._task, self._incarnation = node, task, incarnation
        self._drains_itself = drains_itself
        self._is_standalone = is_standalone
        self._lock = threading.Lock()
        idle = Role(task=task, role=WorkerRole.IDLE)
        self._role = Role(task=task, role=WorkerRole.ACTIVE, epoch=1) if is_standalone else idle
        self._epochs = Epochs()
        self._early_end = 0
        """The newest epoch whose inputs have ended although our role in it has not, or has not come yet."""
        self._stop = threading.Event()
        self._ended = Latch()
        """It was told to stop."""
        self._signals = 0
        """How often it was told to stop."""
        self._pid = os.getpid()
        self._handlers: dict[int, Any] = {}
        """{signal: what was done at it before this worker}"""
        self._has_signals = True
        """Signals end this worker; behind `close` they do what they did before."""
        self._outputs: dict[str, Output] = {}
        """{key, the epoch still a placeholder: its output}; guarded by `_lock`."""
        self._output_keys = output_keys
        self._untaken = ""
        """The report about the first output that no rule of the task takes."""
        self._is_ready = False
        self._is_closed = False
        """Nothing is put any more: what an output still took would go down with the session."""
        self._declared: list[Any] = []
        self._inputs: list[str] = []
        self._services: list[str] = []
        self._errands = Errands(self._stop)
        self._refusals: Errands | None = None
        """Requests that are refused: who asks may take nothing of that for a while, and roles must not wait for it."""
        self._token: zenoh.LivelinessToken | None = None
        self._session = open_session(zenoh_config)
        self._state_link = StateLink(self._session, zenoh_config)
        self._acks = Acknowledger(self._send_acks)
        self._debts = Debts(self._acks)
        acks_key = self._keyspace.received("*", "*", str(self._session.zid()))
        self._stalled = StalledLinks(self._session, lease_s(zenoh_config), STALLED_S)
        self._keeper = Keeper(self._session, acks_key, self._debts, self._stalled)
        self._troubles = Troubles(self._tell_trouble)
        self._jobs = JobBook(task, incarnation, self._tell_jobs, deadline_s)
        self._lives = RelayLives(self._session, self._keyspace)
        self._declared.append(self._lives)
        self._dispatcher = Dispatcher(
            self._inputs_ended, self._acks, self._troubles, self._debts, self._jobs, self._lives.is_over
        )
        self._states = StateBook()
        self._restorer = Restorer(self._fetch_snapshot, node, self._dispatcher, self._tell_cold, self._states)
        self._dispatcher.start()
        self._watch: RoleWatch | None = None
        if not is_standalone:
            key = self._keyspace.role(node, task)
            self._watch = RoleWatch(self._session, key, self._on_role, self._stop, relay_endpoint(zenoh_config))
            self._declared.append(self._watch)
            self._watch.start()

    @classmethod
    def from_env(
        cls,
        env: Mapping[str, str] = os.environ,
        *,
        standalone: str = "",
        drains_itself: bool = False,
        handles_signals: bool = True,
    ) -> Self:
        """The worker that the daemon's environment describes.

        ``standalone`` names the task of a worker started by hand: without a daemon's variables (``ZSCHED_NODE`` alone
        is a terminal's) it is then the owner on node ``local``, epoch 1, on zenoh's default session. ``drains_itself``
        says that outputs also leave outside of the input callbacks: the end markers then wait for `drained`; no input
        waits until what another thread puts has reached the robots. SIGTERM and SIGINT end `wait` (main thread only);
        behind `close`, in the main thread too, they do what they did before.

        Raises:
            ConfigError: a variable is missing, or the zenoh configuration cannot be read.
        """
        around = surroundings(env, standalone)
        worker = cls(
            fleet=around.fleet,
            node=around.node,
            task=around.task,
            incarnation=around.incarnation,
            zenoh_config=around.zenoh_config,
            is_standalone=around.is_standalone,
            drains_itself=drains_itself and not around.is_standalone,
            deadline_s=around.deadline_s,
            output_keys=around.output_keys,
        )
        if handles_signals and threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                worker._handlers[number] = signal.signal(number, worker._on_signal)
        return worker

    # --- what a worker does ------------------------------------------------------------------------------------------

    @property
    def role(self) -> Role:
        """The newest role that this node's daemon has told us; idle until it has, and while a snapshot is awaited."""
        return Role(task=self._task, role=WorkerRole.IDLE) if self._restorer.is_pending else self._role

    @property
    def session(self) -> zenoh.Session:
        """The data session, for what this library does not offer (never block in its callbacks)."""
        return self._session

    def subscribe(
        self, key_expr: str, on_sample: Callable[[Received], None], keep_last: KeepLast = BY_CLASS, depth: int = 4096
    ) -> None:
        """Take an input; call it before `ready`. ``{prefix}`` is filled in.

        ``on_sample`` runs in the dispatch thread. When it falls behind, samples wait: of an input of class ``reliable``
        all, of any other the newest per key. ``keep_last`` says otherwise: this many of the newest per key, ``None``:
        all. Of all, at most ``depth`` per key wait, then the oldest go. What goes of a ``reliable`` input, or of one
        with ``keep_last=None``, is counted `lost` in `zsched status`; of others, what gives way to something newer
        counts as processed.

        Raises:
            ValueError: ``keep_last`` or ``depth`` is below 1, the key has another placeholder, or another input of this
                worker has keys of it.
            RuntimeError: this worker is ready already.
        """
        self._check_not_ready("subscribe")
        source = Input(on_sample=on_sample, keep_last=keep_last, depth=depth)
        expr = self._taken_by_one(self._inputs, filled(key_expr, self.prefix))
        marker = tolerant(self._on_marker, "marker")
        remote = zenoh.Locality.REMOTE  # what this worker answers may have a key of its inputs
        ends = self._session.declare_subscriber(f"{expr}/{END_CHUNK}", marker, allowed_origin=remote)
        put = tolerant(partial(self._dispatcher.put, source), "input")
        data = self._session.declare_subscriber(expr, put, allowed_origin=remote)  # who sees this sees the other
        self._declared += [data, ends]

    def publisher(
        self,
        template: str,
        *,
        latest: bool = False,
        reliable: bool = False,
        keep_last: int = 1,
        depth: int = OUTPUT_DEPTH,
    ) -> Output:
        """An output; ``{prefix}`` and ``{epoch}`` are filled in, the epoch at each time this worker becomes the owner.

        ``latest``: the last ``keep_last`` values are cached for late subscribers; a put never waits, behind a stalled
        receiver the newest wait. ``reliable``: a put waits for a slow receiver (up to a lease) instead of dropping, and
        the last ``depth`` answers (at most `zsched.core.hop.shared.SHARED_BYTES`) are kept until the robots' relays
        have acknowledged them: what a broken link lost is sent again. An output that no rule of the task takes is
        logged, and shown in `zsched status` while this worker is the owner.

        The same key with the same options gives the same output again.

        Raises:
            ValueError: the key is none, or has another placeholder; it was declared with other options; ``latest`` and
                ``reliable`` are both set; ``keep_last`` or ``depth`` is below 1.
        """
        key = output_key(template, self.prefix)
        options = OutputOptions(latest=latest, reliable=reliable, keep_last=keep_last, depth=depth)
        with self._lock:
            known = self._outputs.get(key)
            if known is not None and known.options != options:
                raise ValueError(f"{template!r} is declared already, with {known.options}")
            output = self._outputs[key] = known or Output(
                self._session,
                key,
                options,
                keeper=self._keeper,
                epoch_now=self._epoch_now,
                stamp_now=self._dispatcher.stamp,
                owe=self._dispatcher.owe,
            )
        if known is None and (text := untaken(key, self._output_keys)):
            _log.warning("the worker %s", text)
            self._untaken = self._untaken or text
            if self._role.role is WorkerRole.ACTIVE:  # as in a callback: its role was told before, and does not change
                self._errands.put(lambda: self._tell_trouble(0, self._untaken))
        return output

    def serve(self, key_expr: str, handler: Handler, depth: int = 16) -> None:
        """Answer requests under a key; call it before `ready`. ``{prefix}`` is filled in.

        ``handler`` runs in a thread of its own per service, one request after another; at most ``depth`` wait, the next
        one is answered "busy". What it raises becomes an error reply. It is only called while this worker is the owner.

        Raises:
            ValueError: ``depth`` is below 1, the key has another placeholder, or another service of this worker has
                keys of it.
            RuntimeError: this worker is ready already.
        """
        self._check_not_ready("serve")
        if depth < 1:
            raise ValueError(f"depth: {depth!r} is not 1 or more")
        expr = self._taken_by_one(self._services, filled(key_expr, self.prefix))
        self._refusals = self._refusals or Errands(self._stop, "zsched refusals", MAX_REFUSALS)
        service = Service(
            self._session,
            expr,
            handler,
            is_owner=self._is_owner,
            later=self._refusals.put,
            troubles=self._troubles,
            jobs=self._jobs,
            depth=depth,
        )
        self._declared.append(service)

    def _taken_by_one(self, taken: list[str], expr: str) -> str:
        """``expr``, which is now among ``taken``: a sample goes to one callback, a request to one handler."""
        for other in taken:
            if fault(expr) is None and intersects(expr, other):
                raise ValueError(f"{expr!r} has keys of {other!r}, which is taken already: let one callback take both")
        taken.append(expr)
        return expr

    def offer_snapshot(self, snapshot: Callable[[], bytes | bytearray]) -> None:
        """Offer this worker's state to its successor, at most `MAX_SNAPSHOT` bytes; call it once, before `ready`.

        ``snapshot`` is called in a thread of its own whenever the next owner asks, usually while this one still works.

        Raises:
            RuntimeError: this worker is ready already, or offers its state already.
        """
        self._check_not_ready("offer_snapshot")
        if any(isinstance(entity, Offer) for entity in self._declared):
            raise RuntimeError("Worker.offer_snapshot a second time: the next owner takes neither of two states")
        key = self._keyspace.snapshot(self._node, self._task)
        self._declared.append(Offer(self._state_link.session, key, snapshot, self._troubles, self._states))

    def on_snapshot(self, restore: Callable[[bytes], None], timeout_s: float = TIMEOUT_S) -> None:
        """Take the predecessor's state over when this worker becomes the owner; call it once, before `subscribe`.

        ``restore`` runs in the dispatch thread before any input of the new epoch, at most ``timeout_s`` after the role
        came; until then `role` is idle. Without a snapshot it is not called.

        Raises:
            RuntimeError: this worker is ready already, or takes the state already.
        """
        self._check_not_ready("on_snapshot")
        if self._restorer.has_callback:
            raise RuntimeError("Worker.on_snapshot a second time: one callback takes the state")
        self._errands.put(self._state_link.open)  # before it is needed, not in a move
        self._dispatcher.remember(lambda: self.role.role is WorkerRole.IDLE)
        with self._lock:  # a role that comes just now is noted here or behind this, with the callback
            self._restorer.register(restore, timeout_s)
            role = self._role
            self._restorer.note(role)
        self._errands.put(lambda: self._begin(role))

    def ready(self) -> None:
        """Say that the inputs are declared: the token that the robots' relays wait for. Call it once."""
        self._is_ready = True
        self._states.ready()
        if self._is_standalone or self._token is not None:
            return
        key = self._keyspace.worker(self._node, self._task, self._incarnation)
        self._token = self._session.liveliness().declare_token(key)
        self._errands.put(self._show_now)

    def _check_not_ready(self, call: str) -> None:
        if self._is_ready:
            raise RuntimeError(f"Worker.{call} after Worker.ready: relays may send already; declare it before")

    def wait(self, timeout_s: float | None = None) -> bool:
        """Sleep at most this long; ``False`` as soon as the worker is asked to end."""
        return not self._ended.wait(timeout_s)

    def job(self, *, skipped: int = 0, came_s: float | None = None) -> Job:
        """A piece of work that is not done in a callback: ``with worker.job(): ...``, in whatever thread does it.

        The daemon hears how long jobs take, how much CPU, and how many are left undone (docs/guide/worker.md); from
        the first one on, callbacks are no jobs any more. ``skipped``: this many were left undone for this one.
        ``came_s``: when what it works on came, by ``time.monotonic``.

        Raises:
            ValueError: ``skipped`` is no whole number from 0 on, or ``came_s`` has not been: it is of another clock.
        """
        return self._jobs.job(skipped, came_s)

    def drained(self) -> None:
        """Say that everything taken so far is published (only with ``drains_itself``): ends may go out now.

        They do once `role` is draining and every input that was heard in its epoch has ended; say it again until then.
        """
        role = self._role
        is_due = self._drains_itself and role.role is WorkerRole.DRAINING
        if is_due and not self._dispatcher.has_waiting(role.epoch) and self._dispatcher.has_ended(role.epoch):
            self._send_ends(role.epoch)

    # --- the end -----------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Let `wait` answer ``False`` (any thread)."""
        self._stop.set()
        self._ended.set()

    def close(self) -> None:
        """Do what has come, then close the session within a second.

        After a signal: the process ends here when zenoh would hold it longer. Without one nothing is finished.
        """
        self.stop()
        if self._signals:
            self._finish()
        has_alarm = self._signals > 0 and threading.current_thread() is threading.main_thread()
        if has_alarm:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, ALARM_S)
        self._dispatcher.close()
        self._troubles.close()
        self._debts.settle(monotonic_s())
        self._acks.flush()  # before the session closes: what is done must not be called lost
        self._acks.close()
        self._is_closed = True
        self._keeper.close()
        for output in tuple(self._outputs.values()):
            output.close()
        for errands in (self._errands, self._refusals):
            if errands is not None:
                errands.close()
        is_closed = ends_within(CLOSE_S, self._close_session, name="zsched close")
        if not is_closed and self._signals:
            logging.shutdown()
            os._exit(0)  # a stopped peer holds zenoh's close for seconds, and its threads hold the interpreter
        if has_alarm:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        self._give_signals_back()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _close_session(self) -> None:
        for entity in self._declared:  # advanced subscribers hold a closed session open otherwise
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()
        for close in (self._state_link.close, self._session.close):
            with contextlib.suppress(zenoh.ZError):
                close()

    def _give_signals_back(self) -> None:
        self._has_signals = False
        if threading.current_thread() is not threading.main_thread():
            return
        for number in self._handlers:
            if signal.getsignal(number) == self._on_signal:  # or somebody else's came behind it
                signal.signal(number, self._handler_before(number))

    def _handler_before(self, number: int) -> Any:
        """What a signal did before us; workers that have ended since do nothing with it."""
        before = self._handlers[number]
        worker = getattr(before, "__self__", None)
        if isinstance(worker, Worker) and not worker._has_signals:  # noqa: SLF001 - another one of us
            return worker._handler_before(number)  # noqa: SLF001 - as above
        return signal.SIG_DFL if before is None else before

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if not self._has_signals:  # closed, and nobody could put back what was there
            _pass_on(number, self._handler_before(number))
        elif os.getpid() != self._pid:  # a child that this process forked has our handler, and nobody who waits in it
            _pass_on(number, signal.SIG_DFL)
        else:
            self._signals += 1
            self._ended.set()  # and not `_stop`, an event: its lock may be held by what this signal has interrupted

    def _finish(self) -> None:
        """Take the token back, so that relays keep what is to come for the next worker, and do what has come."""
        token, self._token = self._token, None
        if token is None or self._role.role is WorkerRole.IDLE:
            return
        try:
            guarded(self._undeclare, token, name="zsched token", is_lasting=False).start()
        except RuntimeError:  # no thread is to be had
            self._undeclare(token)
        ends_at = monotonic_s() + FINISH_S
        while self._signals == 1 and monotonic_s() < ends_at:
            if self._dispatcher.is_still(STILL_S) and not self._debts.is_waiting:
                return
            time.sleep(LOOK_S)  # no event: a signal's handler may not set one that its thread waits for

    @staticmethod
    def _undeclare(token: zenoh.LivelinessToken) -> None:
        with contextlib.suppress(zenoh.ZError):
            token.undeclare()

    # --- role --------------------------------------------------------------------------------------------------------

    def _on_role(self, role: Role) -> None:
        with self._lock:
            self._restorer.note(role)  # first: from the moment that we are the owner, inputs wait for the snapshot
            before = self._role
            if role.role is WorkerRole.IDLE or lets_out(before, role, monotonic_s()):
                self._dispatcher.expect_begin(is_due=role.role is not WorkerRole.IDLE)
            self._role = role
            if not self._drains_itself:
                self._epochs.follow(before, role)
        if role != before:
            self._errands.put(lambda: self._change_role(before, role))

    def _change_role(self, before: Role, role: Role) -> None:
        """Follow a new role: the token that says in which epoch we work; the ends of an epoch that was cut short."""
        if self._epochs.is_carried(before.epoch):
            try:
                guarded(self._end_later, before.epoch, name="zsched carry", is_lasting=False).start()
            except RuntimeError:  # no thread is to be had: nobody would end it, were its inputs never to end
                self._send_ends(before.epoch)
        elif before.epoch and before.epoch != role.epoch:
            self._send_ends(before.epoch)
        if role.role is WorkerRole.DRAINING:
            if before.epoch != role.epoch:  # that we work in it was told us too late: what was withheld is answered now
                self._begin(role)
            self._look_for_end(role.epoch)
        if role.role is WorkerRole.IDLE and before.epoch:
            self._dispatcher.forget(before.epoch)
        is_active = role.role is WorkerRole.ACTIVE
        if self._watch is not None and (not is_active or before.epoch != role.epoch):
            self._watch.hide()
        if is_active:
            self._epochs.resume(role.epoch)
            if self._untaken:
                self._tell_trouble(0, self._untaken)
        was_held = before.lease_until_s is not None and monotonic_s() >= before.lease_until_s
        is_shown = self._watch is not None and self._watch.is_shown
        if is_active and (not is_shown or was_held):
            self._begin(role)  # also what was withheld for want of a lease

    def _end_later(self, epoch: int) -> None:
        """End an epoch that is carried, also when the end of its inputs never comes."""
        if self._stop.wait(CARRY_S):
            return
        while self._epochs.is_carried(epoch) and self._dispatcher.has_waiting(epoch):
            if self._stop.wait(CARRY_LOOK_S):
                return
        self._send_ends(epoch)

    def _begin(self, role: Role) -> None:
        """Work in the role's epoch from now on, behind the predecessor's snapshot if there is one to be had."""
        then = partial(self._errands.put, lambda: self._begin(role))
        now = self._role
        is_stale = now.role is WorkerRole.IDLE or now.epoch != role.epoch
        if self._restorer.begin(role, then):  # also one that is over: who follows asks us for what we have asked for
            return
        if not is_stale:
            self._dispatcher.begin(role.epoch)
            if now.role is WorkerRole.ACTIVE:
                self._show_role(role.epoch)
            self._look_for_end(role.epoch)
        self._restorer.deliver(role.epoch)

    def _show_role(self, epoch: int) -> None:
        """Show that we work in ``epoch``, with the state that it begins with: before `ready` nobody can know that."""
        if self._watch is not None and self._is_ready:
            self._watch.show(epoch)

    def _show_now(self) -> None:
        role = self.role
        if role.role is WorkerRole.ACTIVE:
            self._show_role(role.epoch)

    def _fetch_snapshot(
        self, predecessor: str, epoch: int, timeout_s: float, is_gone: Callable[[], bool]
    ) -> bytes | str:
        key, session = self._keyspace.snapshot(predecessor, self._task), self._state_link.session
        for offer in [entity for entity in self._declared if isinstance(entity, Offer)]:
            offer.offer_by(session)  # the relay may not have been there when it was declared
        return fetch(session, key, epoch, timeout_s, is_gone)

    def _is_owner(self) -> bool:
        role = self.role
        has_lease = role.lease_until_s is None or monotonic_s() < role.lease_until_s
        return role.role is not WorkerRole.IDLE and has_lease

    def _epoch_now(self) -> int | None:
        """The epoch that outputs are stamped with, ``None`` while they go nowhere."""
        role = self._role
        if self._is_closed or role.role is WorkerRole.IDLE or self._restorer.is_pending:
            self._dispatcher.note_withheld()
            return None
        if self._dispatcher.must_wait(role.epoch) and not self._is_standalone:  # what was withheld before comes first
            self._dispatcher.note_withheld()
            return None
        has_lease = role.lease_until_s is None or monotonic_s() < role.lease_until_s
        epoch = self._epochs.stamp(role, self._dispatcher.epoch_in_hand()) if has_lease else None
        if epoch is None:  # without a lease, or behind our own end: the next role answers it
            self._dispatcher.note_withheld()
        return epoch

    def _send_acks(self, relay: str, frame: StreamAcks) -> None:
        """Tell a relay how far its samples are; what is dropped here is mended by the next one."""
        self._session.put(
            self._keyspace.ack(self._node, self._task, self._incarnation, relay),
            wire.encode(frame),
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def _tell_trouble(self, count: int, text: str, *, is_cold: bool = False) -> None:
        life = self._incarnation
        self._tell(WorkerTrouble(task=self._task, incarnation=life, count=count, text=text, is_cold=is_cold))

    def _tell_cold(self, text: str) -> None:
        # An older daemon, which does not know the word, takes it for one callback that raised, and forgets it.
        self._tell_trouble(1, as_reason(text), is_cold=True)

    def _tell_jobs(self, jobs: WorkerJobs) -> None:
        if not self._is_standalone:
            self._tell(jobs)

    def _tell(self, word: WorkerTrouble | WorkerJobs) -> None:
        """Say something of this worker to its node; what is dropped here is said by the next word."""
        key = self._keyspace.trouble(self._node, self._task, self._incarnation)
        self._session.put(key, wire.encode(word), congestion_control=zenoh.CongestionControl.DROP)

    # --- ends --------------------------------------------------------------------------------------------------------

    def _on_marker(self, sample: zenoh.Sample) -> None:
        marker = decode_end(sample.payload.to_bytes())
        source = sample.source_info
        if marker is None or source is None:
            return
        key = str(sample.key_expr).removesuffix(f"/{END_CHUNK}")
        name = (key, str(source.source_id.zid), source.source_id.eid)
        self._dispatcher.put_marker(Marker(name=name, end=marker, came_at=monotonic_s()))

    def _inputs_ended(self, epoch: int) -> None:
        """Every input seen in ``epoch`` has ended and is processed (dispatch thread).

        While we are to work in it, that is somebody's forgery, or our daemon learns of the move later than the robots:
        its word decides. So it is before we have begun with it, and then what was withheld is not answered yet.
        """
        if self._drains_itself:
            return
        with self._lock:
            is_at_work = self._role.role is WorkerRole.ACTIVE and self._role.epoch == epoch
            if is_at_work or not self._dispatcher.has_begun(epoch):
                self._early_end = epoch
                return
        self._send_ends(epoch)

    def _look_for_end(self, epoch: int) -> None:
        """Our role has changed: an end that came too early for it may count now."""
        with self._lock:
            is_early = self._early_end == epoch
        if is_early:
            self._dispatcher.look_for_end(epoch)

    def _send_ends(self, epoch: int) -> None:
        with self._lock:
            ended = self._epochs.close(epoch)
            outputs = tuple(self._outputs.values())
        for one in ended:
            for output in outputs:  # an errand each: one that fails takes no end from those behind it
                self._errands.put(partial(output.send_end, one))


def _pass_on(number: int, handler: Any) -> None:
    """Let ``handler`` have the signal that has come to a worker, and all later ones."""
    signal.signal(number, handler)
    os.kill(os.getpid(), number)
