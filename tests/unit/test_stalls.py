"""Below a red test with real processes stands how the machine was while it ran."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support import stalls
from support.stalls import Stalls, now
from support.waiting import until

TESTS = Path(__file__).parent.parent
CASES = """
def test_wrong():
    assert False

def test_right():
    pass
"""


def test_a_disk_that_takes_long_is_told_while_it_does_and_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_slow, sync = [True], os.fsync

    def slow_sync(number: int) -> None:
        while is_slow[0]:
            time.sleep(0.01)
        sync(number)

    monkeypatch.setattr(os, "fsync", slow_sync)
    monkeypatch.setattr(stalls, "DISK_PERIOD_S", 0.01)
    began = now()
    watch = Stalls(tmp_path / "file")
    try:
        until(lambda: "4 KiB were on their way to the disk, and still for " in watch.told(began), "it is stuck")
        is_slow[0] = False
        until(lambda: "4 KiB were on their way to the disk for " in watch.told(began), "it was stuck")
        assert "4 KiB" not in watch.told(now()), "that was before"
    finally:
        is_slow[0] = False
        watch.close()
    assert not (tmp_path / "file").exists()


def test_a_process_that_stands_still_tells_it(tmp_path: Path) -> None:
    script = """
import os, signal, sys, time
from pathlib import Path
from support.stalls import Stalls, now
began, watch = now(), Stalls(Path(sys.argv[1]))
if (pid := os.fork()) == 0:
    time.sleep(0.5)
    os.kill(os.getppid(), signal.SIGSTOP)
    time.sleep(2.0)
    os.kill(os.getppid(), signal.SIGCONT)
    os._exit(0)
while "this process did not run for " not in watch.told(began):
    time.sleep(0.05)
watch.close()
print(watch.told(began))
"""
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "file"],
        env=os.environ | {"PYTHONPATH": str(TESTS)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    head, *lines = done.stdout.splitlines()
    assert head.startswith("load ")
    assert "some process waited for cpu " in head
    assert any("s: this process did not run for " in line for line in lines)


def test_a_red_test_with_real_processes_has_it_and_no_other_one(tmp_path: Path) -> None:
    shutil.copy(TESTS / "conftest.py", tmp_path)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["-c", str(TESTS.parent / "pyproject.toml"), "--rootdir", str(tmp_path), str(tmp_path)]
    for folder, times in (("system", 1), ("unit", 0)):
        case = tmp_path / "tests" / folder / "test_cases.py"
        case.parent.mkdir(parents=True)
        case.write_text(CASES)
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert "1 failed, 1 passed" in done.stdout, done.stdout
        assert done.stdout.count(" The machine meanwhile ") == times, done.stdout
        case.unlink()
