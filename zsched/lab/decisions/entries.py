"""Who takes part: the paper's schemes, yardsticks, zsched's own rule, and the grid over its tuning.

Knows: every rule's name and settings. Does not know: histories, results.

The paper gives neither the cost of Alg. 2 nor rates; its schemes run here with a cost of 0.1, once a second, on
readings averaged over about a second, and with the demand-corrected equations of docs/decisions/0001.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from random import Random
from typing import Any, Final

from zsched.core.fleet import LinkLimits, PairReading
from zsched.core.model import Tuning, Weights
from zsched.lab.decisions.replay import Entry
from zsched.lab.decisions.rules import (
    BlindRule,
    CoreRule,
    PickRule,
    Rule,
    drawn,
    first_match,
    fixed,
)
from zsched.lab.decisions.view import Look, View
from zsched.lab.decisions.world import EVEN, RADIO_ONLY, World

RAW: Final = Look(smoothing_s=0.5)
"""As noisy as a profiler that averages over one second."""
PAPER_COST: Final = 0.1
PATIENCE: Final = 0.2
"""Utility seconds, with a bonus of 0.05 (docs/evaluation/decisions.md)."""
CPU_ONLY: Final = Weights(cpu=1.0, memory=0.0, network=0.0)
MEMORY_ONLY: Final = Weights(cpu=0.0, memory=1.0, network=0.0)


def core(
    world: World,
    *,
    bonus: float | None = None,
    time_to_trigger_s: float | None = None,
    cool_down_s: float | None = None,
    patience: float | None = None,
    pays_off_in_s: float | None = None,
    move_cost_s: float = 0.0,
) -> Callable[[View], Rule]:
    """The production's decision; what is ``None`` is its default, a ``patience`` replaces the time-to-trigger."""
    given = {"bonus": bonus, "time_to_trigger_s": time_to_trigger_s, "cool_down_s": cool_down_s}
    settings: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    tuning = Tuning(weights=world.spec.tuning.weights, **settings)
    return lambda view: CoreRule(view, tuning, patience=patience, pays_off_in_s=pays_off_in_s, move_cost_s=move_cost_s)


def schemes(world: World, seed: int) -> tuple[Entry, ...]:
    """zsched, the paper's schemes and the yardsticks."""
    names = world.candidates[:3]
    return (
        Entry(name="zsched", make=core(world)),
        Entry(name="zsched, bonus 0.05", make=core(world, bonus=0.05)),
        Entry(name="zsched, patience", make=core(world, bonus=0.05, patience=PATIENCE)),
        *(Entry(name=f"fixed_e{index}", make=_blind(fixed(name))) for index, name in enumerate(names, 1)),
        Entry(name="dyna_cpu", look=RAW, weights=CPU_ONLY, make=_pick(PAPER_COST)),
        Entry(name="dyna_mem", look=RAW, weights=MEMORY_ONLY, make=_pick(PAPER_COST)),
        Entry(name="dyna_both", look=RAW, weights=EVEN, make=_pick(PAPER_COST)),
        Entry(name="dyna_net", look=RAW, weights=RADIO_ONLY, make=_pick(PAPER_COST)),
        Entry(name="dyna_both_penalty", look=RAW, weights=EVEN, make=_pick(-PAPER_COST)),
        Entry(name="argmax", look=RAW, make=_pick(0.0)),
        Entry(name="every_25s", look=RAW, make=lambda view: PickRule(view, period_s=25.0)),
        Entry(name="random", make=lambda view: BlindRule(view, drawn(Random(seed)), period_s=25.0)),
        Entry(name="first_match", look=RAW, make=lambda view: BlindRule(view, first_match, period_s=1.0)),
    )


def _pick(cost: float) -> Callable[[View], Rule]:
    return lambda view: PickRule(view, cost=cost)


def _blind(choose: Callable[[tuple[str, ...]], str]) -> Callable[[View], Rule]:
    return lambda view: BlindRule(view, choose)


