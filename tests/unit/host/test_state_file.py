"""The state file on real disks: torn, flipped, foreign, locked, full, and killed in the middle of a save."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import tuning_of
from support.states import state_of
from zsched.core.values.errors import AdapterError
from zsched.core.values.model import Acceptance, RegisterState
from zsched.core.values.startup import NoState
from zsched.host.state_file import NEW_NAME, StateFile, hardware_id, is_same_hardware

BALLOT = ballot_of(3, incarnation=2)
VALUE = allocation_of(9, epoch=4, tuning=tuning_of())
REGISTER = RegisterState(task="merge", promised=BALLOT, accepted=Acceptance(ballot=BALLOT, value=VALUE), learnt=VALUE)
STATE = state_of("robot1", REGISTER, fleet="hall", incarnation=2, hardware="machine:aa,serial:bb", electorate="0123")


def state_file(folder: Path, node: str = "robot1", fleet: str = "hall", hardware: str = "machine:aa") -> StateFile:
    return StateFile(folder, fleet=fleet, node=node, hardware=hardware)


@pytest.mark.parametrize("place", ["taken", "taken/below"])
def test_a_file_where_the_folder_should_be_is_told_as_that(tmp_path: Path, place: str) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(AdapterError, match=r"a file is where a folder should be: see --state-dir"):
        state_file(tmp_path / place).acquire()


def test_saved_state_is_loaded_and_the_folder_is_private(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "zsched"
    with state_file(folder) as file:
        file.save(STATE)
        file.save(replace(STATE, incarnation=3))
        result = file.load()
    assert result.state == replace(STATE, incarnation=3)
    assert result.problem is None
    assert folder.stat().st_mode & 0o777 == 0o700
    assert file.path.stat().st_mode & 0o777 == 0o600
    assert sorted(path.name for path in folder.iterdir()) == ["lock", "state"]


def test_missing_state_is_a_value_with_advice(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        result = file.load()
    assert result.state is None
    assert result.problem is not None
    assert "stop the daemon, run `zsched init`" in result.problem
    assert result.no_state is NoState.MISSING


def test_create_refuses_an_existing_state_unless_the_generation_rises(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.create(STATE)
        with pytest.raises(AdapterError, match="--generation 1"):
            file.create(replace(STATE, incarnation=0))
        assert file.load().state == STATE
        file.create(replace(STATE, generation=1, incarnation=0, registers=()))
        assert file.load().state == replace(STATE, generation=1, incarnation=2, registers=())


def test_create_refuses_a_damaged_state_unless_a_generation_is_named(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.path.write_bytes(b"zsched-state/1 0000\nxx")
        with pytest.raises(AdapterError, match="--generation 1"):
            file.create(STATE)
        file.create(replace(STATE, generation=1))
        assert file.load().problem is None


@pytest.mark.parametrize(
    ("fleet", "node", "hardware", "word"),
    [
        ("yard", "robot1", "machine:aa", "fleet"),
        ("hall", "robot2", "machine:aa", "node"),
        ("hall", "robot1", "machine:aa,serial:cc", "another machine"),
    ],
)
def test_state_of_somebody_else_is_lost_state(tmp_path: Path, fleet: str, node: str, hardware: str, word: str) -> None:
    with state_file(tmp_path) as file:
        file.save(STATE)
    with state_file(tmp_path, node, fleet, hardware) as file:
        result = file.load()
    assert result.state is None
    assert result.problem is not None
    assert word in result.problem
    is_others = result.no_state is NoState.ANOTHER_NODE
    assert is_others is ("`zsched leave`" in result.problem) is (word != "another machine")
    assert result.no_state is not NoState.MISSING, "it is lost"


def test_unreadable_state_is_a_value(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.path.mkdir()
        result = file.load()
    assert result.problem is not None
    assert "cannot be read" in result.problem


def test_a_pipe_in_place_of_the_state_is_a_value_and_nothing_waits_for_it(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        os.mkfifo(file.path)
        os.mkfifo(tmp_path / NEW_NAME)
        result = file.load()
        file.save(STATE)
        assert file.load().state == STATE, "a save puts a file in the place of either"
    assert result.problem is not None
    assert "a pipe" in result.problem


def test_file_cut_at_every_length_is_damaged(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.save(STATE)
        content = file.path.read_bytes()
        for length in range(len(content)):
            file.path.write_bytes(content[:length])
            assert file.load().problem is not None, length
        file.path.write_bytes(content + b"\0")
        assert file.load().problem is not None


def test_file_with_any_byte_changed_is_damaged(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.save(STATE)
        content = bytearray(file.path.read_bytes())
        for index in range(len(content)):
            for mask in (0x01, 0x80):
                content[index] ^= mask
                file.path.write_bytes(content)
                assert file.load().problem is not None, (index, mask)
                content[index] ^= mask


def test_second_daemon_is_refused_and_told_who_holds_the_folder(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from zsched.host.state_file import StateFile\n"
        "from zsched.core.values.errors import AdapterError\n"
        "try: StateFile(Path(sys.argv[1]), fleet='hall', node='robot1').acquire()\n"
        "except AdapterError as error: print(error)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with state_file(tmp_path):
        held = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    free = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert f"in use by process {os.getpid()}" in held.stdout
    assert free.stdout == ""


def test_save_without_the_lock_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match="acquire"):
        state_file(tmp_path).save(STATE)


SAVER = """
import sys
from dataclasses import replace
from pathlib import Path
from zsched.host.state_file import StateFile
folder = Path(sys.argv[1])
with StateFile(folder, fleet="hall", node="robot1", hardware="machine:aa") as file:
    state = file.load().state
    first = state.incarnation
    while True:
        state = replace(state, incarnation=state.incarnation + 1, electorate="e" * (state.incarnation % 100))
        file.save(state)
        if state.incarnation == first + 1:
            print("saving", flush=True)
