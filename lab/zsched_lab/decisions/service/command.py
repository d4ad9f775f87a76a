"""``python -m zsched_lab.decisions service``: play histories to every rule, and judge each by what the task got.

Knows: the command line. Does not know: what is played (`study`), how it is shown (`tables`, `picture`).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from zsched_lab.decisions import study as before
from zsched_lab.decisions.service import cast, picture, study, tables
from zsched_lab.decisions.service.history import SIZES, Activity


def _seeds(text: str) -> range:
    """``train``, ``test``, or from-to; never some of both."""
    named = {"train": study.TRAIN[:20], "test": study.TEST[:20]}
    if text in named:
        return named[text]
    first, _, last = text.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    if not seeds or not any(seeds[0] in kept and seeds[-1] in kept for kept in (study.TRAIN, study.TEST)):
        raise argparse.ArgumentTypeError(
            f"{text}: seeds for choosing are {study.TRAIN[0]} to {study.TRAIN[-1]}, "
            f"seeds for checking {study.TEST[0]} to {study.TEST[-1]}"
        )
    return seeds


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(one) for one in text.split(","))


def _described(text: str) -> str:
    try:
        cast.described(text)
    except (ValueError, TypeError) as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The command line; ends the program when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions service", description=__doc__)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("test"), help="train, test, or from-to (default test)")
    parser.add_argument("--hours", type=float, default=1.0, help="of every history; 0: only show (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="histories at a time (default 1)")
    parser.add_argument("--loads", type=_numbers, default=study.LOADS_S, help="lengths of load, s; 0: no loads")
    parser.add_argument("--tasks", type=_numbers, default=(1.0, 3.0), help="numbers of tasks (default 1,3)")
    when = "when the tasks' jobs come; each has results of its own (default steady)"
    parser.add_argument("--activity", type=Activity, choices=list(Activity), default=Activity.STEADY, help=when)
    same = "machines are equal and nobody loads them; has results of its own"
    parser.add_argument("--equal", action="store_true", help=same)
    spiky = "readings have the spikes that were measured on the demo's edges; has results of its own"
    parser.add_argument("--spikes", action="store_true", help=spiky)
    parser.add_argument("--prices", type=_numbers, default=study.PRICES_S, help="of a move, s (default 0.05,0.3,1)")
    also = "one more rule: zsched's under other settings (of Tuning, of TaskSpec, smoothing_s)"
    parser.add_argument("--rule", type=_described, action="append", default=[], metavar="NAME:KEY=VALUE,...", help=also)
    parser.add_argument("--only", default="", help="play these rules only (names, separated by ';')")
    parser.add_argument("--out", type=Path, default=Path("decisions"), help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="go on from the results in the folder")
    given = parser.parse_args(argv)
    if wrong := [count for count in given.tasks if count not in SIZES]:
        parser.error(f"no histories of {wrong[0]:g} tasks; there are {', '.join(map(str, SIZES))}")
    if given.equal:
        given.loads, given.prices = (0.0,), given.prices[:1]
    return given


def play(given: argparse.Namespace, results: Path) -> None:
    """Play what is missing."""
    if results.exists() and not given.resume:
        sys.exit(f"{results} is there already: give --resume to go on from it, or another --out")
    known = before.read(results)
    only = set(filter(None, given.only.split(";")))
    yardsticks = () if given.equal else study.YARDSTICKS
    rules = (*yardsticks, *(one.name for one in cast.players()), *given.rule)
    rules = tuple(rule for rule in rules if not only or rule.partition(":")[0] in only)
    made_as = {str(row["rule"]): str(row["as"]) for row in known}
    for rule in rules:
        name = rule.partition(":")[0]
        if made_as.setdefault(name, rule) != rule:
            sys.exit(f"{name} is {made_as[name]} already: give the rule another name, or another --out")
    if any(row["asked_hours"] != given.hours for row in known):
        sys.exit(f"{results} holds histories of another length: give the same --hours, or another --out")
    tasks = [int(count) for count in given.tasks]
    made = study.cases(
        given.seeds,
        given.hours,
        given.loads,
        tasks,
        given.prices,
        rules,
        known,
        given.activity,
        is_equal=given.equal,
        has_spikes=given.spikes,
    )
    began_at = time.monotonic()
    for index, (case, rows) in enumerate(study.play_all(made, given.jobs), 1):
        with results.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
        print(
            f"{time.monotonic() - began_at:7.0f} s  {index} of {len(made)}: {case.tasks} tasks, "
            f"loads of {case.load_s:g} s, seed {case.seed}",
            file=sys.stderr,
            flush=True,
        )


def main(argv: Sequence[str]) -> None:
    """Play what is missing, then show everything that the folder holds of these seeds' kind."""
    given = parse(argv)
    given.out.mkdir(parents=True, exist_ok=True)
    kind = "train" if given.seeds[0] in study.TRAIN else "test"
    name = f"service-{kind}" if given.activity is Activity.STEADY else f"service-{kind}-{given.activity}"
    name += "-equal" * given.equal + "-spikes" * given.spikes
    results = given.out / f"{name}.ndjson"
    if given.hours > 0:
        play(given, results)
    rows = before.read(results)
    if not rows:
        sys.exit(f"{results} holds no results")
    shown = tables.equal(rows) if given.equal else tables.report(rows)
    text = f"# Judged by service, {kind}ing seeds, {given.activity} tasks{', spikes' * given.spikes}\n\n{shown}"
    print(text)
    (given.out / f"{name}.md").write_text(text, encoding="utf-8")
    if not given.equal:
        picture.draw(rows, given.out / f"{name}.png")
    print(f"written: {name}.* in {given.out}")
