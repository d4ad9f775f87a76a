"""Says in words when a task moves: every setting of `scheduling:` and `link:`, and what it does.

Knows: a task's settings, the fleet's timing. Does not know: the fleet file, nodes, how anything is printed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from zsched.core.scheduler.fuse import ESCAPES_PER_MINUTE
from zsched.core.scheduler.ledger import AHEAD_S, left_after_s
from zsched.core.scheduler.scoring import REACH_MARGIN_DB
from zsched.core.scheduler.utility import NEARLY_FULL
from zsched.core.values.deadline import tells_jobs
from zsched.core.values.fleet import TaskSpec, Timing
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import PairReading, ScoreForm, Tuning

LEADS = (0.5, 0.1)
"""The leads for which the report says how soon they are followed: a machine that is worth half, and a slight one."""


def told_once(specs: Iterable[TaskSpec], timing: Timing) -> list[list[str]]:
    """The sentences about every task, the names first; tasks with the same sentences stand together."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for spec in specs:
        alike.setdefault(tuple(told(spec, timing)), []).append(spec.name)
    return [[f"{_named(names)}: {first}", *more] for (first, *more), names in alike.items()]


def _named(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"tasks {', '.join(names)}"


def told(spec: TaskSpec, timing: Timing) -> list[str]:
    """One sentence per setting, each with its key in the fleet file."""
    return [*_worth(spec), *_when(spec, timing), *_links(spec)]


def _worth(spec: TaskSpec) -> Iterator[str]:
    """What a machine is worth to the task."""
    tuning = spec.tuning
    is_service = tuning.score is ScoreForm.SERVICE
    worth = "the share of its work that it gets done there" if is_service else "what is left free there (Eq. 1 and 2)"
    yield f"a machine is worth {worth} (score: {tuning.score})"
    yield from _weighed(tuning)
    if tuning.deadline_ms is not None and tells_jobs(spec.worker):
        yield LATENCY.format(deadline=f"{tuning.deadline_ms:g}")
    elif is_service:
        yield "it wants as many of its jobs done as possible, late ones too (objective: service)"
    floor = f"{100 * spec.memory_floor_ratio:g} %"
    if is_service:
        less = f"counts up to {100 * NEARLY_FULL:g} % less"
        if tuning.weights.memory > 0.0:
            yield f"a machine that it leaves less than {floor} of the memory free {less} (memory_floor_ratio)"
        of_cpu = f"{100 * spec.cpu_floor_ratio:g} %"
        if tuning.weights.cpu > 0.0 and spec.cpu_floor_ratio > 0.0:
            yield f"a machine that it leaves less than {of_cpu} of the CPU free {less} (cpu_floor_ratio)"
        elif tuning.weights.cpu > 0.0:
            yield "what programs that are no tasks would still get there does not count (cpu_floor_ratio: 0)"
    for name, limit in spec.gauge_limits:
        gauge = BY_NAME[name]
        side, unknown = ("below" if gauge.is_floor else "above"), ("refused" if gauge.is_needed else "taken")
        left = "is not taken, an owner stays" if name == "gpu" and not spec.demand.gpu else "is left, or not taken"
        told = f"a machine with {gauge.says} {side} {gauge.shown(limit)} {left} (limits.{name})"
        yield f"{told}; one where it is not measured is {unknown}"
    reach = f"a candidate counts that {_REACH[spec.reach.value]} (reach)"
    yield f"{reach}; the robots' {tuning.aggregate} decides (aggregate)"


def _weighed(tuning: Tuning) -> Iterator[str]:
    """How the terms become one figure, what a weight does, and what the term of a gauge is."""
    weights = tuning.weights
    shares = ", ".join(f"{name} {weight:g}" for name, weight in weights.shares)
    counting = [(name, weight) for name, weight in weights.shares if weight > 0.0]
    if tuning.score is ScoreForm.SERVICE:
        most = max(weight for _, weight in counting)
        falls = ", ".join(f"{weight / most:.2g} % for {name}" for name, weight in counting)
        yield (
            "the terms of what has a weight are multiplied, so plenty of one makes up for no lack of another; where a "
            f"term falls by 1 %, the worth falls by {falls} (weights: {shares})"
        )
    else:
        yield (
            "the terms are added, each times its weight, so plenty of one makes up for a lack of another "
            f"(weights: {shares})"
        )
    for name, _ in counting:
        if name in BY_NAME:
            gauge = BY_NAME[name]
            unknown = "cannot have the task while another one has it" if gauge.is_needed else "counts 1"
            ends = f"1 at {gauge.shown(gauge.best)} and 0 at {gauge.shown(gauge.worst)}"
            yield f"the term of {name} is {gauge.says}, {ends}; a machine where it is not measured {unknown}"


def _when(spec: TaskSpec, timing: Timing) -> Iterator[str]:
    """When a lead is followed."""
    tuning = spec.tuning
    yield (
        f"it moves to the machine that owes least once its own one owes {spec.price_s:g} s more (price_s): what it has "
        f"lost there, half of it forgotten in {spec.memory_s:g} s (memory_s), and will lose in {AHEAD_S:g} s; what its "
        f"own one is worth counts {tuning.bonus:g} more (bonus)"
    )
    followed = "; ".join(f"by {lead:g} {_left(spec, timing, lead)}" for lead in LEADS)
    yield f"it leaves an owner that a load puts behind another candidate {followed}; {ON_TOP}"
    yield f"it moves at most {spec.max_moves_per_minute} times a minute, from failures {ESCAPES_PER_MINUTE} times"


def _left(spec: TaskSpec, timing: Timing, lead: float) -> str:
    """How soon a lead is followed, in words."""
    if lead <= spec.tuning.bonus:
        return "never"
    return f"after about {left_after_s(lead - spec.tuning.bonus, spec.price_s, timing.smoothing_s):.2g} s"


def _links(spec: TaskSpec) -> Iterator[str]:
    """What a signal is worth; of nodes on cables it says nothing."""
    limits = spec.limits
    yield f"a robot does not reach a candidate whose signal is below {limits.nu_dbm:g} dBm (link.nu_dbm)"
    least = f"{limits.nu_dbm + REACH_MARGIN_DB:g} dBm"
    yield f"while the owner is reached, another one's own signal counts from {least} on, so it moves a task once"
    if spec.tuning.weights.network > 0.0:
        yield f"a signal is worth 0 at {limits.nu_dbm:g} dBm and 1 from {limits.rho_dbm:g} dBm on (link.rho_dbm)"
        yield f"through one access point {_PAIR[limits.pair]} counts (link.pair: {limits.pair})"


ON_TOP = (
    "that is smoothing and the price alone: sampling, gathering, the vote and the commit come on top (with the "
    "defaults 0.7 to 3.0 s were seen from a real load to the move)"
)
LATENCY = (
    "objective latency: of the work that it gets done there the share counts that is expected within {deadline} ms "
    "(deadline_ms), by its worker's word of its jobs (CPU per job over the machine's speed and what is free there, or "
    "its fair share if that is more; its usual queue, and what a job waits for otherwise; what it got there before) "
    "and the measured way there and back; late work counts a tenth"
)
_REACH = {"majority": "most robots reach", "all": "all robots reach"}
_PAIR = {PairReading.CANDIDATE: "the candidate's way alone", PairReading.WEAKER: "the weaker of the two ways"}
