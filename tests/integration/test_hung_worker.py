"""A worker that hangs while inputs flow, with real daemons: restarted in place, and left when it hangs again and again.

The endless loop keeps its token and its links; only the missing answers betray it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from zsched_lab.fleet.netbed import descendants_running
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WORKER = Path(__file__).with_name("hangable_echo.py")
DEADLINE_S = 1.0


class Bed(Testbed):
    """A fleet whose workers can be made to hang, and an application on robot1 that publishes 50 times a second."""

    __test__ = False

    def begin(self) -> None:
        self.heard = 0
        self.quiet = threading.Event()
        session = self.app("robot1")
        self._publisher = session.declare_publisher("robot1/in")
        self._subscriber = session.declare_subscriber("robot1/out", self._on_answer)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _publish(self) -> None:
        while not self.quiet.wait(0.02):
            self._publisher.put(b"ping")

    def _on_answer(self, _sample: object) -> None:
        self.heard += 1

    def end(self) -> None:
        self.quiet.set()
        self._thread.join(60)

    def worker_pid(self, node: str) -> int | None:
        found = descendants_running(self.pid(node), str(WORKER))
        return found[0] if found else None


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Bed]:
    # An endless loop is load, too: by the price alone no task leaves it here.
    calm = {"price_s": 1000}
    tree = echo_fleet(robots=2, edges=2, timing="wired", worker=("python", str(WORKER)), scheduling=calm)
    tree["electorate"] = sorted(tree["nodes"])
    tree["tasks"][TASK]["worker"] |= {"output_deadline_s": DEADLINE_S, "max_failures": 2, "start_deadline_s": 30}
    with Bed(tmp_path, tree) as made:
        made.init()
        made.start()
        made.wait_settled()
        made.begin()
        try:
            made.wait(lambda: made.heard, 60, "the first answer")
            yield made
        finally:
            made.end()


@pytest.mark.parametrize("way", [signal.SIGUSR1, signal.SIGSTOP], ids=["endless loop", "stopped"])
def test_a_hung_worker_is_restarted_in_place_and_left_when_it_hangs_again(bed: Bed, way: signal.Signals) -> None:
    owner = bed.wait_settled()
    epoch = bed.task("robot1")["epoch"]
    first = bed.worker_pid(owner)
    assert first is not None
    os.kill(first, way)
    second = bed.wait(lambda: (pid := bed.worker_pid(owner)) != first and pid, 60, "another worker process")
    assert isinstance(second, int)
    assert f"no output for {DEADLINE_S:g} s while inputs flow" in bed.log(owner)
    before = bed.heard
    bed.wait(lambda: bed.heard > before + 20, 60, "answers of the new process")
    assert bed.task("robot1")["epoch"] == epoch, "the task stays where it is"
    os.kill(second, way)
    bed.wait(lambda: bed.owner() not in (None, owner), 60, "another owner")
    before = bed.heard
    bed.wait(lambda: bed.heard > before + 20, 60, "answers of the next owner")


def test_a_worker_that_answers_and_one_that_is_given_nothing_are_left_alone(bed: Bed) -> None:
    owner = bed.wait_settled()
    pid = bed.worker_pid(owner)
    before = bed.heard
    bed.wait(lambda: bed.heard > before + 50 * 4 * DEADLINE_S, 60, "four deadlines' answers")
    bed.quiet.set()
    profiles = bed.status("robot1")["up_s"]
    bed.wait(lambda: bed.status("robot1")["up_s"] > profiles + 4 * DEADLINE_S, 60, "four deadlines of silence")
    assert bed.worker_pid(owner) == pid
    assert "hangs" not in bed.log(owner)
