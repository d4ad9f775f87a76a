"""Schedules by seed: each seed enables its own random subset of faults, sizes and fleets (swarm testing).

Knows: which fleets and faults there are, and how a seed becomes a `Plan`. Does not know: how a fault is carried out
(`zsched_lab.sim.faults`), what must hold.

A plan does not depend on what happens in it: leaving faults out (shrinking) leaves the others as they are.
Swarm testing: Groce et al., ISSTA 2012.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from zsched.config.timing import WAN, WIFI, WIRED
from zsched.core.values.fleet import Fleet, NodeSpec, OnIsolation, Standby, TaskSpec, WorkerSpec
from zsched.core.values.model import NodeId, NodeKind, Tuning, Weights
from zsched.core.values.struct import replace
from zsched_lab.sim.clocks import clock_faults, suspensions
from zsched_lab.sim.files import CHANGES, RELOADED
from zsched_lab.sim.foreign import absences, with_foreign_workers
from zsched_lab.sim.many import with_many_tasks
from zsched_lab.sim.orders import order_faults

SECONDS = 30.0
"""Virtual seconds of one schedule: faults in the first half, then quiet."""
SAMPLE_S = 1.0
DECIDE_S = (0.5, 1.0, 1.0)
"""Machines measure, and robots look around, less often than by default: schedules are about what happens between."""
MIN_NODES, MAX_NODES = 3, 7
LEASE_EVERY, LEASE_OFFSET = 4, 2
"""Every fourth seed is about leases: an exclusive task of few candidates that moves often under their faults."""
CPU_ONLY = Weights(cpu=1.0, memory=0.0, network=0.0)
LEASE_KINDS = ("cut", "one_way", "pause", "kill", "storm", "spike", "delay", "replay", "partial", "clock", "slow")
"""What leases hang on: silence, restarts, late messages, clocks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault: from ``at`` on (seconds after the start) for ``seconds``, on ``nodes``, ``size`` strong."""

    at: float
    kind: str
    nodes: tuple[NodeId, ...] = ()
    seconds: float = 0.0
    size: float = 0.0

    def __str__(self) -> str:
        return f"{self.at:6.2f} {self.kind} {','.join(self.nodes)} for {self.seconds:.2f} s, size {self.size:.4g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One schedule: the fleet, what goes wrong in it, and how long it takes."""

    seed: int
    fleet: Fleet
    faults: tuple[Fault, ...]
    seconds: float = SECONDS
    generation: int = 0
    """The generation that the fleet begins with."""


def plan(seed: int, *, nodes: int | None = None, seconds: float = SECONDS, kinds: frozenset[str] | None = None) -> Plan:
    """The schedule of a seed.

    Args:
        seed: any whole number.
        nodes: the fleet's size, 3 to 7 (``None``: by seed).
        seconds: virtual seconds; faults begin in the first half only.
        kinds: which of `KINDS` there may be (``None``: all but `PENDING`).
    """
    rng, later, until = Random(f"schedule {seed}"), Random(f"later {seed}"), seconds / 2
    fleet = _fleet(rng, nodes or rng.randint(MIN_NODES, MAX_NODES))
    is_leased = seed % LEASE_EVERY == LEASE_OFFSET
    if is_leased:
        fleet = _leased(rng, fleet)
    fleet = with_many_tasks(Random(f"many {seed}"), fleet)
    kinds = KINDS - PENDING if kinds is None else kinds
    faults = (_lease_faults if is_leased else _faults)(rng, fleet, until)
    fleet, generation = _varied(later, fleet)
    faults += _later_faults(later, fleet, until, kinds, fleet.tasks[0].candidates if is_leased else ())
    for at, name, slewed_s, size in clock_faults(Random(f"clocks {seed}"), fleet, until):
        faults += (Fault(at=at, kind="slew", nodes=(name,), seconds=slewed_s, size=size),)
    suspends = suspensions(Random(f"suspended {seed}"), fleet, until) if "suspend" in kinds else ()
    for at, name, slept_s, size in suspends:
        faults += (Fault(at=at, kind="suspend", nodes=(name,), seconds=slept_s, size=size),)
    if is_leased and "rollout" in kinds and later.random() < 0.25:
        fleet, rollout = _made_exclusive(later, fleet)
        faults += (rollout,)
    if "reload" in kinds:
        faults += _reloads(Random(f"reload {seed}"), fleet, until)
    others = Random(f"foreign {seed}")
    fleet = with_foreign_workers(others, fleet)
    for at, name, away_s in absences(others, fleet, until):
        faults += (Fault(at=at, kind="absence", nodes=(name,), seconds=away_s),)
    for at, name, size in order_faults(Random(f"orders {seed}"), fleet, until):
        faults += (Fault(at=at, kind="order", nodes=(name,), size=size),)
    faults = tuple(sorted(faults, key=lambda fault: (fault.at, fault.kind, fault.nodes)))
    return Plan(seed=seed, fleet=fleet, faults=faults, seconds=seconds, generation=generation)


