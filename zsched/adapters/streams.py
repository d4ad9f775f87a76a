"""The daemon's handle on the relay process: starts it, feeds it plans and roles, restarts it, hears its reports.

Knows: the process, its pipe, the newest plan and role of every task. Does not know: what a plan means, zenoh.

Nothing here ever blocks the caller: commands wait in a table where the newest per task replaces the one before, and a
thread writes them. A relay that dies, or gives no sign of life, is restarted with backoff and given the newest plans
and roles again. It dies with the daemon: its stdin ends, and the kernel kills it with its parent.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from zsched import wire
from zsched.clock import monotonic_s
from zsched.core.events import ProblemReported, RelayChanged
from zsched.core.model import NodeId
from zsched.core.plan import Role, RoutePlan
from zsched.core.relay_protocol import HandleReport, RelayStarted, RelayStop
from zsched.errors import WireError
from zsched.relay_pipe import REPORTS, read_frame, write_frame

BACKOFF_MIN_S: Final = 0.1
BACKOFF_MAX_S: Final = 5.0
BACKOFF_FACTOR: Final = 2.0
CALM_S: Final = 30.0
"""A relay that lived so long starts again with the shortest backoff."""
SILENCE_S: Final = 5.0
"""A relay counts every second; after so long without a word it is wedged and killed."""

_log = logging.getLogger("zsched.streams")

_Key = tuple[str, str]


@dataclass(slots=True)
class _Outbox:
    """What the relay has not been told yet; at most one plan and one role per task."""

    items: dict[_Key, RoutePlan | Role] = field(default_factory=dict)
    wake: threading.Condition = field(default_factory=threading.Condition)
    is_closed: bool = False

    def put(self, key: _Key, value: RoutePlan | Role) -> None:
        with self.wake:
            self.items.pop(key, None)  # the newest goes to the end
            self.items[key] = value
            self.wake.notify()

    def close(self) -> None:
        with self.wake:
            self.is_closed = True
            self.wake.notify()

    def take(self) -> RoutePlan | Role | None:
        """The next value, waiting for one; ``None`` once closed."""
        with self.wake:
            while not self.items and not self.is_closed:
                self.wake.wait()
            if self.is_closed:
                return None
            return self.items.pop(next(iter(self.items)))


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
    ) -> None:
        """``zenoh_config`` is the JSON of the data session, ``threads`` the size of zenoh's pools (targets + 2).

        ``local_config`` is the session of the host's own side; empty: the data session serves the host, too.
        """
        self._configs = tuple(text.encode() for text in (zenoh_config, local_config) if text)
        self._on_report = on_report
        self._command = [python, "-m", "zsched.relay", "--fleet", fleet, "--node", node]
        self._command += ["--threads", str(threads), "--parent", str(os.getpid())]
        self._command += ["--local"] if local_config else []
        self._lock = threading.Lock()
        self._newest: dict[_Key, RoutePlan | Role] = {}
        self._outbox = _Outbox()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._supervise, name="relay", daemon=True)

    @property
    def pid(self) -> int | None:
        """The relay's process id, ``None`` while none runs."""
        process = self._process
        return process.pid if process is not None and process.poll() is None else None

    def start(self) -> None:
        """Start the relay; `RelayChanged` tells when its session is open."""
        self._thread.start()

    def apply(self, plan: RoutePlan) -> None:
        """Give the relay the newest plan of a task."""
        self._tell(("plan", plan.task), plan)

    def set_role(self, role: Role) -> None:
        """Let the relay tell this node's worker its newest role."""
        self._tell(("role", role.task), role)

    def stop(self, deadline_s: float = 2.0) -> None:
        """Stop the relay in order, with SIGKILL at the deadline; returns when it is gone."""
        until = monotonic_s() + deadline_s
        self._stopping.set()
        process = self._process
        if process is not None:
            self._outbox.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, until - monotonic_s()))
            if process.poll() is None:
                process.kill()
        if self._thread.is_alive():
            self._thread.join(max(0.5, until - monotonic_s()))

    # --- internals ---------------------------------------------------------------------------------------------------

    def _tell(self, key: _Key, value: RoutePlan | Role) -> None:
        with self._lock:
            self._newest[key] = value
            self._outbox.put(key, value)

    def _supervise(self) -> None:
        """One process after the other; this thread is their parent (PDEATHSIG counts threads) and lives on."""
        backoff = BACKOFF_MIN_S
        while not self._stopping.is_set():
            started_at = monotonic_s()
            reason = self._run_once()
            if self._stopping.is_set():
                return
            if monotonic_s() - started_at > CALM_S:
                backoff = BACKOFF_MIN_S
            _log.warning("the relay is gone (%s), next one in %.1f s", reason, backoff)
            self._on_report(RelayChanged(is_running=False, reason=reason))
            self._stopping.wait(backoff)
            backoff = min(backoff * BACKOFF_FACTOR, BACKOFF_MAX_S)

    def _run_once(self) -> str:
        """Run one relay to its end; answers why it ended."""
        try:
            process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        except OSError as error:
            return f"cannot start {self._command[0]}: {error}"
        assert process.stdin is not None
        assert process.stdout is not None
        with self._lock:
            outbox = self._outbox = _Outbox(items=dict(self._newest))
            self._process = process
        if self._stopping.is_set():
            outbox.close()
        writer = threading.Thread(target=self._write, args=(process.stdin.fileno(), outbox), daemon=True)
        writer.start()
        reason = self._listen(process.stdout.fileno())
        process.kill()
        code = process.wait()
        outbox.close()
        writer.join()
        process.stdin.close()
        process.stdout.close()
        return reason or f"exit code {code}"

    def _write(self, descriptor: int, outbox: _Outbox) -> None:
        try:
            for text in self._configs:
                write_frame(descriptor, text)
            while (value := outbox.take()) is not None:
                write_frame(descriptor, wire.encode(value))
            write_frame(descriptor, wire.encode(RelayStop()))
        except OSError:
            return  # it is gone: the reader says so
        except WireError as error:
            self._on_report(ProblemReported(source="relay", problem=f"a plan is too large: {error}"[:400]))

    def _listen(self, descriptor: int) -> str:
        """Hand on reports until the pipe ends; answers what was wrong, or ``""``."""
        poller = select.poll()
        poller.register(descriptor, select.POLLIN)
        while True:
            if not poller.poll(SILENCE_S * 1000):
                return f"no sign of life for {SILENCE_S:g} s"
            try:
                frame = read_frame(descriptor)
                if frame is None:
                    return ""
                report: HandleReport = wire.decode(frame, *REPORTS)
            except WireError as error:
                return f"unreadable report: {error}"
            if isinstance(report, RelayStarted):
                self._on_report(RelayChanged(is_running=True, reason=f"pid {report.pid}"))
            self._on_report(report)
