"""Random fault schedules by seed: the short form of ``python -m zsched_lab.sim.simulate`` (CI plays thousands)."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from zsched.core.membership.beat_room import most_bytes
from zsched.core.register.register import Register
from zsched.core.values.beat import MAX_BEAT_BYTES
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Prepare, Promise, Refused
from zsched.core.values.todo import ToDo
from zsched.core.vote.belief import GENERATION_STEP
from zsched_lab.sim import simulate
from zsched_lab.sim.checks import DisagreementError
from zsched_lab.sim.faults import BEYOND, Stage, play
from zsched_lab.sim.files import CHANGES
from zsched_lab.sim.links import Held
from zsched_lab.sim.parts import Clock, Disk
from zsched_lab.sim.rest import AT_MOST_S
from zsched_lab.sim.simulate import Job, main, shrink
from zsched_lab.sim.simulator import Simulator
from zsched_lab.sim.swarm import KINDS, LATER, MAKERS, MAX_NODES, MIN_NODES, PENDING, Fault, Plan, plan


@pytest.mark.parametrize("seed", range(10))
def test_a_schedule_of_faults_violates_nothing_and_ends_at_rest(seed: int) -> None:
    result = play(plan(seed))
    assert result.violation == "", f"{Job(seed=seed).command}\n" + "\n".join(result.stories[-40:])
    assert result.settled_s is None or result.settled_s <= AT_MOST_S[plan(seed).fleet.timing.name]


def test_same_seed_same_schedule_to_the_letter() -> None:
    assert play(plan(7)).stories == play(plan(7)).stories
    assert plan(7) == plan(7)


def test_plans_have_every_fault_every_size_and_every_kind_of_task() -> None:
    plans = [plan(seed, kinds=KINDS) for seed in range(400)]
    kinds = {fault.kind for one in plans for fault in one.faults}
    assert kinds == (set(MAKERS) - {"clock"}) | {
        "absence",
        "clock_rate",
        "clock_jump",
        "load",
        "reload",
        "order",
        "slew",
        "suspend",
    } | set(LATER) - {"fsync"}
    assert {one.generation for one in plans} == {0, 1, 2}
    assert any(not set(one.fleet.electors) & set(one.fleet.voters) for one in plans), "edges alone"
    assert {fault.size for one in plans for fault in one.faults if fault.kind == "rollout"} == set(range(len(CHANGES)))
    assert {len(one.fleet.nodes) for one in plans} == set(range(MIN_NODES, MAX_NODES + 1))
    tasks = [task for one in plans for task in one.fleet.tasks]
    assert {task.exclusive for task in tasks} == {True, False}
    assert any(not set(one.fleet.electors) <= set(one.fleet.voters) for one in plans), "edges as electors"
    assert any(not one.faults for one in plans), "and some in which nothing goes wrong"


@pytest.mark.long
def test_many_tasks_with_slow_workers_all_leave_a_busy_owner_in_the_end() -> None:
    """Found by the simulator: each vote asked an owner to leave, and the next on that task came when it had stayed."""
    one = plan(598)
    assert len(one.fleet.tasks) == 41
    assert play(one).violation == ""


def test_a_machine_that_stood_still_while_its_clock_was_slewed_and_well_again_hears_that_it_is_well() -> None:
    """Its watch stopped looking before the machine went on, so the doubt had no end (311001444)."""
    assert play(plan(311001444)).violation == ""


def test_about_one_schedule_of_fifty_has_beats_without_room_for_everything() -> None:
    plans = [plan(seed) for seed in range(1000)]
    many = [one for one in plans if len(one.fleet.tasks) > 20]
    assert 10 <= len(many) <= 30
    assert any(most_bytes(one.fleet) > MAX_BEAT_BYTES for one in many)
    assert any(most_bytes(one.fleet) < MAX_BEAT_BYTES for one in many)


@pytest.mark.parametrize("seed", [8021526, 8022150])
def test_a_task_is_not_made_exclusive_while_two_machines_have_one_name(seed: int) -> None:
    """Found by the simulator: one of two machines of a name answered that nobody works there, the other one did."""
    one = plan(seed, kinds=frozenset(LATER))
    twins = [fault for fault in one.faults if fault.kind == "apart"]
    result = play(one)
    assert result.violation == ""
    assert twins
    assert result.faults["apart"] == len(twins)
    assert result.faults["rollout of exclusive"] == 0

    alone = play(replace(one, faults=tuple(fault for fault in one.faults if fault not in twins)))
    assert alone.violation == ""
    assert alone.faults["rollout of exclusive"] == 1


def test_a_daemon_that_leaves_its_name_does_so_behind_all_else() -> None:
    """Found by the simulator: one answer told a newer value and that our name lives twice; the role came after us."""
    assert play(plan(9040656)).violation == ""


@pytest.mark.long
def test_every_fault_that_is_planned_is_carried_out() -> None:
    done: set[str] = set()
    planned: set[str] = set()
    for seed in range(60):
        one = plan(seed, kinds=frozenset(LATER))
        kinds = {fault.kind for fault in one.faults}
        if kinds - planned:
            done |= set(play(one).faults)
            planned |= kinds
    assert planned <= done


def test_a_fleet_whose_electors_lost_their_state_is_started_anew_and_gets_an_owner() -> None:
    """Found by this simulator (seed 0): blank electors of a generation were taken for ones that had forgotten it."""
    sim = Simulator(fleet=plan(0, nodes=5).fleet, seed=1)
    for machine in sim.machines.values():
        sim.initialise(machine, generation=3)
    sim.start()
    assert sim.run_until(lambda: not sim.unsettled(), AT_MOST_S[sim.fleet.timing.name]), sim.unsettled()
    sim.run(2.0)  # what is learnt is on the disks soon after it is acted upon
    assert min(revision for _, revision in sim.learnt if revision % GENERATION_STEP) == 3 * GENERATION_STEP + 1


@pytest.mark.parametrize("nodes", [MIN_NODES, MAX_NODES])
def test_the_fleet_s_size_may_be_given(nodes: int) -> None:
    assert len(plan(3, nodes=nodes).fleet.nodes) == nodes


# --- the simulator finds what is wrong, and makes it small -----------------------------------------------------------


@pytest.fixture
def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    """Electors that answer before their promise is on disk."""
    original = Register.on_prepare

    def on_prepare(self: Register, prepare: Prepare, _todo: ToDo) -> Promise | Refused:
        return original(self, prepare, ToDo())

    monkeypatch.setattr(Register, "on_prepare", on_prepare)


@pytest.mark.usefixtures("forgetful")
def test_a_failing_seed_shrinks_and_prints_how_to_play_it_again(capsys: pytest.CaptureFixture[str]) -> None:
    job = Job(seed=0, seconds=6.0)
    assert job.play().violation
    small = shrink(job)
    assert small.keep is not None
    assert len(small.keep) <= 1
    assert small.play().violation
    assert main(["--seed", "0", "--runs", "2", "--seconds", "6", "--shrink"]) == 1
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == "2 schedules, 2 violations"
    assert "without its promise on disk" in out
    command = next(line for line in out.splitlines() if line.strip().startswith("again: ") and "--keep" in line)
    arguments = command.partition("simulate ")[2].split()
    assert main(arguments) == 1


def test_whatever_a_node_raises_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Register, "tick", lambda *_: 1 / 0)
    assert "ZeroDivisionError" in play(plan(1)).violation


def test_a_fleet_that_does_not_come_to_rest_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsched_lab.sim.simulator.unsettled", lambda *_: "never")
    with pytest.raises(InvariantError, match="not at rest"):
        Stage(Plan(seed=1, fleet=plan(1).fleet, faults=(), seconds=4.0)).play(None, 2.0)


@pytest.mark.parametrize(
    ("beyond", "error", "is_violation"),
    [
        ("robot1 began with 3 of 5 votes", DisagreementError, False),
        ("robot1 began with 3 of 5 votes", InvariantError, True),
        ("", DisagreementError, True),
    ],
)
def test_only_what_forgotten_votes_do_to_the_agreement_is_no_violation(
    beyond: str, error: type[InvariantError], is_violation: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by seed 8028426: whoever had seen an elector's votes had forgotten them, or was cut off from it."""

    def fail(stage: Stage, *_: object) -> float:
        stage.sim.memory.beyond = beyond
        raise error("two values")

    monkeypatch.setattr(Stage, "play", fail)
    result = play(plan(1))
    assert bool(result.violation) is is_violation
    assert result.faults[BEYOND] == (not is_violation)