# --- fleets ----------------------------------------------------------------------------------------------------------


def _fleet(rng: Random, size: int) -> Fleet:
    robots = size if rng.random() < 0.3 else rng.randint(2, size - 1)
    names = {f"robot{i}": NodeKind.ROBOT for i in range(1, robots + 1)}
    names |= {f"edge{i}": NodeKind.EDGE for i in range(1, size - robots + 1)}
    voters = tuple(name for name, kind in names.items() if kind is NodeKind.ROBOT)
    edges = tuple(name for name in names if name not in voters)
    spare = 3 - robots if robots < 3 else (1 if edges and rng.random() < 0.15 else 0)
    timing = rng.choices((WIFI, WIRED, WAN), (14, 4, 2))[0]
    tasks = tuple(
        _task(rng, name, voters, edges) for name in (("guard", "merge") if rng.random() < 0.25 else ("merge",))
    )
    return Fleet(
        name="sim",
        timing=replace(timing, sample_s=SAMPLE_S, decide_s=max(timing.decide_s, rng.choice(DECIDE_S))),
        nodes=tuple(NodeSpec(name=name, kind=kind) for name, kind in sorted(names.items())),
        tasks=tasks,
        electors=tuple(sorted((*voters, *edges[:spare]))),
    )


def _task(rng: Random, name: str, voters: tuple[NodeId, ...], edges: tuple[NodeId, ...]) -> TaskSpec:
    candidates = edges if len(edges) >= 2 and rng.random() < 0.8 else (*voters, *edges)
    is_cold = rng.random() < 0.1
    is_exclusive = rng.random() < 0.4
    is_local = not is_exclusive and rng.random() < 0.2
    bonus, price_s = rng.choice((0.0, 0.1)), rng.choice((0.0, 0.05, 0.3))
    rng.choice((0, 1))  # of a setting that is no more: so a seed plays the same schedule as before
    return TaskSpec(
        name=name,
        candidates=tuple(sorted(candidates)),
        tuning=Tuning(
            weights=Weights(cpu=0.5, memory=0.5, network=0.0),
            bonus=bonus,
        ),
        price_s=price_s,
        worker=WorkerSpec(command=("work",), standby=Standby.COLD if is_cold else Standby.WARM, start_deadline_s=3.0),
        exclusive=is_exclusive,
        on_isolation=OnIsolation.LOCAL if is_local else OnIsolation.HOLD,
        drain_s=rng.choice((0.1, 1.0)),
        max_moves_per_minute=rng.choice((2, 60)),
    )


def _leased(rng: Random, fleet: Fleet) -> Fleet:
    """The same fleet with exclusive tasks that want to move: few candidates, electors among them."""
    names, candidates = [node.name for node in fleet.nodes], set(rng.sample(fleet.electors, 1))
    candidates |= set(rng.sample(names, rng.choice((1, 2, 2))))
    while len(candidates) < 2:
        candidates.add(rng.choice(names))
    tasks = tuple(
        replace(
            task,
            candidates=tuple(sorted(candidates)),
            tuning=replace(task.tuning, weights=CPU_ONLY, bonus=0.0),
            price_s=0.0,
            worker=replace(task.worker, standby=Standby.WARM),
            exclusive=True,
            on_isolation=OnIsolation.HOLD,
            max_moves_per_minute=60,
        )
        for task in fleet.tasks[:1]
    )
    quick = replace(fleet.timing, decide_s=max(fleet.timing.gather_s, 0.5), smoothing_s=SAMPLE_S)
    return replace(fleet, tasks=tasks, timing=quick)


def _varied(rng: Random, fleet: Fleet) -> tuple[Fleet, int]:
    """Some fleets are in a later generation; in some the edges alone are electors, so that no robot is needed."""
    generation = rng.choice((0, 0, 1, 2))
    edges = tuple(node.name for node in fleet.nodes if node.kind is NodeKind.EDGE)
    if edges and rng.random() < 0.15:
        fleet = replace(fleet, electors=edges)
    return fleet, generation


# --- faults ----------------------------------------------------------------------------------------------------------

Maker = Callable[[Random, Fleet, float], list[Fault]]
"""(chance, fleet, how long faults may begin) -> some faults of one kind."""


def _faults(rng: Random, fleet: Fleet, until: float) -> tuple[Fault, ...]:
    """A random subset of the kinds, each a few times; in about one schedule of twenty nothing goes wrong."""
    share = rng.choice((0.0, 0.15, 0.3, 0.3, 0.5, 0.7))
    found: list[Fault] = []
    for make in MAKERS.values():
        if rng.random() < share:
            found += make(rng, fleet, until)
    found += _load(rng, fleet, until)
    return tuple(sorted(found, key=lambda fault: (fault.at, fault.kind, fault.nodes)))


