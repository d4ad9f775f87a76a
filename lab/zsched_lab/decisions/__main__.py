"""``python -m zsched_lab.decisions``: play thousands of hours to every rule, and say which decided best.

With ``service`` behind it, rules are judged by what the task gets (`zsched_lab.decisions.service.command`).

Knows: the command line. Does not know: what is played (`study`), how it is shown (`report`, `figures`).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from zsched_lab.decisions import drives, figures, halls, report, study
from zsched_lab.decisions.service import command

PARTS = ("compare", "sweep", "options")
SHOWN = ("zsched by service", "zsched", "dyna_net", "argmax", "dyna_net_penalty")


def parse() -> argparse.Namespace:
    """The command line; ends the program when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="of every kind of history; 0: only show (default 2)")
    parser.add_argument("--seeds", choices=("train", "test"), default="test", help="which seeds (default test)")
    parser.add_argument("--candidates", default="3,10,50,200", help="sizes of fleets (default 3,10,50,200)")
    parser.add_argument("--parts", default="compare,options", help=f"some of {','.join(PARTS)}")
    parser.add_argument("--only", default="", help="play these rules only (names, separated by ';')")
    parser.add_argument("--cases", default="", help="play these kinds of histories only")
    parser.add_argument("--drives", type=Path, help=f"folder of the recorded drives ({', '.join(drives.FILES)})")
    parser.add_argument("--out", type=Path, default=Path("decisions"), help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="go on from the results in the folder")
    given = parser.parse_args()
    if unknown := set(given.parts.split(",")) - set(PARTS):
        parser.error(f"unknown part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    return given


def play(given: argparse.Namespace) -> None:
    """Play what is missing."""
    results = given.out / f"results-{given.seeds}.ndjson"
    if results.exists() and not given.resume:
        sys.exit(f"{results} is there already: give --resume to go on from it, or another --out")
    candidates = tuple(int(count) for count in given.candidates.split(","))
    made = {
        "compare": study.compared(candidates),
        "sweep": study.swept(),
        "options": study.options(),
    }
    seeds = study.TRAIN if given.seeds == "train" else study.TEST
    only = frozenset(filter(None, given.only.split(";")))
    began_at = time.monotonic()
    for part in given.parts.split(","):
        cases = tuple(case for case in made[part] if not given.cases or case.name in given.cases.split(","))
        for line in study.play(cases, given.hours, seeds, results, only):
            print(f"{time.monotonic() - began_at:7.0f} s  {line}", flush=True)


def show(out: Path, folder: Path | None) -> None:
    """Write `report.md` and the pictures from all results in ``out``, and from the drives if there are any."""
    rows = [row for name in ("train", "test") for row in study.read(out / f"results-{name}.ndjson")]
    tables = {}
    if folder is not None:
        recorded = drives.load(folder)
        for name, title in (("drives", "every candidate follows a recorded drive"), ("robots", "robot to robot")):
            tables[title], moves, world = drives.compare(recorded, are_robots=name == "robots")
            figures.drives(world, moves, SHOWN, f"Recorded drives: {title}", out / f"{name}.png")
        for title, fleet in drives.apart(folder).items():
            tables[title] = drives.compare(fleet, are_robots=True)[0]
    report.write(rows, tables, out / "report.md")
    cases = {str(row["case"]) for row in rows}
    if "long" in cases:
        figures.rules(rows, out / "rules.png")
    if {"equal", "step"} <= cases:
        figures.stickiness(rows, out / "stickiness.png")
    if "robots" in cases:
        figures.options(rows, out / "options.png")
    if any(case.startswith("long-") for case in cases):
        figures.sizes(rows, out / "sizes.png")
    if report.grid_played(rows):
        figures.grid(rows, out / "grid.png")
    print(f"written: {out / 'report.md'} and the pictures beside it")


def main() -> None:
    """Play what is missing, then show everything."""
    if sys.argv[1:2] == ["service"]:
        command.main(sys.argv[2:])
        return
    if sys.argv[1:2] == ["halls"]:
        halls.main(sys.argv[2:])
        return
    given = parse()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.hours > 0:
        play(given)
    show(given.out, given.drives)


if __name__ == "__main__":
    main()
