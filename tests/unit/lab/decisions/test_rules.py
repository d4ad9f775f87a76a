"""The rules on short histories: what each does, and that the goals for stickiness and quickness hold."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import numpy as np
import pytest

from support.fleets import task_of
from zsched.config.load import check_bytes
from zsched.core.scheduler.ledger import left_after_s
from zsched.core.values.fleet import DEFAULT_BONUS
from zsched.core.values.model import Tuning
from zsched_lab.decisions import entries
from zsched_lab.decisions.replay import Entry, replay
from zsched_lab.decisions.report import STARS
from zsched_lab.decisions.rules import BlindRule, CoreRule, Move, PickRule, drawn, first_match, fixed
from zsched_lab.decisions.view import Feed, Look, View
from zsched_lab.decisions.world import DT_S, EVEN, World, equal_world, loaded_world

STEP_AT_S = 60.0
PLAIN = """\
fleet: plain
nodes:
  robot1: {kind: robot}
  edge1: {kind: edge, host: 192.0.2.11, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}
seeds: [edge1]
tasks:
  plain:
    candidates: {kind: edge}
    weights: {cpu: 0.5, memory: 0.5}
    scheduling: {score: paper}
"""
"""A fleet file that leaves everything else to zsched."""


def only(world: World, entry: Entry, seed: int = 0) -> list[Move]:
    return [move for move in replay(world, (entry,), seed)[entry.name] if move.left is not None]


def test_equal_nodes_under_noise_are_not_moved_between_and_the_penalty_never_rests() -> None:
    world = equal_world(seed=1, hours=0.1)
    assert [len(only(world, entry)) for entry in entries.ours(world)] == [0]
    penalty = only(world, Entry(name="penalty", make=lambda view: PickRule(view, cost=-0.1)))
    assert len(penalty) > 100
    argmax = only(world, Entry(name="argmax", look=entries.RAW, make=PickRule))
    assert 10 < len(argmax) < len(penalty)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_step_of_thirty_percent_is_followed_in_time(seed: int) -> None:
    world = equal_world(seed=seed, hours=0.03, step_at_s=STEP_AT_S)
    for entry in entries.ours(world):
        (move,) = only(world, entry, seed)
        assert move.left == "edge001"
        assert 0.0 < move.at_s - STEP_AT_S <= 1.5, entry.name


def short_of_memory(*ratios: float) -> World:
    """So much of each edge's memory is in use, from the 20th second on; before it the first edge is the idler one."""
    world = equal_world(seed=1, hours=0.02, half_width=0.0)
    memory, cpu = world.memory.copy(), world.cpu.copy()
    start = round(20.0 / DT_S)
    cpu[:start, 1:] += 0.3
    memory[start:] = ratios
    return replace(world, cpu=cpu, cpu_read=cpu, memory=memory, memory_read=memory)


def test_no_rule_of_ours_flees_for_memory_to_a_machine_that_would_lack_it_too() -> None:
    """As in the product: the owner cannot be scored, and is left for that, by a planned move."""
    for entry in entries.ours(short_of_memory(0.96, 0.92)):
        ((move,), (fled,)) = (only(short_of_memory(0.96, ratio), entry) for ratio in (0.92, 0.4))
        assert not move.is_escape, entry.name
        assert move.at_s > fled.at_s, entry.name


def test_a_move_that_costs_more_waits_longer() -> None:
    def delay(price_s: float) -> float:
        world = equal_world(seed=1, hours=0.03, half_width=0.0, step_at_s=STEP_AT_S)
        (move,) = only(world, Entry(name="dear", make=entries.core(world, price_s=price_s)))
        return move.at_s - STEP_AT_S

    assert delay(0.3) < delay(1.5) < delay(3.0)


@pytest.mark.parametrize("price_s", [0.0, 0.3, 1.5, 3.0])
def test_what_zsched_check_says_of_the_time_to_leave_is_what_the_rule_takes(price_s: float) -> None:
    world = equal_world(seed=1, hours=0.03, half_width=0.0, step_at_s=STEP_AT_S)
    (move,) = only(world, Entry(name="one", make=entries.core(world, price_s=price_s)))
    timing = world.fleet.timing
    told_s = left_after_s(0.3 - DEFAULT_BONUS, price_s, timing.smoothing_s)
    assert move.at_s - STEP_AT_S == pytest.approx(told_s, abs=0.75 * timing.decide_s)


