"""A stranger's zenoh session attacks a real fleet: streams go on, owners stay, `status` is right, nothing is written.

No certificate keeps it out here: whoever reaches the ports can put, ask and answer. One frame must not end anything.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.allocations import allocation_of
from support.beats import beat_of
from support.profiles import profile_of
from zsched.core.values import codec as wire
from zsched.core.values.messages import Learnt
from zsched.core.values.model import NodeId
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import EndMarker, StreamAck, StreamAcks
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import encode_end
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

KEYS = Keyspace("testbed")
FAR = 10**6


@dataclass
class Application:
    """Puts numbered messages on robot1's key, and notes when which come back."""

    session: zenoh.Session
    received: list[int] = field(default_factory=list)
    sent: int = 0
    _stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self._subscriber = self.session.declare_subscriber("robot1/out", self._hear)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _hear(self, sample: zenoh.Sample) -> None:
        text = sample.payload.to_bytes()
        if text.startswith(b"#"):  # what a stranger has put in between carries no number of ours
            self.received.append(int(text[1:]))

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            self.session.put("robot1/in", b"#%d" % self.sent)
            self.sent += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(60)

    def goes_on(self, bed: Testbed, what: str) -> None:
        """Messages that are sent from now on come back."""
        start = self.sent
        bed.wait(lambda: bool(self.received) and self.received[-1] > start + 25, 60, f"the stream behind {what}")


@pytest.fixture
def bed(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Testbed]:
    """One edge, so that nothing moves by itself; the streams' class may be the parameter.

    One robot has no address on the data network. So workers dial by gossip, and they dial any session that listens.
    """
    tree = echo_fleet(edges=1, stream_class=getattr(request, "param", "latest"))
    del tree["nodes"]["robot3"]["listen"]["data"]
    with Testbed(tmp_path, tree) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_whole()
        yield testbed


@pytest.fixture
def application(bed: Testbed) -> Iterator[Application]:
    made = Application(bed.app("robot1"))
    made.goes_on(bed, "the start")
    yield made
    made.stop()


@dataclass
class Stranger:
    """Two plain sessions, one on the control network, one on the data network."""

    control: zenoh.Session
    data: zenoh.Session


@pytest.fixture
def stranger(bed: Testbed) -> Iterator[Stranger]:
    nodes = bed.fleet.nodes
    with (
        zenoh.open(_peer([node.listen_control for node in nodes])) as control,
        zenoh.open(_peer([node.listen_data for node in nodes if node.listen_data])) as data,
    ):
        yield Stranger(control, data)


def _peer(endpoints: list[str]) -> zenoh.Config:
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "connect/endpoints": endpoints,
        "listen/endpoints": ["tcp/127.0.0.1:0"],
    }.items():
        config.insert_json5(path, json.dumps(value))
    return config


def reaches(session: zenoh.Session, key: str) -> None:
    """Wait until somebody subscribes to what the stranger is about to put."""
    publisher = session.declare_publisher(key)
    end = time.monotonic() + 60
    while not getattr(publisher.matching_status, "matching", False):
        assert time.monotonic() < end, f"nobody hears {key}"
        time.sleep(0.01)
    publisher.undeclare()


def life(bed: Testbed, node: NodeId) -> int:
    """The incarnation of a node's daemon."""
    found: int = next(one["incarnation"] for one in bed.status("robot1")["nodes"] if one["name"] == node)
    return found


def is_as_before(bed: Testbed, epoch: int) -> None:
    """Nobody has moved, lost its say, or gone."""
    for node in bed.names:
        status = bed.status(node)
        assert (status["tasks"][0]["owner"], status["tasks"][0]["epoch"]) == ("edge1", epoch)
        assert {one["state"] for one in status["nodes"]} == {"alive"}
        assert status["quorum"]["this_node"] == ("elector" if node.startswith("robot") else "no_elector")


# --- the control network ---------------------------------------------------------------------------------------------


def test_one_put_on_the_control_network_ends_nothing(
    bed: Testbed, application: Application, stranger: Stranger
) -> None:
    """A forged allocation, beats and profiles far ahead, and beats in the robots' own names."""
    epoch = bed.task("robot1")["epoch"]
    relays = {node: bed.relay_pid(node) for node in bed.names}
    put: Callable[[str, bytes], None] = stranger.control.put
    reaches(stranger.control, KEYS.allocation("robot1"))
    tuning = bed.fleet.tasks[0].tuning
    for number in (2**52 - 1, epoch + 1):
        absurd = allocation_of(number, "nobody", task=TASK, tuning=tuning)
        put(KEYS.allocation("robot1"), wire.encode(Learnt(node="robot1", values=(absurd,))))
    ours = life(bed, "edge1")
    for incarnation, sequence in ((ours, 10**9), (ours, FAR), (2**52, 1)):
        put(KEYS.beat("edge1"), _beat("edge1", incarnation, sequence))
        put(KEYS.profile("edge1"), _profile("edge1", incarnation, sequence))
    for step in range(35):  # for longer than it takes to dispute a name
        for robot in ("robot1", "robot2", "robot3"):
            put(KEYS.beat(robot), _beat(robot, 77, 10**6 + step))
        time.sleep(0.2)
    application.goes_on(bed, "forged frames on the control network")
    is_as_before(bed, epoch)
    assert "somebody sends beats in the name of 'robot1'" in str(bed.status("robot1")["problems"])
    assert {node: bed.relay_pid(node) for node in bed.names} == relays
    bed.wait(lambda: bed.status("robot1")["problems"] == [], 60, "the complaint to end")


