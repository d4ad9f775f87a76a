"""The daemon's handle on the relay process: takes over the one that runs or starts one, feeds it, hears its reports.

Knows: the process, its pipe, the newest plan and role of every task, when a relay counts as wedged. Does not know: what
a plan means, zenoh.

Nothing here ever blocks the caller: commands wait in a table where the newest per task replaces the one before, and a
thread writes them. A relay that dies, or is wedged, is replaced and given the newest plans and roles again. With a
`Bequest` it outlives this daemon for a while, and the next one takes it over, streams and all; else it dies with it.
"""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
from collections.abc import Callable
from typing import Final

from zsched import __version__
from zsched.adapters.relay.child import ENDING_S, RelayChild, start_relay
from zsched.adapters.relay.silence import Silence
from zsched.clock import awake_s
from zsched.core.events import ProblemReported, RelayChanged
from zsched.core.relay_protocol import HandleReport, RelayStarted, RelayStop, TaskEnded, WorkerWatch
from zsched.core.values.model import MAX_REASON, NodeId, TaskId
from zsched.core.values.plan import Role, RoutePlan
from zsched.core.values.struct import Struct, field
from zsched.errors import AdapterError, WireError
from zsched.guard import guarded
from zsched.ipc.pipe import REPORTS, read_frame, write_frame
from zsched.ipc.protocol import RelayHello, RelayPulse
from zsched.ipc.takeover import GREETING_S, Door, digest_of
from zsched.wire import codec as wire

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
WARM_S: Final = 4.0
"""A relay that is to be replaced carries on for at most this time, until the next one has loaded its code."""

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


class Bequest(Struct, frozen=True, kw_only=True):
    """How a relay passes from this daemon to the next one."""

    door: Door
    orphan_s: float
    """The relay goes on without a daemon for this long."""
    incarnation: int
    """This daemon's; only a later one may take the relay over."""
    digest: str
    """Over everything beside sessions that a running relay must agree with (`digest_of`)."""
    listen: str = ""
    """Where the data session listens, for the next daemon."""
    certificate: str = ""
    """A digest over the files that the data session reads when it opens."""
    tasks: tuple[TaskId, ...] | None = None
    """Of the fleet; a relay that is taken over ends what it carries for others (``None``: it ends nothing)."""
    spare_threads: int = 0
    """A relay that is started gets this many more, for a fleet that grows."""


