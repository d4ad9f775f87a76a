"""`zsched bench paper`: reads the scenario, runs the matrix, writes results.json, report.md and the pictures.

Knows: options, exit codes, files of the folder. Does not know: how a run is made, what a figure means.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from zsched import __version__
from zsched.errors import ConfigError, ZschedError
from zsched.lab.demo import EXIT_CONFIG, EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE
from zsched.lab.laser_log import malaga_path
from zsched.lab.paper.figures import save_all
from zsched.lab.paper.matrix import Matrix, cells_of, collect
from zsched.lab.paper.metrics import Truth, brief, measure
from zsched.lab.paper.radio_bench import run_radio
from zsched.lab.paper.report import report
from zsched.lab.paper.robots import ExploreRobots, LogRobots, Robots
from zsched.lab.paper.run import Cell, CellRun, Inputs, write_json
from zsched.lab.paper.scenario import Scenario, load_scenario
from zsched.lab.paper.schemes import QUICK_SCHEMES
from zsched.lab.signals import Interrupted, interruptible

RESULTS_SCHEMA = "zsched.paper/1"
QUICK_S = 34.0
"""With start and end five runs of this length take under five minutes on two cores."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOptions:
    """What the command line gives."""

    out: Path
    scenario: Path
    robots_scenario: Path
    runs: int | None = None
    schemes: tuple[str, ...] = ()
    is_quick: bool = False
    is_resumed: bool = False
    log: Path | None = None
    drives: Path | None = None
    duration_s: float | None = None
    is_exploring: bool = False


def run_bench(options: BenchOptions) -> int:
    """Run the bench; returns the exit code: 0, 1 failed, 2 usage, 78 bad file, 128 + n after signal n.

    Whatever happens, no process of a run is left; what was done is kept, and `is_resumed` goes on behind it.
    """
    try:
        with interruptible():
            return _run(options)
    except Interrupted as interrupted:
        say(f"interrupted; go on with --resume --out {options.out}")
        return EXIT_SIGNAL + interrupted.number
    except ConfigError as error:
        say(str(error))
        return EXIT_CONFIG
    except (ZschedError, OSError) as error:
        say(str(error))
        return EXIT_FAILED


def _run(options: BenchOptions) -> int:
    scenario, cells = planned(options)
    robots = robots_of(options, scenario)
    inputs = Inputs(robots=robots, drives=options.drives)
    body = plan_body(scenario, inputs, cells)
    wrong = claim_folder(options, body)
    if wrong:
        say(wrong)
        return EXIT_USAGE
    truth = Truth(robots.truth())

    def figures_of(folder: Path) -> tuple[dict[str, Any], str]:
        figures = measure(folder, scenario, truth)
        return figures, brief(figures)

    def make(cell: Cell, folder: Path) -> dict[str, Any]:
        return CellRun(scenario, cell, inputs, folder).run()

    Matrix(scenario, make, figures_of, options.out, say).run(cells)
    wants_radio = not options.is_quick and not options.schemes
    # A drive of minutes: the robots replay a log there, an exploration would be over before.
    replay = Inputs(robots=LogRobots(log=log_path(options)), drives=options.drives)
    radio = run_radio(load_scenario(options.robots_scenario), replay, options.out, say) if wants_radio else None
    return conclude(options, scenario, inputs, cells, radio)


def robots_of(options: BenchOptions, scenario: Scenario) -> Robots:
    """What the robots see."""
    if options.is_exploring:
        loop = scenario.explore
        return ExploreRobots(world=loop.world, speed=loop.speed, slam_on=loop.slam_on)
    return LogRobots(log=log_path(options))


def log_path(options: BenchOptions) -> Path:
    """The log given, else the shipped one."""
    return (options.log or malaga_path()).absolute()


