"""The rules on short histories: what each does, and that the goals for stickiness and quickness hold."""

from __future__ import annotations

import itertools
from dataclasses import replace
from random import Random

import numpy as np
import pytest

from zsched.commands.rules import left_after_s
from zsched.config.load import check_bytes
from zsched.core.values.fleet import DEFAULT_BONUS, DEFAULT_COOL_DOWN_S, PAPER_PATIENCE
from zsched.core.values.model import Tuning
from zsched_lab.decisions import entries
from zsched_lab.decisions.replay import Entry, replay
from zsched_lab.decisions.report import STARS
from zsched_lab.decisions.rules import BlindRule, CoreRule, Move, PickRule, drawn, first_match, fixed
from zsched_lab.decisions.view import START_S, Feed, Look, View
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
    assert [len(only(world, entry)) for entry in entries.ours(world)] == [0, 0]
    penalty = only(world, Entry(name="penalty", make=lambda view: PickRule(view, cost=-0.1)))
    assert len(penalty) > 100
    argmax = only(world, Entry(name="argmax", look=entries.RAW, make=PickRule))
    assert 10 < len(argmax) < len(penalty)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_step_of_thirty_percent_is_followed_in_time(seed: int) -> None:
    """The goal is the timer's; patience is held to it, too, within a round."""
    world = equal_world(seed=seed, hours=0.03, step_at_s=STEP_AT_S)
    timing, trigger_s = world.fleet.timing, entries.TIMER_S
    for entry in entries.ours(world):
        (move,) = only(world, entry, seed)
        assert move.left == "edge001"
        assert move.at_s - STEP_AT_S >= trigger_s - timing.decide_s, entry.name
        assert move.at_s - STEP_AT_S <= trigger_s + 0.6 * timing.smoothing_s + 1.1 * timing.decide_s, entry.name


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
        assert (fled.is_escape, move.is_escape) == (True, False), entry.name
        assert move.at_s > fled.at_s, entry.name


def test_an_escape_is_kept_apart_from_planned_moves() -> None:
    """Else six of them in a minute would hold every planned move back."""
    world = short_of_memory(0.97, 0.4)
    view = View(world, feed := Feed(world, Look()))
    rule = CoreRule(view, Tuning(weights=EVEN))
    for step in range(world.steps):
        feed.step(step)
        rule.round((0,) if step % 5 == 0 else (), step * DT_S, now := START_S + step * DT_S)
        if len(rule.moves) == 2:
            break
    (first, fled) = rule.moves
    assert (first.owner, fled.left, fled.is_escape) == ("edge001", "edge001", True)
    assert [rule._damping.moves_within(60.0, now, escapes=is_escape) for is_escape in (True, False)] == [1, 0]


def test_after_a_move_the_cool_down_holds() -> None:
    world = loaded_world(seed=1, hours=0.2)
    tuning = Tuning(weights=EVEN, bonus=0.0, cool_down_s=20.0)
    moves = only(world, Entry(name="eager", make=lambda view: CoreRule(view, tuning, patience=0.0)))
    planned = [after.at_s - before.at_s for before, after in itertools.pairwise(moves) if not after.is_escape]
    assert len(planned) >= 3
    assert min(planned) >= 20.0


def test_patience_follows_a_big_lead_sooner_than_a_small_one() -> None:
    def delay(patience: float) -> float:
        world = equal_world(seed=1, hours=0.03, half_width=0.0, step_at_s=STEP_AT_S)
        (move,) = only(world, Entry(name="patient", make=entries.core(world, patience=patience)))
        return move.at_s - STEP_AT_S

    assert delay(0.05) < delay(0.4) < delay(1.6)


@pytest.mark.parametrize("patience", [0.0, 0.05, 0.3, 1.5])
def test_what_zsched_check_says_of_the_time_to_leave_is_what_the_rule_takes(patience: float) -> None:
    world = equal_world(seed=1, hours=0.03, half_width=0.0, step_at_s=STEP_AT_S)
    (move,) = only(world, Entry(name="patient", make=entries.core(world, patience=patience)))
    told_s = left_after_s(0.3, DEFAULT_BONUS, patience, world.fleet.timing)
    assert move.at_s - STEP_AT_S == pytest.approx(told_s, abs=0.75 * world.fleet.timing.decide_s)


