"""Robot to robot, the paper's real-world demonstration: three robots, no edges, the radio decides.

Knows: which schemes are run on the radio, and their figures. Does not know: how a run is made.

The signal is the drive's own reading of every moment, the same for all schemes, however they smooth it; the task's
signal is that of the robot that holds it. "Best" is the strongest robot at every moment, known in hindsight.
The picture shows the signals as the first scheme's daemons smoothed them.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from zsched_lab.fleet.recorder import read_records
from zsched_lab.paper.cells import Cell
from zsched_lab.paper.drive_clock import DriveClock, clocks
from zsched_lab.paper.figures import save_radio
from zsched_lab.paper.matrix import Matrix, Say, collect
from zsched_lab.paper.metrics import owners_within, wasted
from zsched_lab.paper.run import CellRun, Inputs
from zsched_lab.paper.scenario import Scenario
from zsched_lab.paper.schemes import NETWORK, SCHEMES

RADIO_SCHEMES = ("zsched", "dyna_net", "argmax")
STEP_S = 0.5
WEAK_DBM = -70.0
PICTURE = "radio.png"
Series = Sequence[tuple[float, float]]


def radio_cells(scenario: Scenario) -> tuple[Cell, ...]:
    """One run of each scheme, all by the radio alone."""
    schemes = [replace(SCHEMES[name], weights=NETWORK) for name in RADIO_SCHEMES]
    return tuple(Cell(scheme=scheme, level=scenario.level, run=0) for scheme in schemes)


def run_radio(scenario: Scenario, inputs: Inputs, out: Path, say: Say) -> dict[str, Any] | None:
    """Run the robots; returns `radio_results`."""
    cells, folder = radio_cells(scenario), out / "radio"

    def figures_of(cell: Cell, run: Path) -> tuple[dict[str, Any], str]:
        del cell
        figures = radio_figures(run)
        return figures, f"{figures['moves']} moves, owner at {figures['mean_dbm']:.1f} dBm"

    def make(cell: Cell, place: Path) -> dict[str, Any]:
        return CellRun(scenario, cell, inputs, place).run()

    Matrix(scenario, make, figures_of, folder, say).run(cells)
    return radio_results(scenario, out)


def radio_results(scenario: Scenario, out: Path) -> dict[str, Any] | None:
    """The figures of the runs in the folder, with their picture drawn beside them. ``None``: no run is valid."""
    runs, _ = collect(out / "radio", radio_cells(scenario))
    if not runs:
        return None
    rows = {figures["scheme"]: [(float(t_s), str(node)) for t_s, node in figures["owners"]] for figures in runs}
    signals = {robot: [(float(t), float(v)) for t, v in series] for robot, series in runs[0]["signals"].items()}
    save_radio(out / PICTURE, signals, rows, scenario.duration_s)
    return {
        "picture": PICTURE,
        "links": runs[0]["links"],
        "duration_s": scenario.duration_s,
        "best_dbm": runs[0]["best_dbm"],
        "best_fixed_dbm": runs[0]["best_fixed_dbm"],
        "schemes": {figures["scheme"]: {k: v for k, v in figures.items() if k != "signals"} for figures in runs},
    }


def radio_figures(folder: Path) -> dict[str, Any]:
    """The figures of one run.

    Raises:
        ValueError: no robot's signal was recorded.
    """
    run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    signals = read_signals(folder / "records" / "decisions.ndjson")
    if not signals:
        raise ValueError("no robot's signal was recorded")
    duration_s = float(run["duration_s"])
    owners = owners_within(run["allocations"], duration_s)
    return {
        "scheme": run["scheme"],
        "run": run["run"],
        "level": run["level"],
        "host": run["host"],
        "links": run["links"],
        "moves": len(owners) - 1,
        "wasted_moves": wasted(owners),
        "owners": owners,
        "signals": signals,
        **signal_figures(clocks(folder, signals), owners, duration_s),
    }


def read_signals(path: Path) -> dict[str, list[tuple[float, float]]]:
    """{robot: [(t_s, dBm)]} as each robot's own daemon said."""
    found: dict[str, list[tuple[float, float]]] = {}
    for record in read_records(path):
        links = [value for value in record.get("links") or () if value is not None]
        if links:
            found.setdefault(str(record["node"]), []).append((float(record["t_s"]), float(links[0])))
    return found


def signal_figures(
    signals: Mapping[str, DriveClock], owners: Sequence[tuple[float, str]], duration_s: float
) -> dict[str, float]:
    """The task's mean signal, the best robot's at every moment, the best single robot's, and the time under -70 dBm.

    Raises:
        ValueError: there is no moment at which the owner's signal and all others' are known.
    """
    task, best = [], []
    single: dict[str, list[float]] = {robot: [] for robot in signals}
    for step in range(int(duration_s / STEP_S)):
        t_s = step * STEP_S
        owner = next((node for start, node in reversed(owners) if start <= t_s), None)
        values = {robot: drive.at(t_s) for robot, drive in signals.items()}
        known = {robot: value for robot, value in values.items() if value is not None}
        if owner not in known or len(known) < len(signals):
            continue
        task.append(known[owner])
        best.append(max(known.values()))
        for robot, value in known.items():
            single[robot].append(value)
    if not task:
        raise ValueError("no robot's signal was recorded")
    return {
        "mean_dbm": statistics.fmean(task),
        "best_dbm": statistics.fmean(best),
        "under_best_db": statistics.fmean(best) - statistics.fmean(task),
        "best_fixed_dbm": max(statistics.fmean(values) for values in single.values()),
        "below_70_ratio": sum(value < WEAK_DBM for value in task) / len(task),
    }
