"""Whole fleets of real nodes on a fake network, clock and disk, by seed."""

from __future__ import annotations

import itertools
from dataclasses import replace
from random import Random

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.scheduler.ledger import left_after_s
from zsched.core.values.fleet import Fleet, Timing, WorkerSpec
from zsched.core.values.model import NodeId, PeerState
from zsched_lab.sim.simulator import CORES, Simulator

TASK = "merge"


def fleet(robots: int = 3, edges: int = 3, *, price_s: float = 0.3) -> Fleet:
    names = [f"robot{i}" for i in range(1, robots + 1)] + [f"edge{i}" for i in range(1, edges + 1)]
    task = task_of(
        TASK,
        tuple(f"edge{i}" for i in range(1, edges + 1)),
        tuning=tuning_of(),
        price_s=price_s,
        worker=WorkerSpec(command=("true",)),
    )
    return fleet_of(task, of=sorted(names))


def settled(sim: Simulator) -> bool:
    owner = sim.agreed(TASK)
    return owner is not None and owner in sim.running()


def started(seed: int = 1, **options: float) -> Simulator:
    sim = Simulator(fleet=fleet(), seed=seed, **options)  # type: ignore[arg-type]
    sim.start()
    assert sim.run_until(lambda: settled(sim), 15), "\n".join(sim.stories)
    return sim


@pytest.mark.parametrize("seed", range(4))
def test_fleet_agrees_on_a_first_owner(seed: int) -> None:
    sim = started(seed)
    assert sim.agreed(TASK) in {"edge1", "edge2", "edge3"}
    assert {value.epoch for value in sim.learnt.values()} == {1}


def test_same_seed_same_story() -> None:
    """Nothing in the core iterates a set or reads a clock: two runs agree to the letter."""
    first, second = started(5), started(5)
    for sim in (first, second):
        sim.crash(sim.agreed(TASK) or "")
        sim.run(5)
    assert first.stories == second.stories


@pytest.mark.parametrize("seed", range(8))
def test_killed_owner_is_replaced_within_200_ms_and_epochs_rise_by_one(seed: int) -> None:
    sim = started(seed)
    owner = sim.agreed(TASK)
    assert owner is not None
    sim.run(1)
    sim.crash(owner)
    at = sim.now
    assert sim.run_until(lambda: settled(sim), 2), "\n".join(sim.stories[-30:])
    assert sim.now - at < 0.2
    assert sim.agreed(TASK) != owner
    assert max(epoch for _, epoch in sim.owners) == 2


@pytest.mark.parametrize("step", [0.3, 0.6])
def test_busy_owner_is_left_once_staying_has_cost_a_move_and_not_before(step: float) -> None:
    """By a step of load of 0.6 the owner falls 0.3 behind: 0.2 with its bonus."""
    busy: set[NodeId] = set()
    sim = Simulator(
        fleet=fleet(), seed=3, load=lambda node, _: (CORES * (0.25 + step if node in busy else 0.25), 1000.0)
    )
    sim.start()
    assert sim.run_until(lambda: settled(sim), 15)
    sim.run(12)
    owner = sim.agreed(TASK)
    assert owner is not None
    busy.add(owner)
    at = sim.now
    assert sim.run_until(lambda: sim.agreed(TASK) not in (None, owner), 10)
    timing = Timing()
    due_s = left_after_s(0.5 * step - 0.1, 0.3, timing.smoothing_s)
    assert due_s - timing.decide_s < sim.now - at < due_s + 2 * timing.smoothing_s + timing.decide_s


def test_equal_noisy_nodes_do_not_flap_for_three_minutes() -> None:
    rng = Random(11)
    sim = Simulator(
        fleet=fleet(), seed=4, load=lambda _node, _now: (CORES * rng.uniform(0.1, 0.4), rng.uniform(600, 1800))
    )
    sim.start()
    sim.run(180)
    assert max(epoch for _, epoch in sim.owners) <= 2


@pytest.mark.parametrize("seed", range(4))
def test_minority_does_not_move_anything_and_heals(seed: int) -> None:
    """Two robots cut off from the third and from every edge: the majority side decides, the other one learns later."""
    sim = started(seed)
    owner = sim.agreed(TASK)
    rest = [name for name in sim.running() if name != "robot1"]
    sim.cut(("robot1",), tuple(rest))
    sim.crash(owner or "")
    alive = [name for name in rest if name != owner]
    assert sim.run_until(lambda: sim.agreed(TASK, *alive) not in (None, owner), 5)
    assert sim.node("robot1").registers[TASK].value.owner == owner
    sim.run(10)
    sim.heal()
    assert sim.run_until(lambda: settled(sim), 5)


def test_without_a_majority_of_robots_nothing_moves() -> None:
    sim = started(2)
    owner = sim.agreed(TASK)
    sim.cut(("robot1",), ("robot2",), ("robot3",))
    epoch = max(epoch for _, epoch in sim.owners)
    sim.crash(owner or "")
    sim.run(20)
    assert max(epoch for _, epoch in sim.owners) == epoch
    sim.heal()
    assert sim.run_until(lambda: settled(sim), 10), "\n".join(sim.stories[-40:])


