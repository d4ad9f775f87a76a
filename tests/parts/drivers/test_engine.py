"""The loop of all drivers, with a real process that is not the driver's child: its end, signals, the driver's end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from support.waiting import until

PROGRAM = Path(__file__).with_name("outside_engine.py")


@contextmanager
def driver(folder: Path, mode: str = "") -> Iterator[subprocess.Popen[str]]:
    """A driver in a session of its own, as the daemon starts it."""
    told = {
        "ZSCHED_FLEET": "f",
        "ZSCHED_NODE": "edge1",
        "ZSCHED_TASK": "t",
        "ZSCHED_INCARNATION": "1",
        "ZSCHED_ZENOH_CONFIG": str(folder / "edge1-t.zenoh.json5"),
    }
    with subprocess.Popen(
        [sys.executable, str(PROGRAM), mode],
        env={**os.environ, **told},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def noted(folder: Path) -> int:
    """The worker's process, once the driver has noted it."""
    path = folder / "edge1-t.pid"
    return int(until(lambda: path.read_text().split()[0] if path.exists() else "", "the worker's process is noted"))


def output(process: subprocess.Popen[str]) -> str:
    said, _ = process.communicate(timeout=30)
    return said


def test_the_end_of_the_worker_is_the_drivers_with_its_reason(tmp_path: Path) -> None:
    with driver(tmp_path) as process:
        os.kill(noted(tmp_path), signal.SIGKILL)
        assert output(process).splitlines()[-1] == "it has ended, status 0"
        assert process.returncode == 1
    assert list(tmp_path.iterdir()) == []


def test_what_is_left_after_an_end_is_cleared_away(tmp_path: Path) -> None:
    with driver(tmp_path, "messy") as process:
        noted(tmp_path)
        os.killpg(process.pid, signal.SIGINT)
        assert output(process).splitlines() == ["it runs"]
    until((tmp_path / "cleared").exists, "the keeper has cleared away, after the driver's end")


def test_what_cannot_run_here_says_so_by_its_status(tmp_path: Path) -> None:
    with driver(tmp_path, "refuse") as process:
        assert output(process) == "there is no such thing here\n"
        assert process.returncode == 78


def test_a_stop_that_comes_while_the_driver_begins_starts_no_worker(tmp_path: Path) -> None:
    """A withdrawn standby was started, and killed hard after its grace."""
    with driver(tmp_path, "late") as process:
        assert output(process) == ""
        assert process.returncode == 0


@pytest.mark.parametrize("mode", ["", "deaf"])
def test_signals_end_the_worker_the_second_one_at_once(tmp_path: Path, mode: str) -> None:
    with driver(tmp_path, mode) as process:
        worker = psutil.Process(noted(tmp_path))
        os.killpg(process.pid, signal.SIGINT)
        if mode == "deaf":
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.3)
            os.killpg(process.pid, signal.SIGTERM)
        assert output(process).splitlines() == ["it runs"]
        assert process.returncode == 0, "an end that was asked for is no failure"
        assert not worker.is_running()


def test_a_driver_that_is_killed_takes_its_worker_along(tmp_path: Path) -> None:
    with driver(tmp_path) as process:
        worker = psutil.Process(noted(tmp_path))
        followers = psutil.Process(process.pid).children()
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(30)
        until(lambda: not worker.is_running(), "the worker has gone with its driver")
        until(lambda: not any(one.is_running() for one in followers), "and what followed it")
