"""Hung workers: what a robot's counters say, and what the owner makes of what the robots say."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.beats import beat_of, hear
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import profile_of
from support.states import state_of
from support.todos import todo_of
from zsched.core.executor.handover import Executor, Phase
from zsched.core.executor.progress import MARGIN_S, HangWatch
from zsched.core.executor.rhythm import COUNT_S, Progress
from zsched.core.gateway.gateway import Gateway
from zsched.core.node.node import Node
from zsched.core.scheduler.probation import LIMIT_S
from zsched.core.values import events as ev
from zsched.core.values.fleet import StreamRule, TaskSpec, WorkerSpec, electorate_hash
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import Instruction, RecordStory, RestartWorker
from zsched.core.values.model import RegisterState
from zsched.core.values.plan import Direction, StreamCount
from zsched.core.values.profile import Profile, TaskProgress, WorkerState

ROBOTS = ("robot1", "robot2")
DEADLINE_S = 4.0
INPUT = StreamRule(direction=Direction.INPUT, from_template="{robot}/in", to_template="{target}/merge/{robot}/in")
OUTPUT = StreamRule(direction=Direction.OUTPUT, from_template="{target}/merge/out", to_template="{robot}/out")
SPEC = task_of(
    candidates=("edge1",),
    tuning=tuning_of(cpu=1.0, memory=0.0),
    worker=WorkerSpec(command=("merge",), output_deadline_s=DEADLINE_S),
    rules=(INPUT, OUTPUT),
)
UNSERVED = TaskProgress(task="merge", epoch=3, is_served=False)
SERVED = replace(UNSERVED, is_served=True)


def settled(spec: TaskSpec = SPEC, *, has_streams: bool = True) -> Executor:
    executor = Executor(spec=spec, me="robot1", has_streams=has_streams)
    executor.phase, executor.epoch, executor.owner = Phase.SETTLED, 3, "edge1"
    return executor


class Robot:
    """One robot's counters, told once a second."""

    def __init__(self, spec: TaskSpec = SPEC) -> None:
        self.progress, self.executor = Progress(InForce(fleet_of(spec))), settled(spec)
        self.taken = self.given = 0
        self.acknowledged: int | None = None
        self.now = 100.0

    def run(self, seconds: float, *, inputs: int = 10, outputs: int = 0) -> tuple[TaskProgress, ...]:
        for _ in range(round(seconds / COUNT_S)):
            self.now += COUNT_S
            self.taken, self.given = self.taken + inputs, self.given + outputs
            counts = (
                StreamCount(stream="merge/in/0", messages=self.taken, acknowledged=self.acknowledged),
                StreamCount(stream="merge/out/0", messages=self.given),
                StreamCount(stream="merger/out/0", messages=round(self.now)),  # another task's
            )
            self.progress.absorb(counts, {"merge": self.executor}, self.now)
        return self.progress.reports(self.now)


# --- a robot ---------------------------------------------------------------------------------------------------------


def test_inputs_without_outputs_are_reported_after_the_deadline_and_not_before() -> None:
    robot = Robot()
    assert robot.run(4) == ()
    assert robot.run(1) == ()
    assert robot.run(1) == (UNSERVED,)


def test_outputs_are_reported_and_end_a_complaint() -> None:
    robot = Robot()
    assert robot.run(10) == (UNSERVED,)
    assert robot.run(1, outputs=1) == (SERVED,)
    assert robot.run(3) == (), "three seconds of waiting are within the deadline"


def test_an_answer_of_long_ago_says_nothing() -> None:
    robot = Robot()
    assert robot.run(3, outputs=1) == (SERVED,)
    assert robot.run(DEADLINE_S, inputs=0) == (SERVED,)
    assert robot.run(1, inputs=0) == ()


def test_whatever_the_deadline_an_answer_counts_for_two_counts_of_the_relay() -> None:
    """One count may be late."""
    robot = Robot(replace(SPEC, worker=WorkerSpec(command=("merge",), output_deadline_s=0.1)))
    assert robot.run(3, outputs=1) == (SERVED,)
    assert robot.run(2 * COUNT_S, inputs=0) == (SERVED,)
    assert robot.run(COUNT_S, inputs=0) == ()


