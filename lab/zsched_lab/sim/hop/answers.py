"""One output's hop: a worker's sender towards several relays, class ``reliable`` or ``latest``.

Knows: what the worker's threads do with the sender (`zsched.worker.keep`), and the relays' with what comes
(`zsched.relay.streams.outputs`); what must hold. Does not know: how the numbers work (`zsched.core.hop`).

What must hold: a relay passes every number once, in order; what does not pass is counted as lost, exactly; everything
that is kept is let go of in the end, and every relay has the last answer. ``reliable``: an input is not done before the
robot that it came from has its answers, as long as that robot is known; and while links only lose what is on them, and
relays only stand still, nothing is lost.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from random import Random
from types import SimpleNamespace
from typing import Any, Final, cast

from zenoh import Sample

from zsched.core.hop.held import HeldInputs
from zsched.core.hop.kept import Owed
from zsched.core.hop.serial import SPAN, number_near, serial_of
from zsched.core.hop.shared import FORGET_S, TICK_S, SharedSender
from zsched.core.values.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks
from zsched.link.acknowledger import ACK_S, Acknowledger
from zsched.link.pipe.frames import encode_end
from zsched.relay.streams.answers import Answers
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.slots import KeyState
from zsched.relay.task import CARE_S
from zsched.worker.outputs import OUTPUT_DEPTH
from zsched_lab.sim.hop.way import FAULTS_END_S, SIZE, HopError, Process, Scene, Way

KEY: Final = "edge1/t/1/out"
WORKER: Final = ("d0", 1)
"""The worker's publisher: (session id, entity id)."""


def _frame(number: int, payload: bytes = bytes(SIZE), encoding: str = "") -> Sample:
    """A frame, as far as a relay reads it (zenoh lets nobody make a sample)."""
    source = SimpleNamespace(source_id=SimpleNamespace(zid=WORKER[0], eid=WORKER[1]), source_sn=serial_of(number))
    frame = SimpleNamespace(
        key_expr=KEY,
        payload=_Payload(payload),
        encoding=encoding,
        attachment=None,
        timestamp=None,
        priority=None,
        express=False,
        source_info=source,
        kind=None,
    )
    return cast("Sample", frame)


def _near(number: int, reference: int) -> int:
    """A number as the other side has it: one that came late knows the lowest bits only."""
    return number_near(serial_of(number), max(0, reference))


class _Payload(bytes):
    def to_bytes(self) -> bytes:
        """As `zenoh.ZBytes` has it."""
        return bytes(self)


@dataclass(slots=True, kw_only=True)
class Relay(Process):
    """One life of a robot's relay."""

    name: str
    node: str
    way: Way
    acks: Acknowledger
    answers: Answers
    counter: StreamCounter
    key: KeyState
    passed: list[int] = field(default_factory=list)
    begins_at: int | None = None
    """The first number that it may count as lost; ``None``: the first one that came."""


