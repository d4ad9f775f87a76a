"""Runs the matrix cell by cell: shows progress and the time left, survives interruptions, repeats what is invalid.

Knows: which cells there are, which are done, what makes a run invalid. Does not know: how a run is made or reported.

A cell is done when its ``metrics.json`` is there; figures by older definitions are made again from its records.
A run whose host was short of CPU, one of whose processes failed, or whose records are damaged, is moved aside
(``NAME.invalid-N``) and repeated, at most `ATTEMPTS` times in all; what stays invalid is reported, not counted. A run
that was cut (a signal, a kill) is moved aside (``NAME.interrupted-N``) and made again.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError

from zsched_lab.fleet.children import ChildError
from zsched_lab.paper.cells import Cell
from zsched_lab.paper.plan import clock
from zsched_lab.paper.run import write_json
from zsched_lab.paper.scenario import Scenario

ATTEMPTS = 3
IDLE_FLOOR = 0.05
"""Where pressure cannot be measured: a host that was less idle than this was short of CPU."""
GIVE_UP = 3
"""This many cells in a row stay invalid: the machine or the fleet is at fault, and the rest would fail as well."""
METRICS = "metrics.json"
DEFINITIONS = 6
"""Raise it when a figure's definition changes: figures of finished runs are then made again."""
Say = Callable[[str], None]
Json = dict[str, Any]
Make = Callable[[Cell, Path], Json]
"""Makes a run in a folder (`CellRun`); raises `ChildError` when it failed."""
Measure = Callable[[Cell, Path], tuple[Json, str]]
"""The figures of a finished run in its folder, and the same in a line."""


def invalid_reason(scenario: Scenario, host: Mapping[str, float | None]) -> str | None:
    """Why a run does not count: the host itself was short of CPU; ``None``: it counts."""
    pressure, idle = host.get("pressure"), host.get("idle_ratio")
    if pressure is not None and pressure > scenario.pressure_limit:
        return f"pressure {pressure:.2f} outside the quotas, at most {scenario.pressure_limit:g}"
    floor = scenario.idle_floor if pressure is not None else max(scenario.idle_floor, IDLE_FLOOR)
    if idle is not None and idle < floor:
        return f"the host was idle for {idle:.2f} of the time, at least {floor:g}"
    return None


@dataclass(slots=True)
class Progress:
    """How far the matrix is, and how long the rest takes by what the cells took so far."""

    total: int
    done: int = 0
    took_s: list[float] = field(default_factory=list)

    def line(self, cell: Cell) -> str:
        """Before a cell is run."""
        left = (
            "" if not self.took_s else f", about {clock(statistics.fmean(self.took_s) * (self.total - self.done))} left"
        )
        return f"[{self.done + 1}/{self.total}{left}] {cell.name}"


class Matrix:
    """The cells of one bench in one folder. For the main thread only (see `Children`)."""

    def __init__(self, scenario: Scenario, make: Make, measure: Measure, out: Path, say: Say) -> None:
        self._scenario, self._make, self._measure = scenario, make, measure
        self._runs, self._say = out / "runs", say

    def run(self, cells: Sequence[Cell]) -> None:
        """Run what is not done yet; a failing cell does not stop the others.

        Raises:
            ChildError: `GIVE_UP` cells in a row stayed invalid.
        """
        todo = undone(self._runs.parent, cells)
        progress = Progress(total=len(todo))
        if len(todo) < len(cells):
            self._say(f"{len(cells) - len(todo)} of {len(cells)} runs are done already")
        self._measure_again([cell for cell in cells if cell not in todo])
        in_a_row = 0
        for cell in todo:
            self._say(progress.line(cell))
            started = time.monotonic()
            reason = self._one(cell)
            in_a_row = 0 if reason is None else in_a_row + 1
            if in_a_row >= GIVE_UP:
                raise ChildError(f"{GIVE_UP} cells in a row stayed invalid, the last: {reason}; see {self._runs}")
            progress.took_s.append(time.monotonic() - started)
            progress.done += 1

    def _measure_again(self, done: Sequence[Cell]) -> None:
        old = [cell for cell in done if read_json(self._runs / cell.name / METRICS).get("definitions") != DEFINITIONS]
        for number, cell in enumerate(old, start=1):
            self._say(f"[{number}/{len(old)}] {cell.name}: figures by the present definitions")
            self._note(cell, self._runs / cell.name)

    def _note(self, cell: Cell, folder: Path) -> str:
        figures, brief = self._measure(cell, folder)
        write_json(folder / METRICS, {**figures, "definitions": DEFINITIONS})
        return brief

    def _one(self, cell: Cell) -> str | None:
        """One cell until it is valid; returns why it is not after all attempts."""
        folder, reason = self._runs / cell.name, None
        for attempt in range(1, ATTEMPTS + 1):
            set_aside(folder, "interrupted")
            reason = self._attempt(cell, folder)
            if reason is None:
                return None
            self._say(f"{cell.name}: invalid (attempt {attempt} of {ATTEMPTS}): {reason}")
            write_json(folder / "invalid.json", {"cell": cell.name, "attempt": attempt, "reason": reason})
            set_aside(folder, "invalid")
        return reason

    def _attempt(self, cell: Cell, folder: Path) -> str | None:
        """Make the run and its figures; returns why it is invalid."""
        folder.mkdir(parents=True, exist_ok=True)
        try:
            run = self._make(cell, folder)
        except ChildError as error:
            return str(error)
        reason = invalid_reason(self._scenario, run["host"])
        if reason is not None:
            return reason
        try:
            self._say("      " + self._note(cell, folder))
        except (OSError, ValueError, McapError) as error:  # a recorder was killed, say: such a run is made again
            return f"its records cannot be measured: {error!r}"
        return None


def undone(out: Path, cells: Iterable[Cell]) -> list[Cell]:
    """The cells that have no valid run in the folder yet."""
    return [cell for cell in cells if not (out / "runs" / cell.name / METRICS).exists()]


def set_aside(folder: Path, why: str) -> None:
    """Rename the folder of a run that does not count; nothing is thrown away."""
    if not folder.exists():
        return
    number = 1
    while (target := folder.with_name(f"{folder.name}.{why}-{number}")).exists():
        number += 1
    folder.rename(target)


def collect(out: Path, cells: Iterable[Cell]) -> tuple[list[Json], list[Json]]:
    """(figures of the runs that count, what was invalid) of ``cells``, out of the folder."""
    runs = out / "runs"
    valid = [read_json(path) for cell in cells if (path := runs / cell.name / METRICS).exists()]
    invalid = [read_json(path) for path in sorted(runs.glob("*.invalid-*/invalid.json"))]
    return valid, invalid


def read_json(path: Path) -> Json:
    """What `write_json` wrote."""
    body: Json = json.loads(path.read_text(encoding="utf-8"))
    return body
