"""Fuzzes what is not payload: keys, tokens, numbers, markers and acknowledgements, of the control and the data plane.

``python -m zsched_lab.bugs.fuzz_keys --rounds N`` feeds them to the real parsers and books: the control bus, the
relay's tokens and lanes, the worker's side of a hop, a state's pieces. Knows: what a hostile one looks like. Does not
know: what it means.

What must hold: nothing is raised; whatever comes of a key or token fits into a frame; a number that is read is one that
a node may have; books stay within what was sent, and memory within its bounds; and a few honest messages later
everything counts on as if nothing had been. The last line is ``N rounds, V violations``; the exit code is 1 when there
is any.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any, cast

from zenoh import SampleKind

from zsched.core.hop.receiver import MAX_REPLAYED, RETURN
from zsched.core.hop.sender import Sender, near
from zsched.core.hop.serial import serial_of
from zsched.core.hop.shared import MAX_RECEIVERS, SharedSender
from zsched.core.route.ros2 import parse_token
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.model import MAX_COUNTER
from zsched.core.values.relay_protocol import EndMarker, SnapshotChunk, StreamAck, StreamAcks
from zsched.core.values.sequence import RUN, Order, Track
from zsched.core.values.words import NAME
from zsched.link.acknowledger import Acknowledger
from zsched.link.bus.control_bus import ControlBus
from zsched.link.keyspace import Keyspace, counter, parse
from zsched.link.pipe.frames import decode_chunk, decode_end, encode_chunk, encode_end
from zsched.relay.streams.slots import KeyState, Numbers
from zsched.relay.tokens import Tokens
from zsched.worker.snapshot import CHUNK, MAX_OFFERS, MAX_SNAPSHOT, Assembly
from zsched_lab.bugs.fuzz_wire import NAMES

KEYS = Keyspace("fuzz")
NUMBERS = (
    *(0, 1, 2, 3, 7, 255, 4096, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**52, MAX_COUNTER, MAX_COUNTER + 1),
    *(2**63, 2**64, 10**25, -1),
)
CHUNKS = (
    *("", "*", "**", "$*", "@zsched", "in", "turn", "ghost", "Edge1", "a" * 63, "a" * 64, "é", "٣", "\x00", "1e3"),
    *(str(number) for number in NUMBERS),
    *NAMES,
)
KINDS = (
    *("alive", "beat", "profile", "proposal", "allocation", "utility", "register", "status", "command", "worker"),
    *("role", "ack", "received", "snapshot", "trouble"),
)


@dataclass(frozen=True, slots=True)
class _Bytes:
    content: bytes

    def to_bytes(self) -> bytes:
        """As zenoh's own do."""
        return self.content


@dataclass(frozen=True, slots=True)
class _Heard:
    """What the parsers read of one of zenoh's samples or queries (nobody can make those without a session)."""

    key_expr: str
    payload: _Bytes
    kind: SampleKind

    def drop(self) -> None:
        """A query is let go of."""


def hostile_key(rng: Random) -> str:
    """A control key with something wrong, or right, about it."""
    if rng.random() < 0.3:  # the right shape, and a number that may be none
        name, number = rng.choice(NAMES), str(rng.choice(NUMBERS))
        return rng.choice(
            (KEYS.alive(name, number), KEYS.worker(name, "merge", number), f"{KEYS.role(name, 't')}/{number}")
        )
    chunks = ["@zsched", rng.choice(("fuzz", "fuzz", "other")), rng.choice(KINDS), rng.choice(NAMES)]
    chunks += [rng.choice(CHUNKS) for _ in range(rng.randrange(4))]
    for _ in range(rng.randrange(3)):
        chunks[rng.randrange(len(chunks))] = rng.choice(CHUNKS)
    return "/".join(chunks)


def _graph_token(rng: Random) -> str:
    known = ("@ros2_lv", "@", "0", "MP", "MS", "SS", "NN", "%", "%chatter", "std§msg", ":1:,1:,:,:,,")
    return "/".join(rng.choice((*known, *CHUNKS)) for _ in range(rng.choice((5, 6, 7, 13, 13, 14))))


