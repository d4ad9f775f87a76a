"""`zsched init`'s blank state on a real disk: what it states, what it refuses, what a new generation starts at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from zsched.commands.members.blank import begin_anew, init_state
from zsched.config.load import check_bytes
from zsched.core.electorate.recovery import NEW_DISK, Sides
from zsched.core.register.register import MAX_REVISION
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import MAX_COUNTER, NO_BALLOT, RegisterState
from zsched.core.vote.belief import GENERATION_STEP, MAX_GENERATION
from zsched.host.state_file import StateFile, hardware_id

TEXT = b"""
fleet: hall
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot}
  robot3: {kind: robot}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 0.7, memory: 0.3}}
  slam: {candidates: {kind: robot}, weights: {cpu: 1.0}}
"""


@pytest.fixture
def fleet() -> Fleet:
    found = check_bytes(TEXT).fleet
    assert found is not None
    return found


def load(fleet: Fleet, folder: Path) -> DurableState:
    with StateFile(folder, fleet=fleet.name, node="robot1") as file:
        state = file.load().state
    assert state is not None
    return state


def test_blank_state_says_that_this_name_never_voted(fleet: Fleet, tmp_path: Path) -> None:
    path = init_state(fleet, "robot1", tmp_path / "state", 0)
    assert path == tmp_path / "state" / "state"
    state = load(fleet, tmp_path / "state")
    assert (state.fleet, state.node, state.generation) == ("hall", "robot1", 0)
    assert state.registers == ()
    assert state.electorate == electorate_hash(fleet)
    assert state.hardware == hardware_id()


def test_second_blank_state_is_refused_and_the_first_one_stays(fleet: Fleet, tmp_path: Path) -> None:
    path = init_state(fleet, "robot1", tmp_path, 0)
    before = path.read_bytes()
    with pytest.raises(AdapterError, match="exists already"):
        init_state(fleet, "robot1", tmp_path, 0)
    assert path.read_bytes() == before


def test_damaged_state_is_not_taken_for_none(fleet: Fleet, tmp_path: Path) -> None:
    init_state(fleet, "robot1", tmp_path, 0).write_bytes(b"\xc1 no state")
    with pytest.raises(AdapterError, match="damaged"):
        init_state(fleet, "robot1", tmp_path, 0)


def test_a_state_that_cannot_be_used_is_moved_away_and_the_fleet_is_left_as_it_is(fleet: Fleet, tmp_path: Path) -> None:
    """One damaged file of a machine that never voted led to `--generation 1 --force` on every node."""
    path = init_state(fleet, "edge1", tmp_path, 0)
    path.write_bytes(b"\xc1 no state")
    with pytest.raises(AdapterError, match="move the file away, then again") as refused:
        init_state(fleet, "edge1", tmp_path, 0)
    assert "--generation" not in str(refused.value)
    assert path.read_bytes() == b"\xc1 no state"


def test_new_generation_starts_above_every_older_revision_and_epoch(fleet: Fleet, tmp_path: Path) -> None:
    init_state(fleet, "robot1", tmp_path, 0)
    first = load(fleet, tmp_path).incarnation
    init_state(fleet, "robot1", tmp_path, 2)
    state = load(fleet, tmp_path)
    assert (state.generation, state.incarnation >= first) == (2, True)
    assert [register.task for register in state.registers] == ["merge", "slam"]
    for register in state.registers:
        assert register.promised == NO_BALLOT
        assert register.learnt is not None
        assert (register.learnt.revision, register.learnt.epoch) == (2 * GENERATION_STEP, 2 * GENERATION_STEP)
        assert register.learnt.owner is None
        assert register.learnt.tuning == fleet.task(register.task).tuning


def test_new_generation_counts_as_accepted_or_its_first_round_would_find_a_forgotten_value(
    fleet: Fleet, tmp_path: Path
) -> None:
    init_state(fleet, "robot1", tmp_path, 1)
    for register in load(fleet, tmp_path).registers:
        assert register.accepted is not None
        assert register.accepted.value == register.learnt


def test_a_new_generation_keeps_how_long_the_leases_were_that_were_granted(fleet: Fleet, tmp_path: Path) -> None:
    """Who has one may work by it until it is over, and by a fleet file that says another length."""
    init_state(fleet, "robot1", tmp_path, 0)
    with StateFile(tmp_path, fleet=fleet.name, node="robot1") as file:
        state = file.load().state
        assert state is not None
        file.save(replace(state, lease_s=12.5))
    init_state(fleet, "robot1", tmp_path, 1)
    assert load(fleet, tmp_path).lease_s == 12.5


def test_generation_that_is_not_newer_is_refused(fleet: Fleet, tmp_path: Path) -> None:
    init_state(fleet, "robot1", tmp_path, 3)
    for generation in (0, 2, 3):
        with pytest.raises(AdapterError, match="generation"):
            init_state(fleet, "robot1", tmp_path, generation)


def test_a_generation_that_leaves_no_room_to_count_is_refused(fleet: Fleet, tmp_path: Path) -> None:
    """Its first revision would be the highest there is: a fleet of that generation could agree on nothing."""
    with pytest.raises(AdapterError, match="at most 1048575"):
        init_state(fleet, "robot1", tmp_path, MAX_GENERATION + 1)
    assert list(tmp_path.iterdir()) == []


def test_highest_generation_leaves_room_to_count(fleet: Fleet, tmp_path: Path) -> None:
    init_state(fleet, "robot1", tmp_path, MAX_GENERATION)
    (learnt, _) = (register.learnt for register in load(fleet, tmp_path).registers)
    assert learnt is not None
    assert learnt.revision + GENERATION_STEP <= MAX_REVISION < MAX_COUNTER


def test_state_folder_of_a_running_daemon_is_refused(fleet: Fleet, tmp_path: Path) -> None:
    with (
        StateFile(tmp_path, fleet=fleet.name, node="robot1"),
        pytest.raises(AdapterError, match="in use by process"),
    ):
        init_state(fleet, "robot1", tmp_path, 0)


def test_a_generation_after_an_owner_that_needed_no_lease_is_not_leased_from_the_start(tmp_path: Path) -> None:
    """That owner may still work, with the old file; an exclusive task's owner before has worked by leases."""
    old = check_bytes(TEXT).fleet
    assert old is not None
    new = replace(old, tasks=tuple(replace(task, exclusive=True) for task in old.tasks))
    init_state(old, "robot1", tmp_path, 0)
    owned = {
        "merge": replace(old.task("merge").first_value(0), revision=1, epoch=1, owner="robot2"),
        "slam": replace(new.task("slam").first_value(0), revision=1, epoch=1, owner="robot2"),
    }
    with StateFile(tmp_path, fleet=old.name, node="robot1") as file:
        registers = tuple(RegisterState(task=name, learnt=value) for name, value in owned.items())
        state = file.load().state
        assert state is not None
        file.save(replace(state, registers=registers))
    init_state(new, "robot1", tmp_path, 1)
    found = {register.task: register.learnt for register in load(new, tmp_path).registers}
    assert {name: value is not None and value.leased for name, value in found.items()} == {"merge": False, "slam": True}


def test_a_new_member_s_state_names_its_generation_and_is_no_elector_s(fleet: Fleet, tmp_path: Path) -> None:
    side = Sides(generation_id="ab12", generation=0, nodes=("robot2",), recovered_by="", electors=("robot1", "robot2"))
    begin_anew(fleet, "robot1", tmp_path, side)
    state = load(fleet, tmp_path)
    assert (state.joins, state.lost, state.hardware) == ("ab12", NEW_DISK, hardware_id())
    with pytest.raises(AdapterError, match="move the file away, then again"):
        begin_anew(fleet, "robot1", tmp_path, side)
    assert load(fleet, tmp_path) == state
