"""Algorithm 3, "Executors": Consensus, Minimizing Reallocation, Offload by topic remapping."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from support.proposals import proposal_of
from support.robots import Decider
from support.todos import done
from zsched.core.executor.handover import Executor, Phase
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.ledger import AHEAD_S
from zsched.core.values.change import MoveOwner, Retune
from zsched.core.values.fleet import StreamRule, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import (
    ApplyRoutes,
    AskUtilities,
    Instruction,
    PublishProposal,
    StartWorker,
    StopWorker,
)
from zsched.core.values.model import Allocation, PeerState, Proposal
from zsched.core.values.plan import Direction, RoutePhase, RoutePlan
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource, WorkerState
from zsched.core.vote.tally import Tally, VoteOutcome, tally

ROBOTS = ("robot1", "robot2", "robot3")
TUNING = tuning_of(cpu=0.0, memory=0.0, network=1.0)
SPEC = task_of(
    candidates=("edge1", "edge2", "edge3"),
    tuning=TUNING,
    worker=WorkerSpec(command=("merge",)),
    rules=(
        StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/merge/{robot}/map"),
        StreamRule(
            direction=Direction.OUTPUT,
            from_template="{target}/merge/{epoch}/global_map",
            to_template="{robot}/global_map",
        ),
    ),
)


def allocation(owner: str | None, epoch: int, *, revision: int | None = None) -> Allocation:
    return allocation_of(epoch if revision is None else revision, owner, epoch=epoch, tuning=TUNING)


# --- Consensus -----------------------------------------------------------------------------------------------------


def consensus(votes: Mapping[str, str], *, owner: str = "edge1", is_over: bool = True, best: float = 0.5) -> Tally:
    papers = {
        robot: proposal_of(robot, candidate, base_revision=1, aggregate=best) for robot, candidate in votes.items()
    }
    return tally(papers, voters=ROBOTS, present=frozenset(ROBOTS), owner=owner, is_over=is_over)


def test_the_resource_that_most_of_the_robots_have_selected_is_scheduled() -> None:
    """Sec. V, Consensus: the resource that most of the robots have selected is ultimately scheduled."""
    result = consensus({"robot1": "edge3", "robot2": "edge2", "robot3": "edge3"})

    assert (result.outcome, result.winner) == (VoteOutcome.WON, "edge3")


def test_consensus_counts_after_all_decisions_are_in_and_not_after_the_first() -> None:
    """Alg. 3 calls Consensus inside the subscription loop; the text: with the decision from all the schedulers."""
    assert consensus({"robot1": "edge2"}, is_over=False).outcome is VoteOutcome.PENDING
    assert consensus({"robot1": "edge2", "robot2": "edge3"}, is_over=False).outcome is VoteOutcome.PENDING
    assert consensus({"robot1": "edge2", "robot2": "edge3", "robot3": "edge3"}, is_over=False).winner == "edge3"


def test_no_consensus_without_a_majority_of_the_robots() -> None:
    """Reading: one robot's selection is no consensus, however long the others stay silent."""
    assert consensus({"robot1": "edge2"}).outcome is VoteOutcome.NO_QUORUM


def test_three_robots_for_three_edges_is_a_tie_that_the_owner_wins() -> None:
    """Alg. 3 has no rule for ties; reading: the owner, then the higher aggregate, then the lowest name."""
    split = {"robot1": "edge1", "robot2": "edge2", "robot3": "edge3"}

    assert consensus(split, owner="edge3").winner == "edge3"
    assert consensus(split, owner="robot9").winner == "edge1"


def test_every_executor_counts_the_same_winner_whatever_the_order_of_arrival() -> None:
    """Reading: e* is one node, the same at every robot (as printed it is a set of pairs without a maximum)."""
    for choice in itertools.product(SPEC.candidates, repeat=3):
        votes = list(zip(ROBOTS, choice, strict=True))
        assert len({consensus(dict(order)).winner for order in itertools.permutations(votes)}) == 1


# --- Minimizing Reallocation ---------------------------------------------------------------------------------------


def make_executor(me: str = "robot1") -> Executor:
    return Executor(spec=SPEC, me=me, has_streams=me in ROBOTS)


def plans(out: tuple[Instruction, ...]) -> list[RoutePlan]:
    return [step.plan for step in out if isinstance(step, ApplyRoutes)]


def test_the_same_winner_as_the_current_allocation_moves_nothing() -> None:
    """Sec. V, Minimizing Reallocation: avoids remapping if the task has been reallocated to the same device."""
    result = consensus(dict.fromkeys(ROBOTS, "edge1"))

    assert result.outcome is VoteOutcome.STAY, "nothing is committed"
    executor = make_executor()
    assert plans(done(executor.execute, allocation("edge1", 1), 0.0))
    assert done(executor.execute, allocation("edge1", 1), 1.0) == ()


