"""The recorded drives: which rule follows the best signal, how often it moves, and what that costs in delay.

Knows: recorded signals and delays, the paper's real-world figure. Does not know: simulated radio.

Signals are those recorded at each moment, not their mean: the oracle has the strongest of them at every reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from zsched.core.values.model import ScoreForm
from zsched_lab.decisions import entries
from zsched_lab.decisions.radio import Drive, read_drive
from zsched_lab.decisions.replay import Entry, replay
from zsched_lab.decisions.rules import Move, PickRule
from zsched_lab.decisions.score import owners_by_step, wasted_moves
from zsched_lab.decisions.view import Look
from zsched_lab.decisions.world import World, drives_world

FILES: Final = ("router-5G-trial1.csv.gz", "router-2G-trial1.csv.gz")
APART: Final = ("router-2G-trial2.csv.gz", "router-2G-trial3.csv.gz", "router-5G-trial2.csv.gz")
"""Drives that nothing was chosen by: where the folder has them, they are only looked at."""
SHIFT_S: Final = 120.0
"""The third robot drives as the first one did, two minutes later."""
WEAK_DBM: Final = -70.0
UNSMOOTHED: Final = Look(smoothing_s=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveFigures:
    """What one rule did on the drives."""

    rule: str
    moves: int
    wasted: int
    mean_dbm: float
    weak: float
    """Share of the time under `WEAK_DBM`."""
    delay_ms: float
    """Mean of the delays recorded for the owner's link."""


def load(folder: Path) -> tuple[Drive, ...]:
    """The two recorded drives and the first one shifted. Raises `OSError` when they are not in ``folder``."""
    first, second = (read_drive(folder / name) for name in FILES)
    return first, second, first.shifted(SHIFT_S)


def apart(folder: Path) -> dict[str, tuple[Drive, ...]]:
    """{title: three robots' drives} of what ``folder`` has of `APART`: all together, and each by itself, shifted."""
    found = {name: read_drive(folder / name) for name in APART if (folder / name).exists()}
    fleets = {drive.name: (drive, drive.shifted(SHIFT_S / 2), drive.shifted(SHIFT_S)) for drive in found.values()}
    together = {"all three": tuple(found.values())} if len(found) == len(APART) else {}
    return {f"robot to robot, kept apart: {name}": fleet for name, fleet in (together | fleets).items()}


def cast(world: World) -> tuple[Entry, ...]:
    """Who drives: zsched, what it could be, and the yardsticks."""
    return (
        *entries.ours(world),
        Entry(name="zsched by service", make=entries.core(world, form=ScoreForm.SERVICE)),
        *(
            Entry(name=f"by service, bonus {bonus:g}", make=entries.core(world, bonus=bonus, form=ScoreForm.SERVICE))
            for bonus in (0.05, 0.1)
        ),
        Entry(
            name="by service, smoothing 1 s",
            look=Look(smoothing_s=1.0),
            make=entries.core(world, form=ScoreForm.SERVICE),
        ),
        Entry(name="dyna_net", look=UNSMOOTHED, make=lambda view: PickRule(view, cost=entries.PAPER_COST)),
        Entry(name="dyna_net_penalty", look=UNSMOOTHED, make=lambda view: PickRule(view, cost=-entries.PAPER_COST)),
        Entry(name="argmax", look=UNSMOOTHED, make=PickRule),
        Entry(name="argmax, every 0.5 s", look=UNSMOOTHED, make=lambda view: PickRule(view, period_s=0.5)),
        Entry(name="every_25s", look=UNSMOOTHED, make=lambda view: PickRule(view, period_s=25.0)),
        *(entry for entry in entries.schemes(world, 1) if entry.name.startswith("fixed")),
    )


def compare(
    drives: tuple[Drive, ...], *, are_robots: bool, cast: Callable[[World], tuple[Entry, ...]] = cast
) -> tuple[list[DriveFigures], dict[str, list[Move]], World]:
    """Everybody's figures on the drives, the oracle's first; everybody's moves; and the history."""
    world = drives_world(drives, are_robots=are_robots)
    moves = dict(replay(world, cast(world)))
    signal = np.stack([drive.rssi_dbm[: world.steps] for drive in drives], axis=1)
    delay = np.stack([drive.delay_ms[: world.steps] for drive in drives], axis=1)
    best = np.nan_to_num(signal, nan=-math.inf).argmax(axis=1)
    figures = [_figures("oracle", best, signal, delay, int((np.diff(best) != 0).sum()), 0)]
    for rule, made in moves.items():
        later = [move for move in made if move.left is not None]
        owner = owners_by_step(world, made)
        figures.append(_figures(rule, owner, signal, delay, len(later), wasted_moves(later)))
    return figures, moves, world


def _figures(
    rule: str, owner: np.ndarray, signal: np.ndarray, delay: np.ndarray, moves: int, wasted: int
) -> DriveFigures:
    steps = np.flatnonzero(owner >= 0)
    mine = signal[steps, owner[steps]]
    ways = delay[steps, owner[steps]]
    return DriveFigures(
        rule=rule,
        moves=moves,
        wasted=wasted,
        mean_dbm=float(np.nanmean(mine)),
        weak=float((mine[np.isfinite(mine)] < WEAK_DBM).mean()),
        delay_ms=float(np.nanmean(ways)) if np.isfinite(ways).any() else math.nan,
    )
