"""A results.json without the files of its runs: it can be reported, and a bench can go on behind it in a new folder.

Knows: what results.json holds of each run. Does not know: how a bench is run or reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from zsched_lab.paper.cells import cell_name
from zsched_lab.paper.matrix import DEFINITIONS, METRICS, read_json
from zsched_lab.paper.run import write_json

RESULTS = "results.json"


def is_published(out: Path) -> bool:
    """Whether a folder holds a results.json, and no bench was begun in it."""
    return (out / RESULTS).exists() and not (out / "plan.json").exists()


def definitions_of(results: Path) -> tuple[int, ...] | str:
    """By which definitions the figures of a results.json are, sorted; a text: why it cannot be reported."""
    try:
        told = read_json(results)
        found = sorted({int(run["definitions"]) for run in told["runs"]})
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"it is no results.json of `zsched bench paper` ({type(error).__name__}: {error})"
    return tuple(found) or "it has no runs"


def made_by(runs: Sequence[Mapping[str, Any]], key: str) -> str:
    """The versions or machines that made these runs, who reports them aside; empty: the runs do not say."""
    return ", ".join(sorted({str(run[key]) for run in runs if run.get(key)}))


def unpack(out: Path, body: Mapping[str, Any]) -> str | None:
    """Make the folders of the runs that ``out/results.json`` tells of; returns why they do not go with ``body``.

    ``body`` is `zsched_lab.paper.bench.plan_body`. Nothing is written when something is wrong. Runs that do not count
    stay what they are. The records of a run do not come back, so its figures must be by the present definitions.
    """
    results = out / RESULTS
    try:
        told = read_json(results)
        runs: Sequence[Mapping[str, Any]] = told["runs"]
        same = (told["scenario"], told["input"], told["drives"]) == (body["scenario"], body["input"], body["drives"])
        named = [(cell_name(run["block"], run["level"], run["scheme"], run["run"]), run) for run in runs]
        old = [name for name, run in named if run.get("definitions") != DEFINITIONS]
        invalid = [(f"{one['cell']}.invalid-{one['attempt']}", one) for one in told["invalid"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"--resume: {results} is no results.json of `zsched bench paper` ({type(error).__name__}: {error})"
    if not same:
        return f"--resume: {results} was made with another scenario, log or drives; start anew in a new folder"
    if old:
        return f"--resume: {results}: {old[0]} has figures by older definitions; start anew in a new folder"
    for name, run in named:
        _put(out / "runs" / name / METRICS, run)
    for name, one in invalid:
        _put(out / "runs" / name / "invalid.json", one)
    return None


def _put(path: Path, body: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, body)
