"""Decides what happens in one seeded hour: machines of unequal speed, tasks as large as they are, loads of one length.

Knows: what is drawn from which range, and what every placement of the tasks would get at every moment. Does not know:
rules, prices, how a placement comes about.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from zsched.core.values.fleet import Demand, Fleet, TaskSpec, Timing, WorkerSpec
from zsched.core.values.model import Tuning
from zsched_lab.decisions.loads import LONG, Array, Scatter, Spikes, correlated
from zsched_lab.decisions.service.machines import Machine, Shared, Work, alone_s, share
from zsched_lab.decisions.world import DT_S, EVEN, MEMORY_MB, build_fleet

ROBOTS: Final = 3
CORES: Final = (2.0, 4.0)
SPEEDS: Final = (0.5, 2.0)
SIZES: Final = {1: (0.1, 1.2), 3: (0.1, 0.6)}
"""{number of tasks: how large each is, as a share of the median machine}; on the slow ones it is larger."""
EDGES: Final = {1: 3, 3: 4}
"""{number of tasks: number of machines}."""
RATES_HZ: Final = (0.5, 5.0)
MEMORY_SHARES: Final = (0.05, 0.3)
SLOW_TIMES: Final = 2.0
"""A job is slow when it takes this many times as long as on the median machine while that is idle."""
DEADLINE_PERIODS: Final = 1.5
"""A job is late when it takes longer than this many periods of its task."""
LEAST_PAUSE_S: Final = (10.0, 20.0)
"""Between two loads of a machine: the least pause and the mean of what is added, each the load's length at least."""
IDLE_SHARE: Final = 0.02
"""An idle task still gets so much of its jobs."""
BURSTS_S: Final = ((5.0, 60.0), (5.0, 60.0))
"""How long a bursty task has all of its jobs, and then none; drawn so that halves and doubles are as likely."""
MEASURED: Final = Scatter(spike_hz=0.0)
"""As `zsched_lab.decisions.scatter` measured it; spikes are apart (`zsched_lab.decisions.loads.SPIKES`)."""
Placement = tuple[int, ...]
"""The machine of every task."""


class Activity(StrEnum):
    """When the jobs of the tasks come: always, hardly ever, or in bursts of each task's own."""

    STEADY = "steady"
    IDLE = "idle"
    BURSTY = "bursty"


@dataclass(frozen=True, slots=True, kw_only=True)
class Begin:
    """A load begins: the step, the machine, and the step at which it ends."""

    step: int
    machine: int
    end: int


@dataclass(frozen=True, slots=True, kw_only=True)
class History:
    """One seeded history. T steps, S stretches without change, C machines, K tasks."""

    load_s: float
    machines: tuple[Machine, ...]
    works: tuple[Work, ...]
    fleet: Fleet
    stretch: npt.NDArray[np.intp]
    """[T]: which stretch a step belongs to."""
    on: tuple[tuple[Shared, ...], ...]
    """[C][2^K]: what a machine gives when the tasks of that bit mask are on it."""
    activity: Array
    """[S, K]: the share of its jobs that comes to each task."""
    begins: tuple[Begin, ...]
    cpu_error: Array
    """[T, C]: what a reading adds to the cores in use, as a share of the machine."""
    memory_error: Array
    running_error: Array
    """[T, C]: what a count of the threads that want to run adds to the cores that are wanted."""
    spikes: tuple[tuple[float, Array], ...]
    """By use: up to which share of the machine, and [T, C]: what spikes add to a reading, as shares of it."""
    size: float
    """The largest task, as a share of the median machine."""

    @property
    def steps(self) -> int:
        """How many steps the history has."""
        return len(self.stretch)

    @property
    def placements(self) -> list[Placement]:
        """Every way to place the tasks, in the order of `service`'s columns."""
        return list(itertools.product(range(len(self.machines)), repeat=len(self.works)))

    def _joined(self, name: str) -> Array:
        """[S, C^K, K] of one field of `Shared`."""
        out = np.empty((int(self.stretch[-1]) + 1, len(self.placements), len(self.works)))
        for column, placed in enumerate(self.placements):
            for task, machine in enumerate(placed):
                there = self.on[machine][mask_of(placed, machine)]
                out[:, column, task] = getattr(there, name)[:, rank_of(placed, task)]
        return out

    def service(self) -> Array:
        """[S, C^K, K]: the share of its jobs that every task does under every placement."""
        return self._joined("service")

    def missed(self) -> Array:
        """[S, C^K, K]: the share of its jobs that are missed."""
        return self._joined("missed")


