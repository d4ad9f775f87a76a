"""The first four stages in a closed loop: what is decided changes what is measured next.

A machine's load follows from whether it has the task. Quantities are design section 11's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from support.allocations import allocation_of
from support.decisions import figures_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of
from support.proposals import proposal_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.decision import decide
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.scoring import score
from zsched.core.values.events import WorkerJobs
from zsched.core.values.fleet import DEFAULT_BONUS, Demand, Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, ScoreForm, Tuning, Weights
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource, WorkerState
from zsched.core.vote.tally import VoteOutcome, tally

HOUR_S = 3600.0
MEMORY_MB = 4000.0
READY = {"merge": WorkerState.READY}
BOTH = Weights(cpu=0.5, memory=0.5, network=0.0)
NO_STEP: Callable[[float], float] = lambda _: 0.0  # noqa: E731 - a default value, not a function of its own
SAME_SIZE: Callable[[float], float] = lambda _: 1.0  # noqa: E731 - as above


@dataclass(kw_only=True)
class Machine:
    """One edge: a base load with steps and noise, and what the task takes where it runs."""

    name: str
    cores: float = 4.0
    base: float = 0.4
    """Ratio in use without the task, of CPU and memory; the signal falls by 0.4 dB per 1 % of a step."""
    memory: float | None = None
    """Ratio of memory in use without the task; ``None``: as the CPU."""
    signal_dbm: float = -60.0
    step: Callable[[float], float] = NO_STEP
    """Ratio added at a time."""
    noise: float = 0.0
    task_cores: float = 0.0
    """On a machine of speed 1."""
    speed: float = 1.0
    own_speed: float = 1.0
    """The task is so many times as quick there as the benchmark says."""
    task_mb: float = 0.0
    hidden_mb: float = 0.0
    """Beside that, and not in its worker's figure."""
    shows_worker: bool = True
    job_s: float | None = None
    """Its worker tells of its jobs, of so many CPU seconds at speed 1; ``None``: it does not."""
    waits_s: float = 0.0
    """Of such an answer, for other things than a CPU."""
    queueing: float = 0.0
    """Its jobs come irregularly: they wait so many times u / (1 - u) of their time for each other, u being busy."""
    rub: float = 1.0
    """A job takes so many times the CPU time when the machine is full."""
    most_cores: float = math.inf
    """The task gets no more there, though the machine's figures say that more is free."""
    threads: float | None = None
    """Of others, that want to run; ``None``: nobody counts."""
    takes_turns: bool = False
    """Its one thread waits for its turn among them: a job takes longer there, and wants to run all that time."""
    frees_at: float = math.inf
    """From then on nobody else is there."""
    size: Callable[[float], float] = SAME_SIZE
    """Its jobs, and so the task, take so many times the CPU at a time."""
    fewer_from: float = math.inf
    """From then on its jobs come a fifth as often."""
    works_until: float = math.inf
    """From then on its worker has nothing to do."""

    def sample(self, now: float, rng: Random, *, is_owner: bool) -> tuple[DeviceSample, LinkSample]:
        step = self.step(now)
        if now >= self.frees_at:
            self.base, self.threads = 0.0, None if self.threads is None else 0.0
        bases = (self.base, self.base if self.memory is None else self.memory)
        cpu, memory = (base + step + rng.uniform(-self.noise, self.noise) for base in bases)
        rest = max(cpu, 0.0) * self.cores
        # A full machine gives the task what is left, half a core at least.
        needs = self.task_cores / self._speed if is_owner and now < self.works_until else 0.0
        needs = (needs / 5.0 if now >= self.fewer_from else needs) * self.size(now)
        room = max(self.cores - rest, 0.5)
        takes = min(needs, room, self.most_cores)
        is_short = takes < needs
        wanted = float(math.ceil(needs)) if is_short else None
        runnable = math.ceil(needs) if is_short else takes
        if self.takes_turns and needs > 0.0:
            takes, runnable = self._in_turns(needs, self.cores - rest, now)
            is_short, wanted = takes < needs, 1.0 if runnable >= 0.9 else None
        holds = self.task_mb if is_owner else 0.0
        load = load_of(
            cpu_cores=takes if self.shows_worker else None,
            memory_mb=holds if self.shows_worker else None,
            wanted_cores=wanted if self.shows_worker else None,
            runnable=runnable if self.shows_worker else None,
        )
        self._work(now, needs, takes, runnable)
        device = DeviceSample(
            cpu_cores=self.cores,
            cpu_used_cores=min(rest + takes, self.cores),
            memory_mb=MEMORY_MB,
            memory_used_mb=min(max(memory, 0.0) * MEMORY_MB + holds + (self.hidden_mb if is_owner else 0.0), MEMORY_MB),
            workers=(load,),
            speed=self.speed,
            runnable=None if self.threads is None else self.threads + runnable,
        )
        return device, LinkSample(source=LinkSource.NL80211, rssi_dbm=self.signal_dbm - 40.0 * step)

    def __post_init__(self) -> None:
        self.told: WorkerJobs | None = None
        self._done = self._undone = self._now = 0.0

    def _in_turns(self, needs: float, free_cores: float, now: float) -> tuple[float, float]:
        """(cores in use, threads that run or wait): while it has a job its thread runs at a fair share."""
        assert self.job_s is not None
        assert self.threads is not None
        rate = min(max(free_cores, self.cores / max(self.threads + 1.0, self.cores)), 1.0)
        rubs = self.rub if rate < 1.0 else 1.0
        cpu_s = self.size(now) * self.job_s / self._speed * rubs
        takes = min(needs * rubs, cpu_s / (self.waits_s + cpu_s / rate))
        return takes, takes / rate

    @property
    def _speed(self) -> float:
        """Of the task."""
        return self.speed * self.own_speed

    def _work(self, now: float, needs: float, takes: float, runnable: float) -> None:
        """One worker of one thread, which skips what it cannot do; jobs are a fluid here, and told in whole ones."""
        before_s, self._now = self._now, now
        elapsed_s = max(now - before_s, 0.0)
        if now == 0.0:
            self.told = None
        if self.job_s is None or needs <= 0.0:
            has_ended = self.told is not None and self.told.at_s == before_s and now >= self.works_until
            self.told = replace(self.told, at_s=now, is_idle=True) if has_ended and self.told is not None else None
            return
        word = self.told or WorkerJobs(task="merge", incarnation=str(now), at_s=now, done=0, wait_s=0.0, age_s=0.0)
        alone_s = self.size(now) * self.job_s / self._speed
        is_full = takes < runnable if self.takes_turns else takes < needs
        cpu_s = alone_s * (self.rub if is_full else 1.0)
        wanted_hz = needs / alone_s
        done_hz = takes / cpu_s
        before, self._done = int(self._done), self._done + elapsed_s * done_hz
        self._undone += elapsed_s * max(wanted_hz - done_hz, 0.0)
        jobs, time_s = int(self._done) - before, max(1.0 / done_hz, cpu_s) if takes < needs else cpu_s
        if self.takes_turns:
            time_s = runnable / done_hz
        busy = min(needs, 0.9)
        queue_s = time_s * self.queueing * busy / (1.0 - busy)
        self.told = replace(
            word,
            at_s=now,
            done=word.done + jobs,
            skipped=int(self._undone),
            time_s=word.time_s + jobs * (time_s + (self.waits_s if self.takes_turns else 0.0)),
            cpu_s=word.cpu_s + jobs * cpu_s,
            wait_s=(word.wait_s or 0.0) + jobs * max(time_s - cpu_s, 0.0),
            age_s=(word.age_s or 0.0) + jobs * (time_s + queue_s + (self.waits_s if self.takes_turns else 0.0)),
        )


