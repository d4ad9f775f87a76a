"""Starts and ends the lab's processes so that none is left, however the lab itself ends.

Knows: process groups, logs, the janitor. Does not know: what the processes are.

Three nets, each for what the one before misses: an orderly stop (SIGTERM, then SIGKILL, by process group), the parent
death signal (`zsched.host.workers.launch`) when the lab is killed, and the janitor, which finds every process of
the run by its environment. Start children from the main thread only: the death signal follows the thread that forked.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from zsched.core.values.errors import ZschedError
from zsched.host.workers import launch
from zsched_lab.fleet.janitor import TOKEN_VARIABLE

STOP_GRACE_S = 3.0
THREAD_LIMITS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Twenty processes share the machine's cores: none may start a pool of its own."""


class ChildError(ZschedError):
    """A process of the lab ended when it should not have; says which, with what, and where its log is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Child:
    """One running process: its group's id is its pid."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def is_running(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.poll() is None

    def log_tail(self, lines: int = 5) -> str:
        """The log's last lines, to show with an error."""
        with contextlib.suppress(OSError):
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])
        return ""


class Janitor:
    """The handle on `zsched_lab.fleet.janitor`: told what to remove, set off by `finish` or by our death."""

    def __init__(self, token: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "zsched_lab.fleet.janitor", token],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            text=True,
        )

    def remove(self, folder: Path) -> None:
        """Remove ``folder`` and all in it at the end. Tell it before making the folder: a kill may come between."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"remove": str(folder)}) + "\n")
        self._process.stdin.flush()

    def finish(self, timeout_s: float = 60.0) -> list[str]:
        """Set the janitor off and wait for it; returns what it could not remove."""
        try:
            answer, _ = self._process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            return [f"the janitor was at work for {timeout_s:g} s and was ended"]
        with contextlib.suppress(ValueError, KeyError):
            return [str(item) for item in json.loads(answer)["left"]]
        return ["janitor gave no answer"]


class Children:
    """All processes of one run. As a context it ends them on the way out, whatever the reason."""

    def __init__(self, logs: Path) -> None:
        logs.mkdir(parents=True, exist_ok=True)
        self._logs = logs
        self._children: dict[str, Child] = {}
        self.token = secrets.token_hex(8)
        self.janitor = Janitor(self.token)
        self.left_behind: list[str] = []

    def environment(self) -> dict[str, str]:
        """Ours, with the run's token and one thread per numeric library; no program is looked for in our folder."""
        return {**os.environ, **THREAD_LIMITS, "PYTHONSAFEPATH": "1", TOKEN_VARIABLE: self.token}

    def start(self, name: str, command: list[str], *, output: Path | None = None) -> Child:
        """Start ``command`` as ``name``, bound to our life; stderr (and stdout, without ``output``) go to its log.

        Raises `ChildError` when it cannot be started.
        """
        log = self._logs / f"{name}.log"
        bound = [sys.executable, "-I", "-S", str(launch.__file__), str(os.getpid()), *command]
        with contextlib.ExitStack() as stack:
            errors = stack.enter_context(log.open("ab"))
            out = stack.enter_context(output.open("ab")) if output else errors
            try:
                process = subprocess.Popen(
                    bound,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=errors,
                    env=self.environment(),
                    start_new_session=True,
                )
            except OSError as error:
                raise ChildError(f"{name}: {command[0]} cannot be started: {error}") from error
        child = Child(name=name, process=process, log=log)
        self._children[name] = child
        return child

    def stop(self, *children: Child, grace_s: float = STOP_GRACE_S) -> None:
        """SIGTERM to each at once, SIGKILL to their groups when they ended or after ``grace_s``; reaped on return.

        The leader alone is asked to stop: what it started is its own to end, in its own order.
        """
        for child in children:
            child.process.send_signal(signal.SIGTERM)
        end = time.monotonic() + grace_s
        for child in children:
            wait_unreaped(child, end)
        for child in children:
            # Also to those that ended: what they started may have stayed in their group.
            kill_group(child)
            child.process.wait()
            self._children.pop(child.name, None)

    def check(self) -> None:
        """Raise `ChildError` for the first child that ended by itself with an error."""
        for child in self._children.values():
            code = child.process.poll()
            if code:
                raise ChildError(f"{child.name} ended with {code}; see {child.log}\n{child.log_tail()}")

    def running(self, prefix: str = "") -> list[Child]:
        """The children that have not been stopped, by the start of their names."""
        return [child for name, child in self._children.items() if name.startswith(prefix)]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except BaseException:
            self.close()  # Ctrl-C hit the clean-up itself (see `interruptible`: it hits once)
            raise

    def close(self) -> None:
        """End everything; idempotent. `left_behind` says what could not be removed (empty: nothing is left)."""
        self.stop(*self._children.values())
        self.left_behind = self.janitor.finish()


def kill_group(child: Child) -> None:
    """SIGKILL to the child's process group, unless it was reaped (its number may then be another's)."""
    if child.process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child.process.pid, signal.SIGKILL)


def wait_unreaped(child: Child, end: float) -> None:
    """Wait until the child has ended or the monotonic time ``end``, leaving its number taken."""
    while child.process.returncode is None:
        if os.waitid(os.P_PID, child.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return
        if time.monotonic() > end:
            return
        time.sleep(0.01)
