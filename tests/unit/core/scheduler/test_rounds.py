"""Rounds at one robot: gather, judge, call and answer votes, hand the commit out."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import load_of, profile_of
from support.proposals import proposal_of, vector_of
from support.robots import Decider
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.claims import taken
from zsched.core.scheduler.judge import Outcome
from zsched.core.scheduler.ledger import AHEAD_S
from zsched.core.scheduler.rounds import TaskRound
from zsched.core.values.fleet import Demand, Fleet, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import AskUtilities, Instruction, PublishProposal
from zsched.core.values.messages import Utilities
from zsched.core.values.model import Allocation, Asked, PeerState, Pin
from zsched.core.values.profile import WorkerState
from zsched.core.vote.tally import VoteOutcome
from zsched.core.vote.voting import Voting, vote_time

T = TypeVar("T")
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
TUNING = tuning_of(cpu=1.0, memory=0.0)
PRICE_S = 3.0
FLEET = fleet_of(
    task_of(candidates=EDGES, tuning=TUNING, price_s=PRICE_S, worker=WorkerSpec(command=("merge",))),
    of=sorted((*ROBOTS, *EDGES)),
    electors=ROBOTS,
)
GATHER_S, STAGGER_S = FLEET.timing.gather_s, FLEET.timing.stagger_s


class Robot:
    """One robot's rounds with what surrounds them: peers, profiles, the register's value."""

    def __init__(
        self, me: str = "robot1", *, owner: str | None = "edge1", owner_cpu: float = 1.0, fleet: Fleet = FLEET
    ) -> None:
        self.me, self.now = me, 100.0
        self.states = dict.fromkeys((*ROBOTS, *EDGES), PeerState.ALIVE)
        self.gateway = Gateway(InForce(fleet))
        self.decider = Decider(fleet, me, self.gateway, now=self.now)
        self.rounds, self.votes = self.decider.rounds, self.decider.votes
        revision = 0 if owner is None else 5
        self.value = allocation_of(revision, owner, tuning=TUNING)
        self.sequence = 0
        self.profiles({"edge1": owner_cpu})

    @property
    def task(self) -> TaskRound:
        return self.rounds.tasks["merge"]

    @property
    def voting(self) -> Voting:
        return self.votes.tasks["merge"]

    def outcome(self) -> Outcome | None:
        return None if self.task.judgement is None else self.task.judgement.outcome

    def profiles(self, cpu: dict[str, float], **changes: object) -> None:
        """Fresh profiles of everybody; ``cpu`` in cores, 1 of 4 by default."""
        self.sequence += 1
        for name in (*ROBOTS, *EDGES):
            profile = profile_of(name, sequence=self.sequence, cpu_used_cores=cpu.get(name, 1.0), workers=(load_of(),))
            self.gateway.absorb(replace(profile, **changes) if name == "edge1" else profile, self.now)  # type: ignore[arg-type]

    def values(self) -> dict[str, Allocation]:
        return {"merge": self.value}

    def tick(self, seconds: float = 0.0) -> list[Instruction]:
        self.now += seconds
        return self.decider.tick(self.values(), self.states, self.now)

    def hear(self, voter: str, gather: int, revision: int | None = None, /, **values: float) -> bool:
        return self.rounds.absorb_utilities(gather, self.answer(voter, revision, **values))

    def answer(self, voter: str, revision: int | None = None, /, **values: float) -> Utilities:
        column = {name: values.get(name, 0.75) for name in EDGES}
        base = self.value.revision if revision is None else revision
        return Utilities(voter=voter, vectors=(vector_of(voter, column, base),))

    def round(self, seconds: float = 0.0, **values: float) -> list[Instruction]:
        """A whole gather in which everybody answers with ``values``."""
        self.now = max(self.now + seconds, self.decider.next_deadline())
        out = self.tick()
        for ask in of(out, AskUtilities):
            for name in ROBOTS:
                if name != self.me:
                    self.hear(name, ask.gather, **values)
        return [*out, *self.tick()]

    def paper(
        self, voter: str, candidate: str, *, base: int | None = None, is_escape: bool = False, task: str = "merge"
    ) -> list[Instruction]:
        value = self.values()[task]
        proposal = proposal_of(
            voter, candidate, task=task, base_revision=value.revision if base is None else base, is_escape=is_escape
        )
        return self.decider.absorb_proposal(proposal, value, self.states, self.now)


def of(out: list[Instruction], kind: type[T]) -> list[T]:
    return [one for one in out if isinstance(one, kind)]


def proposed(out: list[Instruction]) -> list[str]:
    return [one.proposal.candidate for one in of(out, PublishProposal)]


# --- the gather ------------------------------------------------------------------------------------------------------


def test_gather_closes_as_soon_as_all_living_robots_have_answered() -> None:
    robot = Robot()
    (ask,) = robot.tick()
    assert ask == AskUtilities(gather=1, deadline_s=GATHER_S)
    assert robot.decider.next_deadline() == robot.now + GATHER_S
    assert robot.hear("robot2", 1)
    robot.tick(0.01)
    assert robot.task.judgement is None, "robot3 is still awaited"
    assert robot.hear("robot3", 1)
    robot.tick(0.01)
    assert robot.task.judged_at == robot.now
    assert robot.task.silent == ()


def test_gather_closes_at_its_deadline_and_names_the_silent() -> None:
    robot = Robot()
    robot.tick()
    robot.hear("robot3", 1)
    robot.tick(GATHER_S)
    assert robot.outcome() is Outcome.STAY, "two of three robots are a majority"
    assert robot.task.silent == ("robot2",)


def asks(robot: Robot, rounds: int, **cpu: float) -> int:
    """How often a robot asks in so many rounds, with a profile of everybody before each; all answer."""
    found = 0
    for _ in range(rounds):
        robot.now = max(robot.now, robot.decider.next_deadline())
        robot.profiles({"edge1": 1.0, **cpu})
        found += len(of(robot.round(), AskUtilities))
    return found


def test_a_robot_at_rest_judges_by_what_it_has_heard_and_asks_again_when_that_is_old() -> None:
    robot = Robot()
    assert asks(robot, 1) == 1
    asked_at = robot.now
    while robot.decider.next_deadline() < asked_at + FLEET.timing.profile_ttl_s:
        assert asks(robot, 1) == 0
        assert robot.task.judged_at == robot.now
        assert robot.task.silent == ()
    assert asks(robot, 1) == 1


def test_a_robot_that_sees_a_change_asks_at_its_next_round() -> None:
    robot = Robot()
    assert asks(robot, 2) == 1
    assert asks(robot, 1, edge2=0.5) == 1
    assert asks(robot, 1, edge2=0.5) == 0


def test_a_robot_asks_in_every_round_while_another_candidate_leads() -> None:
    robot = Robot(owner_cpu=3.0)
    for _ in range(3):
        robot.now = robot.decider.next_deadline()
        robot.profiles({"edge1": 3.0})
        assert of(robot.round(edge1=0.25), AskUtilities)
        assert robot.outcome() is not Outcome.STAY


def test_a_robot_asks_when_it_is_called_when_a_node_goes_and_after_a_silence() -> None:
    robot = Robot()
    assert asks(robot, 2) == 1
    robot.paper("robot2", "edge2")
    assert asks(robot, 1) == 1, "called to a vote"
    assert asks(robot, 1) == 0
    robot.states = {**robot.states, "edge2": PeerState.SUSPECT}
    assert asks(robot, 1) == 1, "another node's state"
    assert asks(robot, 1) == 0
    robot.value = replace(robot.value, revision=6)
    assert asks(robot, 1) == 1, "another revision"
    robot.now = robot.decider.next_deadline()
    robot.rounds.hurry(robot.now)
    robot.tick()
    robot.tick(GATHER_S)
    assert robot.task.silent == ("robot2", "robot3")
    assert asks(robot, 1) == 1, "nobody has answered"


def test_late_foreign_doubled_and_forged_answers_do_not_count() -> None:
    robot = Robot()
    assert not robot.hear("robot2", 1), "nothing was asked yet"
    robot.tick()
    assert not robot.hear("robot2", 0)
    assert not robot.hear("robot2", 2)
    assert not robot.hear("edge1", 1)
    assert not robot.hear("robot1", 1)
    forged = replace(robot.answer("robot3"), voter="robot2")
    assert not robot.rounds.absorb_utilities(1, forged)
    stuffed = replace(robot.answer("robot2"), vectors=robot.answer("robot2").vectors + forged.vectors)
    assert not robot.rounds.absorb_utilities(1, stuffed), "its own vector does not cover another one's"
    assert robot.hear("robot2", 1)
    assert not robot.hear("robot2", 1), "once per gather"
    robot.tick(GATHER_S)
    assert not robot.hear("robot3", 1), "closed"


def test_vectors_on_another_revision_are_not_counted() -> None:
    robot = Robot()
    robot.tick()
    robot.hear("robot2", 1, 4)
    robot.hear("robot3", 1, 6)
    robot.tick()
    assert robot.outcome() is Outcome.NONE


def test_rounds_come_by_themselves_about_every_decide_s() -> None:
    robot = Robot()
    starts = []
    for _ in range(20):
        robot.round()
        starts.append(robot.decider.next_deadline() - robot.now)
    assert all(0.9 * FLEET.timing.decide_s <= wait <= 1.1 * FLEET.timing.decide_s for wait in starts)
    assert len(set(starts)) > 10, "jitter keeps the robots' rounds apart"


def test_hurry_brings_the_next_round_forward_and_never_back() -> None:
    robot = Robot()
    robot.round()
    later = robot.decider.next_deadline()
    robot.rounds.hurry(later + 1.0)
    assert robot.decider.next_deadline() == later
    robot.rounds.hurry(robot.now)
    assert of(robot.tick(), AskUtilities)


def test_hurry_during_a_gather_runs_another_round_after_it() -> None:
    robot = Robot()
    robot.tick()
    robot.rounds.hurry(robot.now)
    robot.hear("robot2", 1)
    robot.hear("robot3", 1)
    robot.tick()
    assert of(robot.tick(), AskUtilities)


def lead_of(robot: Robot) -> float:
    """Of the best over the owner with its bonus."""
    assert robot.task.judgement is not None
    aggregates = robot.task.judgement.aggregates
    return max(aggregates.values()) - aggregates["edge1"]


def test_a_lead_is_followed_in_the_round_by_which_staying_has_cost_a_move() -> None:
    robot = Robot(owner_cpu=3.9)
    robot.round(edge1=0.02)
    assert robot.outcome() is Outcome.WAIT
    due = robot.now + PRICE_S / lead_of(robot) - AHEAD_S
    while robot.outcome() is Outcome.WAIT:
        robot.profiles({"edge1": 3.9})
        out = robot.round(edge1=0.02)
    assert due <= robot.now <= due + 1.1 * FLEET.timing.decide_s
    assert proposed(out) == ["edge2"]


def test_an_operator_s_price_counts_from_the_next_round_and_the_file_s_when_it_ends() -> None:
    robot = Robot(owner_cpu=3.9)
    robot.round(edge1=0.02)
    assert robot.outcome() is Outcome.WAIT
    robot.value = replace(robot.value, revision=6, tuning=replace(TUNING, price_s=0.0))
    robot.profiles({"edge1": 3.9})
    assert proposed(robot.round(edge1=0.02)) == ["edge2"]
    figures = robot.task.figures
    assert figures is not None
    assert figures.rules.price_s == 0.0
    robot.task.under(TUNING)
    assert robot.task.spec == FLEET.tasks[0]


def test_a_call_to_a_vote_ends_with_the_value_that_it_was_for() -> None:
    """Its caller's timers counted for that one: the next is judged with all of them."""
    robot = Robot(owner_cpu=3.9)
    robot.decider.rounds.on_called("merge", is_escape=True, now=robot.now)
    assert (robot.task.is_called, robot.task.is_called_escape) == (True, True)
    robot.decider.on_learnt("merge", is_new_epoch=True, now=robot.now)
    assert (robot.task.is_called, robot.task.is_called_escape) == (False, False)


