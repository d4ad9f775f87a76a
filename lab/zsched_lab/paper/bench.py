"""`zsched bench paper`: reads the scenario, runs the matrix, writes results.json, report.md and the pictures.

Knows: options, exit codes, files of the folder. Does not know: how a run is made, what a figure means.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from zsched import __version__
from zsched.core.values.errors import ConfigError, ZschedError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE
from zsched_lab.fleet.netns import why_not
from zsched_lab.fleet.runner import read_tree
from zsched_lab.fleet.signals import Interrupted, interruptible
from zsched_lab.maps.laser_log import malaga_path
from zsched_lab.paper.cells import Cell, cells_of, merge_of, world_of
from zsched_lab.paper.coverage_report import save_coverage
from zsched_lab.paper.figures import save_all, save_gains, save_panels
from zsched_lab.paper.matrix import DEFINITIONS, Matrix, collect, read_json, undone
from zsched_lab.paper.metrics import Truth, brief, measure
from zsched_lab.paper.places import scenario_path
from zsched_lab.paper.plan import AROUND_S, leave_out, plan_text, without
from zsched_lab.paper.published import RESULTS, definitions_of, is_published, made_by, unpack
from zsched_lab.paper.radio_bench import RADIO_SCHEMES, radio_results, run_radio
from zsched_lab.paper.report import groups_of, in_block, is_whole, main_level, report
from zsched_lab.paper.robots import ExploreRobots, LogRobots, Robots, slam_task
from zsched_lab.paper.run import CellRun, Inputs, machine_text, write_json
from zsched_lab.paper.scenario import MATRIX, Scenario, load_scenario
from zsched_lab.paper.schemes import QUICK_SCHEMES

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
    is_plan: bool = False
    """Only say what would be run."""
    is_report: bool = False
    """Run nothing; report what is done in the folder."""


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
    if options.is_report and is_published(options.out):
        return report_again(options.out)
    scenario, cells, skipped = planned(options)
    inputs = InputsOf(options, scenario)
    body = plan_body(scenario, inputs, cells)
    has_radio = scenario.main == MATRIX and not options.is_quick and not options.schemes
    radio = load_scenario(options.robots_scenario) if has_radio else None
    wrong = None if options.is_plan else claim_folder(options, body)
    if wrong:
        say(wrong)
        return EXIT_USAGE
    text = told_plan(options, scenario, cells, radio, skipped)
    if options.is_plan:
        print(text)
        return 0
    say(text)
    truths = inputs.truths(cells)

    def figures_of(cell: Cell, folder: Path) -> tuple[dict[str, Any], str]:
        figures = measure(folder, scenario, truths[inputs.of(cell).robots.name])
        return figures, brief(figures)

    def make(cell: Cell, folder: Path) -> dict[str, Any]:
        return CellRun(scenario, cell, inputs.of(cell), folder).run()

    if options.is_report:
        found = None if radio is None else radio_results(radio, options.out)
        return conclude(options, scenario, inputs, cells, Rest(radio=found, skipped=skipped))
    Matrix(scenario, make, figures_of, options.out, say).run(cells)
    # A drive of minutes: the robots replay a log there, an exploration would be over before.
    replay = Inputs(robots=LogRobots(log=log_path(options)), drives=options.drives)
    found = None if radio is None else run_radio(radio, replay, options.out, say)
    return conclude(options, scenario, inputs, cells, Rest(radio=found, skipped=skipped))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rest:
    """What stands in the results beside the runs."""

    radio: Mapping[str, Any] | None = None
    skipped: Mapping[str, str] = field(default_factory=dict)
    """{block: why it was left out}."""


class InputsOf:
    """What the robots of each cell see: one log for all, or the world of the cell's run and block."""

    def __init__(self, options: BenchOptions, scenario: Scenario) -> None:
        self._options, self._scenario = options, scenario
        tasks = read_tree(scenario.fleet)["tasks"]
        self._has_slam_tasks = any(slam_task(robot) in tasks for robot in scenario.explore.slam_on)

    @property
    def name(self) -> str:
        """As shown in reports."""
        if self._options.is_exploring:
            return f"explore {Path(self._scenario.explore.world).name}"
        return LogRobots(log=log_path(self._options)).name

    @property
    def drives(self) -> Path | None:
        """The folder of recorded drives."""
        return self._options.drives

    def of(self, cell: Cell) -> Inputs:
        """One cell's."""
        return Inputs(robots=self._robots(cell), drives=self._options.drives)

    def truths(self, cells: Sequence[Cell]) -> dict[str, Truth]:
        """The truth of each input by its name.

        Raises:
            ConfigError: a log or a world cannot be read, or has no room for the robots.
        """
        found: dict[str, Truth] = {}
        for cell in cells:
            robots = self._robots(cell)
            if robots.name not in found:
                found[robots.name] = Truth(robots.truth())
        return found

    def _robots(self, cell: Cell) -> Robots:
        if not self._options.is_exploring:
            return LogRobots(log=log_path(self._options))
        loop = self._scenario.explore
        full = self._scenario.full_cores
        return ExploreRobots(
            world=world_of(self._scenario, cell),
            speed=loop.speed,
            slam_on=loop.slam_on,
            resolution_m=merge_of(self._scenario, cell).resolution_m,
            slam_cores=None if loop.slam_share is None else loop.slam_share * full,
            navigate_cores=loop.navigate_share * full,
            first=loop.first,
            map_period_s=loop.map_period_s,
            ends_at_target=loop.ends_at_target,
            is_slam_task=self._has_slam_tasks,
        )