def spiky() -> World:
    """Every 20 s the first edge is a fifth of a machine busier for 1 s, in CPU and memory."""
    world = equal_world(seed=1, hours=0.05, half_width=0.0)
    use = world.cpu.copy()
    at_s = np.arange(world.steps) * DT_S
    use[(at_s + 5.0) % 20.0 < 1.0, 0] += 0.2
    use[at_s < 10.0, 1] += 0.3  # every rule begins on the first edge
    return replace(world, cpu=use, memory=use, cpu_read=use, memory_read=use)


def test_short_spikes_move_nothing_by_default_and_without_a_price_they_would() -> None:
    world = spiky()
    assert [only(world, entry) for entry in entries.ours(world)] == [[]]
    assert len(only(world, Entry(name="free", make=entries.core(world, price_s=0.0)))) >= 1


def test_a_lower_price_keeps_equal_nodes_apart_as_well_and_follows_a_step() -> None:
    cheap = Entry(name="cheap", make=lambda view: CoreRule(view, Tuning(weights=EVEN, bonus=0.05), price_s=0.2))
    assert only(equal_world(seed=1, hours=0.1), cheap) == []
    assert len(only(equal_world(seed=1, hours=0.03, step_at_s=STEP_AT_S), cheap)) == 1


def test_zsched_in_the_comparison_is_what_a_fleet_file_gets_that_names_the_paper_s_score_only() -> None:
    """Rule "zsched" plays the product's defaults, whatever they are."""
    result = check_bytes(PLAIN.encode(), "plain.yaml")
    assert result.fleet is not None, result.faults
    task = result.fleet.task("plain")
    world = loaded_world(seed=1, hours=0.05, with_radio=True)
    as_file = CoreRule(View(world, Feed(world, Look())), task.tuning, price_s=task.price_s, memory_s=task.memory_s)
    (zsched,) = entries.ours(world)
    rule = zsched.make(as_file.view)
    assert isinstance(rule, CoreRule)
    settings = replace(task.tuning, weights=rule.tuning.weights)
    assert (rule.tuning, rule.price_s, rule.memory_s) == (settings, task.price_s, task.memory_s)
    assert world.spec.limits == task.limits
    assert zsched.look == Look(smoothing_s=result.fleet.timing.smoothing_s)


def test_rules_that_look_at_nothing() -> None:
    world = loaded_world(seed=1, hours=0.05)
    always = only(world, Entry(name="fixed", make=lambda view: BlindRule(view, fixed("edge002"))))
    assert always == []
    first = replay(world, (Entry(name="first", make=lambda view: BlindRule(view, first_match, period_s=1.0)),))
    assert [move.owner for move in first["first"]] == ["edge001"]
    anyone = only(world, Entry(name="random", make=lambda view: BlindRule(view, drawn(Random(1)), period_s=5.0)))
    assert len(anyone) > 10


def test_every_entry_of_every_cast_plays_and_has_a_name_of_its_own() -> None:
    world = loaded_world(seed=1, hours=0.01, with_radio=True)
    for cast in (entries.schemes(world, 1), entries.costly(world, 5.0), entries.readings(world), entries.grid(world)):
        names = [entry.name for entry in cast]
        assert len(set(names)) == len(names)
        moves = replay(world, cast)
        assert all(moves[name] for name in names), "everybody places the task"


def test_the_grid_holds_the_default() -> None:
    world = loaded_world(seed=1, hours=0.05)
    smoothing_s = world.fleet.timing.smoothing_s
    default = f"s{smoothing_s:g} b{DEFAULT_BONUS:g} p{task_of().price_s:g}"
    assert list(STARS.values()) == [default]
    cast = {entry.name: entry for entry in entries.grid(world)}
    (zsched,) = entries.ours(world)
    assert only(world, cast[default]) == only(world, zsched)
    assert cast[default].look == Look(smoothing_s=smoothing_s)
