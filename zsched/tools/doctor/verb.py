"""`zsched doctor`: looks at this machine, or at the whole fleet, and prints what is wrong and what to do.

Knows: how results are shown, exit codes. Does not know: any check (`zsched.tools.doctor`).
"""

from __future__ import annotations

import sys
import textwrap
from collections import Counter
from collections.abc import Iterable
from typing import Annotated, Final

import typer

from zsched.commands.base.common import Json, print_json, wants_color
from zsched.commands.base.options import JsonOption, Machine, NoColorOption
from zsched.commands.base.page import Page, page_width
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.host.screen import harmless
from zsched.tools.doctor.look import look
from zsched.tools.doctor.model import Check, Result, Scene, Verdict
from zsched.tools.doctor.table import run_all, worst

SCHEMA: Final = "zsched.doctor/1"
STYLES: Final = {Verdict.PASS: "green", Verdict.SKIP: "dim", Verdict.WARN: "yellow", Verdict.FAIL: "alarm"}
NAME_COLUMNS: Final = 22
INDENT: Final = 5
Results = list[tuple[Check, Result]]


def doctor(
    here: Machine,
    fleet: Annotated[bool, typer.Option("--fleet", help="Ask every node, and compare what they say.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on a warning, too.")] = False,
    json_: JsonOption = False,
    no_color: NoColorOption = False,
) -> int:
    """Look for what is wrong with this machine, its daemon, or the whole fleet, and say what to do.

    Example: sudo zsched doctor --fleet

    Each check says PASS, WARN, FAIL or SKIP, and what it saw. It changes nothing. Exits with 1 on a FAIL.
    """
    scene = look(here.machine(), is_fleet=fleet)
    results = run_all(scene)
    if json_:
        print_json(as_json(scene, results))
    else:
        sys.stdout.write(as_text(results, page_width(), is_colored=wants_color(no_color)))
    bad = (Verdict.FAIL, Verdict.WARN) if strict else (Verdict.FAIL,)
    return EXIT_FAILED if worst(results) in bad else EXIT_OK


def as_json(scene: Scene, results: Results) -> Json:
    """The results with their schema's name."""
    fleet = scene.known
    return {
        "schema": SCHEMA,
        "fleet": None if fleet is None else fleet.name,
        "node": scene.node,
        "verdict": worst(results).value,
        "counts": {verdict.value: count for verdict, count in _counts(results).items()},
        "checks": [
            {"id": check.name, "verdict": result.verdict.value, "evidence": list(result.evidence), "fix": result.fix}
            for check, result in results
        ],
    }


def as_text(results: Results, width: int, *, is_colored: bool) -> str:
    """One line per check, more where there is more evidence, and the fix below it."""
    page = Page(width, is_colored)
    for check, result in results:
        first, *more = _wrapped(result.evidence, width - INDENT - NAME_COLUMNS) or [""]
        head = f"{page.paint(result.verdict.value, STYLES[result.verdict])} {check.name:<{NAME_COLUMNS - 1}} {first}"
        page.lines.append(head.rstrip())
        page.lines += [" " * (INDENT + NAME_COLUMNS) + line for line in more]
        for line in _wrapped((f"fix: {result.fix}",) if result.fix else (), width - INDENT - NAME_COLUMNS):
            page.lines.append(" " * (INDENT + NAME_COLUMNS) + page.paint(line, "bold"))
    counts = _counts(results)
    parts = ", ".join(f"{counts[verdict]} {verdict.value}" for verdict in Verdict if counts[verdict])
    wrong = [check.name for check, result in results if result.verdict in (Verdict.WARN, Verdict.FAIL)]
    page.lines += _wrapped([f"{len(results)} checks: {parts}{': ' if wrong else ''}{', '.join(wrong)}"], width)
    return "".join(f"{line}\n" for line in page.lines)


def _wrapped(texts: Iterable[str], width: int) -> list[str]:
    return [line for text in texts for line in textwrap.wrap(harmless(text), width, break_on_hyphens=False)]


def _counts(results: Results) -> Counter[Verdict]:
    return Counter(result.verdict for _, result in results)
