"""Who takes part: the paper's schemes, yardsticks, zsched's own rule, and the grid over its tuning.

Knows: every rule's name and settings. Does not know: histories, results.

The paper gives neither the cost of Alg. 2 nor rates; its schemes run here with a cost of 0.1, once a second, on
readings averaged over about a second, and with the demand-corrected equations of docs/decisions/0001.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any, Final

from zsched.core.values.fleet import DEFAULT_BONUS, DEFAULT_COOL_DOWN_S, DEFAULT_FORESEE_S, PAPER_PATIENCE, LinkLimits
from zsched.core.values.model import PairReading, ScoreForm, Tuning, Weights
from zsched_lab.decisions.ledger import BONUS, Ledger
from zsched_lab.decisions.replay import Entry
from zsched_lab.decisions.rules import (
    BlindRule,
    CoreRule,
    PickRule,
    Rule,
    drawn,
    first_match,
    fixed,
)
from zsched_lab.decisions.view import Look, Sight
from zsched_lab.decisions.world import EVEN, RADIO_ONLY, World

RAW: Final = Look(smoothing_s=0.5)
"""As noisy as a profiler that averages over one second."""
PAPER_COST: Final = 0.1
TIMER_S: Final = 2.0
"""The time-to-trigger of the rules that have one, with the bonus of `Tuning` (docs/decisions/0017)."""
CPU_ONLY: Final = Weights(cpu=1.0, memory=0.0, network=0.0)
MEMORY_ONLY: Final = Weights(cpu=0.0, memory=1.0, network=0.0)


def core(
    world: World,
    *,
    bonus: float | None = None,
    time_to_trigger_s: float | None = None,
    cool_down_s: float | None = None,
    patience: float | None = None,
    form: ScoreForm = ScoreForm.PAPER,
) -> Callable[[Sight], Rule]:
    """The production's decision; what is ``None`` is what a fleet file with ``score: paper`` gets that leaves it out.

    These histories are judged by the paper's utility, so the product decides by that, too (docs/decisions/0024), but
    where ``form`` is `ScoreForm.SERVICE`: for the network alone both have the same terms, and service has margins.
    With a time-to-trigger it is the rule before patience, with the bonus and the cool-down that it had: those of
    `Tuning`. Signals are `foreseeing`'s affair.
    """
    tuning = Tuning(weights=world.spec.tuning.weights, score=form)
    if time_to_trigger_s is None:
        tuning = replace(tuning, bonus=DEFAULT_BONUS, cool_down_s=DEFAULT_COOL_DOWN_S)
    tuning = tuning if bonus is None else replace(tuning, bonus=bonus)
    tuning = tuning if cool_down_s is None else replace(tuning, cool_down_s=cool_down_s)
    held = PAPER_PATIENCE if patience is None else patience
    return lambda view: CoreRule(view, tuning, patience=held, time_to_trigger_s=time_to_trigger_s)


def foreseeing(world: World, lead_s: float = DEFAULT_FORESEE_S, **more: Any) -> LinkLimits | None:
    """The limits of a task that counts signals ``lead_s`` ahead; the world's own where there is no radio."""
    return None if world.signal is None else LinkLimits(foresee_s=lead_s, **more)


def by_ledger(world: World) -> Callable[[Sight], Rule]:
    """The production's decision by a ledger in place of patience; it needs no foresight."""
    tuning = Tuning(weights=world.spec.tuning.weights, score=ScoreForm.SERVICE, bonus=BONUS, cool_down_s=0.0)
    return lambda view: CoreRule(view, tuning, ledger=Ledger)


def ours(world: World) -> tuple[Entry, ...]:
    """The product as `score: paper` has it, and with a time-to-trigger in place of patience and foresight."""
    return (
        Entry(name="zsched", limits=foreseeing(world), make=core(world)),
        Entry(name="zsched, timer", make=timed(world)),
    )


def timed(world: World, **settings: Any) -> Callable[[Sight], Rule]:
    """The production's decision with a time-to-trigger, as it came until docs/decisions/0021; see `core`."""
    return core(world, **{"time_to_trigger_s": TIMER_S, **settings})


