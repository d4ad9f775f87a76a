"""``python -m zsched.lab.decisions``: play thousands of hours to every rule, and say which decided best.

Knows: the command line. Does not know: what is played (`study`), how it is shown (`report`).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from zsched.lab.decisions import study

PARTS = ("compare", "sweep", "options")


def main() -> None:
    """Play what is missing, then write the report."""
    parser = argparse.ArgumentParser(prog="python -m zsched.lab.decisions", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="of every kind of history (default 2)")
    parser.add_argument("--seeds", choices=("train", "test"), default="test", help="which seeds (default test)")
    parser.add_argument("--candidates", default="3,10,50,200", help="sizes of fleets (default 3,10,50,200)")
    parser.add_argument("--parts", default="compare,options", help=f"some of {','.join(PARTS)}")
    parser.add_argument("--only", default="", help="play these rules only (names, separated by ';')")
    parser.add_argument("--cases", default="", help="play these kinds of histories only")
    parser.add_argument("--out", type=Path, default=Path("decisions"), help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="go on from the results in the folder")
    given = parser.parse_args()
    parts = given.parts.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"unknown part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    candidates = tuple(int(count) for count in given.candidates.split(","))
    given.out.mkdir(parents=True, exist_ok=True)
    results = given.out / f"results-{given.seeds}.ndjson"
    if results.exists() and not given.resume:
        sys.exit(f"{results} is there already: give --resume to go on from it, or another --out")
    made = {"compare": study.compared(candidates), "sweep": study.swept(), "options": study.options()}
    seeds = study.TRAIN if given.seeds == "train" else study.TEST
    began_at = time.monotonic()
    for part in parts:
        cases = tuple(case for case in made[part] if not given.cases or case.name in given.cases.split(","))
        only = frozenset(filter(None, given.only.split(";")))
        for line in study.play(cases, given.hours, seeds, results, only):
            print(f"{time.monotonic() - began_at:7.0f} s  {line}", flush=True)


if __name__ == "__main__":
    main()
