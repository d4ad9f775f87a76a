"""docs/guide/worker.md says what the library's code says: its calls with their options, the fields, the environment."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from zsched.core.values.plan import Role
from zsched.worker import Answer, Output, Received, Request, Worker
from zsched.worker.start import _ENVIRONMENT

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "guide" / "worker.md").read_text(encoding="utf-8")
CALLED_BY_THE_LIBRARY = {"Output.send_end", "Output.close"}


def rows(head: str) -> list[list[str]]:
    """The cells of the table behind a line that begins with ``head``."""
    lines = PAGE[PAGE.index(f"\n{head}") + 1 :].splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith("| ---")) + 1
    found = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in line[1:-1].split("|")])
    return found


def options_of(call: Any) -> str:
    """The parameters as the page has them: in order, with their defaults."""
    shown = []
    for name, parameter in inspect.signature(call).parameters.items():
        default = parameter.default
        if name == "self":
            continue
        value = "os.environ" if name == "env" else default
        text = f'"{value}"' if isinstance(default, str) else str(value)
        shown.append(f"`{name}`" if default is inspect.Parameter.empty else f"`{name}={text}`")
    return ", ".join(shown)


def public_calls() -> Iterator[tuple[str, str]]:
    for kind in (Worker, Output):
        for name, member in inspect.getmembers(kind, lambda one: inspect.isfunction(one) or inspect.ismethod(one)):
            if not name.startswith("_") and f"{kind.__name__}.{name}" not in CALLED_BY_THE_LIBRARY:
                yield f"`{kind.__name__}.{name}`", options_of(member)


def test_every_call_is_there_with_its_options_and_their_defaults() -> None:
    assert {call: options for call, options, _ in rows("| call |")} == dict(public_calls())


@pytest.mark.parametrize("kind", [Received, Request, Answer, Role])
def test_every_field_is_there(kind: type[Any]) -> None:
    assert [name for name, _ in rows(f"`{kind.__name__}`, ")] == [f"`{one.name}`" for one in fields(kind)]


def test_every_variable_that_a_worker_is_given_is_there() -> None:
    sources = [(ROOT / "zsched" / name).read_text() for name in ("runtime/recipes.py", "host/workers/supervisor.py")]
    given = {name for text in sources for name in re.findall(r'"((?:ZSCHED|ZENOH|PYTHON)\w+)": ', text)}
    named = [name.strip("`") for name, _ in rows("| variable |")]
    assert given >= set(_ENVIRONMENT)
    assert sorted(named) == sorted(given)
    assert tuple(named[: len(_ENVIRONMENT)]) == _ENVIRONMENT


def test_what_the_page_says_of_waiting_samples_is_the_default() -> None:
    default = inspect.signature(Worker.subscribe).parameters["keep_last"].default
    assert rows("| `keep_last` |")[0][0] == f'`"{default}"` (default)'