def test_gone_owner_is_left_in_one_round_by_whoever_is_there() -> None:
    robot = Robot(fleet=replace(FLEET, electors=("edge1", "edge2", "robot1")))
    robot.states.update(edge1=PeerState.GONE, robot2=PeerState.GONE, robot3=PeerState.GONE)
    assert proposed(robot.tick()) == ["edge2"]
    assert robot.task.judgement is not None
    assert robot.task.judgement.is_escape


def test_what_too_few_electors_could_agree_to_is_not_called_for() -> None:
    """It would wait in the register until the network heals, and move the task then, for a reason that is over."""
    robot = Robot()
    robot.states.update(edge1=PeerState.GONE, robot2=PeerState.GONE, robot3=PeerState.GONE)
    assert proposed(robot.tick()) == []
    assert robot.task.judgement is not None
    assert robot.task.judgement.reason == "edge1 is gone; 1 of 3 electors heard"
    assert (robot.outcome(), robot.task.judgement.candidate) == (Outcome.WAIT, "edge1")
    robot.states["robot2"] = PeerState.ALIVE
    assert proposed(robot.round(edge1=0.0)) == ["edge2"]


def test_an_elector_that_has_left_the_document_is_silent() -> None:
    """It keeps its seat until the electors have agreed to remove it, and is no peer any more."""
    robot = Robot()
    robot.rounds._in_force.count(robot.rounds._in_force.voters, ("gone1", "robot1", "robot2"))
    robot.states.update(edge1=PeerState.GONE, robot2=PeerState.GONE, robot3=PeerState.GONE)
    assert proposed(robot.tick()) == []
    assert robot.task.judgement is not None
    assert robot.task.judgement.reason == "edge1 is gone; 1 of 3 electors heard"


