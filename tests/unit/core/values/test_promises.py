"""What is promised of each step, by the timing profile and the task's settings."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of
from zsched.config.timing import PROFILES
from zsched.core.values.fleet import Fleet, Standby, StreamRule, TaskSpec, WorkerSpec
from zsched.core.values.plan import Direction, HandoverRule, OnCrash, ReadyWhen, StreamClass, StreamSettings
from zsched.core.values.promises import promises
from zsched.core.values.rehearsal import Promised, Step


def rule(direction: Direction, stream_class: StreamClass, **settings: object) -> StreamRule:
    made = StreamSettings(stream_class=stream_class, **settings)  # type: ignore[arg-type]
    return StreamRule(direction=direction, from_template="{robot}/a", to_template="{target}/b", settings=made)


RULES = (
    rule(Direction.INPUT, StreamClass.RELIABLE),
    rule(Direction.INPUT, StreamClass.RELIABLE, on_crash=OnCrash.REPLAY),
    rule(Direction.INPUT, StreamClass.LATEST),
    rule(Direction.OUTPUT, StreamClass.RELIABLE, handover=HandoverRule.ALL),
    rule(Direction.OUTPUT, StreamClass.RELIABLE),
)
TASK = task_of(worker=WorkerSpec(command=("merge",), start_deadline_s=20.0), rules=RULES)
FLEET = fleet_of(TASK, of=("edge1", "edge2", "robot1", "robot2", "robot3"), electors=("robot1",))


def of(fleet: Fleet = FLEET, task: TaskSpec = TASK) -> dict[Step, Promised]:
    return {one.step: one for one in promises(fleet, task)}


def test_the_limits_are_those_of_the_timing_page() -> None:
    found = of(replace(FLEET, timing=PROFILES["wifi"]))
    assert list(found) == list(Step)
    # "from suspect on add up to about 1.8 s": confirm 0.3, gather 0.15, vote 0.4, commit 0.6, ranks 0.09, flip 0.3
    assert found[Step.DAEMON].gap_s == pytest.approx(1.84)
    assert found[Step.DAEMON].decide_s == pytest.approx(1.54)
    assert found[Step.LINK].gap_s == pytest.approx(1.84 + 1.6), "silence first: up to a slow beat late, or by the lease"
    assert found[Step.MOVE].gap_s == 0.3
    assert found[Step.MOVE].decide_s == pytest.approx(0.69)
    assert (found[Step.DRAIN].gap_s, found[Step.DRAIN].decide_s) == (0.3, None)
    assert found[Step.WORKER].gap_s > 20.0, "it starts in place"
    assert found[Step.WORKER].decide_s is None
    wired = of(replace(FLEET, timing=PROFILES["wired"]))
    assert wired[Step.LINK].gap_s < found[Step.LINK].gap_s


@pytest.mark.parametrize(("confirm_s", "beat_s", "later_s"), [(0.5, 0.2, 0.2), (0.3, 0.3, 0.15)])
def test_a_dead_daemon_is_gone_by_the_slower_of_both_ways_to_know_it(
    confirm_s: float, beat_s: float, later_s: float
) -> None:
    """It may refute for ``confirm_s``; in a small fleet a lost token counts after one and a half beats."""
    usual, timing = PROFILES["wifi"], replace(PROFILES["wifi"], confirm_s=confirm_s, beat_s=beat_s)
    before, after = (of(replace(FLEET, timing=one))[Step.DAEMON].decide_s for one in (usual, timing))
    assert before is not None
    assert after == pytest.approx(before + later_s)


def test_an_exclusive_task_waits_for_its_lease_and_a_cold_one_for_its_worker() -> None:
    plain, leased = of()[Step.DAEMON], of(task=replace(TASK, exclusive=True))[Step.DAEMON]
    assert leased.gap_s == pytest.approx(plain.gap_s + FLEET.timing.lease_s)
    cold = of(task=replace(TASK, worker=replace(TASK.worker, standby=Standby.COLD)))
    assert cold[Step.MOVE].gap_s == pytest.approx(20.3)


def test_what_loses_nothing_is_named_by_its_stream() -> None:
    found = of()
    assert found[Step.MOVE].whole == found[Step.DRAIN].whole == ("merge/in/0", "merge/in/1", "merge/out/0")
    assert found[Step.DAEMON].whole == ("merge/in/1",), "what was not acknowledged is replayed"
    foreign = of(task=replace(TASK, worker=replace(TASK.worker, ready_when=ReadyWhen.MATCHING)))
    assert all(one.whole == () for one in foreign.values()), "nobody numbers what a foreign worker takes"
