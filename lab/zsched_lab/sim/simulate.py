"""Plays simulated fault schedules by seed: ``python -m zsched_lab.sim.simulate --seed S --runs N``.

Knows: seeds, processes, what was played before, how to make a failing schedule smaller. Does not know: what a schedule
is or what must hold.

The last line is ``N schedules, V violations``; the exit code is 1 when there is any, and when too many fleets took too
long to come to rest (`zsched_lab.sim.rest`). A failing seed prints the one command that plays it again exactly.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import multiprocessing
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from zsched.config.timing import PROFILES
from zsched.core.values.struct import replace
from zsched_lab.sim.faults import Result, play
from zsched_lab.sim.rest import FEWEST, spread, too_few, too_slow
from zsched_lab.sim.swarm import KINDS, MAX_NODES, MIN_NODES, PENDING, SECONDS, Plan, plan

CHUNK = 10
STORIES_SHOWN = 40
PROGRESS_EVERY = 500
GARBAGE = (100_000, 10, 10)
"""This many new values before the collector looks at them."""
STOPPED = 143
"""Exit code after SIGTERM; what was played is in the file that ``--resume`` names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What exactly is played: a seed and everything that changes its schedule."""

    seed: int
    nodes: int | None = None
    seconds: float = SECONDS
    keep: frozenset[int] | None = None
    calm_at: float | None = None
    pending: frozenset[str] = frozenset()
    """Faults of `PENDING` that there may be all the same."""

    @property
    def plan(self) -> Plan:
        """Its schedule."""
        kinds = KINDS - PENDING | self.pending
        return plan(self.seed, nodes=self.nodes, seconds=self.seconds, kinds=kinds)

    @property
    def profile(self) -> str:
        """The name of its timing profile."""
        return self.plan.fleet.timing.name

    @property
    def command(self) -> str:
        """How to play it again."""
        words = ["python -m zsched_lab.sim.simulate", f"--seed {self.seed}", "--runs 1"]
        if self.nodes is not None:
            words.append(f"--nodes {self.nodes}")
        if self.seconds != SECONDS:
            words.append(f"--seconds {self.seconds:g}")
        if self.pending:
            words.append(f"--with {','.join(sorted(self.pending))}")
        if self.keep is not None:
            words.append(f"--keep {','.join(map(str, sorted(self.keep))) or 'none'}")
        if self.calm_at is not None:
            words.append(f"--calm-at {self.calm_at!r}")
        return " ".join(words)

    def play(self) -> Result:
        """Play it."""
        return play(self.plan, self.keep, self.calm_at)


@dataclass(slots=True, kw_only=True)
class Totals:
    """What was played so far; kept in a file with ``--resume``."""

    seed: int
    schedules: int = 0
    events: int = 0
    generations: int = 0
    """Schedules in which too many electors lost their state: the operator started a new generation."""
    settled_s: dict[str, list[float]] = field(default_factory=dict)
    """{timing profile: how long each of its schedules took to come to rest}."""
    violations: dict[str, str] = field(default_factory=dict)
    """{seed: what was violated}."""
    faults: Counter[str] = field(default_factory=Counter)

    def take(self, job: Job, result: Result) -> None:
        """Count one schedule."""
        self.seed = job.seed + 1
        self.schedules += 1
        self.events += result.events
        self.faults += result.faults
        self.generations += "new generation" in result.faults
        if result.settled_s is not None:
            self.settled_s.setdefault(job.profile, []).append(round(result.settled_s, 3))
        if result.violation:
            self.violations[str(job.seed)] = result.violation

    def save(self, path: Path) -> None:
        """Write it down, whole or not at all."""
        body = {name: getattr(self, name) for name in self.__dataclass_fields__}
        new = path.with_suffix(".new")
        new.write_text(json.dumps(body, indent=1) + "\n", encoding="utf-8")
        new.replace(path)

    @classmethod
    def load(cls, path: Path) -> Totals:
        """What an earlier run has written down."""
        body = json.loads(path.read_text(encoding="utf-8"))
        body["faults"] = Counter(body["faults"])
        return cls(**body)


def collect_seldom() -> None:
    """What a schedule leaves behind is collected now and then: looking for it all the time takes 2 % of the time."""
    if sys.implementation.name == "cpython":  # PyPy's collector has neither
        gc.freeze()
        gc.set_threshold(*GARBAGE)


def _play(job: Job) -> tuple[Job, Result]:
    return job, job.play()


def play_all(jobs: Iterable[Job], processes: int) -> Iterator[tuple[Job, Result]]:
    """Play many schedules, in order, in this many processes."""
    if processes <= 1:
        yield from map(_play, jobs)
        return
    with multiprocessing.Pool(processes, initializer=_end_at_once) as pool:
        yield from pool.imap(_play, jobs, chunksize=CHUNK)
        pool.close()
        pool.join()


def _end_at_once() -> None:
    """A pool ends its processes by SIGTERM: our own handler, inherited, may wait without end for one of its locks."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


# --- shrinking -------------------------------------------------------------------------------------------------------


