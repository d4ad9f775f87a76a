"""docs/design/built-in-values.md tells every number that the core goes by, and tells it as it is.

Run as a program, this file writes that page's table anew.
"""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "design" / "built-in-values.md"
ROW = re.compile(r"^\| `([\w/]+)\.py` \| (.+) \|$", re.MULTILINE)
VALUE = re.compile(r"`(\w+)` (\S+?)(?:, |$)")


def told() -> dict[tuple[str, str], str]:
    """{(module, name): value} of the table."""
    rows = ROW.findall(PAGE.read_text(encoding="utf-8"))
    return {(module, name): value for module, values in rows for name, value in VALUE.findall(values)}


def table() -> str:
    rows: dict[str, list[str]] = {}
    for (module, name), value in built_in().items():
        rows.setdefault(module, []).append(f"`{name}` {value}")
    return "\n".join(f"| `{module}.py` | {', '.join(values)} |" for module, values in sorted(rows.items()))


def built_in() -> dict[tuple[str, str], str]:
    """The same of the modules: numbers with a public name that are made at the import, where they are made."""
    found = {}
    package = ROOT / "zsched"
    config = (package / "config" / "rulecheck.py", package / "config" / "timing.py")
    for path in (*sorted((package / "core").rglob("*.py")), *config):
        place = path.relative_to(package).with_suffix("")
        module = importlib.import_module(".".join(("zsched", *place.parts)))
        for name in assigned(path.read_text(encoding="utf-8")):
            value = getattr(module, name)
            if isinstance(value, int | float) and not name.startswith("_"):
                found[str(place), name] = f"{value:g}" if isinstance(value, float) else str(value)
    return found


def assigned(source: str) -> list[str]:
    """The names that a module's own body gives a value."""
    names: list[str] = []
    for node in ast.parse(source).body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                names.append(name)
            case ast.Assign(targets=[ast.Tuple(elts=several)]):
                names += [one.id for one in several if isinstance(one, ast.Name)]
            case _:
                pass
    return names


def test_the_table_tells_every_value_as_the_code_has_it() -> None:
    assert told() == built_in()
    assert len(told()) > 50


if __name__ == "__main__":
    head = PAGE.read_text(encoding="utf-8").partition("| --- | --- |\n")
    PAGE.write_text(f"{head[0]}{head[1]}{table()}\n", encoding="utf-8")