def test_a_handover_a_new_epoch_and_a_new_relay_start_anew() -> None:
    robot = Robot()
    robot.run(10)
    robot.executor.phase = Phase.DRAINING
    assert robot.run(1) == ()
    robot.executor.phase = Phase.SETTLED
    assert robot.run(5) == ()
    robot.executor.epoch = 4
    assert robot.run(5) == ()
    robot.taken = -10  # a new relay counts from 0
    assert robot.run(5) == ()
    assert robot.run(1) == (replace(UNSERVED, epoch=4),)


def test_a_task_without_outputs_is_judged_by_acknowledgements_if_there_are_any() -> None:
    robot = Robot(replace(SPEC, rules=(INPUT,)))
    assert robot.run(10) == (), "a foreign worker acknowledges nothing"
    robot.acknowledged = 50
    assert robot.run(7) == (UNSERVED,)
    robot.acknowledged = 60
    assert robot.run(1) == (SERVED,)


# --- the owner -------------------------------------------------------------------------------------------------------


def profile(robot: str, sequence: int, *progress: TaskProgress) -> Profile:
    return profile_of(
        robot,
        sequence=sequence,
        cpu_cores=1.0,
        cpu_used_cores=0.1,
        memory_mb=100.0,
        memory_used_mb=10.0,
        progress=progress,
    )


class Owner:
    """The daemon whose worker is judged; its worker became ready at 100 s."""

    def __init__(self, spec: TaskSpec = SPEC) -> None:
        self.fleet = fleet_of(spec, of=("edge1", *ROBOTS))
        self.watch, self.gateway = HangWatch(InForce(self.fleet)), Gateway(InForce(self.fleet))
        self.executor = settled(spec, has_streams=False)
        self.watch.note_worker("merge", WorkerState.READY, 100.0)
        self.sequence = 0

    def hear(self, robot: str, now: float, *progress: TaskProgress) -> tuple[Instruction, ...]:
        self.sequence += 1
        assert self.gateway.absorb(profile(robot, self.sequence, *progress), now) is None
        return tuple(todo_of(self.watch.look, ["merge"], {"merge": self.executor}, self.gateway, now).apply)


LATE = 100.0 + DEADLINE_S + MARGIN_S + 0.1


def test_one_robot_that_is_not_served_is_enough_and_one_complaint_ends_one_life() -> None:
    owner = Owner()
    restart, story = owner.hear("robot1", LATE, UNSERVED)
    assert restart == RestartWorker(task="merge", reason="no output for 4 s while inputs flow")
    assert isinstance(story, RecordStory)
    assert owner.hear("robot1", LATE + 60, UNSERVED) == (), "the next life has not begun"


def test_a_robot_that_is_served_speaks_for_the_worker() -> None:
    owner = Owner()
    assert owner.hear("robot2", LATE, SERVED) == ()
    assert owner.hear("robot1", LATE, UNSERVED) == ()
    assert owner.hear("robot1", LATE + 4, UNSERVED) != (), "robot2's profile is too old to count"


def test_a_worker_that_has_just_become_ready_or_owner_has_its_time() -> None:
    owner = Owner()
    owner.watch.note_worker("merge", WorkerState.STOPPED, 101.0)
    assert owner.hear("robot1", LATE, UNSERVED) == (), "that is what start-up deadlines are for"
    owner.watch.note_worker("merge", WorkerState.READY, LATE)
    assert owner.hear("robot1", LATE + DEADLINE_S, UNSERVED) == ()
    owner.executor.started_at = LATE + 3
    assert owner.hear("robot1", LATE + DEADLINE_S + MARGIN_S + 0.1, UNSERVED) == ()
    assert owner.hear("robot1", LATE + DEADLINE_S + MARGIN_S + 3.1, UNSERVED) != ()


