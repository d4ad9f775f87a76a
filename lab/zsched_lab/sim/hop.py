"""One numbered hop on a bad way: the real sender and the real receiver, everything between them simulated, by seed.

``python -m zsched_lab.sim.hop --seed S --runs N`` plays class ``reliable``: samples, start markers, acknowledgements
and what is put again, while links break and take with them what is on them, and the receiver freezes, or dies and
begins another life. Knows: what the relay's threads do with the state (`zsched.relay.streams.outlet`), what must hold.
Does not know: how the numbers work (`zsched.core.hop`).

What must hold: nothing is processed twice in one life; nothing is lost while the receiver lives; and when the faults
are over, everything that was sent is processed, or told as lost or left open.
"""

from __future__ import annotations

import argparse
import heapq
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Final

from zsched.core.hop.receiver import RunningTime, Source
from zsched.core.hop.sender import Sender
from zsched.core.hop.serial import SPAN, serial_of
from zsched.core.relay_protocol import StreamAck
from zsched.hop.acknowledger import ACK_S
from zsched.relay.streams.tally import Tally
from zsched.relay.task import CARE_S

FAULTS_END_S: Final = 12.0
REST_S: Final = 60.0
"""Longer than any pause between two tries."""
SIZE: Final = 100


class HopError(AssertionError):
    """What must hold does not."""


@dataclass(slots=True)
class Life:
    """One life of the receiver."""

    name: str
    source: Source | None = None
    time: RunningTime = field(default_factory=RunningTime)
    frozen_until: float = 0.0
    waiting: list[Callable[[], None]] = field(default_factory=list)
    processed: set[int] = field(default_factory=set)
    is_changed: bool = False


