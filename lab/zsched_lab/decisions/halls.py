"""Simulated drives, as many as are wanted: how far a price of moves follows a radio, with what scatter over drives.

Knows: a hall with one access point, drives by seed, the rules that are compared. Does not know: recordings.

    python -m zsched_lab.decisions halls [--seeds train|test] [--drives 30]

Two recorded drives are few: settings that differ by a tenth change places on them. Every hall has three machines that
drive through it, as long as a recorded drive takes. They are robots that have the task themselves, or edges on wheels
beside robots that stand.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from zsched.core.values.model import ScoreForm
from zsched_lab.decisions import entries, radio
from zsched_lab.decisions.drives import UNSMOOTHED, compare
from zsched_lab.decisions.replay import Entry
from zsched_lab.decisions.report import mean_and_spread
from zsched_lab.decisions.rules import PickRule
from zsched_lab.decisions.world import DT_S, World

MACHINES: Final = 3
DRIVE_S: Final = 262.0
PRICES_S: Final = (0.1, 0.2, 0.3, 0.4, 0.6)
FIRST: Final = {"train": 2000, "test": 1000}
"""The first seed: settings are chosen on *train* and checked on *test*."""
MOST_DRIVES: Final = 900


class Row(NamedTuple):
    """What one rule did in all halls."""

    rule: str
    under_db: float
    """Mean signal under the strongest of every moment."""
    error_db: float
    """1.96 standard errors of it over halls."""
    moves: float
    """A drive."""
    wasted_ratio: float
    """Of all moves."""


def cast(world: World) -> tuple[Entry, ...]:
    """By service with several prices of a move, the paper's rule by the network, and plain argmax."""
    return (
        *(
            Entry(name=f"price {price_s:g} s", make=entries.core(world, price_s=price_s, form=ScoreForm.SERVICE))
            for price_s in PRICES_S
        ),
        Entry(name="dyna_net", look=UNSMOOTHED, make=lambda view: PickRule(view, cost=entries.PAPER_COST)),
        Entry(name="argmax", look=UNSMOOTHED, make=PickRule),
    )


def drives_of(seed: int) -> tuple[radio.Drive, ...]:
    """What the machines of one hall read of their access point."""
    rng = np.random.default_rng(seed)
    steps = round(DRIVE_S / DT_S)
    mean = radio.hall_signals(steps, DT_S, MACHINES, 1, rng)[:, :, 0]
    read = mean + radio.fading_db(mean.shape, rng)
    none = np.full(steps, np.nan)
    return tuple(
        radio.Drive(name=f"hall{seed}-{index}", dt_s=DT_S, rssi_dbm=read[:, index], delay_ms=none)
        for index in range(MACHINES)
    )


def rows(seeds: Sequence[int], *, are_robots: bool) -> Iterator[Row]:
    """Every rule's figures over these halls, at least two."""
    played: dict[str, list[tuple[float, int, int]]] = {}
    for seed in seeds:
        oracle, *others = compare(drives_of(seed), are_robots=are_robots, cast=cast)[0]
        for one in others:
            played.setdefault(one.rule, []).append((oracle.mean_dbm - one.mean_dbm, one.moves, one.wasted))
    for rule, found in played.items():
        under, moves, wasted = zip(*found, strict=True)
        under_db, error_db = mean_and_spread(under)
        yield Row(
            rule=rule,
            under_db=under_db,
            error_db=error_db,
            moves=statistics.fmean(moves),
            wasted_ratio=sum(wasted) / max(sum(moves), 1),
        )


def main(arguments: Sequence[str]) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions halls", description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", choices=tuple(FIRST), default="test", help="which halls (default test)")
    parser.add_argument("--drives", type=int, default=30, metavar="N", help="how many halls, 2 to 900 (default 30)")
    given = parser.parse_args(arguments)
    if not 2 <= given.drives <= MOST_DRIVES:
        parser.error(f"--drives: give 2 to {MOST_DRIVES}")
    seeds = range(FIRST[given.seeds], FIRST[given.seeds] + given.drives)
    for title, are_robots in (("three robots", True), ("three edges on wheels", False)):
        print(f"### {title}, {given.drives} drives of {DRIVE_S:g} s\n", flush=True)
        print("| rule | under the oracle, dB | moves a drive | wasted % |\n| --- | --- | --- | --- |")
        for row in rows(seeds, are_robots=are_robots):
            told = f"{row.under_db:.2f} ± {row.error_db:.2f} | {row.moves:.1f} | {100 * row.wasted_ratio:.0f}"
            print(f"| {row.rule} | {told} |", flush=True)
        print()
