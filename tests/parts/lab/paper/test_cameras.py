from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from zsched_lab.fleet.neural_load import Network
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.paper.cameras import Camera, next_frame


def test_streams_run_side_by_side_and_end_on_sigterm(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with output.open("wb") as file:
        command = [
            sys.executable,
            "-m",
            "zsched_lab.paper.cameras",
            "--streams",
            "3",
            "--cores",
            "0.05",
            "--side",
            "32",
        ]
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 90.0
        while output.read_bytes().count(b"\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        threads = len(list(Path(f"/proc/{process.pid}/task").iterdir()))
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.wait()
    lines = [json.loads(line) for line in output.read_bytes().splitlines()]
    assert threads >= 4
    assert lines[-1]["streams"] == 3
    assert 0 < lines[0]["frames"] < lines[-1]["frames"]


def test_a_stream_pauses_by_its_own_cpu_time_and_catches_nothing_up() -> None:
    assert next_frame(10.0, 10.0, 0.05, 0.25) == pytest.approx(10.2)
    assert next_frame(10.0, 99.0, 0.05, 0.25) == pytest.approx(99.2)  # late: a full node
    assert next_frame(10.2, 10.1, 0.05, 0.25) == pytest.approx(10.4)
    assert next_frame(10.0, 10.0, 0.05, 0.0) == 10.0  # all it can get


def test_streams_take_the_cpu_that_they_are_given() -> None:
    stop, network = StopFlag(), Network(name="busy", infer=lambda _: burn(0.02))
    cameras = [Camera(network, 0.1, 32, stop) for _ in range(2)]
    began, before = time.monotonic(), time.process_time()
    for camera in cameras:
        camera.start()
    deadline = began + 90.0
    while min(camera.frames for camera in cameras) < 6 and time.monotonic() < deadline:
        time.sleep(0.05)
    stop.is_set = True
    for camera in cameras:
        camera.join(60.0)
    used = (time.process_time() - before) / (time.monotonic() - began)

    assert min(camera.frames for camera in cameras) >= 6
    assert used < 2 * 0.1 * 1.5  # both together; less on a machine that is short of CPU


def burn(cpu_s: float) -> None:
    until = time.thread_time() + cpu_s
    while time.thread_time() < until:
        pass
