"""A candidate whose ready worker no stream of a robot reaches: when that is said, and when it is not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.scheduler.probation import Probation
from zsched.core.scheduler.unseen import LONGEST_GAP_S, UNSEEN_S, Unseen
from zsched.core.values.fleet import Standby, TaskSpec, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.plan import ReadyWhen

TASK = task_of(tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("true",)))
OTHER = replace(TASK, name="other")
EDGES = ("edge1", "edge2")
STEP_S = 1.0


class Robot:
    """One robot's view: it looks once a second."""

    def __init__(self, *seen: str, spec: TaskSpec = TASK) -> None:
        self.spec, self.now = spec, 100.0
        self.here = InForce(fleet_of(TASK, OTHER, of=TASK.candidates, electors=("edge1",)))
        self.tokens = Probation(self.here)
        self.unseen, self.period_s = Unseen(self.here), STEP_S
        self.owner: str | None = "edge2"
        self.is_ours = self.is_enough = False
        for name in seen:
            self.show(name)

    def show(self, name: str, *, is_present: bool = True, task: str = TASK.name) -> None:
        self.tokens.on_token(name, task, "1", is_present=is_present, now=self.now)

    def look(self, *ready: str) -> set[str]:
        found = self.unseen.look(
            self.spec,
            ready or EDGES,
            self.tokens,
            self.now,
            self.period_s,
            owner=self.owner,
            is_ours=self.is_ours,
            is_enough=self.is_enough,
        )
        return set(found)

    def pass_time(self, seconds: float, *ready: str) -> set[str]:
        found, end = self.look(*ready), self.now + seconds
        while self.now < end:
            self.now = min(self.now + STEP_S, end)
            found = self.look(*ready)
        return found


def test_a_ready_worker_that_is_not_seen_beside_one_that_is_is_told_after_its_time() -> None:
    robot = Robot("edge2")
    assert robot.pass_time(UNSEEN_S - 0.01) == set()
    assert robot.pass_time(0.01) == {"edge1"}
    assert robot.unseen.found == {"merge": {"edge1"}}


def test_a_robot_that_sees_nobody_s_worker_blames_nobody() -> None:
    assert Robot().pass_time(60.0) == set()
    assert Robot("edge1", "edge2").pass_time(60.0) == set()


def test_a_robot_that_can_do_the_task_alone_leaves_it_to_nobody_whom_it_does_not_see() -> None:
    robot = Robot()
    robot.is_enough = True
    assert robot.pass_time(UNSEEN_S - 0.01) == set()
    assert robot.pass_time(0.01) == {"edge1", "edge2"}


def test_the_worker_of_another_task_is_no_sight_of_this_one_s() -> None:
    robot = Robot()
    robot.show("edge2", task="other")
    assert robot.pass_time(60.0) == set()
    robot = Robot("edge2")
    robot.show("edge1", task="other")
    assert robot.pass_time(UNSEEN_S) == {"edge1"}


def test_a_token_ends_it_at_once_and_its_end_begins_the_time_anew() -> None:
    robot = Robot("edge2")
    assert robot.pass_time(UNSEEN_S) == {"edge1"}
    robot.show("edge1")
    assert robot.look() == set()
    robot.show("edge1", is_present=False)
    assert robot.pass_time(UNSEEN_S - 0.01) == set()
    assert robot.pass_time(0.01) == {"edge1"}


def come_and_go(robot: Robot, times: int, away_s: float = 9.0, there_s: float = 2.0) -> list[set[str]]:
    """What is found at the end of each time away, and of each time there."""
    found = []
    for is_present, for_s in ((False, away_s), (True, there_s)) * times:
        robot.show("edge1", is_present=is_present)
        found.append(robot.pass_time(for_s))
    return found


def test_a_token_that_comes_and_goes_is_found_and_held_until_its_absences_are_forgiven() -> None:
    """11 of each 12 s without a stream: the time began anew with each token, and the owner was never left."""
    robot = Robot("edge2", "edge1")
    assert come_and_go(robot, 3) == [set(), set(), set(), {"edge1"}, {"edge1"}, {"edge1"}]
    assert robot.pass_time(20.0) == {"edge1"}
    assert robot.pass_time(20.0) == set()


