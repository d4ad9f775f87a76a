"""One input's hop: a relay's sender towards a worker, class ``reliable`` or ``latest``.

Knows: what the relay's threads do with the sender (`zsched.relay.streams.outlet`), and the worker's with the receiver
(`zsched.worker.inputs`); what must hold. Does not know: how the numbers work (`zsched.core.hop`).

What must hold of both classes: nothing is processed twice in one life; every sample is in exactly one counter, at any
time; what was never processed is counted as lost, left open or overtaken in the queue. ``reliable``: while the receiver
lives, nothing is lost. ``latest``: nothing older is taken behind something newer; once the links stay whole, the newest
value is there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Final

from zsched.core.hop.books import unaccounted
from zsched.core.hop.receiver import RunningTime, Source
from zsched.core.hop.sender import KEPT_BYTES_LATEST, Sender
from zsched.core.hop.serial import SPAN, serial_of
from zsched.core.values.plan import StreamCount
from zsched.core.values.relay_protocol import StreamAck
from zsched.link.acknowledger import ACK_S
from zsched.relay.streams.tally import Tally
from zsched.relay.task import CARE_S
from zsched_lab.sim.hop.way import SIZE, HopError, Process, Scene, Way

WINDOW: Final = 32
"""Frames that a link to a frozen receiver takes; then a put waits."""


@dataclass(slots=True, kw_only=True)
class Life(Process):
    """One life of the receiver."""

    name: str
    source: Source | None = None
    time: RunningTime = field(default_factory=RunningTime)
    processed: set[int] = field(default_factory=set)
    newest: int = -1
    """The highest number that it has taken."""
    pending: list[int] = field(default_factory=list)
    """Class ``latest``: what has come and is not processed; a newer one takes its place."""
    is_changed: bool = False


@dataclass(slots=True)
class InputHop:
    """A sender, the present life of its receiver and the way between them."""

    seed: int
    is_whole: bool
    scene: Scene = field(init=False)
    way: Way = field(init=False)
    sender: Sender = field(init=False)
    life: Life = field(init=False)
    tally: Tally = field(default_factory=Tally)
    queue: int = 0
    """Samples that are taken, and not sent yet."""
    depth: int = 1
    keep_last: int = 1
    taken: int = 0
    repeated: int = 0
    overflow: int = 0
    lives: int = 0
    processed: set[int] = field(default_factory=set)
    """By any life."""

    def __post_init__(self) -> None:
        rng = Random(self.seed)
        self.scene = Scene(rng)
        self.way = Way(self.scene, self._way_is_seen)
        first = rng.choice((0, 0, SPAN - 40))
        self.sender = Sender(is_whole=self.is_whole, count=first, base=first)
        if not self.is_whole:
            self.keep_last = rng.choice((1, 1, 4))
            self.depth = self.sender.kept_samples = max(self.keep_last, rng.choice((1, 16)))
            self.sender.kept_least, self.sender.kept_limit = self.keep_last, KEPT_BYTES_LATEST
        self.life = self._new_life()

    def _new_life(self) -> Life:
        self.lives += 1
        return Life(scene=self.scene, name=str(self.lives))

    def _way_is_seen(self) -> None:
        self.sender.part(self.scene.now)

    def _freeze(self) -> None:
        self.life.freeze()

    def restart(self) -> None:
        """The receiver dies and another life of it begins; of class ``latest`` it is given the newest value."""
        self.way.drop()
        self.life.is_dead = True
        self.life = self._new_life()
        if self.is_whole:
            self.sender.part(self.scene.now)
        elif self.taken:
            self.repeated += 1
            self._offer()

    # --- the sender, as the relay's threads treat it ------------------------------------------------------------------

    def take(self) -> None:
        """An application puts a sample."""
        self.taken += 1
        self._offer()

    def _offer(self) -> None:
        self.queue += 1
        self.work()
        limit = self.depth if not self._is_blocked else self.keep_last
        if not self.is_whole and self.queue > limit:
            self.overflow += self.queue - limit
            self.queue = limit

    @property
    def _is_blocked(self) -> bool:
        return len(self.life.waiting) >= WINDOW

    def work(self) -> None:
        """Send what may be sent: the queue's thread."""
        sender = self.sender
        if self._is_blocked:
            return
        if self.is_whole:
            if not self.way.is_seen:
                return
            if not sender.is_met:
                lowest = sender.take_greeting(self.scene.now)
                if lowest is not None:
                    self._put_start(lowest)
                return
        self._put_owed()
        while self.queue and not (self.is_whole and sender.is_full()) and not self._is_blocked:
            self.queue -= 1
            self.way.carry("out", partial(self._arrive, sender.count))
            sender.note_put(None, None, SIZE, at=self.scene.now)

    def _put_start(self, lowest: int) -> None:
        self.way.carry("out", lambda: self._start(lowest))

    def _put_owed(self) -> None:
        owed = self.sender.take_owed()
        for lowest in (owed.start, owed.skip):
            if lowest is not None:
                self._put_start(lowest)
        for sent in owed.again:
            self.way.carry("out", partial(self._arrive, sent.number))
        if owed.again or owed.skip is not None:
            self.sender.resent(self.scene.now)

    def look_after(self) -> None:
        """Now and then: put again what is late."""
        if self.way.is_seen and not self._is_blocked:
            self.sender.look_after(self.scene.now)
        self.work()

    def _acknowledged(self, ack: StreamAck, life: str) -> None:
        if life != self.life.name:
            return  # its token is gone
        ended = self.sender.hear(ack, life, self.scene.now)
        if ended is not None:
            self.tally.take(ended)
        self._check_books()
        self.work()

    # --- the receiver, as the worker treats it -----------------------------------------------------------------------

    def _start(self, lowest: int) -> None:
        def take() -> None:
            source = life.source = life.source or Source.at(lowest)
            source.skip(lowest)
            source.note_start(lowest, is_whole=self.is_whole, replayed=0)
            life.is_changed = True

        life = self.life
        life.hear(take)

    def _arrive(self, number: int) -> None:
        def take() -> None:
            life.is_changed = True
            source = life.source = life.source or Source.at(0 if self.is_whole else serial_of(number))
            whole = source.number(serial_of(number))
            if source.admit(whole, life.time.at(self.scene.now), in_turn=self.is_whole):
                self._admitted(life, source, number, whole)

        life = self.life
        life.hear(take)

    def _admitted(self, life: Life, source: Source, number: int, whole: int) -> None:
        if self.is_whole and whole != number:
            raise HopError(f"number {number} is taken for {whole}")
        if number in life.processed:
            raise HopError(f"number {number} is processed twice in life {life.name}")
        if number < life.newest:
            raise HopError(f"number {number} comes behind {life.newest} in life {life.name}")
        life.newest = number
        life.processed.add(number)
        self.processed.add(number)
        life.pending.append(whole)
        if len(life.pending) == 1:
            self.scene.after(self.scene.rng.uniform(0.0, 0.02), partial(self._done, life, source))

    def _done(self, life: Life, source: Source) -> None:
        """A callback has returned: of class ``latest`` the newest counts, the others gave way to it."""

        def take() -> None:
            done = life.pending if self.is_whole else life.pending[-1:]
            life.pending, life.is_changed = [], True
            for number in done:
                source.done(number)

        life.hear(take)

    def acknowledge(self) -> None:
        """The acknowledger's thread."""
        life = self.life
        if not life.is_running:
            return
        life.time.at(self.scene.now)
        if life.is_changed and life.source is not None:
            life.is_changed = False
            ack = life.source.ack(1)
            self.way.carry("in", lambda: self._acknowledged(ack, life.name))

    # --- a run -------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Faults, then rest.

        Raises:
            HopError: what must hold does not.
        """
        self.scene.every(CARE_S, self.look_after)
        self.scene.every(ACK_S, self.acknowledge)
        self.scene.often(self.take)
        for fault in (self.way.cut, self.way.drop, self._freeze, self.restart):
            self.scene.some(fault)
        self.scene.run()
        self._check()

    def _check_books(self) -> StreamCount:
        total = self.tally.plus([self.sender])
        count = StreamCount(
            stream="t/in/0",
            messages=self.taken,
            repeated=self.repeated,
            acknowledged=total.acknowledged,
            lost=total.lost,
            at_most_lost=total.at_most_lost,
            in_flight=total.in_flight + self.queue,
            drops=(("overflow", self.overflow),),
        )
        if unaccounted(count):
            raise HopError(f"{unaccounted(count)} samples are in no counter, or (below 0) in two: {count}")
        return count

    def _check(self) -> None:
        count = self._check_books()
        lost = count.lost + count.at_most_lost
        if count.in_flight:
            raise HopError(f"{count.in_flight} are under way long after the last fault")
        if self.is_whole and self.lives == 1 and lost:
            raise HopError(f"{count.lost} lost and {count.at_most_lost} left open, though nobody died")
        if not self.is_whole and self.taken and self.life.newest != self.sender.count - 1:
            raise HopError(f"the newest value is {self.sender.count - 1}, the receiver's {self.life.newest}")
        missing = self.taken + self.repeated - self.overflow - len(self.processed)
        if missing > lost:
            raise HopError(f"{missing} never processed, {count.lost} lost and {count.at_most_lost} left open are told")
