"""Finds what a worker in Python imports, imports that, and says what is missing; the worker itself is not carried out.

Run as a script, by path, in the worker's own interpreter: ``python imports.py module NAME`` or ``... file PATH``. The
worker's own package is only read. Imports inside functions and ``try`` are left out: they may be optional.

Knows: import statements. Does not know: tasks, or any other module of zsched (it imports none).
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path


def imported(tree: ast.Module, package: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """(module, names taken from it) of each import at the top of a module of ``package``."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from ((alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            name = ".".join([*above, *([node.module] if node.module else [])])
            yield name, tuple(alias.name for alias in node.names)


def outside(start: str) -> set[str]:
    """Modules of other packages that the module ``start``, and those of its own package that it imports, import."""
    own, seen, found, waiting = start.partition(".")[0], {start}, set(), [start]
    while waiting:
        name = waiting.pop()
        spec = importlib.util.find_spec(name)
        if spec is None:
            found.add(name)
            continue
        if spec.origin is None or not spec.origin.endswith(".py"):
            continue
        package = name if spec.submodule_search_locations is not None else name.rpartition(".")[0]
        for module, names in imported(ast.parse(Path(spec.origin).read_bytes()), package):
            if module.partition(".")[0] != own:
                found.add(module)
                continue
            below = [f"{module}.{one}" for one in names if _is_module(f"{module}.{one}")]
            new = [one for one in (module, *below) if one not in seen]
            seen.update(new)
            waiting += new
    return found


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # what is before its last dot is no package
        return False


def first_missing(names: set[str]) -> str:
    """Why one of these modules cannot be imported; empty: all can."""
    for name in sorted(names):
        try:
            importlib.import_module(name)
        except Exception as error:  # noqa: BLE001 - a package may raise what it likes at its import
            return f"{name}: {type(error).__name__}: {error}"
    return ""


def main(arguments: list[str]) -> int:
    """Look, and print why not; returns the exit status."""
    kind, what = arguments
    sys.path.pop(0)  # this file's own folder
    if kind == "file":
        path = Path(what).absolute()
        sys.path.insert(0, str(path.parent))
        names = {name for name, _ in imported(ast.parse(path.read_bytes()), "")}
    else:
        sys.path.insert(0, "")
        try:
            has_main = _is_module(f"{what}.__main__")
            names = outside(f"{what}.__main__" if has_main else what)
        except ModuleNotFoundError as error:
            print(error)
            return 1
    missing = first_missing(names)
    if missing:
        print(missing)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
