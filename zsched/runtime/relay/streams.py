"""The daemon's handle on its relay: connects to the one that runs, or starts one, feeds it, hears its reports.

Knows: the socket, the greeting, the newest plan and role of every task, when a relay counts as wedged. Does not know:
what a plan means, zenoh.

Nothing here ever blocks the caller: commands wait in a table where the newest per task replaces the one before, and a
thread writes them. A relay that is connected to is told all of the table, whatever it has carried before. One that
dies, is wedged, or is not the one that is needed is followed by another one.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from zsched import __version__
from zsched.core.values import codec as wire
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.events import ProblemReported, RelayChanged
from zsched.core.values.model import MAX_REASON, TaskId
from zsched.core.values.plan import Role, RoutePlan
from zsched.core.values.relay_protocol import HandleReport, RelayStarted, RelayStop, TaskEnded, WorkerWatch
from zsched.core.values.struct import Struct, field, replace
from zsched.host.clock import awake_s
from zsched.host.guard import guarded
from zsched.link.pipe.frames import REPORTS, read_frame, write_frame
from zsched.link.pipe.protocol import RelayHello, RelayHere, RelayPulse, RelayRefused
from zsched.link.pipe.relay_socket import GREETING_S, dial
from zsched.runtime.relay.process import ENDING_S, RelayProcess, start_relay
from zsched.runtime.relay.silence import Silence

BACKOFF_MIN_S: Final = 0.1
BACKOFF_MAX_S: Final = 5.0
BACKOFF_FACTOR: Final = 2.0
CALM_S: Final = 10.0
"""A relay that lived at least this long is replaced at once; one that did not waits for its backoff."""
SILENCE_S: Final = 1.5
"""A relay says something twice a second; after this long without a word it is wedged, unless it lacks a processor."""
START_S: Final = 5.0
"""The same for its first word."""
OPEN_S: Final = 30.0
"""The same for its session, which may have to wait for peers."""
STARVED_S: Final = 15.0
"""After this long without a word `status` says that it lacks a processor."""
STILL_S: Final = 8.0
"""Its streams are counted every second; after this long without a count they hang on something, though it lives."""
EVICT_S: Final = 2.0
"""A relay that is not the one that is needed ends itself within this time."""
LOOK_S: Final = 0.02
"""How often we look whether a relay that starts listens yet."""

_log = logging.getLogger("zsched.streams")

_Key = tuple[str, str]
_Told = RoutePlan | Role | WorkerWatch | TaskEnded
TOO_LARGE: Final = "relay/plan"
"""Of the problem that the relay goes by an older plan, for the newest one is too large."""
_KINDS: Final = ("plan", "role", "watch")
"""What a task has in the table."""


class _Outbox(Struct):
    """What the relay has not been told yet; at most one plan, one role and one watch per task."""

    items: dict[_Key, _Told] = field(default_factory=dict)
    wake: threading.Condition = field(default_factory=threading.Condition)
    is_closed: bool = False

    def put(self, key: _Key, value: _Told) -> None:
        with self.wake:
            self.items.pop(key, None)  # the newest goes to the end
            self.items[key] = value
            self.wake.notify()

    def close(self) -> None:
        with self.wake:
            self.is_closed = True
            self.wake.notify()

    def take(self) -> _Told | None:
        """The next value, waiting for one; ``None`` once closed."""
        with self.wake:
            while not self.items and not self.is_closed:
                self.wake.wait()
            if self.is_closed:
                return None
            return self.items.pop(next(iter(self.items)))


class RelayHandle:
    """One node's relay. ``on_report`` is called from this handle's thread and must only enqueue."""

    def __init__(
        self,
        *,
        hello: RelayHello,
        path: Path,
        zenoh_config: str,
        on_report: Callable[[HandleReport], None],
        local_config: str = "",
        silence_s: float = SILENCE_S,
        python: str = sys.executable,
        starts: bool = True,
    ) -> None:
        """``hello`` says which relay is needed, ``path`` is the socket's; another one starts relays unless ``starts``.

        ``zenoh_config`` is the JSON of the data session, ``local_config`` that of the host's own side; empty: the data
        session serves the host, too. ``silence_s`` should be over zenoh's lease: a call of zenoh that waits for a
        frozen peer may hold Python's lock that long.
        """
        self._hello = replace(hello, has_local_side=bool(local_config))
        self._texts = tuple(text.encode() for text in (zenoh_config, local_config) if text)
        self._on_report = on_report
        self._silence_s = min(silence_s, STARVED_S)
        self._path, self._python, self._starts = path, python, starts
        self._lock = threading.Lock()
        self._newest: dict[_Key, _Told] = {}
        self._outbox = _Outbox()
        self._relay: RelayProcess | None = None
        self._stopping = threading.Event()
        self._is_leaving = False
        self._thread = guarded(self._supervise, name="relay")

    @property
    def pid(self) -> int | None:
        """The relay's process id, ``None`` while none runs."""
        relay = self._relay
        return relay.pid if relay is not None and not relay.has_ended() else None

    def start(self) -> None:
        """Connect to the relay, or start one; `RelayChanged` tells when it obeys."""
        self._thread.start()

    def apply(self, plan: RoutePlan) -> None:
        """Give the relay the newest plan of a task."""
        self._tell(("plan", plan.task), plan)

    def set_role(self, role: Role) -> None:
        """Let the relay tell this node's worker its newest role."""
        self._tell(("role", role.task), role)

    def watch(self, watch: WorkerWatch) -> None:
        """Let the relay look after what of a task does not depend on its owner."""
        self._tell(("watch", watch.task), watch)

    def end(self, task: TaskId) -> None:
        """Let the relay end everything of a task; a relay that starts later hears nothing of it."""
        with self._lock:
            for kind in _KINDS:
                self._newest.pop((kind, task), None)
            self._outbox.put(("ended", task), TaskEnded(task=task))

    def stop(self, deadline_s: float = 2.0) -> None:
        """Stop the relay in order, with SIGKILL at the deadline; returns when it is gone."""
        until = awake_s() + deadline_s
        self._stopping.set()
        relay = self._relay
        if relay is not None:
            self._outbox.close()
            if not relay.wait(max(0.0, until - awake_s())):
                relay.kill()
        if self._thread.is_alive():
            self._thread.join(max(0.5, until - awake_s()))
        if self._starts and (relay is None or relay.has_ended()):
            self._path.unlink(missing_ok=True)

    def leave(self) -> None:
        """Let go of the relay, which carries on for this node's next daemon."""
        self._is_leaving = True
        self._stopping.set()
        if (relay := self._relay) is not None:
            relay.hang_up()
        self._outbox.close()
        if self._thread.is_alive():
            self._thread.join(1.0)

    # --- internals ---------------------------------------------------------------------------------------------------

    def _tell(self, key: _Key, value: _Told) -> None:
        with self._lock:
            self._newest[key] = value
            self._outbox.put(key, value)

    def _supervise(self) -> None:
        """One relay after the other."""
        backoff = 0.0
        while not self._stopping.is_set():
            started_at = awake_s()
            reason = self._run_once()
            if self._stopping.is_set():
                return
            backoff = 0.0 if awake_s() - started_at > CALM_S else backoff
            _log.warning("the relay is gone (%s), next one in %.1f s", reason, backoff)
            self._on_report(RelayChanged(is_running=False, reason=reason))
            self._stopping.wait(backoff)
            backoff = min(max(BACKOFF_MIN_S, backoff * BACKOFF_FACTOR), BACKOFF_MAX_S)

    def _run_once(self) -> str:
        """Serve one relay to its end; answers why it ended."""
        try:
            relay = self._reach()
        except (OSError, AdapterError) as error:
            return f"cannot start {self._python}: {error}" if isinstance(error, OSError) else str(error)
        try:
            return self._serve(relay)
        except Exception as error:  # noqa: BLE001 - whatever it is: streams need a relay, and this thread its life
            _log.exception("the relay's handle failed, the relay is replaced")
            return f"its handle failed: {error!r}"

    def _reach(self) -> RelayProcess:
        """A relay that obeys us: the one that listens, else one that we start.

        Raises:
            AdapterError: it does not listen, does not answer, or is not the one that is needed; it has ended then.
            OSError: none can be started.
        """
        link = dial(self._path)
        if link is None:
            if not self._starts:
                raise AdapterError(f"none listens at {self._path}: see journalctl -u zsched-relay")
            relay = self._relay = start_relay(self._python, self._path)
            relay.meet(self._await_listener(relay))
        else:
            relay = self._relay = RelayProcess(0, link)
        if reason := self._greet(relay):
            relay.close()
            raise AdapterError(reason)
        return relay

    def _await_listener(self, relay: RelayProcess) -> socket.socket:
        """The link to a relay that has been started, once it listens."""
        silence = Silence(relay.pid, START_S)
        while (link := dial(self._path)) is None:
            began = awake_s()
            time.sleep(LOOK_S)
            reason = silence.go_on(LOOK_S, awake_s() - began)
            if relay.has_ended() or reason or self._stopping.is_set():
                relay.kill()
                raise AdapterError(reason or relay.ending)
        return link

    def _greet(self, relay: RelayProcess) -> str:
        """Say who we are; answers why the relay does not obey us, or ``""``. One that does not has ended then."""
        patience_s = 0.0
        try:
            with contextlib.suppress(BrokenPipeError):  # it may have refused us by the first word, and says why
                for frame in (wire.encode(self._hello), *self._texts):
                    write_frame(relay.descriptor, frame)
            self._await_answer(relay)
            answer: RelayHere | RelayRefused | None = None
            if (word := read_frame(relay.descriptor)) is not None:
                answer = wire.decode(word, RelayHere, RelayRefused)  # type: ignore[assignment] # one of both
            if isinstance(answer, RelayHere):
                relay.wait_for_ever()
                if answer.version != __version__:
                    _log.info("the relay's code stays that of another version until the service is stopped")
                return ""
            patience_s = EVICT_S
            reason = "it went away" if answer is None else f"another one is needed: {answer.reason}"
        except (OSError, WireError) as error:
            reason = f"it does not answer ({error})"
        if not self._is_leaving and not relay.wait(patience_s):
            relay.kill()
        return reason

    def _await_answer(self, relay: RelayProcess) -> None:
        """Wait for the first word.

        Raises:
            TimeoutError: the relay hangs.
        """
        silence = Silence(relay.pid, GREETING_S)
        poller = select.poll()
        poller.register(relay.descriptor, select.POLLIN)
        began = awake_s()
        while not poller.poll((asked_s := silence.left_s) * 1000):
            if reason := silence.go_on(asked_s, awake_s() - began):
                raise TimeoutError(reason)
            began = awake_s()

    def _serve(self, relay: RelayProcess) -> str:
        with self._lock:
            outbox = self._outbox = _Outbox(items=dict(self._newest))
        if self._is_leaving:
            relay.hang_up()
        if self._stopping.is_set():
            outbox.close()
        writer = guarded(self._write, relay, outbox, name="relay writer", is_lasting=False)
        writer.start()
        reason = "not listened to"
        try:
            reason = self._listen(relay)
        finally:
            if not self._is_leaving:
                if not reason:  # it ends itself: its exit code says more than our SIGKILL's
                    relay.wait(ENDING_S)
                relay.kill()
            outbox.close()
            writer.join()
            relay.close()
        return reason or relay.ending

    def _write(self, relay: RelayProcess, outbox: _Outbox) -> None:
        too_large: dict[tuple[str, TaskId], str] = {}
        """{what the relay was to be told: why it was not}, until something of that kind fits."""
        try:
            while (value := outbox.take()) is not None:
                kind = (type(value).__name__, value.task)
                try:
                    frame = wire.encode(value)
                except WireError as error:
                    too_large[kind] = f"a plan of {value.task} is too large: {error}"[:MAX_REASON]
                    self._on_report(ProblemReported(source=TOO_LARGE, problem=too_large[kind]))
                    continue
                write_frame(relay.descriptor, frame)
                if too_large.pop(kind, None) is not None:
                    left = next(iter(too_large.values()), None)
                    self._on_report(ProblemReported(source=TOO_LARGE, problem=left))
            write_frame(relay.descriptor, wire.encode(RelayStop()))
        except OSError:
            return  # it is gone: the reader says so

    def _listen(self, relay: RelayProcess) -> str:
        """Hand on reports until the link ends; answers what was wrong, or ``""``.

        A relay that cannot start says why (a problem before `RelayStarted`) and ends: that is the answer then.
        """
        poller = select.poll()
        poller.register(relay.descriptor, select.POLLIN)
        silence, last_word = Silence(relay.pid, START_S), ""
        opening: Silence | None = Silence(relay.pid, OPEN_S)
        while True:
            if reason := self._await_word(poller, silence, opening):
                return reason
            try:
                frame = read_frame(relay.descriptor)
                if frame is None:
                    return last_word
                report: HandleReport | RelayPulse = wire.decode(frame, *REPORTS)
            except ConnectionResetError:  # it ended before it had read all that we said
                return last_word
            except (WireError, OSError) as error:
                if isinstance(error, WireError) and error.reason == "kind":
                    continue  # a newer relay tells more than we read: ours, too, if its files were just replaced
                return f"unreadable report: {error}"
            if isinstance(report, RelayPulse):
                if report.counted_s > STILL_S:
                    return f"its streams stand still for {report.counted_s:.1f} s"
                continue
            if isinstance(report, ProblemReported) and opening is not None:
                last_word = report.problem or ""
            if isinstance(report, RelayStarted):
                silence.limit_s, opening, last_word = self._silence_s, None, ""
                self._on_report(RelayChanged(is_running=True, reason=f"pid {report.pid}"))
            self._on_report(report)

    def _await_word(self, poller: select.poll, silence: Silence, opening: Silence | None) -> str:
        """Wait for the relay's next word; answers why it is wedged, or ``""``."""
        is_starved = False
        try:
            while True:
                asked_s, began = silence.left_s, awake_s()
                is_there = bool(poller.poll(asked_s * 1000))
                took_s = awake_s() - began
                if opening is not None and (reason := opening.go_on(asked_s, took_s)):
                    return f"its session does not open: {reason}"
                if is_there:
                    silence.end()
                    return ""
                reason = silence.go_on(asked_s, took_s)
                if reason and not poller.poll(0):  # the verdict takes a look of 0.1 s, in which a word may have come
                    return reason
                if silence.silent_s >= STARVED_S and not is_starved:
                    is_starved = True
                    self._tell_starved(f"no word for {silence.silent_s:.0f} s: it waits for a processor")
        finally:
            if is_starved:
                self._tell_starved(None)

    def _tell_starved(self, problem: str | None) -> None:
        _log.warning("the relay: %s", problem or "is heard again, or ended")
        self._on_report(ProblemReported(source="relay/processor", problem=problem))
