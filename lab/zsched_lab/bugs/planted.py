"""Plants one bug at a time into the code and lets the suite find it: ``python -m zsched_lab.bugs.planted``.

Knows: how a bug is planted (an import hook in a process of its own; no file is touched), the budget of each, the list.
Does not know: what the bugs are (`zsched_lab.bugs.core_bugs`, `elector_bugs`, `stream_bugs`), what finds them.

For every bug the simulator plays schedules until one is violated; when none is within the budget, the bug's directed
tests are run. The last line is ``F of N planted bugs found``; the exit code is 1 when one survives.
Must be run in the source tree: the directed tests are there.
"""

from __future__ import annotations

import argparse
import csv
import importlib.abc
import importlib.machinery
import importlib.util
import io
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import types
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from zsched_lab.bugs.adoption_bugs import ADOPTION_BUGS
from zsched_lab.bugs.core_bugs import CORE_BUGS, Bug
from zsched_lab.bugs.elector_bugs import ELECTOR_BUGS
from zsched_lab.bugs.flag_bugs import FLAG_BUGS
from zsched_lab.bugs.member_bugs import MEMBER_BUGS
from zsched_lab.bugs.pilot_bugs import PILOT_BUGS
from zsched_lab.bugs.recovery_bugs import RECOVERY_BUGS
from zsched_lab.bugs.stream_bugs import STREAM_BUGS

BUGS: tuple[Bug, ...] = (
    *CORE_BUGS,
    *ELECTOR_BUGS,
    *PILOT_BUGS,
    *MEMBER_BUGS,
    *RECOVERY_BUGS,
    *STREAM_BUGS,
    *ADOPTION_BUGS,
    *FLAG_BUGS,
)

BUDGET_S = 30.0
"""What the schedules may take for one bug; the directed tests come on top."""
STUCK_S = 120.0
"""So much CPU time beyond its budget only a schedule, or a test, that does not end takes."""
LONGEST_S = 1800.0
"""Of the wall clock, on a machine that is busy with other work; a bug that is not judged by then counts as survived."""
CELL = 100
"""Characters of a violation in the list."""
FOUND = 10
"""Exit code of a process that has found the bug planted in it (0: it has not; anything else: it broke down)."""
MAX_SEEDS = 100_000


class PlantError(Exception):
    """The text that a bug replaces is not in its module exactly once: write the bug again."""


def changed(bug: Bug, source: str) -> str:
    """The source of the bug's module with the bug in it.

    Raises:
        PlantError: a text is not there exactly once.
    """
    for old, new in bug.changes:
        if source.count(old) != 1:
            raise PlantError(f"{bug.name}: {bug.module} has {source.count(old)} times {old!r}")
        source = source.replace(old, new)
    return source


class _Planter(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Loads one module with a bug in it."""

    def __init__(self, bug: Bug) -> None:
        self._bug = bug
        self._path = ""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self._bug.module:
            return None
        found = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if found is None or found.origin is None:
            return None
        self._path = found.origin
        return importlib.util.spec_from_loader(fullname, self, origin=found.origin)

    def get_code(self, _name: str) -> types.CodeType:
        """The module's code with the bug; ``python -m`` asks for it, too."""
        source = changed(self._bug, Path(self._path).read_text(encoding="utf-8"))
        return compile(source, self._path, "exec")

    def exec_module(self, module: types.ModuleType) -> None:
        exec(self.get_code(module.__name__), module.__dict__)  # noqa: S102 - our own source, a few words changed


def plant(bug: Bug) -> None:
    """From now on this process has the bug (its modules must not have been imported yet)."""
    for one in bug.parts:
        if one.module in sys.modules:
            raise PlantError(f"{one.name}: {one.module} is imported already")
        sys.meta_path.insert(0, _Planter(one))


# --- in the planted process ------------------------------------------------------------------------------------------


def _player(bug: Bug) -> Callable[[int], str]:
    """What plays a schedule and says what it violates; only now, with the bug planted, may the core be imported."""
    if bug.has_changing_electors:
        from zsched_lab.sim.electorate import play as play_electors  # noqa: PLC0415 - see above

        return lambda seed: play_electors(seed).violation
    if bug.has_changing_fleets:
        from zsched_lab.sim.fleets import play as play_fleets  # noqa: PLC0415 - see above

        return lambda seed: play_fleets(seed)[0]
    from zsched_lab.sim.faults import play as play_nodes  # noqa: PLC0415 - see above
    from zsched_lab.sim.swarm import plan  # noqa: PLC0415 - see above

    return lambda seed: play_nodes(plan(seed)).violation


def hunt(bug: Bug, budget_s: float) -> int:
    """Play schedules until one is violated: `FOUND`, or 0 when none was in time."""
    plant(bug)
    play = _player(bug)
    ends_at = time.process_time() + budget_s
    first = () if bug.seed is None else (bug.seed,)
    for seed in (*first, *range(MAX_SEEDS)):
        violation = play(seed)
        if violation:
            print(f"seed {seed}: {violation[:200]}")
            return FOUND
        if time.process_time() > ends_at:
            break
    return 0


def run_tests(bug: Bug, tests: Sequence[str]) -> int:
    """Run directed tests: `FOUND` when one fails, else 0. Processes that a test starts have the bug, too."""
    plant(bug)
    with tempfile.TemporaryDirectory(prefix="zsched-planted-") as folder:
        for_children(bug, Path(folder))
        return _run_tests(tests)


def for_children(bug: Bug, folder: Path) -> None:
    """From now on every Python process that this one starts has the bug, by way of the ``site`` module."""
    lines = f"import sys; sys.path.insert(0, {str(Path.cwd())!r})\nfrom zsched_lab.bugs.planted import BUGS, plant\n"
    lines += f"plant(next(bug for bug in BUGS if bug.name == {bug.name!r}))\n"
    (folder / "sitecustomize.py").write_text(lines, encoding="utf-8")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))


