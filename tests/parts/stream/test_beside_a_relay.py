"""An application with its own streams beside a real relay process: moves between two workers, and the next relay."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import pytest
import zenoh

from support.books import newest_counts
from support.hand_relay import environment_on
from support.waiting import free_endpoint, until
from zsched.adapters.relay.streams import RelayHandle
from zsched.core.events import ProblemReported, RelayChanged, SlotDrained, SlotFlipped, SlotReady
from zsched.core.hop.books import unaccounted
from zsched.core.relay_protocol import HandleReport, SlotLost, WorkerSeen
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
    WorkerRole,
)
from zsched.relay.roles import RoleServer
from zsched.sessions.config import data_config, worker_config
from zsched.stream import Received, Streams
from zsched.wire.keyspace import Keyspace
from zsched.worker import Received as Input
from zsched.worker import Worker

SETTINGS = StreamSettings(stream_class=StreamClass.RELIABLE, depth=1000, handover=HandoverRule.ALL)
Kind = TypeVar("Kind")


def slot(epoch: int, owner: str) -> Slot:
    ends = (
        ("t/in/0", Direction.INPUT, "robot1/in", f"{owner}/t/robot1/in"),
        ("t/out/0", Direction.OUTPUT, f"{owner}/t/{epoch}/robot1/out", "robot1/out"),
    )
    routes = (
        Route(stream=name, direction=way, from_expr=at, to_expr=to, settings=SETTINGS) for name, way, at, to in ends
    )
    return Slot(epoch=epoch, owner=owner, routes=tuple(routes), ready_when=ReadyWhen.TOKEN)


class Edge:
    """An edge's hub, which tells the worker its role, and a worker that answers everything."""

    def __init__(self, node: str, folder: Path, *dialled: str) -> None:
        endpoint = free_endpoint()
        text = data_config(listen=(endpoint,), connect=(), shared_memory=False, dials_by_gossip=False)
        self.goes_on = threading.Event()
        self.goes_on.set()
        self._hub = zenoh.open(zenoh.Config.from_json5(text))
        self._roles = RoleServer(self._hub, Keyspace("test"), node)
        self.tell(WorkerRole.IDLE)
        dials = (endpoint, *dialled)
        config = worker_config(connect=dials, listen=(), shared_memory=False, dials_by_gossip=False)
        self._worker = Worker.from_env(environment_on(node, folder, config))
        self._answers = self._worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)
        self._worker.subscribe("{prefix}/robot1/in", self._echo)
        self._worker.ready()

    def tell(self, role: WorkerRole, epoch: int = 0) -> None:
        self._roles.set(Role(task="t", role=role, epoch=epoch))

    def _echo(self, sample: Input) -> None:
        self.goes_on.wait(10)
        self._answers.put(sample.payload.to_bytes())

    def close(self) -> None:
        self._worker.close()
        self._hub.close()


@dataclass
class Bench:
    """The robot's relay process and two edges."""

    folder: Path
    reports: list[HandleReport] = field(default_factory=list)
    back: list[int] = field(default_factory=list)
    sent: int = 0

    def __post_init__(self) -> None:
        own, data = free_endpoint(), free_endpoint()
        self.relay = RelayHandle(
            fleet="test",
            node="robot1",
            zenoh_config=data_config(listen=(data,), connect=(), shared_memory=False, dials_by_gossip=False),
            on_report=self.reports.append,
            streams=(self.folder / "robot1.streams", own),
        )
        self.relay.start()
        until(lambda: self.find(RelayChanged, is_running=True), "the relay runs")
        self.edges = {node: Edge(node, self.folder, data, own) for node in ("edge1", "edge2")}
        for node in self.edges:
            until(lambda node=node: self.find(WorkerSeen, node=node), f"the worker on {node}")  # type: ignore[misc] # mypy's lambda

    def find(self, kind: type[Kind], **fields: object) -> Kind | None:
        for report in tuple(self.reports):
            if isinstance(report, kind) and all(getattr(report, name) == value for name, value in fields.items()):
                return report
        return None

    def move(self, new: Slot, old: Slot | None) -> None:
        """The executor's steps."""
        olds = () if old is None else (old,)
        self.edges[new.owner].tell(WorkerRole.ACTIVE, new.epoch)
        if old is not None:
            self.edges[old.owner].tell(WorkerRole.DRAINING, old.epoch)
        for phase, kind in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self.relay.apply(RoutePlan(task="t", phase=phase, current=new, predecessors=olds))
            until(lambda kind=kind: self.find(kind, epoch=new.epoch), f"{phase.value} {new.epoch}")  # type: ignore[misc] # mypy's lambda
        if old is not None:
            until(lambda: self.find(SlotDrained, epoch=old.epoch), f"epoch {old.epoch} has drained")
        self.relay.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=new))
        if old is not None:
            self.edges[old.owner].tell(WorkerRole.IDLE)

    def take(self, answer: Received) -> None:
        self.back.append(int(answer.payload.to_bytes()))

    def count(self) -> StreamCount:
        return next((one for one in newest_counts(self.reports) if one.stream == "t/in/0"), StreamCount(stream="none"))

    def close(self) -> None:
        for edge in self.edges.values():
            edge.close()
        self.relay.stop()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def test_moves_lose_nothing_and_the_next_relay_is_joined(bench: Bench) -> None:
    now = slot(1, "edge1")
    bench.move(now, None)
    halt = threading.Event()
    with Streams.join(runtime_dir=bench.folder) as own:
        own.subscribe("robot1/out", bench.take)
        publisher = own.publisher("robot1/in")

        def feed() -> None:
            while not halt.wait(0.005):
                assert publisher.put(str(bench.sent))
                bench.sent += 1

        thread = threading.Thread(target=feed, daemon=True)
        thread.start()
        for epoch in range(2, 5):
            before = len(bench.back)
            until(lambda before=before: len(bench.back) > before + 20, "answers")  # type: ignore[misc] # mypy's lambda
            new = slot(epoch, "edge2" if epoch % 2 == 0 else "edge1")
            bench.move(new, now)
            now = new
        pid = bench.relay.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        before = len(bench.back)
        until(lambda: len(bench.back) > before + 40, "answers without a relay")
        until(lambda: bench.relay.pid not in (None, pid), "the next relay")
        del bench.reports[:]
        until(lambda: bench.count().messages > before, "its counters have ours")
        bench.move(slot(5, "edge1"), now)
        halt.set()
        thread.join(5)
        until(lambda: len(bench.back) >= bench.sent, f"all answers: {len(bench.back)} of {bench.sent}")
        assert bench.back == list(range(bench.sent))
        until(lambda: bench.count().acknowledged == bench.sent, f"all counted: {bench.count()}")
        count = bench.count()
        assert (count.messages, count.lost, count.doubled, count.at_most_lost) == (bench.sent, 0, 0, 0)
        assert unaccounted(count) == 0
        told = [one.problem for one in bench.reports if isinstance(one, ProblemReported) and one.problem]
        assert not [text for text in told if "again" in text], "the next relay has the same session for it"


