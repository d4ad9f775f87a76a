"""Plays numbered hops on a bad way by seed: ``python -m zsched_lab.sim.hop [--play PLAY] --seed S --runs N``.

Samples, markers, acknowledgements and what is put again, while links break and take with them what is on them, and
receivers freeze, or die and begin another life. Knows: the plays. Does not know: what happens in one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Final

from zsched_lab.sim.hop.answers import AnswerHop
from zsched_lab.sim.hop.inputs import InputHop
from zsched_lab.sim.hop.way import HopError

PLAYS: Final[dict[str, Callable[[int], None]]] = {
    "reliable": lambda seed: InputHop(seed, is_whole=True).run(),
    "latest": lambda seed: InputHop(seed, is_whole=False).run(),
    "reliable-answers": lambda seed: AnswerHop(seed, is_whole=True).run(),
    "latest-answers": lambda seed: AnswerHop(seed, is_whole=False).run(),
}


def play(name: str, seed: int) -> str:
    """Play one seed; what does not hold, or nothing."""
    try:
        PLAYS[name](seed)
    except HopError as error:
        return str(error)
    return ""


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.hop", description=__doc__.partition("\n")[0])
    parser.add_argument("--play", choices=(*PLAYS, "all"), default="all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=1000, help="of each play")
    options = parser.parse_args(arguments)
    total = 0
    for name in PLAYS if options.play == "all" else (options.play,):
        found = 0
        for seed in range(options.seed, options.seed + options.runs):
            fault = play(name, seed)
            if fault:
                found += 1
                print(f"{name} seed {seed}: {fault}")
        total += found
        print(f"{name}: {options.runs} runs, {found} violations")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