def schemes(world: World, seed: int) -> tuple[Entry, ...]:
    """zsched, the paper's schemes and the yardsticks."""
    names = world.candidates[:3]
    return (
        *ours(world),
        Entry(name="zsched, timer, bonus 0.05", make=timed(world, bonus=0.05)),
        *((Entry(name="patience without foresight", make=core(world)),) if world.signal is not None else ()),
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


def _pick(cost: float) -> Callable[[Sight], Rule]:
    return lambda view: PickRule(view, cost=cost)


def _blind(choose: Callable[[tuple[str, ...]], str]) -> Callable[[Sight], Rule]:
    return lambda view: BlindRule(view, choose)


def grid(world: World) -> tuple[Entry, ...]:
    """The sweep over zsched's tuning: smoothing, bonus, time-to-trigger, cool-down; patience in place of the timer.

    Names read ``s1 b0.1 t2 c10`` and ``s1 b0.05 p0.4 c5``.
    """
    by_timer = tuple(
        Entry(
            name=f"s{smoothing_s:g} b{bonus:g} t{trigger_s:g} c{cool_s:g}",
            look=Look(smoothing_s=smoothing_s),
            make=core(world, bonus=bonus, time_to_trigger_s=trigger_s, cool_down_s=cool_s),
        )
        for smoothing_s, bonus, trigger_s, cool_s in itertools.product(
            (0.3, 1.0, 3.0), (0.03, 0.05, 0.10, 0.15), (1.0, 2.0, 4.0), (10.0,)
        )
    )
    patient = tuple(
        Entry(
            name=f"s{smoothing_s:g} b{bonus:g} p{patience:g} c{cool_s:g}",
            look=Look(smoothing_s=smoothing_s),
            make=core(world, bonus=bonus, cool_down_s=cool_s, patience=patience),
        )
        for smoothing_s, bonus, patience, cool_s in itertools.product(
            (0.3, 1.0, 3.0), (0.03, 0.05, 0.07), (0.1, 0.2, 0.4, 0.55), (2.0,)
        )
    )
    return by_timer + patient


def cool_downs(world: World) -> tuple[Entry, ...]:
    """The default with other cool-downs, from none to what the timer has."""
    return tuple(
        Entry(name=f"cool-down {cool_s:g} s", limits=foreseeing(world), make=core(world, cool_down_s=cool_s))
        for cool_s in (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
    )


def smoothings(world: World) -> tuple[Entry, ...]:
    """The default with other smoothing and patience. Names read ``s3 p0.2``."""
    return tuple(
        Entry(
            name=f"s{smoothing_s:g} p{patience:g}",
            look=Look(smoothing_s=smoothing_s),
            limits=foreseeing(world),
            make=core(world, patience=patience),
        )
        for smoothing_s, patience in itertools.product(
            (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0), (0.1, 0.2, 0.3, 0.4, 0.5, 0.55)
        )
    )


def fading(world: World) -> tuple[Entry, ...]:
    """Prediction of a fading link, with patience (3 s is the default) and with the timer."""
    return (*ours(world), *foresights(world))


def foresights(world: World) -> tuple[Entry, ...]:
    """``link.foresee_s`` from 0 to 4 s, with the timer and with patience, where that is neither of `ours`."""
    return (
        *(
            Entry(name=f"timer, foresee {lead_s:g} s", limits=foreseeing(world, lead_s), make=timed(world))
            for lead_s in (1.0, 2.0, 3.0, 4.0)
        ),
        *(
            Entry(name=f"patience, foresee {lead_s:g} s", limits=foreseeing(world, lead_s), make=core(world))
            for lead_s in (2.0, 4.0)
        ),
        Entry(name="patience without foresight", make=core(world)),
    )


def costly(world: World, move_cost_s: float) -> tuple[Entry, ...]:
    """What to do when a move costs this many seconds of work: other bonuses, and a patience by the cost."""
    return (
        *ours(world),
        *(Entry(name=f"timer, bonus {bonus:g}", make=timed(world, bonus=bonus)) for bonus in (0.05, 0.15, 0.2, 0.3)),
        Entry(name="patience of the cost", make=core(world, patience=max(PAPER_PATIENCE, 0.5 * move_cost_s))),
    )


def readings(world: World) -> tuple[Entry, ...]:
    """Robot to robot through one access point: every reading of a pair, by default, with timers, and plain argmax."""
    judged = tuple(
        Entry(name=f"{pair}, zsched", limits=foreseeing(world, pair=pair), make=core(world)) for pair in PairReading
    )
    judged += tuple(
        Entry(
            name=f"{pair}, timer, bonus {bonus:g}" + (f", foresee {lead_s:g} s" if lead_s else ""),
            limits=LinkLimits(pair=pair, foresee_s=lead_s),
            make=timed(world, bonus=bonus),
        )
        for pair, bonus, lead_s in itertools.product(PairReading, (0.1, 0.05, 0.03), (0.0, 2.0))
    )
    plain = tuple(
        Entry(name=f"{pair}, argmax", look=RAW, limits=LinkLimits(pair=pair), make=_pick(0.0)) for pair in PairReading
    )
    return judged + plain
