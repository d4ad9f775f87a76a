"""A robot's daemon and relay begin another life in one epoch: what was answered before is neither lost nor done."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import zenoh

from support.sessions import matches
from zsched.core.hop.shared import NEWCOMERS_S, TICK_S
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

COUNT = 60


def feed(bed: Testbed, first: int) -> list[int]:
    """An application of the robot's; what has come back of its `COUNT` numbers."""
    app, back = bed.app("robot1"), list[int]()
    kept = app.declare_subscriber("robot1/out", lambda sample: back.append(int(sample.payload.to_bytes())))
    publisher = app.declare_publisher("robot1/in", congestion_control=zenoh.CongestionControl.BLOCK)
    bed.wait(lambda: matches(publisher), 60, "the relay subscribes")
    for number in range(first, first + COUNT):
        publisher.put(str(number).encode())
    bed.wait(lambda: len(back) >= COUNT, 60, f"{COUNT} answers")
    kept.undeclare()
    return back


def test_what_a_former_life_of_the_relay_has_had_is_neither_lost_nor_given_twice(tmp_path: Path) -> None:
    """Twice: at once, while the worker still keeps its first answers, and when it keeps them no more."""
    with Testbed(tmp_path, echo_fleet(robots=1, edges=1, timing="wired", stream_class="reliable")) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        epoch = bed.task("robot1")["epoch"]
        assert feed(bed, 0) == list(range(COUNT))
        kept_until = time.monotonic() + NEWCOMERS_S + TICK_S
        for life in (1, 2):
            if life == 2:
                time.sleep(max(0.0, kept_until - time.monotonic()))
            bed.stop("robot1")
            bed.wait(lambda: bed.relay_pid("robot1") is None, 60, "the relay has ended, too")
            bed.start("robot1")
            bed.wait_settled()
            assert feed(bed, life * COUNT) == list(range(life * COUNT, (life + 1) * COUNT))

            def has_counted() -> bool:
                return [count.messages for count in bed.counts("robot1")] == [COUNT, COUNT]

            bed.wait(has_counted, 60, "the counters of this life")
            assert [(count.stream, count.lost, count.doubled) for count in bed.counts("robot1")] == [
                (f"{TASK}/in/0", 0, 0),
                (f"{TASK}/out/0", 0, 0),
            ]
        assert bed.task("robot1")["epoch"] == epoch, "all in one epoch"


def test_a_robot_that_joins_late_has_lost_nothing_of_what_was_before_it(tmp_path: Path) -> None:
    """An output that all robots share: the others have had its beginning, and the worker keeps that no more."""
    tree = echo_fleet(robots=3, edges=1, timing="wired", stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["from"] = "{target}/echo/{epoch}/robot1/out"
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start("robot1", "robot2", "edge1")
        bed.wait_settled()
        feed(bed, 0)
        time.sleep(NEWCOMERS_S + 2 * TICK_S)  # what everybody has acknowledged is let go of
        bed.start("robot3")
        bed.wait_settled()
        late = bed.app("robot3")
        heard: list[int] = []
        kept = late.declare_subscriber("robot3/out", lambda sample: heard.append(int(sample.payload.to_bytes())))
        feed(bed, COUNT)
        bed.wait(lambda: heard == list(range(COUNT, 2 * COUNT)), 60, "what came since, and nothing twice")

        def told() -> tuple[int, int] | None:
            count = next((one for one in bed.counts("robot3") if one.stream == f"{TASK}/out/0"), None)
            return None if count is None or count.messages < COUNT else (count.messages, count.lost)

        assert bed.wait(told, 60, "the counters") == (COUNT, 0)
        kept.undeclare()