class RelayHandle:
    """One node's relay process. ``on_report`` is called from this handle's thread and must only enqueue."""

    def __init__(
        self,
        *,
        fleet: str,
        node: NodeId,
        zenoh_config: str,
        on_report: Callable[[HandleReport], None],
        threads: int = 6,
        python: str = sys.executable,
        local_config: str = "",
        silence_s: float = SILENCE_S,
        bequest: Bequest | None = None,
    ) -> None:
        """``zenoh_config`` is the JSON of the data session, ``threads`` the size of zenoh's pools (targets + 2).

        ``local_config`` is the session of the host's own side; empty: the data session serves the host, too.
        Without ``bequest`` the relay dies with this process. ``silence_s`` should be over zenoh's lease: a call of
        zenoh that waits for a frozen peer may hold Python's lock that long.
        """
        self._configs = tuple(text.encode() for text in (zenoh_config, local_config) if text)
        self._on_report = on_report
        self._silence_s = min(silence_s, STARVED_S)
        self._bequest = bequest
        self._command = [python, "-P", "-m", "zsched.relay", "--fleet", fleet, "--node", node]
        spare = 0 if bequest is None else bequest.spare_threads
        self._command += ["--threads", str(threads + spare), "--parent", str(os.getpid())]
        self._command += ["--local"] if local_config else []
        if bequest is not None:
            digest = digest_of(bequest.digest, python, local_config)
            session = digest_of(zenoh_config, bequest.certificate)
            self._hello = RelayHello(
                fleet=fleet,
                node=node,
                incarnation=bequest.incarnation,
                digest=digest,
                session=session,
                threads=threads,
                tasks=bequest.tasks,
            )
            self._command += ["--orphan", str(bequest.orphan_s), "--digest", digest, "--session", session]
            self._command += ["--incarnation", str(bequest.incarnation), "--books", str(bequest.door.books)]
        self._lock = threading.Lock()
        self._newest: dict[_Key, _Told] = {}
        self._outbox = _Outbox()
        self._relay: RelayChild | None = None
        self._reopens = False
        """The relay that was taken over waits for the configuration of its data session."""
        self._stopping = threading.Event()
        self._is_leaving = False
        self._thread = guarded(self._supervise, name="relay")

    @property
    def pid(self) -> int | None:
        """The relay's process id, ``None`` while none runs."""
        relay = self._relay
        return relay.pid if relay is not None and not relay.has_ended() else None

    def start(self) -> None:
        """Take over or start the relay; `RelayChanged` tells when it obeys."""
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
        if self._bequest is not None and self._bequest.door.note() is None:
            self._bequest.door.remove()

    def leave(self) -> None:
        """Let go of the relay, which carries on for this node's next daemon; without a `Bequest` it is stopped."""
        if self._bequest is None:
            self.stop()
            return
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
        """One process after the other; this thread is their parent (PDEATHSIG counts threads) and lives on."""
        backoff = 0.0
        found = self._take_over()
        while found is not None or not self._stopping.is_set():
            started_at = awake_s()
            reason = self._run_once(found)
            found = None
            if self._stopping.is_set():
                return
            backoff = 0.0 if awake_s() - started_at > CALM_S else backoff
            _log.warning("the relay is gone (%s), next one in %.1f s", reason, backoff)
            self._on_report(RelayChanged(is_running=False, reason=reason))
            self._stopping.wait(backoff)
            backoff = min(max(BACKOFF_MIN_S, backoff * BACKOFF_FACTOR), BACKOFF_MAX_S)

    def _take_over(self) -> RelayChild | None:
        """The relay that an earlier daemon left; one that is not for us is ended, for there must be one only."""
        bequest = self._bequest
        note = None if bequest is None else bequest.door.note()
        if bequest is None or note is None:
            return None
        silence = Silence(note.pid, GREETING_S)
        found = bequest.door.connect(self._hello, lambda asked_s, took_s: not silence.go_on(asked_s, took_s))
        if isinstance(found, str):
            _log.warning("the relay that runs here (pid %d) is replaced: %s", note.pid, found)
            return self._replaced(RelayChild(pid=note.pid, link=None, door=bequest.door))
        link, here = found
        self._reopens = here.reopens
        how = ", and opens its data session anew" if here.reopens else ""
        if note.version != __version__:
            how += "; its code stays that of another version until the service is stopped"
        _log.info("the relay that runs here (pid %d) is taken over%s", here.pid, how)
        return RelayChild(pid=here.pid, link=link, door=bequest.door)

    def _replaced(self, other: RelayChild) -> RelayChild | None:
        """The relay that follows ``other``; ``None``: it could not be started yet.

        The other one carries on until the next one waits for its configuration: it opens its sessions at once then, and
        the host's applications find a relay when they dial for the second time.
        """

        def end(following: RelayChild) -> None:
            following.speaks(WARM_S)
            other.end(EVICT_S)

        try:
            return self._start(end)
        except (OSError, AdapterError) as error:
            _log.warning("the relay that is to follow does not start: %s", error)
            other.end(EVICT_S)
            return None

    def _run_once(self, found: RelayChild | None) -> str:
        """Serve one relay to its end; answers why it ended."""
        try:
            relay = found or self._start()
        except (OSError, AdapterError) as error:
            return f"cannot start {self._command[0]}: {error}"
        try:
            return self._serve(relay)
        except Exception as error:  # noqa: BLE001 - whatever it is: streams need a relay, and this thread its life
            _log.exception("the relay's handle failed, the relay is replaced")
            return f"its handle failed: {error!r}"

    def _serve(self, relay: RelayChild) -> str:
        with self._lock:
            outbox = self._outbox = _Outbox(items=dict(self._newest))
            self._relay = relay
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

    def _start(self, ends_other: Callable[[RelayChild], None] = lambda _next: None) -> RelayChild:
        if self._bequest is None:
            return start_relay(self._command)
        return start_relay(self._command, self._bequest.door, self._bequest.listen, ends_other)

    def _write(self, relay: RelayChild, outbox: _Outbox) -> None:
        too_large: dict[tuple[str, TaskId], str] = {}
        """{what the relay was to be told: why it was not}, until something of that kind fits."""
        try:
            texts = self._configs if relay.is_child else self._configs[: int(self._reopens)]
            for text in texts:
                write_frame(relay.descriptor, text)
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

    def _listen(self, relay: RelayChild) -> str:
        """Hand on reports until the pipe ends; answers what was wrong, or ``""``.

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