def grid(world: World) -> tuple[Entry, ...]:
    """The sweep over zsched's tuning: smoothing, bonus, time-to-trigger, cool-down; patience in place of the timer.

    Names read ``s3 b0.1 t2 c10`` and ``s3 b0.05 p0.2 c5``.
    """
    timed = tuple(
        Entry(
            name=f"s{smoothing_s:g} b{bonus:g} t{trigger_s:g} c{cool_s:g}",
            look=Look(smoothing_s=smoothing_s),
            make=core(world, bonus=bonus, time_to_trigger_s=trigger_s, cool_down_s=cool_s),
        )
        for smoothing_s, bonus, trigger_s, cool_s in itertools.product(
            (1.5, 3.0), (0.03, 0.05, 0.07, 0.10, 0.15), (1.0, 2.0, 4.0), (5.0, 10.0)
        )
    )
    patient = tuple(
        Entry(
            name=f"s{smoothing_s:g} b{bonus:g} p{patience:g} c5",
            look=Look(smoothing_s=smoothing_s),
            make=core(world, bonus=bonus, cool_down_s=5.0, patience=patience),
        )
        for smoothing_s, bonus, patience in itertools.product((1.5, 3.0), (0.03, 0.05, 0.07), (0.05, 0.1, 0.2))
    )
    return timed + patient


def fading(world: World) -> tuple[Entry, ...]:
    """Prediction of a fading link, at the default tuning: ``link.foresee_s``; and a knee, and both."""
    ahead = tuple(
        Entry(name=f"foresee {lead_s:g} s", limits=LinkLimits(foresee_s=lead_s), make=core(world))
        for lead_s in (1.0, 2.0, 3.0, 4.0)
    )
    return (
        Entry(name="zsched", make=core(world)),
        *ahead,
        Entry(name="knee -65 dBm", limits=LinkLimits(knee_dbm=-65.0), make=core(world)),
        *(
            Entry(name=f"patience, foresee {lead_s:g} s", limits=LinkLimits(foresee_s=lead_s), make=_patient(world))
            for lead_s in (2.0, 3.0, 4.0)
        ),
        Entry(name="zsched, patience", make=_patient(world)),
    )


def _patient(world: World) -> Callable[[View], Rule]:
    return core(world, bonus=0.05, patience=PATIENCE)


def costly(world: World, move_cost_s: float) -> tuple[Entry, ...]:
    """What to do when a move costs so many seconds of work: fixed bonuses, patience, and the measured cost."""
    return (
        Entry(name="zsched", make=core(world)),
        *(Entry(name=f"bonus {bonus:g}", make=core(world, bonus=bonus)) for bonus in (0.05, 0.15, 0.2, 0.3)),
        *(
            Entry(
                name=f"bonus {bonus:g} + cost over {horizon_s:g} s",
                make=core(world, bonus=bonus, pays_off_in_s=horizon_s, move_cost_s=move_cost_s),
            )
            for bonus, horizon_s in ((0.05, 60.0), (0.05, 120.0), (0.1, 60.0), (0.1, 120.0))
        ),
        Entry(name="zsched, patience", make=_patient(world)),
        Entry(name="patience of the cost", make=core(world, bonus=0.05, patience=max(PATIENCE, 0.5 * move_cost_s))),
    )


def readings(world: World) -> tuple[Entry, ...]:
    """Robot to robot through one access point: every reading of a pair, at several bonuses, and plain argmax."""
    judged = tuple(
        Entry(
            name=f"{pair}, bonus {bonus:g}" + (f", foresee {lead_s:g} s" if lead_s else ""),
            limits=LinkLimits(pair=pair, foresee_s=lead_s),
            make=core(world, bonus=bonus),
        )
        for pair, bonus, lead_s in itertools.product(PairReading, (0.1, 0.05, 0.03), (0.0, 2.0))
    )
    plain = tuple(
        Entry(name=f"{pair}, argmax", look=RAW, limits=LinkLimits(pair=pair), make=_pick(0.0)) for pair in PairReading
    )
    return judged + plain