@dataclass
class Loop:
    """Robots that profile, score, judge, vote and move one task among machines."""

    machines: tuple[Machine, ...]
    weights: Weights = BOTH
    tuning: Tuning = field(default_factory=lambda: Tuning(weights=BOTH))
    timing: Timing = field(default_factory=Timing)
    robots: tuple[str, ...] = ("robot1",)
    price_s: float = 0.3
    memory_s: float = 1000.0
    demand: Demand = Demand()
    """By the fleet file."""
    seed: int = 0
    moves: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = tuple(machine.name for machine in self.machines)
        self.spec = task_of(
            candidates=names,
            tuning=replace(self.tuning, weights=self.weights),
            demand=self.demand,
            price_s=self.price_s,
            memory_s=self.memory_s,
        )
        fleet = fleet_of(self.spec, of=(*names, *self.robots), timing=self.timing)
        self.allocation = allocation_of(owner=names[0], tuning=self.spec.tuning)
        self.gateways = {robot: Gateway(InForce(fleet)) for robot in self.robots}
        self.judges = {robot: Judge(spec=self.spec) for robot in self.robots}
        self.profilers = {name: Profiler(name, 1, self.timing) for name in (*names, *self.robots)}
        self.states = dict.fromkeys(self.profilers, PeerState.ALIVE)
        self.rng = Random(self.seed)

    def run(self, until_s: float) -> list[tuple[float, str]]:
        """(when, where to) of every move."""
        rounds = 0
        for tick in range(int(until_s / self.timing.sample_s)):
            now = tick * self.timing.sample_s
            self._profile(now)
            if now >= rounds * self.timing.decide_s:
                rounds += 1
                self._round(now)
        return self.moves

    def _profile(self, now: float) -> None:
        for machine in self.machines:
            is_owner = machine.name == self.allocation.owner
            device, link = machine.sample(now, self.rng, is_owner=is_owner)
            if machine.told is not None:
                self.profilers[machine.name].note_jobs(machine.told, now)
            self.profilers[machine.name].absorb(device, (link,) if self.weights.network > 0.0 else (), now)
        if self.weights.network > 0.0:
            device = DeviceSample(cpu_cores=4.0, cpu_used_cores=1.0, memory_mb=MEMORY_MB, memory_used_mb=1000.0)
            link = LinkSample(source=LinkSource.NL80211, rssi_dbm=-45.0)
            for robot in self.robots:
                self.profilers[robot].absorb(device, (link,), now)
        for profiler in self.profilers.values():
            profile = profiler.publishable(READY, is_draining=False, now=now)
            if profile is not None:
                for gateway in self.gateways.values():
                    assert gateway.absorb(profile, now) is None

    def _round(self, now: float) -> None:
        judgements = self._judge(now, is_called=False)
        if any(judgement.outcome is Outcome.PROPOSE for judgement in judgements.values()):
            self._vote(self._judge(now, is_called=True), now)

    def _judge(self, now: float, *, is_called: bool) -> dict[str, Judgement]:
        owner = self.allocation.owner
        assert owner is not None
        for gateway in self.gateways.values():
            gateway.learn_demand("merge", owner, now)
        vectors = {
            robot: score(self.spec, self.allocation, robot, gateway, self.states, now)
            for robot, gateway in self.gateways.items()
        }
        figures = figures_of(
            self.spec,
            *self.robots,
            now=now,
            allocation=self.allocation,
            vectors=tuple(vectors.values()),
            owner_profile=self.gateways[self.robots[0]].fresh(owner, now),
            is_called=is_called,
        )
        # without a record of moves: the cap must not hide a cycle
        return {robot: decide(judge, Fuse(), figures).judgement for robot, judge in self.judges.items()}

    def _vote(self, judgements: dict[str, Judgement], now: float) -> None:
        proposals = {
            robot: proposal_of(
                robot,
                judgement.candidate or "",
                base_revision=self.allocation.revision,
                aggregate=judgement.aggregate,
                is_escape=judgement.is_escape,
            )
            for robot, judgement in judgements.items()
        }
        owner = self.allocation.owner
        result = tally(proposals, voters=self.robots, present=frozenset(self.robots), owner=owner, is_over=True)
        for judge in self.judges.values():
            judge.reset()
        if result.outcome is not VoteOutcome.WON or result.winner is None:
            return
        revision = self.allocation.revision + 1
        self.allocation = replace(self.allocation, revision=revision, epoch=revision, owner=result.winner)
        self.moves.append((now, result.winner))


