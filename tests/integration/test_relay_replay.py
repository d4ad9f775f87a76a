"""`on_crash: replay`: what an owner that died had not acknowledged is done by the next one, at least once."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from support.relay_rig import ROBOT, Application, Rig, relay_rig, slot
from support.sessions import matches
from support.waiting import until
from zsched.core.values.events import SlotFlipped, SlotReady
from zsched.core.values.plan import OnCrash, RoutePhase, Slot, StreamClass, WorkerRole
from zsched.core.values.relay_protocol import SlotLost


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def replaying(epoch: int, owner: str) -> Slot:
    return slot(epoch, owner, StreamClass.RELIABLE, 1, on_crash=OnCrash.REPLAY)


def first_ones(numbers: list[int]) -> list[int]:
    """Without those that came once more."""
    return list(dict.fromkeys(numbers))


def is_whole(rig: Rig, app: Application) -> bool:
    until(lambda: len(set(app.back)) == app.sent, "an answer to everything", deadline_s=60.0)
    until(lambda: rig.told("echo/in/0").messages >= app.sent, "the count of everything")
    until(lambda: rig.told("echo/in/0").in_flight == 0, "every acknowledgement")
    told = rig.told("echo/in/0")
    assert (told.lost, told.at_most_lost, told.drops) == (0, 0, ())
    assert rig.reports["robot1"].find(SlotLost) is None
    return first_ones(app.back) == list(range(app.sent))


@pytest.mark.parametrize("is_dropped_first", [False, True])
def test_the_next_owner_does_what_the_dead_one_had_not(rig: Rig, is_dropped_first: bool) -> None:
    """Also what came while there was none, in order; what the dead one's answers prove done is done once.

    Its newest answer proves nothing of its own sample, and others may have been on their way.
    """
    worker = rig.start_worker("edge1", "--delay-ms", "5")
    rig.start_worker("edge2")
    app = Application(rig.app)
    first, second = replaying(1, "edge1"), replaying(2, "edge2")
    rig.move(first)
    thread = app.flow(400, 50)
    worker.kill()
    worker.wait(60)
    if is_dropped_first:  # as the executor does with a node that is gone
        sent = app.sent
        rig.plan(RoutePhase.PREPARE, second)
        until(lambda: app.sent > sent + 100, "samples without an owner")
        rig.move(second)
    else:
        rig.move(second, first, drains=False)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    assert is_whole(rig, app)
    assert rig.told("echo/in/0").replayed > 0
    twice = [number for number, times in Counter(app.back).items() if times > 1]
    assert len(twice) <= 3


def test_a_worker_that_restarts_in_place_does_what_its_former_life_had_not(rig: Rig) -> None:
    worker = rig.start_worker("edge1", "--delay-ms", "5")
    app = Application(rig.app)
    rig.move(replaying(1, "edge1"))
    thread = app.flow(150, 50)
    worker.kill()
    worker.wait(60)
    rig.start_worker("edge1")
    before = len(app.back)
    until(lambda: len(app.back) > before + 50, "the stream through its second life")
    app.halt(thread)
    assert is_whole(rig, app)


def test_an_owner_that_hangs_until_it_is_left_has_its_work_done_by_the_next(rig: Rig) -> None:
    """It is alive when the task moves, and never ends its slot."""
    worker = rig.start_worker("edge1")
    rig.start_worker("edge2")
    app = Application(rig.app)
    first, second = replaying(1, "edge1"), replaying(2, "edge2")
    rig.move(first)
    thread = app.flow(200, 50)
    worker.send_signal(signal.SIGSTOP)
    sent = app.sent
    until(lambda: app.sent > sent + 40, "samples to a worker that stands still")
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.move(second, first, drains=False)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    is_whole(rig, app)


def test_what_an_owner_has_left_undone_comes_before_anything_newer(rig: Rig) -> None:
    """An exclusive owner stops at once when the task moves, whatever is on its way to it."""
    rig.start_worker("edge1", "--delay-ms", "5")
    rig.start_worker("edge2")
    app = Application(rig.app)
    first, second = replaying(1, "edge1"), replaying(2, "edge2")
    rig.move(first)
    thread = app.flow(400, 50)
    rig.role("edge1", WorkerRole.IDLE)
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.plan(RoutePhase.PREPARE, second, first)
    until(lambda: rig.reports["robot1"].find(SlotReady, epoch=2, is_ready=True), "the new owner is ready")
    rig.plan(RoutePhase.FLIP, second, first)
    until(lambda: rig.reports["robot1"].find(SlotFlipped, epoch=2), "the flip")
    sent = app.sent
    until(lambda: app.sent > sent + 5, "newer samples")
    rig.plan(RoutePhase.CLOSE, second)
    until(lambda: app.nodes[-1] == "edge2", "the stream through edge2")
    app.halt(thread)
    assert is_whole(rig, app), "in order"


def test_a_timestamp_that_several_samples_have_proves_none_of_them_done(rig: Rig) -> None:
    """As the parts of one scan have it."""
    worker = rig.start_worker("edge1", "--delay-ms", "50")
    rig.start_worker("edge2")
    back: list[int] = []
    answers = rig.app.declare_subscriber(
        f"{ROBOT}/out", lambda sample: back.append(int(sample.payload.to_bytes().split(b" ")[0]))
    )
    first, second = replaying(1, "edge1"), replaying(2, "edge2")
    rig.move(first)
    block = zenoh.CongestionControl.BLOCK
    publisher = rig.app.declare_publisher(f"{ROBOT}/in", congestion_control=block)
    until(lambda: matches(publisher), "the application sees the relay's subscription")
    for scan in range(3):
        stamp = rig.app.new_timestamp()
        for part in range(10):
            publisher.put(f"{10 * scan + part}", timestamp=stamp)
    until(lambda: 13 in back, "an answer to a part of the second scan")
    worker.kill()
    worker.wait(60)
    rig.move(second, first, drains=False)
    until(lambda: len(set(back)) == 30, "an answer to every part")
    answers.undeclare()


def test_what_has_one_of_its_two_answers_is_done_again(rig: Rig) -> None:
    script = Path(__file__).with_name("double_echo.py")
    worker = rig.start_worker("edge1", "2", program=(str(script),))
    rig.start_worker("edge2", program=(str(script),))
    back: list[bytes] = []
    answers = rig.app.declare_subscriber(f"{ROBOT}/out", lambda sample: back.append(sample.payload.to_bytes()))
    first, second = replaying(1, "edge1"), replaying(2, "edge2")
    rig.move(first)
    block = zenoh.CongestionControl.BLOCK
    publisher = rig.app.declare_publisher(f"{ROBOT}/in", congestion_control=block)
    until(lambda: matches(publisher), "the application sees the relay's subscription")
    for number in range(5):
        publisher.put(f"{number}")
    until(lambda: b"1 2" in back, "the first of the third one's answers")
    worker.kill()
    worker.wait(60)
    rig.move(second, first, drains=False)
    until(lambda: {f"{half} {number}".encode() for half in (1, 2) for number in range(5)} <= set(back), "all answers")
    answers.undeclare()