def test_what_an_owner_takes_with_it_is_counted(bench: Bench) -> None:
    bench.move(slot(1, "edge1"), None)
    with Streams.join(runtime_dir=bench.folder) as own:
        own.subscribe("robot1/out", bench.take)
        publisher = own.publisher("robot1/in")
        for number in range(40):
            publisher.put(str(number))
        until(lambda: len(bench.back) == 40, "answers of the first owner")
        bench.edges["edge1"].goes_on.clear()
        for number in range(40, 80):
            publisher.put(str(number))
        until(lambda: bench.count().in_flight == 40, "all are on their way")
        bench.edges["edge1"]._worker.session.close()
        bench.edges["edge1"].goes_on.set()
        bench.edges["edge2"].tell(WorkerRole.ACTIVE, 2)
        bench.relay.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=slot(2, "edge2")))
        until(lambda: publisher.put("80") and 80 in bench.back, "an answer of the next owner")
        until(lambda: bench.count().messages > 80 and bench.count().in_flight == 0, f"counted: {bench.count()}")
        count = bench.count()
        assert unaccounted(count) == 0
        # of the samples that were put until one was answered the first ones may have gone to the first owner, too
        assert 40 <= count.at_most_lost < 40 + count.messages - 80
        assert bench.find(SlotLost, task="t", epoch=1, owner="edge1", samples=40) is not None
        assert sorted(set(bench.back)) == [*range(40), 80]


PROGRAM = """
import sys, time
from pathlib import Path
from zsched.stream import Streams

streams = Streams.join(runtime_dir=Path(sys.argv[1]))
publisher = streams.publisher("robot1/in")
for number in range(50):
    publisher.put(str(number))
print("put", flush=True)
time.sleep(60)
"""


def test_an_application_that_is_killed_leaves_its_counters_and_its_place(bench: Bench) -> None:
    bench.move(slot(1, "edge1"), None)
    for life in (1, 2):
        command = [sys.executable, "-c", PROGRAM, str(bench.folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as program:
            assert program.stdout is not None
            assert program.stdout.readline() == b"put\n"
            if life == 1:
                until(lambda: bench.count().acknowledged == 50, "all are processed, and counted")
                bench.edges["edge1"].goes_on.clear()
            else:
                until(lambda: bench.count().in_flight == 50, "all are on their way, and counted")
            program.kill()
    bench.edges["edge1"].goes_on.set()
    until(lambda: not bench.count().in_flight, "it is known to have gone")
    count = bench.count()
    assert (count.messages, count.acknowledged, count.at_most_lost) == (100, 50, 50)
    assert unaccounted(count) == 0
    assert bench.find(SlotLost, task="t", epoch=1, owner="edge1", samples=50) is not None
    with Streams.join(runtime_dir=bench.folder) as own:
        own.subscribe("robot1/out", bench.take)
        own.publisher("robot1/in").put("7")
        until(lambda: bench.back == [7], "the next life's answer, and none of the former's")
