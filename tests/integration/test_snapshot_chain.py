"""A worker's state through a whole fleet: the task is moved, the new owner's worker goes on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from support.verbs import move
from zsched_lab.fleet.testbed import Testbed, echo_fleet

WORKER = '''
"""Counts its inputs; its state is the count, which takes a while to say."""
import logging, sys, time
from zsched.worker import Worker

logging.basicConfig(level=logging.INFO, format="%(name)s %(message)s")
count = 0

def take(received):
    global count
    count += 1
    out.put(str(count).encode())

def restore(content):
    global count
    count = int(content)

def save():
    time.sleep(float(sys.argv[1]))
    return str(count).encode()

with Worker.from_env() as worker:
    out = worker.publisher("{prefix}/{epoch}/robot1/out")
    worker.on_snapshot(restore)
    worker.subscribe("{prefix}/robot1/in", take, keep_last=None)
    worker.offer_snapshot(save)
    worker.ready()
    while worker.wait(1.0):
        pass
'''


@pytest.mark.parametrize(
    ("link", "save_s", "stops"), [("peer", 0.0, False), ("client", 0.0, False), ("peer", 1.0, True)]
)
def test_the_state_moves_with_the_task(tmp_path: Path, link: str, save_s: float, stops: bool) -> None:
    """Workers of different machines must reach each other, whatever their links; else every move is a cold start.

    An owner that is told to stop stays until its state has been taken, though that takes a second.
    """
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    worker = {"command": [sys.executable, str(script), str(save_s)], "link": link}
    tree = echo_fleet(robots=1, edges=2, stream_class="reliable", task={"worker": worker})
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        first = bed.wait_settled()
        totals: list[int] = []
        session = bed.app("robot1")
        subscriber = session.declare_subscriber(
            "robot1/out", lambda sample: totals.append(int(sample.payload.to_bytes()))
        )
        publisher = session.declare_publisher("robot1/in")
        bed.wait(lambda: publisher.put(b"x") or totals, 60, "the first count")
        bed.wait(lambda: publisher.put(b"x") or totals[-1] >= 50, 60, "a count worth keeping")
        second = next(name for name in ("edge1", "edge2") if name != first)
        if stops:
            assert bed.stop(first)[first][0] == 0
        else:
            move(bed, second)
        before = max(totals)
        bed.wait(lambda: publisher.put(b"x") or totals[-1] > before, 60, "the new owner counts on")
        assert min(totals[totals.index(before) :]) >= before - 5, bed.log(second) + bed.log(first)
        log = bed.log(second)
        assert f"from={first} bytes=" in log, log
        assert "cold_start" not in log
        subscriber.undeclare()
