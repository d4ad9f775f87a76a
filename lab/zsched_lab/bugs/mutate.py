"""Mutates the core and counts what the tests find: ``python -m zsched_lab.bugs.mutate --seed S --mutants N``.

Knows: the choice by seed, processes, what was tried before, the table. Does not know: what a mutant is
(`zsched_lab.bugs.mutants`), which tests may find it and how it is planted (`zsched_lab.bugs.mutant_tests`).

Each mutant has a process of its own, which first runs the tests of its module, then all others that reach its function,
then a few schedules of the simulator, and ends with the first that fails. The last line is the score; the exit code is
1 when it is below ``--least``. Must be run in the source tree: the tests are there.
"""

from __future__ import annotations

import argparse
import functools
import gc
import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import pytest

from zsched_lab.bugs.mutant_tests import (
    KILLED,
    OPTIONS,
    SCHEDULES,
    SURVIVED,
    TESTS,
    TIMEOUT,
    UNJUDGED,
    Calls,
    Effort,
    Functions,
    Loop,
    Planter,
    Reach,
    hunt,
    measure,
    merged,
    silence,
    source_hash,
)
from zsched_lab.bugs.mutants import Mutant, files_of, module_of, mutants_of, mutated

ROOT = Path(__file__).parents[3]
CORE = ROOT / "zsched" / "core"
LEAST_PERCENT = 97.0
LONGEST_S = 1800.0
"""Of the wall clock, for one mutant on a machine that is busy with other work."""
GRACE_S = 60.0
"""A child whose own process is ended at that time needs so much to say so."""
POLL_S = 0.01
PROGRESS_EVERY_S = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What became of one mutant."""

    key: str
    path: str
    text: str
    verdict: str
    found_by: str
    seconds: float


@dataclass(slots=True)
class Results:
    """The verdicts so far, kept in a file with ``--resume``."""

    file: Path | None
    verdicts: dict[str, Verdict] = field(default_factory=dict)

    @classmethod
    def load(cls, file: Path | None) -> Results:
        """What an earlier run has found out."""
        results = cls(file)
        if file is not None and file.exists():
            for body in json.loads(file.read_text(encoding="utf-8")):
                results.verdicts[body["key"]] = Verdict(**body)
        return results

    def forget_survivors(self) -> None:
        """Try them once more: there are other tests now."""
        self.verdicts = {key: one for key, one in self.verdicts.items() if one.verdict != SURVIVED}

    def take(self, verdict: Verdict) -> None:
        """One more; written down whole or not at all."""
        self.verdicts[verdict.key] = verdict
        if self.file is not None:
            new = self.file.with_suffix(".new")
            new.write_text(json.dumps([asdict(one) for one in self.verdicts.values()], indent=1), encoding="utf-8")
            new.replace(self.file)


# --- the choice ------------------------------------------------------------------------------------------------------


@functools.cache
def _mutants(module: str, source: str) -> tuple[Mutant, ...]:
    return tuple(mutants_of(module, source))


def choose(seed: int, count: int, only: Sequence[str] = ()) -> list[Mutant]:
    """Mutants of the core, all equally likely; the same ones for the same seed and source.

    After a change of the source most of them are the same still: what is drawn hangs on each mutant alone.

    Args:
        seed: any number.
        count: how many (fewer when there are no more).
        only: modules ("core/vote/voting.py") or lines ("core/vote/voting.py:103"); none: the whole core.
    """
    wanted = {one.partition(":")[0] for one in only}
    sources = {
        path: path.read_text(encoding="utf-8")
        for path in files_of(CORE)
        if not only or path.relative_to(CORE.parent).as_posix() in wanted
    }
    found = [
        mutant
        for path, source in sources.items()
        for mutant in _mutants(module_of(path, CORE), source)
        if not only or mutant.path in only or f"{mutant.path}:{mutant.line}" in only
    ]
    found.sort(key=lambda mutant: hashlib.sha256(f"{seed} {mutant.key}".encode()).digest())
    chosen: list[Mutant] = []
    for mutant in found:
        if len(chosen) == count:
            break
        path = mutant.file(CORE.parent)
        if mutated(mutant, sources[path], str(path)) is not None:
            chosen.append(mutant)
    return chosen


# --- processes -------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Fork:
    """A child that writes one line and ends."""

    pid: int
    pipe: int
    began_at: float

    def result(self, status: int) -> tuple[str, str]:
        """(verdict, what has found it): too much CPU time finds a mutant, too much of the wall clock judges nothing."""
        with os.fdopen(self.pipe, encoding="utf-8") as pipe:
            text = pipe.read()
        if os.WIFSIGNALED(status):
            number = os.WTERMSIG(status)
            if number in {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}:
                return UNJUDGED, ""
            return (TIMEOUT, "") if number == signal.SIGPROF else (KILLED, f"signal {number}")
        if not text:  # an exception in the tests or in a schedule has said so: this one is of the tool
            return UNJUDGED, ""
        return (KILLED, text.strip()) if text.strip() != "-" else (SURVIVED, "")


def _fork(session: pytest.Session, mutant: Mutant, reach: Reach, functions: Functions, effort: Effort) -> Fork:
    """Try a mutant in a child."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        return Fork(pid, reading, time.monotonic())
    found = "broken"
    try:
        silence()
        if reach.is_cold(mutant):
            found = _cold(mutant, effort)
        else:
            path = mutant.file(CORE.parent)
            code = mutated(mutant, path.read_text(encoding="utf-8"), str(path))
            assert code is not None
            functions.plant(code)
            found = hunt(session, mutant, reach, effort)
        os.write(writing, (found or "-").encode())
    except MemoryError:
        os.write(writing, b"out of memory")
    finally:
        os._exit(0)


