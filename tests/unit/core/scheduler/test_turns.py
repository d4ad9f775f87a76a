"""Whose planned move goes first when several tasks want to move, and what a booked task weighs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.claims import claims_of_others
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.turns import in_turn, who_moves_first
from zsched.core.scheduler.usage import book
from zsched.core.scheduler.utility import service_utility
from zsched.core.values.fleet import Demand, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, PeerState, ScoreForm, Tuning, UtilityVector, Weights
from zsched.core.values.profile import DeviceSample, WorkerLoad, WorkerState
from zsched.core.vote.voting import Voting


@dataclass
class Task:
    opened_at: float | None = None
    commit: object | None = None
    awaited_until: float = -math.inf
    called_at: float = -math.inf
    bound_for: str | None = None

    def going_to(self, now: float) -> str | None:
        assert now >= 0.0
        return self.bound_for


def test_a_planned_move_waits_for_an_open_vote_and_for_a_commit() -> None:
    for moving in (Task(opened_at=1.0), Task(commit="move"), Task(awaited_until=2.1)):
        assert who_moves_first({"a": moving, "b": Task()}, "b", is_called=False, now=2.0) == "a"
        assert who_moves_first({"a": Task(), "b": moving}, "a", is_called=False, now=2.0) == "b"
        assert who_moves_first({"a": moving}, "a", is_called=False, now=2.0) is None, "its own does not count"


def test_two_votes_called_at_once_are_settled_by_name_and_a_commit_goes_before_both() -> None:
    crossed = {"a": Task(opened_at=1.0), "b": Task(opened_at=1.0)}
    assert who_moves_first(crossed, "a", is_called=True, now=2.0) is None
    assert who_moves_first(crossed, "b", is_called=True, now=2.0) == "a"
    assert who_moves_first({"a": Task(opened_at=1.0), "b": Task(commit="move")}, "a", is_called=True, now=2.0) == "b"


def test_a_vote_that_was_won_goes_first_whoever_commits_it_but_not_for_ever() -> None:
    tasks = {"a": Task(), "b": Task(awaited_until=2.0)}
    assert who_moves_first(tasks, "a", is_called=True, now=1.9) == "b"
    assert who_moves_first(tasks, "a", is_called=True, now=2.0) is None


def test_a_claim_is_every_other_task_s_that_is_about_to_go_somewhere() -> None:
    tasks = {"a": Task(bound_for="edge1"), "b": Task(), "c": Task(bound_for="edge2")}
    assert claims_of_others(tasks, "a", now=2.0) == {"c": "edge2"}
    assert claims_of_others(tasks, "b", now=2.0) == {"a": "edge1", "c": "edge2"}


def test_who_has_proposed_longest_ago_is_judged_first() -> None:
    tasks = {"a": Task(called_at=9.0), "b": Task(called_at=3.0), "c": Task()}
    assert in_turn(tasks) == ["c", "b", "a"]
    assert in_turn({"b": Task(), "a": Task()}) == ["a", "b"]


def test_a_move_keeps_its_turn_for_a_second_try_and_loses_it_then_or_when_it_has_succeeded() -> None:
    """An owner that is slow to stop leaves by the next vote, if that comes before its lease is granted again."""
    voting = Voting(InForce(FLEET), "robot1")
    voting.call(3.0)
    assert voting.called_at == -math.inf, "it is first again"
    voting.call(5.0)
    assert voting.called_at == 5.0, "and lets others pass"
    voting.call(7.0)
    assert voting.called_at == 5.0
    voting.on_learnt()
    assert voting.called_at == 7.0, "it has moved"
    voting.on_learnt()
    assert voting.called_at == 7.0, "somebody else's change is no try of ours"


# --- bookings --------------------------------------------------------------------------------------------------------

DEMAND = Demand(cpu_cores=1.0, memory_mb=800.0)
A, B = (task_of(name, demand=DEMAND, worker=WorkerSpec(command=("work",))) for name in ("a", "b"))
FLEET = fleet_of(A, B, of=("edge1", "edge2"), electors=("robot1",))
ALIVE = dict.fromkeys(("edge1", "edge2"), PeerState.ALIVE)


def values(owner_of_a: str | None, owner_of_b: str | None = None) -> dict[str, Allocation]:
    owners = {"a": owner_of_a, "b": owner_of_b}
    return {name: allocation_of(owner=o, task=name) for name, o in owners.items()}


def scored_b(gateway: Gateway, agreed: dict[str, Allocation]) -> UtilityVector:
    return score(B, agreed["b"], "robot1", gateway, ALIVE, 0.0, book(FLEET.tasks, agreed))


def gateway_with(*workers_on_edge1: WorkerLoad, memory_mb: float = 1000.0) -> Gateway:
    gateway, idle = Gateway(InForce(FLEET)), load_of("b", cpu_cores=0.0, memory_mb=0.0)
    for node, shown in (("edge1", workers_on_edge1), ("edge2", ())):
        workers = shown if any(load.task == "b" for load in shown) else (*shown, idle)
        seen_cores = sum(load.cpu_cores or 0.0 for load in workers)
        seen_mb = sum(load.memory_mb or 0.0 for load in workers)
        profile = profile_of(node, cpu_used_cores=1.0 + seen_cores, memory_used_mb=memory_mb + seen_mb, workers=workers)
        assert gateway.absorb(profile, 0.0) is None
    return gateway


def of_a(cpu: float | None, memory: float | None) -> WorkerLoad:
    return load_of("a", cpu_cores=cpu, memory_mb=memory)


def value(vector: UtilityVector, node: str) -> float:
    return next(one.value for one in vector.utilities if one.candidate == node)


@pytest.mark.parametrize("shown", [0.0, 0.5, 1.0, None])
def test_a_task_that_has_just_come_counts_before_its_load_shows_and_not_twice_afterwards(shown: float | None) -> None:
    load = of_a(shown, None if shown is None else shown * DEMAND.memory_mb)
    vector = scored_b(gateway_with(load), values("edge1"))
    # 4 cores: 1 in use by others, 1 by a (seen or not), 1 by b; 4000 MiB: 1000, 800, 800
    assert value(vector, "edge1") == pytest.approx(0.5 * 0.25 + 0.5 * 1400 / 4000)
    assert value(vector, "edge2") == pytest.approx(0.5 * 0.5 + 0.5 * 2200 / 4000)


def test_nothing_is_booked_for_a_task_elsewhere_for_oneself_and_where_no_worker_is() -> None:
    for agreed, workers in ((values("edge2"), (of_a(0.0, 0.0),)), (values("edge1"), ())):
        vector = scored_b(gateway_with(*workers), agreed)
        assert value(vector, "edge1") == pytest.approx(0.5 * 0.5 + 0.5 * 2200 / 4000)
    own = load_of("b", cpu_cores=0.0, memory_mb=0.0)
    assert value(scored_b(gateway_with(own), values(None, "edge1")), "edge1") == pytest.approx(0.625)


def test_memory_that_is_booked_cannot_be_had_twice() -> None:
    vector = scored_b(gateway_with(of_a(0.0, 0.0), memory_mb=2800.0), values("edge1"))
    assert dict(vector.refused) == {"edge1": "needs 800 MiB, has 400 free"}


@pytest.mark.parametrize(
    ("owner_of_b", "owner_state", "held_s", "refused"),
    [
        ("edge2", PeerState.GONE, 60.0, {}),
        ("edge1", PeerState.ALIVE, 60.0, {}),
        (None, PeerState.ALIVE, 60.0, {}),
        ("edge2", PeerState.GONE, 59.0, {"edge1": "needs 800 MiB, has 0 free"}),
        ("edge2", PeerState.ALIVE, 60.0, {"edge1": "needs 800 MiB, has 0 free"}),
    ],
)
def test_memory_that_another_worker_holds_and_no_process_shows_leaves_no_task_without_a_place(
    owner_of_b: str | None, owner_state: PeerState, held_s: float, refused: dict[str, str]
) -> None:
    """A board whose GPU uses the machine's memory: a asks for 3000 MiB, and 500 of them show."""
    large = replace(A, demand=Demand(memory_mb=3000.0))
    gateway = Gateway(InForce(fleet_of(large, B, of=("edge1", "edge2"), electors=("robot1",))))
    workers = (load_of("a", cpu_cores=0.1, memory_mb=500.0), load_of("b", cpu_cores=0.0, memory_mb=50.0))
    at_home = profile_of(memory_mb=6500.0, memory_used_mb=1500.0 + 3000.0, workers=workers)
    away = profile_of("edge2", memory_mb=6500.0, workers=(load_of("b", cpu_cores=0.0, memory_mb=50.0),))
    for sequence, now in enumerate((0.0, held_s)):
        for one in (at_home, away):
            gateway.absorb(replace(one, sequence=sequence), now)
        gateway.learn_demand("a", "edge1", now)
    agreed = values("edge1", owner_of_b)
    states = {**ALIVE, "edge2": owner_state} if owner_of_b == "edge2" else ALIVE
    vector = score(B, agreed["b"], "robot1", gateway, states, held_s, book((large, B), agreed))
    assert dict(vector.refused) == refused


