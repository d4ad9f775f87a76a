"""The size and shape of the code: rooms, arrows and floors of the import graph, lines, functions, words of documents.

``python -m benchmarks.house [CHECKOUT ...]``: a column for each checkout; none given: this one. A room of a package is
a folder or a module directly in it; an arrow is an import from one room into another, counted once; the floors are the
rooms on the longest way along arrows, where rooms that import each other stand on one floor. The lab counts apart.

``python -m benchmarks.house --budget``: each room's lines of code (without blanks, comments and docstrings) and the
other figures that have a budget, beside `benchmarks/budget.toml`. ``--lower`` writes today's figures there where they
are lower; none is ever raised by it. `tests/unit/test_budget.py` fails above the budget.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import statistics
import tokenize
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parents[1]
GENERATED: Final = "_version.py"
BUDGET: Final = HERE / "benchmarks" / "budget.toml"
LARGE_CLASS: Final = 300
_NO_CODE: Final = frozenset(
    {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT, tokenize.ENDMARKER}
)

Graph = Mapping[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Shape:
    """Of one package."""

    rooms: int
    arrows: int
    floors: int
    mutual: int
    """Rooms that import each other, directly or around a circle."""


def sources(folder: Path) -> list[Path]:
    """All Python files below a folder, but for the one that a build writes."""
    return sorted(path for path in folder.rglob("*.py") if path.name != GENERATED)


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of what is imported anywhere in a file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def graph_of(package: Path, prefix: str, without: frozenset[str] = frozenset()) -> Graph:
    """{room: rooms that it imports} of the package in the folder ``package``, whose full name is ``prefix``.

    Args:
        package: the folder.
        prefix: "zsched", or "zsched.core".
        without: rooms that do not count.
    """
    entries = {path.stem for path in package.iterdir() if path.suffix == ".py" or (path.is_dir() and sources(path))}
    rooms = sorted(entries - {"__init__", "__pycache__", Path(GENERATED).stem} - without)
    found = {}
    for room in rooms:
        folder, module = package / room, package / f"{room}.py"
        files = [*(sources(folder) if folder.is_dir() else ()), *([module] if module.exists() else ())]
        targets = set()
        for file in files:
            for full in imports(ast.parse(file.read_text(encoding="utf-8"))):
                if full.startswith(f"{prefix}."):
                    targets.add(full.removeprefix(f"{prefix}.").partition(".")[0])
        found[room] = frozenset(targets & set(rooms) - {room})
    return found


def reached(graph: Graph, start: str) -> frozenset[str]:
    """The rooms that can be reached from one along arrows."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        for target in graph[waiting.pop()] - seen:
            seen.add(target)
            waiting.append(target)
    return frozenset(seen)


def shape_of(graph: Graph) -> Shape:
    """Count a graph."""
    reach = {room: reached(graph, room) for room in graph}
    circle = {room: frozenset(other for other in reach[room] if room in reach[other]) | {room} for room in graph}
    depth: dict[frozenset[str], int] = {}

    def depth_of(rooms: frozenset[str]) -> int:
        if rooms not in depth:
            below = {circle[target] for room in rooms for target in graph[room]} - {rooms}
            depth[rooms] = 1 + max((depth_of(one) for one in below), default=0)
        return depth[rooms]

    return Shape(
        rooms=len(graph),
        arrows=sum(len(targets) for targets in graph.values()),
        floors=max((depth_of(rooms) for rooms in circle.values()), default=0),
        mutual=sum(len(rooms) > 1 for rooms in circle.values()),
    )


def lines_of(files: list[Path]) -> int:
    """Lines of all files."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def functions_of(files: list[Path]) -> list[int]:
    """The lengths of all functions in lines, sorted."""
    return sorted(
        node.end_lineno - node.lineno + 1
        for file in files
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno is not None
    )


def code_lines(text: str) -> int:
    """Lines with code: no blanks, comments or docstrings; a statement over three lines is three."""
    lines: set[int] = set()
    told = {
        node.lineno
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    }
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        is_docstring = token.type == tokenize.STRING and token.start[0] in told
        if token.type not in _NO_CODE and not is_docstring:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines)


def room_lines(root: Path) -> dict[str, int]:
    """{room: its lines of code} of a checkout; rooms of the core apart, a package's loose modules under its name."""
    found: dict[str, int] = {}
    for file in sources(root / "zsched"):
        parts = file.relative_to(root).parts
        depth = 3 if len(parts) > 3 and parts[1] == "core" else min(2, len(parts) - 1)
        room = "/".join(parts[:depth])
        found[room] = found.get(room, 0) + code_lines(file.read_text(encoding="utf-8"))
    return dict(sorted(found.items()))


