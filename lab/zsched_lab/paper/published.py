"""Fills a new folder with the runs of a results.json, so that a bench goes on where its files are no longer there.

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
