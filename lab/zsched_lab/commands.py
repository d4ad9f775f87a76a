"""The lab's verbs, `zsched demo` and `zsched bench paper`: their arguments.

Knows: options. Does not know: what is run (`zsched_lab.demo.demo`, `zsched_lab.paper`), which is imported when it is
needed: the program's help loads this module.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.base.common import CliError, Verb, Verbs
from zsched.core.values.exits import EXIT_USAGE


class MergeMode(StrEnum):
    """How the demo's worker learns where the robots' maps lie."""

    KNOWN = "known"
    TRACK = "track"
    ESTIMATE = "estimate"


class RobotsSee(StrEnum):
    """A recorded laser log, or a known world that they explore in closed loop."""

    LOG = "log"
    EXPLORE = "explore"


demo_app = typer.Typer(name="demo", add_completion=False, rich_markup_mode=None)
bench_app = typer.Typer(
    name="bench",
    cls=Verbs,
    help="Evaluations on this machine, with real daemons (the lab).",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@demo_app.command(cls=Verb)
def demo(
    headless: Annotated[bool, typer.Option("--headless", help="Plain lines instead of the live view.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for pictures and figures.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="FILE", help="CARMEN laser log. [Malaga, shipped]")] = None,
    duration: Annotated[float, typer.Option(metavar="S", help="Seconds to run.")] = 60.0,
    mode: Annotated[MergeMode, typer.Option(help="Where the robots' poses come from.")] = MergeMode.KNOWN,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of poses and injected loads.")] = 1,
) -> None:
    """Run a whole fleet on this machine: three robots and three edges merge real laser maps."""
    from zsched_lab.demo.demo import DemoOptions, run_demo  # noqa: PLC0415 - heavy

    options = DemoOptions(headless=headless, out=out, log=log, duration_s=duration, mode=mode.value, seed=seed)
    raise typer.Exit(run_demo(options))


@bench_app.callback()
def bench() -> None:
    """Evaluations on this machine, with real daemons (the lab)."""


@bench_app.command(cls=Verb)
def paper(
    runs: Annotated[
        int | None, typer.Option(min=1, max=1000, metavar="N", help="Runs of each scheme. [scenario]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="The README's block `heavy`, five schemes once: 6 quiet minutes.")
    ] = False,
    schemes: Annotated[str, typer.Option(metavar="A,B", help="Only these schemes. [the scenario's]")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Go on in the folder of --out.")] = False,
    report: Annotated[bool, typer.Option("--report", help="Run nothing; report what is done in --out.")] = False,
    plan: Annotated[bool, typer.Option("--plan", help="Only say what would be run, and for how long.")] = False,
    kind: Annotated[
        RobotsSee | None, typer.Option("--input", help="What the robots see. [explore; log with --log]")
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results.")] = Path("zsched-paper"),
    scenario: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A file, or a declared block (nano, heavy-all). [paper]")
    ] = None,
    log: Annotated[Path | None, typer.Option(metavar="FILE", help="CARMEN laser log. [Malaga, shipped]")] = None,
    drives: Annotated[Path | None, typer.Option(metavar="DIR", help="Recorded radio drives. [simulated]")] = None,
    duration: Annotated[
        float | None, typer.Option(min=5.0, max=600.0, metavar="S", help="Seconds the robots drive. [scenario]")
    ] = None,
) -> None:
    """Run the paper's evaluation: schemes by runs, with figures, pictures and a report of every claim.

    Needs control groups (root, or a delegated group): the edges differ by what they may use.
    """
    is_replay = kind is RobotsSee.LOG or (kind is None and log is not None)
    if log is not None and not is_replay:
        raise CliError(EXIT_USAGE, "--log goes with --input log; leave one of them out")
    names = tuple(name.strip() for name in schemes.split(",") if name.strip())
    if schemes and not names:
        raise CliError(EXIT_USAGE, f"--schemes {schemes!r}: give names, e.g. --schemes dyna_both,zsched")
    from zsched_lab.paper.bench import BenchOptions, run_bench  # noqa: PLC0415 - heavy
    from zsched_lab.paper.places import robots_scenario_path, scenario_path, shipped_scenario  # noqa: PLC0415 - as above

    options = BenchOptions(
        out=out,
        scenario=scenario_path() if scenario is None else shipped_scenario(str(scenario)) or scenario,
        robots_scenario=robots_scenario_path(),
        runs=runs,
        schemes=names,
        is_quick=quick,
        is_resumed=resume,
        log=log,
        drives=drives,
        duration_s=duration,
        is_exploring=not is_replay,
        is_plan=plan,
        is_report=report,
    )
    raise typer.Exit(run_bench(options))