PATIENT = Tuning(weights=BOTH, bonus=DEFAULT_BONUS)
"""What a task gets whose fleet file says nothing but ``score: paper``."""
RESTLESS = Tuning(weights=BOTH, bonus=0.0)
"""With a price of 0."""


# --- noise ---------------------------------------------------------------------------------------------------------


def test_two_equal_nodes_under_noise_move_at_most_once_in_an_hour() -> None:
    """+-15 % uniform noise in every 5 Hz sample of CPU and memory."""
    loop = Loop((Machine(name="edge1", noise=0.15), Machine(name="edge2", noise=0.15)))

    assert len(loop.run(HOUR_S)) <= 1


def test_nor_do_they_by_default() -> None:
    machines = (Machine(name="edge1", noise=0.15), Machine(name="edge2", noise=0.15))

    assert len(Loop(machines, tuning=PATIENT).run(HOUR_S)) <= 1


def test_the_same_noise_without_stickiness_moves_the_task_all_the_time() -> None:
    """The control: the harness can fail."""
    machines = (Machine(name="edge1", noise=0.15), Machine(name="edge2", noise=0.15))

    assert len(Loop(machines, tuning=RESTLESS, price_s=0.0, memory_s=1.0).run(120.0)) > 10


# --- a step --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", [0.0, 0.07, 0.1, 0.21, 0.33, 0.45])
@pytest.mark.parametrize(
    "weights",
    [
        BOTH,
        Weights(cpu=1.0, memory=0.0, network=0.0),
        Weights(cpu=0.0, memory=0.0, network=1.0),
        Weights(cpu=0.4, memory=0.3, network=0.3),
    ],
)
def test_a_step_of_30_percent_is_followed_in_time(weights: Weights, phase: float) -> None:
    """Within 1.5 s, wherever in a round the step falls."""
    at = 15.0 + phase
    stepped = Machine(name="edge1", step=lambda now: 0.3 if now >= at else 0.0)
    robots = ("robot1", "robot2", "robot3")
    loop = Loop((stepped, Machine(name="edge2")), weights=weights, robots=robots, tuning=PATIENT)
    ((moved_at, where),) = loop.run(22.0)

    assert where == "edge2"
    assert 0.0 <= moved_at - at <= 1.5


def test_a_step_smaller_than_the_bonus_moves_nothing() -> None:
    stepped = Machine(name="edge1", step=lambda now: 0.09 if now >= 30.0 else 0.0)

    assert Loop((stepped, Machine(name="edge2"))).run(120.0) == []


@pytest.mark.parametrize("phase", [0.0, 0.07, 0.1, 0.2, 0.3, 0.4])
def test_a_short_spike_moves_nothing(phase: float) -> None:
    """A fifth of the machine for 1 s; by a price of 0 it would be followed."""
    spiky = Machine(name="edge1", step=lambda now: 0.2 if now >= 15.0 and (now - phase) % 20.0 < 1.0 else 0.0)
    machines = (spiky, Machine(name="edge2"))

    assert Loop(machines, tuning=PATIENT).run(200.0) == []
    assert Loop(machines, tuning=PATIENT, price_s=0.0).run(200.0) != []


def test_loads_that_follow_the_task_are_fled_once_each() -> None:
    """A load that alternates between the machines: one move a load at most, and none back before it has ended."""

    def wave(phase: int) -> Callable[[float], float]:
        return lambda now: 0.4 if int(now / 6.0) % 2 == phase else 0.0

    machines = (Machine(name="edge1", step=wave(0)), Machine(name="edge2", step=wave(1)))
    times = [at for at, _ in Loop(machines).run(300.0)]

    assert len(times) >= 2, "the loads are large enough to follow"
    assert len({int(at / 6.0) for at in times}) == len(times)


# --- the task's own load -------------------------------------------------------------------------------------------

THOUSAND_ROUNDS_S = 1000 * Timing().decide_s


@pytest.mark.parametrize("noise", [0.0, 0.15])
@pytest.mark.parametrize("other_cores", [4.0, 8.0, 2.5])
def test_a_heavy_task_does_not_chase_itself_around_in_a_thousand_rounds(other_cores: float, noise: float) -> None:
    """It takes more than the bonus: 40 % of a machine's CPU, 30 % of its memory. It may move once to the machine that
    is better with it; never back and forth."""
    machines = (
        Machine(name="edge1", base=0.2, noise=noise, task_cores=1.6, task_mb=1200.0),
        Machine(name="edge2", cores=other_cores, base=0.2, noise=noise, task_cores=1.6, task_mb=1200.0),
    )

    assert len(Loop(machines, seed=3).run(THOUSAND_ROUNDS_S)) <= 1
    patient = Loop(machines, tuning=PATIENT, seed=3)
    assert len(patient.run(THOUSAND_ROUNDS_S)) <= 1


