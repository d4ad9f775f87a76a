"""What the digest of a relay's code is made of."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from zsched.ipc.takeover import PACKAGE, code_digest, code_files


def file_of(module: str) -> Path | None:
    """The file of one of this package's modules; ``None`` where that is a name in a module."""
    path = PACKAGE.parent.joinpath(*module.split("."))
    found = (path / "__init__.py", path.with_suffix(".py"))
    return next((one for one in found if one.exists()), None)


def imports_of(file: Path) -> Iterator[str]:
    """What a file may import of this package, inside of functions, too."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (one.name for one in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{one.name}" for one in node.names)


def loaded_by(*modules: str) -> set[Path]:
    """The files of all modules that these may load."""
    found: dict[str, Path] = {}
    todo = list(modules)
    while todo:
        name = todo.pop()
        file = file_of(name) if name.split(".")[0] == PACKAGE.name else None
        if file is not None and name not in found:
            found[name] = file
            todo += [*imports_of(file), name.rpartition(".")[0]]
    return set(found.values())


def test_the_digest_covers_all_that_a_relay_may_load() -> None:
    """By it an operator learns that the relay runs other code than what is installed."""
    needed = loaded_by("zsched.relay.__main__", "zsched.relay.process")
    assert len(needed) > 60
    assert needed - set(code_files()) - {PACKAGE / "_version.py"} == set()
    assert len(code_digest()) == 16


def test_a_relay_has_the_installed_code_where_only_other_code_is_newer() -> None:
    """An upgrade of the daemon, the command line or the version alone is nothing to it."""
    names = {str(path.relative_to(PACKAGE)) for path in code_files()}
    others = ("tasks/", "examples/", "dev/", "commands/", "daemon.py", "cli.py", "runtime/", "config/", "_version.py")
    assert not {name for name in names if name.startswith(others)}
