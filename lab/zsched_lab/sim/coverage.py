"""Which branches of `core/` the simulator reaches, which the tests, which neither.

``python -m zsched_lab.sim.coverage``.

Knows: what is run and how it is watched (coverage.py, of the dev extra), the table. Does not know: what a branch means.

A branch is a jump from one line to another that is not the only one from there. The last line is ``N branches are
reached by neither``; the exit code is 1 when there is any. Must be run in the source tree: the tests are there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

TESTS = ("tests/unit/core", "tests/paper", "tests/sim")
RUNS = 600
CHUNK = 100
"""Schedules in one process."""
LONGEST_S = 3600.0
ROOT = "zsched/core/"
Branch = tuple[int, int]
"""(from line, to line); a line below 0 is the way out of the function that begins there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class File:
    """One file's branches."""

    name: str
    all: frozenset[Branch]
    by_simulator: frozenset[Branch]
    by_tests: frozenset[Branch]

    @property
    def by_neither(self) -> tuple[Branch, ...]:
        """What nobody has gone."""
        return tuple(sorted(self.all - self.by_simulator - self.by_tests))


def watch(command: Sequence[str], data: Path) -> None:
    """Run a Python module with its branches in `core/` watched.

    Raises:
        RuntimeError: the command failed.
    """
    line = [sys.executable, "-m", "coverage", "run", "--branch", "--source=zsched.core", f"--data-file={data}", "-m"]
    run = subprocess.run([*line, *command], capture_output=True, text=True, timeout=LONGEST_S, check=False)
    if run.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{(run.stdout + run.stderr)[-2000:]}")


def reached(data: Path) -> dict[str, tuple[frozenset[Branch], frozenset[Branch]]]:
    """{file: (branches that were gone, branches that were not)} of one data file."""
    report = data.with_suffix(".json")
    line = [sys.executable, "-m", "coverage", "json", "-q", "--ignore-errors", f"--data-file={data}", "-o", str(report)]
    subprocess.run(line, check=True, timeout=LONGEST_S, capture_output=True)
    files = json.loads(report.read_text(encoding="utf-8"))["files"]
    return {
        name: (_branches(found["executed_branches"]), _branches(found["missing_branches"]))
        for name, found in files.items()
        if name.startswith(ROOT)
    }


def _branches(pairs: list[list[int]]) -> frozenset[Branch]:
    return frozenset((source, target) for source, target in pairs)


def merge(folder: Path, name: str) -> Path:
    """One data file of all that begin with ``name``."""
    whole = folder / f"{name}.all"
    parts = sorted(str(part) for part in folder.glob(f"{name}.[0-9]*"))
    line = [sys.executable, "-m", "coverage", "combine", "-q", f"--data-file={whole}", *parts]
    subprocess.run(line, check=True, timeout=LONGEST_S, capture_output=True)
    return whole


def measure(folder: Path, *, seed: int, runs: int, tests: Sequence[str], jobs: int) -> list[File]:
    """Play schedules and run tests, both watched; what each has reached, by file."""
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(watch, ["pytest", "-q", "-x", "--timeout=0", *tests], folder / "tests.0")]
        for number, first in enumerate(range(seed, seed + runs, CHUNK)):
            count = min(CHUNK, seed + runs - first)
            command = ["zsched_lab.sim.simulate", f"--seed={first}", f"--runs={count}"]
            waiting.append(pool.submit(watch, command, folder / f"simulator.{number}"))
        for one in waiting:
            one.result()
    simulator, tested = reached(merge(folder, "simulator")), reached(merge(folder, "tests"))
    nothing: tuple[frozenset[Branch], frozenset[Branch]] = (frozenset(), frozenset())
    found = []
    for name in sorted(simulator.keys() | tested.keys()):
        (played, unplayed), (ran, unrun) = simulator.get(name, nothing), tested.get(name, nothing)
        every = played | unplayed | ran | unrun
        found.append(File(name=name.removeprefix(ROOT), all=every, by_simulator=played, by_tests=ran))
    return found


def table(files: Sequence[File]) -> str:
    """One row for each file, the sum below, then the branches that nobody has gone."""
    rows = [f"{'file':24} {'branches':>8} {'simulator':>9} {'tests':>6} {'neither':>7}"]
    sums = [0, 0, 0, 0]
    for file in files:
        counts = [len(file.all), len(file.by_simulator), len(file.by_tests), len(file.by_neither)]
        sums = [total + count for total, count in zip(sums, counts, strict=True)]
        rows.append(_row(file.name, counts))
    rows.append(_row("all", sums))
    rows += [f"  {file.name}: {', '.join(map(_told, file.by_neither))}" for file in files if file.by_neither]
    rows.append(f"{sums[3]} branches are reached by neither")
    return "\n".join(rows)


def _row(name: str, counts: Sequence[int]) -> str:
    return f"{name:24} {counts[0]:8} {counts[1]:9} {counts[2]:6} {counts[3]:7}"


def _told(branch: Branch) -> str:
    source, target = branch
    return f"{source} -> {target if target > 0 else 'the end'}"


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.coverage", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--runs", type=int, default=RUNS, help="schedules")
    parser.add_argument("--tests", nargs="*", default=TESTS, help="what pytest runs")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="zsched-coverage-") as folder:
        files = measure(Path(folder), seed=given.seed, runs=given.runs, tests=given.tests, jobs=given.jobs)
    print(table(files))
    return 1 if any(file.by_neither for file in files) else 0


if __name__ == "__main__":
    sys.exit(main())