def test_suspect_owner_is_left_only_when_another_robot_calls_an_escape() -> None:
    robot = Robot()
    robot.states["edge1"] = PeerState.SUSPECT
    assert proposed(robot.round(edge1=0.0)) == []
    robot.paper("robot2", "edge2", is_escape=True)
    assert proposed(robot.round(edge1=0.0)) == ["edge2"]


@pytest.mark.parametrize(
    ("calls", "is_escape"),
    [((False,), False), ((True,), True), ((True, False), True), ((False, True), True)],
)
def test_one_robot_that_calls_an_escape_from_a_silent_owner_is_believed_whoever_calls_besides(
    calls: tuple[bool, ...], is_escape: bool
) -> None:
    robot = Robot()
    robot.states["edge1"] = PeerState.SUSPECT
    robot.round()
    for voter, flees in zip(("robot2", "robot3"), calls, strict=False):
        robot.paper(voter, "edge2", is_escape=flees)
    out = robot.round()
    papers = [(one.proposal.candidate, one.proposal.is_escape) for one in of(out, PublishProposal)]
    assert papers == [("edge2", is_escape)]


# --- called votes ----------------------------------------------------------------------------------------------------


def test_called_vote_is_answered_at_once_with_the_owner_when_nobody_is_better() -> None:
    robot = Robot()
    robot.round()
    robot.paper("robot2", "edge2")
    assert robot.decider.next_deadline() == robot.now
    assert proposed(robot.round()) == ["edge1"]


