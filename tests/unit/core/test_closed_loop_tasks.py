"""Several tasks in a closed loop: each one is on the machines that the others are scored on.

Machines share their CPU fairly among threads, so a task that comes makes others wait, tasks or not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from support.allocations import allocation_of
from support.decisions import figures_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.decision import decide
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.usage import book
from zsched.core.values.events import WorkerJobs
from zsched.core.values.fleet import DEFAULT_BONUS, Demand, Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, ScoreForm, Tuning, Weights
from zsched.core.values.profile import DeviceSample, WorkerState

MEMORY_MB = 4000.0
CPU_ONLY, BOTH = Weights(cpu=1.0, memory=0.0, network=0.0), Weights(cpu=0.5, memory=0.5, network=0.0)
ROBOT = "robot1"


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Of ``cores``, with somebody else's work."""

    cores: float = 1.0
    speed: float = 1.0
    steady: float = 0.0
    """Cores that others' threads want which rest now and then."""
    hungry: int = 0
    """Others' threads that always want to run."""
    memory: float = 0.2
    """Ratio in use without any task."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a task does, and what the fleet file says that it does."""

    cores: float
    """On a machine of speed 1."""
    threads: int = 1
    memory_mb: float = 50.0
    demand_cores: float = 0.0
    job_s: float | None = None
    """CPU seconds of a job at speed 1, told by its worker; ``None``: it tells nothing."""
    deadline_ms: float | None = None
    priority: int = 0
    beside: tuple[tuple[str, float], ...] = ()

    def wanted(self, machine: Machine) -> float:
        """Cores that it would use there."""
        return min(self.cores / machine.speed, float(self.threads))


def shared(capacity: float, wanted: list[tuple[float, float]]) -> list[float]:
    """Cores that a fair scheduler gives to each of these, (threads, cores that they want); each thread counts the same.

    >>> shared(1.0, [(1.0, 0.2), (1.0, 1.0), (3.0, 3.0)])
    [0.2, 0.2, 0.6]
    """
    got, left, order = [0.0] * len(wanted), capacity, sorted(range(len(wanted)), key=lambda n: _per_thread(wanted[n]))
    threads = sum(threads for threads, _ in wanted)
    for number in order:
        own, wants = wanted[number]
        got[number] = min(wants, left * own / threads) if threads > 0.0 else 0.0
        left, threads = left - got[number], threads - own
    return got


def _per_thread(one: tuple[float, float]) -> float:
    threads, wants = one
    return wants / threads if threads > 0.0 else 0.0


