"""What a driver asks of an engine, the thing that keeps the worker's process, and the loop that asks it.

A driver is a worker's process like any other: the daemon starts it, reads what it prints, asks it to end by SIGINT and
SIGTERM, and takes its end as the worker's. So restarts, limits, logs and reasons are those of
`zsched.host.workers.supervisor`, and the daemon loads nothing of any engine.

Knows: signals, the order of an engine's commands, exit statuses. Does not know: which engine there is, zenoh.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_OK
from zsched.core.values.struct import Struct
from zsched.drivers.place import Place
from zsched.host.guard import guarded
from zsched.host.workers.process import LAUNCHER

COMMAND_S: Final = 10.0
"""An engine that does not answer a command within this time has failed."""
LAST_LINES_S: Final = 0.3
"""The follower of the log gets this long for what the worker has printed last."""
FIRST_LOOK_S: Final = 0.1
LOOK_S: Final = 10.0
"""How often the worker's process is looked up: an engine may start it again by itself."""

KEEPER: Final = "trap '' INT TERM HUP; read -r said; [ \"$said\" = done ] || {{ {stop}; }}"
"""Reads from the driver's pipe. When it closes without a word, the driver was killed: the engine is asked to stop."""


class Ended(Struct, frozen=True, kw_only=True):
    """The end of a worker that nobody has asked for."""

    reason: str
    """One line for `zsched status`."""
    is_final: bool = False
    """It cannot run on this machine: it is not started again (exit status 78)."""


class Look(Struct, frozen=True, kw_only=True):
    """What `zsched doctor` finds of a worker's engine on this machine."""

    told: str
    fix: str = ""
    """What to do; empty: nothing."""
    is_fatal: bool = True
    """With ``fix``: the worker cannot be started."""


class Engine(Protocol):
    """One worker under one engine. The methods are called by one thread, in this order; `stop` may come at any time."""

    is_child: bool
    """`run` is the worker itself, not a command that follows it: it gets the daemon's signals as this process does."""

    leaves_nothing: bool
    """After the worker's end there is nothing to clear away; otherwise `last_resort` is run in any case."""

    def begin(self, tell_end: Callable[[Ended], None]) -> Ended | None:
        """Look whether it can be started, and clear away what a dead driver has left; ``None``: go on.

        ``tell_end`` may be called by any thread, for an end that `run` does not show.
        """
        ...

    def run(self) -> Sequence[str]:
        """The command that starts the worker and lasts as long as it does; empty: somebody else has started it."""
        ...

    def log(self) -> Sequence[str]:
        """The command that prints what the worker prints; empty: `run` does."""
        ...

    def pid(self) -> int | None:
        """The worker's own process, whose CPU and memory count as the task's; ``None``: not known, or the driver's."""
        ...

    def stop(self, *, is_hard: bool) -> None:
        """Tell the worker to end; ``is_hard``: at once."""
        ...

    def why(self, status: int) -> Ended:
        """Why the worker has ended, ``status`` being `run`'s as `subprocess` gives it."""
        ...

    def last_resort(self) -> str:
        """The shell commands that end the worker when the driver was killed; empty: none."""
        ...


def ask(*command: str) -> subprocess.CompletedProcess[str]:
    """Run one of the engine's commands; a program that is missing or does not answer gives a status and a sentence."""
    try:
        return subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",  # a worker's last line may be of any bytes
            timeout=COMMAND_S,
            check=False,
        )
    except FileNotFoundError:
        return subprocess.CompletedProcess(command, 127, "", f"there is no program {command[0]} on this machine")
    except OSError as error:
        return subprocess.CompletedProcess(command, 126, "", f"{command[0]}: {error.strerror}")
    except subprocess.TimeoutExpired:
        said = f"{' '.join(command[:2])} does not answer within {COMMAND_S:g} s"
        return subprocess.CompletedProcess(command, 124, "", said)


def said(done: subprocess.CompletedProcess[str]) -> str:
    """The last line that a command has printed about its failure."""
    lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
    return lines[-1].strip() if lines else f"{done.args[0]} ended with status {done.returncode}"