def test_without_the_demand_correction_the_same_task_oscillates() -> None:
    """The control: a worker that does not show what it uses, and of which the fleet file tells nothing either, lets
    the owner look worse by its own load."""
    machines = tuple(
        Machine(name=name, base=0.2, task_cores=1.6, task_mb=1200.0, shows_worker=False) for name in ("edge1", "edge2")
    )

    assert len(Loop(machines, memory_s=1.0).run(THOUSAND_ROUNDS_S)) > 20


@pytest.mark.parametrize("threads", [None, 0.0])
@pytest.mark.parametrize("score_form", list(ScoreForm))
def test_nor_does_a_task_whose_worker_shows_no_figures_if_the_fleet_file_tells_its_demand(
    score_form: ScoreForm, threads: float | None
) -> None:
    """Somebody else starts its workers: three fifths of a machine's CPU and half of its memory are its own."""
    machines = tuple(
        Machine(name=name, cores=2.0, base=0.1, task_cores=1.2, task_mb=2000.0, shows_worker=False, threads=threads)
        for name in ("edge1", "edge2")
    )
    tuning = Tuning(weights=BOTH, score=score_form)
    assert Loop(machines, tuning=tuning, demand=Demand(cpu_cores=1.2, memory_mb=2000.0)).run(THOUSAND_ROUNDS_S) == []


def test_a_starved_owner_is_left_and_not_taken_back_while_the_load_lasts() -> None:
    """The load takes the CPU from the worker, which then shows little: still its demand is what it was."""
    loaded = Machine(name="edge1", base=0.2, step=lambda now: 0.75 if now >= 30.0 else 0.0, task_cores=1.6)
    other = Machine(name="edge2", base=0.35, task_cores=1.6)
    loop = Loop((loaded, other), weights=Weights(cpu=1.0, memory=0.0, network=0.0))

    ((at, where),) = loop.run(300.0)
    assert where == "edge2"
    assert at < 40.0


def test_a_load_that_goes_away_may_bring_the_task_back_once() -> None:
    loaded = Machine(name="edge1", base=0.1, step=lambda now: 0.7 if 30.0 <= now < 100.0 else 0.0)
    loop = Loop((loaded, Machine(name="edge2", base=0.4)))

    assert [where for _, where in loop.run(200.0)] == ["edge2", "edge1"]


# --- scored by service ---------------------------------------------------------------------------------------------

BY_SERVICE = Tuning(weights=BOTH, score=ScoreForm.SERVICE, bonus=DEFAULT_BONUS)
"""What a task gets whose fleet file says nothing."""
CPU_ONLY = Weights(cpu=1.0, memory=0.0, network=0.0)


@st.composite
def constant_machines(draw: st.DrawFn) -> tuple[Machine, ...]:
    """Two or three machines of whatever size, speed and load, and a task that may be too large for all of them."""
    task_cores = draw(st.one_of(st.floats(0.001, 0.1), st.floats(0.1, 8.0)))
    return tuple(
        Machine(
            name=f"edge{number}",
            cores=draw(st.sampled_from((1.0, 2.0, 4.0, 8.0))),
            speed=draw(st.floats(0.25, 4.0)),
            base=draw(st.floats(0.0, 1.1)),
            task_cores=task_cores,
            task_mb=draw(st.sampled_from((100.0, 800.0))),
            threads=draw(st.one_of(st.none(), st.floats(0.0, 20.0))),
        )
        for number in range(1, draw(st.integers(2, 3)) + 1)
    )


SLOW_AND_FAST = (
    Machine(name="edge1", base=0.5, speed=0.5, task_cores=1.1),
    Machine(name="edge2", base=0.5, speed=2.0, task_cores=1.1),
)


@settings(derandomize=True, database=None, deadline=None, max_examples=12)
@example(machines=SLOW_AND_FAST, weights=CPU_ONLY)
@given(
    machines=constant_machines(),
    weights=st.sampled_from((CPU_ONLY, BOTH, Weights(cpu=0.2, memory=0.8, network=0.0))),
)
def test_where_nothing_changes_a_task_scored_by_service_comes_to_rest(
    machines: tuple[Machine, ...], weights: Weights
) -> None:
    """No limit cycle, whatever the speeds: at most once to each machine to learn what it needs there, then to stay.

    A lead that is next to nothing may take minutes to be worth a move.
    """
    moves = Loop(machines, weights=weights, tuning=BY_SERVICE).run(600.0)
    assert len([at for at, _ in moves if at <= 300.0]) <= len(machines)
    assert [at for at, _ in moves if at > 300.0] == []


@st.composite
def tempting_machines(draw: st.DrawFn) -> tuple[Machine, ...]:
    """Each machine looks better from another one, if only the benchmark's speed counts.

    The second one has more memory or a better link, and seems to have CPU enough. But the task is slower there than the
    benchmark says, so it is short there, and the first one is then better.
    """
    task_cores = draw(st.floats(0.3, 2.5))
    threads = draw(st.one_of(st.none(), st.floats(0.0, 4.0)))
    noise = draw(st.sampled_from((0.0, 0.02)))

    def machine(name: str, room: tuple[float, float], own: tuple[float, float], rest: tuple[float, float]) -> Machine:
        speed, base = draw(st.floats(0.5, 2.0)), draw(st.floats(0.0, 0.6))
        free_cores = task_cores * draw(st.floats(*room)) / speed
        return Machine(
            name=name,
            cores=free_cores / (1.0 - base),
            base=base,
            memory=draw(st.floats(*rest)),
            signal_dbm=draw(st.floats(-58.0, -50.0)) if name == "edge1" else -48.0,
            speed=speed,
            own_speed=draw(st.floats(*own)),
            task_cores=task_cores,
            task_mb=300.0,
            threads=threads,
            noise=noise,
        )

    return (
        machine("edge1", room=(1.2, 3.0), own=(1.0, 1.2), rest=(0.86, 0.925)),
        machine("edge2", room=(1.0, 1.6), own=(0.35, 0.9), rest=(0.1, 0.5)),
    )