class _Silent:
    """Stands in for the session of a `Tokens` whose watch nothing comes from: `_note` is called by hand."""

    def liveliness(self) -> _Silent:
        """Itself."""
        return self

    def declare_subscriber(self, *_: object, **__: object) -> _Silent:
        """A subscription with a handler that is at its end."""
        return self

    handler: tuple[()] = ()


@dataclass(slots=True)
class KeyFuzz:
    """One run by seed."""

    seed: int
    violations: list[str] = field(default_factory=list)
    _rng: Random = field(init=False)
    _parts: tuple[Callable[[], None], ...] = field(init=False)
    _events: list[Any] = field(default_factory=list)
    _bus: ControlBus = field(init=False)
    _tokens: Tokens = field(init=False)

    def __post_init__(self) -> None:
        self._rng = Random(self.seed)
        self._bus = ControlBus(
            fleet="fuzz", node="robot1", incarnation=1, zenoh_config="{}", post=self._events.append, is_voter=True
        )
        self._tokens = Tokens(
            cast("Any", _Silent()), KEYS, self._events.append, lambda _, ended: self._events.append(ended), lambda: None
        )
        self._parts = (
            self._key,
            self._token,
            self._marker,
            self._lane,
            self._kept,
            self._hop,
            self._start,
            self._end,
            self._pieces,
            self._track,
        )

    def run(self, rounds: int) -> None:
        """This many rounds of everything."""
        for number in range(rounds):
            for part in self._parts:
                try:
                    part()
                except Exception as error:  # noqa: BLE001 - whatever escapes is what is looked for
                    self.violations.append(f"seed {self.seed} round {number} {part.__name__}: {error!r}")

    def _number(self) -> int:
        return self._rng.choice((*NUMBERS, self._rng.randrange(2**33)))

    def _counter(self) -> int:
        """One that a frame may hold."""
        return min(max(self._number(), 0), MAX_COUNTER)

    # --- keys and tokens ---------------------------------------------------------------------------------------------

    def _key(self) -> None:
        key, frame = hostile_key(self._rng), self._rng.randbytes(self._rng.randrange(20))
        parsed = parse(key)
        if parsed is not None:
            assert all(NAME.fullmatch(name) for name in (parsed.fleet, parsed.owner, *parsed.rest))
        for chunk in key.split("/"):
            number = counter(chunk)
            assert number is None or 0 <= number <= MAX_COUNTER
        heard = cast("Any", _Heard(key, _Bytes(frame), self._rng.choice((SampleKind.PUT, SampleKind.DELETE))))
        self._events.clear()
        self._bus._on_sample(heard)  # noqa: SLF001 - what zenoh calls
        self._bus._on_token(heard)  # noqa: SLF001
        self._bus._on_query(heard)  # noqa: SLF001
        assert len(self._events) == 3
        for event in self._events:
            if isinstance(event, ev.TokenSeen | ev.TokenLost):
                assert 0 <= event.incarnation <= MAX_COUNTER

    def _token(self) -> None:
        self._events.clear()
        key = hostile_key(self._rng)
        self._tokens._note(key, is_present=self._rng.random() < 0.5)  # noqa: SLF001 - what its thread calls
        for report in self._events:
            wire.decode(wire.encode(report), type(report))  # it goes over the relay's pipe
        parse_token(_graph_token(self._rng))

    def _marker(self) -> None:
        frame = bytearray(
            encode_end(EndMarker(epoch=self._counter(), count=self._counter(), had=self._counter(), age_s=1.0))
        )
        for _ in range(self._rng.randrange(3)):
            frame[self._rng.randrange(len(frame))] = self._rng.randrange(256)
        marker = decode_end(bytes(frame))
        assert marker is None or (0 <= marker.count <= MAX_COUNTER and 0 <= marker.epoch <= MAX_COUNTER)

    # --- numbers -----------------------------------------------------------------------------------------------------

    def _ack(self) -> StreamAck:
        near = self._rng.random() < 0.5
        first, arrived, processed, lost, until = (
            self._rng.randrange(40) if near else self._counter() for _ in range(5)
        )
        has_gap = self._rng.random() < 0.5
        return StreamAck(
            eid=1, first=first, arrived=arrived, processed=processed, lost=lost, until=until, has_gap=has_gap
        )

    def _lane(self) -> None:
        """A relay's book of one publisher: whatever is acknowledged, it stays within what was sent."""
        lane = Sender(kept_samples=16, kept_limit=1000)
        for _ in range(30):
            if self._rng.random() < 0.5:
                lane.note_put(None, None, 10, at=1.0)
            elif self._rng.random() < 0.2:
                done = self._rng.randrange(lane.processed, lane.count + 1)
                lane.acknowledge(StreamAck(eid=1, first=0, arrived=done, processed=done), "1", 2.0)
            else:
                lane.acknowledge(near(self._ack(), lane.count), "1", 2.0)
            assert 0 <= lane.arrived <= lane.count
            assert 0 <= lane.in_flight <= lane.count
            assert lane.acknowledged >= 0
            assert lane.lost >= 0
        lane.count += 5
        lane.acknowledge(StreamAck(eid=1, first=0, arrived=lane.count, processed=lane.count), "1", 3.0)
        assert (lane.in_flight, lane.arrived, lane.is_full()) == (0, lane.count, False)

    def _kept(self) -> None:
        """A worker's answers: a relay's word lets go of nothing that was not sent, and never of more than there is."""
        lane = SharedSender(limit=8)
        for _ in range(20):
            lane.note_put(None, None, 1, 1.0)
            name = str(self._rng.randrange(3 * MAX_RECEIVERS))
            receiver = lane.hear(f"a{name}", f"robot{name}", self._ack(), 1.0)
            assert receiver.arrived <= lane.count
            owed = lane.take_owed(f"a{name}", 1.0, is_reached=self._rng.random() < 0.5)
            assert len(owed.again) <= lane.limit
            assert (owed.skip or 0) <= lane.count
        assert len(lane.kept) <= lane.limit
        if self._rng.random() < 0.05:
            for number in range(MAX_RECEIVERS + 9):
                lane.hear(f"b{number}", f"robot{number}", self._ack(), 2.0)
        assert len(lane.receivers) <= MAX_RECEIVERS

    def _hop(self) -> None:
        """The receiving side: after hostile numbers and markers an honest stream is admitted again within a few."""
        sent: list[StreamAcks] = []
        acks = Acknowledger(lambda _, frame: sent.append(frame))
        name, in_turn = ("k", "a1", 7), self._rng.random() < 0.5
        try:
            start = self._rng.choice((0, 5, 2**32 - 3))
            acks.skip(name, start)
            for number in range(start, start + 4):
                assert acks.admit(name, serial_of(number), in_turn=in_turn) == number
            hostile = serial_of(start + 4 + self._rng.choice((10, 300, 10**6, 2**31 - 100)))
            if self._rng.random() < 0.5:
                acks.skip(name, min(self._number(), MAX_COUNTER) if self._rng.random() < 0.2 else hostile)
            else:
                acks.admit(name, hostile, in_turn=in_turn)
            admitted = [acks.admit(name, serial_of(start + 4 + step), in_turn=in_turn) for step in range(RETURN + 2)]
            heard = [None if number is None else serial_of(number) for number in admitted[RETURN:]]
            assert heard == [serial_of(start + 4 + RETURN), serial_of(start + 5 + RETURN)], (hostile, start, admitted)
            acks.flush()
            for frame in tuple(sent):
                wire.decode(wire.encode(frame), StreamAcks)
        finally:
            acks.close()

    def _start(self) -> None:
        """What start markers say: a few honest ones in a row, and it is so; one never says that less is wanted."""
        acks = Acknowledger(lambda *_: None)
        name, is_whole = ("k", "a1", 7), self._rng.random() < 0.5
        replayed = self._rng.choice((0, 40))
        try:
            acks.skip(name, 0)
            acks.note_start(name, 0, is_whole=is_whole, replayed=replayed)
            for number in range(4):
                acks.admit(name, number, in_turn=True)
            hostile = min(self._number(), MAX_COUNTER)
            acks.note_start(name, max(hostile, 0), is_whole=self._rng.random() < 0.5, replayed=self._counter())
            assert acks.is_whole(name) >= is_whole
            assert replayed <= acks.replay_end(name) <= 4 + MAX_REPLAYED
            for _ in range(RETURN):
                acks.note_start(name, 0, is_whole=is_whole, replayed=replayed)
            assert (acks.is_whole(name), acks.replay_end(name)) == (is_whole, replayed)
        finally:
            acks.close()

    def _end(self) -> None:
        """A slot's end: whatever markers came before, the real one ends it, and nothing before that does."""
        key, publisher = KeyState(), ("a1", 7)
        count = self._rng.randrange(1, 40)
        for number in range(count):
            if self._rng.random() < 0.2:
                named = EndMarker(epoch=1, count=self._rng.choice((number, self._counter())))
                is_taken = key.take_end(named, self._rng.choice((publisher, ("b2", 7))), 1.0)
                assert not is_taken or key.end_of == publisher or number == 0
            key.received += 1
            assert key.sources.setdefault(publisher, Numbers(first=0, arrived=0, processed=0)).take(number)
            key.last_number = number
            key.heard_at = 1.0
            if key.is_past_end(publisher):
                key.reopen()
            assert key.end is None or key.end_of != publisher or key.end.count > number
        assert key.take_end(EndMarker(epoch=1, count=count), publisher, 1.0)
        assert key.is_ended(1.0, None)

    def _pieces(self) -> None:
        """A state's pieces: what is kept is bounded, whatever they say of themselves."""
        assembly, size = Assembly(), 0
        for _ in range(12):
            chunk = SnapshotChunk(
                index=self._rng.choice((0, 1, self._counter())),
                count=self._rng.choice((1, 2, self._counter())),
                size=self._rng.choice((0, 10, CHUNK, CHUNK + 10, MAX_SNAPSHOT, self._counter())),
                checksum=self._rng.choice(("", "00", "ff", "x" * 200)),
            )
            read = decode_chunk(encode_chunk(chunk)) if len(chunk.checksum) < 100 else chunk
            assert read == chunk
            part = bytes(self._rng.choice((0, 10, CHUNK)))
            if assembly.add(chunk, part) is None:
                size += len(part)
        assert size <= MAX_OFFERS * MAX_SNAPSHOT

    def _track(self) -> None:
        """Beats and profiles: whatever came between, a few honest ones in a row are believed."""
        track, now, life = Track(), 100.0, self._rng.choice((1, 5))
        for number in range(5):
            track.judge(life, number, now + number, may_begin=False)
        for _ in range(self._rng.randrange(6)):
            number = self._rng.choice((self._counter(), 4 + self._rng.randrange(1, 40)))
            track.judge(self._rng.choice((life, self._counter())), number, now + 4.5, may_begin=False)
        orders = [track.judge(life, 5 + step, now + 5 + step, may_begin=False) for step in range(RUN + 2)]
        assert orders[RUN:] == [Order.NEW] * 2, orders


def main(arguments: list[str] | None = None) -> int:
    """Fuzz, print, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.bugs.fuzz_keys", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    fuzz = KeyFuzz(given.seed)
    fuzz.run(given.rounds)
    for violation in fuzz.violations[:20]:
        print(violation)
    print(f"{given.rounds} rounds, {len(fuzz.violations)} violations")
    return 1 if fuzz.violations else 0


if __name__ == "__main__":
    sys.exit(main())
