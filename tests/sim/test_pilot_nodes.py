"""Whole nodes replace their electors by themselves, and count the robots that are there."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.electorate.recovery import NEW_DISK, Sides, rejoined
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.messages import ChangeFleet
from zsched.core.values.model import NodeId
from zsched_lab.sim.simulator import Simulator

TASK = "merge"
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")
REPLACE_S, AWAY_S = 2.0, 5.0


def fleet(electors: tuple[NodeId, ...], robots: tuple[NodeId, ...] = ROBOTS) -> Fleet:
    task = task_of(
        TASK,
        (*EDGES, *robots),
        tuning=tuning_of(cpu=1.0, memory=0.0),
        worker=WorkerSpec(command=("true",)),
        exclusive=True,
    )
    plain = fleet_of(task, of=sorted(EDGES + robots), electors=electors)
    return replace(plain, is_auto=True, replace_s=REPLACE_S, away_s=AWAY_S)


class Play:
    """A fleet whose document is agreed, so that its pilots work."""

    def __init__(self, agreed: Fleet, seed: int = 1) -> None:
        self.sim = Simulator(fleet=agreed, seed=seed)
        self.sim.documents.judge_from(agreed, 0)
        self.sim.start()
        command = ChangeFleet(document=self.sim.documents.write(agreed))
        assert self.sim.run_until(lambda: not self.sim.unsettled(), 20), self.sim.unsettled()
        self.sim.deliver(self.sim.machines[agreed.electors[0]], ev.FleetCommanded(request=1, command=command))
        assert self.sim.run_until(lambda: all(value.document and value.settled for value in self.values()), 20)

    def values(self) -> list[FleetValue]:
        found = [self.sim.node(name).agreement.fleet_value for name in self.sim.running()]
        return [value for value in found if value is not None]

    def electors(self) -> tuple[NodeId, ...]:
        return max(self.values(), key=lambda value: value.revision).electorate.names

    def reaches(self, wanted: int | tuple[NodeId, ...], seconds: float = 60.0) -> None:
        """Wait until these, or so many, elect, all of them run, and every running node knows that they are settled."""

        def is_so() -> bool:
            running = self.sim.running()
            return all(
                value.settled
                and wanted in (value.electorate.names, len(value.electors))
                and set(value.electorate.names) <= set(running)
                for value in self.values()
            )

        assert self.sim.run_until(is_so, seconds), self.values()

    def owner_is_alive(self, seconds: float = 20.0) -> None:
        """Wait until the task's owner, as every running node knows it, runs."""
        assert self.sim.run_until(lambda: not self.sim.unsettled(), seconds), self.sim.unsettled()
        assert self.sim.agreed(TASK) in self.sim.running()


def test_electors_die_one_after_another_and_are_replaced() -> None:
    play = Play(fleet(("edge1", "robot1", "robot2")))
    play.reaches(5)
    for left in (5, 4, 3):
        play.sim.crash(play.electors()[0])
        play.reaches(left)
        play.owner_is_alive()
    assert {play.sim.node(name).in_force.electors for name in play.sim.running()} == {play.electors()}
    assert set(play.electors()) == set(play.sim.running()), "all others are dead"
    play.sim.crash(play.electors()[0])
    play.owner_is_alive()
    assert not play.sim.run_until(lambda: len(play.electors()) != 3, 3 * REPLACE_S)
    quorum = build_snapshot(play.sim.node(play.sim.running()[0]), play.sim.now).quorum
    assert quorum.names == play.electors()
    assert "is gone, and no node is fit to follow it: two electors are no better than three" in quorum.pilot


def test_an_elector_that_has_lost_its_disk_is_replaced_and_the_log_says_why() -> None:
    play = Play(fleet(("edge1", "edge2", "robot1"), robots=("robot1",)))
    play.sim.crash("edge2")
    machine = play.sim.machines["edge2"]
    play.sim.initialise(machine)
    play.sim.start("edge2")
    assert play.sim.run_until(lambda: ("state", "") in play.sim.node("edge2").agreement.problems, REPLACE_S)
    play.reaches(("edge1", "edge3", "robot1"))
    assert play.sim.run_until(lambda: not play.sim.node("edge2").agreement.problems, 5), "that seat is gone"
    play.sim.crash("edge3")
    play.reaches(("edge1", "edge2", "robot1"))
    state = machine.disk.read()
    assert state is not None
    assert {one.name: one.disk for one in play.values()[0].electors}["edge2"] == state.disk
    assert not state.lost
    told = "\n".join(play.sim.stories)
    assert "edge2 is removed as an elector: gone for edge1, robot1, on revision " in told
    assert "edge3 becomes an elector: heard without a break for " in told
    robot = [story for story in play.sim.stories if " robot1 vote number " in story]
    assert any("edge3 is no elector any more (electors: edge1, robot1)" in story for story in robot)


def without_spare() -> Fleet:
    """Three robots, which are the electors, and nobody else."""
    plain = fleet(ROBOTS)
    nodes = tuple(node for node in plain.nodes if node.name in ROBOTS)
    return replace(plain, nodes=nodes, tasks=(replace(plain.tasks[0], candidates=ROBOTS),))


