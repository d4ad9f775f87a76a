"""When an owner has ceased to answer a robot, by the task's own rhythm."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.executor.handover import Executor, Phase
from zsched.core.executor.rhythm import COUNT_S, HUNG_TIMES, LEAST_S, Progress
from zsched.core.values.fleet import StreamRule, TaskSpec, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.plan import Direction, ReadyWhen, StreamCount

INPUT = StreamRule(direction=Direction.INPUT, from_template="{robot}/in", to_template="{target}/merge/{robot}/in")
OUTPUT = StreamRule(direction=Direction.OUTPUT, from_template="{target}/merge/out", to_template="{robot}/out")
FOREIGN = task_of(
    candidates=("edge1", "edge2"),
    tuning=tuning_of(cpu=1.0, memory=0.0),
    worker=WorkerSpec(command=("merge",), ready_when=ReadyWhen.MATCHING),
    rules=(INPUT, OUTPUT),
)


class Robot:
    """One robot's counters, told once a second."""

    def __init__(self, spec: TaskSpec = FOREIGN, *, acknowledges: bool = False) -> None:
        self.progress, self.acknowledges = Progress(InForce(fleet_of(spec))), acknowledges
        self.executor = Executor(spec=spec, me="robot1", has_streams=True)
        self.executor.phase, self.executor.epoch, self.executor.owner = Phase.SETTLED, 1, "edge1"
        self.taken = self.given = 0.0
        self.now = 100.0

    @property
    def overdue_s(self) -> float | None:
        return self.progress.overdue_s("merge", self.executor.epoch, self.now)

    def run(self, seconds: float, *, in_hz: float = 10.0, out_hz: float = 0.0) -> bool:
        """Whether the owner was overdue at some moment of it."""
        was_overdue = False
        for _ in range(round(seconds / COUNT_S)):
            self.now += COUNT_S
            self.taken, self.given = self.taken + in_hz * COUNT_S, self.given + out_hz * COUNT_S
            taken, given = int(self.taken), int(self.given)
            took = StreamCount(stream="merge/in/0", messages=taken)
            if self.acknowledges:
                took = replace(took, acknowledged=given, in_flight=taken - given)
            counts = (
                took,
                StreamCount(stream="merge/out/0", messages=0 if self.acknowledges else given),
                StreamCount(stream="merger/out/0", messages=round(self.now)),  # another task's
            )
            self.progress.absorb(counts, {"merge": self.executor}, self.now)
            was_overdue |= self.overdue_s is not None
        return was_overdue

    def move(self) -> None:
        self.executor.epoch += 1


@pytest.mark.parametrize("acknowledges", [False, True])
def test_an_owner_whose_answers_have_ended_is_overdue_within_five_seconds(*, acknowledges: bool) -> None:
    robot = Robot(acknowledges=acknowledges)
    assert not robot.run(60.0, out_hz=10.0)
    assert not robot.run(LEAST_S)
    assert robot.run(1.0)
    assert robot.run(1.0, out_hz=1000.0 if acknowledges else 1.0) is False, "it has answered"


def test_a_task_without_outputs_is_judged_by_acknowledgements_alone() -> None:
    spec = replace(FOREIGN, rules=(INPUT,))
    silent = Robot(spec)
    assert not silent.run(60.0, out_hz=10.0)
    assert not silent.run(60.0)
    library = Robot(spec, acknowledges=True)
    library.run(5.0, out_hz=10.0)
    assert library.run(LEAST_S + 2.0)


def test_one_that_says_how_soon_it_answers_is_judged_by_that_elsewhere() -> None:
    robot = Robot(replace(FOREIGN, worker=WorkerSpec(command=("merge",), output_deadline_s=60.0)))
    robot.run(5.0, out_hz=10.0)
    assert not robot.run(60.0)


def test_without_inputs_nobody_owes_an_answer() -> None:
    robot = Robot()
    robot.run(10.0, out_hz=10.0)
    assert not robot.run(60.0, in_hz=0.0)
    assert not robot.run(1.0)
    assert not robot.run(60.0, in_hz=0.0), "one input that is not answered"


