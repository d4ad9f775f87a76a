"""The house's floors: who may import whom, what the pure core may use, what the daemon and the CLI never load.

Read from the sources with ast, so that imports inside functions and under TYPE_CHECKING count too. A new folder needs a
line in `FLOORS` (and a place in docs/design/architecture.md).
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
PACKAGE: Final = ROOT / "zsched"
LAB: Final = ROOT / "lab" / "zsched_lab"

FLOORS: Final[tuple[tuple[str, int, str], ...]] = (
    # pattern of the module's name below "zsched.", floor, room (\1: the group)
    (r"(__init__|_version)", 0, "version"),
    (r"core(\..+)?", 1, "core"),
    (r"host(\..+)?", 2, "host"),
    (r"config(\..+)?", 3, "config"),
    (r"link(\..+)?", 4, "link"),
    (r"(pki|relay|worker)(?:\..+)?", 5, "\\1"),
    (r"(drivers|runtime)(?:\..+)?", 6, "\\1"),
    (r"tasks(?:\.(\w+))?(?:\..+)?", 7, "tasks: \\1"),
    (r"tools\.examples(?:\.(\w+))?(?:\..+)?", 7, "tasks: example \\1"),  # programs that `zsched new` copies
    (r"daemon", 7, "daemon"),
    (r"commands(\..+)?", 8, "commands"),
    (r"tools(\..+)?", 9, "tools"),
    (r"(cli|__main__)", 10, "cli"),
    (r"lab(\..+)?", 11, "lab"),  # zsched_lab, a distribution of its own
)
"""A module imports lower floors and its own room, nothing else."""

CORE_MAY: Final = frozenset(
    {
        *(
            "__future__",
            "abc",
            "bisect",
            "collections",
            "collections.abc",
            "copy",
            "dataclasses",
            "enum",
            "functools",
            "hashlib",
        ),
        *(
            "abc",
            "heapq",
            "ipaddress",
            "itertools",
            "math",
            "operator",
            "random",
            "re",
            "statistics",
            "types",
            "typing",
        ),
    }
)
"""Pure parts of the standard library; ``random`` only for the type `Random` (generators come in seeded)."""
IMPURE_CALLS: Final = frozenset({"open", "print", "input", "exec", "eval", "compile", "__import__", "Random"})
MAKES_FUNCTIONS: Final = ("core.values.codec", "exec")
"""It makes its readers and writers from text of its own."""

HEAVY: Final = frozenset(
    {
        *("numpy", "cv2", "matplotlib", "onnxruntime", "rich", "pydantic", "asyncio"),
        *("psutil", "pyroute2", "rosbags", "scipy", "skimage"),  # decision 0042
    }
)
OUTSIDE: Final[dict[str, str]] = {
    # library: who alone may import it, besides lab and tasks
    "zenoh": r"(link|relay|worker)(\..+)?|drivers\.ros2_lifecycle",
    "msgpack": r"core\.values\.codec",  # bytes in, values out
    "msgspec": r"core\.values\.struct",  # makes classes, reads and writes nothing (decision 0042)
    "ruamel": r"config\.(reader|editing)",
    "typer": r"cli|(commands|tools)\..+",
    "mcap": r"tools\.watch\.record",  # an extra
    "opentelemetry": r"tools\.watch\.trace",  # likewise
    "cryptography": r"pki(\..+)?|link\.signatures",  # 16 MiB in memory: of the authority's verbs only
}


@dataclass(frozen=True, kw_only=True)
class Module:
    """One source file: its name below ``zsched.`` and what it imports."""

    name: str
    read: Callable[[], str]

    @cached_property
    def tree(self) -> ast.Module:
        """Parsed when it is asked for: each process that runs any test imports this file."""
        return ast.parse(self.read())

    @property
    def place(self) -> tuple[int, str]:
        """(floor, room)."""
        for pattern, floor, room in FLOORS:
            match = re.fullmatch(pattern, self.name)
            if match is not None:
                return floor, self.name if room == "*" else match.expand(room)
        raise AssertionError(f"zsched/{self.name.replace('.', '/')}.py has no floor: add it to FLOORS in {__file__}")

    def imports(self, root: ast.AST | None = None) -> Iterator[str]:
        """Full names of what is imported anywhere below ``root``, relative imports resolved, as written."""
        for node in ast.walk(root or self.tree):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.name}: relative import"
                assert node.module is not None
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def read_modules() -> dict[str, Module]:
    """Of both distributions; the lab's are called ``lab.``..."""
    modules = {}
    for package, above in ((PACKAGE, ()), (LAB, ("lab",))):
        for path in sorted(package.rglob("*.py")):
            parts = (*above, *path.relative_to(package).with_suffix("").parts)
            name = ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)
            modules[name] = Module(name=name, read=partial(path.read_text, encoding="utf-8"))
    return modules


