"""Runs the tests that may find a mutant, in a fork of a process that has them all loaded.

Knows: which tests reach which function of the core (measured once, kept), how a mutant is planted, in which order tests
are run and when that stops. Does not know: what a mutant is (`zsched_lab.bugs.mutants`), which ones are tried.

Everything happens in pytest's run loop: all tests are collected once, and each mutant costs one fork. In it the mutated
functions get the mutated code; where the mutated code runs at the import, a process of its own imports it.
"""

from __future__ import annotations

import ast
import builtins
import functools
import gc
import hashlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import math
import os
import resource
import signal
import time
import types
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest

from zsched_lab.bugs.mutants import Mutant, files_of, module_of, mutated

TESTS = (
    "tests/unit/core",
    "tests/paper",
    "tests/sim",
    "tests/unit/config/test_load.py",
    "tests/unit/config/test_docs.py",
    "tests/unit/config/test_ros2.py",
    "tests/unit/config/test_rulecheck.py",
    "tests/unit/config/test_timing.py",
    "tests/unit/test_docs.py",
    "tests/unit/commands/test_report.py",
    "tests/unit/core/values/test_codec.py",
)
SCHEDULES = 24
"""What no test has found is looked for by this many schedules."""
SLOWER = 20.0
LEAST_CPU_S = 10.0
"""A test that takes this many times its usual CPU time and this much more does not end."""
MORE_MEMORY = 2 << 30
KILLED, SURVIVED, TIMEOUT = "killed", "survived", "timeout"
UNJUDGED = "not judged"
"""By no fault of the mutant: the machine was too busy, or somebody has ended its process. Never counted as found."""
PROBE = "_zsched_probe"
_CACHE = type(functools.cache(len))
OPTIONS = ("-qq", "-p", "no:cacheprovider", "-p", "no:xdist", "--timeout=0", "-s", "--no-header", "--tb=no")


@dataclass(slots=True)
class Reach:
    """Which functions of the core each test calls, and how much CPU time it takes."""

    functions: dict[str, list[str]] = field(default_factory=dict)
    """{test: "module:function" of every function that it calls}."""
    seconds: dict[str, float] = field(default_factory=dict)
    at_import: list[str] = field(default_factory=list)
    """Functions that are called when tests are collected: what they have made is there before a mutant is."""
    broken: list[str] = field(default_factory=list)
    """Tests that fail without any mutant."""
    finders: dict[str, list[str]] = field(default_factory=dict)
    """{"module:function": tests that have found a mutant of it}: they are run first."""

    def learn(self, mutant: Mutant, found_by: str) -> None:
        """A test has found a mutant: it may find others of the same function."""
        if found_by in self.functions:
            known = self.finders.setdefault(_place(mutant), [])
            if found_by in known:
                known.remove(found_by)
            known.insert(0, found_by)

    def is_cold(self, mutant: Mutant) -> bool:
        """Whether the mutant must be there before anything is imported."""
        return not mutant.function.startswith("=") or _place(mutant) in self.at_import

    def chosen(self, mutant: Mutant) -> list[str]:
        """The tests that may find it: what found one of its function, those of its module, then the quick ones."""
        place, module = _place(mutant), f"{mutant.module}:"
        name = mutant.module.rpartition(".")[2]
        if mutant.function.startswith("="):
            reaching = [test for test, called in self.functions.items() if place in called]
        else:
            reaching = list(self.functions)

        known = self.finders.get(place, [])

        def rank(test: str) -> tuple[bool, bool, bool, float]:
            is_directed = Path(test.partition("::")[0]).name in {f"test_{name}.py", f"test_{name}_rules.py"}
            is_near = any(one.startswith(module) for one in self.functions[test])
            return test not in known, not is_directed, not is_near, self.seconds[test]

        return sorted((test for test in reaching if test not in self.broken), key=rank)

    def save(self, path: Path) -> None:
        """Keep it for the next run on the same source."""
        path.parent.mkdir(parents=True, exist_ok=True)
        body = {name: getattr(self, name) for name in self.__dataclass_fields__}
        path.write_text(json.dumps(body), encoding="utf-8")


def _place(mutant: Mutant) -> str:
    return f"{mutant.module}:{mutant.function.removeprefix('=')}"


