"""The offline replay decides as full nodes do: the same history, played to a fleet of `zsched.core.node.node`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from zsched.core.values.fleet import DEFAULT_BONUS, Demand, Timing
from zsched.core.values.model import Tuning
from zsched_lab.decisions.loads import Array
from zsched_lab.decisions.replay import Entry, replay
from zsched_lab.decisions.rules import CoreRule
from zsched_lab.decisions.world import DT_S, EVEN, World, build_fleet
from zsched_lab.sim.simulator import CORES, MEMORY_MB, Simulator

WIDE = Tuning(weights=EVEN)
PLAIN = Tuning(weights=EVEN, bonus=DEFAULT_BONUS)
MINUTES = 3
STARTED_AT_S = 100.0
"""The simulator's clock at its start."""
TOLERANCE_S = 1.0
"""Nodes sample at phases of their own, their rounds are not the replay's, and a profile is up to a second old."""


def history(seed: int, scatter: float) -> World:
    """Three edges, all but one of them loaded; after 20 to 45 s another one is the free one."""
    rng = np.random.default_rng(seed)
    steps = round(MINUTES * 60 / DT_S)
    cpu, memory = np.full((steps, 3), 0.7), np.full((steps, 3), 0.55)
    at_s, free = 0.0, 0
    while at_s < MINUTES * 60:
        free = (free + int(rng.integers(1, 3))) % 3
        end_s = at_s + float(rng.uniform(20.0, 45.0))
        window = slice(round(at_s / DT_S), round(end_s / DT_S))
        cpu[window, free] -= 0.5
        memory[window, free] -= 0.3
        at_s = end_s
    return World(
        name="same",
        fleet=build_fleet(3, 3, EVEN, Timing(), are_robots_candidates=False),
        cores=np.full(3, CORES),
        cpu=cpu,
        memory=memory,
        cpu_read=np.clip(cpu + rng.normal(0.0, scatter, cpu.shape), 0.0, 1.0),
        memory_read=memory,
    )


def by_nodes(world: World, tuning: Tuning, price_s: float) -> list[tuple[float, str]]:
    """(time, owner) of every allocation that a fleet of full nodes learns."""
    column = {name: index for index, name in enumerate(world.candidates)}
    cpu, memory = world.cpu_read, world.memory_read

    def load(name: str, now: float) -> tuple[float, float]:
        step = min(int((now - STARTED_AT_S) / DT_S), world.steps - 1)
        if name not in column:
            return 1.0, 1000.0
        # A node sees the task's own work at its owner, and the histories are without it.
        is_owner = sim.node("robot001").registers[task.name].value.owner == name
        own = task.demand if is_owner else Demand()
        used, used_mb = _at(cpu, step, column[name]) * CORES, _at(memory, step, column[name]) * MEMORY_MB
        return used + own.cpu_cores, used_mb + own.memory_mb

    task = replace(world.spec, tuning=tuning, price_s=price_s)
    sim = Simulator(fleet=replace(world.fleet, tasks=(task,)), seed=1, load=load)
    sim.start()
    learnt: list[tuple[float, str]] = []

    def note() -> bool:
        value = sim.node("robot001").registers[task.name].value
        if value.owner is not None and (not learnt or learnt[-1][1] != value.owner):
            learnt.append((sim.now - STARTED_AT_S, value.owner))
        return False

    sim.run_until(note, MINUTES * 60)
    return learnt


def _at(table: Array, step: int, column: int) -> float:
    return float(table[step, column])


@pytest.mark.parametrize(
    ("seed", "scatter", "tuning", "price_s"),
    [
        (1, 0.0, WIDE, 1.0),
        pytest.param(2, 0.03, PLAIN, 1.0, marks=pytest.mark.long),
        (2, 0.03, PLAIN, 0.3),
    ],
)
def test_the_replay_makes_the_moves_that_full_nodes_make(
    seed: int, scatter: float, tuning: Tuning, price_s: float
) -> None:
    world = history(seed, scatter)
    rule = Entry(name="zsched", make=lambda view: CoreRule(view, tuning, price_s=price_s))
    moves = replay(world, (rule,))["zsched"]
    nodes = by_nodes(world, tuning, price_s)

    assert [move.owner for move in moves] == [owner for _, owner in nodes]
    assert len(moves) >= 4, "a history without moves shows nothing"
    late = [at_s - move.at_s for move, (at_s, _) in zip(moves, nodes, strict=True)]
    assert max(map(abs, late[1:])) <= TOLERANCE_S, late
