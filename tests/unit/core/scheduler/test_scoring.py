from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.eligibility import NO_DOUBTS, Doubts
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import LOST_S, compare, pick, reaches_owner
from zsched.core.scheduler.utility import service_utility
from zsched.core.values.fleet import Demand, Standby, TaskSpec, Timing, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import (
    Allocation,
    PeerState,
    Reach,
    ScoreForm,
    Tuning,
    Utility,
    UtilityVector,
    Weights,
)
from zsched.core.values.profile import Jobs, Link, LinkSource, Profile, WorkerLoad, WorkerState
from zsched.core.values.veto import Filter, Veto

CPU = Weights(cpu=1.0, memory=0.0, network=0.0)
HALVES = Weights(cpu=0.5, memory=0.0, network=0.5)
WIRED = (Link(source=LinkSource.WIRED),)
SPEC = task_of(
    candidates=("edge1", "edge2", "edge3"), tuning=Tuning(weights=CPU), worker=WorkerSpec(command=("worker",))
)


def radio(rssi: float | None, peer: str | None = None) -> tuple[Link, ...]:
    return (Link(source=LinkSource.NL80211, peer=peer, rssi_dbm=rssi),)


def profile(
    node: str,
    *,
    cpu: float | None = 1.0,
    memory: float | None = 1000.0,
    links: tuple[Link, ...] = WIRED,
    state: WorkerState | None = WorkerState.READY,
    own: tuple[float, float] = (0.0, 0.0),
    draining: bool = False,
) -> Profile:
    load = () if state is None else (load_of(state=state, cpu_cores=own[0], memory_mb=own[1]),)
    return profile_of(
        node, sequence=0, cpu_used_cores=cpu, memory_used_mb=memory, links=links, workers=load, draining=draining
    )


def allocation(weights: Weights = CPU, owner: str | None = "edge1") -> Allocation:
    return allocation_of(7, owner, epoch=3, tuning=Tuning(weights=weights))


def scored(
    *profiles: Profile,
    spec: TaskSpec = SPEC,
    agreed: Allocation | None = None,
    voter: str = "robot1",
    states: Mapping[str, PeerState] | None = None,
    age_s: float = 0.0,
    doubts: Doubts = NO_DOUBTS,
) -> UtilityVector:
    names = sorted({*spec.candidates, voter, *(one.node for one in profiles)})
    fleet = fleet_of(spec, of=names, electors=(voter,))
    gateway = Gateway(InForce(fleet))
    for one in profiles:
        assert gateway.absorb(one, 0.0) is None
    seen = dict.fromkeys(names, PeerState.ALIVE) | dict(states or {})
    return score(spec, agreed or allocation(), voter, gateway, seen, age_s, doubts=doubts)


def values(vector: UtilityVector) -> dict[str, float]:
    return {utility.candidate: utility.value for utility in vector.utilities}


ROBOT = profile("robot1", links=radio(-50.0), state=None)
EDGES = (profile("edge1", cpu=3.0), profile("edge2", cpu=2.0), profile("edge3", cpu=1.0))


# --- the score's form ------------------------------------------------------------------------------------------------


def test_machines_that_lack_what_the_task_needs_are_told_apart_by_the_service_form_only() -> None:
    """One is idle, one is starved, both have less left than a task of a whole machine needs."""
    spec = replace(SPEC, candidates=("edge1", "edge2"), demand=Demand(cpu_cores=4.0, memory_mb=500.0))
    edges = (profile("edge1", cpu=3.9), profile("edge2", cpu=0.1))
    half = Weights(cpu=0.5, memory=0.5, network=0.0)
    found = {}
    for form in ScoreForm:
        agreed = replace(allocation(half, owner=None), tuning=Tuning(weights=half, score=form))
        found[form] = values(scored(ROBOT, *edges, spec=spec, agreed=agreed))

    assert found[ScoreForm.PAPER]["edge1"] == found[ScoreForm.PAPER]["edge2"]
    assert found[ScoreForm.SERVICE]["edge1"] < found[ScoreForm.SERVICE]["edge2"] / 4