def test_called_vote_is_answered_with_todays_winner_without_waiting() -> None:
    robot = Robot(owner_cpu=3.9)
    robot.round(edge1=0.02)
    assert robot.outcome() is Outcome.WAIT
    robot.paper("robot2", "edge2")
    assert proposed(robot.round(edge1=0.02)) == ["edge2"]


def test_called_vote_is_not_answered_by_a_robot_that_hears_too_few() -> None:
    robot = Robot()
    robot.round()
    robot.states["robot3"] = PeerState.GONE
    robot.paper("robot2", "edge2")
    robot.tick()
    assert proposed(robot.tick(GATHER_S)) == [], "robot2 did not answer the gather"


def test_one_paper_per_vote_however_often_it_is_called() -> None:
    robot = Robot()
    robot.paper("robot2", "edge2")
    assert proposed(robot.round()) == ["edge1"]
    robot.paper("robot3", "edge2")
    assert proposed(robot.round()) == []


@pytest.mark.parametrize("base", [4, 6])
def test_proposal_on_an_older_or_newer_base_does_not_count(base: int) -> None:
    robot = Robot()
    robot.round()
    assert robot.paper("robot2", "edge2", base=base) == []
    assert robot.voting.proposals == {}
    assert proposed(robot.round()) == []


def test_vote_that_is_not_completed_ends_without_a_quorum() -> None:
    robot = Robot()
    robot.round()
    robot.states.update(robot2=PeerState.SUSPECT, robot3=PeerState.SUSPECT)
    robot.paper("robot2", "edge2")
    opened = robot.now
    while robot.voting.opened_at is not None:
        robot.now = max(robot.decider.next_deadline(), robot.now)
        robot.tick()
    assert robot.now == pytest.approx(opened + vote_time(FLEET.timing))
    assert robot.voting.tally is not None
    assert robot.voting.tally.outcome is VoteOutcome.NO_QUORUM


# --- the commit ------------------------------------------------------------------------------------------------------


def won(me: str, other: str) -> Robot:
    """``me`` has called a vote for edge2, and ``other``'s paper has just made the majority."""
    robot = Robot(me, owner_cpu=3.9)
    out = robot.round(edge1=0.02)
    while not proposed(out):
        robot.profiles({"edge1": 3.9})
        out = robot.round(edge1=0.02)
    assert robot.voting.commit is None, "one paper of three is no majority"
    robot.paper(other, "edge2")
    assert robot.voting.tally is not None
    assert robot.voting.tally.outcome is VoteOutcome.WON
    return robot


@pytest.mark.parametrize(
    ("me", "other", "rank"), [("robot1", "robot2", 0), ("robot2", "robot1", 1), ("robot2", "robot3", 0)]
)
def test_winners_voters_commit_staggered_by_rank_and_once(me: str, other: str, rank: int) -> None:
    robot = won(me, other)
    wait = rank * STAGGER_S
    if rank:
        assert robot.votes.due_commits(robot.now + wait - 0.001) == []
        assert robot.decider.next_deadline() <= robot.now + wait
    ((name, change),) = robot.votes.due_commits(robot.now + wait)
    assert (name, change.owner, change.base_revision) == ("merge", "edge2", 5)
    assert "edge1 owes" in change.reason, "its own reason goes into the history"
    assert robot.votes.due_commits(robot.now + 9.0) == [], "handed out once"


