"""One worker process with its group, its output and its end; and the guard that kills what a killed daemon leaves.

A worker is the leader of its own session and process group. Three things bind it to the daemon's life:
`zsched.host.workers.launch` (the kernel kills the worker with the daemon's thread), `WorkerGuard` (a shell that
reads from a pipe and kills every group it knows when the pipe closes, so grandchildren go as well), and, in service,
systemd's control group. Only a grandchild that moves to a session of its own escapes the first two.

Knows: processes, groups, pipes, log lines. Does not know: tasks' states, restarts, deadlines.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from zsched.host import log_limit
from zsched.host.clock import awake_s
from zsched.host.screen import harmless
from zsched.host.workers.hired import Hired
from zsched.host.workers.kept_lines import KeptLines

LAUNCHER = str(Path(__file__).with_name("launch.py"))
MAX_LINE_BYTES = 2048
LINES_PER_S = 50.0
LINES_BURST = 400.0
PAST_ROUNDING_S = 0.001
READ_BYTES = 65536
INTAKE_BYTES = 262_144
"""Read from one worker per `INTAKE_WINDOW_S`; what it prints faster waits in its pipe."""
INTAKE_WINDOW_S = 0.1
POLL_S = 0.05
"""How often exits are looked for on kernels without pidfd."""


GUARD_SCRIPT = (
    "groups=' '; while read -r sign group; do case $sign in "
    '+) groups="$groups$group ";; -) groups="${groups%% $group *} ${groups#* $group }";; esac; done; '
    'for group in $groups; do kill -s KILL -- "-$group"; done'
)
"""Reads ``+ GROUP`` and ``- GROUP`` until the daemon's end of the pipe closes. On one line for `ps`."""


class LineLog:
    """Passes a worker's output on as log lines: long ones cut, too many counted instead of written."""

    def __init__(self, logger: logging.Logger, kept: KeptLines | None = None) -> None:
        """``kept``: where the newest lines stay for operators."""
        self._logger, self._kept = logger, kept
        self._partial = b""
        self._tokens = LINES_BURST
        self._refilled_s: float | None = None
        self._is_muted = False
        self._suppressed = 0
        self.last_line = ""
        """The newest line, for the reason of an exit."""

    def feed(self, chunk: bytes, now: float) -> None:
        """Take ``chunk`` as it came from the pipe at ``now`` (monotonic seconds)."""
        self._refill(now)
        if self._is_muted:
            self._suppress(chunk)
            return
        lines = (self._partial + chunk).split(b"\n")
        self._partial = lines.pop()[:MAX_LINE_BYTES]
        for index, line in enumerate(lines):
            if self._tokens < 1.0:
                self._is_muted = True
                self._suppress(b"\n".join([*lines[index:], b""]))
                return
            self._write(line)

    def tells_s(self) -> float | None:
        """When `feed` is due even if nothing comes (monotonic seconds): lines were left out, and nobody knows so far.

        A worker that floods and then hangs prints nothing more; ``None``: all is told.
        """
        if not self._is_muted or self._refilled_s is None:
            return None
        return self._refilled_s + max(0.0, LINES_PER_S - self._tokens) / LINES_PER_S + PAST_ROUNDING_S

    def close(self) -> None:
        """Write the unfinished line and the count of those left out."""
        if self._partial:
            self._write(self._partial)
        self._report_suppressed()

    def _write(self, line: bytes) -> None:
        self._tokens -= 1.0
        self._remember(line[:MAX_LINE_BYTES])
        cut = " ..." if len(line) > MAX_LINE_BYTES else ""
        text = f"{_printable(line[:MAX_LINE_BYTES]).rstrip()}{cut}"
        self._logger.info("%s", text, extra=log_limit.PASSED)
        self._keep(text)

    def _keep(self, text: str) -> None:
        if self._kept is not None:
            self._kept.add(text)

    def _remember(self, line: bytes) -> None:
        text = _printable(line).strip()
        self.last_line = text or self.last_line

    def _refill(self, now: float) -> None:
        elapsed_s = 0.0 if self._refilled_s is None else now - self._refilled_s
        self._refilled_s = now
        self._tokens = min(LINES_BURST, self._tokens + elapsed_s * LINES_PER_S)
        if self._is_muted and self._tokens >= LINES_PER_S:
            self._is_muted = False
            self._report_suppressed()

    def _suppress(self, chunk: bytes) -> None:
        self._suppressed += chunk.count(b"\n")
        self._partial = b""
        self._remember(chunk.rstrip().rpartition(b"\n")[2][-MAX_LINE_BYTES:])

    def _report_suppressed(self) -> None:
        if self._suppressed:
            self._logger.warning("suppressed lines=%d limit_per_s=%g", self._suppressed, LINES_PER_S)
            told = f"... {self._suppressed} lines left out: more than {LINES_PER_S:g} a second"
            self._keep(f"{told}; the newest: {self.last_line}")
            self._suppressed = 0