def test_a_full_machine_is_worth_the_fair_share_of_it_to_all_but_an_owner_that_lacks_cpu() -> None:
    """Four threads wait beside the task's two; what such an owner gives is measured, and was not much."""
    spec = replace(SPEC, candidates=("edge1", "edge2"), demand=Demand(cpu_cores=2.0))
    agreed = allocation_of(7, epoch=3, tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    full = [
        replace(profile(name, cpu=4.0, own=(0.2 if name == "edge1" else 0.0, 0.0)), runnable=runnable)
        for name, runnable in (("edge1", 4.2), ("edge2", 4.0))  # its own is among them
    ]
    told = values(scored(ROBOT, *full, spec=spec, agreed=agreed))
    untold = values(scored(ROBOT, *(replace(one, runnable=None) for one in full), spec=spec, agreed=agreed))
    assert told["edge2"] == pytest.approx(service_utility(4.0 * 2 / 6, 2.0, 4.0))
    assert untold["edge2"] == pytest.approx(0.0)
    assert told["edge1"] == told["edge2"], "it uses little, and nobody says that it wants more"
    hungry = tuple(replace(load, wanted_cores=2.0) for load in full[0].workers)
    short = values(scored(ROBOT, replace(full[0], workers=hungry), full[1], spec=spec, agreed=agreed))
    assert short["edge1"] == untold["edge1"] == pytest.approx(service_utility(0.2, 2.0, 4.0))


def test_an_owner_has_the_memory_that_it_holds_though_not_all_of_it_shows_as_its_own() -> None:
    """2000 of 4000 MiB are the task's, of which its processes show 100; the others have 800."""
    half = Weights(cpu=0.5, memory=0.5, network=0.0)
    demand = Demand(cpu_cores=0.4, memory_mb=2000.0)
    spec = replace(SPEC, candidates=("edge1", "edge2"), demand=demand)
    agreed = allocation_of(7, epoch=3, tuning=Tuning(weights=half, score=ScoreForm.SERVICE))
    owner = profile("edge1", memory=2800.0, own=(0.0, 100.0))
    vector = scored(owner, profile("edge2", memory=800.0), spec=spec, agreed=agreed)
    assert vector.refused == ()
    first, second = vector.utilities
    assert first.memory == second.memory
    too_small = scored(owner, spec=replace(spec, demand=Demand(memory_mb=5000.0)), agreed=agreed)
    assert dict(too_small.refused)["edge1"] == "needs 5000 MiB, has 4000 free"


# --- who is scored -------------------------------------------------------------------------------------------------


def test_a_candidate_never_heard_is_left_out_for_the_listener_may_have_just_started() -> None:
    vector = scored(ROBOT, *EDGES, states={"edge2": PeerState.UNKNOWN})

    assert "edge2" not in values(vector)
    assert vector.refused == (("edge2", "not heard yet"),)


def test_an_owner_whose_suspicion_is_young_is_scored_and_reached_as_before() -> None:
    silent = {"edge1": PeerState.SUSPECT}
    vector = scored(ROBOT, *EDGES, states=silent, doubts=Doubts(in_grace={"edge1"}))

    assert vector == scored(ROBOT, *EDGES)
    assert not {one.candidate: one.reachable for one in scored(ROBOT, *EDGES, states=silent).utilities}["edge1"]


def test_another_candidate_whose_suspicion_is_young_is_not_reached() -> None:
    vector = scored(ROBOT, *EDGES, states={"edge3": PeerState.SUSPECT}, doubts=Doubts(in_grace={"edge3"}))

    assert values(vector)["edge3"] == 0.0


def test_a_candidate_whose_streams_are_not_proven_is_refused_and_the_owner_stays() -> None:
    vector = scored(ROBOT, *EDGES, doubts=Doubts(unproven={"edge1": "back", "edge3": "back for 1.2 s"}))

    assert values(vector) == {"edge1": 0.25, "edge2": 0.5}
    assert vector.refused == (("edge3", "back for 1.2 s"),)


def test_a_candidate_that_no_stream_reaches_is_not_reached_though_it_is_the_owner() -> None:
    vector = scored(ROBOT, *EDGES, doubts=Doubts(unseen={"edge1", "edge3"}))

    assert {one.candidate: one.reachable for one in vector.utilities} == {"edge1": False, "edge2": True, "edge3": False}
    assert values(vector) == {"edge1": 0.0, "edge2": 0.5, "edge3": 0.0}


def test_a_node_that_can_hold_no_lease_is_refused_though_it_is_the_owner() -> None:
    vector = scored(ROBOT, *EDGES, doubts=Doubts(unfit={"edge1": Veto(Filter.TERMS, "goes by other leases")}))

    assert set(values(vector)) == {"edge2", "edge3"}
    assert vector.refused == (("edge1", "goes by other leases"),)


@pytest.mark.parametrize("state", [PeerState.SUSPECT, PeerState.GONE])
def test_a_candidate_that_is_not_alive_gets_zero_and_is_not_left_out(state: PeerState) -> None:
    vector = scored(ROBOT, *EDGES, states={"edge2": state})

    assert vector.utilities[1] == Utility(candidate="edge2", value=0.0, reachable=False)
    assert vector.refused == ()


def reached(vector: UtilityVector, *, agreed: Allocation, spec: TaskSpec = SPEC) -> dict[str, bool]:
    """{candidate: whether it is reached}, as all robots say it that score as this one does."""
    (joint,) = compare(spec, agreed, {vector.voter: vector}).vectors
    return {one.candidate: one.reachable for one in joint.utilities}


def test_a_link_below_nu_is_zero_even_without_weight_at_nu_it_is_reached() -> None:
    edges = (profile("edge1", links=radio(-80.1)), profile("edge2", links=radio(-80.0)), profile("edge3"))
    vector = scored(ROBOT, *edges, agreed=allocation(CPU))

    assert vector.utilities[0] == Utility(candidate="edge1", value=0.0, reachable=False)
    assert (vector.utilities[1].reachable, vector.utilities[1].network) == (True, 0.0)
    assert vector.utilities[1].value == 0.75


@pytest.mark.parametrize(
    ("own", "theirs", "is_reached"),
    [(-79.0, -77.1, False), (-79.0, -77.0, True), (-80.1, -79.0, True), (None, -77.1, False)],
)
def test_who_reaches_the_owner_reaches_another_candidate_from_a_margin_on(
    own: float | None, theirs: float, *, is_reached: bool
) -> None:
    """A signal that scatters about nu moved the task there and back: below is an escape, above a planned move."""
    tuning = Tuning(weights=CPU, score=ScoreForm.SERVICE)
    edges = (profile("edge1", links=radio(own)), profile("edge2", links=radio(theirs)))
    by_service = replace(allocation(), tuning=tuning)
    vector = scored(ROBOT, *edges, agreed=by_service)
    assert reached(vector, agreed=by_service)["edge2"] is is_reached
    assert vector.utilities[0].reachable is (own is None or own >= -80.0)
    free = replace(by_service, owner=None)
    assert reached(scored(ROBOT, *edges, agreed=free), agreed=free)["edge2"], "nobody has it"
    gone = scored(ROBOT, *edges, agreed=by_service, states={"edge1": PeerState.GONE})
    assert reached(gone, agreed=by_service)["edge2"]


RADIO_ONLY_LIMIT = {"edge1": -60.0, "edge2": -78.0}
"""A robot that reaches both, the second one at the limit of its signal."""
NO_OWNER = {"edge1": -90.0, "edge2": -60.0}
"""A robot that does not reach the owner."""


@pytest.mark.parametrize(
    ("signals", "reach", "can_have_it", "why"),
    [
        # the owner is not reached by enough: a machine that both reach is better than none
        ([RADIO_ONLY_LIMIT, NO_OWNER], Reach.MAJORITY, True, ""),
        ([RADIO_ONLY_LIMIT, NO_OWNER, {"edge1": -60.0, "edge2": -60.0}], Reach.ALL, True, ""),
        ([RADIO_ONLY_LIMIT, NO_OWNER, {"edge1": -90.0, "edge2": -90.0}], Reach.MAJORITY, True, ""),
        # it is: also for a robot that does not reach it, a signal at the limit does not count
        (
            [{"edge1": -60.0, "edge2": -60.0}, {"edge1": -60.0}, {"edge1": -90.0, "edge2": -78.0}],
            Reach.MAJORITY,
            False,
            "reached by 1 of 3 robots, by 1 more at the limit of the signal (link.nu_dbm)",
        ),
    ],
)
def test_the_margin_hangs_on_whether_the_robots_reach_the_owner_and_not_on_one_of_them(
    signals: list[dict[str, float]], reach: Reach, why: str, *, can_have_it: bool
) -> None:
    """Each for itself: the one that still saw the owner kept the task there, the one that did not brought it back."""
    spec = replace(SPEC, reach=reach)
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    robots = [
        profile(
            f"robot{number}",
            state=None,
            links=tuple(
                Link(source=LinkSource.NL80211, peer=edge, rssi_dbm=heard.get(edge, -95.0))
                for edge in ("edge1", "edge2")
            ),
        )
        for number, heard in enumerate(signals, 1)
    ]
    vectors = {
        robot.node: scored(*robots, profile("edge1"), profile("edge2"), spec=spec, agreed=agreed, voter=robot.node)
        for robot in robots
    }
    standing = compare(spec, agreed, vectors)
    assert ("edge2" in standing.aggregates) is can_have_it
    assert str(standing.vetoed.get("edge2", "")) == why


def test_an_owner_that_is_lost_for_a_moment_is_not_left_for_a_machine_at_the_limit() -> None:
    """Where all stood at the limit the task fled round without end: 84 moves in 150 s among three machines."""
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    edges = (profile("edge1", links=radio(-81.0)), profile("edge2", links=radio(-79.0)), profile("edge3"))
    vectors = {ROBOT.node: scored(ROBOT, *edges, agreed=agreed)}
    assert not reaches_owner(SPEC, agreed, vectors)
    assert compare(SPEC, agreed, vectors, LOST_S - 0.1).aggregates.keys() == {"edge3"}, "which is clearly reached"
    assert compare(SPEC, agreed, vectors, LOST_S).aggregates.keys() == {"edge2", "edge3"}
    assert not reaches_owner(SPEC, replace(agreed, owner=None), vectors)


def test_an_owner_that_is_refused_is_not_lost_by_that_to_the_radio() -> None:
    """A gap of its profiles made a machine at the limit of its signal a place to go, and come back from."""
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    spec = replace(SPEC, gauge_limits=(("battery", 0.2),))
    edges = (replace(profile("edge1"), gauges=(("battery", 0.1),)), profile("edge2", links=radio(-79.0)))
    vector = scored(ROBOT, *edges, spec=spec, agreed=agreed)
    assert dict(vector.refused).keys() >= {"edge1"}
    assert not reached(vector, spec=spec, agreed=agreed)["edge2"]


def test_a_candidate_at_the_limit_counts_nothing_for_who_hears_it_so_while_the_owner_is_reached() -> None:
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    near, far = (
        scored(ROBOT, *EDGES, agreed=agreed),
        scored(ROBOT, profile("edge1"), profile("edge2", links=radio(-79.0)), profile("edge3"), agreed=agreed),
    )
    far = replace(far, voter="robot2")
    third = replace(near, voter="robot3")
    joined = compare(SPEC, agreed, {"robot1": near, "robot2": far, "robot3": third}).aggregates
    alone = compare(SPEC, agreed, {"robot1": near, "robot3": third}).aggregates
    assert joined["edge2"] == pytest.approx(alone["edge2"] * 2 / 3)
    assert far.utilities[1].at_limit


@pytest.mark.parametrize(
    ("owner", "left", "is_reached"),
    [
        ({}, (), False),
        ({}, ("edge1",), True),
        ({"draining": True}, (), True),
        ({"state": WorkerState.STARTING}, (), False),  # a cold standby that begins: what was fled must not be better
        ({"state": WorkerState.STARTING}, ("edge1",), True),  # it has had its time
    ],
)
def test_an_owner_that_the_task_cannot_return_to_asks_for_no_margin(
    owner: dict[str, Any], left: tuple[str, ...], *, is_reached: bool
) -> None:
    """A weak link is better than none, and a machine that is nearly out of its limits better than a drained one."""
    spec = replace(SPEC, gauge_limits=(("battery", 0.2),))
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    edges = (
        profile("edge1", **owner),
        profile("edge2", links=radio(-79.0)),
        replace(profile("edge3"), gauges=(("battery", 0.23),)),
    )
    vector = scored(ROBOT, *edges, spec=spec, agreed=agreed, doubts=Doubts(left=frozenset(left)))
    assert reached(vector, spec=spec, agreed=agreed)["edge2"] is is_reached
    assert ("edge3" not in dict(vector.refused)) is is_reached


def test_a_weak_way_to_the_access_point_that_leads_to_the_owner_too_sets_no_candidate_back() -> None:
    """Both edges are reached by the same radio: it says nothing of which one is better."""
    weak, edges = (
        profile("robot1", links=radio(-78.5), state=None),
        (profile("edge1", cpu=3.8), profile("edge2", cpu=0.1)),
    )
    agreed = replace(allocation(), tuning=Tuning(weights=CPU, score=ScoreForm.SERVICE))
    spec = replace(SPEC, candidates=("edge1", "edge2", "robot1"))
    found = reached(scored(weak, *edges, spec=spec, agreed=agreed), spec=spec, agreed=agreed)
    assert [found["edge1"], found["edge2"]] == [True, True]
    at_home = replace(agreed, owner="robot1")
    home = replace(weak, workers=(load_of(),))
    found = reached(scored(home, *edges, spec=spec, agreed=at_home), spec=spec, agreed=at_home)
    assert [found["edge1"], found["edge2"]] == [False, False]


@pytest.mark.parametrize(
    ("candidate", "reason"),
    [
        (profile("edge2", draining=True), "draining"),
        (profile("edge2", state=WorkerState.FAILED), "worker failed"),
        (profile("edge2", state=WorkerState.STARTING), "worker starting"),
        (profile("edge2", state=WorkerState.STOPPED), "worker stopped"),
        (profile("edge2", state=None), "runs no worker for it"),
        (profile("edge1", draining=True), "draining"),
        (profile("edge1", state=WorkerState.FAILED), "worker failed"),
    ],
)
def test_who_may_not_have_the_task_is_refused_with_the_reason(candidate: Profile, reason: str) -> None:
    others = [edge for edge in EDGES if edge.node != candidate.node]
    vector = scored(ROBOT, candidate, *others)

    assert vector.refused == ((candidate.node, reason),)
    assert candidate.node not in values(vector)


@pytest.mark.parametrize("state", [WorkerState.STARTING, WorkerState.STOPPED])
def test_the_owner_keeps_its_place_while_its_worker_restarts(state: WorkerState) -> None:
    """Not ready is an escape only after the worker's start-up deadline."""
    assert "edge1" in values(scored(ROBOT, profile("edge1", state=state), *EDGES[1:]))


@pytest.mark.parametrize("standby", Standby)
def test_a_foreign_worker_needs_no_process_of_ours_but_must_be_there(standby: Standby) -> None:
    foreign = replace(SPEC, worker=WorkerSpec(standby=standby))

    assert "edge2" in values(scored(ROBOT, profile("edge2", state=WorkerState.READY), spec=foreign))
    assert "edge2" in values(scored(ROBOT, profile("edge2", state=None), spec=foreign)), "its daemon does not know"
    gone = profile("edge2", state=WorkerState.STOPPED)
    told = replace(gone, workers=(replace(gone.workers[0], reason="nobody subscribes to a/key"),))
    assert ("edge2", "worker stopped: nobody subscribes to a/key") in scored(ROBOT, told, spec=foreign).refused
    assert "edge1" in values(scored(ROBOT, profile("edge1", state=WorkerState.STOPPED), spec=foreign)), "the owner"


def test_no_or_old_profile_of_a_living_node_is_refused_not_guessed() -> None:
    assert scored(ROBOT, *EDGES[:2]).refused == (("edge3", "no fresh profile"),)
    old = scored(ROBOT, *EDGES, age_s=Timing().profile_ttl_s + 0.1)
    assert old.refused == tuple((edge, "no fresh profile") for edge in SPEC.candidates)


def test_memory_that_the_task_would_not_get_is_a_hard_constraint() -> None:
    spec = replace(SPEC, demand=Demand(memory_mb=500.0))
    vector = scored(ROBOT, profile("edge1", memory=3500.0), profile("edge2", memory=3600.0), spec=spec)

    assert values(vector) == {"edge1": 0.75}
    assert vector.refused[0] == ("edge2", "needs 500 MiB, has 400 free")


@pytest.mark.parametrize(
    ("state", "worker", "wanted_mb", "is_refused"),
    [
        (PeerState.ALIVE, WorkerState.READY, 0.0, True),
        (PeerState.ALIVE, WorkerState.STARTING, 0.0, True),
        (PeerState.ALIVE, WorkerState.FAILED, 0.0, False),
        (PeerState.SUSPECT, WorkerState.READY, 0.0, False),
        (PeerState.GONE, WorkerState.READY, 0.0, False),
        (PeerState.GONE, WorkerState.READY, 1500.0, True),
    ],
)
def test_what_a_worker_has_come_to_hold_forbids_a_machine_only_while_the_task_has_an_owner(
    state: PeerState, worker: WorkerState, wanted_mb: float, is_refused: bool
) -> None:
    """A worker that leaked, or that sized its heap by its machine: without its owner nobody would have room for it."""
    spec = replace(SPEC, demand=Demand(memory_mb=wanted_mb))
    gateway = Gateway(InForce(fleet_of(spec, of=(*spec.candidates, "robot1"))))
    for one in (profile("edge1", memory=3500.0, own=(0.5, 3000.0)), profile("edge2", memory=3000.0), ROBOT):
        assert gateway.absorb(one, 0.0) is None
    gateway.learn_demand("merge", "edge1", 0.0)
    ended = profile_of("edge1", sequence=1, workers=(load_of(state=worker),), memory_used_mb=500.0, links=WIRED)
    assert gateway.absorb(ended, 0.1) is None
    states = dict.fromkeys((*spec.candidates, "robot1"), PeerState.ALIVE) | {"edge1": state}

    vector = score(spec, allocation(), "robot1", gateway, states, 0.1)

    assert ("edge2" in dict(vector.refused)) == is_refused
    if is_refused:
        assert (
            dict(vector.refused)["edge2"]
            == f"needs {max(wanted_mb, 3000.0 * (state is PeerState.ALIVE)):.0f} MiB, has 1000 free"
        )


def test_a_machine_that_took_the_task_without_room_for_all_that_it_held_keeps_it() -> None:
    spec = replace(SPEC, tuning=Tuning(weights=CPU))
    gateway = Gateway(InForce(fleet_of(spec, of=(*spec.candidates, "robot1"))))
    for one in (profile("edge1", memory=3500.0, own=(0.5, 3000.0)), profile("edge2", memory=3000.0), ROBOT):
        assert gateway.absorb(one, 0.0) is None
    gateway.learn_demand("merge", "edge1", 0.0)
    gateway.learn_demand("merge", "edge2", 0.2)
    states = dict.fromkeys((*spec.candidates, "robot1"), PeerState.ALIVE) | {"edge1": PeerState.GONE}

    vector = score(spec, allocation(owner="edge2"), "robot1", gateway, states, 0.2)

    assert "edge2" in values(vector)


def test_memory_that_its_own_worker_holds_counts_as_free_for_the_task() -> None:
    spec = replace(SPEC, demand=Demand(memory_mb=500.0))
    vector = scored(ROBOT, profile("edge1", memory=3900.0, own=(0.0, 500.0)), spec=spec)

    assert "edge1" in values(vector)


# --- demand --------------------------------------------------------------------------------------------------------


def test_the_owner_does_not_look_worse_by_the_task_s_own_load() -> None:
    """Two equal machines, one of them carrying the task: equal utilities, in CPU and in memory."""
    spec = replace(SPEC, demand=Demand(cpu_cores=0.8, memory_mb=600.0))
    owner = profile("edge1", cpu=1.8, memory=1600.0, own=(0.8, 600.0))
    other = profile("edge2", cpu=1.0, memory=1000.0)
    vector = scored(ROBOT, owner, other, spec=spec, agreed=allocation(Weights(cpu=0.5, memory=0.5, network=0.0)))
    first, second = vector.utilities

    assert first.value == pytest.approx(second.value)
    assert first.cpu == pytest.approx(1 - 1.8 / 4)
    assert first.memory == pytest.approx(1 - 1600 / 4000)


def test_an_idle_standby_s_load_is_not_counted_twice() -> None:
    spec = replace(SPEC, demand=Demand(cpu_cores=0.8, memory_mb=600.0))
    vector = scored(ROBOT, profile("edge2", cpu=1.1, memory=1200.0, own=(0.1, 200.0)), spec=spec)

    assert vector.utilities[0].cpu == pytest.approx(1 - 1.8 / 4)
    assert vector.utilities[0].memory == pytest.approx(1 - 1600 / 4000)


UNSEEN = Demand(cpu_cores=1.2, memory_mb=1200.0)
"""Of a worker that somebody else starts, which shows no figures."""


def owned_unseen(**options: Any) -> tuple[Utility, ...]:
    """How the owner edge1, with these figures, and an idle edge2 of the same size count for such a task."""
    spec = replace(SPEC, candidates=("edge1", "edge2"), demand=UNSEEN, worker=WorkerSpec())
    tuning = Tuning(weights=Weights(cpu=0.5, memory=0.5, network=0.0), score=ScoreForm.SERVICE)
    size = {"cpu_cores": 2.0, "memory_mb": 2000.0}
    nodes = (
        profile_of("edge1", **{**size, "workers": (load_of(),), **options}),
        profile_of("edge2", **size, cpu_used_cores=0.1, memory_used_mb=400.0, workers=(load_of(),)),
    )
    vector = scored(ROBOT, *nodes, spec=spec, agreed=allocation_of(7, epoch=3, tuning=tuning))
    assert vector.refused == ()
    return vector.utilities


@pytest.mark.parametrize("workers", [(), (load_of(),)])
@pytest.mark.parametrize("runnable", [None, 1.3])
def test_what_a_worker_without_figures_needs_counts_as_its_own_at_the_owner(
    workers: tuple[WorkerLoad, ...], runnable: float | None
) -> None:
    owner, other = owned_unseen(cpu_used_cores=1.3, memory_used_mb=1600.0, workers=workers, runnable=runnable)
    assert (owner.cpu, owner.memory) == pytest.approx((other.cpu, other.memory))


def test_such_a_worker_has_no_more_of_a_full_machine_than_its_fair_share() -> None:
    owner, _ = owned_unseen(cpu_used_cores=2.0, memory_used_mb=1600.0, runnable=5.2)
    assert owner.cpu == pytest.approx(service_utility(2.0 * 1.2 / 5.2, 1.2, 2.0))


def test_such_a_worker_that_tells_of_undone_jobs_has_what_its_jobs_use() -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, done_hz=3.0, wanted_hz=12.0)
    owner, _ = owned_unseen(cpu_used_cores=2.0, memory_used_mb=1600.0, workers=(load_of(jobs=jobs),))
    assert owner.cpu == pytest.approx(service_utility(0.3, 1.2, 2.0))