class Tasks:
    """One robot that profiles, scores, judges and moves several tasks, one after the other."""

    def __init__(
        self, machines: tuple[Machine, ...], works: tuple[Work, ...], owners: tuple[int, ...], weights: Weights
    ) -> None:
        self.machines = {f"edge{number}": machine for number, machine in enumerate(machines, 1)}
        self.works = {f"task{number}": work for number, work in enumerate(works, 1)}
        tuning = Tuning(weights=weights, score=ScoreForm.SERVICE, bonus=DEFAULT_BONUS)
        self.specs = {
            name: task_of(
                name,
                candidates=tuple(self.machines),
                tuning=replace(tuning, deadline_ms=work.deadline_ms),
                demand=Demand(cpu_cores=work.demand_cores),
                priority=work.priority,
                beside=work.beside,
            )
            for name, work in self.works.items()
        }
        self.timing = Timing()
        fleet = fleet_of(*self.specs.values(), of=(*self.machines, ROBOT), timing=self.timing)
        self.values = {
            name: allocation_of(task=name, owner=f"edge{owner}", tuning=spec.tuning)
            for (name, spec), owner in zip(self.specs.items(), owners, strict=False)
        }
        self.gateway = Gateway(InForce(fleet))
        self.judges = {name: Judge(spec=spec) for name, spec in self.specs.items()}
        self.profilers = {name: Profiler(name, 1, self.timing) for name in self.machines}
        self.states = dict.fromkeys((*self.machines, ROBOT), PeerState.ALIVE)
        self.settled_at = dict.fromkeys(self.specs, 0.0)
        self.told: dict[str, WorkerJobs] = {}
        self.done: dict[str, tuple[float, float]] = {}
        """{task: jobs done and undone by its worker}."""

    def run(self, until_s: float) -> list[tuple[float, str, str]]:
        """(when, which, where to) of every move."""
        rounds, moves = 0, list[tuple[float, str, str]]()
        for tick in range(int(until_s / self.timing.sample_s)):
            now = tick * self.timing.sample_s
            self._profile(now)
            if now >= rounds * self.timing.decide_s:
                rounds += 1
                moves += self._round(now)
        return moves

    def _profile(self, now: float) -> None:
        for name, machine in self.machines.items():
            mine = [task for task in self.works if self.values[task].owner == name]
            others = [(math.ceil(machine.steady), machine.steady), (machine.hungry, float(machine.hungry))]
            wanted = [(self.works[task].threads, self.works[task].wanted(machine)) for task in mine]
            got = shared(machine.cores, [*others, *wanted])
            waits = [
                threads if cores < wants - 1e-9 else cores
                for (threads, wants), cores in zip(wanted, got[2:], strict=True)
            ]
            loads = [load_of(task=task, cpu_cores=0.0, memory_mb=0.0, runnable=0.0) for task in self.works]
            for number, task in enumerate(mine):
                cores, wants = got[2 + number], wanted[number][1]
                loads[list(self.works).index(task)] = load_of(
                    task=task,
                    cpu_cores=cores,
                    memory_mb=self.works[task].memory_mb,
                    wanted_cores=float(self.works[task].threads) if cores < wants - 1e-9 else None,
                    runnable=float(waits[number]),
                )
                self._tell(task, machine, cores, wants, now)
            rests = got[0] if got[0] >= machine.steady - 1e-9 else math.ceil(machine.steady)
            used_mb = machine.memory * MEMORY_MB + sum(self.works[task].memory_mb for task in mine)
            device = DeviceSample(
                cpu_cores=machine.cores,
                cpu_used_cores=min(sum(got), machine.cores),
                memory_mb=MEMORY_MB,
                memory_used_mb=min(used_mb, MEMORY_MB),
                workers=tuple(loads),
                speed=machine.speed,
                runnable=rests + machine.hungry + sum(waits),
            )
            self.profilers[name].absorb(device, (), now)
            ready = dict.fromkeys(self.specs, WorkerState.READY)
            profile = self.profilers[name].publishable(ready, is_draining=False, now=now)
            assert profile is None or self.gateway.absorb(profile, now) is None

    def _tell(self, task: str, machine: Machine, cores: float, wants: float, now: float) -> None:
        """Its worker does one job after the other and skips what it cannot do."""
        work, owner = self.works[task], self.values[task]
        if work.job_s is None or cores <= 0.0:
            return
        word, life = self.told.get(task), f"{owner.owner}/{owner.epoch}"
        if word is None or word.incarnation != life:
            word = WorkerJobs(task=task, incarnation=life, at_s=now, done=0, wait_s=0.0, age_s=0.0)
            self.done[task] = (0.0, 0.0)
        cpu_s, elapsed_s = work.job_s / machine.speed, now - word.at_s
        done, undone = self.done[task]
        after = done + elapsed_s * cores / cpu_s
        self.done[task] = after, undone + elapsed_s * max(wants - cores, 0.0) / cpu_s
        jobs, time_s = int(after) - int(done), cpu_s / cores if cores < wants - 1e-9 else cpu_s
        self.told[task] = replace(
            word,
            at_s=now,
            done=word.done + jobs,
            skipped=int(self.done[task][1]),
            time_s=word.time_s + jobs * time_s,
            cpu_s=word.cpu_s + jobs * cpu_s,
            wait_s=(word.wait_s or 0.0) + jobs * max(time_s - cpu_s, 0.0),
            age_s=(word.age_s or 0.0) + jobs * time_s,
        )
        self.profilers[owner.owner or ""].note_jobs(self.told[task], now)

    def _round(self, now: float) -> list[tuple[float, str, str]]:
        """At most one move (`zsched.core.scheduler.turns`)."""
        for name in sorted(self.specs, key=lambda name: (self.settled_at[name], name)):
            if self._judge(name, now, is_called=False).outcome is not Outcome.PROPOSE:
                continue
            judgement = self._judge(name, now, is_called=True)
            if judgement.outcome is Outcome.PROPOSE and judgement.candidate is not None:
                revision = self.values[name].revision + 1
                self.values[name] = replace(
                    self.values[name], revision=revision, epoch=revision, owner=judgement.candidate
                )
                self.settled_at[name] = now
                self.judges[name].reset()
                return [(now, name, judgement.candidate)]
        return []

    def _judge(self, name: str, now: float, *, is_called: bool) -> Judgement:
        spec, allocation = self.specs[name], self.values[name]
        assert allocation.owner is not None
        self.gateway.learn_demand(name, allocation.owner, now)
        booked = book(self.specs.values(), self.values)
        vector = score(spec, allocation, ROBOT, self.gateway, self.states, now, bookings=booked)
        figures = figures_of(
            spec,
            ROBOT,
            now=now,
            allocation=allocation,
            vectors=(vector,),
            owner_profile=self.gateway.fresh(allocation.owner, now),
            is_called=is_called,
            head_starts=spec.head_starts({task: one.owner for task, one in self.values.items()}),
        )
        return decide(self.judges[name], Fuse(), figures).judgement


