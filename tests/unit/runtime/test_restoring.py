"""What a start makes of its state folder: each life is above the one before, whatever the wall clock says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from support.fleets import fleet_of
from support.states import state_of
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import electorate_hash
from zsched.core.values.startup import NoState
from zsched.host.state_file import LIFE_NAME, StateFile
from zsched.runtime import restoring
from zsched.runtime.restoring import Restored, restore

FLEET = fleet_of(name="hall")
STATE = state_of("robot1", fleet="hall", incarnation=2, electorate=electorate_hash(FLEET))


def start(folder: Path, monkeypatch: pytest.MonkeyPatch, wall: int, node: str = "robot1") -> Restored:
    monkeypatch.setattr(restoring, "wall_tenths", lambda: wall)
    with StateFile(folder, fleet="hall", node=node, hardware="") as file:
        return restore(file, FLEET, config=Path("fleet.yaml"), node=node, state_dir=folder)


def save(folder: Path, incarnation: int, electorate: str = STATE.electorate) -> None:
    with StateFile(folder, fleet="hall", node="robot1", hardware="") as file:
        file.save(replace(STATE, incarnation=incarnation, electorate=electorate))


def test_without_a_state_a_start_with_an_early_clock_is_a_later_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a lower one the others would refuse all that it signs, its votes among it."""
    first = start(tmp_path, monkeypatch, 5000)
    assert (first.state, first.no_state, first.incarnation) == (None, NoState.MISSING, 5000)
    assert start(tmp_path, monkeypatch, 40).incarnation == 5001
    assert start(tmp_path, monkeypatch, 6000).incarnation == 6000


def test_a_state_that_was_lost_or_comes_back_begins_no_lower_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 7000)
    found = start(tmp_path, monkeypatch, 40)
    assert found.state is not None
    assert (found.state.incarnation, found.incarnation) == (7001, 7001)
    (tmp_path / "state").unlink()
    assert start(tmp_path, monkeypatch, 40).incarnation == 7002
    save(tmp_path, 2)  # from a backup
    again = start(tmp_path, monkeypatch, 40)
    assert again.state is not None
    assert again.state.incarnation == 7003
    save(tmp_path, 9000, "another one's")
    foreign = start(tmp_path, monkeypatch, 40)
    assert (foreign.no_state, foreign.incarnation) == (NoState.ANOTHER_ELECTORATE, 9001)


def test_another_node_s_folder_is_left_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, 7000)
    found = start(tmp_path, monkeypatch, 40, "robot2")
    assert (found.no_state, found.incarnation) == (NoState.ANOTHER_NODE, 40)
    assert not (tmp_path / LIFE_NAME).exists()


def test_a_life_that_cannot_be_noted_is_lived_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / LIFE_NAME).mkdir()
    assert start(tmp_path, monkeypatch, 5000).incarnation == 5000
    assert "life not noted why=cannot write" in caplog.text


def test_a_disk_that_refuses_this_life_keeps_nobody_from_knowing_what_was_agreed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It started by its fleet file: in a fleet that was created by a command it was a stranger to all others."""
    save(tmp_path, 7000)
    with monkeypatch.context() as patch:
        patch.setattr(StateFile, "save", refuse)
        found = start(tmp_path, patch, 40)
    assert found.is_unsaved
    assert found.problem == "cannot write state: No space left on device"
    assert found.state == replace(STATE, incarnation=7001, disk=found.state.disk if found.state else "")
    again = start(tmp_path, monkeypatch, 40)
    assert (again.is_unsaved, again.problem) == (False, None)
    assert again.incarnation > found.incarnation


def refuse(*_given: object) -> None:
    raise AdapterError("cannot write state: No space left on device")