def test_an_owner_whose_worker_does_not_run_uses_nothing_for_it() -> None:
    idle = (load_of(state=WorkerState.STOPPED),)
    owner, _ = owned_unseen(cpu_used_cores=1.3, memory_used_mb=700.0, workers=idle)
    assert owner.cpu == pytest.approx(service_utility(0.7, 1.2, 2.0))


# --- links ---------------------------------------------------------------------------------------------------------


def pair_of(mine: tuple[Link, ...], theirs: tuple[Link, ...]) -> Utility:
    """robot1's utility of edge1."""
    return scored(profile("robot1", links=mine, state=None), profile("edge1", links=theirs), spec=SPEC).utilities[0]


@pytest.mark.parametrize(
    ("mine", "theirs", "worth"),
    [
        (radio(-50.0), WIRED, 1.0),
        (radio(-50.0), radio(-60.0), 0.5),
        (radio(-60.0), radio(-50.0), 0.75),
        (WIRED, WIRED, 1.0),
        (WIRED, radio(-60.0), 0.5),
        (radio(-50.0), (), None),
        ((), WIRED, None),
        (radio(None), WIRED, None),
        ((*radio(-70.0), *radio(-50.0, "edge1")), radio(-79.0), 0.75),
        (radio(-70.0), (*radio(-79.0), *radio(-50.0, "robot1")), 0.75),
        ((*radio(-70.0), Link(source=LinkSource.WIRED, peer="edge1")), radio(-79.0), 1.0),
        ((*radio(-50.0), *radio(None, "edge1")), WIRED, 1.0),
        ((*radio(-50.0), *radio(-70.0, "edge2")), WIRED, 1.0),
    ],
)
def test_the_link_of_a_pair(mine: tuple[Link, ...], theirs: tuple[Link, ...], worth: float | None) -> None:
    """Directly measured as it is, from either end; else through the access point, by the candidate's own way."""
    assert pair_of(mine, theirs).network == worth