def spiky() -> World:
    """Every 20 s the first edge is half a machine busier for one second, in CPU and memory."""
    world = equal_world(seed=1, hours=0.05, half_width=0.0)
    use = world.cpu.copy()
    at_s = np.arange(world.steps) * DT_S
    use[(at_s + 5.0) % 20.0 < 1.0, 0] += 0.5
    use[at_s < 10.0, 1] += 0.3  # every rule begins on the first edge
    return replace(world, cpu=use, memory=use, cpu_read=use, memory_read=use)


def test_short_spikes_move_nothing_by_default_nor_with_the_timer_and_half_the_patience_would_follow() -> None:
    """Why the patience of the paper's score is not less (docs/decisions/0033)."""
    world = spiky()
    assert [only(world, entry) for entry in entries.ours(world)] == [[], []]
    assert len(only(world, Entry(name="half", make=entries.core(world, patience=PAPER_PATIENCE / 2)))) >= 1


def test_patience_keeps_equal_nodes_apart_as_well_and_follows_a_step_sooner() -> None:
    patient = Entry(name="patient", make=lambda view: CoreRule(view, Tuning(weights=EVEN, bonus=0.05), patience=0.2))
    assert only(equal_world(seed=1, hours=0.1), patient) == []
    world = equal_world(seed=1, hours=0.03, step_at_s=STEP_AT_S)
    (move,) = only(world, patient)
    (by_timer,) = only(world, Entry(name="timer", make=entries.timed(world)))
    assert move.at_s < by_timer.at_s


def test_zsched_in_the_comparison_is_what_a_fleet_file_gets_that_names_the_paper_s_score_only() -> None:
    """Rule "zsched" plays the product's defaults, whatever they are."""
    result = check_bytes(PLAIN.encode(), "plain.yaml")
    assert result.fleet is not None, result.faults
    task = result.fleet.task("plain")
    world = loaded_world(seed=1, hours=0.05, with_radio=True)
    as_file = CoreRule(View(world, Feed(world, Look())), task.tuning, patience=task.patience)
    zsched, timer = entries.ours(world)
    rule = zsched.make(as_file.view)
    assert isinstance(rule, CoreRule)
    settings = replace(task.tuning, weights=rule.tuning.weights)
    assert (rule.tuning, rule.patience) == (settings, task.patience)
    assert zsched.limits == task.limits
    assert zsched.look == Look(smoothing_s=result.fleet.timing.smoothing_s)
    was = timer.make(as_file.view)
    assert isinstance(was, CoreRule)
    assert (was.tuning.bonus, was.tuning.cool_down_s, was.time_to_trigger_s, timer.limits) == (0.1, 10.0, 2.0, None)


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
    casts = (entries.schemes, lambda world, _: entries.fading(world), lambda world, _: entries.costly(world, 5.0))
    parts = (entries.grid(world), entries.cool_downs(world), entries.smoothings(world))
    for cast in (*(make(world, 1) for make in casts), *parts):
        names = [entry.name for entry in cast]
        assert len(set(names)) == len(names)
        moves = replay(world, cast)
        assert all(moves[name] for name in names), "everybody places the task"


def test_the_grid_holds_the_default() -> None:
    world = loaded_world(seed=1, hours=0.05)
    tuning = Tuning(weights=EVEN)
    smoothing = f"s{world.fleet.timing.smoothing_s:g}"
    default = f"{smoothing} b{DEFAULT_BONUS:g} p{PAPER_PATIENCE:g} c{DEFAULT_COOL_DOWN_S:g}"
    timer = f"{smoothing} b{tuning.bonus:g} t{entries.TIMER_S:g} c{tuning.cool_down_s:g}"
    assert list(STARS.values()) == [default, timer]
    cast = {entry.name: entry for entry in entries.grid(world)}
    for name, entry in zip((default, timer), entries.ours(world), strict=True):
        assert only(world, cast[name]) == only(world, entry)
        assert cast[name].look == Look(smoothing_s=world.fleet.timing.smoothing_s)
    name = f"{smoothing} p{PAPER_PATIENCE:g}"
    smoothed = {entry.name: entry for entry in entries.smoothings(world)}
    assert only(world, smoothed[name]) == only(world, entries.ours(world)[0])