MODULES: Final = read_modules()


def targets(module: Module) -> set[str]:
    """The modules of this house that ``module`` imports (a name imported from a module counts as that module)."""
    found = set()
    for full in module.imports():
        parts = ["zsched", "lab", *full.split(".")[1:]] if full.startswith("zsched_lab") else full.split(".")
        if parts[0] != "zsched":
            continue
        names = [".".join(parts[1:end]) for end in range(len(parts), 1, -1)]
        found.add(next((name for name in names if name in MODULES), "__init__"))
    return found - {module.name}


def faults_of_floor(module: Module) -> list[str]:
    floor, room = module.place
    places = {name: MODULES[name].place for name in targets(module)}
    return [
        f"{module.name} (floor {floor}) imports {name} (floor {other})"
        for name, (other, other_room) in sorted(places.items())
        if other >= floor and other_room != room
    ]


@pytest.mark.parametrize("name", sorted(MODULES))
def test_module_imports_only_lower_floors_and_its_own_room(name: str) -> None:
    assert faults_of_floor(MODULES[name]) == []


def test_planted_import_of_a_higher_floor_is_found() -> None:
    for name, line in (
        ("core.model", "from zsched.link.seal import sealed"),
        ("link.seal", "def late():\n    import zsched.runtime.shell"),
        ("host.state_file", "from zsched.link.bus import control_bus"),
        ("daemon", "from zsched.tasks.map_merge import grid"),
        ("commands.look.status", "from zsched.tools.watch import top"),
        ("tasks.other", "from zsched.tasks.map_merge import grid"),
        ("host.systemd", "from zsched import daemon"),
    ):
        assert faults_of_floor(Module(name=name, read=partial(str, line))), (name, line)


def find_circle(imports: dict[str, set[str]]) -> list[str]:
    """Some circle of imports, empty when there is none."""
    done: set[str] = set()

    def visit(name: str, path: list[str]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name in done:
            return []
        for target in sorted(imports[name]):
            circle = visit(target, [*path, name])
            if circle:
                return circle
        done.add(name)
        return []

    return next((circle for name in sorted(imports) if (circle := visit(name, []))), [])


@cache
def graph() -> dict[str, set[str]]:
    return {name: targets(module) for name, module in MODULES.items()}


def test_there_are_no_circles() -> None:
    assert find_circle(graph()) == []


def test_planted_circle_is_found() -> None:
    assert find_circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]


FOLDERS: Final = ("", *sorted({name[: match.start()] for name in MODULES for match in re.finditer(r"\.", name)}))
"""Every folder with code, by its dotted name; ``""`` is ``zsched/`` itself."""


def rooms_in(folder: str, modules: dict[str, set[str]]) -> dict[str, set[str]]:
    """{room: rooms that it imports} of one folder: its folders and its modules.

    No circle of modules is needed for a circle of rooms: two modules of one folder are enough.
    """
    prefix = f"{folder}." if folder else ""

    def inside(names: Iterable[str]) -> set[str]:
        return {name.removeprefix(prefix).partition(".")[0] for name in names if name.startswith(prefix)}

    rooms: dict[str, set[str]] = {room: set() for room in inside(modules)}
    for name, found in modules.items():
        for room in inside([name]):
            rooms[room] |= inside(found & set(modules)) - {room}
    return rooms


@pytest.mark.parametrize("folder", FOLDERS)
def test_there_are_no_circles_of_rooms(folder: str) -> None:
    assert find_circle(rooms_in(folder, graph())) == []