@pytest.mark.parametrize("dead_end", ["mine", "theirs"])
def test_a_path_with_a_dead_end_is_dead(dead_end: str) -> None:
    """Below nu on either way the candidate is not reached, however good the other way is."""
    ways = {"mine": radio(-45.0), "theirs": radio(-45.0), dead_end: radio(-81.0)}

    assert not pair_of(ways["mine"], ways["theirs"]).reachable


def test_a_robot_that_is_a_candidate_reaches_itself() -> None:
    spec = replace(SPEC, candidates=("robot1", "robot2"))
    one, two = (profile(name, links=radio(-60.0)) for name in spec.candidates)
    vector = scored(one, two, spec=spec, agreed=allocation(HALVES, owner="robot1"))

    assert [utility.network for utility in vector.utilities] == [1.0, 0.5]


# --- metrics that are missing --------------------------------------------------------------------------------------


def test_a_metric_missing_for_every_candidate_is_dropped_and_the_rest_renormalised() -> None:
    mute = profile("robot1", links=(), state=None)

    assert values(scored(mute, *EDGES, agreed=allocation(HALVES))) == {"edge1": 0.25, "edge2": 0.5, "edge3": 0.75}


@pytest.mark.parametrize("form", list(ScoreForm))
def test_a_robot_s_link_to_itself_does_not_make_the_network_measured(form: ScoreForm) -> None:
    """It is a candidate, and cannot read its signal for some seconds: that is no fault of the owner."""
    spec = replace(SPEC, candidates=("edge1", "robot1"))
    agreed = allocation_of(7, "edge1", epoch=3, tuning=Tuning(weights=HALVES, score=form))
    mute = profile("robot1", links=radio(None), cpu=2.0)
    vector = scored(profile("edge1"), mute, spec=spec, agreed=agreed)
    by_cpu = scored(profile("edge1"), mute, spec=spec, agreed=replace(agreed, tuning=Tuning(weights=CPU, score=form)))

    assert vector.refused == ()
    assert values(vector) == values(by_cpu)
    assert [one.network for one in vector.utilities] == [None, None], "the sums of `explain` are made from these terms"


