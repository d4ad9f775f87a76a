"""A worker's state through a whole fleet: the task is moved, the new owner's worker goes on."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from support.authorities import secured
from support.verbs import command, move
from zsched.host import paths
from zsched.host.operator_client import ask
from zsched.worker.snapshot import TIMEOUT_S
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

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
    early = count
    time.sleep(float(sys.argv[1]))
    return str(early if sys.argv[3:] else count).encode()

with Worker.from_env() as worker:
    out = worker.publisher("{prefix}/{epoch}/robot1/out")
    worker.on_snapshot(restore, timeout_s=float(sys.argv[2]))
    worker.subscribe("{prefix}/robot1/in", take, keep_last=None)
    worker.offer_snapshot(save)
    worker.ready()
    while worker.wait(1.0):
        pass
'''


@contextmanager
def counting(
    folder: Path, *words: str, edges: int = 2, link: str = "peer", has_certificates: bool = False
) -> Iterator[tuple[Testbed, str, list[int], zenoh.Publisher]]:
    """A fleet whose task has counted to 50; its owner, every count that robot1 got, and what it counts by.

    ``words``: for the worker: how long its state takes, how long it waits for one, and whether it is the early one.
    """
    script = folder / "worker.py"
    script.write_text(WORKER)
    worker = {"command": [sys.executable, str(script), *words], "link": link}
    tree = echo_fleet(robots=1, edges=edges, stream_class="reliable", task={"worker": worker})
    if has_certificates:
        secured(tree, folder)
    with Testbed(folder, tree) as bed:
        bed.init()
        bed.start()
        first = bed.wait_whole()
        totals: list[int] = []
        session = bed.app("robot1")
        subscriber = session.declare_subscriber("robot1/out", lambda out: totals.append(int(out.payload.to_bytes())))
        publisher = session.declare_publisher("robot1/in")
        bed.wait(lambda: publisher.put(b"x") or (totals and totals[-1] >= 50), 60, "a count worth keeping")
        yield bed, first, totals, publisher
        subscriber.undeclare()


@pytest.mark.parametrize(
    ("link", "save_s", "stops", "has_certificates"),
    [
        ("peer", 0.0, False, False),
        *(
            pytest.param(*other, marks=pytest.mark.long)
            for other in (
                ("client", 0.0, False, False),
                ("peer", 1.0, True, False),
                ("peer", 0.0, False, True),
                ("client", 0.0, False, True),
            )
        ),
    ],
)
def test_the_state_moves_with_the_task(
    tmp_path: Path, link: str, save_s: float, stops: bool, has_certificates: bool
) -> None:
    """Workers of different machines must reach each other, whatever their links; else every move is a cold start.

    An owner that is told to stop stays until its state has been taken, though that takes a second.
    """
    words = (str(save_s), str(TIMEOUT_S))
    with counting(tmp_path, *words, link=link, has_certificates=has_certificates) as (bed, first, totals, publisher):
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


@pytest.mark.parametrize("edges", [2, 3], ids=["back", "on"])
def test_the_state_follows_a_task_that_moves_twice_at_once(tmp_path: Path, edges: int) -> None:
    """The owner in between is asked while it still waits for the state itself."""
    with counting(tmp_path, "0.6", "10", "early", edges=edges) as (bed, first, totals, publisher):
        others = [name for name in bed.names if name.startswith("edge") and name != first]
        second, third = others[0], (*others, first)[1]
        for node in (second, third):
            socket, task = paths.socket_path(bed.folder, "robot1"), bed.task("robot1")
            order = {"verb": "move", "task": TASK, "target": node, "origin": None}
            said = ask(socket, {**order, "base_revision": task["revision"], "by": "test", "reason": ""}, 10.0)
            bed.wait(lambda node=node: bed.owner() == node, 60, f"the move, of which was said: {said}")  # type: ignore[misc] # at once
        bed.wait(lambda: f"epoch=3 from={second}" in bed.log(third), 60, "the third owner has the state or not")
        before = len(totals)
        bed.wait(lambda: publisher.put(b"x") or len(totals) >= before + 20, 60, "counts of the third owner")
        began = next(number for number, total in enumerate(totals) if total >= 50)
        assert min(totals[began:]) >= 50, bed.log(second) + bed.log(third)
        assert f"restored epoch=3 from={second}" in bed.log(third)


@pytest.mark.long
def test_an_owner_s_worker_that_is_started_again_is_not_given_the_state_of_before_the_move(tmp_path: Path) -> None:
    """It is older than what was done since; without one the worker knows that it has to begin anew."""
    with counting(tmp_path, "0", str(TIMEOUT_S)) as (bed, first, totals, publisher):
        second = next(name for name in ("edge1", "edge2") if name != first)
        move(bed, second)
        bed.wait(lambda: f"restored epoch=2 from={first}" in bed.log(second), 60, "the state")
        before = len(totals)
        command(bed, "restart", TASK, second, "--yes")

        def is_anew() -> bool:
            return any(total < 50 for total in totals[before:])

        bed.wait(lambda: publisher.put(b"x") or is_anew(), 60, "the new worker counts from 1")
        assert bed.log(second).count("restored epoch=2") == 1
