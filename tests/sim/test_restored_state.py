"""A state folder that goes back in time (a backup, a disk that lies about fsync): its elector votes no more."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.durable import DurableState
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.values.model import NodeId
from zsched.core.vote.witness import ASK_ALL_S, Witness
from zsched_lab.sim.simulator import CORES, Simulator

TASK = "merge"
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
FLEET = fleet_of(
    task_of(
        TASK,
        EDGES,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.05,
        worker=WorkerSpec(command=("true",)),
        exclusive=True,
        max_moves_per_minute=1000,
    ),
    of=(*EDGES, *ROBOTS),
    electors=ROBOTS,
)


class Site:
    """A fleet whose task the test moves to and fro."""

    def __init__(self, seed: int) -> None:
        self.busy: set[NodeId] = set()
        self.sim = Simulator(
            fleet=FLEET, seed=seed, load=lambda node, _: (CORES * (0.9 if node in self.busy else 0.2), 1000.0)
        )
        self.blank = self.saved("robot1")
        self.sim.start()
        self.until_owned()

    def until_owned(self, *names: NodeId, by: NodeId | None = None) -> NodeId:
        """Who owns the task for all of ``names``, once they agree (on ``by``)."""

        def owner() -> NodeId | None:
            found = self.sim.agreed(TASK, *names)
            return found if by is None or found == by else None

        assert self.sim.run_until(lambda: owner() is not None, 20), "\n".join(self.sim.stories[-20:])
        return owner() or ""

    def move(self, *names: NodeId) -> NodeId:
        """Make the other edge the better one; the new owner for ``names``."""
        self.busy = {self.until_owned(*names)}
        return self.until_owned(*names, by=next(name for name in EDGES if name not in self.busy))

    def saved(self, name: NodeId) -> DurableState:
        state = self.sim.disk(name)
        assert state is not None
        return state

    def bring_back(self, name: NodeId, state: DurableState) -> None:
        """The operator stops a node, restores its folder from a backup and starts it again."""
        self.sim.crash(name)
        machine = self.sim.machines[name]
        machine.disk.write(state)
        machine.disk.sync()
        machine.is_durable = False
        self.sim.start(name)

    def problems(self, name: NodeId) -> str:
        batch = self.sim.node(name).handle(ev.StatusAsked(request=1), self.sim.now)
        (answer,) = [one for one in batch if isinstance(one, do.AnswerStatus)]
        return " ".join(answer.snapshot.problems)


@pytest.mark.parametrize("age", ["blank", "one move ago", "of this life"])
@pytest.mark.parametrize("seed", range(3))
def test_an_elector_whose_state_is_older_than_what_others_have_seen_votes_no_more(seed: int, age: str) -> None:
    site = Site(seed)
    backup = site.blank if age == "blank" else site.saved("robot1")
    if age == "one move ago":
        site.sim.crash("robot1")
        site.sim.start("robot1")
        site.sim.run(2)
    site.move()
    site.sim.run(1)
    votes = site.saved("robot1").votes
    site.bring_back("robot1", backup)
    assert site.sim.run_until(lambda: not site.sim.node("robot1").agreement.is_elector, 2)
    assert site.saved("robot1").votes < votes, "it has given none since"
    assert "votes of this elector" in site.problems("robot1") or "later life" in site.problems("robot1")
    site.sim.run(0.5)
    assert "electors without their state, 1 of 3: robot1" in site.problems("robot2")

    site.sim.crash("robot1")
    site.sim.start("robot1")
    assert not site.sim.node("robot1").agreement.is_elector, "it is on its disk"
    assert site.move(), "the others go on"


@pytest.mark.parametrize("seed", range(2))
def test_a_forgotten_promise_does_not_let_a_second_owner_be_chosen(seed: int) -> None:
    """robot1 and robot2 choose an owner while robot3 is away; robot1's backup and robot3 would choose another one."""
    site = Site(seed)
    site.sim.run(2)
    backup = site.saved("robot1")
    rest = ("robot1", "robot2", *EDGES)
    site.sim.cut(("robot3",), rest)
    site.move(*rest)
    site.sim.run(1)
    site.sim.cuts.clear()
    site.sim.cut(("robot2",), ("robot1", "robot3", *EDGES))
    site.bring_back("robot1", backup)
    site.busy = set()
    site.sim.run(10)  # the simulator raises as soon as two values of a revision, or two owners at work, are seen
    assert not site.sim.node("robot1").agreement.is_elector
    site.sim.heal()
    site.until_owned()


@pytest.mark.parametrize("seed", range(2))
def test_an_elector_that_only_restarts_loses_nothing(seed: int) -> None:
    site = Site(seed)
    for name in (*ROBOTS, *ROBOTS):
        site.move()
        site.sim.crash(name)
        site.sim.run(0.5)
        site.sim.start(name)
        site.sim.run(2)
        assert site.sim.node(name).agreement.is_elector
    for name in site.sim.running():
        site.sim.crash(name, is_power_lost=True)
    site.sim.start()
    site.sim.run(2)
    assert all(site.sim.node(name).agreement.is_elector for name in ROBOTS)
    assert site.move()


def test_what_was_remembered_of_a_generation_says_nothing_of_the_next() -> None:
    site = Site(1)
    site.move()
    for name in site.sim.running():
        site.sim.crash(name)
        site.sim.initialise(site.sim.machines[name], incarnation=site.sim.wall_count, generation=1)
    site.sim.start()
    assert site.move()
    assert all(site.sim.node(name).agreement.is_elector for name in ROBOTS)