def test_a_robot_that_alone_may_have_the_task_reaches_itself_without_a_radio() -> None:
    spec = replace(SPEC, candidates=("edge1", "robot1"))
    only_network = allocation(Weights(cpu=0.0, memory=0.0, network=1.0))
    mute = profile("robot1", links=())
    assert values(scored(profile("edge1", draining=True), mute, spec=spec, agreed=only_network)) == {"robot1": 1.0}


def test_a_metric_missing_for_some_excludes_those() -> None:
    vector = scored(ROBOT, profile("edge1", links=()), *EDGES[1:], agreed=allocation(HALVES))

    assert list(values(vector)) == ["edge2", "edge3"]
    assert vector.refused == (("edge1", "network: not measured there, and it has a weight"),)


@pytest.mark.parametrize("form", list(ScoreForm))
@pytest.mark.parametrize("weights", [Weights(cpu=0.0, memory=0.0, network=1.0), Weights.of({"gpu": 1.0})])
def test_where_nobody_measures_what_is_weighed_all_candidates_are_alike(weights: Weights, form: ScoreForm) -> None:
    """Each was refused, and the task had no owner, by hand neither: what cannot be told apart is no reason for that."""
    mute = [replace(one, links=()) for one in (ROBOT, *EDGES)]
    agreed = replace(allocation(weights), tuning=Tuning(weights=weights, score=form))
    assert values(scored(*mute, agreed=agreed)) == {"edge1": 1.0, "edge2": 1.0, "edge3": 1.0}


