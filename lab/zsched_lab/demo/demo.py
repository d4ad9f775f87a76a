"""`zsched demo`: three robots and three edges merge real laser maps, and the merging moves as machines get busy.

Knows: options, exit codes, and how a run ends at any moment. Does not know: what happens in a run (`demo_run`).
"""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from zsched.core.values.errors import ConfigError, ZschedError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE
from zsched_lab.demo.evaluate import evaluate, print_summary
from zsched_lab.demo.live_view import make_view
from zsched_lab.demo.run import DemoRun, RunPlan
from zsched_lab.fleet.children import Children
from zsched_lab.fleet.schedule import SchedulePolicy
from zsched_lab.fleet.signals import Interrupted, interruptible
from zsched_lab.maps.laser_log import load_log, malaga_path

MODES = ("known", "track", "estimate")
MIN_DURATION_S, MAX_DURATION_S = 20.0, 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What the command line gives; ``out`` and ``log`` have their defaults in the run."""

    headless: bool = False
    out: Path | None = None
    log: Path | None = None
    duration_s: float = 60.0
    mode: str = "known"
    seed: int = 1
    policy: SchedulePolicy = SchedulePolicy.PUSH


def run_demo(options: DemoOptions) -> int:
    """Run the demo; returns the exit code: 0, 1 failed, 2 usage, 78 bad file, 128 + n after signal n.

    Whatever happens, no process, control group, socket or shared memory of the run is left when it returns (and a
    moment after this process is killed).
    """
    wrong = usage_fault(options)
    if wrong:
        complain(wrong)
        return EXIT_USAGE
    out = options.out or Path(f"zsched-demo-{datetime.now().astimezone():%Y%m%d-%H%M%S}")
    try:
        with interruptible():
            return run(options, out.absolute())
    except Interrupted as interrupted:
        name = signal.Signals(interrupted.number).name
        complain(f"ended by {name}; nothing is left running, records so far are in {out}")
        return EXIT_SIGNAL + interrupted.number
    except ConfigError as error:
        complain(str(error))
        return EXIT_CONFIG
    except (ZschedError, OSError) as error:
        complain(f"{error}\nlogs are in {out / 'logs'}")
        return EXIT_FAILED


def run(options: DemoOptions, out: Path) -> int:
    """Run, clean up, then work the figures out with the machine to ourselves."""
    log_path = (options.log or malaga_path()).absolute()
    log = load_log(log_path)
    plan = RunPlan(
        out=out,
        log_path=log_path,
        log=log,
        duration_s=options.duration_s,
        mode=options.mode,
        seed=options.seed,
        policy=options.policy,
    )
    plan.records.mkdir(parents=True, exist_ok=True)
    with Children(out / "logs") as children, make_view(headless=options.headless) as view:
        facts = DemoRun(plan, children, view).run()
    for item in children.left_behind:
        complain(f"could not remove {item}")
    summary = evaluate(facts)
    print_summary(summary, out)
    if summary["merges"] == 0:
        complain(f"no merged map reached any robot; see {out / 'logs'}")
        return EXIT_FAILED
    return 0


def usage_fault(options: DemoOptions) -> str | None:
    """What is wrong with the options, if anything."""
    if options.mode not in MODES:
        return f"--mode {options.mode}: choose one of {', '.join(MODES)}"
    if not MIN_DURATION_S <= options.duration_s <= MAX_DURATION_S:
        return f"--duration {options.duration_s:g}: give {MIN_DURATION_S:g} to {MAX_DURATION_S:g} seconds"
    return None if options.out is None else _folder_fault(options.out)


def _folder_fault(out: Path) -> str | None:
    """Why the run's files cannot be written there, if so; touches nothing."""
    try:
        if out.exists() and any(out.iterdir()):
            return f"--out {out}: the folder is not empty; name a new one, nothing is overwritten"
        there = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    except OSError as error:
        return f"--out {out}: {error.strerror}; name a folder that you may write into"
    if there.is_dir() and os.access(there, os.W_OK | os.X_OK):
        return None
    why = "you may not write there" if there.is_dir() else "it is no folder"
    return f"--out {out}: {there}: {why}; name another folder"


def complain(text: str) -> None:
    """One error for people, on stderr."""
    sys.stderr.write(f"zsched demo: {text}\n")