def test_a_complaint_counts_from_the_very_end_of_the_time_on() -> None:
    assert Owner().hear("robot1", LATE - 0.1, UNSERVED) != ()
    assert Owner().hear("robot1", LATE - 0.101, UNSERVED) == ()


def test_a_robot_s_profile_tells_what_its_relay_has_counted_of_tasks_with_a_deadline() -> None:
    for worker, told in ((SPEC.worker, (UNSERVED,)), (WorkerSpec(command=("merge",)), ())):
        spec = replace(SPEC, worker=worker)
        watch, executor = HangWatch(InForce(replace(Owner().fleet, tasks=(spec,)))), settled(spec)
        for second in range(10):
            counts = (
                StreamCount(stream="merge/in/0", messages=10 * second),
                StreamCount(stream="merge/out/0", messages=0),
            )
            watch.absorb(counts, {"merge": executor}, 100.0 + second)
        assert watch.reports(110.0) == told


def test_a_worker_whose_token_went_still_owes() -> None:
    owner = Owner()
    owner.watch.note_worker("merge", WorkerState.STARTING, 101.0)
    assert owner.hear("robot1", LATE, UNSERVED) != ()


def test_a_robot_that_slept_does_not_count_its_sleep_as_waiting() -> None:
    """It wakes up with an input that is not answered yet."""
    robot = Robot()
    robot.run(2)
    robot.now += 60.0
    robot.progress.begin_again("merge", robot.now)
    assert robot.run(3) == ()
    assert robot.run(1) == (UNSERVED,), "it hangs all the same"


def test_an_owner_that_slept_gives_its_worker_the_whole_time_again() -> None:
    owner = Owner()
    owner.watch.note_lag(DEADLINE_S / 2, 200.0)
    assert owner.hear("robot1", 200.0, UNSERVED) == ()
    assert owner.hear("robot1", 200.0 + DEADLINE_S + MARGIN_S + 0.1, UNSERVED) != (), "it hangs all the same"


def test_a_daemon_that_lags_a_little_still_notices() -> None:
    owner = Owner()
    owner.watch.note_lag(DEADLINE_S / 2 - 0.1, LATE)
    assert owner.hear("robot1", LATE, UNSERVED) != ()


@pytest.mark.parametrize("is_suspended", [False, True])
def test_a_suspended_owner_takes_no_complaint_about_its_sleep(*, is_suspended: bool) -> None:
    """The whole node: the robots' complaint is the first thing it hears when it wakes up."""
    node, now = owner_node(), 100.0
    while now < 120.0:
        now = min(max(node.next_deadline(), now + 0.01), 120.0)
        node.handle(ev.DeadlineReached(), now)
    now = node.next_deadline() + (60.0 if is_suspended else 0.0)
    told = node.handle(ev.ProfileReceived(profile=profile("robot1", 1, UNSERVED)), now)
    assert any(isinstance(one, RestartWorker) for one in told) != is_suspended


def owner_node() -> Node:
    """The whole daemon of the only candidate, which owns the task and whose worker became ready at 100 s."""
    node = node_of("edge1")
    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    return node


def node_of(name: str) -> Node:
    """A whole daemon that knows, at 100 s, that edge1 owns the task."""
    fleet = Owner().fleet
    learnt = allocation_of(3, tuning=SPEC.tuning)
    electorate = electorate_hash(fleet)
    state = state_of(name, RegisterState(task="merge", learnt=learnt), electorate=electorate)
    node = Node(fleet=fleet, me=name, durable=state, incarnation=7, electorate=electorate, rng=Random(1), now=100.0)
    node.start(100.0)
    hear(node, *(one.name for one in fleet.nodes if one.name != name), now=100.0)
    return node