def test_answers_that_come_rarely_are_waited_for_as_many_times_as_long() -> None:
    robot = Robot()
    assert not robot.run(100.0, out_hz=0.5)
    assert not robot.run(2.0 * HUNG_TIMES - 1.0)
    assert robot.run(4.0)


def test_who_answers_now_and_then_only_is_waited_for_twice_as_long_as_ever() -> None:
    """A detector that sees nobody: once it was left for that, and then it is known."""
    robot = Robot()
    robot.run(10.0, out_hz=100.0)
    assert robot.run(20.0)
    robot.run(10.0, out_hz=100.0)
    assert not robot.run(30.0)


def test_large_samples_that_do_not_come_through_are_seen_though_some_of_them_do() -> None:
    """A link that is made anew for each of them: 12 a second are sent, two of them come."""
    robot = Robot(acknowledges=True)
    robot.run(20.0, in_hz=12.0, out_hz=12.0)
    assert robot.run(5.0, in_hz=12.0, out_hz=1.8)


@pytest.mark.parametrize(("acknowledges", "ratio"), [(True, 2.0), (False, HUNG_TIMES)])
def test_if_the_next_owner_does_no_better_each_one_is_waited_for_longer(*, acknowledges: bool, ratio: float) -> None:
    robot = Robot(acknowledges=acknowledges)
    robot.run(20.0, out_hz=10.0)
    times = []
    for _ in range(4 if acknowledges else 2):
        began = robot.now
        while robot.overdue_s is None:
            robot.run(1.0)
        times.append(robot.now - began)
        robot.move()
        robot.run(1.0)
    assert [second / first for first, second in itertools.pairwise(times)] == pytest.approx(
        [ratio] * (len(times) - 1), rel=0.3
    )
    robot.given = robot.taken
    robot.run(200.0, out_hz=10.0)
    assert robot.run(LEAST_S + 1.0) is acknowledges, "that is forgiven where acknowledgements tell"


def escapes(schedule: Iterable[tuple[float, float]]) -> list[float]:
    """When a task was left that answers so ((seconds, answers a second) in turn), while inputs flow."""
    robot, found = Robot(), list[float]()
    for seconds, out_hz in schedule:
        for _ in range(round(seconds)):
            if robot.run(1.0, out_hz=out_hz):
                found.append(robot.now - 100.0)
                robot.move()
    return found


@pytest.mark.parametrize("schedule", [((60.0, 10.0), (120.0, 0.0)), ((20.0, 10.0), (20.0, 0.0))])
def test_a_task_that_answers_in_bursts_is_left_twice_at_most(schedule: tuple[tuple[float, float], ...]) -> None:
    """An answer of the next owner ends the wait, too; no steady time of answers makes that forgotten."""
    assert len(escapes(schedule * 40)) in {1, 2}


def test_a_task_that_answers_seldom_is_not_judged_by_its_first_answers() -> None:
    seldom = ((1.0, 0.0), (1.0, 1.0), *((59.0, 0.0), (1.0, 1.0)) * 40)
    assert escapes(seldom) == []


def test_the_next_owner_s_answer_tells_how_long_the_task_may_be_silent() -> None:
    robot = Robot()
    robot.run(20.0, out_hz=10.0)
    assert robot.run(LEAST_S + 1.0)
    robot.move()
    robot.run(20.0)
    robot.run(300.0, out_hz=10.0)
    assert not robot.run(40.0)
    assert robot.run(10.0), "and who answers no more is seen all the same"


def test_a_handover_and_another_life_of_the_worker_owe_nothing() -> None:
    robot = Robot()
    robot.run(20.0, out_hz=10.0)
    robot.run(2.0)
    robot.executor.phase = Phase.DRAINING
    assert not robot.run(10.0)
    robot.executor.phase = Phase.SETTLED
    assert not robot.run(LEAST_S + 1.0)
    assert robot.run(1.0)
    robot.progress.begin_again("merge")
    assert not robot.run(LEAST_S)
    robot.taken = robot.given = 0.0  # another relay
    assert not robot.run(LEAST_S + 1.0)