def test_who_voted_otherwise_does_not_commit_the_winner() -> None:
    robot = Robot()
    robot.paper("robot2", "edge2")
    assert proposed(robot.round()) == ["edge1"]
    robot.paper("robot3", "edge2")
    assert robot.voting.tally is not None
    assert robot.voting.tally.winner == "edge2"
    assert robot.votes.due_commits(robot.now + 9.0) == []


def test_no_vote_is_called_or_answered_while_a_commit_is_under_way() -> None:
    robot = won("robot1", "robot2")
    robot.votes.due_commits(robot.now)
    assert proposed(robot.round(edge1=0.02)) == []
    robot.paper("robot3", "edge2")
    assert robot.voting.opened_at is None
    robot.votes.on_commit_ended("merge")
    robot.paper("robot3", "edge2")
    assert robot.voting.opened_at == robot.now


def test_learnt_value_ends_the_vote_and_a_commit_that_was_not_handed_out() -> None:
    robot = won("robot2", "robot1")
    robot.decider.on_learnt("merge", is_new_epoch=True, now=robot.now)
    assert robot.votes.due_commits(robot.now + 9.0) == []
    assert (robot.voting.commit, robot.voting.proposals, robot.task.settled_at) == (None, {}, robot.now)


def test_learnt_value_leaves_a_handed_out_commit_to_the_register() -> None:
    """The register ends it (it knows whether it was ours): no second one may start meanwhile."""
    robot = won("robot1", "robot2")
    robot.votes.due_commits(robot.now)
    robot.decider.on_learnt("merge", is_new_epoch=False, now=robot.now)
    under_way = robot.voting.commit
    robot.votes.on_commit_ended("merge")
    assert under_way is not None
    assert (robot.voting.commit, robot.voting.commit_at) == (None, math.inf)


# --- several tasks ---------------------------------------------------------------------------------------------------


class RobotOfTwo(Robot):
    """A robot of a fleet with the tasks ``merge`` and ``plan``, both unplaced, both best on edge1."""

    def __init__(self, me: str) -> None:
        (merge,) = FLEET.tasks
        super().__init__(me, owner=None, fleet=replace(FLEET, tasks=(merge, replace(merge, name="plan"))))
        self.plan = replace(self.value, task="plan")

    def values(self) -> dict[str, Allocation]:
        return {"merge": self.value, "plan": self.plan}

    def answer(self, voter: str, revision: int | None = None, /, **values: float) -> Utilities:
        (merge,) = super().answer(voter, revision, **values).vectors
        return Utilities(voter=voter, vectors=(merge, replace(merge, task="plan", revision=self.plan.revision)))

    def hear_all(self, gather: int) -> list[bool]:
        """The other robots' answers: edge1 is better."""
        return [self.hear(voter, gather, edge1=0.9, edge2=0.7) for voter in ROBOTS if voter != self.me]

    def learn_plan(self, owner: str) -> None:
        self.plan = replace(self.plan, revision=1, epoch=1, owner=owner)
        self.decider.on_learnt("plan", is_new_epoch=True, now=self.now)

    def gathered(self) -> list[Instruction]:
        """A whole gather, from its question to what follows from it."""
        (ask,) = of(self.tick(), AskUtilities)
        self.hear_all(ask.gather)
        return self.tick(0.001)


def test_what_was_gathered_before_another_task_was_placed_is_gathered_again() -> None:
    robot = RobotOfTwo("robot2")
    (ask,) = of(robot.tick(), AskUtilities)
    robot.learn_plan("edge1")
    assert robot.hear_all(ask.gather) == [False, False], "they say nothing of what plan will use on edge1"
    (again,) = of(robot.tick(), AskUtilities)
    assert robot.rounds.tasks["merge"].judgement is None
    assert robot.hear_all(again.gather) == [True, True]
    assert len(of(robot.tick(), PublishProposal)) == 1


def test_a_value_that_comes_while_nothing_is_gathered_hurries_nobody() -> None:
    robot = RobotOfTwo("robot2")
    robot.value, robot.plan = (replace(one, revision=5, owner="edge1") for one in (robot.value, robot.plan))
    robot.gathered()
    due = robot.decider.next_deadline()
    assert due > robot.now
    robot.decider.on_learnt("plan", is_new_epoch=False, now=robot.now)
    assert robot.decider.next_deadline() == due


