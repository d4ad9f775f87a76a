"""Algorithm 2, "Schedulers": Calculate_Utility, APPLY_COST, Compare_Utility, with the readings of docs/decisions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from support.proposals import proposal_of, vector_of
from support.robots import Decider
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.judge import Judge, Outcome
from zsched.core.scheduler.ledger import AHEAD_S
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import compare, pick
from zsched.core.values.fleet import Timing, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import AskUtilities, Instruction, PublishProposal
from zsched.core.values.messages import Utilities
from zsched.core.values.model import Allocation, PeerState, Proposal, Tuning, UtilityVector, Weights
from zsched.core.values.profile import Link, LinkSource

BOTH = Weights(cpu=0.5, memory=0.5, network=0.0)
TUNING = Tuning(weights=BOTH)
SPEC = task_of(candidates=("edge1", "edge2", "edge3"), tuning=TUNING, worker=WorkerSpec(command=("merge",)))
ROBOTS = ("robot1", "robot2", "robot3")
LONG = Timing(profile_ttl_s=60.0)
"""One set of edge data lasts for a test."""
FLEET = fleet_of(SPEC, of=(*SPEC.candidates, *ROBOTS), timing=LONG)
ALIVE = {node.name: PeerState.ALIVE for node in FLEET.nodes}
SETTLED_S = 1000.0


def allocation(owner: str | None = "edge1", weights: Weights = BOTH, revision: int = 4) -> Allocation:
    tuning = replace(TUNING, weights=weights)
    return allocation_of(revision, owner, tuning=tuning)


def gateway_with(now: float = SETTLED_S, **used: tuple[float, float]) -> Gateway:
    """Edge data: {edge: (CPU ratio, memory ratio) in use}."""
    gateway = Gateway(InForce(FLEET))
    for node in FLEET.nodes:
        cpu, memory = used.get(node.name, (0.5, 0.5))
        profile = profile_of(
            node.name,
            sequence=0,
            cpu_used_cores=4.0 * cpu,
            memory_used_mb=4000.0 * memory,
            links=(Link(source=LinkSource.WIRED),),
            workers=(load_of(),),
        )
        gateway.absorb(profile, now)
    return gateway


def row(robot: str, revision: int = 4, **utilities: float) -> UtilityVector:
    return vector_of(robot, utilities, revision)


def answer(robot: str, **utilities: float) -> Utilities:
    return Utilities(voter=robot, vectors=(row(robot, 4, **utilities),))


def proposals(out: list[Instruction]) -> list[Proposal]:
    return [step.proposal for step in out if isinstance(step, PublishProposal)]


# --- Calculate_Utility ---------------------------------------------------------------------------------------------


def test_each_robot_calculates_its_utility_of_every_edge_from_edge_data() -> None:
    """Alg. 2: for each edge calculate UT_self by Eq. 1-3 and apply Eq. 4."""
    gateway = gateway_with(edge1=(0.8, 0.6), edge2=(0.4, 0.2), edge3=(0.0, 1.0))
    vector = score(SPEC, allocation(), "robot1", gateway, ALIVE, SETTLED_S)

    assert {utility.candidate: utility.value for utility in vector.utilities} == pytest.approx(
        {"edge1": 0.3, "edge2": 0.7, "edge3": 0.5}
    )


def test_weights_come_from_the_parameter_server_of_the_running_fleet() -> None:
    """Alg. 2: get omega from the rosparam server; here the agreed tuning, not the fleet file's, decides."""
    gateway = gateway_with(edge1=(0.1, 0.9), edge2=(0.9, 0.1), edge3=(0.5, 0.5))
    best = {}
    for name, weights in (
        ("cpu", Weights(cpu=1, memory=0, network=0)),
        ("memory", Weights(cpu=0, memory=1, network=0)),
    ):
        vector = score(SPEC, allocation(weights=weights), "robot1", gateway, ALIVE, SETTLED_S)
        best[name] = max(vector.utilities, key=lambda utility: utility.value).candidate

    assert best == {"cpu": "edge1", "memory": "edge2"}


def test_utilities_under_other_weights_are_not_summed_up() -> None:
    """Reading: a vector names the revision of its tuning; one under older weights is a number of another kind."""
    vectors = {"robot1": row("robot1", edge1=0.9), "robot2": row("robot2", revision=3, edge1=0.1)}
    standing = compare(SPEC, allocation(), vectors)

    assert (standing.voters_heard, standing.aggregates) == (1, {"edge1": 0.9})


# --- get U_r of the other robots -----------------------------------------------------------------------------------


def opened(now: float = SETTLED_S) -> tuple[Decider, int]:
    """robot1 just asked the others; edge1 owns the task since long ago."""
    rounds = Decider(FLEET, "robot1", gateway_with(now, edge1=(0.9, 0.9), edge2=(0.1, 0.1)))
    (asked,) = rounds.tick({"merge": allocation()}, ALIVE, now)
    assert isinstance(asked, AskUtilities)
    return rounds, asked.gather