def _lease_faults(rng: Random, fleet: Fleet, until: float) -> tuple[Fault, ...]:
    """Faults of the candidates, cuts with other electors on their side too, and loads that push the task around."""
    candidates = fleet.tasks[0].candidates
    found: list[Fault] = []
    for kind in LEASE_KINDS:
        if rng.random() < 0.4:
            found += [_at_candidate(rng, fault, candidates) for fault in MAKERS[kind](rng, fleet, until)]
    pushes = rng.randint(4, 12)
    for number in range(pushes):
        at = until * (number + rng.random()) / pushes
        busy = rng.choice(candidates)
        found += [Fault(at=at, kind="load", nodes=(name,), size=0.95 if name == busy else 0.05) for name in candidates]
    return tuple(sorted(found, key=lambda fault: (fault.at, fault.kind, fault.nodes)))


def _made_exclusive(rng: Random, fleet: Fleet) -> tuple[Fleet, Fault]:
    """The task becomes exclusive only on the way, node by node."""
    tasks = tuple(replace(task, exclusive=False) for task in fleet.tasks)
    rollout = Fault(
        at=rng.uniform(1.0, 5.0), kind="rollout", nodes=(fleet.nodes[0].name,), seconds=rng.uniform(1.0, 30.0)
    )
    return replace(fleet, tasks=tasks), rollout


def _later_faults(
    rng: Random, fleet: Fleet, until: float, kinds: frozenset[str], candidates: tuple[NodeId, ...]
) -> tuple[Fault, ...]:
    """A random subset of `LATER`, in every second schedule; with chances of their own, so that no other fault moves."""
    share = rng.choice((0.0, 0.0, 0.1, 0.25))
    found: list[Fault] = []
    for kind, make in LATER.items():
        is_likely = kind == "amnesia" and not set(fleet.electors) & set(fleet.voters)  # they remember without robots
        is_chosen, chance = rng.random() < (0.5 if is_likely else share), Random(rng.random())
        if is_chosen and kind in kinds:
            faults = make(chance, fleet, until)
            found += [_at_candidate(chance, fault, candidates) for fault in faults] if candidates else faults
    return tuple(found)


def _reloads(rng: Random, fleet: Fleet, until: float) -> tuple[Fault, ...]:
    """In one schedule of six running nodes take another fleet file over, once or twice."""
    if rng.random() < 5 / 6:
        return ()
    return tuple(
        _one_node("reload", 2, 8.0, tuple(float(number) for number in range(len(RELOADED))))(rng, fleet, until)
    )


def _at_candidate(rng: Random, fault: Fault, candidates: tuple[NodeId, ...]) -> Fault:
    """The same fault, mostly of a candidate; one node's is often short enough to end within a lease."""
    if not fault.nodes or rng.random() < 0.3:
        return fault
    if len(fault.nodes) > 1:
        others = tuple(name for name in fault.nodes if name not in candidates)
        return replace(fault, nodes=(rng.choice(candidates), *others))
    seconds = rng.choice((fault.seconds, rng.uniform(0.02, 0.6)))
    return replace(fault, nodes=(rng.choice(candidates),), seconds=fault.seconds if fault.kind == "pause" else seconds)


def _names(fleet: Fleet) -> list[NodeId]:
    return [node.name for node in fleet.nodes]


def _air(kind: str, sizes: tuple[float, ...]) -> Maker:
    """Something about every message, for a while or from the start."""

    def make(rng: Random, _fleet: Fleet, until: float) -> list[Fault]:
        at = rng.choice((0.0, rng.uniform(0.0, until)))
        return [Fault(at=at, kind=kind, seconds=rng.uniform(1.0, until), size=rng.choice(sizes))]

    return make


def _one_node(kind: str, most: int, longest: float, sizes: tuple[float, ...] = (0.0,)) -> Maker:
    """One to ``most`` times something about one node, each for up to ``longest`` seconds."""

    def make(rng: Random, fleet: Fleet, until: float) -> list[Fault]:
        return [
            Fault(
                at=rng.uniform(0.0, until),
                kind=kind,
                nodes=(rng.choice(_names(fleet)),),
                seconds=10 ** rng.uniform(-1.5, 0.0) * longest,
                size=rng.choice(sizes),
            )
            for _ in range(rng.randint(1, most))
        ]

    return make


def _cuts(kind: str, fewest: int, most: int) -> Maker:
    """Cuts that concern some nodes, for up to 6 s."""

    def make(rng: Random, fleet: Fleet, until: float) -> list[Fault]:
        names = _names(fleet)
        return [
            Fault(
                at=rng.uniform(0.0, until),
                kind=kind,
                nodes=tuple(rng.sample(names, rng.randint(fewest, min(most, len(names) - 1)))),
                seconds=rng.uniform(0.1, 6.0),
                size=rng.random(),
            )
            for _ in range(rng.randint(1, 3))
        ]

    return make


