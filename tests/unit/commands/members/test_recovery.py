"""Recovery on real state folders: two halves, states of dead machines, and what a node that changes sides keeps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from zsched.commands.members.blank import init_state
from zsched.commands.members.recovery import look, read_state, recover, rejoin
from zsched.config.load import load_fleet
from zsched.core.electorate.recovery import Recovery, Sides, consider
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import AdapterError
from zsched.host.document_store import DocumentStore
from zsched.host.state_file import StateFile

TEXT = """\
fleet: hall
nodes:
  robot1: {kind: robot}
  robot2: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:1, data: tcp/127.0.0.1:2}}
  robot3: {kind: robot}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 1}, exclusive: true}
"""
ROBOTS = ("robot1", "robot2", "robot3")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The fleet file of three machines, each with a state that has never voted."""
    path = tmp_path / "fleet.yaml"
    path.write_text(TEXT)
    for name in ROBOTS:
        init_state(load_fleet(path), name, tmp_path / name, 0)
    return path


def state_at(file: Path, node: str) -> DurableState:
    state = StateFile(file.parent / node, fleet="hall", node=node).load().state
    assert state is not None
    return state


def recovered(file: Path, node: str, *brought: str) -> FleetValue:
    """What a node begins with that is recovered beside the states of others."""
    folder, others = file.parent / node, [file.parent / name / "state" for name in brought]
    plan = consider(look(load_fleet(file), node, file, folder, others))
    assert isinstance(plan, Recovery), plan
    recover(plan, file, folder, others)
    value = value_of(state_at(file, node))
    assert DocumentStore(folder).load(value.document) is not None
    return value


def value_of(state: DurableState) -> FleetValue:
    assert state.fleet_register is not None
    assert state.fleet_register.learnt is not None
    return state.fleet_register.learnt


def test_two_halves_that_are_both_recovered_are_two_generations(file: Path) -> None:
    left, right = recovered(file, "robot1"), recovered(file, "robot3")
    assert left.parent_id == right.parent_id
    assert len({left.generation_id, right.generation_id, left.parent_id}) == 3
    assert (left.electorate.names, right.electorate.names) == (("robot1",), ("robot3",))
    plan = consider(look(load_fleet(file), "robot1", file, file.parent / "robot1", [file.parent / "robot3" / "state"]))
    assert isinstance(plan, str)
    assert "halves that were recovered apart never mix" in plan


def test_a_dead_machine_s_state_is_read_and_a_damaged_one_is_named(file: Path) -> None:
    assert recovered(file, "robot1", "robot2").recovered_by == "robot1"
    path = file.parent / "robot2" / "state"
    assert read_state(path).node == "robot2"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(AdapterError, match="is damaged, or no state file"):
        read_state(path)


def test_who_changes_sides_keeps_nothing_but_what_it_may_have_granted(file: Path) -> None:
    value, before = recovered(file, "robot1"), state_at(file, "robot3")
    side = Sides(
        generation_id=value.generation_id, generation=0, nodes=("robot1",), recovered_by="robot1", electors=("robot1",)
    )
    rejoin(load_fleet(file), "robot3", file.parent / "robot3", before, side)
    after = state_at(file, "robot3")
    assert (after.joins, after.fleet_register, after.registers) == (value.generation_id, None, ())
    assert after.disk != before.disk
    assert after.lost


def test_a_daemon_that_has_run_while_the_operator_thought_about_it_loses_nothing(file: Path) -> None:
    """The question may stand for minutes; what was agreed here meanwhile is in no table that was shown."""
    folder = file.parent / "robot1"
    plan = consider(look(load_fleet(file), "robot1", file, folder, []))
    assert isinstance(plan, Recovery), plan
    before = state_at(file, "robot1")
    side = Sides(generation_id="ab" * 16, generation=0, nodes=("robot2",), recovered_by="robot2", electors=("robot2",))
    with StateFile(folder, fleet="hall", node="robot1") as daemon:
        daemon.save(replace(before, votes=before.votes + 1))
    with pytest.raises(AdapterError, match="a daemon has run here meanwhile"):
        recover(plan, file, folder, [])
    with pytest.raises(AdapterError, match="a daemon has run here meanwhile"):
        rejoin(load_fleet(file), "robot1", folder, before, side)
    assert state_at(file, "robot1").votes == before.votes + 1