class _Own:
    """A process that the daemon has started itself, as its own user."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", LAUNCHER, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=dict(environment),
            start_new_session=True,
        )
        self.pid = self.group = self._process.pid
        assert self._process.stdout is not None
        self._output = self._process.stdout
        self.output_fd = self._output.fileno()
        self.end_fd = _open_pid_fd(self.pid)
        self.wait = self._process.wait

    def has_exited(self) -> bool:
        try:
            return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        except ChildProcessError:
            return True

    def signal_group(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    def close(self) -> None:
        self._output.close()
        if self.end_fd is not None:
            os.close(self.end_fd)


class WorkerProcess:
    """A running worker. Made, read and ended by one thread: the kernel ties the process to the thread that made it."""

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        logger: logging.Logger,
        kept: KeptLines | None = None,
        starter: Path | None = None,
        session: str = "",
    ) -> None:
        """Start ``command`` (its first word ``python`` means this interpreter). Raises `OSError`, `AdapterError`.

        ``starter``: who starts it, as another user, with a file of its own for its ``session``; ``None``: we do.
        """
        words = _own_python(command)
        self._child = _Own(words, environment) if starter is None else Hired(starter, words, environment, session)
        self.pid = self._child.pid
        self.group = self._child.group
        """For the guard; ``None``: its starter kills it."""
        self.output_fd, self.end_fd = self._child.output_fd, self._child.end_fd
        self.has_exited = self._child.has_exited
        """Whether the worker has ended; it is not reaped yet, so its id and group are still its own."""
        self.signal_group = self._child.signal_group
        """Sends a signal to the worker and everything it started in its group."""
        os.set_blocking(self.output_fd, False)
        self._lines = LineLog(logger, kept)
        self._window_start_s = 0.0
        self._window_bytes = 0

    @property
    def last_line(self) -> str:
        """The newest line of output."""
        return self._lines.last_line

    def read_output(self, now: float) -> bool:
        """Log what the worker has printed; ``False`` once it has closed its output."""
        try:
            chunk = os.read(self.output_fd, READ_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if now - self._window_start_s >= INTAKE_WINDOW_S:
            self._window_start_s, self._window_bytes = now, 0
        self._window_bytes += len(chunk)
        self._lines.feed(chunk, now)
        return bool(chunk)

    def tells_s(self) -> float | None:
        """When `tell` is due (monotonic seconds); ``None``: all output is told."""
        return self._lines.tells_s()

    def tell(self, now: float) -> None:
        """Say how many lines were left out."""
        self._lines.feed(b"", now)

    def resume_reading_s(self) -> float | None:
        """When reading may go on (monotonic seconds); ``None``: at once."""
        return self._window_start_s + INTAKE_WINDOW_S if self._window_bytes >= INTAKE_BYTES else None

    def finish(self, now: float) -> int:
        """Kill what is left of the group, log the rest of the output, reap; returns the status as `subprocess` does."""
        self.signal_group(signal.SIGKILL)
        for _ in range(INTAKE_BYTES // READ_BYTES):
            if not self.read_output(now):
                break
        self._lines.close()
        returncode = self._child.wait()
        self._child.close()
        return returncode


class WorkerGuard:
    """A shell of half a megabyte that kills the known process groups when this process is gone, however it went."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._groups: set[int] = set()

    def add(self, group: int | None) -> None:
        """Watch over ``group``, if there is one; starts the shell when there is none (any more)."""
        if group is None:
            return
        self._groups.add(group)
        if not self._tell(f"+ {group}\n"):
            self._restart()

    def discard(self, group: int | None) -> None:
        """Forget ``group``; to be called before its leader is reaped and its number can be used again."""
        if group in self._groups:
            self._groups.remove(group)
            self._tell(f"- {group}\n")

    def close(self) -> None:
        """End the shell; it kills the groups that are still known."""
        if self._process is None:
            return
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = None

    def _tell(self, line: str) -> bool:
        if self._process is None:
            return False
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), line.encode("ascii"))
        except OSError:
            return False
        return True

    def _restart(self) -> None:
        if self._process is not None:
            self._process.kill()
            self.close()
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", GUARD_SCRIPT, "zsched-guard"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            cwd="/",
        )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        for group in sorted(self._groups):
            self._tell(f"+ {group}\n")


