"""Plays histories to rules; results are lines of JSON that a later run goes on from.

Knows: experiments, seeds (those that defaults are chosen by, and those that are only looked at afterwards), resuming.
Does not know: how a rule decides, how results are shown.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from zsched_lab.decisions import entries, loads
from zsched_lab.decisions.replay import Entry, replay
from zsched_lab.decisions.score import MOVE_COST_S, figures, truth_of
from zsched_lab.decisions.world import World, equal_world, loaded_world, robots_world

TRAIN: Final = range(1, 1000)
"""Seeds that the defaults are chosen by."""
TEST: Final = range(1001, 2000)
"""Seeds that are only looked at afterwards."""
CANDIDATES: Final = (3, 10, 50, 200)
COSTS_S: Final = (1.0, 5.0, 15.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One history to be played: ``build(seed, hours)`` makes it, ``cast`` names the rules."""

    name: str
    build: Callable[[int, float], World]
    cast: Callable[[World, int], tuple[Entry, ...]]
    hours: float
    """Length of one history."""
    share: float = 1.0
    """How many of the hours asked for: large fleets get fewer."""
    move_cost_s: float = MOVE_COST_S


def _loads(edges: int, plan: loads.LoadPlan, *, with_radio: bool = False) -> Callable[[int, float], World]:
    return lambda seed, hours: loaded_world(seed=seed, hours=hours, edges=edges, plan=plan, with_radio=with_radio)


def _equal(seed: int, hours: float) -> World:
    return equal_world(seed=seed, hours=hours)


def _robots(seed: int, hours: float) -> World:
    return robots_world(seed=seed, hours=hours)


def _step(seed: int, hours: float) -> World:
    return equal_world(seed=seed, hours=hours, step_at_s=60.0)


def compared(candidates: tuple[int, ...]) -> tuple[Case, ...]:
    """The schemes on every kind of history, and on fleets of every size."""
    kinds = (
        ("long", _loads(3, loads.LONG)),
        ("mixed", _loads(3, loads.MIXED)),
        ("short", _loads(3, loads.SHORT)),
        ("radio", _loads(3, loads.LONG, with_radio=True)),
        ("equal", _equal),
    )
    small = tuple(Case(name=name, build=build, cast=entries.schemes, hours=1.0) for name, build in kinds)
    step = Case(name="step", build=_step, cast=entries.schemes, hours=0.025, share=0.25)
    large = tuple(
        Case(
            name=f"long-{count}",
            build=_loads(count, loads.LONG),
            cast=entries.schemes,
            hours=min(1.0, 12.5 / count),
            share=min(0.5, 1.25 / count),
        )
        for count in candidates
        if count > 3
    )
    return (*small, step, *large)


def swept() -> tuple[Case, ...]:
    """The grid over zsched's tuning."""

    def cast(world: World, _seed: int) -> tuple[Entry, ...]:
        return entries.grid(world)

    return tuple(
        Case(name=f"sweep {name}", build=build, cast=cast, hours=1.0, share=share)
        for name, build, share in (
            ("long", _loads(3, loads.LONG), 1.0),
            ("mixed", _loads(3, loads.MIXED), 0.5),
            ("radio", _loads(3, loads.LONG, with_radio=True), 0.5),
            ("equal", _equal, 0.5),
        )
    )


def options() -> tuple[Case, ...]:
    """What might be better than the paper's: links between robots, dear moves."""
    return (
        Case(name="robots", build=_robots, cast=lambda world, _seed: entries.readings(world), hours=1.0),
        *(_costly(cost_s) for cost_s in COSTS_S),
    )


def _costly(cost_s: float) -> Case:
    return Case(
        name=f"a move costs {cost_s:g} s",
        build=_loads(3, loads.MIXED),
        cast=lambda world, _seed: entries.costly(world, cost_s),
        hours=1.0,
        move_cost_s=cost_s,
    )


def play(
    cases: tuple[Case, ...], hours: float, seeds: range, out: Path, only: frozenset[str] = frozenset()
) -> Iterator[str]:
    """Play every case for about ``hours``, one history per seed, and append each result to ``out``.

    What ``out`` holds of a rule already is not played again. Yields one line per history for people. ``only`` names
    the rules that take part (none: all).
    """
    done = {(row["case"], row["seed"], row["rule"]) for row in read(out)}
    if out.exists() and not out.read_text(encoding="utf-8").endswith("\n"):
        with out.open("a", encoding="utf-8") as file:
            file.write("\n")  # a run was killed while it wrote
    for case in cases:
        count = max(1, round(hours * case.share / case.hours))
        for seed in seeds[:count]:
            world = case.build(seed, case.hours)
            told = (entry for entry in case.cast(world, seed) if not only or entry.name in only)
            cast = tuple(entry for entry in told if (case.name, seed, entry.name) not in done)
            has_oracle = (case.name, seed, "oracle") in done
            if has_oracle and not cast:
                continue
            truth = truth_of(world, move_cost_s=case.move_cost_s)
            moves = replay(world, cast, seed)
            rows = [
                {"case": case.name, "seed": seed, "rule": name, **asdict(figures(world, truth, made))}
                for name, made in moves.items()
            ]
            if not has_oracle:
                rows.append({"case": case.name, "seed": seed, "rule": "oracle", **asdict(truth.figures())})
            with out.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in rows)
            yield f"{case.name} seed {seed}: {len(rows)} rules, {case.hours:g} h"


def read(out: Path) -> list[dict[str, float | str]]:
    """All results so far; a line that was cut off by the end of a run is left out."""
    rows = []
    if out.exists():
        for line in out.read_text(encoding="utf-8").splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                continue
    return rows