def blank(play: Play, name: NodeId) -> None:
    """`zsched init` on a machine with a blank disk, whose name the others know as an elector."""
    machine, value = play.sim.machines[name], play.values()[0]
    side = Sides(
        generation_id=value.generation_id, generation=0, nodes=(), recovered_by="", electors=value.electorate.names
    )
    machine.disk.wipe()
    machine.disk.write(rejoined(machine.fleet, name, None, side, disk="99", incarnation=1, hardware="", why=NEW_DISK))
    machine.disk.sync()
    machine.is_durable = False


@pytest.mark.parametrize("how", ["init", "blank", "backup"])
def test_a_lost_disk_among_three_electors_without_a_spare_heals_by_itself(how: str) -> None:
    """The one that lost it is the spare: it gives its old seat up, and is added as another member."""
    play = Play(without_spare())
    machine = play.sim.machines["robot3"]
    play.sim.crash("robot3")
    votes = play.sim.disk("robot3").votes  # type: ignore[union-attr]
    if how == "init":
        blank(play, "robot3")
    elif how == "blank":
        play.sim.initialise(machine)
        machine.is_durable = False
    else:
        while machine.disk.state is not None and machine.disk.state.votes == votes:
            machine.disk.restore(Random(1))
        machine.is_durable = False
    play.sim.start("robot3")
    assert play.sim.run_until(lambda: ("state", "") in play.sim.node("robot3").agreement.problems, 5)
    assert not play.sim.node("robot3").agreement.is_elector
    play.reaches(("robot1", "robot2"))
    assert play.sim.run_until(lambda: not play.sim.node("robot3").agreement.problems, 5), "that seat is gone"
    play.reaches(ROBOTS)
    assert play.sim.node("robot3").agreement.is_elector
    play.sim.crash("robot1")
    play.owner_is_alive()
    assert "robot3 is removed as an elector: gone for robot1, robot2, on revision " in "\n".join(play.sim.stories)


def test_three_electors_stay_three_when_one_is_gone_and_nobody_may_follow_it() -> None:
    play = Play(without_spare())
    play.sim.crash("robot3")
    play.sim.machines["robot3"].disk.wipe()
    play.sim.machines["robot3"].is_durable = False
    play.sim.start("robot3")
    assert not play.sim.run_until(lambda: len(play.electors()) != 3, 6 * REPLACE_S), "it has no state to elect with"


def test_robots_that_are_away_for_long_do_not_count_and_the_rest_decides() -> None:
    robots = ("robot1", "robot2", "robot3", "robot4", "robot5")
    play = Play(replace(fleet(EDGES, robots=robots), is_auto=False))
    for name in robots[:3]:
        play.sim.crash(name)
    seen: list[tuple[str, ...]] = []

    def planned_moves_stop() -> bool:
        seen.append(build_snapshot(play.sim.node("robot5"), play.sim.now).problems)
        return any(problem.startswith("no planned moves") for problem in seen[-1])

    assert play.sim.run_until(planned_moves_stop, 5), "three of five robots are silent, and count still"
    assert play.sim.run_until(lambda: all(value.away == robots[:3] for value in play.values()), 3 * AWAY_S)
    assert not planned_moves_stop(), seen[-1]
    assert play.sim.node("robot5").in_force.voters == robots[3:]
    play.owner_is_alive()
    play.sim.start("robot2")
    assert play.sim.run_until(lambda: all(value.away == ("robot1", "robot3") for value in play.values()), AWAY_S)
    assert play.sim.node("robot2").in_force.voters == ("robot2", *robots[3:]), "it has learnt so itself"


def test_a_robot_that_comes_back_into_its_document_counts_from_its_start() -> None:
    robots = ("robot1", "robot2", "robot3")
    play = Play(replace(fleet(EDGES, robots=robots), is_auto=False))
    play.sim.crash("robot1")
    assert play.sim.run_until(lambda: all(value.away == ("robot1",) for value in play.values()), 3 * AWAY_S)
    play.sim.crash("robot2")
    play.sim.start("robot2")
    assert play.sim.run_until(lambda: "robot2" in play.sim.running(), 5)
    assert play.sim.node("robot2").in_force.voters == ("robot2", "robot3"), "its disk says who is away"


def test_a_node_that_leaves_hands_over_gives_its_seat_up_and_gets_neither_back() -> None:
    agreed = fleet(("edge1", "robot1", "robot2"))
    play = Play(agreed)
    play.reaches(5)
    play.owner_is_alive()
    owner = play.sim.agreed(TASK)
    assert owner is not None
    leavers = sorted({owner, play.electors()[0]})
    flags = tuple(Flag(kind=FlagKind.LEAVE, subject=name) for name in leavers)
    content = play.sim.documents.write(agreed, flags)
    play.sim.deliver(play.sim.machines["robot3"], ev.FleetCommanded(request=2, command=ChangeFleet(document=content)))
    stay = tuple(name for name in play.sim.running() if name not in leavers)
    play.reaches(stay if len(stay) % 2 else len(stay) - 1)
    assert not set(leavers) & set(play.electors())
    assert play.sim.run_until(lambda: play.sim.agreed(TASK) in stay, 20)
    play.sim.run_until(lambda: False, 20)
    assert not set(leavers) & {*play.electors(), play.sim.agreed(TASK)}, "they get nothing back while they run"