def test_late_node_learns_from_beats() -> None:
    sim = Simulator(fleet=fleet(), seed=6)
    sim.start("robot1", "robot2", "edge1", "edge2")
    assert sim.run_until(lambda: settled(sim), 15)
    value = sim.node("robot1").registers[TASK].value
    sim.start("robot3", "edge3")
    assert sim.run_until(lambda: settled(sim), 3)
    assert sim.node("robot3").registers[TASK].value == value


def test_partial_cut_is_suspicion_for_one_and_an_ordinary_vote_for_all() -> None:
    """robot1 and the owner do not hear each other, everybody else hears both: never gone, but an edge that all robots
    reach is better by robot1's share, and gets the task once staying has cost a move."""
    sim = started(7)
    owner = sim.agreed(TASK) or ""
    sim.run(12)
    sim.cut((owner,), ("robot1",))
    at = sim.now
    assert sim.run_until(lambda: sim.agreed(TASK, "robot2", "robot3") not in (None, owner), 10)
    assert sim.now - at > 2.0, "not an escape"
    assert sim.sees("robot1", owner) is PeerState.SUSPECT
    assert sim.sees("robot2", owner) is PeerState.ALIVE


def test_robot_that_reaches_no_edge_moves_nothing() -> None:
    """Every edge looks the same to robot1, so its zeros change no order."""
    sim = started(7)
    owner = sim.agreed(TASK) or ""
    sim.run(12)
    sim.cut(("edge1", "edge2", "edge3"), ("robot1",))
    sim.run(20)
    assert sim.agreed(TASK) == owner


@pytest.mark.parametrize("seed", range(6))
def test_random_faults_never_break_agreement_and_end_in_an_owner(seed: int) -> None:
    """Loss, crashes, restarts, cuts, then quiet: one value per revision all along, a living owner at the end."""
    rng = Random(1000 + seed)
    sim = Simulator(
        fleet=fleet(price_s=0.1),
        seed=seed,
        loss=rng.choice([0.0, 0.05, 0.2]),
        delay_s=(0.0005, rng.choice([0.003, 0.2])),
    )
    sim.start()
    names = tuple(sim.running())
    for _ in range(20):
        sim.run(rng.uniform(0.05, 3.0))
        action = rng.random()
        if action < 0.35:
            sim.crash(rng.choice(names))
        elif action < 0.7:
            down = [name for name in names if name not in sim.running()]
            sim.start(*down[:1]) if down else None
        elif action < 0.85:
            cut = rng.sample(names, rng.randint(1, 3))
            sim.cut(tuple(cut), tuple(name for name in names if name not in cut))
        else:
            sim.heal()
    sim.heal()
    sim.loss = 0.0
    down = [name for name in names if name not in sim.running()]
    if down:
        sim.start(*down)
    assert sim.run_until(lambda: settled(sim), 20), "\n".join(sim.stories[-40:])


def test_epochs_of_one_fleet_are_gapless_for_planned_moves() -> None:
    sim = started(8)
    for _ in range(4):
        owner = sim.agreed(TASK) or ""
        sim.crash(owner)
        assert sim.run_until(lambda: settled(sim), 5)
        sim.start(owner)
        sim.run(3)
    epochs = sorted(epoch for _, epoch in sim.owners)
    assert all(b == a + 1 for a, b in itertools.pairwise(epochs))


# --- limits of gauges ------------------------------------------------------------------------------------------------


def limited(*limits: tuple[str, float], charge: dict[NodeId, float]) -> Simulator:
    """A fleet whose machines have these batteries; the test changes them."""
    whole = fleet()
    task = replace(whole.tasks[0], gauge_limits=limits)
    sim = Simulator(
        fleet=replace(whole, tasks=(task,)),
        seed=1,
        gauges=lambda node, _: (("battery", charge[node]),) if node in charge else (),
    )
    sim.start()
    assert sim.run_until(lambda: settled(sim), 15), "\n".join(sim.stories)
    return sim


def test_a_battery_that_crosses_its_limit_moves_the_task_once_and_not_back_at_the_limit() -> None:
    charge: dict[NodeId, float] = {}
    sim = limited(("battery", 0.2), charge=charge)
    first = sim.agreed(TASK)
    assert first is not None
    charge[first] = 0.3
    sim.run(20)
    assert sim.agreed(TASK) == first, "above its limit nothing moves it"
    charge[first] = 0.19
    assert sim.run_until(lambda: sim.agreed(TASK) not in (None, first), 15), "\n".join(sim.stories[-20:])
    second, epochs = sim.agreed(TASK), len(sim.owners)
    for step in range(40):  # a reading that jitters about the limit
        charge[first] = 0.19 + 0.03 * (step % 2)
        sim.run(1)
    assert sim.agreed(TASK) == second
    assert len(sim.owners) == epochs


def test_where_every_machine_is_beyond_the_limit_the_task_stays_with_its_owner() -> None:
    charge: dict[NodeId, float] = {}
    sim = limited(("battery", 0.2), charge=charge)
    owner = sim.agreed(TASK)
    charge.update(dict.fromkeys(("edge1", "edge2", "edge3"), 0.1))
    sim.run(30)
    assert sim.agreed(TASK) == owner