def _cold(mutant: Mutant, effort: Effort) -> str:
    """What has found a mutant that must be there from the first import on: in a new process."""
    command = [sys.executable, "-m", "zsched_lab.bugs.mutate", "--cold", json.dumps(asdict(mutant))]
    command += ["--longest", str(effort.longest_s), "--schedules", str(effort.schedules), "--tests", *effort.tests]
    with tempfile.TemporaryFile("w+") as said:
        run = subprocess.Popen(command, cwd=ROOT, stdout=said)
        try:
            code = run.wait(LONGEST_S)
        except subprocess.TimeoutExpired:
            run.kill()
            run.wait()
            os.kill(os.getpid(), signal.SIGKILL)
        if code < 0:
            with suppress(OSError):
                signal.signal(-code, signal.SIG_DFL)
            os.kill(os.getpid(), -code)
        said.seek(0)
        lines = [line for line in said.read().splitlines() if line.startswith("found: ")]
    if not lines:
        return "it cannot be imported"
    return lines[-1].removeprefix("found: ").strip()


def cold(mutant: Mutant, effort: Effort) -> int:
    """Try a mutant in this process, which has not imported the core."""
    sys.meta_path.insert(0, Planter(mutant))
    reach = Reach(**json.loads(cache_file(effort.tests).read_text(encoding="utf-8")))

    def work(session: pytest.Session) -> None:
        if {item.nodeid for item in session.items} < set(reach.seconds):
            print("\nfound: some tests cannot be collected", flush=True)
            return
        print(f"\nfound: {hunt(session, mutant, reach, effort)}", flush=True)  # behind pytest's dots

    code = pytest.main([*OPTIONS, *effort.tests], plugins=[Loop(work)])
    return 0 if code in {pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED} else 1