@pytest.mark.parametrize("mine", ["a", "b"])
def test_two_tasks_that_fit_a_machine_keep_it_though_a_robot_has_just_begun_to_look(mine: str) -> None:
    """Both hold memory that no process shows: 1500 by others, 3000 and 1850 by theirs, of 6500."""
    specs = {"a": replace(A, demand=Demand(memory_mb=3000.0)), "b": replace(B, demand=Demand(memory_mb=1850.0))}
    gateway = Gateway(InForce(fleet_of(*specs.values(), of=("edge1", "edge2"), electors=("robot1",))))
    workers = (load_of("a", cpu_cores=0.1, memory_mb=500.0), load_of("b", cpu_cores=0.1, memory_mb=50.0))
    gateway.absorb(profile_of(memory_mb=6500.0, memory_used_mb=6350.0, workers=workers), 0.0)
    for name in specs:
        gateway.learn_demand(name, "edge1", 0.0)
    tuning = tuning_of(score=ScoreForm.SERVICE)
    agreed = {name: allocation_of(owner="edge1", task=name, tuning=tuning) for name in specs}
    vector = score(specs[mine], agreed[mine], "robot1", gateway, ALIVE, 0.0, book(specs.values(), agreed))
    assert dict(vector.refused) == {"edge2": "no fresh profile"}