def _bursts(rng: Random, fleet: Fleet, until: float) -> list[Fault]:
    """Some nodes' links deliver in bursts."""
    return [replace(fault, size=rng.choice((0.05, 0.2, 0.6))) for fault in _cuts("burst", 1, 3)(rng, fleet, until)]


def _clocks(rng: Random, fleet: Fleet, until: float) -> list[Fault]:
    """Every clock runs at its own rate: within the lease's bound, or far beyond it where nothing is exclusive."""
    is_leased = any(task.exclusive for task in fleet.tasks)
    bound = 0.0009 if is_leased else rng.choice((0.001, 0.2))
    found = [
        Fault(at=0.0, kind="clock_rate", nodes=(name,), size=1.0 + rng.uniform(-bound, bound)) for name in _names(fleet)
    ]
    jumps = 0 if is_leased else rng.randint(0, 2)
    for _ in range(jumps):
        jump_s = 10 ** rng.uniform(-2.0, 3.0)
        found.append(
            Fault(at=rng.uniform(0.0, until), kind="clock_jump", nodes=(rng.choice(_names(fleet)),), size=jump_s)
        )
    return found


def _load(rng: Random, fleet: Fleet, until: float) -> list[Fault]:
    """Machines get busier or idler, so that robots want to move the tasks."""
    return [
        Fault(
            at=rng.uniform(0.0, until),
            kind="load",
            nodes=(rng.choice(_names(fleet)),),
            size=rng.choice((0.05, 0.3, 0.6, 0.95)),
        )
        for _ in range(rng.randint(0, 4))
    ]


MAKERS: dict[str, Maker] = {
    "loss": _air("loss", (0.02, 0.1, 0.3)),
    "delay": _air("delay", (0.02, 0.1, 0.3)),
    "duplicate": _air("duplicate", (0.05, 0.3)),
    "spike": _air("spike", (0.3, 1.0, 3.0)),
    "mutate": _air("mutate", (0.02, 0.2)),
    "forge": _air("forge", (0.02, 0.1)),
    "replay": _air("replay", (0.02, 0.1)),
    "cut": _cuts("cut", 1, 4),
    "one_way": _cuts("one_way", 1, 2),
    "partial": _cuts("partial", 2, 2),
    "version": _cuts("version", 1, 2),
    "pause": _one_node("pause", 3, 5.0),
    "kill": _one_node("kill", 4, 5.0),
    "power": _one_node("power", 3, 5.0),
    "blackout": _one_node("blackout", 1, 3.0),
    "damage": _one_node("damage", 2, 2.0),
    "wipe": _one_node("wipe", 2, 2.0),
    "storm": _one_node("storm", 2, 4.0),
    "prefix": _air("prefix", (0.02, 0.1, 0.3)),
    "slow": _one_node("slow", 2, 6.0, (0.001, 0.005, 0.02)),
    "slow_disk": _one_node("slow_disk", 3, 10.0, (0.005, 0.02, 0.1)),
    "full_disk": _one_node("full_disk", 2, 5.0),
    "clock": _clocks,
    "twin": _one_node("twin", 1, 8.0),
    "electorate": _one_node("electorate", 1, 5.0),
    "worker": _one_node("worker", 4, 3.0, (0.0, 1.0)),
    "retune": _one_node("retune", 6, 1.0, (0.2, 0.4, 0.6, 0.8)),
    "drain": _one_node("drain", 2, 3.0),
}
LATER: dict[str, Maker] = {
    "stall": _cuts("stall", 1, 3),
    "burst": _bursts,
    "data": _cuts("data", 1, 4),
    "apart": _one_node("apart", 1, 8.0, (1.0, 2.0)),
    "fsync": _one_node("slow_disk", 2, 8.0, (0.5, 1.5)),
    "rollback": _one_node("rollback", 2, 2.0),
    "lie": _one_node("lie", 2, 2.0, (0.3, 1.0, 3.0)),
    "amnesia": _one_node("amnesia", 1, 2.0),
    "freeze": _one_node("freeze", 3, 5.0),
    "rollout": _one_node("rollout", 2, 8.0, tuple(float(number) for number in range(len(CHANGES)))),
    "generation": _one_node("generation", 1, 8.0),
}
"""Faults that came later, drawn apart from `MAKERS`."""
KINDS: frozenset[str] = frozenset(LATER) | {"suspend", "reload"}
"""Faults that a plan may leave out; no other fault of the plan changes by that."""
PENDING: frozenset[str] = frozenset()
"""Faults whose mend has not landed: only ``--with`` plays them."""
