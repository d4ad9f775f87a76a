"""What two fleet files of one fleet may differ in: one function for each, by chance.

Knows: fleet files. Does not know: which node has which (`zsched_lab.sim.rollout`).
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from zsched.config.timing import PROFILES
from zsched.core.values.fleet import Fleet, OnIsolation, Standby, StreamRule, TaskSpec
from zsched.core.values.model import ScoreForm, Weights
from zsched.core.values.plan import Direction
from zsched.core.values.struct import replace

Change = Callable[[Random, Fleet], Fleet]


def other_electors(rng: Random, fleet: Fleet) -> Fleet:
    """The same fleet file with an electorate that differs."""
    names = tuple(node.name for node in fleet.nodes)
    others = tuple(sorted(rng.sample(names, rng.randint(1, len(names)))))
    return replace(fleet, electors=others if others != fleet.electors else names[:1])


def _with_task(fleet: Fleet, change: Callable[[TaskSpec], TaskSpec]) -> Fleet:
    return replace(fleet, tasks=(change(fleet.tasks[0]), *fleet.tasks[1:]))


def _other_exclusive(_rng: Random, fleet: Fleet) -> Fleet:
    """Not of a task that a robot which is cut off may work at alone: that has to be changed first."""
    is_held = fleet.tasks[0].on_isolation is OnIsolation.HOLD
    return _with_task(fleet, lambda task: replace(task, exclusive=task.exclusive is not is_held))


def _other_timing(rng: Random, fleet: Fleet) -> Fleet:
    timing = PROFILES[rng.choice([name for name in PROFILES if name != fleet.timing.name])]
    decide_s = max(timing.decide_s, fleet.timing.decide_s)
    return replace(fleet, timing=replace(timing, sample_s=fleet.timing.sample_s, decide_s=decide_s))


def _other_weights(rng: Random, fleet: Fleet) -> Fleet:
    cpu = rng.choice((0.0, 0.25, 0.75, 1.0))
    weights = Weights(cpu=cpu, memory=1.0 - cpu, network=0.0)
    return _with_task(fleet, lambda task: replace(task, tuning=replace(task.tuning, weights=weights)))


def _other_candidates(rng: Random, fleet: Fleet) -> Fleet:
    names = [node.name for node in fleet.nodes]
    chosen = tuple(sorted(rng.sample(names, rng.randint(2, len(names)))))
    return _with_task(fleet, lambda task: replace(task, candidates=chosen))


def _other_limits(rng: Random, fleet: Fleet) -> Fleet:
    moves, drain_s = rng.choice((2, 60)), rng.choice((0.1, 1.0, 2.0))
    return _with_task(fleet, lambda task: replace(task, max_moves_per_minute=moves, drain_s=drain_s))


def _other_tasks(_rng: Random, fleet: Fleet) -> Fleet:
    """A second task comes, or goes."""
    if len(fleet.tasks) > 1:
        return replace(fleet, tasks=fleet.tasks[1:])
    return replace(fleet, tasks=(replace(fleet.tasks[0], name="extra"), *fleet.tasks))


def _other_isolation(_rng: Random, fleet: Fleet) -> Fleet:
    """Robots may work alone, or may not any more; `zsched check` refuses the first for an exclusive task."""
    task = fleet.tasks[0]
    may_work = task.on_isolation is OnIsolation.HOLD and not task.exclusive
    return _with_task(
        fleet, lambda task: replace(task, on_isolation=OnIsolation.LOCAL if may_work else OnIsolation.HOLD)
    )


def _other_worker(rng: Random, fleet: Fleet) -> Fleet:
    """Warm or cold, more or less time to start, fewer failures until it is given up, watched for its output.

    One that somebody else runs stays warm, and always gets another time.
    """
    is_ours = bool(fleet.tasks[0].worker.command)
    standby = Standby.COLD if is_ours and fleet.tasks[0].worker.standby is Standby.WARM else Standby.WARM
    deadline_s = rng.choice((2.0, 3.0, 5.0) if is_ours else (2.0, 4.0, 5.0))
    failures, silence_s = rng.choice((1, 3)), rng.choice((None, 3.0))
    worker = replace(
        fleet.tasks[0].worker,
        standby=standby,
        start_deadline_s=deadline_s,
        max_failures=failures,
        output_deadline_s=silence_s,
    )
    return _with_task(fleet, lambda task: replace(task, worker=worker))


def _other_score(rng: Random, fleet: Fleet) -> Fleet:
    """Another form, with or without a deadline, and another price of a move."""
    score, deadline_ms = rng.choice(((ScoreForm.PAPER, None), (ScoreForm.SERVICE, None), (ScoreForm.SERVICE, 500.0)))
    price_s = rng.choice((0.1, 0.3))

    def changed(task: TaskSpec) -> TaskSpec:
        tuning = replace(task.tuning, score=score, deadline_ms=deadline_ms)
        return replace(task, tuning=tuning, price_s=price_s)

    return _with_task(fleet, changed)


def _other_streams(rng: Random, fleet: Fleet) -> Fleet:
    """A stream more, or another place for it, or none."""
    kept = rng.choice(((), ("in",), ("{task}/in",)))
    rules = tuple(
        StreamRule(direction=Direction.INPUT, from_template="{robot}/in", to_template=f"{{target}}/{place}/{{robot}}")
        for place in kept
    )
    return _with_task(fleet, lambda task: replace(task, rules=rules))


CHANGES: dict[str, Change] = {
    "exclusive": _other_exclusive,
    "timing": _other_timing,
    "weights": _other_weights,
    "candidates": _other_candidates,
    "electors": other_electors,
    "limits": _other_limits,
    "tasks": _other_tasks,
    "isolation": _other_isolation,
    "worker": _other_worker,
    "score": _other_score,
    "streams": _other_streams,
}
"""In the order of a fault's size."""


def _other_command(rng: Random, fleet: Fleet) -> Fleet:
    """The workers run by another command."""
    command = ("work", f"--version={rng.randrange(10**6)}")
    return _with_task(fleet, lambda task: replace(task, worker=replace(task.worker, command=command)))


def _other_times(rng: Random, fleet: Fleet) -> Fleet:
    """Other times, with the same length of leases: that one needs a restart of all, and bounds beats and silence."""
    timing = fleet.timing
    times = replace(
        timing,
        beat_s=timing.beat_s * rng.choice((0.5, 0.75, 1.0)),
        suspect_s=timing.suspect_s * rng.choice((1.0, 1.5, 2.0)),
        decide_s=timing.decide_s * rng.choice((1.0, 1.5)),
    )
    return replace(fleet, timing=times)


RELOADED: dict[str, Change] = {
    **{name: change for name, change in CHANGES.items() if name != "electors"},
    "timing": _other_times,
    "command": _other_command,
}
"""What a file that running nodes take over may differ in, in the order of a fault's size."""