@dataclass(slots=True)
class AnswerHop:
    """A worker's sender, the relays and the ways between them."""

    seed: int
    is_whole: bool
    scene: Scene = field(init=False)
    sender: SharedSender = field(init=False)
    held: HeldInputs[SharedSender] = field(default_factory=HeldInputs)
    relays: list[Relay] = field(init=False)
    """The present life of each."""
    first: int = 0
    inputs: int = 0
    lives: int = 0

    def __post_init__(self) -> None:
        rng = Random(self.seed)
        self.scene = Scene(rng)
        # What wraps begins far from 0: a relay that begins with the slot must know that, so it has no first number.
        self.first = rng.choice((0, 0, SPAN - 40))
        limit = OUTPUT_DEPTH if self.is_whole else rng.choice((1, 4))
        if self.is_whole and rng.random() < 0.2:
            limit = 30
        self.sender = SharedSender(limit=limit, is_whole=self.is_whole, count=self.first)
        self.relays = [self._new_relay(f"robot{number}", None) for number in range(rng.choice((1, 2, 3)))]

    def _new_relay(self, node: str, way: Way | None) -> Relay:
        name = f"a{self.lives}"
        self.lives += 1
        counter = StreamCounter("t/out/0")
        acks = Acknowledger(partial(self._said, name), clock=self.scene.clock)
        is_from_start = self.first == 0 and (way is None or self.scene.rng.random() < 0.5)
        answers = Answers(acks, counter, is_from_start=is_from_start, in_turn=self.is_whole, heard={})
        return Relay(
            scene=self.scene,
            name=name,
            node=node,
            way=way or Way(self.scene, lambda: None),
            acks=acks,
            answers=answers,
            counter=counter,
            key=KeyState(name=KEY),
        )

    def _relay(self, name: str) -> Relay | None:
        return next((relay for relay in self.relays if relay.name == name), None)

    def _any(self) -> Relay:
        return self.scene.rng.choice(self.relays)

    def _cut(self) -> None:
        self._any().way.cut()

    def _drop(self) -> None:
        self._any().way.drop()

    def _freeze(self) -> None:
        self._any().freeze()

    def _restart(self) -> None:
        """A relay dies and another life of it begins: another session of the same node."""
        old = self._any()
        old.is_dead = True
        old.way.drop()
        self.relays[self.relays.index(old)] = self._new_relay(old.node, old.way)

    # --- the worker, as its threads treat the sender ------------------------------------------------------------------

    def put(self) -> None:
        """A callback answers an input of one of the relays."""
        number = self.sender.note_put(None, None, SIZE, self.scene.now)
        for relay in self.relays:
            relay.way.carry("out", partial(self._arrive, relay, _frame(number), is_again=False))
        if self.is_whole:
            name = ("edge1/t/in", self._any().name, 1)
            self.held.hold(name, self.inputs, SIZE, {self.sender: number + 1})
            self.inputs += 1

    def look_after(self) -> None:
        """The keeper's thread, now and then."""
        sender, now = self.sender, self.scene.now
        sender.look_after(now)
        for name in sender.in_doubt(now):
            sender.decide(name, now, is_there=self._is_reached(name))
        self._put_owed()
        self._settle()

    def _is_reached(self, name: str) -> bool:
        relay = self._relay(name)
        return relay is not None and relay.way.is_seen

    def _put_owed(self) -> None:
        for name in self.sender.owing():
            owed = self.sender.take_owed(name, self.scene.now, is_reached=self._is_reached(name))
            relay = self._relay(name)
            if relay is not None:
                self._put_to(relay, owed)

    def _put_to(self, relay: Relay, owed: Owed) -> None:
        if owed.skip is not None:
            marker = self.sender.skip_marker(relay.name, owed.skip, self.scene.now)
            frame = _frame(owed.skip, encode_end(marker), SKIP_ENCODING)
            relay.way.carry("out", partial(self._arrive, relay, frame, is_again=True))
        for sent in owed.again:
            relay.way.carry("out", partial(self._arrive, relay, _frame(sent.number), is_again=True))
        if owed.end is not None:
            self._put_end(relay, owed.end)

    def end(self) -> None:
        """The worker is left: its end marker goes behind the last answer."""
        marker = EndMarker(epoch=1, count=self.sender.count)
        for relay in self.relays:
            self._put_end(relay, marker)
        self.sender.note_end(marker, self.scene.now)

    def _settle(self) -> None:
        before = {name: line[0].owed[self.sender] for name, line in self.held.lines.items()}
        for done in self.held.settle(self.scene.now):
            relay, receiver = self._relay(done.name[1]), self.sender.receivers.get(done.name[1])
            owed = before[done.name]
            if relay is not None and receiver is not None and _near(relay.acks.arrived((KEY, *WORKER)), owed) < owed:
                raise HopError(f"an input of {relay.name} is done before its answer {owed - 1} has come")

    def _said(self, name: str, _session: str, frame: StreamAcks) -> None:
        relay = self._relay(name)
        if relay is not None:
            relay.way.carry("in", partial(self._hear, relay, frame.acks))

    def _hear(self, relay: Relay, acks: Iterable[StreamAck]) -> None:
        for ack in acks:
            self.sender.hear(relay.name, relay.node, ack, self.scene.now)
            self._put_owed()
        self._settle()

    # --- the relays --------------------------------------------------------------------------------------------------

    def _arrive(self, relay: Relay, frame: Sample, *, is_again: bool) -> None:
        def take() -> None:
            name = (KEY, *WORKER)
            if is_again:
                ready: tuple[Any, ...] = tuple(one for _, one in relay.answers.take_again(KEY, frame))
            else:
                ready = relay.answers.take(name, cast("Any", frame).source_info.source_sn, frame)
            self._pass(relay, ready)

        relay.hear(take)

    def _put_end(self, relay: Relay, marker: EndMarker) -> None:
        def take() -> None:
            if relay.key.take_end(marker, WORKER, self.scene.now):
                relay.key.ender = (KEY, *WORKER)
                relay.answers.ended(relay.key.ender)

        relay.way.carry("out", lambda: relay.hear(take))

    def _pass(self, relay: Relay, ready: Iterable[Any]) -> None:
        for one in ready:
            serial = one.source_info.source_sn
            if relay.begins_at is None:
                relay.begins_at = relay.answers.first_of((KEY, *WORKER))
                relay.begins_at = serial if relay.begins_at is None else relay.begins_at
            if not relay.key.take(WORKER, serial, relay.answers, relay.counter):
                raise HopError(f"{relay.name} passes {serial} behind {relay.passed[-1:]}")
            relay.passed.append(relay.key.last_number)

    def care(self) -> None:
        """The relays' threads, now and then."""
        for relay in self.relays:
            if relay.is_running:
                self._pass(relay, [one for _, one in relay.answers.overdue()])
                relay.key.is_ended(self.scene.now, relay.answers)

    def acknowledge(self) -> None:
        """The acknowledgers' threads."""
        for relay in self.relays:
            if relay.is_running:
                relay.acks.look_at_gaps()
                relay.acks.flush()

    # --- a run -------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Faults, then rest.

        Raises:
            HopError: what must hold does not.
        """
        scene = self.scene
        scene.often(self.put)
        for fault in (self._cut, self._drop, self._freeze, self._restart):
            scene.some(fault)
        scene.every(TICK_S, self.look_after)
        scene.every(CARE_S, self.care)
        scene.every(ACK_S, self.acknowledge)
        if scene.rng.random() < 0.5:
            scene.after(FAULTS_END_S + 2 * FORGET_S, self.end)
        scene.run()
        for relay in self.relays:
            self._check(relay)
        if self.sender.next_deadline(scene.now) is not None or self.held.lines:
            kept, waiting = len(self.sender.kept), len(self.held.lines)
            raise HopError(f"{kept} are kept and inputs of {waiting} sources wait long after the last fault")

    def _check(self, relay: Relay) -> None:
        passed = relay.passed
        count = _near(self.sender.count, relay.key.last_number)
        if any(after <= before for before, after in pairwise(passed)):
            raise HopError(f"{relay.name} passed what is older, or the same twice")
        if passed and passed[-1] != count - 1:
            raise HopError(f"the last answer is {count - 1}, the last one of {relay.name} {passed[-1:]}")
        told = relay.counter.lost + relay.key.missing(relay.answers)
        begins_at = relay.answers.first_of((KEY, *WORKER)) if relay.begins_at is None else relay.begins_at
        missing = 0 if begins_at is None else max(0, count - begins_at - len(passed))
        is_told = relay.begins_at is not None or (self.is_whole and relay.key.end is not None)
        if is_told and told != missing:  # a relay that has heard nothing cannot know what there was
            raise HopError(f"{relay.name} lacks {missing} answers, but {told} are told as lost")
        is_calm = self.lives == len(self.relays) and not any(one.way.cuts for one in self.relays)
        if self.is_whole and is_calm and self.sender.limit == OUTPUT_DEPTH and told:
            raise HopError(f"{relay.name} lacks {told} answers, though nobody died and no link was down")