def shrink(job: Job) -> Job:
    """The smallest job found that is still violated: faults left out, then an earlier end of the faults."""
    keep = frozenset(range(len(job.plan.faults))) if job.keep is None else job.keep
    best = replace(job, keep=keep)
    size = max(len(keep) // 2, 1)
    while True:
        smaller = _without_some(best, size)
        if smaller is not None:
            best = smaller
        elif size == 1:
            break
        else:
            size //= 2
    return _shorter(best)


def _without_some(job: Job, size: int) -> Job | None:
    """The job without ``size`` neighbouring faults, if that is still violated."""
    assert job.keep is not None
    indices = sorted(job.keep)
    for start in range(0, len(indices), size):
        less = job.keep - frozenset(indices[start : start + size])
        smaller = replace(job, keep=less)
        if smaller.play().violation:
            return smaller
    return None


def _shorter(job: Job) -> Job:
    until = job.seconds / 2 if job.calm_at is None else job.calm_at
    step = until / 2
    while step > 0.5:
        shorter = replace(job, calm_at=until - step)
        if shorter.play().violation:
            job, until = shorter, until - step
        step /= 2
    return job


# --- the command line ------------------------------------------------------------------------------------------------


def commit_seed() -> int:
    """A first seed that every commit has to itself: the first 32 bits of its hash (0 outside a repository)."""
    found = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False, timeout=10)
    return int(found.stdout[:8], 16) if found.returncode == 0 else 0


def _arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.simulate", description=__doc__)
    parser.add_argument("--seed", default="0", help="first seed, or 'commit': one made from the commit's hash")
    parser.add_argument("--runs", type=int, default=100, help="how many seeds in a row")
    parser.add_argument(
        "--of-each", type=int, default=0, metavar="N", help="then further seeds, until each timing profile has N"
    )
    parser.add_argument("--nodes", type=int, choices=range(MIN_NODES, MAX_NODES + 1), help="default: by seed")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="virtual seconds of a schedule")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument(
        "--resume", type=Path, help="go on behind the last seed in this file, and keep the totals there"
    )
    parser.add_argument("--shrink", action="store_true", help="make each failing schedule smaller")
    parser.add_argument(
        "--with",
        dest="pending",
        type=lambda text: [*filter(None, text.split(","))],
        default=(),
        metavar="KINDS",
        help=f"faults that are left out until their mend has landed: {', '.join(sorted(PENDING)) or 'none today'}",
    )
    parser.add_argument("--keep", help="only these faults of the schedule (indices with commas, or 'none')")
    parser.add_argument("--calm-at", type=float, help="end the faults after so many seconds")
    parser.add_argument("--story", action="store_true", help="print everything that happened")
    return parser.parse_args(arguments)


def _jobs(given: argparse.Namespace, first: int) -> Iterator[Job]:
    keep = None
    if given.keep is not None:
        keep = frozenset(int(part) for part in given.keep.split(",") if part != "none")
    jobs = (
        Job(
            seed=seed,
            nodes=given.nodes,
            seconds=given.seconds,
            keep=keep,
            calm_at=given.calm_at,
            pending=frozenset(given.pending),
        )
        for seed in itertools.count(first)
    )
    yield from with_enough_of_each(jobs, given.runs, given.of_each)


def with_enough_of_each(jobs: Iterator[Job], runs: int, fewest: int) -> Iterator[Job]:
    """The first ``runs`` jobs, then only those of the timing profiles that have fewer than ``fewest``, until none has.

    A profile that few schedules have would else have too few for its bounds (`zsched_lab.sim.rest`).
    """
    has = dict.fromkeys(PROFILES, 0)
    for job in itertools.islice(jobs, runs):
        has[job.profile] += 1
        yield job
    while min(has.values()) < fewest:
        job = next(jobs)
        if has[job.profile] < fewest:
            has[job.profile] += 1
            yield job


def _explain(job: Job, result: Result, *, is_shrinking: bool) -> None:
    print(f"\nseed {job.seed}: {result.violation}\n  again: {job.command}")
    if is_shrinking:
        job = shrink(job)
        result = job.play()
        print(f"  smallest: {result.violation}\n  again: {job.command}")
        for index, fault in enumerate(job.plan.faults):
            if job.keep is None or index in job.keep:
                print(f"    {index:3d} {fault}")
    print("  " + "\n  ".join(result.stories[-STORIES_SHOWN:]), flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Play, print, return the exit code."""
    given = _arguments(arguments)
    first = commit_seed() if given.seed == "commit" else int(given.seed)
    totals = Totals(seed=first)
    if given.resume is not None and given.resume.exists():
        totals = Totals.load(given.resume)
    print(f"seeds {totals.seed} to {totals.seed + given.runs - 1}", flush=True)
    before, began_at, violations = totals.schedules, time.monotonic(), 0
    for job, result in play_all(_jobs(given, totals.seed), given.jobs):
        totals.take(job, result)
        violations += bool(result.violation)
        if given.story:
            print("\n".join(result.stories))
        if result.violation:
            _explain(job, result, is_shrinking=given.shrink)
        played = totals.schedules - before
        if given.resume is not None and played % CHUNK == 0:
            totals.save(given.resume)
        if played % PROGRESS_EVERY == 0:
            print(f"{played} schedules, {violations} violations so far, next seed {totals.seed}", flush=True)
    if given.resume is not None:
        totals.save(given.resume)
        print(f"in all: {totals.schedules} schedules, {len(totals.violations)} violations ({given.resume})")
    played, took_s = totals.schedules - before, time.monotonic() - began_at
    counts = ", ".join(f"{name} {count}" for name, count in sorted(totals.faults.items()))
    print(f"faults: {counts}")
    for name, times in sorted(totals.settled_s.items()):
        print(f"came to rest, {name}: {spread(times)}")
    for name in too_few(totals.settled_s) if played >= min(FEWEST.values()) else ():
        print(f"came to rest, {name}: too few schedules to be judged")
    pace = 60 * played / max(took_s, 1e-9)
    print(f"{totals.events} events; {totals.generations} new generations; {pace:.0f} schedules a minute")
    slow = too_slow(totals.settled_s)
    for one in slow:
        print(f"too slow: {one}")
    print(f"{played} schedules, {violations} violations")
    return 1 if violations or slow else 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(STOPPED))  # else the pool's processes would stay
    collect_seldom()
    sys.exit(main())
