"""`zsched dev` as a newcomer runs it: an example on a terminal, its owner killed, a worker saved, and nothing left."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import pytest

from support.waiting import until
from zsched.tools.example import Example, write_example

pytestmark = pytest.mark.long

CLI = (sys.executable, "-m", "zsched.cli")
END_S = 30.0


class Dev:
    """One run, on a pseudo-terminal or in a pipe; what it prints is gathered."""

    def __init__(self, folder: Path, *, has_terminal: bool, options: tuple[str, ...] = ()) -> None:
        self.folder = folder
        self.said = ""
        self._keys, theirs = pty.openpty() if has_terminal else os.pipe()
        self.process = subprocess.Popen(
            [*CLI, "dev", *options],
            cwd=folder,
            stdin=theirs if has_terminal else subprocess.DEVNULL,
            stdout=theirs,
            stderr=subprocess.STDOUT,
            env={name: value for name, value in os.environ.items() if not name.startswith("ZSCHED_")},
            start_new_session=True,
        )
        os.close(theirs)
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):  # a terminal ends like that
            while chunk := os.read(self._keys, 65536):
                self.said += chunk.decode(errors="replace").replace("\r\n", "\n")

    def press(self, key: str) -> None:
        os.write(self._keys, key.encode())

    def wait(self, pattern: str, after: int = 0) -> re.Match[str]:
        """The first match of what it says from character ``after`` on."""

        def found() -> re.Match[str] | None:
            match = re.compile(pattern).search(self.said, after)
            assert match or self.process.poll() is None, self.said
            return match

        try:
            match: re.Match[str] = until(found, pattern)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.said}") from None
        return match

    def press_until(self, key: str, pattern: str) -> re.Match[str]:
        """Press a key again and again, until what it says then matches."""

        first = len(self.said)

        def pressed() -> re.Match[str] | None:
            if (match := re.compile(pattern).search(self.said, first)) is None:
                told = len(self.said)
                self.press(key)
                self.wait(r"\n", told)
            return match

        match: re.Match[str] = until(pressed, pattern)
        return match

    def wait_ready(self) -> None:
        """Both edges' workers are ready: on a busy machine the second one begins much later than the owner's."""
        self.press_until("s", r"edge1 +edge[^\n]*ready[^\n]*\n[^\n]*edge2 +edge[^\n]*ready")

    @property
    def application(self) -> list[str]:
        """The words of the line that starts the example's application."""
        return shlex.split(self.wait(r"the application, in another terminal:\s+(.+)\n")[1])

    def left(self) -> list[str]:
        """What there still is of the run: its folder, and processes that work in the example's folder."""
        found = [match[1] for match in re.finditer(r"--runtime-dir (\S+)", self.said) if Path(match[1]).exists()]
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdigit() and (entry / "cwd").readlink() == self.folder:
                    found.append((entry / "cmdline").read_text().replace("\0", " "))
        return found


@contextlib.contextmanager
def dev(folder: Path, *, has_terminal: bool = False, options: tuple[str, ...] = ()) -> Iterator[Dev]:
    run = Dev(folder, has_terminal=has_terminal, options=options)
    try:
        yield run
    finally:
        if run.process.poll() is None:
            run.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                run.process.wait(END_S)
        run.process.kill()
        run.process.wait()


