"""Services through real relays and real workers: one answer or one error for each request, never two runs unasked."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import zenoh

from support.sessions import matches
from support.waiting import until
from zsched.core.values.events import SlotDrained, SlotReady, StreamsCounted
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Route,
    RoutePhase,
    ServiceSettings,
    Slot,
    StreamSettings,
)
from zsched.link.sessions.config import worker_config
from zsched_lab.fleet.relays import ROBOT, Relays

TASK = "jobs"
SERVICE = f"{ROBOT}/job"
DEADLINE_S = 90.0

WORKER = """
import sys, time
from zsched.worker import Answer, Worker

def handle(request):
    with open(sys.argv[1], "a") as log:
        log.write(request.payload.to_bytes().decode() + "\\n")
    words = request.payload.to_bytes().decode().split()
    if words[0] == "sleep":
        time.sleep(float(words[1]))
    if words[0] == "raise":
        raise ValueError("no such job")
    text = f"{worker.prefix} did {' '.join(words)} with {request.parameters}"
    return Answer(payload=text.encode(), attachment=request.attachment, encoding=request.encoding)

with Worker.from_env() as worker:
    worker.serve("{prefix}/robot1/job", handle, depth=4)
    worker.ready()
    while worker.wait(1.0):
        pass
"""


def slot(epoch: int, owner: str, service: ServiceSettings, ready_when: ReadyWhen = ReadyWhen.TOKEN) -> Slot:
    route = Route(
        stream=f"{TASK}/srv/0",
        direction=Direction.SERVICE,
        from_expr=SERVICE,
        to_expr=f"{owner}/{TASK}/{ROBOT}/job",
        settings=StreamSettings(),
        service=service,
    )
    return Slot(epoch=epoch, owner=owner, routes=(route,), ready_when=ready_when)


@dataclass
class Asked:
    """What one request came to."""

    answers: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    attachments: list[bytes] = field(default_factory=list)
    encodings: list[str] = field(default_factory=list)
    took_s: float = 0.0
    thread: threading.Thread | None = None

    def wait(self) -> Asked:
        assert self.thread is not None
        self.thread.join(DEADLINE_S)
        assert not self.thread.is_alive(), "the request was never answered"
        return self


@dataclass
class Rig(Relays):
    """Three nodes' relays on loopback, workers with a service, an application beside the robot."""

    task: str = TASK

    def start(self) -> None:
        (self.folder / "worker.py").write_text(WORKER)
        super().start()
        self.app = self.application()

    def serve(self, node: str) -> subprocess.Popen[bytes]:
        """Start a worker with the service."""
        return self.start_worker(node, str(self.folder / f"{node}.log"), program=(str(self.folder / "worker.py"),))

    def open(self, new: Slot, old: Slot | None = None) -> None:
        """The executor's table up to the flip; the old slot still drains."""
        self.prepare(new, old)
        self.flip(new, old)

    def done_by(self, node: str) -> list[str]:
        """The requests that the node's workers have begun, in order."""
        path = self.folder / f"{node}.log"
        return path.read_text().splitlines() if path.exists() else []

    def ask(self, text: str, key: str = SERVICE, timeout_s: float = DEADLINE_S) -> Asked:
        """Send a request in a thread of its own."""
        asked = Asked()

        def run() -> None:
            started = time.monotonic()
            for reply in self.app.get(
                f"{key}?a=1;b=2",
                payload=text.encode(),
                attachment=b"\x01\x02",
                encoding="text/plain;x",
                timeout=timeout_s,
            ):
                if reply.err is not None:
                    asked.errors.append(reply.err.payload.to_string())
                    continue
                assert reply.ok is not None
                assert str(reply.ok.key_expr) == SERVICE
                asked.answers.append(reply.ok.payload.to_string())
                asked.encodings.append(str(reply.ok.encoding))
                if reply.ok.attachment is not None:
                    asked.attachments.append(reply.ok.attachment.to_bytes())
            asked.took_s = time.monotonic() - started

        asked.thread = threading.Thread(target=run, daemon=True)
        asked.thread.start()
        return asked

    def drops(self) -> dict[str, int]:
        reports = [report for report in self.reports[ROBOT].told() if isinstance(report, StreamsCounted)]
        return dict(reports[-1].counts[0].drops) if reports and reports[-1].counts else {}


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with Rig(tmp_path) as made:
        yield made


ONCE = ServiceSettings(timeout_s=40.0, max_pending=8)
RETRY = ServiceSettings(timeout_s=40.0, max_pending=8, retry=True)
SOON_S = 30.0
"""Well before a service's own time is over; on a quiet machine milliseconds."""