SHORT_OF_MEMORY = (
    Machine(name="edge1", base=0.1, memory=0.92, task_cores=1.5, task_mb=300.0),
    Machine(name="edge2", cores=2.0, base=0.1, task_cores=1.5, task_mb=300.0, own_speed=0.6),
)
FAR_AWAY = (
    Machine(name="edge1", base=0.1, signal_dbm=-55.0, task_cores=1.5, task_mb=100.0),
    Machine(name="edge2", cores=2.0, base=0.1, signal_dbm=-48.0, task_cores=1.5, task_mb=100.0, own_speed=0.6),
)
ONE_THREAD = tuple(
    Machine(name=name, cores=cores, base=0.1, memory=memory, task_cores=0.5, task_mb=300.0, job_s=0.3, own_speed=own)
    for name, cores, memory, own in (("edge1", 4.0, 0.92, 1.0), ("edge2", 0.6, 0.1, 0.5))
)
WITH_NETWORK = Weights(cpu=0.6, memory=0.0, network=0.4)
ALL_THREE = Weights(cpu=0.4, memory=0.3, network=0.3)
_SAME = Machine(name="edge1", task_cores=0.514, threads=2.4, noise=0.02, task_mb=300.0)
FORGOTTEN = (
    replace(_SAME, cores=2.21, base=0.57, memory=0.906, signal_dbm=-58.0, speed=1.525, own_speed=1.046),
    replace(_SAME, name="edge2", cores=1.73, base=0.256, memory=0.49, signal_dbm=-48.0, speed=0.514, own_speed=0.5),
)
"""What the second one did not keep is forgotten while the task is away."""
_SAME = replace(_SAME, task_cores=1.29, threads=2.945, noise=0.0)
TOO_SLOW = (
    replace(_SAME, cores=1.82, base=0.18, memory=0.914, signal_dbm=-56.9, speed=1.89, own_speed=1.07),
    replace(_SAME, name="edge2", cores=1.77, base=0.34, memory=0.282, signal_dbm=-48.0, speed=1.24, own_speed=0.38),
)
"""Neither keeps the deadline, and each looks better from the other one."""


@pytest.mark.long
@settings(derandomize=True, database=None, deadline=None, max_examples=12)
@example(machines=SHORT_OF_MEMORY, weights=BOTH, job_s=None, deadline_ms=None)
@example(machines=FAR_AWAY, weights=WITH_NETWORK, job_s=None, deadline_ms=None)
@example(machines=ONE_THREAD, weights=BOTH, job_s=0.3, deadline_ms=None)
@example(machines=ONE_THREAD, weights=BOTH, job_s=0.05, deadline_ms=400.0)
@example(machines=ONE_THREAD, weights=BOTH, job_s=0.3, deadline_ms=1000.0)
@example(machines=FORGOTTEN, weights=ALL_THREE, job_s=0.02, deadline_ms=1000.0)
@example(machines=TOO_SLOW, weights=BOTH, job_s=0.071, deadline_ms=150.0)
@given(
    machines=tempting_machines(),
    weights=st.sampled_from((BOTH, WITH_NETWORK, ALL_THREE)),
    job_s=st.one_of(st.none(), st.floats(0.02, 0.6)),
    deadline_ms=st.sampled_from((None, 150.0, 1000.0)),
)
def test_where_the_benchmark_says_little_of_a_task_it_comes_to_rest_all_the_same(
    machines: tuple[Machine, ...], weights: Weights, job_s: float | None, deadline_ms: float | None
) -> None:
    """By the benchmark alone the first five are limit cycles of 38 to 79 moves."""
    for machine in machines:
        machine.job_s = job_s
    tuning = replace(BY_SERVICE, deadline_ms=None if job_s is None else deadline_ms)
    moves = Loop(machines, weights=weights, tuning=tuning).run(400.0)
    assert len(moves) <= 4
    assert [at for at, _ in moves if at > 200.0] == []


FULL = tuple(Machine(name=name, cores=2.0, base=1.0, threads=4.0, task_cores=0.3) for name in ("edge1", "edge2"))


@settings(derandomize=True, database=None, deadline=None, max_examples=8)
@example(machines=FULL, job_s=None)
@given(machines=constant_machines(), job_s=st.one_of(st.none(), st.floats(0.001, 0.2)))
def test_a_task_that_has_nothing_to_do_any_more_comes_to_rest(
    machines: tuple[Machine, ...], job_s: float | None
) -> None:
    """What it used when it had is still its need; that it uses nothing now is no lack."""
    for machine in machines:
        machine.works_until, machine.job_s = 30.0, job_s
    loop = Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE)
    assert len([at for at, _ in loop.run(240.0) if at > 30.0]) <= len(machines)


@pytest.mark.parametrize("works_until", [20.0, math.inf])
@pytest.mark.parametrize("task_cores", [0.005, 0.3])
@pytest.mark.parametrize("job_s", [None, 0.001])
def test_a_task_that_lacks_nothing_stays_where_all_machines_are_full(
    works_until: float, task_cores: float, job_s: float | None
) -> None:
    """Each of them would give it a fair share of much; so does its owner, which shows only what it uses."""
    machines = tuple(replace(one, task_cores=task_cores, works_until=works_until, job_s=job_s) for one in FULL)
    assert Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(90.0) == []