"""


def test_killed_while_saving_leaves_a_whole_state(tmp_path: Path) -> None:
    with state_file(tmp_path) as file:
        file.save(STATE)
    last = STATE.incarnation
    for round_number in range(8):
        with subprocess.Popen([sys.executable, "-c", SAVER, str(tmp_path)], stdout=subprocess.PIPE) as saver:
            assert saver.stdout is not None
            assert saver.stdout.readline() == b"saving\n"
            with pytest.raises(subprocess.TimeoutExpired):
                saver.wait(timeout=0.01 + 0.007 * round_number)
            saver.kill()
            saver.wait(timeout=60)
        with state_file(tmp_path) as file:
            state = file.load().state
        assert state is not None
        assert state.incarnation > last
        last = state.incarnation


@pytest.mark.root
def test_root_writes_for_the_folders_owner(tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can write for somebody else")
    os.chown(tmp_path, 54321, 54322)
    with state_file(tmp_path) as file:
        file.create(STATE)
    owners = {(path.stat().st_uid, path.stat().st_gid) for path in tmp_path.iterdir()}
    assert owners == {(54321, 54322)}


@pytest.mark.parametrize("is_hard", [False, True])
def test_a_link_in_the_folder_never_chooses_what_is_written(tmp_path: Path, is_hard: bool) -> None:
    victim, folder = tmp_path / "victim", tmp_path / "state-dir"
    victim.write_text("somebody else's")
    folder.mkdir()

    def link(name: str) -> None:
        (folder / name).hardlink_to(victim) if is_hard else (folder / name).symlink_to(victim)

    link("lock")
    with pytest.raises(AdapterError, match=r"delete .*lock: it leads to another file"):
        state_file(folder).acquire()
    (folder / "lock").unlink()
    link(NEW_NAME)
    with state_file(folder) as file:
        file.save(STATE)
        assert file.load().state == STATE
    assert not file.path.is_symlink()
    assert victim.read_text() == "somebody else's"
    assert victim.stat().st_uid == os.geteuid()


def test_a_folder_that_is_gone_is_no_full_disk(tmp_path: Path) -> None:
    """It said that the old state is whole, and to start again, which founds nothing good without one."""
    folder = tmp_path / "gone"
    with state_file(folder) as file:
        file.save(STATE)
        shutil.rmtree(folder)
        with pytest.raises(AdapterError, match=r"the folder is gone, and the state with it: .*`zsched init`"):
            file.save(STATE)


@pytest.mark.root
def test_full_disk_leaves_the_old_state_whole(tmp_path: Path) -> None:
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    mounted = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small disk: {mounted.stderr.strip()}")
    try:
        with state_file(folder) as file:
            file.save(STATE)
            (folder / "filler").write_bytes(b"x" * 50_000)
            with pytest.raises(AdapterError, match="No space left"):
                file.save(replace(STATE, registers=tuple(RegisterState(task=f"t{i}") for i in range(2_000))))
            assert file.load().state == STATE
            assert not (folder / "state.new").exists()
        remount = ["mount", "-o", "remount,ro", str(folder)]
        subprocess.run(remount, check=True, timeout=60)
        with pytest.raises(AdapterError, match="Read-only"):
            state_file(folder).acquire()
    finally:
        subprocess.run(["umount", str(folder)], check=True, timeout=60)


def test_hardware_is_told_by_what_can_be_read(tmp_path: Path) -> None:
    assert hardware_id(tmp_path) == ""
    (tmp_path / "etc").mkdir()
    (tmp_path / "etc/machine-id").write_text("abc\n")
    alone = hardware_id(tmp_path)
    (tmp_path / "proc/device-tree").mkdir(parents=True)
    (tmp_path / "proc/device-tree/serial-number").write_bytes(b"10000000\0")
    both = hardware_id(tmp_path)
    assert both.startswith(alone + ",serial:")
    assert is_same_hardware(alone, both)
    assert is_same_hardware("", both)
    assert not is_same_hardware(both.replace("serial:", "serial:0"), both)
    assert is_same_hardware(both.replace("machine:", "machine:0"), both), "a new installation has another number"
    assert not is_same_hardware(alone.replace("machine:", "machine:0"), both), "where nothing else can be compared"
    assert "abc" not in both