def begin(rig: Rig, settings: ServiceSettings) -> Slot:
    """edge1 owns the task; edge2 stands by."""
    rig.serve("edge1")
    rig.serve("edge2")
    first = slot(1, "edge1", settings)
    rig.open(first)
    rig.plan(RoutePhase.CLOSE, first)
    querier = rig.app.declare_querier(SERVICE)
    until(lambda: matches(querier), "the application sees the relay's offer: else a request has no answer at all")
    querier.undeclare()
    return first


def test_a_request_passes_with_all_that_belongs_to_it_both_ways(rig: Rig) -> None:
    begin(rig, ONCE)
    asked = rig.ask("hello").wait()
    assert asked.answers == [f"edge1/{TASK} did hello with a=1;b=2"]
    assert asked.attachments == [b"\x01\x02"]
    assert asked.encodings == ["text/plain;x"]
    assert asked.errors == []


def test_a_handler_that_fails_is_an_error_reply(rig: Rig) -> None:
    begin(rig, ONCE)
    asked = rig.ask("raise").wait()
    assert asked.answers == []
    assert asked.errors == ["failed: ValueError: no such job"]


def test_requests_in_a_stream_of_moves_are_each_done_once(rig: Rig) -> None:
    """There and back; nobody is told of owners, nobody gets an error, nothing is done twice."""
    now = begin(rig, ONCE)
    asked: list[Asked] = []
    for epoch, owner in enumerate(["edge2", "edge1", "edge2", "edge1"], start=2):
        batch = [rig.ask(f"{epoch}-{number}") for number in range(3)]  # under way while the task moves
        new = slot(epoch, owner, ONCE)
        rig.open(new, now)
        rig.wait(SlotDrained, epoch=now.epoch)
        rig.plan(RoutePhase.CLOSE, new)
        now = new
        for one in batch:
            one.wait()  # a worker here holds four
        asked += batch
    assert [one.errors for one in asked] == [[]] * len(asked)
    done = rig.done_by("edge1") + rig.done_by("edge2")
    assert sorted(done) == sorted(f"{epoch}-{number}" for epoch in range(2, 6) for number in range(3))


def test_the_old_owner_answers_what_it_has_in_hand_within_its_drain_time(rig: Rig) -> None:
    first = begin(rig, ONCE)
    asked = rig.ask("sleep 3")
    until(lambda: rig.done_by("edge1"), "the old owner has begun")
    second = slot(2, "edge2", ONCE)
    rig.open(second, first)
    assert rig.find(SlotDrained, epoch=1) is None, "drained with a request in hand"
    assert rig.ask("new").wait().answers == [f"edge2/{TASK} did new with a=1;b=2"]
    rig.wait(SlotDrained, epoch=1)
    assert asked.wait().answers == [f"edge1/{TASK} did sleep 3 with a=1;b=2"]
    assert rig.done_by("edge2") == ["new"]


def test_what_the_old_owner_has_not_answered_by_then_is_an_error_and_not_done_again(rig: Rig) -> None:
    first = begin(rig, ONCE)
    asked = rig.ask("sleep 10")
    until(lambda: rig.done_by("edge1"), "the old owner has begun")
    second = slot(2, "edge2", ONCE)
    rig.open(second, first)
    rig.plan(RoutePhase.CLOSE, second)
    asked.wait()
    assert asked.took_s < SOON_S
    assert asked.answers == []
    (error,) = asked.errors
    assert error.startswith("moved: ")
    assert rig.done_by("edge2") == []


def test_with_retry_the_new_owner_is_asked_instead(rig: Rig) -> None:
    first = begin(rig, RETRY)
    asked = rig.ask("sleep 4")
    until(lambda: rig.done_by("edge1"), "the old owner has begun")
    second = slot(2, "edge2", RETRY)
    rig.open(second, first)
    rig.plan(RoutePhase.CLOSE, second)
    assert asked.wait().answers == [f"edge2/{TASK} did sleep 4 with a=1;b=2"]
    assert asked.errors == []


def test_a_killed_owner_is_an_error_at_once(rig: Rig) -> None:
    begin(rig, ONCE)
    asked = rig.ask("sleep 5")
    until(lambda: rig.done_by("edge1"), "the owner has begun")
    killed_at = time.monotonic()
    rig.workers["edge1"].kill()
    (error,) = asked.wait().errors
    assert time.monotonic() - killed_at < SOON_S
    assert error.startswith("owner gone: ")
    assert rig.done_by("edge2") == []


