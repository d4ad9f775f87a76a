"""Says in words when a task moves: every setting of `scheduling:`, and what it does.

Knows: a task's settings. Does not know: the fleet file, nodes, how anything is printed.
"""

from __future__ import annotations

from collections.abc import Iterable

from zsched.core.scheduler.patience import CHOICES
from zsched.core.scheduler.utility import NEARLY_FULL
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import ScoreForm


def told_once(specs: Iterable[TaskSpec]) -> list[list[str]]:
    """What is told of every task, the names first, and once for all tasks of which the same is told."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for spec in specs:
        alike.setdefault(tuple(told(spec)), []).append(spec.name)
    return [[f"{_named(names)}: {first}", *more] for (first, *more), names in alike.items()]


def _named(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"tasks {', '.join(names)}"


def told(spec: TaskSpec) -> list[str]:
    """One sentence per setting."""
    tuning, weights = spec.tuning, spec.tuning.weights
    is_service = tuning.score is ScoreForm.SERVICE
    shares = ", ".join(f"{name} {getattr(weights, name):g}" for name in ("cpu", "memory", "network"))
    worth = "the share of its work that it gets done there" if is_service else "what is left free there (Eq. 1 and 2)"
    floor = f"{100 * spec.memory_floor_ratio:g} %"
    seconds = "s of its work" if is_service else "utility seconds"
    lines = [f"a machine is worth {worth}; weights: {shares}"]
    if spec.learns_patience:
        when = f"staying has cost its patience, which it learns ({CHOICES[0]:g} to {CHOICES[-1]:g} {seconds})"
    else:
        when = f"staying has cost {spec.patience:g} {seconds} (patience)"
    lines.append(f"it moves when another candidate leads by more than {tuning.bonus:g} (bonus) and {when}")
    lines.append(f"after a move it stays {tuning.cool_down_s:g} s at least (cool_down_s), unless its owner fails")
    lines.append(f"it moves {spec.max_moves_per_minute} times a minute at most (max_moves_per_minute), failures aside")
    if is_service:
        less = f"counts up to {100 * NEARLY_FULL:g} % less"
        lines.append(f"a machine that it leaves less than {floor} of the memory free {less} (memory_floor_ratio)")
    else:
        lines.append(f"an owner with less than {floor} of its memory free is left at once (memory_floor_ratio)")
    if tuning.deadline_ms is not None:
        lines.append(LATENCY.format(deadline=f"{tuning.deadline_ms:g}"))
    if weights.network > 0.0:
        lines.append(f"signals count as they will be in {spec.limits.foresee_s:g} s (link.foresee_s)")
    lines.append(f"a candidate counts that {_REACH[spec.reach.value]} (reach); the robots' {tuning.aggregate} decides")
    return lines


LATENCY = (
    "objective latency: a machine is worth the share of jobs that it is expected to do within {deadline} ms, "
    "by its worker's word of them (CPU per job over the machine's speed and what is free there, and what a job waits "
    "for otherwise) and the measured way there and back"
)
_REACH = {"majority": "most robots reach", "all": "all robots reach"}