# --- the command -----------------------------------------------------------------------------------------------------


def test_runs_are_resumed_behind_the_last_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "totals.json"
    for _ in range(2):
        assert main(["--seed", "5", "--runs", "2", "--seconds", "2", "--resume", str(file)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 schedules, 0 violations"
    totals = json.loads(file.read_text())
    assert (totals["seed"], totals["schedules"]) == (9, 4)


def test_two_processes_play_the_same_schedules(capsys: pytest.CaptureFixture[str]) -> None:
    outs = []
    for jobs in ("1", "2"):
        assert main(["--seed", "5", "--runs", "6", "--seconds", "2", "--jobs", jobs]) == 0
        outs.append(next(line for line in capsys.readouterr().out.splitlines() if line.startswith("faults: ")))
    assert outs[0] == outs[1]


def test_a_commit_has_seeds_of_its_own() -> None:
    assert simulate.commit_seed() == simulate.commit_seed()
    assert simulate.commit_seed() < 2**32


# --- its parts -------------------------------------------------------------------------------------------------------


def test_clock_runs_at_its_rate_jumps_and_never_goes_back() -> None:
    clock = Clock()
    assert clock.local(100.0) == 100.0
    clock.change(100.0, rate=1.25)
    assert clock.local(104.0) == pytest.approx(105.0)
    clock.change(104.0, jump_s=3.0)
    assert clock.local(104.0) == pytest.approx(108.0)
    assert clock.true(clock.local(110.0)) == pytest.approx(110.0)


def test_a_link_that_holds_back_keeps_its_order() -> None:
    link = Held(until=5.0)
    assert [link.arrival(1.0, 0.2), link.arrival(4.99, 0.001), link.arrival(5.1, 0.2)] == [5.0, 5.0, pytest.approx(5.3)]
    assert link.arrival(5.2, 0.01) == pytest.approx(5.3), "nothing overtakes what was sent before"
    burst = Held(every_s=0.5)
    assert [burst.arrival(at, 0.01) for at in (1.0, 1.2, 1.495, 1.6)] == [1.5, 1.5, 2.0, 2.0]


def test_a_cut_is_a_machine_s_and_a_twin_may_be_apart_from_its_original() -> None:
    fault = Fault(at=0.5, kind="apart", nodes=("robot1",), seconds=20.0, size=2.0)
    stage = Stage(Plan(seed=1, fleet=plan(1, nodes=6).fleet, faults=(fault,), seconds=30.0))
    sim = stage.sim
    sim.start()
    sim.later(fault.at, stage._begin, fault)
    sim.run(5.0)
    assert {"robot1", "robot1~"} <= set(sim.running())
    lives = {key: sim.node(key).incarnation for key in ("robot1", "robot1~")}
    heard = {
        key: sim.node(key).membership.incarnation("robot1") for key in sim.running() if not key.startswith("robot1")
    }
    assert set(heard.values()) == set(lives.values()), "some hear the one, some the other"


def test_a_frozen_machine_s_clock_stands_still() -> None:
    sim = Simulator(fleet=plan(1).fleet, seed=1)
    sim.start()
    sim.run(1.0)
    machine = sim.machines["robot1"]
    before = machine.clock.local(sim.now)
    sim.freeze(machine, 3.0)
    sim.run(3.5)
    assert machine.clock.local(sim.now) - before == pytest.approx(0.5)
    assert not machine.is_paused


def test_a_backup_and_a_lying_disk_give_back_an_older_file() -> None:
    state = next(iter(Stage(plan(1)).sim.machines.values())).disk.state
    assert state is not None

    def written(lies_from: int) -> Disk:
        disk = Disk()
        for count in range(6):
            if count == lies_from:
                disk.begin_to_lie()
            disk.write(replace(state, incarnation=count))
            disk.sync()
        return disk

    found = set()
    for seed in range(30):
        disk = written(lies_from=4)
        lost = disk.forget(Random(seed))
        assert disk.state is not None
        assert lost == (disk.state.incarnation < 5)
        found.add(disk.state.incarnation)
    assert found == {3, 4, 5}, "what it wrote before it lied is kept"
    disks = [written(lies_from=9) for _ in range(60)]
    older = {disk.restore(Random(seed)) for seed, disk in enumerate(disks)}
    assert older == {True, False}
    assert {disk.state.incarnation for disk in disks if disk.state is not None} == set(range(6))


MAY_STAY = ("limits", "weights", "candidates", "exclusive", "isolation", "score", "streams")


@pytest.mark.parametrize("name", CHANGES)
def test_every_change_of_a_fleet_file_makes_another_fleet_file(name: str) -> None:
    differing = 0
    for seed in range(20):
        fleet = plan(seed).fleet
        changed = CHANGES[name](Random(seed), fleet)
        differing += changed != fleet
        assert [task.name for task in changed.tasks] == sorted(task.name for task in changed.tasks)
    # What is drawn may be what was there, and an exclusive task is never given to robots that work alone.
    assert differing == 20 or (name in MAY_STAY and differing > 5), differing


def _shorter_leases(fleet: Fleet) -> Fleet:
    return replace(fleet, timing=replace(fleet.timing, lease_s=fleet.timing.lease_s / 2))


@pytest.mark.parametrize(
    ("change", "is_restarted"),
    [
        (_shorter_leases, True),
        (lambda fleet: replace(fleet, electors=fleet.electors[1:]), True),
        (lambda fleet: CHANGES["limits"](Random(1), fleet), False),
    ],
    ids=["leases", "electors", "limits"],
)
def test_what_a_reload_cannot_change_the_operator_changes_by_a_restart_when_the_faults_end(
    change: Callable[[Fleet], Fleet], is_restarted: bool
) -> None:
    fleet = plan(3).fleet
    changed = change(fleet)
    assert changed != fleet
    stage = Stage(Plan(seed=1, fleet=fleet, faults=()))
    stage.scene.done["rollout of exclusive"] = 1  # every node comes back
    stage.sim.start()
    stage.sim.run(2.0)
    stage.scene.fleet = changed
    for machine in stage.sim.machines.values():
        stage.scene.reload(machine, changed)
    stage.sim.run(2.0)
    stage.calm()
    stage.sim.run(1.0)
    assert {machine.life > 1 for machine in stage.sim.machines.values()} == {is_restarted}
    assert {stage.sim.node(name).fleet for name in stage.sim.running()} == {changed}


def test_nodes_with_leases_of_two_lengths_are_not_at_rest_until_the_last_one_is_restarted() -> None:
    """Found by seed 200007594: the operator of the schedule left a node by the leases that it was started with."""
    fleet = plan(3).fleet
    fleet = replace(fleet, tasks=(replace(fleet.tasks[0], candidates=fleet.voters),))
    stage = Stage(Plan(seed=1, fleet=fleet, faults=()))
    sim = stage.sim
    stage.scene.done["rollout of exclusive"] = 1  # every node comes back
    sim.start()
    assert sim.run_until(lambda: not sim.unsettled(), AT_MOST_S[fleet.timing.name])
    owner = sim.agreed(fleet.tasks[0].name)
    stage.scene.fleet = _shorter_leases(fleet)
    for machine in sim.machines.values():
        take = stage.scene.reload if machine.name == owner else stage.scene.restart
        take(machine, stage.scene.fleet)
    sim.run(3.0)  # what was granted before is over
    assert not sim.run_until(lambda: not sim.unsettled(), 60.0), "it ends by itself"
    assert "has no lease" in sim.unsettled()
    stage.calm()
    assert sim.run_until(lambda: not sim.unsettled(), AT_MOST_S[fleet.timing.name]), sim.unsettled()


def test_pending_faults_are_played_only_when_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert KINDS >= PENDING
    played = {fault.kind for seed in range(200) for fault in Job(seed=seed).plan.faults}
    assert {"suspend", "stall", "apart"} - PENDING <= played
    assert not played & PENDING
    assert main(["--seed", "5", "--runs", "3", "--seconds", "2", "--with", "amnesia"]) in (0, 1)
    again = Job(seed=5, pending=frozenset({"amnesia", "lie"})).command
    assert again.endswith("--with amnesia,lie")
    assert capsys.readouterr().out


def test_disk_keeps_the_old_or_the_new_file_and_a_damaged_one_is_none() -> None:
    job = Stage(plan(1))
    state = next(iter(job.sim.machines.values())).disk.state
    assert state is not None
    kept = set()
    for seed in range(20):
        disk = Disk()
        disk.write(state)
        assert disk.state is None
        disk.lose_power(Random(seed))
        kept.add(disk.read())
    assert kept == {None, state}
    for seed in range(50):
        disk = Disk()
        disk.write(state)
        disk.sync()
        disk.damage(Random(seed))
        assert disk.read() is None