@dataclass(slots=True)
class Hop:
    """A sender, the present life of its receiver and the way between them."""

    seed: int
    rng: Random = field(init=False)
    now: float = 0.0
    sender: Sender = field(init=False)
    life: Life = field(init=False)
    tally: Tally = field(default_factory=Tally)
    queue: list[int] = field(default_factory=list)
    """Taken, and not sent yet."""
    taken: int = 0
    lives: int = 0
    link: int = 0
    """Its number: what was put on an earlier one is gone."""
    is_linked: bool = True
    is_late_to_see: bool = False
    """The sender does not know yet that the link is broken."""
    clear_at: dict[str, float] = field(default_factory=dict)
    """{direction: when its newest frame arrives}: a link keeps the order."""
    events: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    order: int = 0
    processed: set[int] = field(default_factory=set)
    """By any life."""

    def __post_init__(self) -> None:
        self.rng = Random(self.seed)
        first = self.rng.choice((0, 0, SPAN - 40))
        self.sender = Sender(is_whole=True, count=first, base=first)
        self.life = self._new_life()

    # --- the way -----------------------------------------------------------------------------------------------------

    def after(self, delay_s: float, what: Callable[[], None]) -> None:
        """Do something later."""
        self.order += 1
        heapq.heappush(self.events, (self.now + delay_s, self.order, what))

    def carry(self, direction: str, what: Callable[[], None]) -> None:
        """Put a frame on the link: it arrives in order, or the link breaks before."""
        if not self.is_linked:
            return
        link = self.link
        at = max(self.clear_at.get(direction, 0.0), self.now + self.rng.uniform(0.0005, 0.02))
        self.clear_at[direction] = at
        self.after(at - self.now, lambda: what() if link == self.link else None)

    def cut(self) -> None:
        """The link breaks; the sender sees it later, or only that it is back."""
        self.link += 1
        self.is_linked, self.is_late_to_see = False, True
        self.clear_at.clear()
        self.after(self.rng.uniform(0.0, 1.0), self._see)
        self.after(10 ** self.rng.uniform(-2.0, 0.5), self._mend)

    def _see(self) -> None:
        self.is_late_to_see = False
        if not self.is_linked:
            self.sender.part(self.now)

    def _mend(self) -> None:
        self.is_linked, self.is_late_to_see = True, False
        self.sender.part(self.now)

    def drop(self) -> None:
        """What is on the link is gone, and the link is there again before anybody has seen that."""
        self.link += 1
        self.clear_at.clear()

    def restart(self) -> None:
        """The receiver dies and another life of it begins."""
        self.link += 1
        self.clear_at.clear()
        self.life = self._new_life()
        self.sender.part(self.now)

    def _new_life(self) -> Life:
        self.lives += 1
        return Life(name=str(self.lives))

    # --- the sender, as the relay's threads treat it ------------------------------------------------------------------

    def offer(self) -> None:
        """An application puts a sample."""
        self.queue.append(self.taken)
        self.taken += 1
        self.work()

    def work(self) -> None:
        """Send what may be sent: the queue's thread."""
        sender = self.sender
        if not (self.is_linked or self.is_late_to_see):
            return
        if not sender.is_met:
            self._greet()
            return
        self._resend()
        while self.queue and not sender.is_full():
            self.queue.pop(0)
            self.carry("out", partial(self._arrive, sender.count))
            sender.note_put(None, None, SIZE, at=self.now)

    def _greet(self) -> None:
        lowest = self.sender.take_greeting(self.now)
        if lowest is not None:
            self._put_start(lowest)

    def _put_start(self, lowest: int) -> None:
        self.carry("out", lambda: self._start(lowest))

    def _resend(self) -> None:
        owed = self.sender.take_owed()
        for lowest in (owed.start, owed.skip):
            if lowest is not None:
                self._put_start(lowest)
        for sent in owed.again:
            self.carry("out", partial(self._arrive, sent.number))
        if owed.again or owed.skip is not None:
            self.sender.resent(self.now)

    def look_after(self) -> None:
        """Now and then: put again what is late."""
        self.sender.look_after(self.now)
        self.work()

    def _acknowledged(self, ack: StreamAck, life: str) -> None:
        if life != self.life.name:
            return  # its token is gone
        ended = self.sender.hear(ack, life, self.now)
        if ended is not None:
            self.tally.take(ended)
        self.work()

    # --- the receiver, as the worker treats it -----------------------------------------------------------------------

    def _hear(self, what: Callable[[], None]) -> None:
        if self.now < self.life.frozen_until:
            self.life.waiting.append(what)
        else:
            what()

    def thaw(self, life: Life) -> None:
        """The receiver runs on: what waited comes at once."""
        waiting, life.waiting = life.waiting, []
        for what in waiting if life is self.life else ():
            what()

    def _start(self, lowest: int) -> None:
        def take() -> None:
            life = self.life
            if life.source is None:
                life.source = Source.at(lowest)
            life.source.skip(lowest)
            life.source.note_start(lowest, is_whole=True, replayed=0)
            life.is_changed = True

        self._hear(take)

    def _arrive(self, number: int) -> None:
        def take() -> None:
            life = self.life
            life.is_changed = True
            if life.source is None:
                life.source = Source.at(0)
            whole = life.source.number(serial_of(number))
            if not life.source.admit(whole, life.time.at(self.now), in_turn=True):
                return
            if whole != number:
                raise HopError(f"number {number} is taken for {whole}")
            if number in life.processed:
                raise HopError(f"number {number} is processed twice in life {life.name}")
            life.processed.add(number)
            self.processed.add(number)
            life.source.done(whole)

        self._hear(take)

    def acknowledge(self) -> None:
        """The acknowledger's thread."""
        life = self.life
        if self.now < life.frozen_until:
            return
        life.time.at(self.now)
        if life.is_changed and life.source is not None:
            life.is_changed = False
            ack = life.source.ack(1)
            self.carry("in", lambda: self._acknowledged(ack, life.name))

    # --- a run -------------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Faults, then rest.

        Raises:
            HopError: what must hold does not.
        """
        self._every(CARE_S, self.look_after)
        self._every(ACK_S, self.acknowledge)
        at, rate_hz = 0.0, self.rng.choice((2.0, 50.0, 300.0))
        while at < FAULTS_END_S:
            at += self.rng.expovariate(rate_hz)
            self.after(at, self.offer)
        for fault in (self.cut, self.drop, self.freeze, self.restart):
            for _ in range(self.rng.randrange(4)):
                self.after(self.rng.uniform(0.0, FAULTS_END_S), fault)
        while self.events and self.events[0][0] <= FAULTS_END_S + REST_S:
            self.now, _, what = heapq.heappop(self.events)
            what()
        self._check()

    def freeze(self) -> None:
        """The receiver stands still for a while."""
        life, length_s = self.life, 10 ** self.rng.uniform(-1.0, 0.8)
        life.frozen_until = max(life.frozen_until, self.now + length_s)
        self.after(life.frozen_until - self.now, lambda: self.thaw(life))

    def _every(self, period_s: float, what: Callable[[], None]) -> None:
        def again() -> None:
            what()
            self.after(period_s, again)

        again()

    def _check(self) -> None:
        sender = self.sender
        total = self.tally.plus([sender])
        if self.queue or sender.in_flight:
            raise HopError(f"{len(self.queue)} wait and {sender.in_flight} are under way long after the last fault")
        known = total.acknowledged + total.lost + total.at_most_lost
        if known != self.taken:
            raise HopError(f"{self.taken} taken, but {known} told: {total}")
        if self.lives == 1 and (total.lost or total.at_most_lost):
            raise HopError(f"{total.lost} lost and {total.at_most_lost} left open, though nobody died")
        missing = self.taken - len(self.processed)
        if missing > total.lost + total.at_most_lost:
            raise HopError(f"{missing} never processed, {total.lost} lost and {total.at_most_lost} left open are told")


def play(seed: int) -> str:
    """Play one seed; what does not hold, or nothing."""
    try:
        Hop(seed).run()
    except HopError as error:
        return str(error)
    return ""


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.hop", description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=1000)
    options = parser.parse_args(arguments)
    found = 0
    for seed in range(options.seed, options.seed + options.runs):
        fault = play(seed)
        if fault:
            found += 1
            print(f"seed {seed}: {fault}")
    print(f"{options.runs} runs, {found} violations")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