def test_only_a_planned_move_costs_a_task_its_turn() -> None:
    """Who has called longest ago is judged first; fleeing is no privilege that is used up."""
    for owner, is_planned in ((None, True), ("edge1", False)):
        robot = Robot(owner=owner)
        robot.states["edge1"] = PeerState.ALIVE if is_planned else PeerState.GONE
        robot.round(edge1=0.5, edge2=0.9)
        assert robot.outcome() is Outcome.PROPOSE
        assert robot.voting.called_at == -math.inf, "not before it has moved, or has been tried again"
        robot.voting.on_learnt()
        assert (robot.voting.called_at > -math.inf) is is_planned


def test_a_single_task_needs_no_second_gather() -> None:
    robot = Robot()
    (ask,) = of(robot.tick(), AskUtilities)
    robot.decider.on_learnt("merge", is_new_epoch=False, now=robot.now)
    assert robot.hear("robot2", ask.gather)


@pytest.mark.parametrize("ends", ["learnt", "given up"])
def test_no_other_task_moves_between_a_vote_that_others_won_and_its_value(ends: str) -> None:
    robot = RobotOfTwo("robot1")
    robot.paper("robot2", "edge1", task="plan")
    robot.paper("robot3", "edge1", task="plan")
    assert robot.votes.tasks["plan"].commit is None, "the others commit it"
    assert [one.proposal.task for one in of(robot.gathered(), PublishProposal)] == ["plan"], "it was asked about that"
    judgement = robot.rounds.tasks["merge"].judgement
    assert judgement is not None
    assert judgement.reason.endswith("plan moves first")
    if ends == "learnt":
        robot.learn_plan("edge1")
    else:
        robot.votes.on_commit_ended("plan")
        robot.rounds.hurry(robot.now)
    assert "merge" in {one.proposal.task for one in of(robot.gathered(), PublishProposal)}


class RobotOfOrphans(RobotOfTwo):
    """Both tasks need 1400 MiB and have lost edge1 with its machine; edge2 is best, and has ``free_mb`` left."""

    def __init__(self, me: str, free_mb: float, *, plan_on: tuple[str, ...] = ("edge1", "edge2", "robot3")) -> None:
        super().__init__(me)
        (merge, _) = self.rounds.tasks.values()
        candidates, demand = ("edge1", "edge2", "robot3"), Demand(memory_mb=1400.0)
        need = replace(merge.file, candidates=candidates, demand=demand)
        fleet = replace(FLEET, tasks=(need, replace(need, name="plan", candidates=plan_on)))
        self.gateway = Gateway(InForce(fleet))
        self.decider = Decider(fleet, me, self.gateway, now=self.now)
        self.rounds, self.votes = self.decider.rounds, self.decider.votes
        self.value, self.plan = (replace(one, revision=5, owner="edge1") for one in (self.value, self.plan))
        self.states["edge1"] = PeerState.GONE
        for name, free in (("edge2", free_mb), ("robot3", 8000.0)):
            workers = tuple(load_of(task, cpu_cores=0.0, memory_mb=0.0) for task in ("merge", "plan"))
            held = profile_of(name, memory_mb=16_000.0, memory_used_mb=16_000.0 - free, workers=workers)
            assert self.gateway.absorb(held, self.now) is None

    def hear_all(self, gather: int) -> list[bool]:
        """The other robots' answers: edge2 is better."""
        column = {"edge2": 0.9, "robot3": 0.7}
        vectors = {one: tuple(vector_of(one, column, 5, task=name) for name in self.values()) for one in ROBOTS}
        answers = [Utilities(voter=one, vectors=vectors[one]) for one in ROBOTS if one != self.me]
        return [self.rounds.absorb_utilities(gather, answer) for answer in answers]

    def fled(self) -> dict[str, str]:
        """{task: where it would go}."""
        return {one.proposal.task: one.proposal.candidate for one in of(self.gathered(), PublishProposal)}


def test_tasks_that_lose_their_owner_together_do_not_all_go_where_one_of_them_fits() -> None:
    """They were judged by the same figures: all went there, and some left it again for want of memory."""
    assert RobotOfOrphans("robot1", 3000.0).fled() == {"merge": "edge2", "plan": "edge2"}, "both fit"
    robot = RobotOfOrphans("robot1", 2000.0)
    assert robot.fled() == {"merge": "edge2", "plan": "robot3"}
    figures = robot.rounds.tasks["plan"].figures
    assert figures is not None
    assert figures.claimed == (("edge2", "merge goes there now: needs 1400 MiB, has 600 free"),)