def begin(make: Callable[[Place], Engine], names: Sequence[str]) -> int:
    """Drive what ``make`` gives for the worker that the daemon's variables name; the exit status.

    ``names``: the task's own variables, of ``env:``.
    """
    try:
        place = Place.from_env(os.environ, names)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return EXIT_CONFIG
    return drive(make(place), place)


def drive(engine: Engine, place: Place) -> int:
    """Start the worker, keep it until it ends or a signal asks for its end; the exit status."""
    return _Drive(engine, place).run()


class _Drive:
    """One life of a worker."""

    def __init__(self, engine: Engine, place: Place) -> None:
        self._engine, self._place = engine, place
        self._news: queue.SimpleQueue[int | Ended | None] = queue.SimpleQueue()
        """A signal, an end that the engine tells, or ``None``: the command has ended."""
        self._child: subprocess.Popen[bytes] | None = None
        self._is_asked = False
        """Whether somebody has asked for its end."""
        self._signals = 0

    def run(self) -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._take)
        refused = self._engine.begin(self._news.put)
        if self._is_asked:  # there is nothing to stop yet, and it would start behind the signal
            return EXIT_OK
        if refused is not None:
            return self._ends(refused)
        with _Keeper(self._engine.last_resort(), is_always=not self._engine.leaves_nothing):
            log = self._engine.log()
            follower = _tied(log, is_child=False) if log else None
            self._start()
            end = self._follow()
            if follower is not None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    follower.wait(LAST_LINES_S)
                follower.kill()
                follower.wait()
        self._place.forget()
        return EXIT_OK if end is None else self._ends(end)

    def _take(self, number: int, _frame: object) -> None:
        self._is_asked = True
        self._news.put(number)

    def _start(self) -> None:
        command = self._engine.run()
        if not command:
            return
        self._child = _tied(command, is_child=self._engine.is_child)
        guarded(self._await_child, self._child, name="zsched driver", is_lasting=False).start()

    def _await_child(self, child: subprocess.Popen[bytes]) -> None:
        child.wait()
        self._news.put(None)

    def _follow(self) -> Ended | None:
        """Until the worker's end; ``None``: it was asked for."""
        noted, pause_s = None, FIRST_LOOK_S
        while True:
            try:
                news = self._news.get(timeout=pause_s)
            except queue.Empty:
                pid = self._engine.pid()
                if pid != noted:
                    self._place.note(pid)
                noted, pause_s = pid, min(2 * pause_s, LOOK_S)
                continue
            if isinstance(news, Ended):
                return None if self._signals else news
            if news is None:
                assert self._child is not None
                return None if self._signals else self._engine.why(self._child.returncode)
            self._signals += 1
            self._engine.stop(is_hard=self._signals > 1)
            if self._child is None:
                return None

    def _ends(self, end: Ended) -> int:
        print(end.reason, file=sys.stderr, flush=True)
        return EXIT_CONFIG if end.is_final else EXIT_FAILED


class _Keeper:
    """A shell of a session of its own, which ends the worker when this process is killed.

    ``is_always``: it also runs ``stop`` when this process ends by itself. The daemon kills a driver that takes long to
    end, with all of its group: what a clear-up must finish is done here.
    """

    def __init__(self, stop: str, *, is_always: bool) -> None:
        self._shell: subprocess.Popen[bytes] | None = None
        self._last_word = b"" if is_always else b"done\n"
        if stop:
            script = KEEPER.format(stop=stop)
            self._shell = subprocess.Popen(
                ["/bin/sh", "-c", script, "zsched-keeper"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                cwd="/",
            )

    def __enter__(self) -> None:
        """Nothing to do."""

    def __exit__(self, *_: object) -> None:
        """The worker has ended."""
        if self._shell is None or self._shell.stdin is None:
            return
        with contextlib.suppress(OSError):
            self._shell.stdin.write(self._last_word)
            self._shell.stdin.close()
        if self._last_word:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._shell.wait(1.0)


def _tied(command: Sequence[str], *, is_child: bool) -> subprocess.Popen[bytes]:
    """A command that cannot outlive this process; one that only follows the worker hears no signals of the daemon."""
    words = [sys.executable, "-I", "-S", LAUNCHER, str(os.getpid()), *command]
    return subprocess.Popen(words, stdin=subprocess.DEVNULL, start_new_session=not is_child)
