"""What counts as used on a candidate: the task's own worker once, other tasks' demand as far as it does not show."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.utility import service_utility
from zsched.core.values.fleet import Demand, TaskSpec, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState, ScoreForm, Tuning, Utility, Weights
from zsched.core.values.profile import MAX_CPU_CORES, WorkerLoad, WorkerState

TASKS = tuple(
    task_of(name, ("edge1",), worker=WorkerSpec(command=("work",)), demand=Demand(cpu_cores=0.5, memory_mb=200.0))
    for name in ("map", "plan", "watch")
)
MAP, PLAN, WATCH = TASKS
FLEET = fleet_of(*TASKS, of=("edge1", "robot1"), electors=("robot1",))
NOBODY = allocation_of(owner=None, task="map")
READY = WorkerState.READY
CPU = Weights(cpu=1.0, memory=0.0, network=0.0)


def load(task: str, cpu: float | None = None, memory: float | None = None) -> WorkerLoad:
    return load_of(task, READY, cpu_cores=cpu, memory_mb=memory)


def seen(*workers: WorkerLoad, cpu: float = 1.0, memory: float = 1000.0, booked: tuple[TaskSpec, ...] = ()) -> Utility:
    """How robot1 scores edge1 for the task ``map``."""
    gateway = Gateway(InForce(FLEET))
    profile = profile_of(
        cpu_used_cores=cpu,
        memory_used_mb=memory,
        workers=(load("map"), *workers) if not any(one.task == "map" for one in workers) else workers,
    )
    assert gateway.absorb(profile, 10.0) is None
    states = {"edge1": PeerState.ALIVE, "robot1": PeerState.ALIVE}
    (utility,) = score(
        TASKS[0], NOBODY, "robot1", gateway, states, 10.0, {"edge1": booked} if booked else None
    ).utilities
    return utility


def test_what_the_task_s_own_worker_uses_is_not_counted_twice() -> None:
    idle = seen(load("map"), cpu=1.0, memory=1000.0)
    assert seen(load("map", cpu=0.4, memory=150.0), cpu=1.4, memory=1150.0) == idle
    assert seen(load("map", cpu=0.0, memory=0.0), cpu=1.0, memory=1000.0) == idle
    assert seen(load("map"), cpu=1.4).cpu != idle.cpu
    assert seen(load("map"), memory=1150.0).memory != idle.memory


def test_a_task_that_came_to_a_machine_whose_cpu_is_not_measured_shows_there_after_a_while() -> None:
    """It was booked on top of the machine's memory for good: the other task found no room where there was some."""
    gateway = Gateway(InForce(fleet_of(*TASKS, of=("edge1", "edge2", "robot1"), electors=("robot1",))))
    for step, owner in enumerate(["edge1"] * 4 + ["edge2"] * 40):
        now = 10.0 + 0.5 * step
        held = profile_of(owner, sequence=step, cpu_used_cores=None, workers=(load("plan"),))
        assert gateway.absorb(held, now) is None
        gateway.learn_demand("plan", owner, now)
    assert gateway.demands.unshown_ratio("plan", "edge2", now) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    ("shown", "cpu", "memory"),
    [
        (load("plan"), 0.5, 200.0),
        (load("plan", 0.0, 0.0), 0.5, 200.0),
        (load("plan", 0.2, 50.0), 0.3, 150.0),
        (load("plan", 0.5, 200.0), 0.0, 0.0),
        (load("plan", 0.9, 900.0), 0.0, 0.0),
    ],
)
def test_what_another_task_will_use_counts_as_far_as_its_worker_does_not_show_it(
    shown: WorkerLoad, cpu: float, memory: float
) -> None:
    utility = seen(shown, booked=(PLAN,))
    same = seen(shown, cpu=1.0 + cpu, memory=1000.0 + memory)
    assert (utility.cpu, utility.memory) == pytest.approx((same.cpu, same.memory))