def test_a_claim_takes_nobody_s_only_place() -> None:
    """Who is first by its name has a choice, and would never have made room: the other one had no owner for good."""
    robot = RobotOfOrphans("robot1", 2000.0, plan_on=("edge1", "edge2"))
    assert robot.fled() == {"merge": "edge2", "plan": "edge2"}, "merge is refused there then, and goes on"


def test_a_claim_leaves_a_task_that_is_pinned_hard_its_place() -> None:
    """It has one, whatever other candidates there are."""
    robot = RobotOfOrphans("robot1", 2000.0)
    pin = Pin(node="edge2", asked=Asked(by="ada@robot1"), revision=5, is_hard=True)
    robot.plan = replace(robot.plan, pinned=True, pin=pin)
    assert robot.fled() == {"merge": "edge2", "plan": "edge2"}


def test_an_elector_that_was_never_heard_is_not_counted_as_heard() -> None:
    robot = Robot(owner="edge1")
    robot.states.update(edge1=PeerState.GONE, robot3=PeerState.UNKNOWN)
    robot.round(edge2=0.9)
    figures = robot.rounds.tasks["merge"].figures
    assert figures is not None
    assert "robot3" in figures.electors
    assert "robot3" not in figures.electors_heard


def test_a_task_of_the_same_name_begins_without_the_memory_of_the_one_before() -> None:
    robot = RobotOfTwo("robot1")
    before = dict(robot.rounds.tasks)
    robot.rounds.on_fleet(robot.now, frozenset({"plan"}))
    assert robot.rounds.tasks["merge"] is before["merge"]
    assert robot.rounds.tasks["plan"] is not before["plan"]


def test_a_task_that_flees_from_nobody_leaves_no_room_to_others() -> None:
    robot = RobotOfOrphans("robot1", 2000.0)
    robot.states["edge1"] = PeerState.ALIVE
    profile = profile_of("edge1", workers=tuple(load_of(task) for task in robot.values()))
    assert robot.gateway.absorb(profile, robot.now) is None
    robot.paper("robot2", "edge2", base=5)
    robot.paper("robot3", "edge2", base=5)
    robot.gathered()
    figures = robot.rounds.tasks["plan"].figures
    assert figures is not None
    assert (figures.first, figures.claimed) == ("merge", ()), "its turn comes"


def test_a_proposal_that_no_vote_counts_any_more_and_one_to_stay_are_no_claims() -> None:
    robot = RobotOfOrphans("robot1", 2000.0)
    robot.fled()
    vote_s, voting = vote_time(FLEET.timing), robot.votes.tasks["merge"]
    assert voting.going_to(robot.now) == "edge2"
    voting.opened_at = robot.now + vote_s + 0.1
    assert voting.going_to(robot.now + vote_s + 0.1) is None
    specs = [task.spec for task in robot.rounds.tasks.values()]
    stays = {**robot.values(), "merge": replace(robot.value, owner="edge2")}
    for values, found in ((robot.values(), {"edge2"}), (stays, set())):
        assert taken(specs[1], {"merge": "edge2"}, specs, values, robot.gateway, robot.now).keys() == found


def test_such_tasks_are_judged_in_one_order_by_all_robots_whoever_has_called_what_before() -> None:
    robot = RobotOfOrphans("robot2", 2000.0)
    robot.votes.tasks["merge"].called_at = 50.0
    assert robot.fled() == {"merge": "edge2", "plan": "robot3"}


def test_a_vote_that_others_have_won_takes_the_room_too() -> None:
    robot = RobotOfOrphans("robot1", 2000.0)
    for voter in ("robot2", "robot3"):
        robot.paper(voter, "edge2", base=5, task="plan", is_escape=True)
    assert robot.votes.tasks["plan"].commit is None, "the others commit it"
    assert robot.fled()["merge"] == "robot3"


# --- edges -----------------------------------------------------------------------------------------------------------


def test_while_an_owner_s_worker_is_not_ready_the_decision_says_when_it_will_be_left_and_why() -> None:
    robot = Robot()
    robot.round()
    assert robot.task.judgement is not None
    assert robot.task.judgement.reason == "nobody better"
    load = load_of(state=WorkerState.STARTING, reason="no token yet")
    robot.profiles({}, workers=(load,))
    robot.round()
    since = robot.task.judge.absences.since
    assert since is not None
    robot.now = since + 5.0
    robot.profiles({}, workers=(load,))
    robot.round()
    left_s = FLEET.tasks[0].worker.start_deadline_s - (robot.task.judged_at - since)
    assert (robot.outcome(), robot.task.judgement.candidate) == (Outcome.STAY, "edge1")
    said = robot.task.judgement.reason
    assert said == f"nobody better; edge1 will be left in {left_s:.0f} s, for its worker is starting: no token yet"
    robot.value = replace(robot.value, pinned=True)
    robot.round()
    told = robot.task.judgement.reason
    assert told.startswith("pinned to edge1 by the operator; edge1 will be left in "), "a pin does not keep it there"
    robot.value = replace(robot.value, pinned=False, paused=True)
    robot.round()
    assert robot.task.judgement.reason == "paused by the operator", "it will not be left"
    robot.value = replace(robot.value, paused=False)
    robot.profiles({})
    robot.round()
    assert robot.task.judgement.reason == "nobody better"