def planned(options: BenchOptions) -> tuple[Scenario, tuple[Cell, ...]]:
    """The scenario and the cells that the options ask for.

    Raises:
        ConfigError: the scenario is damaged, or a scheme unknown.
    """
    scenario = load_scenario(options.scenario)
    if options.is_exploring:
        loop = scenario.explore
        scenario = replace(scenario, duration_s=loop.duration_s, target_coverage=loop.target_coverage)
    if options.is_quick:
        names = options.schemes or QUICK_SCHEMES
        scenario = replace(scenario, schemes=names, runs=1, sweep=replace(scenario.sweep, schemes=()))
    if options.is_quick and not options.is_exploring:
        scenario = replace(scenario, duration_s=QUICK_S)
    if options.duration_s is not None:
        scenario = replace(scenario, duration_s=options.duration_s)
    return scenario, cells_of(scenario, options.schemes, options.runs)


def plan_body(scenario: Scenario, inputs: Inputs, cells: Sequence[Cell]) -> dict[str, Any]:
    """What a folder was made for, so that nothing else goes on in it."""
    body = asdict(scenario) | {"fleet": scenario.fleet.name}
    drives = inputs.drives.name if inputs.drives else None
    found = {"scenario": body, "input": inputs.robots.name, "drives": drives, "cells": [cell.name for cell in cells]}
    return dict(json.loads(json.dumps(found)))  # as it is read back: no tuples


def claim_folder(options: BenchOptions, body: Mapping[str, Any]) -> str | None:
    """Make the folder this bench's own; returns why it is not to be used."""
    out, plan = options.out, options.out / "plan.json"
    if not out.exists() or not any(out.iterdir()):
        out.mkdir(parents=True, exist_ok=True)
        write_json(plan, body)
        return None
    if not options.is_resumed:
        return f"--out {out}: the folder is not empty; name a new one, or go on with --resume"
    try:
        before = json.loads(plan.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return f"--resume: {plan} is not there; this folder is none of `zsched bench paper`"
    if {**before, "cells": None} != {**body, "cells": None}:
        return f"--resume: {out} was made with another scenario, log or duration; name a new folder with --out"
    write_json(plan, {**body, "cells": sorted({*before["cells"], *body["cells"]})})
    return None


def conclude(
    options: BenchOptions, scenario: Scenario, inputs: Inputs, cells: Sequence[Cell], radio: Mapping[str, Any] | None
) -> int:
    """Write results.json, report.md and the pictures out of what is in the folder."""
    runs, invalid = collect(options.out, cells)
    results = {
        "schema": RESULTS_SCHEMA,
        "version": __version__,
        "command": command_of(options),
        "scenario": asdict(scenario) | {"fleet": scenario.fleet.name},
        "input": inputs.robots.name,
        "runs": runs,
        "invalid": invalid,
        "radio": radio,
    }
    write_json(options.out / "results.json", results)
    title = f"{scenario.name}, load {scenario.level}, seed {scenario.seed}, {inputs.robots.name}"
    drawn = save_all(runs, scenario.level, tuple(scenario.levels), options.out, title)
    (options.out / "report.md").write_text(report(results, drawn), encoding="utf-8")
    missing = len(cells) - len(runs)
    if missing:
        say(f"{missing} of {len(cells)} runs have no valid result; see {options.out / 'runs'}, then --resume")
    print(f"{options.out / 'report.md'}: {len(runs)} runs")
    return EXIT_FAILED if missing else 0


def command_of(options: BenchOptions) -> str:
    """The command that makes these results, without the places of this machine."""
    words = ["zsched bench paper"]
    words += ["--quick"] if options.is_quick else []
    words += ["--input explore"] if options.is_exploring else []
    words += [f"--runs {options.runs}"] if options.runs is not None else []
    words += [f"--schemes {','.join(options.schemes)}"] if options.schemes else []
    words += [f"--duration {options.duration_s:g}"] if options.duration_s is not None else []
    words += [f"--log {options.log.name}"] if options.log else []
    words += [f"--drives {options.drives.name}"] if options.drives else []
    return " ".join(words)


def say(text: str) -> None:
    """Progress and errors, on stderr."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