@pytest.mark.parametrize(
    ("importer", "imported"),
    [
        ("core.electorate.settling", "core.vote.lease"),
        ("core.values.model", "core.hop.serial"),
        ("relay.streams.crowd", "relay.task"),
        ("lab.fleet.view", "lab.robots.watch"),
    ],
)
def test_planted_circle_of_rooms_is_found(importer: str, imported: str) -> None:
    """Each of these imports makes a circle of folders; the first one had none of modules."""
    planted = {**graph(), importer: graph()[importer] | {imported}}
    assert any(find_circle(rooms_in(folder, planted)) for folder in FOLDERS)


STAGES: Final = ("profile", "gateway", "scheduler", "vote", "executor", "route")
"""The folders of the core that are stages, in the order in which data passes them."""
LENT: Final = frozenset({("core.executor.handover", "core.route.route")})
"""What a stage takes of a later one: functions that make a plan of a task's streams, without any state."""


def later_stages(name: str, found: set[str]) -> list[str]:
    """The modules of later stages that a stage's module imports; those of ``LENT`` are left out."""

    def place(module: str) -> int:
        parts = module.split(".")
        return STAGES.index(parts[1]) if parts[0] == "core" and len(parts) > 1 and parts[1] in STAGES else -1

    own = place(name)
    return sorted(one for one in found if -1 < own < place(one) and (name, one) not in LENT)


@pytest.mark.parametrize("name", sorted(name for name in MODULES if name.startswith("core.")))
def test_no_stage_imports_a_later_one(name: str) -> None:
    assert later_stages(name, graph()[name]) == []


def test_planted_import_of_a_later_stage_is_found() -> None:
    assert later_stages("core.gateway.gateway", {"core.vote.tally", "core.profile.means"}) == ["core.vote.tally"]
    assert later_stages("core.executor.handover", {"core.route.route", "core.route.gaps"}) == ["core.route.gaps"]
    assert later_stages("core.node.work", {"core.vote.tally"}) == []


def test_what_a_stage_takes_of_a_later_one_is_still_taken() -> None:
    assert [pair for pair in LENT if pair[1] not in graph()[pair[0]]] == []


CORE: Final = sorted(name for name in MODULES if name.partition(".")[0] == "core")


def faults_of_purity(module: Module) -> list[str]:
    """What a module of the core uses that is not pure."""
    faults = []
    for full in module.imports():
        library = full.partition(".")[0]
        if full.startswith("zsched.core") or (library in OUTSIDE and re.fullmatch(OUTSIDE[library], module.name)):
            continue
        home, _, item = full.rpartition(".")
        if full not in CORE_MAY and home not in CORE_MAY:
            faults.append(f"imports {full}")
        elif "random" in (full, home) and item != "Random":
            faults.append(f"imports {full}: only the type random.Random")
    for node in ast.walk(module.tree):
        called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
        if isinstance(node, ast.Call) and called in IMPURE_CALLS and (module.name, called) != MAKES_FUNCTIONS:
            faults.append(f"line {node.lineno} calls {called}")
        if isinstance(node, ast.AsyncFunctionDef | ast.Await | ast.Global):
            faults.append(f"line {node.lineno}: {type(node).__name__}")
    return faults


@pytest.mark.parametrize("name", CORE)
def test_core_is_pure(name: str) -> None:
    assert faults_of_purity(MODULES[name]) == []


@pytest.mark.parametrize(
    "line",
    [
        "import time",
        "from datetime import datetime",
        "import random",
        "from random import random",
        "from random import Random\nrng = Random()",
        "import zenoh",
        "import os.path",
        "import logging",
        "def late():\n    from zsched.host import clock",
        "open('x')",
        "async def f(): ...",
    ],
)
def test_planted_impurity_is_found(line: str) -> None:
    assert faults_of_purity(Module(name="core.model", read=partial(str, line)))


@pytest.mark.parametrize("name", sorted(MODULES))
def test_outside_libraries_have_one_window_each(name: str) -> None:
    module = MODULES[name]
    if module.place[1].partition(":")[0] in {"lab", "tasks"}:
        return
    libraries = {full.partition(".")[0] for full in module.imports()}
    assert not libraries & HEAVY
    strays = {lib for lib in libraries & set(OUTSIDE) if not re.fullmatch(OUTSIDE[lib], name)}
    assert strays == set()


