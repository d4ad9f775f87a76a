"""A worker whose callback is slower than its input, with real daemons: what it skips, what `status` says of that."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import zenoh

from support.sessions import matches
from zsched.core.hop.books import unaccounted
from zsched.core.values.plan import StreamCount
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

WORKER = Path(__file__).with_name("slow_echo.py")
SENT = 200
PERIOD_S = 0.005


@pytest.mark.long
@pytest.mark.parametrize("keep_last", ["", "1"], ids=["default", "keep_last=1"])
def test_what_a_slow_worker_skips_of_a_reliable_input_is_counted_lost(tmp_path: Path, keep_last: str) -> None:
    tree = echo_fleet(robots=1, edges=1, timing="wired", worker=("python", str(WORKER)), stream_class="reliable")
    tree["tasks"][TASK]["worker"]["env"] = {"SLOW_KEEP_LAST": keep_last}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        app, back = bed.app("robot1"), list[int]()
        kept = app.declare_subscriber("robot1/out", lambda sample: back.append(int(sample.payload.to_bytes())))
        publisher = app.declare_publisher("robot1/in", congestion_control=zenoh.CongestionControl.BLOCK)
        bed.wait(lambda: matches(publisher), 60, "the relay subscribes")
        for number in range(SENT):
            publisher.put(str(number).encode())
            time.sleep(PERIOD_S)

        def settled() -> StreamCount | None:
            count = next(count for count in bed.counts("robot1") if count.stream == f"{TASK}/in/0")
            is_done = count.messages == SENT and not count.in_flight and count.acknowledged == len(back)
            return count if is_done else None

        count = bed.wait(settled, 60, "as many acknowledged as answered, nothing in flight")
        assert count is not None
        assert unaccounted(count) == 0
        assert count.lost == SENT - len(back)
        if keep_last:
            assert count.lost > 0
            assert back == sorted(back)
            assert back[-1] == SENT - 1
        else:
            assert back == list(range(SENT))
        kept.undeclare()