def cache_file(tests: Sequence[str]) -> Path:
    """Where is kept what the tests of this source reach."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "zsched" / f"reach-{source_hash(ROOT, tests)}.json"


def reach_of(session: pytest.Session, file: Path, at_import: list[str], jobs: int) -> Reach:
    """What each test reaches: from the cache, or measured now in ``jobs`` processes."""
    if not file.exists():
        print(f"{len(session.items)} tests are run once to see what they reach", flush=True)
        modules: dict[str, list[pytest.Item]] = {}
        for item in session.items:
            modules.setdefault(item.nodeid.partition("::")[0], []).append(item)
        shares: list[list[pytest.Item]] = [[] for _ in range(jobs)]
        for items in sorted(modules.values(), key=len, reverse=True):
            min(shares, key=len).extend(items)
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder) / str(number) for number in range(jobs)]
            pids = [_fork_measuring(session, share, path) for share, path in zip(shares, files, strict=True)]
            for pid in pids:
                os.waitpid(pid, 0)
            whole = merged(Reach(**json.loads(path.read_text(encoding="utf-8"))) for path in files)
        whole.at_import = at_import
        whole.save(file)
    reach = Reach(**json.loads(file.read_text(encoding="utf-8")))
    if not any(reach.functions.values()):
        raise SystemExit(f"no test reaches the core, by {file}: the measurement is broken")
    for test in reach.broken:
        print(f"fails without any mutant, left out: {test}", flush=True)
    return reach


def _fork_measuring(session: pytest.Session, items: list[pytest.Item], path: Path) -> int:
    pid = os.fork()
    if pid:
        return pid
    try:
        silence()
        measure(session, items, CORE).save(path)
    finally:
        os._exit(0)


def try_all(
    session: pytest.Session, mutants: Sequence[Mutant], reach: Reach, effort: Effort, jobs: int, results: Results
) -> None:
    """Try every mutant that has no verdict yet, ``jobs`` at a time."""
    functions = Functions(CORE)
    gc.freeze()
    for mutant in mutants:
        if mutant.key in results.verdicts:
            reach.learn(mutant, results.verdicts[mutant.key].found_by)
    waiting = [mutant for mutant in mutants if mutant.key not in results.verdicts]
    running: dict[int, tuple[Mutant, Fork]] = {}
    told_at = time.monotonic()
    while waiting or running:
        while waiting and len(running) < jobs:
            mutant = waiting.pop(0)
            fork = _fork(session, mutant, reach, functions, effort)
            running[fork.pid] = (mutant, fork)
        for pid, status in _ended(running):
            mutant, fork = running.pop(pid)
            verdict, found_by = fork.result(status)
            seconds = round(time.monotonic() - fork.began_at, 2)
            one = Verdict(
                key=mutant.key, path=mutant.path, text=str(mutant), verdict=verdict, found_by=found_by, seconds=seconds
            )
            if verdict == UNJUDGED:
                print(f"not judged within {LONGEST_S:g} s, ended by somebody, or broken down: {mutant}", flush=True)
                continue
            results.take(one)
            reach.learn(mutant, found_by)
            if verdict == SURVIVED:
                print(f"survived ({seconds:g} s): {mutant}", flush=True)
        if time.monotonic() - told_at > PROGRESS_EVERY_S:
            told_at = time.monotonic()
            counts = Counter(results.verdicts[one.key].verdict for one in mutants if one.key in results.verdicts)
            print(f"{counts.total()} of {len(mutants)}: {dict(counts)}", flush=True)
        time.sleep(POLL_S)


def _ended(running: dict[int, tuple[Mutant, Fork]]) -> Iterator[tuple[int, int]]:
    """Children that have ended; one that takes too long is ended."""
    for pid, (_, fork) in list(running.items()):
        if time.monotonic() - fork.began_at > LONGEST_S + GRACE_S:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            yield pid, status


# --- the table -------------------------------------------------------------------------------------------------------


def table(verdicts: Sequence[Verdict]) -> str:
    """Killed, survived and stuck by module, and every survivor, as Markdown."""
    rows = ["| module | mutants | killed | timeout | survived |", "| --- | ---: | ---: | ---: | ---: |"]
    for path in sorted({one.path for one in verdicts}):
        counts = Counter(one.verdict for one in verdicts if one.path == path)
        rows.append(f"| `{path}` | {counts.total()} | {counts[KILLED]} | {counts[TIMEOUT]} | {counts[SURVIVED]} |")
    rows += [f"survived: {one.text}" for one in verdicts if one.verdict == SURVIVED]
    return "\n".join(rows)


def score(verdicts: Sequence[Verdict]) -> float:
    """How many percent were found; one that never ends is found."""
    return 100.0 * sum(one.verdict != SURVIVED for one in verdicts) / max(len(verdicts), 1)


def main(arguments: list[str] | None = None) -> int:
    """Try mutants, print the table, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.bugs.mutate", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mutants", type=int, default=100, help="how many")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time")
    parser.add_argument("--module", action="append", default=[], help="core/vote/voting.py, or core/vote/voting.py:103")
    parser.add_argument("--resume", type=Path, help="keep the verdicts there, and try only what has none")
    parser.add_argument("--again", action="store_true", help="with --resume: try once more what has survived")
    parser.add_argument("--least", type=float, default=LEAST_PERCENT, help="percent that must be found")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="files or folders; the whole core's by default")
    parser.add_argument("--cold", help=argparse.SUPPRESS)
    parser.add_argument("--longest", type=float, default=math.inf, help="leave out tests of more CPU seconds")
    parser.add_argument("--schedules", type=int, default=SCHEDULES, help="of the simulator, for what no test finds")
    given = parser.parse_args(arguments)
    effort = Effort(tests=tuple(given.tests), longest_s=given.longest, schedules=given.schedules)
    if given.cold:
        return cold(Mutant(**json.loads(given.cold)), effort)
    file = cache_file(effort.tests)
    mutants = choose(given.seed, given.mutants, given.module)
    results, calls = Results.load(given.resume), Calls(CORE)
    if given.again:
        results.forget_survivors()

    def work(session: pytest.Session) -> None:
        sys.settrace(None)
        reach = reach_of(session, file, calls.taken(), given.jobs)
        try_all(session, mutants, reach, effort, given.jobs, results)

    sys.settrace(None if file.exists() else calls)
    code = pytest.main([*OPTIONS, *effort.tests], plugins=[Loop(work)])
    sys.settrace(None)
    verdicts = [results.verdicts[mutant.key] for mutant in mutants if mutant.key in results.verdicts]
    if code != pytest.ExitCode.OK:
        print("the tests cannot be collected", file=sys.stderr)
        return 2
    print("\n" + table(verdicts))
    found = score(verdicts)
    caught = sum(one.verdict != SURVIVED for one in verdicts)
    print(f"seed {given.seed}: {caught} of {len(verdicts)} mutants found, {found:.1f} %")
    if len(verdicts) < len(mutants):
        print(f"{len(mutants) - len(verdicts)} were not judged: start the command again with --resume", file=sys.stderr)
        return 2
    return 0 if found >= given.least else 1


if __name__ == "__main__":
    sys.exit(main())
