"""The command line at its edges: interrupted while it loads, an answer that cannot be written, a folder of others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from support.waiting import until
from zsched.cli import app
from zsched.core.values.errors import AdapterError
from zsched.host.state_file import StateFile
from zsched_lab.fleet.testbed import Testbed, echo_fleet

MAIN = "from zsched.__main__ import main; main()"
INTERRUPTED = """
import sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Finder())
sys.argv[1:] = ["status"]
"""


def test_an_interrupt_while_it_loads_is_no_traceback() -> None:
    command = [sys.executable, "-c", INTERRUPTED + MAIN]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("verb", [["version"], ["version", "--json"], ["--help"]])
def test_an_answer_that_cannot_be_written_is_said_in_a_sentence(verb: list[str], unbuffered: str) -> None:
    """As when the disk behind ``> file`` is full."""
    with Path("/dev/full").open("wb") as full:
        command = [sys.executable, "-c", MAIN, *verb]
        env = {**os.environ, "PYTHONUNBUFFERED": unbuffered}  # with a buffer the last flush finds it
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False, env=env)
    assert done.returncode == 1
    assert done.stderr == "zsched: the answer cannot be written: No space left on device; see where stdout goes\n"


def test_an_interrupt_while_the_daemon_loads_is_an_orderly_stop(tmp_path: Path) -> None:
    """Ctrl-C right after `zsched up` has become the daemon, which has not read its fleet file yet."""
    bed = Testbed(tmp_path, echo_fleet(robots=1, edges=0))
    bed.init()
    command = [sys.executable, "-c", MAIN, "up", "--config", str(bed.file), "--node", "robot1"]
    command += ["--state-dir", str(tmp_path / "robot1"), "--runtime-dir", str(tmp_path)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        line = Path(f"/proc/{process.pid}/cmdline")
        until(lambda: b"zsched.daemon" in line.read_bytes() or process.poll() is not None, "the daemon's process")
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait(60)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    assert "stopping node=robot1" in said


def test_a_folder_of_our_name_in_the_current_one_is_not_taken_for_the_program(tmp_path: Path) -> None:
    """In the parent of an editable clone neither daemon nor relay nor worker could be imported."""
    bed = Testbed(tmp_path, echo_fleet(robots=1, edges=0))
    bed.init()
    (tmp_path / "zsched").mkdir()
    command = [sys.executable, "-P", "-c", MAIN, "up", "--config", str(bed.file), "--node", "robot1"]
    command += ["--state-dir", str(tmp_path / "robot1"), "--runtime-dir", str(tmp_path)]
    process = subprocess.Popen(command, cwd=tmp_path)
    try:
        socket = tmp_path / "robot1.sock"
        until(lambda: socket.exists() or process.poll() is not None, "the daemon's socket")
        bed.wait(lambda: bed.task("robot1")["owner"] == "robot1", 60, "a worker that is ready")
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait(60)


def test_up_on_a_machine_that_the_file_does_not_name_says_only_that(tmp_path: Path) -> None:
    bed = Testbed(tmp_path, echo_fleet(robots=1, edges=0))
    command = [
        sys.executable,
        "-c",
        MAIN,
        "up",
        "--config",
        str(bed.file),
        "--node",
        "vm",
        "--state-dir",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 78
    assert "no node 'vm' under 'nodes' (there are robot1)" in done.stderr
    assert "init" not in done.stderr


def test_up_without_a_state_gives_the_command_that_makes_it(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        bed.start()
        wanted = f"`zsched init --config {bed.file} --node robot1 --state-dir {tmp_path / 'robot1'}`"
        bed.wait(lambda: wanted in bed.log("robot1"), 60, "the command in the log")


@pytest.mark.root
def test_up_with_a_state_folder_of_others_leaves_the_word_to_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which says whose it is; `up` looked into it first, and ended in a traceback."""
    bed = Testbed(tmp_path, echo_fleet(robots=1, edges=0))
    (tmp_path / "state").mkdir(0o700)
    bed.file.chmod(0o644)
    for folder in (tmp_path, *tmp_path.parents):
        if "pytest" in folder.as_posix():
            folder.chmod(0o755)
    started: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda _path, command: started.append(command))
    monkeypatch.setattr(signal, "pthread_sigmask", lambda *_: None)
    arguments = ["up", "--config", str(bed.file), "--node", "robot1", "--state-dir", str(tmp_path / "state")]
    os.seteuid(65534)
    try:
        result = CliRunner().invoke(app, arguments, catch_exceptions=False)
        with pytest.raises(AdapterError, match=r"the state folder \S+: Permission denied; run this by sudo"):
            StateFile(tmp_path / "state", fleet="testbed", node="robot1").acquire()
    finally:
        os.seteuid(0)
    assert result.exit_code == 0
    assert "zsched.daemon" in started[0]


@pytest.mark.root
def test_a_folder_without_permission_is_one_line_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(0o700)
    for folder in (tmp_path, *tmp_path.parents):
        if "pytest" in folder.as_posix():
            folder.chmod(0o755)
    monkeypatch.chdir(closed)
    CliRunner().invoke(app, ["dev", "none.yaml"])  # what it loads is root's
    os.seteuid(65534)
    try:
        result = CliRunner().invoke(app, ["dev"])
    finally:
        os.seteuid(0)
    assert (result.exit_code, len(result.stderr.splitlines())) == (1, 1), result.output
    assert result.stderr.startswith("zsched dev: fleet.yaml: Permission denied; run this by sudo")
