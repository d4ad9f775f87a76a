"""A hand-made relay: what one shows to a worker, on a real session, with every step the test's own.

Knows: keys, roles, numbers, markers. Does not know: which worker, what is tested.
"""

from __future__ import annotations

from pathlib import Path

import zenoh

from support.waiting import free_endpoint, until
from zsched.core.values import codec as wire
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import EndMarker, StreamAck, StreamAcks
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end, encode_end
from zsched.link.sessions.config import data_config, worker_config

KEYS = Keyspace("test")
ROLE_KEY = KEYS.role("edge1", "t")
INPUT = "edge1/t/robot1/in"


class Relay:
    """What a relay shows to one worker: its role, inputs with numbers, end markers; what it hears back."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session = zenoh.open(zenoh.Config.from_json5(data_config(listen=(self.endpoint,), connect=())))
        self.role = Role(task="t", role=WorkerRole.IDLE)
        self.tokens: set[str] = set()
        self.outputs: list[tuple[str, bytes]] = []
        self.ends: list[tuple[str, EndMarker]] = []
        self._kept = [
            self.session.declare_queryable(KEYS.role("edge1", "*"), self._answer),
            self.session.liveliness().declare_subscriber("@zsched/test/**", self._token, history=True),
            self.session.declare_subscriber("edge1/t/*/*/out", self._output),
            self.session.declare_subscriber(f"edge1/t/*/*/out/{END_CHUNK}", self._end),
        ]
        self.publisher = self.session.declare_publisher(INPUT)
        self.acks: list[StreamAck] = []
        own = str(self.session.zid())
        self._kept.append(self.session.declare_subscriber(KEYS.ack("*", "*", "*", own), self._acknowledged))
        self.count = 0

    def _acknowledged(self, sample: zenoh.Sample) -> None:
        self.acks += wire.decode(sample.payload.to_bytes(), StreamAcks).acks

    def greet(self, *, is_whole: bool, slot: int = 0) -> None:
        """The start marker of a stream; a relay sends nothing of class ``reliable`` before its answer."""
        self.publisher = self.session.declare_publisher(INPUT, congestion_control=zenoh.CongestionControl.BLOCK)
        self.mark(EndMarker(epoch=0, count=self.count, is_whole=is_whole, slot=slot))
        until(self.told, "the answer")

    def told(self) -> StreamAck | None:
        """The newest acknowledgement of what the present publisher has put."""
        return next((ack for ack in reversed(self.acks) if ack.eid == self.publisher.id.eid), None)

    def open_slot(self, epoch: int) -> None:
        """A publisher of class ``reliable`` for a slot of its own."""
        self.count = 0
        self.greet(is_whole=True, slot=epoch)

    def give_up(self) -> None:
        """The slot is closed: what its publisher has put is not to be done any more."""
        self.mark(EndMarker(epoch=0, count=self.count, is_given_up=True))

    def mark(self, marker: EndMarker) -> None:
        """Put an end or start marker of the present publisher."""
        source = zenoh.SourceInfo(self.publisher.id, marker.count)
        self.session.put(f"{INPUT}/{END_CHUNK}", encode_end(marker), source_info=source)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(ROLE_KEY, wire.encode(self.role))

    def _token(self, sample: zenoh.Sample) -> None:
        act = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
        act(str(sample.key_expr))

    def _output(self, sample: zenoh.Sample) -> None:
        self.outputs.append((str(sample.key_expr), sample.payload.to_bytes()))

    def _end(self, sample: zenoh.Sample) -> None:
        marker = decode_end(sample.payload.to_bytes())
        assert marker is not None
        self.ends.append((str(sample.key_expr), marker))

    def tell(self, role: WorkerRole, epoch: int = 0) -> None:
        self.role = Role(task="t", role=role, epoch=epoch)
        self.session.put(ROLE_KEY, wire.encode(self.role))

    def put(self, payload: bytes) -> None:
        self.publisher.put(payload, source_info=zenoh.SourceInfo(self.publisher.id, self.count))
        self.count += 1

    def end(self, epoch: int, count: int | None = None) -> None:
        number = self.count if count is None else count
        self.mark(EndMarker(epoch=epoch, count=number))


def environment(relay: Relay, folder: Path) -> dict[str, str]:
    return environment_on("edge1", folder, worker_config(connect=(relay.endpoint,)))


def environment_on(node: str, folder: Path, config: str) -> dict[str, str]:
    """What a daemon on ``node`` tells its worker of the task, with ``config`` for its session."""
    path = folder / f"{node}.json5"
    path.write_text(config)
    return {
        "ZSCHED_FLEET": "test",
        "ZSCHED_NODE": node,
        "ZSCHED_TASK": "t",
        "ZSCHED_INCARNATION": "3",
        "ZSCHED_ZENOH_CONFIG": str(path),
    }