class Application:
    """The example's own application, started from another folder; its answers are lines."""

    def __init__(self, words: list[str]) -> None:
        self._process = subprocess.Popen(words, cwd="/", stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
        assert self._process.stdout is not None
        self._pipe = self._process.stdout
        self._rest = b""

    def wait_answer(self, pattern: str) -> None:
        """Wait for an answer that holds ``pattern``."""
        end = time.monotonic() + 60
        while re.search(pattern, self._rest.decode()) is None:
            assert time.monotonic() < end, f"no answer with {pattern}: {self._rest.decode()}"
            if select.select([self._pipe], [], [], 0.5)[0]:
                chunk = os.read(self._pipe.fileno(), 65536)
                assert chunk, "the application has ended"
                self._rest += chunk
        self._rest = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        assert self._process.wait(20) == 0
        self._pipe.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return (tmp_path / "task").resolve()


@pytest.mark.parametrize("example", [Example.PYTHON, Example.ZENOH])
def test_an_example_answers_survives_a_kill_and_leaves_nothing(folder: Path, example: Example) -> None:
    write_example(example, folder)
    with dev(folder, has_terminal=True) as run:
        run.wait(r"shout: on (\w+) \(epoch 1")
        with Application(run.application) as application:
            application.wait_answer(r"\(by \w+\)")
            run.wait_ready()  # else the task waits for its owner, which comes back after 5 s
            told = len(run.said)
            run.press("k")
            # the owner of now: on a busy machine the task may have moved since it was placed
            victim = run.wait(r"kill: (\w+) is dead")[1]
            run.wait(rf"shout: {victim} -> \w+ \(epoch", after=told)
            application.wait_answer(rf"\(by (?!{victim}\))\w+\)")
            run.wait(f"{victim} starts again")
        run.press("q")
        assert run.process.wait(END_S) == 0
        assert run.left() == []


def test_keys_move_load_and_show(folder: Path) -> None:
    write_example(Example.PYTHON, folder)
    with dev(folder, has_terminal=True) as run:
        run.wait(r"shout: on (\w+) \(epoch 1")
        told = len(run.said)
        run.press("s")
        run.wait("fleet example", after=told)
        run.press("l")
        loaded = run.wait(r"load: \d+ busy processes on (\w+)")[1]
        run.press("l")
        run.wait(f"load: ended on {loaded}")
        run.wait("robot1")
        told = len(run.said)
        # on a busy machine the other edge's worker may not be ready yet: then nothing moves
        first = run.press_until("m", r"move: (\w+) is told to stop")[1]
        run.wait(rf"shout: {first} -> \w+ \(epoch (2: {first} is draining\)|[3-9])", after=told)
        run.wait(f"{first} starts again")
        run.press("?")
        run.wait("keys: m moves the task", after=len(run.said) - 200)
        assert [line for line in run.said.splitlines() if line.startswith("dev:") and len(line) > 80] == []
        run.press("\x03")  # Ctrl-C, as the terminal sends it: no signal here, since the run has a session of its own
        run.process.send_signal(signal.SIGINT)
        assert run.process.wait(END_S) == 0
        assert run.left() == []


def test_a_saved_worker_is_started_again_and_a_broken_one_leaves_the_owner_its_own(folder: Path) -> None:
    write_example(Example.PYTHON, folder)
    worker = folder / "worker.py"
    good = worker.read_text()
    with dev(folder, options=("fleet.yaml", "--task", "worker.py")) as run:
        run.wait(r"shout: on (\w+) \(epoch 1")
        run.wait("no terminal, no keys")
        with Application(run.application) as application:
            application.wait_answer(r"\(by ")
            worker.write_text(good.replace("(by ", "(from "))
            run.wait("every worker runs what was saved")
            application.wait_answer(r"\(from ")
            worker.write_text("raise SystemExit('this is broken')\n")
            run.wait(r"\| this is broken")
            run.wait(r"the new worker is not ready on (\w+) \(failed after \d+ s\); (\w+) keeps the worker that it has")
            application.wait_answer(r"\(from ")
            told = len(run.said)
            worker.write_text(good)
            run.wait("every worker runs what was saved", after=told)
            application.wait_answer(r"\(by ")
        run.process.send_signal(signal.SIGTERM)
        assert run.process.wait(END_S) == 0
        assert run.left() == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_at_any_time_leaves_nothing(folder: Path, number: signal.Signals) -> None:
    write_example(Example.ZENOH, folder)
    with dev(folder) as run:
        run.wait("another terminal")
        time.sleep({signal.SIGINT: 0.0, signal.SIGTERM: 0.7, signal.SIGHUP: 2.0}[number])  # daemons start meanwhile
        run.process.send_signal(number)
        assert run.process.wait(END_S) == 0
        assert run.left() == []