STARVED = Demand(cpu_cores=2.0, memory_mb=100.0)
TUNING = tuning_of(cpu=1.0, memory=0.0, score=ScoreForm.SERVICE)
STARVED_A, STARVED_B = (
    task_of(name, demand=STARVED, tuning=TUNING, worker=WorkerSpec(command=("work",))) for name in ("a", "b")
)


def terms_of_a(*, used: float, of_a: float, of_b: float, wants: float | None = 2.0) -> tuple[float, float]:
    """What edge1, which owns a and b, and edge2 are worth to a: 2 cores each, and edge2 has 0.2 free."""
    gateway = Gateway(InForce(fleet_of(STARVED_A, STARVED_B, of=("edge1", "edge2"), electors=("robot1",))))
    for node, cores, figures in (("edge1", used, (of_a, of_b)), ("edge2", 1.8, (0.0, 0.0))):
        workers = tuple(
            load_of(name, cpu_cores=own, memory_mb=100.0, wanted_cores=wants if own else None)
            for name, own in zip(("a", "b"), figures, strict=True)
        )
        profile = profile_of(node, cpu_cores=2.0, cpu_used_cores=cores, workers=workers, runnable=None)
        assert gateway.absorb(profile, 0.0) is None
    agreed = {name: allocation_of(owner="edge1", task=name, tuning=TUNING) for name in ("a", "b")}
    booked = book((STARVED_A, STARVED_B), agreed)
    vector = score(STARVED_A, agreed["a"], "robot1", gateway, ALIVE, 0.0, booked)
    return value(vector, "edge1"), value(vector, "edge2")