def source_hash(root: Path, tests: Sequence[str]) -> str:
    """Of the core and of all tests."""
    files = sorted(
        {*root.glob("zsched/core/**/*.py"), *root.glob("lab/zsched_lab/sim/**/*.py"), *root.glob("tests/**/*.py")}
    )
    digest = hashlib.sha256(" ".join(tests).encode())
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


# --- what tests reach ------------------------------------------------------------------------------------------------


class Calls:
    """Writes down which functions of the core are called, slowly: while nothing of it is imported yet."""

    def __init__(self, core: Path) -> None:
        self._core = core
        self._seen: dict[int, str] = {}
        self.called: set[int] = set()

    def __call__(self, frame: types.FrameType, _event: str, _argument: object) -> None:
        """As `sys.settrace` wants it: no line is traced."""
        number = id(frame.f_code)
        if number in self.called:
            return
        self.called.add(number)
        if number not in self._seen:
            code, name = frame.f_code, ""
            if code.co_filename.startswith(str(self._core)):
                module = module_of(Path(code.co_filename), self._core)
                name = f"{module}:{code.co_qualname.partition('.<locals>')[0]}"
            self._seen[number] = name

    def taken(self) -> list[str]:
        """The functions since the last time."""
        found = sorted({self._seen[number] for number in self.called} - {""})
        self.called.clear()
        return found


class Probes:
    """Writes down which functions of the core a test calls; quick, for the first call of each removes its probe."""

    def __init__(self, core: Path, functions: Functions) -> None:
        self._armed: list[tuple[types.FunctionType, types.CodeType]] = []
        self._plain: dict[str, list[tuple[types.FunctionType, types.CodeType]]] = {}
        self.called: set[str] = set()
        vars(builtins)[PROBE] = self._on_call
        for path in files_of(core):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            module = module_of(path, core)
            _probe(tree.body, f"{module}:")
            for code in _codes(compile(ast.fix_missing_locations(tree), str(path), "exec")):
                if PROBE not in code.co_names:
                    continue
                for function in functions.live(code):
                    self._armed.append((function, code))
                    self._plain.setdefault(f"{module}:{code.co_qualname}", []).append((function, function.__code__))

    def _on_call(self, name: str) -> None:
        self.called.add(name)
        for function, plain in self._plain.get(name, ()):
            function.__code__ = plain

    def arm(self) -> None:
        """From now on every function's first call is noted."""
        self.called.clear()
        for function, probed in self._armed:
            function.__code__ = probed


def _probe(body: list[ast.stmt], prefix: str) -> None:
    """Put a probe first into every outermost function."""
    for one in body:
        if isinstance(one, ast.ClassDef):
            _probe(one.body, f"{prefix}{one.name}.")
        elif isinstance(one, ast.FunctionDef):
            call = ast.Call(
                func=ast.Name(id=PROBE, ctx=ast.Load()), args=[ast.Constant(value=f"{prefix}{one.name}")], keywords=[]
            )
            one.body.insert(0, ast.copy_location(ast.Expr(value=call), one.body[0]))