@pytest.mark.parametrize("coming_cores", [0.0, 0.5, 6.0])
def test_an_owner_that_is_short_keeps_its_share_beside_what_comes_and_gets_no_more_than_now(
    coming_cores: float,
) -> None:
    """A candidate would share with what comes: taken off what the owner gets, the task would go there and back."""
    spec = replace(MAP, candidates=("edge1", "edge2"), demand=Demand(cpu_cores=3.0))
    plan = replace(PLAN, demand=Demand(cpu_cores=0.5 + coming_cores))
    fleet = fleet_of(spec, plan, of=("edge1", "edge2", "robot1"), electors=("robot1",))
    gateway = Gateway(InForce(fleet))
    here = (load_of("map", READY, cpu_cores=1.5, wanted_cores=3.0, runnable=3.0), load("plan", 0.5))
    there = (load_of("map", READY, cpu_cores=0.0, runnable=0.0), load("plan", 0.5))
    assert gateway.absorb(profile_of("edge1", cpu_used_cores=4.0, workers=here, runnable=8.0), 10.0) is None
    assert gateway.absorb(profile_of("edge2", cpu_used_cores=4.0, workers=there, runnable=5.0), 10.0) is None
    agreed = allocation_of(task="map", tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    gateway.learn_demand("map", "edge1", 10.0)
    states = dict.fromkeys(("edge1", "edge2", "robot1"), PeerState.ALIVE)
    booked = {"edge1": (plan,), "edge2": (plan,)}
    terms = {one.candidate: one.cpu for one in score(spec, agreed, "robot1", gateway, states, 10.0, booked).utilities}
    assert terms["edge1"] == pytest.approx(terms["edge2"])
    assert terms["edge1"] == pytest.approx(service_utility(4.0 * 3.0 / (8.0 + coming_cores), 3.0, 4.0))


def test_several_tasks_add_up_and_our_own_and_a_stranger_s_do_not_count() -> None:
    both = seen(load("plan"), load("watch"), booked=(PLAN, WATCH))
    same = seen(load("plan"), load("watch"), cpu=2.0, memory=1400.0)
    assert (both.cpu, both.memory) == pytest.approx((same.cpu, same.memory))
    plain = seen(load("plan"))
    assert seen(load("plan"), booked=(MAP,)) == plain
    assert seen(load("plan"), booked=(WATCH,)) == plain, "it runs no worker that zsched would see"


def test_what_somebody_else_starts_is_coming_only_until_the_machine_s_figures_show_it() -> None:
    """No profile says what such a worker uses, so it would count twice for as long as it is there."""
    plan = replace(PLAN, worker=WorkerSpec(), candidates=("edge0", "edge1"))
    fleet = fleet_of(MAP, plan, of=("edge0", "edge1", "robot1"), electors=("robot1",))
    states = dict.fromkeys(("edge0", "edge1", "robot1"), PeerState.ALIVE)
    gateway = Gateway(InForce(fleet))

    def coming_cores(now: float, owner: str | None) -> float:
        """What robot1 takes for coming on edge1, by its worth for the task ``map``; the profiles say nothing of it."""
        for node in ("edge0", "edge1"):
            assert (
                gateway.absorb(profile_of(node, sequence=next(turn), workers=(load("map"), load("plan"))), now) is None
            )
        gateway.learn_demand("plan", owner, now)
        utilities = score(MAP, NOBODY, "robot1", gateway, states, now, {"edge1": (plan,)}).utilities
        (utility,) = (one for one in utilities if one.candidate == "edge1")
        idle = 1.0 if utility.cpu is None else utility.cpu
        return (free_of_nothing - idle) * 4.0

    turn = itertools.count()
    gateway.absorb(profile_of("edge1", sequence=next(turn), workers=(load("map"), load("plan"))), 0.0)
    (alone,) = score(MAP, NOBODY, "robot1", gateway, states, 0.0).utilities
    free_of_nothing = alone.cpu or 0.0

    assert coming_cores(1.0, "edge1") == 0.0, "it has been there for as long as this robot knows"
    assert coming_cores(2.0, "edge0") == pytest.approx(PLAN.demand.cpu_cores), "it is to come from edge0"
    assert coming_cores(3.0, "edge1") == pytest.approx(PLAN.demand.cpu_cores), "it has just come"
    assert coming_cores(3.5, "edge1") == pytest.approx(PLAN.demand.cpu_cores / math.e)
    assert coming_cores(9.0, "edge1") < 0.001
    assert coming_cores(9.5, None) == pytest.approx(PLAN.demand.cpu_cores), "it is to be placed"
    assert coming_cores(10.0, "edge1") == pytest.approx(PLAN.demand.cpu_cores), "its first owner has just got it"
    assert coming_cores(19.0, "edge1") < 0.001


def test_what_a_failed_worker_had_come_to_use_is_not_kept_for_it() -> None:
    """An idle machine was refused for good, for the memory of a worker that is no more; the file's figure stays."""
    other = replace(PLAN, candidates=("edge1",))
    fleet = fleet_of(MAP, other, of=("edge1", "robot1"), electors=("robot1",))
    gateway, states = Gateway(InForce(fleet)), {"edge1": PeerState.ALIVE, "robot1": PeerState.ALIVE}

    def seen_free(number: int, plan: WorkerLoad, used: float) -> Utility:
        told = profile_of(sequence=number, cpu_used_cores=used, workers=(load("map", 0.0, 0.0), plan))
        assert gateway.absorb(told, float(number)) is None
        gateway.learn_demand("plan", "edge1", float(number))
        vector = score(MAP, NOBODY, "robot1", gateway, states, float(number), {"edge1": (other,)})
        assert vector.refused == ()
        return vector.utilities[0]

    for number in range(1, 20):
        seen_free(number, load("plan", cpu=2.0, memory=2500.0), 3.0)
    failed = load_of("plan", WorkerState.FAILED, cpu_cores=0.0, memory_mb=0.0)
    by_file = seen_free(20, failed, 1.0)
    gateway.forget("plan")
    assert seen_free(21, failed, 1.0) == by_file
    assert seen_free(22, load("plan", 0.0, 0.0), 1.0) == by_file


def with_gpu(owner: str | None, seen_at: str | None, reading: float, now: float) -> tuple[tuple[str, str], ...]:
    """Why ``map``, which needs 35 % of a GPU and is at ``owner``, is refused, where ``plan`` needs as much.

    ``plan`` has been seen at ``seen_at``, is on edge1 now, and shows there since the time 0.
    """
    nodes = ("edge1", "edge2")
    mine, other = (
        replace(one, candidates=nodes, demand=Demand(gpu=0.35), gauge_limits=(("gpu", 0.9),)) for one in (MAP, PLAN)
    )
    gateway = Gateway(InForce(fleet_of(mine, other, of=(*nodes, "robot1"), electors=("robot1",))))
    times = [(-9.0, seen_at)] if seen_at else []
    for sequence, (at, plan_owner) in enumerate([*times, (0.0, "edge1"), (now, "edge1")]):
        for node in nodes:
            workers, gauges = (load("map", 0.1), load("plan", 0.1)), (("gpu", reading if node == "edge1" else 0.0),)
            told = profile_of(node, sequence=sequence, workers=workers, gauges=gauges)
            assert gateway.absorb(told, at) is None
        gateway.learn_demand("plan", plan_owner, at)
    agreed = replace(NOBODY, owner=owner)
    states = dict.fromkeys((*nodes, "robot1"), PeerState.ALIVE)
    return score(mine, agreed, "robot1", gateway, states, now, {"edge1": (other,)}).refused


def test_a_task_that_has_come_to_a_gpu_drives_nobody_out_whom_it_leaves_room_for() -> None:
    """It was added for 6 s to what showed it already: four tasks on three machines moved in a ring, every 6 s."""
    for now in (0.2, 1.0, 3.0, 6.0):
        assert with_gpu("edge1", "edge2", 0.7, now) == ()


def test_whoever_would_come_beside_it_finds_the_gpu_as_full_as_it_is_about_to_be() -> None:
    told = dict(with_gpu("edge2", "edge2", 0.3, 0.2))
    assert list(told) == ["edge1"]
    assert with_gpu("edge2", "edge2", 0.3, 9.0) == (), "what shows by then is all"
    assert with_gpu("edge2", None, 0.4, 0.2) == (), "nobody has just come for a robot that has just started"


def test_whatever_a_profile_tells_a_robot_can_score() -> None:
    """One frame with figures at the ends of what a profile may hold ended every robot's daemon."""
    tasks = tuple(replace(one, candidates=("edge1", "edge2")) for one in TASKS)
    gateway = Gateway(InForce(fleet_of(*tasks, of=("edge1", "edge2", "robot1"), electors=("robot1",))))
    huge = tuple(load(one.name, cpu=4000.0, memory=1e8) for one in tasks)
    states = dict.fromkeys(("edge1", "edge2", "robot1"), PeerState.ALIVE)
    for sequence, used in enumerate((3000.0, 4096.0)):
        told = profile_of("edge1", sequence=sequence, cpu_cores=4096.0, cpu_used_cores=used, speed=2.0, workers=huge)
        idle = profile_of("edge2", sequence=sequence, speed=0.001, workers=tuple(load(one.name) for one in tasks))
        for one in (told, idle):
            assert gateway.absorb(one, float(sequence)) is None
        for task in tasks:
            gateway.learn_demand(task.name, "edge1", float(sequence))
    for task in tasks:
        assert gateway.demand(task, idle).cpu_cores <= MAX_CPU_CORES, "a decision that is told holds it"
        agreed = allocation_of(owner="edge1", task=task.name)
        vector = score(task, agreed, "robot1", gateway, states, 1.5, {"edge1": tasks, "edge2": tasks})
        assert {one.candidate for one in vector.utilities} | {name for name, _ in vector.refused} == {"edge1", "edge2"}


def test_where_somebody_else_starts_the_worker_its_whole_demand_is_added() -> None:
    """No load of the task is in the profile: nothing of what is used is its own."""
    unseen, seen_idle = (profile_of(workers=workers) for workers in ((), (load("map", 0.0, 0.0),)))
    terms = []
    for profile in (unseen, seen_idle):
        gateway = Gateway(InForce(FLEET))
        gateway.absorb(profile, 10.0)
        states = {"edge1": PeerState.ALIVE, "robot1": PeerState.ALIVE}
        spec = replace(TASKS[0], worker=WorkerSpec())
        (utility,) = score(spec, NOBODY, "robot1", gateway, states, 10.0).utilities
        terms.append((utility.cpu, utility.memory))
    assert terms[0] == terms[1]
