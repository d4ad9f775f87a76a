"""Workers of another user, by a real starter that runs as one: started, signalled, ended, and refused to strangers."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from support.waiting import until
from zsched.core.values.errors import AdapterError
from zsched.host.clock import awake_s
from zsched.host.workers.hired import USER, Hired, starter_of
from zsched.host.workers.process import WorkerProcess

REPO = Path(__file__).parents[4]
PYTHON = "/usr/bin/python3"
"""One that another user may run."""
OTHER = 54321
RUN = """
import os, socket, sys
from pathlib import Path
from zsched.host.workers.starter import Starter
listener = socket.socket(fileno=int(sys.argv[1]))
Starter(listener, frozenset({int(sys.argv[2])}), Path(sys.argv[3])).run()
"""
SLEEPER = (
    "import signal, time; [signal.signal(n, signal.SIG_IGN) for n in (2, 15)]; print('up', flush=True); time.sleep(600)"
)
pytestmark = [pytest.mark.root, pytest.mark.timeout(60)]


@contextmanager
def starting(tmp_path: Path, asker: int = 0) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """A starter's socket, and its process: of another user, for orders of the user ``asker``."""
    code, folder, path = tmp_path / "code", tmp_path / "own", tmp_path / "other.sock"
    below = tmp_path.parts.index(next(part for part in tmp_path.parts if part.startswith("pytest-of-")))
    for one in (tmp_path, *tmp_path.parents[: len(tmp_path.parts) - below - 1]):  # one more beside other workers
        one.chmod(0o755)
    for name in ("__init__.py", "host/__init__.py", "host/workers/__init__.py"):
        (code / "zsched" / name).parent.mkdir(parents=True, exist_ok=True)
        (code / "zsched" / name).touch()
    for name in ("starter.py", "launch.py"):
        (code / "zsched/host/workers" / name).write_text((REPO / "zsched/host/workers" / name).read_text())
    folder.mkdir()
    os.chown(folder, OTHER, OTHER)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        process = subprocess.Popen(
            [PYTHON, "-c", RUN, str(listener.fileno()), str(asker), str(folder)],
            env={
                "PYTHONPATH": str(code),
                "PYTHONDONTWRITEBYTECODE": "1",
                "OF_ITS_UNIT": "1",
                "PATH": os.environ["PATH"],
            },
            pass_fds=[listener.fileno()],
            user=OTHER,
            group=OTHER,
            extra_groups=[],
            cwd="/",
        )
        try:
            yield path, process
        finally:
            process.kill()
            process.wait(timeout=10.0)


def ended(process: WorkerProcess) -> int:
    until(process.has_exited, "the worker ends")
    return process.finish(awake_s())


def worker(starter: Path, code: str, session: str = "", **environment: str) -> WorkerProcess:
    logger = logging.getLogger("hired")
    return WorkerProcess((PYTHON, "-c", code), environment, logger, None, starter, session)


def test_it_runs_as_the_other_user_with_the_units_variables_and_a_session_of_its_own(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "hired")
    session = tmp_path / "edge1-echo.zenoh.json5"
    code = "import os; e = os.environ; p = e['ZSCHED_ZENOH_CONFIG']; print(os.getuid(), os.getpgrp() == os.getpid(), "
    code += "open(p).read(), oct(os.stat(p).st_mode), p == e['ZENOH_CONFIG'], e['OF_ITS_UNIT'], 'HOME' in e)"
    with starting(tmp_path) as (path, starter):
        process = worker(path, code, "{}", ZSCHED_ZENOH_CONFIG=str(session), ZENOH_CONFIG=str(session))
        assert process.group is None
        assert ended(process) == 0
        assert starter.wait(timeout=10.0) == 0  # the last one has gone
    assert caplog.messages == [f"{OTHER} True {{}} 0o100600 True 1 False"]
    assert not session.exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_signals_reach_it_and_tell_how_it_ended(tmp_path: Path, number: signal.Signals) -> None:
    with starting(tmp_path) as (path, _):
        process = worker(path, "import time; time.sleep(600)")
        assert psutil.Process(process.pid).uids().real == OTHER
        assert not process.has_exited()
        until(lambda: "sleep" in " ".join(psutil.Process(process.pid).cmdline()[:3]), "it has become its command")
        process.signal_group(number)
        assert ended(process) == -number


def test_its_status_comes_back_and_what_it_left_in_its_group_is_killed(tmp_path: Path) -> None:
    code = "import subprocess, sys; print(subprocess.Popen(['sleep', '600']).pid, flush=True); sys.exit(78)"
    with starting(tmp_path) as (path, starter):
        process = worker(path, code)
        assert ended(process) == 78
        left = int(process.last_line)
        until(lambda: not psutil.pid_exists(left), "its child ends")
        assert starter.wait(timeout=10.0) == 0


def test_it_dies_with_its_daemon_and_with_its_starter(tmp_path: Path) -> None:
    for who in ("daemon", "starter"):
        with starting(tmp_path) as (path, starter):
            link = Hired(path, (PYTHON, "-c", SLEEPER), {}, "")
            assert os.read(link.output_fd, 10) == b"up\n"
            process = psutil.Process(link.pid)
            if who == "daemon":  # whose descriptors the kernel closes
                link.close()
                process.wait(timeout=10.0)
                assert starter.wait(timeout=10.0) == 0
            else:
                starter.kill()
                process.wait(timeout=10.0)
                until(link.has_exited, "the starter's end is seen")
                assert link.wait() == -signal.SIGKILL
                link.close()
        path.unlink()
        (tmp_path / "own").rmdir()


@pytest.mark.parametrize("greeting", [b"", b"pid 1\n"])
def test_a_starter_that_babbles_holds_nobody_up(tmp_path: Path, greeting: bytes) -> None:
    """Its workers have its user, and may have taken it over."""
    is_over, path = threading.Event(), tmp_path / "other.sock"

    def babble(listener: socket.socket) -> None:
        link, _ = listener.accept()
        with link, contextlib.suppress(OSError):
            link.sendall(greeting)
            while not is_over.is_set():
                link.sendall(b"." * 4096)

    timer = threading.Timer(5.0, is_over.set)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        thread = threading.Thread(target=babble, args=(listener,))
        thread.start()
        timer.start()
        try:
            if greeting:
                link = Hired(path, ("true",), {}, "")
                until(link.has_exited, "it counts as ended")
                link.close()
            else:
                with pytest.raises(AdapterError, match="it refuses this daemon"):
                    Hired(path, ("true",), {}, "")
            assert not is_over.is_set()
        finally:
            is_over.set()
            timer.cancel()
            thread.join(timeout=10.0)


def test_a_stranger_starts_nothing(tmp_path: Path) -> None:
    """An operator may open the socket: it is for the daemon's group."""
    with starting(tmp_path, asker=4242) as (path, starter):
        with pytest.raises(AdapterError, match="it refuses this daemon"):
            worker(path, "print('in')")
        assert starter.wait(timeout=10.0) == 0


def test_where_nobody_starts_workers_as_a_user_it_is_said_what_to_do(tmp_path: Path) -> None:
    env = {"ZSCHED_STARTERS": str(tmp_path)}
    assert starter_of("", {}) is None
    assert starter_of("", env) is None
    (tmp_path / f"{USER}.sock").touch()
    assert starter_of("", env) == tmp_path / f"{USER}.sock"
    named = starter_of("ros", env)
    assert named == tmp_path / "ros.sock"
    with pytest.raises(
        AdapterError, match=r"as user ros here \(.*\): sudo systemctl enable --now zsched-worker@ros.sock"
    ):
        worker(named, "print('in')")