def mask_of(placed: tuple[int | None, ...], machine: int) -> int:
    """Which tasks are on ``machine``, as bits.

    >>> mask_of((0, 2, 0), 0)
    5
    """
    return sum(1 << task for task, where in enumerate(placed) if where == machine)


def rank_of(placed: tuple[int | None, ...], task: int) -> int:
    """Which of the tasks on its machine ``task`` is.

    >>> rank_of((0, 2, 0), 2)
    1
    """
    return sum(where == placed[task] for where in placed[:task])


def build(
    *,
    seed: int,
    hours: float,
    load_s: float,
    tasks: int = 1,
    scatter: Scatter = MEASURED,
    activity: Activity = Activity.STEADY,
    is_equal: bool = False,
    spikes: Sequence[Spikes] = (),
) -> History:
    """A history; machines and tasks are the same for every length of load, and machines and loads for every activity.

    Args:
        seed: of everything.
        hours: its length.
        load_s: how long every injected load lasts; 0: there are none.
        tasks: how many tasks, 1 or 3.
        scatter: of the readings.
        activity: when the tasks' jobs come.
        is_equal: all machines are as the first one, with its background.
        spikes: of the readings, by the machine's use.
    """
    rng = np.random.default_rng((seed, tasks))
    machines = tuple(
        Machine(cores=float(rng.choice(CORES)), speed=_between(SPEEDS, rng), memory_mb=MEMORY_MB)
        for _ in range(EDGES[tasks])
    )
    if is_equal:
        machines = machines[:1] * len(machines)
    median = float(np.median([machine.cores * machine.speed for machine in machines]))
    sizes = [_between(SIZES[tasks], rng) for _ in range(tasks)]
    works = tuple(_work(f"task{index}", size * median, machines, rng) for index, size in enumerate(sizes, 1))
    idle = [(float(rng.uniform(*LONG.idle_cpu)), float(rng.uniform(*LONG.idle_memory))) for _ in machines]
    if is_equal:
        idle = idle[:1] * len(idle)
    seeds, edges = (seed, tasks, round(load_s * 10)), range(len(machines))
    rng = np.random.default_rng(seeds)
    steps = round(hours * 3600 / DT_S)
    busy, held, begins = _loads(steps, load_s, machines, rng)
    comes = _comes(steps, tasks, activity, np.random.default_rng((seed, tasks, *activity.encode())))
    changed = np.any([np.any(np.diff(one, axis=0) != 0, axis=1) for one in (busy, held, comes)], axis=0)
    first = np.concatenate([[0], np.flatnonzero(changed) + 1])
    stretch = np.zeros(steps, dtype=np.intp)
    stretch[first[1:]] = 1
    errors = [
        [correlated(steps, deviation, keep, rng) for _ in machines]
        for deviation, keep in ((scatter.cpu, scatter.cpu_keep), (scatter.memory, scatter.memory_keep))
    ]
    return History(
        load_s=load_s,
        machines=machines,
        works=works,
        fleet=_fleet(machines, works),
        stretch=np.cumsum(stretch),
        on=tuple(
            _shares(machine, works, idle[index], busy[first, index], held[first, index], comes[first])
            for index, machine in enumerate(machines)
        ),
        activity=comes[first],
        begins=begins,
        cpu_error=np.stack(errors[0], axis=1),
        memory_error=np.stack(errors[1], axis=1),
        running_error=np.stack(
            [_counted(steps, idle[index][0] * machine.cores, rng) for index, machine in enumerate(machines)], axis=1
        ),
        spikes=tuple(
            (
                kind.below,
                np.stack(
                    [kind.drawn(steps, DT_S, np.random.default_rng((*seeds, index, which))) for which in edges], 1
                ),
            )
            for index, kind in enumerate(spikes)
        ),
        size=max(sizes),
    )


def _counted(steps: int, background: float, rng: np.random.Generator) -> Array:
    """[steps]: at the moment of a count each thread of the background runs or does not; less their mean."""
    threads = math.ceil(background)
    return rng.binomial(threads, background / threads, steps).astype(np.float64) - background