def test_a_request_that_nobody_has_taken_waits_for_the_next_owner(rig: Rig) -> None:
    first = begin(rig, ONCE)
    rig.workers["edge1"].kill()
    rig.workers["edge1"].wait(60)
    rig.wait(SlotReady, epoch=1, is_ready=False)
    asked = rig.ask("hello")
    rig.open(slot(2, "edge2", ONCE), first)
    assert asked.wait().answers == [f"edge2/{TASK} did hello with a=1;b=2"]


@pytest.mark.parametrize("hold_s", [0.0, 0.5])
def test_without_any_owner_there_is_an_error_after_the_services_hold(rig: Rig, hold_s: float) -> None:
    begin(rig, replace(ONCE, hold_s=hold_s))
    rig.workers["edge1"].kill()
    rig.wait(SlotReady, epoch=1, is_ready=False)
    asked = rig.ask("hello").wait()
    (error,) = asked.errors
    assert error.startswith("no owner: ")
    assert hold_s <= asked.took_s < ONCE.timeout_s


def test_a_request_that_no_end_of_a_link_ends_is_an_error_soon(rig: Rig) -> None:
    """As those that leave within a millisecond of the owner's death: zenoh leaves them to their time."""
    held: list[zenoh.Query] = []
    config = worker_config(connect=(rig.endpoint(ROBOT),), shared_memory=False)
    with zenoh.open(zenoh.Config.from_json5(config)) as owner:
        queryable = owner.declare_queryable(f"edge1/{TASK}/{ROBOT}/job", held.append)
        foreign = slot(1, "edge1", ONCE, ReadyWhen.MATCHING)
        rig.open(foreign)
        rig.plan(RoutePhase.CLOSE, foreign)
        asked = rig.ask("hello")
        until(lambda: held, "the owner has the request")
        queryable.undeclare()
        (error,) = asked.wait().errors
        held.pop().drop()
    assert error.startswith("owner gone: ")
    assert asked.took_s < SOON_S


def test_a_frozen_owner_is_an_error_not_a_silence(rig: Rig) -> None:
    """Its link's lease ends before the service's own time."""
    begin(rig, ONCE)
    rig.workers["edge1"].send_signal(signal.SIGSTOP)
    asked = rig.ask("hello").wait()
    (error,) = asked.errors
    assert error.startswith("owner gone: ")
    assert asked.took_s < ONCE.timeout_s


def test_a_frozen_owner_with_retry_costs_the_move_only(rig: Rig) -> None:
    first = begin(rig, RETRY)
    rig.workers["edge1"].send_signal(signal.SIGSTOP)
    asked = rig.ask("hello")
    second = slot(2, "edge2", RETRY)
    rig.open(second, first)
    rig.plan(RoutePhase.CLOSE, second)
    asked.wait()
    assert asked.answers == [f"edge2/{TASK} did hello with a=1;b=2"]
    assert asked.took_s < SOON_S


def test_an_owner_that_takes_too_long_is_an_error_in_time(rig: Rig) -> None:
    begin(rig, ServiceSettings(timeout_s=2.0, retry=True))
    asked = rig.ask("sleep 5").wait()
    assert not asked.answers
    (error,) = asked.errors
    assert error.startswith("timeout: ")
    assert asked.took_s > 1.9
    assert rig.done_by("edge1") == ["sleep 5"]


def test_one_request_too_many_is_answered_busy(rig: Rig) -> None:
    begin(rig, ServiceSettings(timeout_s=60.0, max_pending=2))
    asked = [rig.ask("sleep 3") for _ in range(4)]
    for one in asked:
        one.wait()
    errors = [error for one in asked for error in one.errors]
    assert len(errors) == 2
    assert all(error.startswith("busy: ") for error in errors)
    assert sum(len(one.answers) for one in asked) == 2
    until(lambda: rig.drops().get("busy") == 2, "the counter")


def test_a_standby_refuses_and_does_nothing(rig: Rig) -> None:
    begin(rig, ONCE)
    replies = list(rig.app.get(f"edge2/{TASK}/{ROBOT}/job", payload=b"sneaky", timeout=60.0))
    (error,) = [reply.err for reply in replies]
    assert error is not None
    assert error.payload.to_string().startswith("not owner")
    assert rig.done_by("edge2") == []


def test_the_queue_of_a_worker_is_bounded_too(rig: Rig) -> None:
    """One in hand, four wait, two are told at once."""
    begin(rig, ServiceSettings(timeout_s=60.0, max_pending=16))
    first = rig.ask("sleep 5")
    until(lambda: rig.done_by("edge1"), "the owner has begun")
    others = [rig.ask(f"job{number}") for number in range(6)]
    first.wait()
    for one in others:
        one.wait()
    assert sum(error.startswith("busy: ") for one in others for error in one.errors) == 2
    assert sum(len(one.answers) for one in others) == 4
