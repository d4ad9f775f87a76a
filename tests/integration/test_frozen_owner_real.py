"""Real daemons: the task moves to an edge whose worker stands still just then; nothing is lost in silence."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import zenoh

from support.waiting import until
from zsched.core.plan import StreamCount
from zsched.lab.netbed import descendants_running
from zsched.lab.testbed import TASK, Json, Testbed, echo_fleet

HZ = 200


class Application:
    """Numbers out, answers back; a put waits for its link."""

    def __init__(self, session: zenoh.Session) -> None:
        self.back: list[int] = []
        self.sent = 0
        self._subscriber = session.declare_subscriber("robot1/out", self._take)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = session.declare_publisher("robot1/in", congestion_control=block)
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _take(self, sample: zenoh.Sample) -> None:
        self.back.append(int(sample.payload.to_bytes()))

    def _run(self) -> None:
        due = time.monotonic()
        while not self._halt.is_set():
            self._publisher.put(str(self.sent))
            self.sent += 1
            due = max(due + 1 / HZ, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))

    def halt(self) -> None:
        self._halt.set()
        self._thread.join(60)


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    tree: Json = echo_fleet(robots=3, edges=3, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    with Testbed(tmp_path, tree) as made:
        made.init()
        made.start()
        made.wait_whole()
        yield made


def count(bed: Testbed, direction: str) -> StreamCount:
    stream = f"{TASK}/{direction}/0"
    return next((one for one in bed.counts("robot1") if one.stream == stream), StreamCount(stream=stream))


@pytest.mark.parametrize("seconds", [0.9, 4.0])
def test_a_move_to_a_frozen_worker_loses_nothing_in_silence(bed: Testbed, seconds: float) -> None:
    """After 4 s its link is long gone: the task may move once more meanwhile, and then what is lost is told."""
    app = Application(bed.app("robot1"))
    bed.wait(lambda: len(app.back) > 100, 60, "answers")
    owner = bed.wait_settled()
    first = app.back[0]
    bed.send(owner, signal.SIGTERM)  # it hands its task over while it still works
    new = bed.wait(lambda: _other(bed, owner), 60, f"a move away from {owner}")
    pids = descendants_running(bed.pid(new), "zsched.tasks.echo")
    assert pids
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    for pid in pids:
        with suppress(ProcessLookupError):  # its supervisor has ended it
            os.kill(pid, signal.SIGCONT)
    bed.wait(lambda: bed.has_ended(owner), 60, f"{owner} to end")
    bed.wait_settled()
    before = len(app.back)
    bed.wait(lambda: len(app.back) > before + 50, 60, "answers of the next owner")
    app.halt()
    until(lambda: not count(bed, "in").in_flight, "every acknowledgement", deadline_s=60.0)
    time.sleep(1.5)  # the newest counters, and the last answers
    inward, outward = count(bed, "in"), count(bed, "out")
    lost = app.sent - first - len(set(app.back))
    told = inward.lost + inward.at_most_lost + outward.lost + sum(n for one in (inward, outward) for _, n in one.drops)
    assert app.back == sorted(set(app.back))
    assert lost <= told, (inward, outward)
    assert bed.unaccounted() == []
    if seconds < 1:
        assert lost == 0


def _other(bed: Testbed, owner: str) -> str:
    now: str = bed.task("robot1")["owner"] or ""
    return now if now != owner else ""
