"""Who takes part: the paper's schemes, yardsticks, zsched's own rule, and the grid over its tuning.

Knows: every rule's name and settings. Does not know: histories, results.

The paper gives neither the cost of Alg. 2 nor rates; its schemes run here with a cost of 0.1, once a second, on
readings averaged over about a second, and with the demand-corrected equations of docs/decisions/0001.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from random import Random
from typing import Final

from zsched.core.values.fleet import DEFAULT_BONUS
from zsched.core.values.model import ScoreForm, Tuning, Weights
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
CPU_ONLY: Final = Weights(cpu=1.0, memory=0.0, network=0.0)
MEMORY_ONLY: Final = Weights(cpu=0.0, memory=1.0, network=0.0)


def core(
    world: World, *, bonus: float = DEFAULT_BONUS, price_s: float = 0.3, form: ScoreForm = ScoreForm.PAPER
) -> Callable[[Sight], Rule]:
    """The production's decision; what is not given is what a fleet file gets that leaves it out.

    These histories are judged by the paper's utility, so the product decides by that, too, but where
    ``form`` is `ScoreForm.SERVICE`: for the network alone both have the same terms, and service has margins.
    """
    tuning = Tuning(weights=world.spec.tuning.weights, score=form, bonus=bonus)
    return lambda view: CoreRule(view, tuning, price_s=price_s)


def ours(world: World) -> tuple[Entry, ...]:
    """The product as `score: paper` has it."""
    return (Entry(name="zsched", make=core(world)),)


def schemes(world: World, seed: int) -> tuple[Entry, ...]:
    """zsched, the paper's schemes and the yardsticks."""
    names = world.candidates[:3]
    return (
        *ours(world),
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
    """The sweep over zsched's tuning: smoothing, bonus, price. Names read ``s1 b0.05 p0.3``."""
    return tuple(
        Entry(
            name=f"s{smoothing_s:g} b{bonus:g} p{price_s:g}",
            look=Look(smoothing_s=smoothing_s),
            make=core(world, bonus=bonus, price_s=price_s),
        )
        for smoothing_s, bonus, price_s in itertools.product(
            (0.3, 1.0, 3.0), (0.0, 0.02, 0.05, 0.1), (0.1, 0.2, 0.3, 0.6)
        )
    )


def costly(world: World, move_cost_s: float) -> tuple[Entry, ...]:
    """What to do when a move costs this many seconds of work: that price, and other bonuses."""
    return (
        *ours(world),
        *(Entry(name=f"bonus {bonus:g}", make=core(world, bonus=bonus)) for bonus in (0.1, 0.15, 0.2, 0.3)),
        Entry(name="the price of the cost", make=core(world, price_s=max(0.3, move_cost_s))),
    )


def readings(world: World) -> tuple[Entry, ...]:
    """Robot to robot through one access point: by default, with another bonus, and plain argmax."""
    judged = tuple(
        Entry(name=f"zsched, bonus {bonus:g}", make=core(world, bonus=bonus)) for bonus in (DEFAULT_BONUS, 0.1)
    )
    return (*judged, Entry(name="argmax", look=RAW, make=_pick(0.0)))