def test_beats_in_its_name_do_not_stop_a_daemon_that_starts(bed: Testbed, stranger: Stranger) -> None:
    """It exited 78, which systemd does not try again."""
    reaches(stranger.control, KEYS.beat("robot2"))
    stop = threading.Event()

    def beat() -> None:
        step = 0
        while not stop.wait(0.1):
            step += 1
            stranger.control.put(KEYS.beat("robot2"), _beat("robot2", 1, 10**6 + step))

    beating = threading.Thread(target=beat, daemon=True)
    beating.start()
    try:
        bed.kill("robot2")
        bed.start("robot2")
        bed.wait(lambda: bed.status("robot2")["up_s"] > 4.0, 60, "robot2 to stay")
    finally:
        stop.set()
        beating.join(60)
    assert bed.status("robot2")["quorum"]["this_node"] == "elector"


def _beat(node: NodeId, incarnation: int, sequence: int) -> bytes:
    return wire.encode(beat_of(node, sequence, incarnation=incarnation))


def _profile(node: NodeId, incarnation: int, sequence: int) -> bytes:
    return wire.encode(profile_of(node, incarnation=incarnation, sequence=sequence, draining=True))


# --- the data network ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bed", ["latest", "reliable"], indirect=True)
def test_one_frame_on_the_data_network_ends_nothing(bed: Testbed, application: Application, stranger: Stranger) -> None:
    """Tokens, roles, markers, numbers and acknowledgements, each by whoever has listened for a moment."""
    epoch = bed.task("robot1")["epoch"]
    relays = {node: bed.relay_pid(node) for node in bed.names}
    session = stranger.data
    data, ack = _overheard(bed, session)
    name = data.source_info.source_id
    # a token that no counter can hold
    for node in bed.names:
        for digits in ("9" * 25, "9" * 17, "0" * 40):
            token = session.liveliness().declare_token(f"{KEYS.role(node, TASK)}/{digits}")
            token.undeclare()
    application.goes_on(bed, "tokens of 25 digits")
    # roles, told and answered
    for role in (Role(task=TASK, role=WorkerRole.IDLE), Role(task=TASK, role=WorkerRole.ACTIVE, epoch=10**12)):
        frame = wire.encode(role)
        server = session.declare_queryable(KEYS.role("edge1", TASK), _answering(frame), complete=True)
        for _ in range(5):
            session.put(KEYS.role("edge1", TASK), frame)
            time.sleep(0.05)
        application.goes_on(bed, f"a forged role {role.role}")
        server.undeclare()
    # numbers and markers in the publisher's own name
    for key in (str(data.key_expr), f"edge1/echo/{epoch}/robot1/out"):
        heard = _first(bed, session, key, lambda sample: sample.source_info is not None)
        for number in (FAR, 2**31 - 5, 2**32 - 1):
            source = zenoh.SourceInfo(heard.source_info.source_id, number)
            session.put(key, b"forged", source_info=source, congestion_control=zenoh.CongestionControl.BLOCK)
            for ended in (0, epoch):
                session.put(f"{key}/{END_CHUNK}", encode_end(EndMarker(epoch=ended, count=number)), source_info=source)
            application.goes_on(bed, f"number {number} on {key}")
    # acknowledgements of what was never sent, in the worker's name and in another one's
    for incarnation, number in ((ack.split("/")[-2], 10**12), ("zz", 0), ("zz", 10**12)):
        forged = StreamAck(eid=name.eid, first=0, arrived=number, processed=number)
        session.put(KEYS.ack("edge1", TASK, incarnation, str(name.zid)), wire.encode(StreamAcks(acks=(forged,))))
        application.goes_on(bed, f"an acknowledgement of {number} by {incarnation}")
    is_as_before(bed, epoch)
    assert {node: bed.relay_pid(node) for node in bed.names} == relays, "no relay was replaced"
    assert bed.status("robot1")["problems"] == []


def _answering(frame: bytes) -> Callable[[zenoh.Query], None]:
    def answer(query: zenoh.Query) -> None:
        query.reply(KEYS.role("edge1", TASK), frame)

    return answer


def _overheard(bed: Testbed, session: zenoh.Session) -> tuple[Any, str]:
    """A sample on its way to the worker, and the key of an acknowledgement."""
    data = _first(bed, session, "edge1/echo/robot1/in", lambda sample: sample.source_info is not None)
    ack = _first(bed, session, KEYS.ack("*", "*", "*", str(data.source_info.source_id.zid)), lambda _: True)
    return data, str(ack.key_expr)


def _first(bed: Testbed, session: zenoh.Session, key: str, fits: Callable[[Any], bool]) -> Any:
    heard: list[Any] = []
    watch = session.declare_subscriber(key, heard.append)
    found = bed.wait(lambda: next((one for one in heard if fits(one)), None), 60, f"a sample on {key}")
    watch.undeclare()
    return found