def test_a_robot_forgets_its_wait_when_the_worker_is_back_and_complains_of_the_new_life_alone() -> None:
    """Else a complaint of the life before, which is long on its way on a busy machine, ends the new one, too."""
    node = node_of("robot1")
    for done in (ev.SlotReady(task="merge", epoch=3), ev.SlotFlipped(task="merge", epoch=3, replayed=0)):
        node.handle(done, 100.0)
    reports: list[tuple[TaskProgress, ...]] = []
    given = 0

    def run(seconds: int) -> tuple[TaskProgress, ...]:
        for _ in range(seconds):
            second = len(reports) + 1
            counts = (
                StreamCount(stream="merge/in/0", messages=10 * second),
                StreamCount(stream="merge/out/0", messages=given),
            )
            node.handle(ev.StreamsCounted(counts=counts), 100.0 + second)
            reports.append(node.hangs.reports(100.0 + second))
        return reports[-1]

    assert run(10) == (UNSERVED,)
    node.handle(ev.SlotReady(task="merge", epoch=3), 110.1)  # told again: it was there all the time
    assert run(1) == (UNSERVED,)
    node.handle(ev.SlotReady(task="merge", epoch=3, is_ready=False), 111.1)
    assert run(5) == (UNSERVED,), "it is away, and what it owes stays"
    node.handle(ev.SlotReady(task="merge", epoch=3), 116.1)
    assert node.hangs.reports(116.2) == ()
    assert run(4) == ()
    assert run(2) == (UNSERVED,), "the new life hangs, too"
    node.handle(ev.SlotReady(task="merge", epoch=2, is_ready=False), 122.1)
    node.handle(ev.SlotReady(task="merge", epoch=3), 122.2)
    assert run(1) == (UNSERVED,), "that was another owner's"
    given = 1
    assert run(1) == (SERVED,)


class Fates:
    """An owner's daemon and what it hears of both robots: beats every 0.2 s and a profile every second, or nothing."""

    def __init__(self) -> None:
        self.node, self.now, self.sequence = owner_node(), 100.0, 0

    def run(self, seconds: float, said: TaskProgress | None) -> list[RestartWorker]:
        """Both robots are heard and say that (``None``: they are cut off); returns what became of the worker."""
        batch: list[Instruction] = []
        for _ in range(round(seconds / 0.2)):
            self.now += 0.2
            batch += self.node.handle(ev.DeadlineReached(), self.now)
            self.sequence += 1
            for robot in ROBOTS if said is not None else ():
                beat = beat_of(robot, self.sequence)
                batch += self.node.handle(ev.BeatReceived(beat=beat), self.now)
                if said is not None and self.sequence % 5 == 0:
                    told = profile(robot, self.sequence, said)
                    batch += self.node.handle(ev.ProfileReceived(profile=told), self.now)
        return [one for one in batch if isinstance(one, RestartWorker)]


def test_a_link_that_heals_does_not_restart_the_healthy_worker_of_an_owner_without_another_candidate() -> None:
    """While it was cut off its robots waited for it; their streams come back some seconds after their beats."""
    fates = Fates()
    assert fates.run(20.0, SERVED) == []
    assert fates.run(15.0, None) == []
    assert fates.run(8.0, UNSERVED) == [], "the streams' links heal"
    assert fates.run(60.0, SERVED) == []


def test_a_worker_that_hangs_after_a_heal_is_restarted_all_the_same() -> None:
    fates = Fates()
    fates.run(20.0, SERVED)
    fates.run(15.0, None)
    assert fates.run(LIMIT_S + DEADLINE_S, UNSERVED) == []
    assert len(fates.run(MARGIN_S + 2.0, UNSERVED)) == 1


def test_a_robot_that_is_heard_for_the_first_time_is_believed_at_once() -> None:
    fates = Fates()
    assert len(fates.run(DEADLINE_S + MARGIN_S + 2.0, UNSERVED)) == 1


def test_somebody_else_s_worker_is_told_of_and_left_alone() -> None:
    owner = Owner(replace(SPEC, worker=WorkerSpec(output_deadline_s=DEADLINE_S)))
    (story,) = owner.hear("robot1", LATE, UNSERVED)
    assert isinstance(story, RecordStory)
    assert "not ours" in story.text