def told_plan(
    options: BenchOptions,
    scenario: Scenario,
    cells: Sequence[Cell],
    radio: Scenario | None,
    skipped: Mapping[str, str],
) -> str:
    """The plan for people: blocks, runs, how long at most."""
    radio_s = 0.0 if radio is None else len(RADIO_SCHEMES) * (radio.duration_s + AROUND_S)
    log = None if options.is_exploring else LogRobots(log=log_path(options)).name
    return plan_text(scenario, cells, undone(options.out, cells), radio_s, skipped, log)


def log_path(options: BenchOptions) -> Path:
    """The log given, else the shipped one."""
    return (options.log or malaga_path()).absolute()


def planned(options: BenchOptions) -> tuple[Scenario, tuple[Cell, ...], dict[str, str]]:
    """The scenario, the cells that the options ask for, and {block: why it is left out}.

    Raises:
        ConfigError: the scenario is damaged, or a scheme unknown.
    """
    scenario = load_scenario(options.scenario)
    if options.is_exploring:
        loop = scenario.explore
        scenario = replace(scenario, duration_s=loop.duration_s, target_coverage=loop.target_coverage)
    if options.is_quick:
        scenario = quick_of(scenario, options)
    if options.is_quick and not options.is_exploring:
        scenario = replace(scenario, duration_s=QUICK_S)
    if options.duration_s is not None:
        scenario = replace(scenario, duration_s=options.duration_s)
    skipped = without(scenario, is_exploring=options.is_exploring, why_not=why_not)
    if scenario.main in skipped:
        raise ConfigError(f"{options.scenario}: block {scenario.main}: {skipped[scenario.main]}")
    return scenario, cells_of(leave_out(scenario, skipped), options.schemes, options.runs), skipped


def quick_of(scenario: Scenario, options: BenchOptions) -> Scenario:
    """What ``--quick`` leaves: one run of a few schemes, in the block that the scenario names for it.

    That block is for robots that explore; a replayed log goes through the matrix.
    """
    names = options.schemes or QUICK_SCHEMES
    main = scenario.quick if options.is_exploring else MATRIX
    kept = {main: replace(scenario.blocks[main], schemes=names, runs=1)} if main != MATRIX else {}
    sweep = replace(scenario.sweep, schemes=())
    return replace(scenario, schemes=names, runs=1, sweep=sweep, blocks=kept, main=main, quick=main)


def plan_body(scenario: Scenario, inputs: InputsOf, cells: Sequence[Cell]) -> dict[str, Any]:
    """What a folder was made for, so that nothing else goes on in it."""
    body = asdict(scenario) | {"fleet": scenario.fleet.name}
    drives = inputs.drives.name if inputs.drives else None
    found = {"scenario": body, "input": inputs.name, "drives": drives, "cells": [cell.name for cell in cells]}
    return dict(json.loads(json.dumps(found)))  # as it is read back: no tuples


