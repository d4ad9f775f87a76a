"""What a worker keeps of its answers weighs what they weigh, also when an answer is the input itself."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import psutil
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.link.acknowledger import Acknowledger
from zsched.link.sessions.stalled_links import StalledLinks
from zsched.worker.keep import Debts, Keeper
from zsched.worker.outputs import Output, OutputOptions

ANSWERS = 1000
SIZE = 100


def private_mb() -> float:
    """Private memory of this process in MB."""
    return float(psutil.Process().memory_full_info().uss) / 1e6


def has_sent(output: Output, count: int) -> bool:
    return output.sent >= count


def test_an_answer_that_is_an_input_does_not_hold_the_buffer_in_which_it_came() -> None:
    """Zenoh's is 64 KiB, of which 100 B touch two pages when it is new: kept as they came, these took 12 MB."""
    with hub_and_neighbour() as (application, worker):
        acks = Acknowledger(lambda _relay, _frame: None)
        keeper = Keeper(worker, "t/acks/*", Debts(acks), StalledLinks(worker, 1.5))
        output = Output(
            worker,
            "edge1/t/{epoch}/out",
            OutputOptions(reliable=True),
            keeper=keeper,
            epoch_now=lambda: 1,
            stamp_now=lambda: None,
            owe=lambda _lane, _number: None,
        )
        taken = worker.declare_subscriber("t/in", lambda sample: output.put(sample.payload))
        publisher = application.declare_publisher(
            "t/in", express=True, congestion_control=zenoh.CongestionControl.BLOCK
        )
        until(lambda: matches(publisher), "the worker")
        before = private_mb()

        for number in range(ANSWERS):
            publisher.put(number.to_bytes(SIZE, "big"))
            until(partial(has_sent, output, number + 1), "the answer")  # one by one: each in a buffer of its own

        assert private_mb() - before < 5.0, Path("/proc/self/status").read_text()
        taken.undeclare()
        output.close()
        keeper.close()
        acks.close()