class FixtureCalls:
    """What a fixture of a whole module calls, all its tests reach."""

    def __init__(self, probes: Probes) -> None:
        self._probes = probes
        self.shared: dict[str, set[str]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Generator[None, object, object]:
        """Around the making of a fixture."""
        if fixturedef.scope == "function":
            return (yield)
        before = set(self._probes.called)
        self._probes.arm()
        try:
            return (yield)
        finally:
            shared = self.shared.setdefault(str(request.node.nodeid).partition("::")[0], set())
            shared |= self._probes.called
            self._probes.called |= before


def measure(session: pytest.Session, items: Sequence[pytest.Item], core: Path) -> Reach:
    """Run tests, see what they call."""
    probes, reach = Probes(core, Functions(core)), Reach()
    fixtures = FixtureCalls(probes)
    session.config.pluginmanager.register(fixtures)
    for item, following in _with_next(items):
        failed, began_s = session.testsfailed, time.process_time()
        probes.arm()
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        reach.seconds[item.nodeid] = time.process_time() - began_s
        reach.functions[item.nodeid] = sorted(probes.called)
        if session.testsfailed > failed:
            reach.broken.append(item.nodeid)
    for test, called in reach.functions.items():
        reach.functions[test] = sorted({*called, *fixtures.shared.get(test.partition("::")[0], ())})
    return reach


def merged(parts: Iterable[Reach]) -> Reach:
    """What several processes have measured."""
    whole = Reach()
    for part in parts:
        whole.functions |= part.functions
        whole.seconds |= part.seconds
        whole.broken += part.broken
    return whole


def _with_next(items: Sequence[pytest.Item]) -> Iterator[tuple[pytest.Item, pytest.Item | None]]:
    return zip_longest(items, items[1:])


# --- planting --------------------------------------------------------------------------------------------------------


class Functions:
    """The live functions of the core, and the caches that may hold what they have answered."""

    def __init__(self, core: Path) -> None:
        self._by_place: dict[tuple[str, str, int], list[types.FunctionType]] = {}
        self._caches: list[Any] = []
        gc.unfreeze()  # who froze what lives hides it from the next line
        for one in gc.get_objects():
            if isinstance(one, types.FunctionType) and one.__code__.co_filename.startswith(str(core)):
                code = one.__code__
                key = (code.co_filename, code.co_qualname, code.co_firstlineno)
                self._by_place.setdefault(key, []).append(one)
            elif isinstance(one, _CACHE) and str(one.__module__).startswith("zsched."):
                self._caches.append(one)

    def live(self, code: types.CodeType) -> Sequence[types.FunctionType]:
        """The functions whose place in the source a code has."""
        return self._by_place.get((code.co_filename, code.co_qualname, code.co_firstlineno), ())

    def plant(self, code: types.CodeType) -> None:
        """From now on this process runs a module's mutated code, as far as it is in functions."""
        for one in self._caches:
            one.cache_clear()
        for new in _codes(code):
            for function in self.live(new):
                function.__code__ = new


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            yield one
            yield from _codes(one)


class Planter(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module with a mutant in it."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant, self._path = mutant, ""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Only of the mutant's module."""
        found = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if fullname != self._mutant.module or found is None or found.origin is None:
            return None
        self._path = found.origin
        return importlib.util.spec_from_loader(fullname, self, origin=found.origin)

    def exec_module(self, module: types.ModuleType) -> None:
        """Run the mutated code."""
        code = mutated(self._mutant, Path(self._path).read_text(encoding="utf-8"), self._path)
        assert code is not None
        exec(code, module.__dict__)  # noqa: S102 - our own source with one small fault


# --- the hunt --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """What is tried to find a mutant."""

    tests: tuple[str, ...] = TESTS
    longest_s: float = math.inf
    """Tests that take more CPU time are left out."""
    schedules: int = SCHEDULES


def hunt(session: pytest.Session, mutant: Mutant, reach: Reach, effort: Effort) -> str:
    """Run the tests that may find the planted mutant, then schedules; what has found it, empty when nothing has."""
    limit = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MORE_MEMORY, limit[1]))
    items = {item.nodeid: item for item in session.items}
    tests = [test for test in reach.chosen(mutant) if test in items and reach.seconds[test] <= effort.longest_s]
    chosen = [items[test] for test in tests]
    for item, following in _with_next(chosen):
        _limit_cpu(reach.seconds[item.nodeid])
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.testsfailed:
            return item.nodeid
    return _by_schedules(effort.schedules)


def _by_schedules(count: int) -> str:
    from zsched_lab.sim.faults import play  # noqa: PLC0415 - only now may the core be imported
    from zsched_lab.sim.swarm import plan  # noqa: PLC0415 - as above

    for seed in range(count):
        _limit_cpu(2.0)
        try:
            violation = play(plan(seed)).violation
        except Exception as error:  # noqa: BLE001 - whatever a fault of the core raises
            violation = repr(error)
        if violation:
            return f"seed {seed}: {violation[:100]}"
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    return ""


def _limit_cpu(usual_s: float) -> None:
    """By the signal's own action this process ends when the next test needs much more than it should."""
    signal.setitimer(signal.ITIMER_PROF, LEAST_CPU_S + SLOWER * usual_s)


def silence() -> None:
    """A fork says nothing: it would write into the table."""
    null = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(null, number)


class Loop:
    """As a plugin of pytest: all tests are collected, and then ``work`` is done instead of running them."""

    def __init__(self, work: Callable[[pytest.Session], None]) -> None:
        self._work = work

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Do the work."""
        self._work(session)
        return True