@st.composite
def fleets(draw: st.DrawFn) -> tuple[tuple[Machine, ...], tuple[Work, ...], tuple[int, ...]]:
    """Two or three machines, alike or not, and two to four tasks that may be too much for them."""
    one = st.builds(
        Machine,
        cores=st.sampled_from((1.0, 2.0, 4.0)),
        speed=st.floats(0.4, 2.5),
        steady=st.one_of(st.just(0.0), st.floats(0.0, 1.0)),
        hungry=st.sampled_from((0, 1, 2, 6)),
        memory=st.floats(0.1, 0.85),
    )
    count = draw(st.integers(2, 3))
    machines = (draw(one),) * count if draw(st.booleans()) else tuple(draw(one) for _ in range(count))
    works = list[Work]()
    for _ in range(draw(st.integers(2, 4))):
        cores = draw(st.floats(0.02, 3.0))
        job_s = draw(st.one_of(st.none(), st.floats(0.02, 0.3))) if cores <= 0.9 else None
        works.append(
            Work(
                cores=cores,
                threads=1 if job_s is not None else math.ceil(cores) + draw(st.sampled_from((0, 2))),
                memory_mb=draw(st.sampled_from((50.0, 300.0, 700.0))),
                demand_cores=cores * draw(st.sampled_from((0.0, 0.5, 1.0, 2.0))),
                job_s=job_s,
                deadline_ms=None if job_s is None else draw(st.sampled_from((None, 1500.0 * job_s, 4000.0 * job_s))),
            )
        )
    return machines, tuple(works), tuple(draw(st.integers(1, count)) for _ in works)


WAITING_FOR_IT = (
    (Machine(steady=0.39, hungry=1),) * 3,
    (Work(cores=0.5), Work(cores=0.9, threads=3, memory_mb=900.0)),
    (3, 1),
)
"""Where a task comes, somebody else's thread waits that did not; where it goes that thread rests again."""
BOOKED_TWICE = (
    (Machine(cores=4.0, speed=1.3, hungry=2, memory=0.5), Machine(speed=1.4, steady=0.5, hungry=1)),
    (Work(cores=1.7, threads=3, demand_cores=3.3), Work(cores=2.1, threads=3), Work(cores=0.5, demand_cores=1.1)),
    (1, 2, 1),
)
"""The file says that two tasks take twice what they do."""


TAKES_THE_REST = (
    (Machine(cores=2.0, speed=2.05, steady=0.59, memory=0.6),) * 3,
    (
        Work(cores=0.33, job_s=0.24, deadline_ms=360.0),
        Work(cores=2.955, threads=5, memory_mb=300.0, demand_cores=2.955),
        Work(cores=1.1, threads=4, memory_mb=300.0),
        Work(cores=0.08, threads=3),
    ),
    (1, 3, 1, 2),
)
"""The second one lacks nothing, and leaves somebody else's thread a little too little."""