class ProcessWatch:
    """Waits for workers' output and ends, for a deadline, or to be woken; reads the output, slowly where it floods."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._selector.register(self._wake_fd, selectors.EVENT_READ, partial(os.eventfd_read, self._wake_fd))
        self._watched: dict[WorkerProcess, None] = {}
        self._paused: dict[WorkerProcess, float] = {}
        self._polled: set[WorkerProcess] = set()
        self._lock = threading.Lock()
        self._is_closed = False

    def wake(self) -> None:
        """Make `wait` return; from any thread."""
        with self._lock:
            if not self._is_closed:
                os.eventfd_write(self._wake_fd, 1)

    def wait(self, deadline_s: float | None) -> None:
        """Return at ``deadline_s`` (monotonic seconds; ``None``: never), or when woken or something happened."""
        now = awake_s()
        untold = {process: at for process in self._watched if (at := process.tells_s()) is not None}
        times = [*self._paused.values(), *untold.values(), *([deadline_s] if deadline_s is not None else [])]
        if self._polled:
            times.append(now + POLL_S)
        for key, _ in self._selector.select(max(0.0, min(times) - now) if times else None):
            key.data()
        for process in [process for process, resume_s in self._paused.items() if awake_s() >= resume_s]:
            del self._paused[process]
            self._register_output(process)
        for process, at in untold.items():
            if process in self._watched and awake_s() >= at:
                process.tell(awake_s())

    def add(self, process: WorkerProcess) -> None:
        """Watch ``process``."""
        self._watched[process] = None
        self._register_output(process)
        if process.end_fd is None:
            self._polled.add(process)
        else:
            self._selector.register(process.end_fd, selectors.EVENT_READ, lambda: None)

    def discard(self, process: WorkerProcess) -> None:
        """Stop watching ``process``; to be called before its files are closed."""
        self._watched.pop(process, None)
        self._paused.pop(process, None)
        self._polled.discard(process)
        for fd in (process.output_fd, process.end_fd):
            if fd is not None and fd in self._selector.get_map():
                self._selector.unregister(fd)

    def close(self) -> None:
        """Close the files; `wake` does nothing from now on."""
        self._selector.close()
        with self._lock:
            self._is_closed = True
            os.close(self._wake_fd)

    def _register_output(self, process: WorkerProcess) -> None:
        self._selector.register(process.output_fd, selectors.EVENT_READ, partial(self._read, process))

    def _read(self, process: WorkerProcess) -> None:
        is_open = process.read_output(awake_s())
        resume_s = process.resume_reading_s()
        if is_open and resume_s is None:
            return
        self._selector.unregister(process.output_fd)
        if is_open and resume_s is not None:
            self._paused[process] = resume_s


def _printable(line: bytes) -> str:
    """A line as text that cannot command the reader's terminal."""
    return harmless(line.decode(errors="replace").rstrip("\r\n"))


def _own_python(command: Sequence[str]) -> tuple[str, ...]:
    """The command with ``python`` replaced by this interpreter: workers find the daemon's packages.

    Our own workers are not looked for in the current folder, which may hold another ``zsched``.
    """
    if command and command[0] in {"python", "python3"}:
        is_ours = "-m" in command[1:2] and command[2].startswith("zsched.")
        return (sys.executable, *(("-P",) if is_ours else ()), *command[1:])
    return tuple(command)


def _open_pid_fd(pid: int) -> int | None:
    """A file descriptor that becomes readable when ``pid`` ends; ``None`` on kernels before 5.3 (we poll there)."""
    try:
        return os.pidfd_open(pid)
    except OSError:
        return None