def test_new_weights_move_no_stream() -> None:
    """Reading: the memory of previous allocations is the epoch; it rises only when the owner changes."""
    tuned = Retune(base_revision=1, tuning=replace(TUNING, bonus=0.3)).apply(allocation("edge1", 1))
    moved = MoveOwner(base_revision=2, owner="edge2", reason="").apply(tuned)
    executor = make_executor()
    done(executor.execute, allocation("edge1", 1), 0.0)

    assert (tuned.revision, tuned.epoch) == (2, 1)
    assert (moved.revision, moved.epoch) == (3, 2)
    assert done(executor.execute, tuned, 1.0) == ()
    assert plans(done(executor.execute, moved, 2.0))


def test_an_older_allocation_that_comes_late_moves_nothing() -> None:
    """Reading: with lost and late messages only a newer epoch may remap."""
    executor = make_executor()
    done(executor.execute, allocation("edge2", 5), 0.0)

    assert done(executor.execute, allocation("edge1", 4), 1.0) == ()
    assert executor.owner == "edge2"


# --- Offload -------------------------------------------------------------------------------------------------------


def remapped(plan: RoutePlan) -> list[tuple[str, str]]:
    assert plan.current is not None
    return [(route.from_expr, route.to_expr) for route in plan.current.routes]


def test_offload_remaps_the_in_and_out_topics_of_the_task_to_the_selected_edge() -> None:
    """Alg. 3, Offload: do remapping[in][out] for the mapping key e*; applications keep their own topics."""
    executor = make_executor()
    (first,) = plans(done(executor.execute, allocation("edge1", 1), 0.0))
    assert remapped(first) == [
        ("robot1/map", "edge1/merge/robot1/map"),
        ("edge1/merge/1/global_map", "robot1/global_map"),
    ]
    done(executor.on_ready, 1)
    done(executor.on_flipped, 1, 0, 0.1)

    (second,) = plans(done(executor.execute, allocation("edge2", 2), 1.0))
    assert remapped(second) == [
        ("robot1/map", "edge2/merge/robot1/map"),
        ("edge2/merge/2/global_map", "robot1/global_map"),
    ]


def test_every_robot_remaps_its_own_streams() -> None:
    """Sec. V, Executor: executors run on the robots; together they offload the data collectively to one edge."""
    targets = set()
    for robot in ROBOTS:
        (plan,) = plans(done(make_executor(robot).execute, allocation("edge2", 1), 0.0))
        mapped = remapped(plan)
        targets.add(mapped[0][1])
        assert mapped[1] == ("edge2/merge/1/global_map", f"{robot}/global_map")

    assert targets == {f"edge2/merge/{robot}/map" for robot in ROBOTS}


def test_the_old_edge_carries_the_streams_until_the_new_one_is_ready() -> None:
    """Sec. V, Topic Remappings: messages go on being exchanged; reading: make before break."""
    executor = make_executor()
    done(executor.execute, allocation("edge1", 1), 0.0)
    done(executor.on_ready, 1)
    done(executor.on_flipped, 1, 0, 0.1)
    (prepare,) = plans(done(executor.execute, allocation("edge2", 2), 1.0))
    assert prepare.phase is RoutePhase.PREPARE
    assert [slot.owner for slot in prepare.predecessors] == ["edge1"]

    (flip,) = plans(done(executor.on_ready, 2))
    assert flip.phase is RoutePhase.FLIP
    done(executor.on_flipped, 2, 1, 1.1)
    (close,) = plans(done(executor.on_drained, 1))
    assert (close.phase, close.predecessors, executor.phase) == (RoutePhase.CLOSE, (), Phase.SETTLED)


def test_a_move_does_not_initialise_the_task_anew() -> None:
    """Sec. V: task re-initialization adds to the handover latency; workers run warm on every candidate before it."""
    edges = [make_executor(edge) for edge in SPEC.candidates]

    for executor in edges:
        assert done(executor.start) == (StartWorker(task="merge"),)
        done(executor.execute, allocation("edge1", 1), 0.0)
        moved = done(executor.execute, allocation("edge2", 2), 5.0)
        assert not any(isinstance(step, StopWorker) for step in (*moved, *done(executor.tick, 60.0)))


# --- the three algorithms together ---------------------------------------------------------------------------------

NEAR = {"robot1": -50.0, "robot2": -45.0, "robot3": -55.0}
FAR = -76.0