def large_classes(files: list[Path]) -> int:
    """Classes of over `LARGE_CLASS` lines."""
    return sum(
        node.end_lineno - node.lineno + 1 > LARGE_CLASS
        for file in files
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef) and node.end_lineno is not None
    )


def spent(root: Path) -> dict[str, int]:
    """What a checkout has of each figure that has a budget."""
    package = root / "zsched"
    rooms = room_lines(root)
    figures = {f"lines of code, {room}/": lines for room, lines in rooms.items()}
    figures["lines of code, all of zsched/"] = sum(rooms.values())
    figures["classes over 300 lines"] = large_classes(sources(package))
    for name in ("zsched", "zsched.core", "zsched.commands"):
        figures[f"arrows of {name}"] = shape_of(graph_of(root.joinpath(*name.split(".")), name)).arrows
    figures["words of documents"] = words_of(root)
    return figures


def budget() -> dict[str, int]:
    """What each figure may be at most."""
    return {str(name): int(most) for name, most in tomllib.loads(BUDGET.read_text(encoding="utf-8")).items()}


def show_budget(*, lower: bool) -> None:
    """Print each figure beside its budget; ``lower``: a budget that is above its figure becomes that."""
    now, most = spent(HERE), budget()
    for name in sorted({*now, *most}):
        print(f"{now.get(name, 0):7d} of {most.get(name, 0):7d}  {name}")
    if lower:
        head = BUDGET.read_text(encoding="utf-8").partition("\n\n")[0]
        rows = [f'"{name}" = {min(figure, most.get(name, figure))}' for name, figure in now.items()]
        BUDGET.write_text("\n".join((head, "", *rows, "")), encoding="utf-8")


def words_of(root: Path) -> int:
    """Words of the documents: everything between white space that holds a letter."""
    files = [*root.glob("*.md"), *root.glob("docs/**/*.md")]
    return sum(len(re.findall(r"\S*[A-Za-z]\S*", file.read_text(encoding="utf-8"))) for file in files)


def rows_of(root: Path) -> dict[str, str]:
    """What is printed of one checkout."""
    package, lab = root / "zsched", root / "zsched" / "lab"
    if not lab.is_dir():
        lab = root / "lab"
    product = [file for file in sources(package) if lab not in file.parents]
    lengths = functions_of(product)
    house = shape_of(graph_of(package, "zsched", frozenset({"lab"})))
    core = shape_of(graph_of(package / "core", "zsched.core"))
    return {
        "rooms, arrows, floors of `zsched/`": f"{house.rooms}, {house.arrows}, {house.floors}",
        "rooms, arrows, floors of `core/`": f"{core.rooms}, {core.arrows}, {core.floors}",
        "rooms on circles, `zsched/` and `core/`": f"{house.mutual} and {core.mutual}",
        "loose modules in `zsched/` and `core/`": f"{_loose(package)} and {_loose(package / 'core')}",
        "lines of the product": f"{lines_of(product)}",
        "lines of the lab": f"{lines_of(sources(lab))}",
        "lines of tests": f"{lines_of(sources(root / 'tests'))}",
        "lines of benchmarks": f"{lines_of(sources(root / 'benchmarks'))}",
        "lines a function: median, p90, longest": (
            f"{statistics.median(lengths):.0f}, {lengths[len(lengths) * 9 // 10]}, {lengths[-1]} (n = {len(lengths)})"
        ),
        "files of over 400 lines": f"{sum(lines_of([file]) > 400 for file in product)}",
        "size of the product's sources": f"{sum(file.stat().st_size for file in product) / 1024:.0f} KiB",
        "words of documents": f"{words_of(root)}",
    }


def _loose(package: Path) -> int:
    return sum(path.name not in {"__init__.py", GENERATED} for path in package.glob("*.py"))


def main() -> None:
    """Print the table, or the budget."""
    parser = argparse.ArgumentParser(description="size and shape of the code", prog="python -m benchmarks.house")
    parser.add_argument("checkout", nargs="*", type=Path, help="folders of checkouts; none: this one")
    parser.add_argument("--budget", action="store_true", help="this checkout beside its budget")
    parser.add_argument("--lower", action="store_true", help="the same, and write what has become less")
    given = parser.parse_args()
    if given.budget or given.lower:
        show_budget(lower=given.lower)
        return
    checkouts: list[Path] = given.checkout or [HERE]
    for root in checkouts:
        if not (root / "zsched" / "core").is_dir():
            parser.error(f"{root} is no checkout of zsched: there is no zsched/core in it")
    columns = [rows_of(root) for root in checkouts]
    print("| |", " | ".join(root.resolve().name for root in checkouts), "|")
    print("| --- |", " | ".join("---:" for _ in checkouts), "|")
    for row in columns[0]:
        print(f"| {row} |", " | ".join(column[row] for column in columns), "|")


if __name__ == "__main__":
    main()