def test_a_candidate_that_was_refused_does_not_make_a_metric_measured() -> None:
    """Otherwise one broken machine with a good radio would take all others out of the race."""
    broken = profile("edge3", state=WorkerState.FAILED)
    vector = scored(ROBOT, profile("edge1", links=()), profile("edge2", links=()), broken, agreed=allocation(HALVES))

    assert list(values(vector)) == ["edge1", "edge2"]


# --- gauges ----------------------------------------------------------------------------------------------------------


def gauged(node: str, **gauges: float) -> Profile:
    return replace(profile(node), gauges=tuple(gauges.items()))


def weighed(**shares: float) -> Allocation:
    return allocation(Weights.of(shares))


def terms_of(vector: UtilityVector) -> dict[str, dict[str, float]]:
    return {one.candidate: dict(one.gauges) for one in vector.utilities}


def test_a_node_without_a_gpu_cannot_have_a_task_that_weighs_it_and_one_without_a_battery_counts_as_full() -> None:
    spec = replace(SPEC, demand=Demand(gpu=0.1))
    vector = scored(gauged("edge1", gpu=0.5), gauged("edge2"), agreed=weighed(cpu=0.5, gpu=0.5), spec=spec)
    assert dict(vector.refused)["edge2"] == "gpu: not measured there, and it has a weight"

    vector = scored(gauged("edge1", battery=0.5), gauged("edge2"), agreed=weighed(cpu=0.5, battery=0.5))
    assert terms_of(vector) == {"edge1": {"battery": 0.5}, "edge2": {"battery": 1.0}}


