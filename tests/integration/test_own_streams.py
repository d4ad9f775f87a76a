"""An application that has its streams itself (`zsched.stream`): moves, deaths, and what follows whom."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from support.authorities import install, make_authority
from support.relay_rig import FLEET, ROBOT, TASK, Application, Rig, slot
from support.waiting import free_endpoint, until
from zsched.adapters.relay.streams import RelayHandle
from zsched.core.events import ProblemReported
from zsched.core.relay_protocol import SlotLost
from zsched.core.values.plan import RoutePhase, StreamClass, StreamCount, WorkerRole
from zsched.errors import AdapterError
from zsched.stream import Received, Streams
from zsched_lab.fleet.testbed import TASK as ECHO
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

RELIABLE = StreamClass.RELIABLE
PROGRAM = """
import sys, time
from pathlib import Path
from zsched.stream import Streams

with Streams.join(runtime_dir=Path(sys.argv[1]), node="robot1") as streams:
    publisher = streams.publisher("robot1/in")
    for number in range(int(sys.argv[2])):
        publisher.put(str(number).encode() + b" ", attachment=b"attached")
        time.sleep(0.002)
    print("put", flush=True)
    sys.stdin.read()
"""


@dataclass
class OwnRig(Rig):
    """The robot's relay lets an application have its streams itself."""

    def handle(self, node: str, text: str) -> RelayHandle:
        streams = (self.socket, self.dialled[0]) if node == ROBOT else None
        return RelayHandle(fleet=FLEET, node=node, zenoh_config=text, on_report=self.reports[node].add, streams=streams)

    @property
    def socket(self) -> Path:
        return self.folder / f"{ROBOT}.streams"

    def join(self) -> Streams:
        return Streams.join(runtime_dir=self.folder, node=ROBOT)


@dataclass
class Own:
    """Publishes numbers by streams of its own and collects the answers."""

    streams: Streams
    attachment: bytes | None = b"attached"
    back: list[int] = field(default_factory=list)
    sent: int = 0
    _halt: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.streams.subscribe(f"{ROBOT}/out", self._take)
        self._publisher = self.streams.publisher(f"{ROBOT}/in")

    def _take(self, answer: Received) -> None:
        assert answer.key == f"{ROBOT}/out"
        assert (None if answer.attachment is None else answer.attachment.to_bytes()) == self.attachment
        self.back.append(int(answer.payload.to_bytes().split(b" ")[0]))

    def put(self) -> None:
        assert self._publisher.put(f"{self.sent} ", attachment=self.attachment)
        self.sent += 1

    def stream(self, hz: float) -> threading.Thread:
        thread = threading.Thread(target=self._stream, args=(1 / hz,), daemon=True)
        thread.start()
        return thread

    def _stream(self, period: float) -> None:
        due = time.monotonic()
        while not self._halt.is_set():
            self.put()
            due += period
            time.sleep(max(0.0, due - time.monotonic()))

    def halt(self, thread: threading.Thread) -> None:
        self._halt.set()
        thread.join(10)


@contextmanager
def own_rig(folder: Path) -> Iterator[OwnRig]:
    with OwnRig(folder, dialled=(free_endpoint(),)) as made:
        yield made
        made.assert_nothing_is_unaccounted()


def counted(rig: OwnRig, messages: int) -> StreamCount:
    """The input's counters once they tell of so many messages, none of them in flight."""

    def find() -> StreamCount | None:
        count = rig.told(f"{TASK}/in/0")
        return count if count.messages == messages and not count.in_flight else None

    found: StreamCount = until(find, f"{messages} messages counted, have {rig.told(f'{TASK}/in/0')}")
    return found