def claim_folder(options: BenchOptions, body: Mapping[str, Any]) -> str | None:
    """Make the folder this bench's own; returns why it is not to be used."""
    out, plan = options.out, options.out / "plan.json"
    if options.is_report and not plan.exists():
        return f"--report: there are neither runs of `zsched bench paper` nor a {RESULTS} in {out}; name one with --out"
    if not out.exists() or not any(out.iterdir()):
        out.mkdir(parents=True, exist_ok=True)
        write_json(plan, body)
        return None
    if not options.is_resumed and not options.is_report:
        return f"--out {out}: the folder is not empty; name a new one, or go on with --resume"
    if is_published(out):
        wrong = unpack(out, body)
        if wrong is None:
            write_json(plan, body)
        return wrong
    try:
        before = json.loads(plan.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return f"--resume: {plan} is not there; this folder is none of `zsched bench paper`"
    if {**before, "cells": None} != {**body, "cells": None}:
        return f"--resume: {out} was made with another scenario, log or duration; name a new folder with --out"
    write_json(plan, {**body, "cells": sorted({*before["cells"], *body["cells"]})})
    return None


def conclude(options: BenchOptions, scenario: Scenario, inputs: InputsOf, cells: Sequence[Cell], rest: Rest) -> int:
    """Write results.json, report.md and the pictures out of what is in the folder."""
    runs, invalid = collect(options.out, cells)
    results = {
        "schema": RESULTS_SCHEMA,
        "version": made_by(runs, "version") or __version__,
        "machine": made_by(runs, "machine") or machine_text(),
        "command": command_of(options),
        "scenario": asdict(scenario) | {"fleet": scenario.fleet.name},
        "input": inputs.name,
        "drives": inputs.drives.name if inputs.drives else None,
        "runs": runs,
        "invalid": invalid,
        "interrupted": sorted(path.name for path in (options.out / "runs").glob("*.interrupted-*")),
        "missing": [cell.name for cell in undone(options.out, cells)],
        "skipped": rest.skipped,
        "radio": rest.radio,
    }
    write_json(options.out / RESULTS, results)
    missing = len(cells) - len(runs)
    if missing:
        say(f"{missing} of {len(cells)} runs have no valid result; see {options.out / 'runs'}, then --resume")
    _write_report(options.out)
    return EXIT_FAILED if missing and not options.is_report else 0


def report_again(out: Path) -> int:
    """Report the published ``results.json`` of a folder that holds nothing else, as it is; the exit code."""
    path = out / RESULTS
    told = definitions_of(path)
    if isinstance(told, str):
        say(f"--report: {path}: {told}")
        return EXIT_USAGE
    older = [str(number) for number in told if number != DEFINITIONS]
    text = f"{path} has figures by definitions {', '.join(older)}, today's are {DEFINITIONS}"
    if older:
        say(f"{text}: they stand here as they were (docs/evaluation/README.md)")
    try:
        _write_report(out)
    except KeyError as error:
        say(f"--report: {text}, and {error} is missing: only the version that made them can report them")
        return EXIT_USAGE
    return 0


def _write_report(out: Path) -> None:
    """Write report.md and the pictures of a folder's results.json."""
    results = read_json(out / RESULTS)
    scenario, level = results["scenario"], main_level(results)
    title = f"{scenario['name']}, load {level}, seed {scenario['seed']}, {results['input']}"
    drawn = save_all(in_block(results["runs"], scenario["main"]), level, tuple(scenario["levels"]), out, title)
    drawn += block_pictures(results, out)
    (out / "report.md").write_text(report(results, drawn), encoding="utf-8")
    print(f"{out / 'report.md'}: {len(results['runs'])} runs")


def block_pictures(results: Mapping[str, Any], out: Path) -> list[str]:
    """What placing gains in the matrix and the blocks, and the paper's panels for each block that is a whole matrix."""
    title = f"{results['scenario']['name']}, seed {results['scenario']['seed']}"
    gains = save_gains(out / "gains.png", groups_of(results), f"{title}: against the mean of the fixed schemes, 95 %")
    panels = [
        save_panels(out / f"{name}.png", own, f"{title}, block {name}")
        for name in results["scenario"]["blocks"]
        if is_whole(own := in_block(results["runs"], name))
    ]
    curves = [
        found
        for name in results["scenario"]["blocks"]
        if (found := save_coverage(out / f"{name}-coverage.png", in_block(results["runs"], name), title))
    ]
    return [*curves, *([gains] if gains else []), *panels]


def command_of(options: BenchOptions) -> str:
    """The command that makes these results, without the places of this machine."""
    words = ["zsched bench paper"]
    if options.scenario != scenario_path():
        words += [f"--scenario {options.scenario.name.removesuffix('.scenario.yml')}"]
    words += ["--quick"] if options.is_quick else []
    words += [f"--input {'explore' if options.is_exploring else 'log'}"]
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
