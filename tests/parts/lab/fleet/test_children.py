from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from zsched_lab.fleet.children import ChildError, Children
from zsched_lab.fleet.janitor import SHARED_MEMORY, tagged_processes

SLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]
# Shrugs SIGTERM off, starts a child in a session of its own and says when both are there.
STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
print("up", flush=True)
time.sleep(60)
"""
# A lab that starts a stubborn child, tells its token and waits to be killed.
LAB = f"""
import sys, time
from pathlib import Path
from zsched_lab.fleet.children import Children
folder = Path(sys.argv[1])
with Children(folder / "logs") as children:
    children.janitor.remove(folder / "runtime")
    children.start("stubborn", [sys.executable, "-c", {STUBBORN!r}], output=folder / "up")
    print(children.token, flush=True)
    time.sleep(60)
"""


# A lab that ends by itself, with a stubborn child that makes it last, and tells when it begins to clean up.
ENDING = f"""
import sys
from pathlib import Path
from zsched_lab.fleet.children import Children
from zsched_lab.fleet.signals import Interrupted, interruptible
folder = Path(sys.argv[1])
try:
    with interruptible(), Children(folder / "logs") as children:
        children.start("stubborn", [sys.executable, "-c", {STUBBORN!r}], output=folder / "up")
        while not (folder / "up").exists() or not (folder / "up").read_bytes():
            pass
        print(children.token, flush=True)
except Interrupted:
    sys.exit(130)
"""


def wait_for(condition: Callable[[], bool], deadline_s: float = 60.0) -> bool:
    end = time.monotonic() + deadline_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def test_stop_ends_a_child_within_its_grace(tmp_path: Path) -> None:
    with Children(tmp_path) as children:
        child = children.start("sleeper", SLEEP)
        assert [running.name for running in children.running()] == ["sleeper"]
        children.stop(child, grace_s=60.0)
        assert child.process.returncode == -signal.SIGTERM, "within its grace: else it would have been killed"
        assert children.running() == []
    assert children.left_behind == []


def test_leaving_ends_the_stubborn_and_those_who_left_their_group(tmp_path: Path) -> None:
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    with Children(tmp_path / "logs") as children:
        children.janitor.remove(runtime)
        children.start("stubborn", [sys.executable, "-c", STUBBORN], output=tmp_path / "up")
        assert wait_for((tmp_path / "up").read_bytes)  # type: ignore[arg-type]  # bytes are true when there are any
        assert len(tagged_processes(children.token)) == 2
        children.stop(*children.running(), grace_s=0.2)
        assert len(tagged_processes(children.token)) == 1

    assert tagged_processes(children.token) == []
    assert not runtime.exists()
    assert children.left_behind == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_a_killed_lab_leaves_no_process_and_no_folder(tmp_path: Path, number: signal.Signals) -> None:
    runtime = tmp_path / "runtime"
    runtime.mkdir()
    lab = subprocess.Popen([sys.executable, "-c", LAB, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert lab.stdout is not None
    token = lab.stdout.readline().strip()
    try:
        assert wait_for(lambda: (tmp_path / "up").exists() and (tmp_path / "up").read_bytes() != b"")
        assert len(tagged_processes(token)) == 2
    finally:
        lab.send_signal(number)
        lab.stdout.close()
        lab.wait(timeout=60)

    assert wait_for(lambda: not tagged_processes(token))
    assert wait_for(lambda: not runtime.exists())


def test_a_signal_into_the_clean_up_does_not_cut_it(tmp_path: Path) -> None:
    lab = subprocess.Popen([sys.executable, "-c", ENDING, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert lab.stdout is not None
    with lab.stdout:
        token = lab.stdout.readline().strip()
    time.sleep(0.3)  # it waits for the stubborn child now
    assert tagged_processes(token)
    lab.send_signal(signal.SIGINT)
    time.sleep(0.1)
    lab.send_signal(signal.SIGINT)

    assert lab.wait(timeout=60) == 130
    assert tagged_processes(token) == []


def test_check_names_the_child_that_failed_with_the_end_of_its_log(tmp_path: Path) -> None:
    with Children(tmp_path) as children:
        broken = children.start("broken", [sys.executable, "-c", "import sys; sys.exit('no disk here')"])
        assert wait_for(lambda: not broken.is_running)
        with pytest.raises(ChildError, match=r"(?s)broken ended with 1.*no disk here"):
            children.check()


def test_children_run_one_thread_per_numeric_library(tmp_path: Path) -> None:
    with Children(tmp_path) as children:
        show = "import json, os; print(json.dumps(dict(os.environ)))"
        child = children.start("show", [sys.executable, "-c", show], output=tmp_path / "env")
        assert wait_for(lambda: not child.is_running)
    environment = json.loads((tmp_path / "env").read_text())
    assert environment["OPENBLAS_NUM_THREADS"] == "1"


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason="no /dev/shm here")
def test_the_janitor_removes_orphaned_segments_and_spares_mapped_ones(tmp_path: Path) -> None:
    orphan = SHARED_MEMORY / f"test-{os.getpid()}-orphan.zenoh"
    mapped = SHARED_MEMORY / f"test-{os.getpid()}-mapped.zenoh"
    hold = f"""
import mmap, time
with open({str(mapped)!r}, "w+b") as file:
    file.truncate(4096)
    segment = mmap.mmap(file.fileno(), 4096)
print("up", flush=True)
time.sleep(60)
"""
    holder = None
    try:
        with Children(tmp_path):
            orphan.write_bytes(b"x")
            holder = subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE)
            assert holder.stdout is not None
            holder.stdout.readline()
        assert not orphan.exists()
        assert mapped.exists()
    finally:
        if holder is not None and holder.stdout is not None:
            holder.kill()
            holder.stdout.close()
            holder.wait()
        orphan.unlink(missing_ok=True)
        mapped.unlink(missing_ok=True)