def test_planned_moves_lose_double_and_reorder_nothing(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig, rig.join() as streams:
        for node in ("edge1", "edge2"):
            rig.start_worker(node)
        now = slot(1, "edge1", RELIABLE, 1)
        rig.move(now)
        own = Own(streams)
        thread = own.stream(200)
        until(lambda: len(own.back) > 20, "answers of the first owner")
        for epoch in range(2, 8):
            new = slot(epoch, "edge2" if epoch % 2 == 0 else "edge1", RELIABLE, 1)
            rig.move(new, now)
            rig.role(now.owner, WorkerRole.IDLE)
            now = new
            time.sleep(0.1)
        own.halt(thread)
        until(lambda: len(own.back) >= own.sent, f"all answers: {len(own.back)} of {own.sent}")
        assert own.back == list(range(own.sent))
        count = counted(rig, own.sent)
        assert (count.acknowledged, count.lost, count.doubled, count.at_most_lost) == (own.sent, 0, 0, 0)


def test_nothing_is_lost_silently_when_the_owner_is_killed(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig, rig.join() as streams:
        first = rig.start_worker("edge1")
        rig.start_worker("edge2")
        now, new = slot(1, "edge1", RELIABLE, 1), slot(2, "edge2", RELIABLE, 1)
        rig.move(now)
        own = Own(streams)
        thread = own.stream(200)
        until(lambda: len(own.back) > 20, "answers of the first owner")
        first.kill()
        time.sleep(0.3)
        rig.role("edge2", WorkerRole.ACTIVE, 2)
        rig.plan(RoutePhase.CLOSE, new)
        until(lambda: own.back and own.back[-1] > own.sent - 20, "answers of the next owner")
        time.sleep(0.5)
        own.halt(thread)
        until(lambda: own.back[-1] == own.sent - 1, "the last answer")
        assert own.back == sorted(set(own.back)), "in order, none twice"
        count = counted(rig, own.sent)
        missing = own.sent - len(own.back)
        assert missing <= count.lost + count.at_most_lost + sum(number for _, number in count.drops)
        assert rig.reports[ROBOT].find(SlotLost, task=TASK, epoch=1) is not None


def test_what_others_publish_goes_by_the_relay_and_once(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig, rig.join() as streams:
        rig.start_worker("edge1")
        rig.move(slot(1, "edge1", RELIABLE, 1))
        own, other = Own(streams), Application(rig.app)
        until(other.connected, "the relay subscribes")
        for _ in range(100):
            own.put()
            other.put()
        until(lambda: len(own.back) >= 200 and len(other.back) >= 200, "each hears the answers to both")
        count = counted(rig, 200)
        assert (count.acknowledged, count.lost, count.doubled) == (200, 0, 0)
        for back in (own.back, other.back):
            assert sorted(back) == sorted([*range(100), *range(100)])


def test_streams_run_on_while_the_relay_is_replaced(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig, rig.join() as streams:
        for node in ("edge1", "edge2"):
            rig.start_worker(node)
        now = slot(1, "edge1", RELIABLE, 1)
        rig.move(now)
        own = Own(streams)
        thread = own.stream(200)
        until(lambda: len(own.back) > 20, "answers")
        pid = rig.relays[ROBOT].pid
        assert pid is not None
        killed_at = len(own.back)
        subprocess.run(["kill", "-KILL", str(pid)], check=True)
        until(lambda: len(own.back) > killed_at + 40, "answers meanwhile")
        until(lambda: rig.relays[ROBOT].pid not in (None, pid), "the next relay")
        until(lambda: rig.told(f"{TASK}/in/0").messages > killed_at, "its counters have ours")
        new = slot(2, "edge2", RELIABLE, 1)
        rig.move(new, now)
        rig.role("edge1", WorkerRole.IDLE)
        problems = [word.problem for word in rig.reports[ROBOT].told() if isinstance(word, ProblemReported)]
        assert not [one for one in problems if one and "again" in one], "the next relay has the same session for it"
        own.halt(thread)
        until(lambda: len(own.back) >= own.sent, f"all answers: {len(own.back)} of {own.sent}")
        assert own.back == list(range(own.sent))


def test_what_was_put_without_a_relay_is_counted_by_the_next_one_though_the_application_closes(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig:
        rig.start_worker("edge1")
        rig.move(slot(1, "edge1", RELIABLE, 1))
        with rig.join() as streams:
            own = Own(streams)
            own.put()
            until(lambda: len(own.back) == 1, "the first answer")
            counted(rig, 1)
            pid = rig.relays[ROBOT].pid
            assert pid is not None
            subprocess.run(["kill", "-KILL", str(pid)], check=True)
            for _ in range(20):
                own.put()
            until(lambda: len(own.back) == 21, "answers meanwhile")
        assert counted(rig, 21).acknowledged == 21


def test_an_application_that_is_killed_takes_only_what_it_had_in_flight(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig:
        for node in ("edge1", "edge2"):
            rig.start_worker(node)
        now = slot(1, "edge1", RELIABLE, 1)
        rig.move(now)
        command = [sys.executable, "-c", PROGRAM, str(tmp_path), "100"]
        for life in (1, 2):
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
                assert program.stdout is not None
                assert program.stdout.readline() == b"put\n"
                assert counted(rig, 100 * life).acknowledged == 100 * life
                program.send_signal(signal.SIGKILL)
        with rig.join() as streams:
            own = Own(streams)
            own.put()
            until(lambda: own.back == [0], "the third life's answer")
            count = counted(rig, 201)
            assert (count.acknowledged, count.at_most_lost, count.lost) == (201, 0, 0)


def test_an_application_that_ends_in_order_leaves_no_trace_and_a_second_one_is_not_let_in(tmp_path: Path) -> None:
    with own_rig(tmp_path) as rig:
        for node in ("edge1", "edge2"):
            rig.start_worker(node)
        now = slot(1, "edge1", RELIABLE, 1)
        rig.move(now)
        with rig.join() as streams:
            assert streams.publisher(f"{ROBOT}/in").put(b"0 ", attachment=b"attached")
            with pytest.raises(AdapterError, match="one may at a time"):
                rig.join()
            with pytest.raises(ValueError, match="no input rule takes 'robot1/other'"):
                streams.publisher("robot1/other")
            counted(rig, 1)
        with rig.join() as streams:
            streams.publisher(f"{ROBOT}/in").put(b"1 ", attachment=b"attached")
        assert counted(rig, 2).acknowledged == 2
        assert rig.reports[ROBOT].find(ProblemReported, problem=None) is not None
        other = Application(rig.app)
        thread = other.flow(200, 20)
        rig.move(slot(2, "edge2", RELIABLE, 1), now)  # waits until the old slot has drained: its inputs have all ended
        other.halt(thread)


def move(bed: Testbed, to: str) -> None:
    words = ("move", ECHO, to, "--yes", "--node", "robot1", "--runtime-dir", str(bed.folder))
    subprocess.run([sys.executable, "-m", "zsched", *words], check=True, stdout=subprocess.DEVNULL)
    bed.wait(lambda: bed.owner() == to, 30, f"{to} is the owner")
    bed.wait_settled()


def test_a_real_fleet_moves_and_restarts_its_daemon_under_an_application(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=2, timing="wired", stream_class="reliable")
    tree["nodes"]["robot1"]["listen"]["streams"] = free_endpoint()
    tree["tasks"][ECHO]["outputs"][0]["handover"] = "all"
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        first = bed.wait_whole()
        other = "edge2" if first == "edge1" else "edge1"
        with Streams.join(runtime_dir=tmp_path) as streams:
            own = Own(streams, attachment=None)
            thread = own.stream(200)
            bed.wait(lambda: len(own.back) > 20, 30, "answers")
            move(bed, other)
            bed.kill("robot1", with_relay=False)
            at = len(own.back)
            bed.wait(lambda: len(own.back) > at + 40, 30, "answers without a daemon")
            bed.start("robot1")
            bed.wait_whole()
            move(bed, first)
            own.halt(thread)
            bed.wait(lambda: len(own.back) >= own.sent, 30, f"all answers: {len(own.back)} of {own.sent}")
            assert own.back == list(range(own.sent))

            def told() -> StreamCount | None:
                found = (count for count in bed.counts("robot1") if count.stream == f"{ECHO}/in/0")
                count = next(found, None)  # a daemon that has just begun was told of none yet
                return count if count is not None and count.messages == own.sent and not count.in_flight else None

            count = bed.wait(told, 30, "the counters")
            assert count is not None
            assert (count.acknowledged, count.lost, count.at_most_lost, count.doubled) == (own.sent, 0, 0, 0)
            assert bed.unaccounted() == []


def test_in_a_secured_fleet_it_speaks_by_its_node_s_certificate(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=1, timing="wired", stream_class="reliable")
    tree["nodes"]["robot1"]["listen"]["streams"] = free_endpoint()
    tree["security"] = {"operators": ["ana"]}
    authority = make_authority(tmp_path / "authority", tree["fleet"])
    for name, node in tree["nodes"].items():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
        install(authority, tmp_path / "pki" / name, name)
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled(90)
        with Streams.join(runtime_dir=tmp_path) as streams:
            own = Own(streams, attachment=None)
            for _ in range(100):
                own.put()
            bed.wait(lambda: len(own.back) >= 100, 30, "all answers")
        assert own.back == list(range(100))
        bed.wait(lambda: any(one.acknowledged == 100 for one in bed.counts("robot1")), 30, "the counters")
        assert bed.unaccounted() == []