PROGRAMS: Final[dict[str, str]] = {
    "daemon": "import zsched.daemon",
    "relay": "import zsched.relay.__main__, zsched.relay.process",
    "worker": "import zsched.worker",
    "cli": "import zsched.cli",
    "cli check": "sys.argv[1:] = ['check', 'configs/fleet.yaml']; import zsched.cli; run(zsched.cli.main)",
    "cli help": "sys.argv[1:] = ['--help']; import zsched.cli; run(zsched.cli.main)",
    "cli version": "sys.argv[1:] = ['version']; import zsched.cli; run(zsched.cli.main)",
}
LOADER: Final = """
import contextlib, io, json, sys
def run(main):
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main()
{program}
print(json.dumps(sorted({{name.partition(".")[0] for name in sys.modules}}
    | {{name for name in sys.modules if name in ("zsched_lab", "zsched.tasks")}})))
"""


@pytest.mark.parametrize("program", PROGRAMS)
def test_program_never_loads_what_is_heavy(program: str) -> None:
    """Idle memory is a feature on a robot: what is really in ``sys.modules`` after the import (and the command)."""
    needed = {f"{name}" for name in re.findall(r"zsched\.(\w+(?:\.\w+)?)", PROGRAMS[program])} - {"cli.main"}
    missing = [name for name in needed if name not in MODULES and not (PACKAGE / name).is_dir()]
    if any(name.removesuffix(".__main__") not in MODULES for name in missing):
        pytest.skip(f"not written yet: {missing}")
    done = subprocess.run(
        [sys.executable, "-c", LOADER.format(program=PROGRAMS[program])],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    assert "zsched" in loaded
    brought = {"zsched_lab"} if program == "cli help" else set()  # its verbs are listed, where it is installed
    assert loaded & (HEAVY | {"zsched_lab", "zsched.tasks", "cryptography"}) <= brought


def test_unit_tests_open_no_session() -> None:
    """Such tests belong to `tests/parts/`: what others do on the machine can delay them."""
    real = re.compile(r"zenoh\.open\(|from (?:support\.(?:sessions|relay_rig|ros_host)|zsched_lab\.fleet\.relays) ")
    tests = sorted((ROOT / "tests" / "unit").rglob("test_*.py"))
    assert not [
        str(path.relative_to(ROOT)) for path in tests if path.name != "test_floors.py" and real.search(path.read_text())
    ]


def folders_without_code(tests: Path) -> list[str]:
    """Folders with tests that mirror no folder of the code.

    ``lab`` is the lab, ``package`` what builds packages, everything else the package.
    """
    found = []
    for folder in sorted({path.parent.relative_to(tests) for path in tests.rglob("test_*.py")}):
        others = {"lab": LAB, "package": ROOT / "package"}
        first = folder.parts[0] if folder.parts else ""
        code = others[first].joinpath(*folder.parts[1:]) if first in others else PACKAGE / folder
        if not code.is_dir():
            found.append(str(folder))
    return found


@pytest.mark.parametrize("kind", ["unit", "parts"])
def test_folders_of_tests_are_those_of_the_code(kind: str) -> None:
    assert folders_without_code(ROOT / "tests" / kind) == []


def test_planted_folders_without_code_are_found(tmp_path: Path) -> None:
    for folder in ("core/vote", "core/absent", "lab/sim", "lab/core"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "test_one.py").touch()
    assert folders_without_code(tmp_path) == ["core/absent", "lab/core"]


def test_a_verb_that_only_asks_loads_neither_zenoh_nor_logging() -> None:
    """`status` must answer within 200 ms, most of which is the interpreter's and typer's."""
    program = "sys.argv[1:] = ['status', '--runtime-dir', 'nobody']; import zsched.cli; run(zsched.cli.main)"
    done = subprocess.run(
        [sys.executable, "-c", LOADER.format(program=program)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert "no daemon in nobody" in done.stderr
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    assert loaded & {"zenoh", "ruamel", "logging", "msgpack", "pydantic", "rich"} == set()