def _comes(steps: int, tasks: int, activity: Activity, rng: np.random.Generator) -> Array:
    """[steps, tasks]: the share of its jobs that comes to each task."""
    if activity is not Activity.BURSTY:
        return np.full((steps, tasks), IDLE_SHARE if activity is Activity.IDLE else 1.0)
    comes = np.zeros((steps, tasks))
    for task in range(tasks):
        step, pause = 0, int(rng.integers(2))
        while step < steps:
            length = max(round(_between(BURSTS_S[pause], rng) / DT_S), 1)
            comes[step : step + length, task] = 1.0 - pause
            step, pause = step + length, 1 - pause
    return comes


def _between(span: tuple[float, float], rng: np.random.Generator) -> float:
    """Drawn so that halves and doubles are as likely."""
    return math.exp(float(rng.uniform(math.log(span[0]), math.log(span[1]))))


def _work(name: str, cores: float, machines: tuple[Machine, ...], rng: np.random.Generator) -> Work:
    """A task that takes ``cores`` of speed 1, with enough processes for the slowest machine."""
    rate_hz = _between(RATES_HZ, rng)
    cpu_s, processes = cores / rate_hz, math.ceil(cores / min(machine.speed for machine in machines))
    return Work(
        name=name,
        cpu_s=cpu_s,
        rate_hz=rate_hz,
        memory_mb=float(rng.uniform(*MEMORY_SHARES)) * MEMORY_MB,
        processes=processes,
        deadline_s=DEADLINE_PERIODS / rate_hz,
        slow_s=SLOW_TIMES * float(np.median([alone_s(cpu_s, processes, machine) for machine in machines])),
    )


def _fleet(machines: tuple[Machine, ...], works: tuple[Work, ...]) -> Fleet:
    """Robots, edges and the tasks; their file says what each needs at least, which is its use of the fastest edge."""
    fleet = build_fleet(ROBOTS, len(machines), EVEN, Timing(), are_robots_candidates=False)
    fastest = max(machines, key=lambda machine: machine.speed)
    specs = tuple(
        TaskSpec(
            name=work.name,
            candidates=fleet.tasks[0].candidates,
            tuning=Tuning(weights=EVEN),
            demand=Demand(cpu_cores=work.demand(fastest), memory_mb=work.memory_mb),
            worker=WorkerSpec(command=("work",)),  # its use is measured
        )
        for work in works
    )
    return replace(fleet, tasks=specs)


def _loads(
    steps: int, load_s: float, machines: tuple[Machine, ...], rng: np.random.Generator
) -> tuple[Array, Array, tuple[Begin, ...]]:
    """Busy processes and their MiB [T, C], and when loads begin: up to two processes a core, each wants a whole one."""
    busy, held = np.zeros((steps, len(machines))), np.zeros((steps, len(machines)))
    begins: list[Begin] = []
    length = round(load_s / DT_S)
    pauses_s = (max(LEAST_PAUSE_S[0], load_s), max(LEAST_PAUSE_S[1], load_s))
    for index, machine in enumerate(machines if length else ()):
        step = round(float(rng.exponential(sum(pauses_s))) / DT_S)
        while step < steps:
            busy[step : step + length, index] = float(rng.integers(1, 2 * round(machine.cores), endpoint=True))
            held[step : step + length, index] = float(rng.uniform(*LONG.memory)) * machine.memory_mb
            begins.append(Begin(step=step, machine=index, end=min(step + length, steps)))
            step += length + round((pauses_s[0] + float(rng.exponential(pauses_s[1]))) / DT_S)
    return busy, held, tuple(sorted(begins, key=lambda begin: (begin.step, begin.machine)))


def _shares(
    machine: Machine, works: tuple[Work, ...], idle: tuple[float, float], busy: Array, held: Array, comes: Array
) -> tuple[Shared, ...]:
    """[2^K]: what the machine gives to every set of tasks, beside its background and the load."""
    background = np.full(len(busy), idle[0] * machine.cores)
    others = np.stack([np.stack([background, np.ceil(background)], axis=1), np.stack([busy, busy], axis=1)], axis=1)
    others_mb = np.stack([np.full(len(held), idle[1] * machine.memory_mb), held], axis=1)
    sets = [[task for task in range(len(works)) if mask >> task & 1] for mask in range(1 << len(works))]
    return tuple(
        share(machine, tuple(works[task] for task in here), others, others_mb, comes[:, here]) for here in sets
    )