def test_the_scheduler_requests_the_utilities_of_the_other_robots() -> None:
    """Sec. V, Scheduler: it also requests the utility data of the other robots; it waits a bounded time for them."""
    rounds, gather = opened()
    values = {"merge": allocation()}

    assert rounds.rounds.absorb_utilities(gather, answer("robot2", edge1=0.1, edge2=0.9))
    rounds.tick(values, ALIVE, SETTLED_S)
    assert rounds.tasks["merge"].judgement is None, "robot3 has not answered: nothing is decided on partial sums"
    assert rounds.rounds.absorb_utilities(gather, answer("robot3", edge1=0.1, edge2=0.9))
    rounds.tick(values, ALIVE, SETTLED_S)
    standing = rounds.tasks["merge"].standing
    assert standing is not None
    assert standing.voters_heard == 3


def test_a_robot_that_does_not_answer_is_not_waited_for_longer_than_the_gather() -> None:
    """Reading of "for each r in R get U": what is missing at the deadline is counted as silent, and told."""
    rounds, gather = opened()
    rounds.rounds.absorb_utilities(gather, answer("robot2", edge1=0.1, edge2=0.9))
    rounds.tick({"merge": allocation()}, ALIVE, SETTLED_S + FLEET.timing.gather_s)
    task = rounds.tasks["merge"]

    assert task.silent == ("robot3",)
    assert task.standing is not None
    assert task.standing.voters_heard == 2


def test_an_answer_counts_once_and_only_for_the_one_who_gives_it() -> None:
    """Reading: late answers, answers of strangers and answers in another robot's name change nothing."""
    rounds, gather = opened()
    forged = Utilities(voter="robot2", vectors=(row("robot3", edge1=1.0),))

    assert not rounds.rounds.absorb_utilities(gather, forged)
    assert not rounds.rounds.absorb_utilities(gather + 1, answer("robot2", edge1=1.0))
    assert not rounds.rounds.absorb_utilities(gather, answer("robot1", edge1=1.0))
    assert rounds.rounds.absorb_utilities(gather, answer("robot2", edge1=1.0))
    assert not rounds.rounds.absorb_utilities(gather, answer("robot2", edge1=1.0))


# --- Compare_Utility -----------------------------------------------------------------------------------------------


def test_joint_utilities_are_kept_per_robot_and_not_overwritten() -> None:
    """Alg. 2 merges {**UT_self, **U_r}, where equal keys overwrite each other; the text sums over the robots."""
    vectors = {
        "robot1": row("robot1", edge1=0.9, edge2=0.2),
        "robot2": row("robot2", edge1=0.9, edge2=0.2),
        "robot3": row("robot3", edge1=0.1, edge2=0.6),
    }
    overwritten = {key.candidate: key.value for vector in vectors.values() for key in vector.utilities}

    assert max(overwritten, key=overwritten.__getitem__) == "edge2"
    assert pick(compare(SPEC, allocation(), vectors).aggregates, None) == "edge1"


def test_every_robot_with_the_same_utilities_finds_the_same_maximum() -> None:
    """Alg. 2: max_e = argmax of the sums; the order in which answers come in does not matter."""
    vectors = [row(robot, edge1=0.1 * at, edge2=0.3, edge3=0.1) for at, robot in enumerate(ROBOTS, start=1)]
    orders: list[Mapping[str, UtilityVector]] = [
        {vector.voter: vector for vector in order} for order in (vectors, vectors[::-1], vectors[1:] + vectors[:1])
    ]

    assert len({tuple(compare(SPEC, allocation(), order).aggregates.items()) for order in orders}) == 1


# --- APPLY_COST ----------------------------------------------------------------------------------------------------


def decided(judge: Judge, owner: str, now: float, **aggregates: float) -> str | None:
    rows = {robot: row(robot, 4, **aggregates) for robot in ROBOTS}
    agreed = allocation(owner)
    judgement = judge.judge(compare(SPEC, agreed, rows), agreed, escape=None, is_called=False, now=now)
    return judgement.candidate


def test_the_cost_is_a_bonus_that_keeps_the_same_edge_selected() -> None:
    """Sec. V: the cost adds to the current edge's utility and ensures that the same edge gets selected again."""
    judge, owner = Judge(spec=SPEC), "edge2"
    for now in range(100):
        owner = decided(judge, owner, float(now), edge1=0.55, edge2=0.5) or owner

    assert owner == "edge2"


def test_a_cost_that_is_subtracted_would_switch_in_every_iteration() -> None:
    """The other reading of "cost", with the same numbers: a penalty on the incumbent switches between equals."""
    owner, switches, penalty = "edge1", 0, 0.1
    for _ in range(100):
        utilities = {"edge1": 0.5, "edge2": 0.5}
        utilities[owner] -= penalty
        winner = max(utilities, key=utilities.__getitem__)
        switches += winner != owner
        owner = winner

    assert switches == 100