@pytest.mark.parametrize("threads", [16.0, 40.0])
@pytest.mark.parametrize("job_s", [None, 0.02])
def test_a_small_task_that_lacks_nothing_stays_on_a_large_machine_that_is_full(
    threads: float, job_s: float | None
) -> None:
    """Its fair share of 16 cores is many times its need, as it is of 2."""
    large = Machine(name="edge1", cores=16.0, base=1.0, threads=threads, task_cores=0.1, job_s=job_s)
    small = Machine(name="edge2", cores=2.0, base=1.0, threads=2.0, task_cores=0.1, job_s=job_s)
    assert Loop((large, small), weights=CPU_ONLY, tuning=BY_SERVICE).run(90.0) == []


@pytest.mark.parametrize("works_until", [60.0, 60.1, 60.3])
@pytest.mark.parametrize("task_cores", [0.8, 2.5])
@pytest.mark.parametrize("job_s", [0.02, 0.3, 1.0])
def test_a_task_whose_input_stops_stays_where_all_machines_are_full(
    works_until: float, task_cores: float, job_s: float
) -> None:
    """What it left undone until then fades slowly and its use at once: that is no worker which is given nothing."""
    machines = tuple(replace(one, task_cores=task_cores, works_until=works_until, job_s=job_s) for one in FULL)
    moves = Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(90.0)
    assert [move for move in moves if move[0] > works_until] == []


BY_LATENCY = replace(BY_SERVICE, deadline_ms=150.0)


@settings(derandomize=True, database=None, deadline=None, max_examples=8)
@example(machines=SLOW_AND_FAST, tuning=BY_LATENCY, job_s=0.2, rub=1.0, most_cores=math.inf)
@given(
    machines=constant_machines(),
    tuning=st.sampled_from((BY_SERVICE, BY_LATENCY, replace(BY_LATENCY, deadline_ms=1000.0))),
    job_s=st.floats(0.02, 1.0),
    rub=st.sampled_from((1.0, 1.3)),
    most_cores=st.sampled_from((math.inf, 0.2)),
)
def test_where_nothing_changes_a_task_whose_worker_tells_of_its_jobs_comes_to_rest(
    machines: tuple[Machine, ...], tuning: Tuning, job_s: float, rub: float, most_cores: float
) -> None:
    """Neither does a deadline make it go round, nor jobs that cost more on a full machine, nor a loss unexplained.

    The first owner may be left before it was seen what the task gets there, and be tried once more.
    """
    for machine in machines:
        machine.job_s, machine.rub, machine.most_cores = job_s, rub, most_cores
        machine.task_cores = min(machine.task_cores, 1.0)
    moves = Loop(machines, weights=CPU_ONLY, tuning=tuning).run(600.0)
    assert len([at for at, _ in moves if at <= 300.0]) <= len(machines) + 1
    assert [at for at, _ in moves if at > 300.0] == []


@pytest.mark.parametrize("deadline_ms", [60.0, 100.0])
def test_a_task_with_a_deadline_goes_where_its_jobs_are_quicker_though_it_loses_none(deadline_ms: float) -> None:
    """Both machines do all of its jobs, in 100 ms and in 50: by service there is nothing to gain."""
    machines = (
        Machine(name="edge1", base=0.1, speed=1.0, task_cores=0.3, job_s=0.1),
        Machine(name="edge2", base=0.1, speed=2.0, task_cores=0.3, job_s=0.1),
    )
    by_latency = replace(BY_SERVICE, deadline_ms=deadline_ms)
    assert Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(60.0) == []
    ((_, where),) = Loop(machines, weights=CPU_ONLY, tuning=by_latency).run(60.0)
    assert where == "edge2"


@pytest.mark.parametrize(("base", "deadline_ms"), [(0.7, 150.0), (0.7, 300.0), (0.9, 150.0)])
def test_a_task_with_a_deadline_stays_where_machines_are_alike_and_somebody_else_works_on_each(
    base: float, deadline_ms: float
) -> None:
    """It has a fair share on both; its own thread on its owner takes nothing from it."""
    machines = tuple(
        Machine(name=name, cores=1.0, base=base, memory=0.2, threads=1.0, task_cores=0.28, job_s=0.1)
        for name in ("edge1", "edge2")
    )
    by_latency = replace(BY_SERVICE, deadline_ms=deadline_ms)
    assert Loop(machines, weights=CPU_ONLY, tuning=by_latency).run(120.0) == []


@pytest.mark.parametrize(
    ("cores", "base", "threads", "task_cores", "job_s", "waits_s", "deadline_ms"),
    [
        (1.0, 1.0, 1.0, 0.4, 0.1, 0.0, 200.0),
        (1.0, 0.7, 1.0, 0.28, 0.1, 0.0, 150.0),
        (2.0, 1.0, 4.0, 0.3, 0.1, 0.0, 300.0),
        (1.0, 1.0, 1.0, 0.6, 0.06, 0.02, None),
        (1.0, 1.0, 1.0, 0.6, 0.06, 0.04, None),
        (1.0, 1.0, 1.0, 0.6, 0.06, 0.04, 200.0),
    ],
)
def test_a_task_that_waits_for_its_turn_comes_to_rest_where_machines_are_alike(
    cores: float,
    base: float,
    threads: float,
    task_cores: float,
    job_s: float,
    waits_s: float,
    deadline_ms: float | None,
) -> None:
    """A wait in the queue is no other's thread, and what it gets between its pauses is all that it will get there."""
    machine = Machine(
        name="edge1", cores=cores, base=base, memory=0.2, threads=threads, task_cores=task_cores, takes_turns=True
    )
    machine = replace(machine, job_s=job_s, waits_s=waits_s)
    by_latency = replace(BY_SERVICE, deadline_ms=deadline_ms)
    loop = Loop((machine, replace(machine, name="edge2")), weights=CPU_ONLY, tuning=by_latency)
    moves = loop.run(150.0)
    assert len(moves) <= 2, "once to see, and back"
    assert [at for at, _ in moves if at > 30.0] == []