def failing(*profiles: Profile, spec: TaskSpec = SPEC, agreed: Allocation, life: int = 0) -> UtilityVector:
    """The profiles arrive, then each node's next one without any gauge, from the ``life``-th life after."""
    gateway = Gateway(InForce(fleet_of(spec, of=("edge1", "edge2", "edge3", "robot1"), electors=("robot1",))))
    for one in profiles:
        assert gateway.absorb(one, 0.0) is None
        without = replace(one, gauges=(), sequence=1, incarnation=one.incarnation + life)
        assert gateway.absorb(without, 0.1, without.incarnation) is None
    states = dict.fromkeys(("edge1", "edge2", "edge3"), PeerState.ALIVE)
    return score(spec, agreed, "robot1", gateway, states, 0.1)


def test_a_node_whose_battery_is_not_read_any_more_has_its_last_charge() -> None:
    """Otherwise it would be worth more than one that tells of 60 %; a restarted one has no battery, or reads it."""
    agreed, told = weighed(cpu=0.5, battery=0.5), (gauged("edge1", battery=0.6), gauged("edge2", battery=0.1))
    assert terms_of(failing(*told, agreed=agreed)) == {"edge1": {"battery": 0.6}, "edge2": {"battery": 0.1}}
    assert terms_of(failing(*told, agreed=agreed, life=1)) == {"edge1": {}, "edge2": {}}


def test_a_node_whose_gpu_is_not_read_any_more_has_none() -> None:
    agreed = weighed(cpu=0.5, gpu=0.5)
    assert terms_of(failing(gauged("edge1", gpu=0.5), agreed=agreed)) == {"edge1": {}}


def test_a_limit_holds_also_for_a_reader_that_has_failed() -> None:
    spec = replace(SPEC, gauge_limits=(("battery", 0.2), ("temperature_c", 85.0)))
    told = (gauged("edge1", battery=0.15), gauged("edge2", temperature_c=91.0), gauged("edge3", battery=0.9))
    vector = failing(*told, spec=spec, agreed=allocation())
    assert dict(vector.refused) == {
        "edge1": "battery was last at 15 %, limit 20 %",
        "edge2": "temperature_c was last at 91 °C, limit 85 °C",
    }


def test_a_demand_of_the_gpu_is_predicted_for_every_candidate_alike() -> None:
    """The owner shows the task's use, an idle one does not: both are worth the same with the task."""
    spec = replace(SPEC, demand=Demand(gpu=0.4))
    vector = scored(gauged("edge1", gpu=0.4), gauged("edge2", gpu=0.0), spec=spec, agreed=weighed(cpu=0.5, gpu=0.5))
    assert terms_of(vector) == {"edge1": {"gpu": 0.6}, "edge2": {"gpu": 0.6}}


@st.composite
def gpu_worlds(draw: st.DrawFn) -> tuple[dict[str, tuple[float, float]], float]:
    """{machine: (cores, GPU) in use without the task}, and what of a GPU the task uses."""
    share = st.floats(0.0, 1.0).map(lambda value: round(value, 2))
    return {name: (4.0 * draw(share), draw(share)) for name in SPEC.candidates}, draw(share)


