from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from zsched.lab.paper.cameras import main


@pytest.mark.parametrize("wrong", [["--streams", "0"], ["--side", "100"], ["--hz", "-1"]])
def test_wrong_options_exit_2(wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(wrong)
    assert caught.value.code == 2


def test_streams_run_side_by_side_and_end_on_sigterm(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with output.open("wb") as file:
        command = [sys.executable, "-m", "zsched.lab.paper.cameras", "--streams", "3", "--hz", "5", "--side", "32"]
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 40.0
        while output.read_bytes().count(b"\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        threads = len(list(Path(f"/proc/{process.pid}/task").iterdir()))
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10.0) == 0
    finally:
        process.kill()
        process.wait()
    lines = [json.loads(line) for line in output.read_bytes().splitlines()]
    assert threads >= 4
    assert lines[-1]["streams"] == 3
    assert 0 < lines[0]["frames"] < lines[-1]["frames"]
    assert lines[-1]["fps"] <= 3 * 5 * 1.5