@pytest.mark.parametrize("task_cores", [0.15, 0.3])
@pytest.mark.parametrize("deadline_ms", [150.0, 250.0])
def test_jobs_that_a_load_held_up_are_no_reason_to_leave_when_it_has_ended(
    task_cores: float, deadline_ms: float
) -> None:
    """They count in the mean for some seconds; the other machine is free at the same moment, and as quick."""
    machine = Machine(name="edge1", cores=1.0, base=1.0, memory=0.2, threads=8.0, frees_at=30.0, takes_turns=True)
    machine = replace(machine, task_cores=task_cores, job_s=0.1)
    by_latency = replace(BY_SERVICE, deadline_ms=deadline_ms)
    loop = Loop((machine, replace(machine, name="edge2")), weights=CPU_ONLY, tuning=by_latency)
    assert loop.run(60.0) == []


@pytest.mark.parametrize(("grows", "most"), [(False, 2), (True, 5)])
@pytest.mark.parametrize("large", [4.0, 5.0])
def test_jobs_that_differ_move_next_to_nothing_between_machines_that_are_alike(
    large: float, most: int, *, grows: bool
) -> None:
    """Merging maps takes more when robots meet, and more with every metre: each machine seemed slow when it had come.

    Three machines are loaded one after the other, and the task flees at most from each.
    """

    def size(now: float) -> float:
        return 1.0 + (large - 1.0) * (min(now / 60.0, 1.0) if grows else float(now % 11.0 > 6.0))

    def load_from(begin: float) -> Callable[[float], float]:
        return lambda now: 0.9 if begin <= now < begin + 12.0 else 0.0

    machine = Machine(name="edge1", cores=1.0, base=0.05, task_cores=0.3, job_s=0.05, size=size)
    begins = (("edge1", 10.0), ("edge2", 40.0), ("edge3", 70.0))
    machines = tuple(replace(machine, name=name, step=load_from(begin)) for name, begin in begins)
    moves = Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(120.0)
    assert 2 <= len(moves) <= most, moves


QUEUES = Machine(name="edge1", base=0.1, signal_dbm=-45.0, task_cores=0.5, job_s=0.06, queueing=1.0)


@settings(derandomize=True, database=None, deadline=None, max_examples=8)
@example(far_dbm=-55.0, speed=2.0, queueing=1.0, deadline_ms=150.0)
@example(far_dbm=-60.0, speed=2.0, queueing=2.0, deadline_ms=150.0)
@example(far_dbm=-60.0, speed=2.0, queueing=1.0, deadline_ms=100.0)
@given(
    far_dbm=st.floats(-70.0, -45.0),
    speed=st.floats(1.0, 4.0),
    queueing=st.floats(0.2, 3.0),
    deadline_ms=st.floats(60.0, 300.0),
)
def test_a_task_whose_jobs_wait_for_each_other_comes_to_rest(
    far_dbm: float, speed: float, queueing: float, deadline_ms: float
) -> None:
    """A quick machine far away keeps the deadline, and by its short queue the slow one nearby would keep it as well.

    By the owner's queue alone the examples are limit cycles of 19 to 38 moves in 400 s (docs/decisions/0118).
    """
    near = replace(QUEUES, queueing=queueing)
    far = replace(near, name="edge2", speed=speed, signal_dbm=far_dbm)
    tuning = replace(BY_SERVICE, deadline_ms=deadline_ms)
    moves = Loop((near, far), weights=WITH_NETWORK, tuning=tuning).run(400.0)
    assert len(moves) <= 4
    assert [at for at, _ in moves if at > 200.0] == []


def test_a_machine_that_was_too_slow_for_its_queue_has_the_task_again_when_jobs_come_less_often() -> None:
    near = replace(QUEUES, fewer_from=60.0)
    far = replace(near, name="edge2", speed=2.0, signal_dbm=-60.0)
    loop = Loop((near, far), weights=WITH_NETWORK, tuning=replace(BY_SERVICE, deadline_ms=100.0))
    moves = loop.run(400.0)
    assert [where for _, where in moves] == ["edge2", "edge1"]
    assert moves[0][0] < 60.0 < moves[1][0]


@pytest.mark.parametrize("base", [0.7, 1.0])
def test_a_task_whose_worker_somebody_else_starts_rests_where_machines_are_alike(base: float) -> None:
    machine = Machine(
        name="edge1", cores=1.0, base=base, memory=0.2, threads=1.0, task_cores=0.28, job_s=0.1, takes_turns=True
    )
    machine = replace(machine, shows_worker=False)
    by_latency = replace(BY_SERVICE, deadline_ms=150.0)
    loop = Loop(
        (machine, replace(machine, name="edge2")),
        weights=CPU_ONLY,
        tuning=by_latency,
        demand=Demand(cpu_cores=0.28),
    )
    assert loop.run(150.0) == []


@pytest.mark.parametrize(
    ("cores", "base", "need", "told", "others"),
    [(2.0, 0.0, 2.2, 2.2, 0.0), (4.0, 0.0, 4.4, 4.0, 0.0), (4.0, 0.5, 3.0, 3.0, 2.0), (4.0, 0.5, 3.9, 3.1, 2.0)],
)
def test_a_foreign_worker_that_is_too_large_for_machines_that_are_alike_rests(
    cores: float, base: float, need: float, told: float, others: float
) -> None:
    """Those of its threads that wait for each other were taken for others', and it fled from itself: 31 moves."""
    machine = Machine(name="edge1", cores=cores, base=base, memory=0.2, threads=others, task_cores=need)
    machine = replace(machine, shows_worker=False)
    machines = (machine, replace(machine, name="edge2"))
    demand = Demand(cpu_cores=told)
    moves = Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE, demand=demand).run(150.0)
    assert len(moves) <= 1, "where it began nobody had seen the machine without it"