def _run_tests(tests: Sequence[str]) -> int:
    import pytest  # noqa: PLC0415 - a lab without tests needs none

    # A busy machine must not look like a bug: CPU time is limited, not the wall clock.
    code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", "--timeout=0", *tests])
    return FOUND if code == pytest.ExitCode.TESTS_FAILED else 0


# --- the table -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What became of one bug; ``found_by`` is empty when it survived."""

    bug: Bug
    found_by: str
    seconds: float


def judge(bug: Bug, budget_s: float = BUDGET_S) -> Verdict:
    """Hunt one bug: schedules first, then its directed tests."""
    began_at = time.monotonic()
    found = ""
    for how in ("hunt", "tests"):
        if found or (how == "tests" and not bug.tests):
            break
        if how == "hunt" and not bug.has_schedules:
            continue
        found = _found(bug, how, budget_s)
    return Verdict(bug=bug, found_by=found, seconds=time.monotonic() - began_at)


def _found(bug: Bug, how: str, budget_s: float) -> str:
    command = [
        sys.executable,
        "-m",
        "zsched_lab.bugs.planted",
        "--only",
        bug.name,
        f"--{how}",
        "--budget",
        str(budget_s),
    ]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    except subprocess.TimeoutExpired:
        return ""
    if run.returncode == -signal.SIGXCPU:
        return f"the {how} does not end: {STUCK_S:g} s of CPU beyond its budget"
    if "PlantError" in run.stderr:
        raise PlantError(run.stderr.strip().splitlines()[-1])
    if run.returncode == 0:
        return ""
    if run.returncode != FOUND:
        raise PlantError(f"{bug.name}: the process broke down: {(run.stderr or run.stdout).strip()[-500:]}")
    return next(line for line in run.stdout.splitlines() if line.startswith(("seed ", "FAILED ")))


def table(verdicts: Sequence[Verdict]) -> str:
    """The verdicts as docs/develop/planted-bugs.csv keeps them."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("bug", "in", "found by", "s"))
    rows.writerows((one.bug.name, places(one.bug), _short(one.found_by), f"{one.seconds:.1f}") for one in verdicts)
    return text.getvalue()


def places(bug: Bug) -> str:
    """The modules that a bug is in, as the list names them."""
    return " ".join(f"{part.module.removeprefix('zsched.').replace('.', '/')}.py" for part in bug.parts)


def _short(found_by: str) -> str:
    """What found a bug, in a cell of the list: the schedule's seed, or the test's name."""
    if found_by.startswith("FAILED "):
        return found_by.partition("::")[2].partition(" - ")[0].partition("[")[0]
    seed = re.match(r"seed \d+", found_by)
    text = seed.group(0) if seed else found_by or "survived"
    return text if len(text) <= CELL else f"{text[:CELL]} …"


def main(arguments: list[str] | None = None) -> int:
    """Hunt all bugs (or ``--only`` one), print the list, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.bugs.planted", description=__doc__)
    parser.add_argument("--only", help="the name of one bug")
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="seconds of schedules for one bug")
    parser.add_argument("--jobs", type=int, default=1, help="bugs at a time")
    parser.add_argument("--hunt", action="store_true", help="play schedules in this process")
    parser.add_argument("--tests", action="store_true", help="run the directed tests in this process")
    given = parser.parse_args(arguments)
    bugs = [bug for bug in BUGS if given.only in (None, bug.name)]
    if not bugs:
        parser.error(f"no bug is called {given.only!r}")
    if given.hunt or given.tests:
        limit_s = int(given.budget + STUCK_S)
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 5))
    if given.hunt:
        return hunt(bugs[0], given.budget)
    if given.tests:
        return run_tests(bugs[0], bugs[0].tests)
    verdicts = []
    with ThreadPoolExecutor(given.jobs) as pool:
        for one in pool.map(partial(judge, budget_s=given.budget), bugs):
            verdicts.append(one)
            print(f"{one.bug.name}: {one.found_by or 'SURVIVED'} ({one.seconds:.1f} s)", flush=True)
    print("\n" + table(verdicts))
    found = sum(bool(one.found_by) for one in verdicts)
    print(f"{found} of {len(verdicts)} planted bugs found")
    return 0 if found == len(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