@pytest.mark.parametrize(
    ("state", "is_draining", "votes"),
    [
        (WorkerState.FAILED, False, ["edge2"]),
        (WorkerState.READY, True, ["edge2"]),
        (WorkerState.STARTING, False, []),
    ],
)
def test_a_first_placement_does_not_wait_for_a_node_that_cannot_have_the_task(
    state: WorkerState, is_draining: bool, votes: list[str]
) -> None:
    robot = Robot(owner=None)
    robot.profiles({}, workers=(load_of(state=state),), draining=is_draining)
    robot.now = robot.decider.next_deadline()
    (ask,) = of(robot.tick(), AskUtilities)
    for voter in ("robot2", "robot3"):
        seen = (vector_of(voter, {"edge2": 0.5}),)
        assert robot.rounds.absorb_utilities(ask.gather, Utilities(voter=voter, vectors=seen))
    assert proposed(robot.tick()) == votes
    assert robot.outcome() is (Outcome.PROPOSE if votes else Outcome.WAIT)


def test_a_time_in_which_the_owner_was_not_heard_is_no_time_in_which_its_worker_was_not_ready() -> None:
    """After a minute of silence "not ready for 64 s" would be a reason to flee from a worker that starts again."""
    robot = Robot()
    starting = (load_of(state=WorkerState.STARTING),)
    robot.profiles({}, workers=starting)
    robot.round()
    robot.now += 64.0  # its profile is stale now
    robot.round()
    robot.profiles({}, workers=starting)
    robot.round()
    judgement = robot.task.judgement
    assert judgement is not None
    assert "has not been ready" not in judgement.reason
    for _ in range(50):
        robot.now += 0.5
        robot.profiles({}, workers=starting)
        robot.round()
    assert robot.task.judgement is not None
    assert "has not been ready" in robot.task.judgement.reason


# --- what ends a lead ------------------------------------------------------------------------------------------------


def beaten() -> Robot:
    """A robot at which the owner has been beaten for a round, and has not lost what a move costs."""
    robot = Robot(owner_cpu=3.9)
    for _ in range(2):
        robot.profiles({"edge1": 3.9})
        robot.round(edge1=0.02)
    assert 0.0 < robot.task.judge.ledger.owed["edge1"] < PRICE_S
    return robot


def test_a_vote_that_stays_forgives_what_the_caller_saw_owed() -> None:
    """Else a robot with a nervous view would call a vote in every round."""
    robot = beaten()
    for voter in ("robot2", "robot3"):
        robot.paper(voter, "edge1")
    robot.paper("robot1", "edge2")
    assert robot.voting.tally is not None
    assert robot.voting.tally.outcome is VoteOutcome.STAY
    assert not robot.task.judge.ledger.owed
    robot.now += 0.7 * (PRICE_S / lead_of(robot) - AHEAD_S)
    robot.profiles({"edge1": 3.9})
    assert proposed(robot.round(edge1=0.02)) == []
    assert robot.outcome() is Outcome.WAIT


def test_a_vote_without_a_quorum_does_not() -> None:
    robot = beaten()
    robot.paper("robot1", "edge2")
    robot.tick(vote_time(FLEET.timing))
    assert robot.voting.tally is not None
    assert robot.voting.tally.outcome is VoteOutcome.NO_QUORUM
    assert robot.task.judge.ledger.owed["edge1"] > 0.0


@pytest.mark.parametrize("is_new_epoch", [True, False])
def test_a_new_owner_has_all_its_time_to_get_ready_and_new_weights_give_none(is_new_epoch: bool) -> None:
    robot = beaten()
    robot.task.judge.absences.since = 90.0
    owed = dict(robot.task.judge.ledger.owed)
    robot.decider.on_learnt("merge", is_new_epoch=is_new_epoch, now=robot.now)
    assert robot.task.judge.ledger.owed == owed, "or it would go back and forth"
    assert robot.task.judge.absences.since == (None if is_new_epoch else 90.0)