@dataclass
class Team:
    """The paper's real experiment: three robots, no edges, the network variant; signals decide who merges the maps."""

    signals: dict[str, float]
    owner: str = "robot2"
    moves: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.spec = replace(SPEC, candidates=ROBOTS)
        self.fleet = fleet_of(self.spec, of=ROBOTS, electors=ROBOTS)
        self.value = allocation(self.owner, 1)
        self.states = dict.fromkeys(ROBOTS, PeerState.ALIVE)
        self.profilers = {name: Profiler(name, 1, self.fleet.timing) for name in ROBOTS}
        self.gateways = {name: Gateway(InForce(self.fleet)) for name in ROBOTS}
        self.rounds = {
            name: Decider(self.fleet, name, gateway, at) for at, (name, gateway) in enumerate(self.gateways.items())
        }
        self.now = 0.0
        self.called_at = 0.0
        self.papers: list[Proposal] = []

    def run(self, seconds: float) -> None:
        for _ in range(int(seconds / 0.05)):
            self.now += 0.05
            self._profile()
            for rounds in self.rounds.values():
                self._carry(rounds, rounds.tick({"merge": self.value}, self.states, self.now))
            self._commit()

    def _profile(self) -> None:
        device = DeviceSample(cpu_cores=4.0, cpu_used_cores=1.0, memory_mb=4000.0, memory_used_mb=1000.0)
        for name, profiler in self.profilers.items():
            link = LinkSample(source=LinkSource.WIRELESS, rssi_dbm=self.signals[name])
            profiler.absorb(device, (link,), self.now)
            profile = profiler.publishable({"merge": WorkerState.READY}, is_draining=False, now=self.now)
            if profile is not None:
                for gateway in self.gateways.values():
                    gateway.absorb(profile, self.now)

    def _carry(self, asker: Decider, out: list[Instruction]) -> None:
        for step in out:
            if isinstance(step, AskUtilities):
                for rounds in self.rounds.values():
                    answer = rounds.rounds.vectors({"merge": self.value}, self.states, self.now)
                    asker.rounds.absorb_utilities(step.gather, answer)
            elif isinstance(step, PublishProposal):
                self.papers.append(step.proposal)
                for name, rounds in self.rounds.items():
                    if name != step.proposal.voter:
                        heard = rounds.absorb_proposal(step.proposal, self.value, self.states, self.now)
                        self._carry(rounds, heard)

    def _commit(self) -> None:
        """Stands for the register: the first change based on the current revision is chosen, the others fail."""
        for rounds in self.rounds.values():
            for _, change in rounds.votes.due_commits(self.now):
                rounds.votes.on_commit_ended("merge")
                if change.base_revision == self.value.revision:
                    self.value = change.apply(self.value)
                    self.moves.append((self.now, change.owner))
                    for other in self.rounds.values():
                        other.on_learnt("merge", is_new_epoch=True, now=self.now)


def test_the_task_follows_the_signal_from_robot_to_robot_by_consensus() -> None:
    """Sec. VII-C: when the network degraded for robot 2, the task was moved to robot 1 through consensus."""
    team = Team(dict(NEAR))
    team.run(20.0)
    assert team.moves == []

    team.signals["robot2"] = FAR
    team.run(20.0)
    assert [owner for _, owner in team.moves] == ["robot1"]
    assert team.value.epoch == 2
    # -45 dBm falls below -67 dBm, where the lead passes the bonus, after 1.3 time constants. From then on staying
    # costs the lead at most, and half of it at least, and for the seconds ahead at once. It must cost a move, and half
    # of one that the others owe; the rest is a round.
    waited = team.moves[0][0] - 20.0
    timing, lead = team.fleet.timing, (NEAR["robot1"] - FAR) / 40.0 - TUNING.bonus
    assert 0.0 < waited <= max(3.0 * SPEC.price_s / lead - AHEAD_S, 0.0) + 1.5 * timing.smoothing_s + 0.75


def test_the_first_proposal_makes_every_robot_run_its_round_at_once() -> None:
    """Reading: rounds need no synchronised clocks; the caller's proposal calls the vote, one paper per robot."""
    team = Team(dict(NEAR))
    team.run(20.0)
    team.signals["robot2"] = FAR
    team.run(20.0)

    assert len(team.papers) >= 2
    assert len({paper.voter for paper in team.papers}) == len(team.papers)
    assert {(paper.base_revision, paper.candidate) for paper in team.papers} == {(1, "robot1")}
    called = [paper.reason.startswith("vote called") for paper in team.papers]
    assert called == [False] + [True] * (len(called) - 1), "the others did not wait for their own timers"


def test_the_owner_s_death_moves_the_task_without_waiting_for_the_timers() -> None:
    """Reading: an escape goes as soon as it is known, by the same vote."""
    team = Team(dict(NEAR))
    team.run(20.0)
    team.states["robot2"] = PeerState.GONE
    del team.rounds["robot2"]
    for rounds in team.rounds.values():
        rounds.rounds.hurry(team.now)
    team.run(1.0)

    ((at, owner),) = team.moves
    assert owner == "robot1"
    assert at - 20.0 <= 0.2
    assert all(paper.is_escape for paper in team.papers)


def test_two_robots_cut_off_from_the_third_are_not_outvoted_by_it_alone() -> None:
    """Reading: one robot alone among living ones has no majority, so it moves nothing."""
    team = Team({**NEAR, "robot2": FAR})
    del team.rounds["robot2"], team.rounds["robot3"]
    team.run(20.0)

    assert team.moves == []
    assert team.papers == []
