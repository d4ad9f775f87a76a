"""A robot's daemon and relay begin another life in one epoch: what was answered before is neither lost nor done."""

from __future__ import annotations

import time
from pathlib import Path

import zenoh

from support.sessions import matches
from zsched.lab.testbed import TASK, Testbed, echo_fleet
from zsched.worker_keep import NEWCOMERS_S, TICK_S

COUNT = 60


def feed(bed: Testbed, first: int) -> list[int]:
    """An application of the robot's; what has come back of its `COUNT` numbers."""
    app, back = bed.app("robot1"), list[int]()
    kept = app.declare_subscriber("robot1/out", lambda sample: back.append(int(sample.payload.to_bytes())))
    publisher = app.declare_publisher("robot1/in", congestion_control=zenoh.CongestionControl.BLOCK)
    bed.wait(lambda: matches(publisher), 10, "the relay subscribes")
    for number in range(first, first + COUNT):
        publisher.put(str(number).encode())
    bed.wait(lambda: len(back) >= COUNT, 20, f"{COUNT} answers")
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
            bed.wait(lambda: bed.relay_pid("robot1") is None, 10, "the relay has ended, too")
            bed.start("robot1")
            bed.wait_settled()
            assert feed(bed, life * COUNT) == list(range(life * COUNT, (life + 1) * COUNT))

            def has_counted() -> bool:
                return [count.messages for count in bed.counts("robot1")] == [COUNT, COUNT]

            bed.wait(has_counted, 10, "the counters of this life")
            assert [(count.stream, count.lost, count.doubled) for count in bed.counts("robot1")] == [
                (f"{TASK}/in/0", 0, 0),
                (f"{TASK}/out/0", 0, 0),
            ]
        assert bed.task("robot1")["epoch"] == epoch, "all in one epoch"
