"""`zsched check`: shows what is wrong with a fleet file, or what it says.

Knows: how faults and settings are shown. Does not know: what a fault is (`zsched.config`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.base.common import Json, counted, print_json, say, warn
from zsched.commands.base.options import ConfigOption, JsonOption
from zsched.config.load import check_file
from zsched.core.scheduler.ledger import AHEAD_S, left_after_s
from zsched.core.scheduler.scoring import REACH_MARGIN_DB
from zsched.core.values.deadline import tells_jobs
from zsched.core.values.exits import EXIT_CONFIG, EXIT_OK
from zsched.core.values.fleet import TaskSpec, Timing, fleet_hash
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import Reach, ScoreForm
from zsched.host import paths as places
from zsched.link.sessions.zenoh_file import judged


def check(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="Fleet file; as --config.")] = None,
    config: ConfigOption = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say in words when each task moves.")] = False,
    json_: JsonOption = False,
) -> int:
    """Check a fleet file: all faults that can be judged at once, each with file:line:col; exits with 78 on any.

    Example: zsched check -v fleet.yaml

    A file without fault is one line. With -v it says when each task moves, setting by setting, once for tasks alike.
    """
    result = judged(check_file(places.config_path(file or config, os.environ)))
    fleet = result.fleet
    counts: Json | None = None
    digest = None if fleet is None else fleet_hash(fleet)
    if fleet is not None:
        counts = {"nodes": len(fleet.nodes), "tasks": len(fleet.tasks), "electors": len(fleet.electors)}
    if json_:
        lists = {"faults": result.faults, "warnings": result.warnings}
        keys = ("line", "col", "message", "hint", "source_line")
        found = {name: [{key: getattr(fault, key) for key in keys} for fault in items] for name, items in lists.items()}
        named = None if fleet is None else {"name": fleet.name, **(counts or {})}
        body = {"schema": "zsched.check/1", "file": result.file, "ok": fleet is not None, "hash": digest}
        print_json({**body, "fleet": named, **found})
    elif report := result.report():
        warn(report)
    if counts is None:
        return EXIT_CONFIG
    if json_ or fleet is None:
        return EXIT_OK
    foreign = [task.name for task in fleet.tasks if not task.worker.command]
    yours = f"; you start the workers of {', '.join(foreign)} yourself (no `command`)" if foreign else ""
    said = ", ".join(counted(number, noun) for noun, number in counts.items())
    say(f"ok: {said}; hash {digest}{yours}")
    for first, *more in told_once(fleet.tasks, fleet.timing) if verbose else ():
        say(first)
        for line in more:
            say(f"  {line}", indent=4)
    return EXIT_OK


# --- when tasks move, in words ---------------------------------------------------------------------------------------


LEADS = (0.5, 0.2, 0.1)
"""The leads for which the report says how soon they are followed: a machine that is worth half, and slighter ones."""


def told_once(specs: Iterable[TaskSpec], timing: Timing) -> list[list[str]]:
    """The lines about every task, the names first; tasks with the same lines stand together."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for spec in specs:
        alike.setdefault(tuple(told(spec, timing)), []).append(spec.name)
    return [[f"{'tasks ' * (len(of) > 1)}{', '.join(of)}: {first}", *more] for (first, *more), of in alike.items()]


def told(spec: TaskSpec, timing: Timing) -> list[str]:
    """What a machine is worth, which may have the task, when it moves, how soon."""
    tuning = spec.tuning
    soon = ", ".join(f"{lead:g} {_left(spec, timing, lead)}" for lead in LEADS)
    moves = (
        f"it moves to the machine that owes least once its own one owes {spec.price_s:g} s more (price_s): what it has "
        f"lost there, half of it forgotten in {spec.memory_s:g} s (memory_s), and will lose in {AHEAD_S:g} s"
    )
    how_soon = (
        f"a lead is followed after: {soon}, then gathering, the vote and the commit; its own machine leads by "
        f"{tuning.bonus:g} when all is equal (bonus); at most {spec.max_moves_per_minute} moves a minute"
    )
    return ["; ".join(_worth(spec)), f"not where {'; '.join(_limits(spec))}", moves, how_soon]


def _worth(spec: TaskSpec) -> Iterator[str]:
    """What a machine is worth to the task."""
    tuning = spec.tuning
    is_service = tuning.score is ScoreForm.SERVICE
    worth = "the share of its work that it gets done there" if is_service else "what is left free there (Eq. 1 and 2)"
    is_timed = tuning.deadline_ms is not None and tells_jobs(spec.worker)
    in_time = f" within {tuning.deadline_ms:g} ms (deadline_ms)" if is_timed else ""
    terms = (" x " if is_service else " + ").join(f"{name} {share:g}" for name, share in tuning.weights.shares if share)
    yield f"a machine is worth {worth}{in_time} (score: {tuning.score})"
    yield f"{terms} (weights), the mean of the robots"
    yield from (f"{more:g} more on {node} (prefer)" for node, more in spec.prefer)
    for task, more in spec.beside:
        yield f"{more:g} more beside {task} (together)" if more > 0.0 else f"{-more:g} less beside {task} (spread)"
    if spec.priority:
        yield f"CPU that tasks below {spec.priority} use counts as free (priority)"


def _limits(spec: TaskSpec) -> Iterator[str]:
    """Where the task may not be, beyond what holds for every task."""
    for name, limit in spec.gauge_limits:
        gauge = BY_NAME[name]
        yield f"{gauge.says} is {'below' if gauge.is_floor else 'above'} {gauge.shown(limit)} (limits.{name})"
    yield f"its worker is not ready, the owner's for {spec.worker.start_deadline_s:g} s (start_deadline_s)"
    yield f"{'a robot' if spec.reach is Reach.ALL else 'half of the robots'} cannot reach it (reach)"
    low = spec.limits.nu_dbm
    yield f"the signal is below {low:g} dBm (link.nu_dbm), or {low + REACH_MARGIN_DB:g} while its own one is reached"
    if spec.tuning.weights.network > 0.0:
        yield f"from {spec.limits.rho_dbm:g} dBm on it is worth 1 (link.rho_dbm)"


def _left(spec: TaskSpec, timing: Timing, lead: float) -> str:
    """How soon a lead is followed, in words."""
    if lead <= spec.tuning.bonus:
        return "never"
    return f"in {left_after_s(lead - spec.tuning.bonus, spec.price_s, timing.smoothing_s):.2g} s"