@pytest.mark.parametrize("hidden_mb", [1400.0, 1900.0])
def test_memory_that_a_worker_holds_and_does_not_show_counts_once(hidden_mb: float) -> None:
    """A GPU's on a board where that is the machine's memory; the fleet file says what the task needs of it."""
    machine = Machine(name="edge1", base=0.2, task_cores=0.4, task_mb=100.0, hidden_mb=hidden_mb)
    machines = (machine, replace(machine, name="edge2"))
    demand = Demand(cpu_cores=0.4, memory_mb=100.0 + hidden_mb)
    assert Loop(machines, tuning=BY_SERVICE, demand=demand).run(60.0) == []


def test_a_deadline_that_both_machines_keep_moves_nothing() -> None:
    machines = (
        Machine(name="edge1", base=0.1, speed=1.0, task_cores=0.3, job_s=0.1),
        Machine(name="edge2", base=0.1, speed=2.0, task_cores=0.3, job_s=0.1),
    )
    lenient = replace(BY_SERVICE, deadline_ms=300.0)
    assert Loop(machines, weights=CPU_ONLY, tuning=lenient).run(120.0) == []


def test_an_owner_that_is_measured_to_lose_service_is_left_though_its_figures_are_fine() -> None:
    """It gives the task half a core beside two idle ones; the other machine would give it all."""
    machines = (
        Machine(name="edge1", base=0.2, task_cores=0.9, job_s=0.1, most_cores=0.45),
        Machine(name="edge2", base=0.3, task_cores=0.9, job_s=0.1),
    )
    ((at, where),) = Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(120.0)
    assert where == "edge2"
    assert at < 15.0


def test_a_task_that_began_on_a_machine_too_slow_for_it_leaves_though_it_was_never_seen_unstarved() -> None:
    """The slow one is full with it: by what it uses there it would need no more than it gets."""
    machines = (
        Machine(name="edge1", base=0.1, speed=0.25, task_cores=2.0),
        Machine(name="edge2", base=0.1, task_cores=2.0),
    )
    (move,) = Loop(machines, tuning=BY_SERVICE).run(60.0)
    assert move[1] == "edge2"
    assert move[0] < 5.0


@pytest.mark.parametrize("phase", [0.0, 0.1, 0.33])
def test_a_step_of_30_percent_that_the_task_feels_is_followed_within_3_seconds(phase: float) -> None:
    at = 15.0 + phase
    stepped = Machine(name="edge1", step=lambda now: 0.3 if now >= at else 0.0, task_cores=2.2)
    robots = ("robot1", "robot2", "robot3")
    machines = (stepped, Machine(name="edge2", task_cores=2.2))
    ((moved_at, where),) = Loop(machines, robots=robots, tuning=BY_SERVICE).run(22.0)
    assert where == "edge2"
    assert moved_at - at <= 3.0


def test_a_step_that_the_task_does_not_feel_moves_nothing() -> None:
    stepped = Machine(name="edge1", step=lambda now: 0.3 if now >= 15.0 else 0.0, task_cores=0.4)
    machines = (stepped, Machine(name="edge2", task_cores=0.4))
    assert Loop(machines, tuning=BY_SERVICE).run(60.0) == []


@pytest.mark.parametrize(("task_cores", "at_most", "seed"), [(0.4, 0, 0), (2.0, 0, 1), (3.2, 6, 0), (3.2, 6, 1)])
def test_two_equal_nodes_under_noise_keep_a_task_that_is_scored_by_service(
    task_cores: float, at_most: int, seed: int
) -> None:
    """In a quarter of an hour; the last one lacks CPU on both, where noise looks like work to be had."""
    machines = tuple(Machine(name=name, noise=0.15, task_cores=task_cores) for name in ("edge1", "edge2"))
    assert len(Loop(machines, tuning=BY_SERVICE, seed=seed).run(HOUR_S / 4)) <= at_most


def test_without_a_price_noise_would_move_a_starved_task_all_the_time() -> None:
    """The control: the price of a move is what keeps it."""
    machines = tuple(Machine(name=name, noise=0.15, task_cores=3.2) for name in ("edge1", "edge2"))
    assert len(Loop(machines, tuning=BY_SERVICE, price_s=0.0).run(HOUR_S / 12)) > 12


def test_machines_that_promise_more_than_they_give_do_not_hand_the_task_to_each_other() -> None:
    """Both are full, and by their few threads a fair share of them is much; what it gets there is half a core."""
    machines = tuple(Machine(name=name, base=0.95, task_cores=3.0, threads=1.0) for name in ("edge1", "edge2"))
    assert len(Loop(machines, weights=CPU_ONLY, tuning=BY_SERVICE).run(300.0)) <= 1


# --- several robots ------------------------------------------------------------------------------------------------


def test_three_robots_that_hear_the_same_move_together_and_once() -> None:
    stepped = Machine(name="edge1", step=lambda now: 0.4 if now >= 20.0 else 0.0, noise=0.05)
    machines = (stepped, Machine(name="edge2", noise=0.05), Machine(name="edge3", noise=0.05, base=0.3))
    loop = Loop(machines, robots=("robot1", "robot2", "robot3"), seed=5)

    assert [where for _, where in loop.run(120.0)] == ["edge3"]
    assert loop.allocation.epoch == 2