@pytest.mark.long
@settings(derandomize=True, database=None, deadline=None, max_examples=12)
@example(fleet=WAITING_FOR_IT, weights=BOTH)
@example(fleet=TAKES_THE_REST, weights=BOTH)
@example(fleet=BOOKED_TWICE, weights=BOTH)
@given(fleet=fleets(), weights=st.sampled_from((CPU_ONLY, BOTH)))
def test_where_nothing_changes_several_tasks_come_to_rest(
    fleet: tuple[tuple[Machine, ...], tuple[Work, ...], tuple[int, ...]], weights: Weights
) -> None:
    """Each may go once to each machine, to learn what it gets there. A slight lead may take minutes to cost a move.

    The examples were limit cycles of 47, 4 and 60 moves in 300 s.
    """
    machines, works, owners = fleet
    moves = Tasks(machines, works, owners, weights).run(400.0)
    assert len(moves) <= len(machines) * len(works)
    assert [at for at, _, _ in moves if at > 250.0] == []


def test_tasks_that_crowd_one_machine_spread_over_the_others() -> None:
    """The control: there is something to move."""
    works = (Work(cores=0.8),) * 3
    moves = Tasks((Machine(),) * 3, works, (1, 1, 1), CPU_ONLY).run(60.0)
    assert len(moves) == 2
    assert {where for _, _, where in moves} == {"edge2", "edge3"}


@pytest.mark.parametrize(("together", "expected"), [(0.2, ["edge1", "edge1"]), (-0.2, ["edge1", "edge2"])])
def test_two_tasks_keep_together_or_spread_over_equal_machines(together: float, expected: list[str]) -> None:
    """Without a word they would stay where they are."""
    works = (Work(cores=0.3, beside=(("task2", together),)), Work(cores=0.3))
    for owners in ((1, 1), (2, 1)):
        fleet = Tasks((Machine(cores=4.0),) * 2, works, owners, CPU_ONLY)
        assert len(fleet.run(60.0)) <= 1
        assert sorted(one.owner or "" for one in fleet.values.values()) == expected


@pytest.mark.parametrize(("one", "other"), [(0.2, -0.2), (0.2, 0.2), (-0.5, 0.5)])
def test_tasks_that_seek_and_avoid_each_other_do_not_chase_each_other(one: float, other: float) -> None:
    """400 moves in 200 s: a promise of company that runs away was never held against a machine."""
    works = (Work(cores=0.6, beside=(("task2", one),)), Work(cores=0.54, beside=(("task1", other),)))
    moves = Tasks((Machine(),) * 3, works, (1, 2), CPU_ONLY).run(150.0)
    assert len(moves) <= 8
    assert [at for at, _, _ in moves if at > 100.0] == []


@pytest.mark.parametrize("first", [1, 2])
def test_where_two_tasks_lack_cpu_the_one_of_less_priority_leaves(first: int) -> None:
    works = [Work(cores=0.8), Work(cores=0.8)]
    works[first - 1] = replace(works[first - 1], priority=1)
    fleet = Tasks((Machine(), Machine(speed=0.9)), tuple(works), (1, 1), CPU_ONLY)
    moves = fleet.run(60.0)
    assert [(which, where) for _, which, where in moves] == [(f"task{3 - first}", "edge2")]


@pytest.mark.parametrize("capacity", [0.5, 1.0, 3.0])
def test_the_model_gives_all_that_there_is_and_no_more_than_is_wanted(capacity: float) -> None:
    got = shared(capacity, [(0.0, 0.0), (2.0, 2.0), (1.0, 0.1), (3.0, 0.6)])
    assert sum(got) == pytest.approx(min(capacity, 2.7))
    assert all(0.0 <= one <= wants + 1e-12 for one, wants in zip(got, (0.0, 2.0, 0.1, 0.6), strict=True))