def test_one_that_comes_and_goes_is_held_only_where_the_task_has_an_owner_that_does_not() -> None:
    """Where the owner had died nobody got the task: another one was seen, and could not have it for something else."""
    robot = Robot("edge2", "edge1")
    come_and_go(robot, 4)
    for owner, is_ours, found in (
        ("edge2", False, {"edge1"}),
        (None, False, set[str]()),
        ("edge3", False, set[str]()),
        ("robot1", False, set[str]()),
        ("robot1", True, {"edge1"}),
    ):
        robot.owner, robot.is_ours = owner, is_ours
        assert robot.look() == found
    robot.owner, robot.is_ours = "edge2", False
    assert robot.look("edge1") == set(), "its worker is not ready"
    robot.show("edge2", is_present=False)
    assert robot.look() == set()


def test_an_owner_that_comes_and_goes_is_left_while_it_is_away_and_not_when_it_comes_back() -> None:
    robot = Robot("edge2", "edge1")
    robot.owner = "edge1"
    assert come_and_go(robot, 3) == [set(), set(), set(), set(), {"edge1"}, set()]


def test_a_node_of_the_same_name_that_comes_later_has_not_come_and_gone() -> None:
    robot = Robot("edge2", "edge1")
    come_and_go(robot, 4)
    before = robot.here.fleet
    robot.here.take(replace(before, nodes=tuple(node for node in before.nodes if node.name != "edge1")))
    robot.look("edge2")
    robot.here.take(before)
    assert robot.look() == set()


def test_a_token_that_is_away_for_a_moment_now_and_then_is_no_reason() -> None:
    robot = Robot("edge2", "edge1")
    assert come_and_go(robot, 20, away_s=4.0, there_s=41.0) == [set()] * 40


def test_a_new_relay_tells_its_tokens_anew() -> None:
    robot = Robot("edge2")
    robot.pass_time(UNSEEN_S)
    robot.unseen.forget()
    assert robot.unseen.found == {}
    assert robot.pass_time(UNSEEN_S - 0.01) == set()


def test_a_robot_that_stood_still_begins_anew() -> None:
    robot = Robot("edge2")
    robot.pass_time(UNSEEN_S - 1.0)
    robot.now += LONGEST_GAP_S + 0.01
    assert robot.look() == set()
    assert robot.pass_time(UNSEEN_S) == {"edge1"}


def test_a_robot_that_looks_seldom_finds_it_all_the_same() -> None:
    """Alone with `decide_s: 8` it forgot at every look what it had seen at the one before."""
    robot = Robot("edge2")
    robot.period_s = LONGEST_GAP_S + 3.0
    found = [robot.look()]
    for _ in range(2):
        robot.now += robot.period_s
        found.append(robot.look())
    assert found == [set(), set(), {"edge1"}]
    robot.now += 2.0 * robot.period_s + 0.01
    assert robot.look() == set()


@pytest.mark.parametrize(
    "worker",
    [
        WorkerSpec(command=("true",), standby=Standby.COLD),
        WorkerSpec(command=("true",), ready_when=ReadyWhen.MATCHING),
    ],
    ids=["cold", "matching"],
)
def test_workers_that_show_no_token_before_they_own_the_task_say_nothing(worker: WorkerSpec) -> None:
    assert Robot("edge2", spec=replace(TASK, worker=worker)).pass_time(60.0) == set()


def test_nothing_is_told_any_more_of_a_task_whose_workers_show_no_token_from_now_on() -> None:
    robot = Robot("edge2")
    robot.pass_time(UNSEEN_S)
    robot.spec = replace(TASK, worker=WorkerSpec(command=("true",), standby=Standby.COLD))
    assert robot.look() == set()
    assert robot.unseen.found == {"merge": set()}
