"""Plays histories to rules; results are lines of JSON that a later run goes on from.

Knows: seeds for choosing and seeds for checking, what is played already. Does not know: how a rule decides, tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any, Final

from zsched_lab.decisions.loads import SPIKES
from zsched_lab.decisions.service.cast import described, players
from zsched_lab.decisions.service.history import Activity, build
from zsched_lab.decisions.service.judge import Figures, fixed, judge, oracle
from zsched_lab.decisions.service.present import present
from zsched_lab.decisions.service.replay import replay

TRAIN: Final = range(1, 100)
"""Seeds that rules are chosen by."""
TEST: Final = range(100, 1000)
"""Seeds that are only looked at afterwards."""
LOADS_S: Final = (0.0, 5.0, 10.0, 15.0, 60.0, 300.0)
PRICES_S: Final = (0.05, 0.3, 1.0)
"""What a move costs, in seconds without the task; real fleets: 0.3 to 0.5 s."""
YARDSTICKS: Final = ("oracle", "present", "fixed, best", "fixed, mean")
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One history, and the rules that are still to be played on it."""

    seed: int
    hours: float
    load_s: float
    tasks: int
    prices_s: tuple[float, ...]
    activity: Activity = Activity.STEADY
    is_equal: bool = False
    has_spikes: bool = False
    rules: tuple[str, ...]
    """Names of `players` or of `YARDSTICKS`, or descriptions (`described`)."""


def cases(
    seeds: Sequence[int],
    hours: float,
    loads_s: Sequence[float],
    tasks: Sequence[int],
    prices_s: Sequence[float],
    rules: Sequence[str],
    known: Sequence[Row],
    activity: Activity = Activity.STEADY,
    *,
    is_equal: bool = False,
    has_spikes: bool = False,
) -> list[Case]:
    """Every history with the rules and prices that ``known`` holds no results of; those without any are left out."""
    done = {(row["tasks"], row["load_s"], row["seed"], row["asked_hours"], row["price_s"], row["as"]) for row in known}
    made = []
    for seed, count, load_s in itertools.product(seeds, tasks, loads_s):
        missing: dict[tuple[float, ...], list[str]] = {}
        for rule in rules:
            left = tuple(one for one in prices_s if (count, load_s, seed, hours, one, rule) not in done)
            missing.setdefault(left, []).append(rule)
        made += [
            Case(
                seed=seed,
                hours=hours,
                load_s=load_s,
                tasks=count,
                prices_s=left,
                rules=tuple(names),
                activity=activity,
                is_equal=is_equal,
                has_spikes=has_spikes,
            )
            for left, names in missing.items()
            if left
        ]
    return made


def play(case: Case) -> list[Row]:
    """One row per rule and price."""
    history = build(
        seed=case.seed,
        hours=case.hours,
        load_s=case.load_s,
        tasks=case.tasks,
        activity=case.activity,
        is_equal=case.is_equal,
        spikes=SPIKES if case.has_spikes else (),
    )
    common = {"tasks": case.tasks, "load_s": case.load_s, "seed": case.seed, "asked_hours": case.hours}
    found = {one.name: one for one in players()}
    every: dict[float, list[Figures]] = {}
    if set(YARDSTICKS[2:]) & set(case.rules):
        judged = [judge(history, moves, case.prices_s) for moves in fixed(history)]
        every = {price_s: [one[index] for one in judged] for index, price_s in enumerate(case.prices_s)}
    rows: list[Row] = []
    for rule in case.rules:
        if rule == "oracle":
            made = [judge(history, oracle(history, price_s), (price_s,))[0] for price_s in case.prices_s]
        elif rule == "present":
            made = [judge(history, present(history, price_s), (price_s,))[0] for price_s in case.prices_s]
        elif rule == "fixed, best":
            made = [min(every[price_s], key=lambda one: one.lost) for price_s in case.prices_s]
        elif rule == "fixed, mean":
            made = [_mean(every[price_s]) for price_s in case.prices_s]
        else:
            player = found.get(rule) or described(rule)
            made = judge(history, replay(history, player, case.seed), case.prices_s)
        name = rule.partition(":")[0]
        rows += [{**common, "rule": name, "as": rule, "size": history.size, **asdict(one)} for one in made]
    return rows


def _mean(every: list[Figures]) -> Figures:
    """The mean over all fixed placements; each meets other loads, so nobody reacts."""
    return Figures(
        price_s=every[0].price_s,
        hours=every[0].hours,
        lost=fmean(one.lost for one in every),
        outputs_hz=fmean(one.outputs_hz for one in every),
        missed=fmean(one.missed for one in every),
        slow=fmean(one.slow for one in every),
        moves=0,
        wasted=0,
        felt=0,
        reactions_s=(),
    )


def play_all(made: Sequence[Case], jobs: int) -> Iterator[tuple[Case, list[Row]]]:
    """Play them, up to ``jobs`` at a time, in whatever order they end."""
    if jobs <= 1:
        yield from ((case, play(case)) for case in made)
        return
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        running = {pool.submit(play, case): case for case in made}
        for done in as_completed(running):
            yield running[done], done.result()
