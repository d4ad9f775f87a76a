"""Which of the doctor's checks have a test that plants a fault, and fails unless the check finds it; read off tests.

A test counts by its own ``assert_finds(RESULT, ...)``, where RESULT is what the check has said of the planted scene:
``run("the.check", ...)``, a call of the check's function, ``results["the.check"]``, or a name for one of them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

FOUND = "assert_finds"


def found_in(files: Iterable[Path]) -> set[str]:
    """The names of checks (``state.fsync``) and of their functions (``state.syncs_quickly``)."""
    return {name for file in files for name in _of_file(ast.parse(file.read_text(encoding="utf-8")))}


def _of_file(module: ast.Module) -> Iterator[str]:
    for test in ast.walk(module):
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
            assigned = dict(_assigned(test))
            for call in ast.walk(test):
                if isinstance(call, ast.Call) and _name(call.func) == FOUND:
                    yield from _said_by(call.args[0], assigned)


def _assigned(test: ast.FunctionDef) -> Iterator[tuple[str, ast.expr]]:
    for one in ast.walk(test):
        if isinstance(one, ast.Assign):
            yield from ((target.id, one.value) for target in one.targets if isinstance(target, ast.Name))


def _said_by(result: ast.expr, assigned: dict[str, ast.expr]) -> Iterator[str]:
    """Whose result it is."""
    match result:
        case ast.Name(id=name) if name in assigned:
            rest = {key: value for key, value in assigned.items() if key != name}
            yield from _said_by(assigned[name], rest)
        case ast.Call(func=ast.Name(id="run"), args=[ast.Constant(value=str(check)), *_]):
            yield check
        case ast.Call(func=function):
            yield from _said_by(function, assigned)
        case ast.Subscript(slice=ast.Constant(value=str(check))):
            yield check
        case ast.Attribute(value=ast.Name(id=module), attr=function):
            yield f"{module}.{function}"


def _name(function: ast.expr) -> str:
    return function.id if isinstance(function, ast.Name) else ""