def test_the_bonus_is_applied_once_after_the_aggregation_to_the_one_committed_owner() -> None:
    """Alg. 2 applies it at each robot to its own selected_edge; robots may differ in that, and the sum of it grows."""
    judge = Judge(spec=SPEC)
    rows = {robot: row(robot, edge1=0.5, edge2=0.55) for robot in ROBOTS}
    judgement = judge.judge(
        compare(SPEC, allocation(), rows),
        allocation(),
        escape=None,
        is_called=False,
        now=0.0,
    )

    assert judgement.aggregates == {"edge1": pytest.approx(0.5 + TUNING.bonus), "edge2": pytest.approx(0.55)}
    assert all(utility.value <= 1.0 for vector in rows.values() for utility in vector.utilities)


def test_a_lasting_lead_above_the_bonus_is_followed_once_staying_has_cost_a_move() -> None:
    """Sec. V: minimise switching, yet offload to the maximum: a small lead must last; then it wins."""
    for lead in (0.04, 0.05, 0.08):
        wins_after_s = SPEC.price_s / lead - AHEAD_S
        judge, best = Judge(spec=SPEC), 0.4 + TUNING.bonus + lead
        ticks = [tick / 10 for tick in range(200)]
        answers = [decided(judge, "edge1", SETTLED_S + late, edge1=0.4, edge2=best) for late in ticks]

        assert answers[0] == "edge1"
        assert wins_after_s <= ticks[answers.index("edge2")] <= wins_after_s + 0.2


def test_an_owner_that_is_gone_is_left_at_once() -> None:
    """Reading: stickiness is for the living; an escape skips bonus and price."""
    rows = {robot: row(robot, edge1=0.9, edge2=0.1) for robot in ROBOTS}
    judgement = Judge(spec=SPEC).judge(
        compare(SPEC, allocation(), rows),
        allocation(),
        escape="edge1 is gone",
        is_called=False,
        now=0.0,
    )

    assert (judgement.outcome, judgement.candidate, judgement.is_escape) == (Outcome.PROPOSE, "edge2", True)


# --- the proposal --------------------------------------------------------------------------------------------------


def lead_for(
    rounds: Decider, seconds: float, *, heard: int = 3, start: float = SETTLED_S, best: float = 0.8
) -> list[Proposal]:
    """Gathers in which everybody heard prefers edge2."""
    made: list[Proposal] = []
    values, now = {"merge": allocation()}, start
    while now < start + seconds:
        out = rounds.tick(values, ALIVE, now)
        made += proposals(out)
        for step in out:
            if isinstance(step, AskUtilities):
                for robot in ROBOTS[1:heard]:
                    rounds.rounds.absorb_utilities(step.gather, answer(robot, edge1=0.2, edge2=best))
        made += proposals(rounds.tick(values, ALIVE, now))
        now += 0.05
    return made


def robot1(seed: int = 1, best: float = 0.8) -> Decider:
    gateway = gateway_with(edge1=(0.8, 0.8), edge2=(1.0 - best, 1.0 - best), edge3=(0.9, 0.9))
    return Decider(FLEET, "robot1", gateway, seed)


def test_the_scheduler_proposes_its_maximum_to_the_executors() -> None:
    """Sec. V: after determining max_e the scheduler proposes it, here with the revision that it is based on."""
    rounds = robot1()

    proposal = lead_for(rounds, 1.5)[0]
    assert (proposal.voter, proposal.candidate, proposal.base_revision) == ("robot1", "edge2", 4)
    assert proposal.aggregate == pytest.approx(0.8)
    assert "edge1 owes" in proposal.reason


def test_no_proposal_with_fewer_fresh_voters_than_a_majority() -> None:
    """Reading: the sum over one robot of three is no joint utility; the scheduler says nothing, called or not."""
    alone = robot1()
    assert lead_for(alone, 5.0, heard=1) == []

    call = proposal_of("robot2", "edge2", base_revision=4, aggregate=0.8)
    alone.absorb_proposal(call, allocation(), ALIVE, SETTLED_S + 5.0)
    assert lead_for(alone, 1.0, heard=1, start=SETTLED_S + 5.0) == [], "not even staying is its to propose"
    assert alone.tasks["merge"].judgement is not None
    assert alone.tasks["merge"].judgement.reason == "utilities of 1 robots, 2 needed"


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("best", [0.35, 0.8])
def test_a_lead_is_proposed_within_a_round_of_the_time_that_costs_a_move(seed: int, best: float) -> None:
    """Reading: the price is that of switching; the phase of a robot's rounds adds at most one of them to it."""
    rounds = robot1(seed, best)
    made: list[Proposal] = []
    steps = 0
    while not made:
        made += lead_for(rounds, 0.01, start=SETTLED_S + steps * 0.01, best=best)
        steps += 1

    due_s = max(SPEC.price_s / (best - 0.2 - TUNING.bonus) - AHEAD_S, 0.0)
    assert due_s <= steps * 0.01 <= due_s + 1.1 * Timing().decide_s + 0.1