def test_what_another_task_lacks_on_a_full_machine_is_not_counted_against_a_task_that_lacks_as_much() -> None:
    owner, other = terms_of_a(used=2.0, of_a=1.0, of_b=1.0)
    assert owner == pytest.approx(service_utility(1.0, 2.0, 2.0))
    assert other == pytest.approx(service_utility(0.2, 2.0, 2.0))


def test_what_it_lacks_counts_as_coming_as_soon_as_the_machine_has_room_for_it() -> None:
    """A load has ended: the next reading shows b with all that it wants, and nothing is left for others."""
    assert terms_of_a(used=1.2, of_a=0.2, of_b=1.0)[0] == pytest.approx(service_utility(0.0, 2.0, 2.0))


def test_a_task_that_has_just_come_to_a_full_machine_counts_until_it_shows_that_it_lacks_cpu() -> None:
    assert terms_of_a(used=2.0, of_a=1.0, of_b=0.0)[0] == pytest.approx(service_utility(0.0, 2.0, 2.0))


# --- GPUs ------------------------------------------------------------------------------------------------------------

ON_GPU = Tuning(weights=Weights.of({"cpu": 0.5, "gpu": 0.5}), score=ScoreForm.SERVICE, bonus=0.05)
TWO = tuple(task_of(name, demand=Demand(gpu=0.4), tuning=ON_GPU, price_s=0.3) for name in ("a", "b"))


def test_two_tasks_that_leave_one_gpu_at_the_same_moment_do_not_go_together() -> None:
    """Each moves by its own figures; the second one comes a round later, before the first one's use shows."""
    fleet = fleet_of(*TWO, of=("edge1", "edge2"), electors=("robot1",))
    gateway, owners = Gateway(InForce(fleet)), {"a": "edge1", "b": "edge1"}
    profilers = {name: Profiler(name, 1, fleet.timing) for name in ("edge1", "edge2")}
    moves = 0
    for step in range(300):
        now = 0.2 * step
        for name, profiler in profilers.items():
            used = 0.4 * sum(owner == name for owner in owners.values())
            loads = tuple(load_of(task, cpu_cores=0.1, memory_mb=100.0) for task in owners)
            sample = DeviceSample(cpu_cores=4.0, cpu_used_cores=0.5, memory_mb=4000.0, memory_used_mb=1000.0)
            profiler.absorb(replace(sample, workers=loads, gauges=(("gpu", used),)), (), now)
            ready = dict.fromkeys(owners, WorkerState.READY)
            profile = profiler.publishable(ready, is_draining=False, now=now)
            if profile is not None:
                assert gateway.absorb(profile, now) is None
        agreed = {name: allocation_of(owner=owner, task=name, tuning=ON_GPU) for name, owner in owners.items()}
        turn = TWO[step % 2]  # a vote a round
        for name, owner in owners.items():
            gateway.learn_demand(name, owner, now)
        vector = score(turn, agreed[turn.name], "robot1", gateway, ALIVE, now, book(TWO, agreed))
        told = {one.candidate: one.value for one in vector.utilities}
        best = max(told, key=lambda name: told[name])
        if now >= 10.0 and told[best] > told[owners[turn.name]] + ON_GPU.bonus:
            owners[turn.name], moves = best, moves + 1
    assert (sorted(owners.values()), moves) == (["edge1", "edge2"], 1)