# --- what the simulator calls beyond what is promised -----------------------------------------------------------------


def restored(*forgetful: NodeId, cut: tuple[NodeId, ...] = ()) -> Site:
    """robot1 comes back from a backup, the forgetful ones without a state, and robot1 does not hear those cut off."""
    site = Site(1)
    backup = site.saved("robot1")
    site.move()
    site.sim.run(1)
    site.sim.cut(("robot1",), cut)
    for name in forgetful:
        site.sim.crash(name)
        site.sim.machines[name].disk.wipe()
        site.sim.machines[name].is_durable = False
        site.sim.start(name)
    site.bring_back("robot1", backup)
    site.sim.run(2)
    return site


def test_a_forgotten_vote_that_nobody_has_seen_is_beyond_what_is_promised() -> None:
    """Found by the simulator (seed 8028426): an elector goes back in time, and all others forget."""
    site = restored("robot2", "robot3", *EDGES)
    assert site.sim.node("robot1").agreement.is_elector
    assert "robot1 began with" in site.sim.memory.beyond


def test_a_forgotten_vote_that_only_a_node_beyond_a_cut_has_seen_is_beyond_what_is_promised() -> None:
    site = restored("robot2", "robot3", "edge2", cut=("edge1",))
    assert site.sim.node("robot1").agreement.is_elector
    assert "robot1 began with" in site.sim.memory.beyond


def test_a_forgotten_vote_that_somebody_in_reach_has_seen_is_judged() -> None:
    site = restored("robot2", "robot3", "edge2")
    assert not site.sim.node("robot1").agreement.is_elector
    assert site.sim.memory.beyond == ""


def test_an_elector_that_votes_though_it_was_told_what_it_forgot_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    backup = Site(1).saved("robot1")
    monkeypatch.setattr(Witness, "_excess", lambda *_: "")
    site = restored("robot2", "robot3", "edge2")
    assert site.saved("robot1").votes > backup.votes, "it has voted again"
    assert site.sim.memory.beyond == ""


def test_an_elector_that_forgets_nothing_is_judged() -> None:
    site = Site(1)
    site.move()
    for name in ("robot2", "robot3", *EDGES):
        site.sim.crash(name)
        site.sim.machines[name].disk.wipe()
        site.sim.start(name)
    site.bring_back("robot1", site.saved("robot1"))
    site.sim.run(2)
    assert site.sim.node("robot1").agreement.is_elector
    assert site.sim.memory.beyond == ""


# --- the rule --------------------------------------------------------------------------------------------------------


def witness(votes: int = 10) -> Witness:
    here = InForce(fleet_of(of=(*ROBOTS, *EDGES), electors=ROBOTS))
    return Witness(me="robot1", electors=ROBOTS, in_force=here, incarnation=7, votes=votes, started_at=100.0)


def told(by: NodeId, *seen: tuple[NodeId, int, int], votes: int = 0) -> Learnt:
    return Learnt(node=by, values=(), incarnation=3, votes=votes, seen=seen)


@pytest.mark.parametrize(
    ("seen", "is_lost"),
    [
        (("robot1", 6, 10), False),
        (("robot1", 6, 11), True),
        (("robot1", 7, 12), False),  # it has voted in this life, and was asked
        (("robot1", 7, 13), True),  # another life of this number
        (("robot1", 8, 0), True),
        (("robot2", 9, 99), False),
    ],
)
def test_only_what_this_state_cannot_know_of_itself_means_that_it_was_lost(
    seen: tuple[NodeId, int, int], is_lost: bool
) -> None:
    own = witness()
    own.votes = 12
    assert bool(own.on_answer(told("edge1", seen))) is is_lost


def test_a_starting_elector_waits_for_all_for_a_moment_and_then_for_a_majority() -> None:
    own = witness()
    assert not own.may_vote(1e9)
    own.on_answer(told("edge1"))
    assert not own.may_vote(1e9), "an edge is none of the majority"
    own.on_answer(told("robot2"))
    assert not own.may_vote(100.0 + ASK_ALL_S - 0.01)
    assert own.may_vote(100.0 + ASK_ALL_S)
    for name in ("edge2", "robot3"):
        own.on_answer(told(name))
    assert own.may_vote(100.0)


def test_a_beat_is_a_reason_to_ask_and_nothing_more() -> None:
    """Whoever can forge a beat makes nobody forget anything, or remember it."""
    own = witness()
    own.on_answer(told("robot2", votes=5))
    beat = beat_of("robot2", incarnation=3, votes=5)
    assert not own.must_ask(beat)
    assert own.must_ask(replace(beat, votes=10**9))
    assert own.seen == {"robot2": (3, 5)}


def test_a_vote_that_the_disk_refused_is_not_remembered_by_others() -> None:
    """Found by the simulator (seed 517): an elector whose disk was full was taken for a restored one afterwards."""
    site = Site(1)
    site.sim.broken_disks.add("robot1")
    site.move("robot2", "robot3")
    site.sim.run(2.0)
    site.sim.broken_disks.discard("robot1")
    site.sim.crash("robot1")
    site.sim.start("robot1")
    site.sim.run(3.0)
    assert site.sim.node("robot1").agreement.problems == {}
    assert site.sim.node("robot1").agreement.is_elector
