"""Says in four lines when a task moves, with the keys of `scheduling:`, `limits:` and `link:` that decide it.

Knows: a task's settings, the fleet's timing. Does not know: what a setting means beyond that (the fleet file's guide),
nodes, how anything is printed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from zsched.core.scheduler.ledger import AHEAD_S, left_after_s
from zsched.core.scheduler.scoring import REACH_MARGIN_DB
from zsched.core.values.deadline import tells_jobs
from zsched.core.values.fleet import TaskSpec, Timing
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import Reach, ScoreForm

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
    yield f"{terms} (weights), the robots' {tuning.aggregate} (aggregate)"
    if is_service and tuning.weights.memory > 0.0:
        yield f"less where under {100 * spec.memory_floor_ratio:g} % of the memory stay free (memory_floor_ratio)"
    if is_service and tuning.weights.cpu > 0.0 and spec.cpu_floor_ratio > 0.0:
        yield f"less where under {100 * spec.cpu_floor_ratio:g} % of the CPU stay free (cpu_floor_ratio)"
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
        yield f"from {spec.limits.rho_dbm:g} dBm on it is worth 1 (link.rho_dbm), by the {spec.limits.pair} (link.pair)"


def _left(spec: TaskSpec, timing: Timing, lead: float) -> str:
    """How soon a lead is followed, in words."""
    if lead <= spec.tuning.bonus:
        return "never"
    return f"in {left_after_s(lead - spec.tuning.bonus, spec.price_s, timing.smoothing_s):.2g} s"