@given(
    world=gpu_worlds(),
    weights=st.sampled_from(({"gpu": 1.0}, {"cpu": 0.5, "gpu": 0.5})),
    form=st.sampled_from(ScoreForm),
)
@example(
    world=(dict.fromkeys(SPEC.candidates, (0.4, 0.1)), 0.5),
    weights={"cpu": 0.5, "gpu": 0.5},
    form=ScoreForm.SERVICE,
)
def test_a_task_whose_use_of_the_gpu_nobody_knows_does_not_chase_itself(
    world: tuple[dict[str, tuple[float, float]], float], weights: dict[str, float], form: ScoreForm
) -> None:
    """Where nothing changes but what it uses itself, it comes to rest, without bonus and price."""
    machines, used = world
    spec, owner, left = replace(SPEC, demand=Demand(cpu_cores=0.4)), "edge1", set[str]()
    while owner not in left:
        seen = [
            replace(
                profile(name, cpu=cores + 0.4 * (name == owner), own=(0.4 * (name == owner), 0.0)),
                gauges=(("gpu", min(gpu + used * (name == owner), 1.0)),),
            )
            for name, (cores, gpu) in machines.items()
        ]
        tuning = Tuning(weights=Weights.of(weights), score=form)
        vector = scored(*seen, spec=spec, agreed=allocation_of(7, owner, epoch=3, tuning=tuning))
        best = pick(values(vector), owner)
        if best == owner or best is None:
            return
        left.add(owner)
        owner = best
    pytest.fail(f"it comes back to {owner}")


def test_without_its_demand_the_gpu_s_use_counts_nowhere() -> None:
    """The task's own use would make each machine look worse that it has come to."""
    told = (gauged("edge1", gpu=0.875), gauged("edge2", gpu=0.25), gauged("edge3"))
    agreed = weighed(cpu=0.5, gpu=0.5)
    assert terms_of(scored(*told, agreed=agreed)) == {"edge1": {}, "edge2": {}, "edge3": {}}
    limited = replace(SPEC, gauge_limits=(("gpu", 0.6),))
    assert {name for name, _ in scored(*told, spec=limited).refused} == {"edge3"}, "a limit asks for one"
    by_file = replace(limited, demand=Demand(gpu=0.25))
    assert terms_of(scored(*told[:2], agreed=agreed, spec=replace(SPEC, demand=Demand(gpu=0.25))))["edge1"] == {
        "gpu": 0.125
    }
    assert "edge1" in dict(scored(*told, spec=by_file).refused)


def test_a_limit_of_the_gpu_tells_what_the_task_would_make_of_it() -> None:
    spec = replace(SPEC, demand=Demand(gpu=0.4), gauge_limits=(("gpu", 0.9),))
    vector = scored(gauged("edge2", gpu=0.8), gauged("edge3"), spec=spec)
    assert dict(vector.refused) | {"edge1": ""} == {
        "edge1": "",
        "edge2": "gpu would be at 120 %, limit 90 %",
        "edge3": "gpu is not measured",
    }


@pytest.mark.parametrize("agreed", [allocation(), allocation(owner=None)])
@pytest.mark.parametrize(
    ("spec", "told", "is_refused"),
    [
        (replace(SPEC, gauge_limits=(("battery", 0.2),)), gauged("edge2", battery=0.22), False),
        (replace(SPEC, gauge_limits=(("battery", 0.2),)), gauged("edge2", battery=0.19), True),
        (replace(SPEC, gauge_limits=(("gpu", 0.6),), demand=Demand(gpu=0.5)), gauged("edge2", gpu=0.05), False),
        (replace(SPEC, gauge_limits=(("gpu", 0.6),), demand=Demand(gpu=0.5)), gauged("edge2", gpu=0.15), True),
    ],
)
def test_a_task_that_nobody_has_goes_inside_the_margin_too(
    agreed: Allocation, spec: TaskSpec, told: Profile, is_refused: bool
) -> None:
    """The owner is gone, or there was none: three robots at 22 % kept a task with a limit of 20 % from all of them."""
    vector = scored(told, spec=spec, agreed=agreed, states={"edge1": PeerState.GONE})
    assert ("edge2" in dict(vector.refused)) == is_refused
    assert "edge2" in dict(scored(told, gauged("edge1"), spec=spec).refused), "from a living owner it does not"


def test_a_node_comes_back_inside_the_margin_only() -> None:
    spec = replace(SPEC, gauge_limits=(("battery", 0.2),))
    vector = scored(gauged("edge2", battery=0.22), gauged("edge3", battery=0.25), spec=spec)
    assert dict(vector.refused)["edge2"] == "battery is at 22 %, limit 20 %, back from 25 % on"
    assert [one.candidate for one in vector.utilities] == ["edge3"]


@pytest.mark.parametrize(("battery", "is_refused"), [(0.16, True), (0.14, False)])
def test_from_an_owner_far_beyond_its_limit_a_task_goes_inside_the_margin_too(
    battery: float, *, is_refused: bool
) -> None:
    """It stayed on a robot at 2 % for one at 24 %."""
    spec = replace(SPEC, gauge_limits=(("battery", 0.2),))
    vector = scored(gauged("edge1", battery=battery), gauged("edge2", battery=0.22), spec=spec)
    assert "edge1" in dict(vector.refused)
    assert ("edge2" in dict(vector.refused)) == is_refused
    assert "edge3" in dict(scored(gauged("edge1", battery=battery), gauged("edge3", battery=0.19), spec=spec).refused)


def test_no_margin_holds_a_task_on_an_owner_that_can_hold_no_lease() -> None:
    spec = replace(SPEC, gauge_limits=(("battery", 0.2),))
    told = (gauged("edge1", battery=0.9), gauged("edge2", battery=0.22))
    unfit = Doubts(unfit={"edge1": Veto(Filter.LEASE, "clock in doubt")})
    assert "edge2" not in values(scored(ROBOT, *told, spec=spec))
    assert "edge2" in values(scored(ROBOT, *told, spec=spec, doubts=unfit))
