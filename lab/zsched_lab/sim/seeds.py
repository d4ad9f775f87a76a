"""A small simulator's command: plays seeds in a row, and counts. Knows: its play. Does not know: what is played."""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(slots=True)
class Played:
    """What came of one schedule."""

    violation: str = ""
    counts: Counter[str] = field(default_factory=Counter)


def play_seeds(
    module: str, says: str | None, play: Callable[[int], Played], arguments: list[str] | None, runs: int
) -> int:
    """Play ``runs`` seeds, if no other number is asked for; 1: some schedule violates what must hold."""
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=(says or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=runs)
    options = parser.parse_args(arguments)
    total: Counter[str] = Counter()
    found, began = 0, time.process_time()
    for seed in range(options.seed, options.seed + options.runs):
        played = play(seed)
        total += played.counts
        if played.violation:
            found += 1
            print(f"seed {seed}: {played.violation}", flush=True)
    print(", ".join(f"{name} {count}" for name, count in sorted(total.items())))
    print(f"{options.runs} schedules in {time.process_time() - began:.0f} s, {found} violations")
    return 1 if found else 0
