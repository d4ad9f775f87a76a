"""The ways between simulated machines: delays, losses, cuts, and links that hold back and then deliver all at once.

Knows: which machine reaches which, and when (a twin has links of its own). Does not know: what is said, what a
hostile network makes of a frame (`zsched_lab.sim.network`), how a loop takes an event (`zsched_lab.sim.loops`).

A link that holds back keeps its order, as TCP does: what it has taken arrives, later, and nothing overtakes it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from random import Random

from zsched.core.values import events as ev
from zsched.core.values.model import NodeId
from zsched_lab.sim.loops import Loops
from zsched_lab.sim.network import Message, Weather
from zsched_lab.sim.parts import Machine

SELF_DELAY_S = 0.0001
Pair = tuple[str, str]
"""(from, to), by the machines' keys."""


@dataclass(slots=True, kw_only=True)
class Held:
    """One direction of a link that holds messages back; they arrive in the order in which they were sent."""

    until: float = -math.inf
    """A stall: nothing arrives before."""
    every_s: float = 0.0
    """Bursts: what was sent arrives together, so often (0: as it comes)."""
    last: float = -math.inf
    """When the newest message that it has taken arrives."""

    def arrival(self, now: float, delay_s: float) -> float:
        """When a message arrives that leaves now and would take ``delay_s``."""
        at = max(now + delay_s, self.until, self.last)
        if self.every_s > 0.0 and at > self.last:
            at = max(math.ceil(at / self.every_s) * self.every_s, at)
        self.last = at
        return at


@dataclass(slots=True, kw_only=True)
class Links(Loops):
    """All links of one simulated fleet, on its queue of events."""

    loss: float = 0.0
    delay_s: tuple[float, float] = (0.0005, 0.003)
    cuts: set[Pair] = field(default_factory=set)
    """Pairs that deliver nothing."""
    data_cuts: set[Pair] = field(default_factory=set)
    """Pairs whose streams are dead while their control messages pass."""
    held: dict[Pair, Held] = field(default_factory=dict)
    """Links that hold back, and those that have not caught up yet."""
    weather: Weather = field(default_factory=Weather)
    machines: dict[str, Machine] = field(default_factory=dict)
    """{key: machine}; a twin has a key of its own."""
    rng: Random = field(init=False)

    def cut(self, *sides: tuple[NodeId, ...]) -> None:
        """Nothing passes between the groups any more, in either direction; groups inside stay connected."""
        for one, other in itertools.permutations(sides, 2):
            self.cuts.update(itertools.product(one, other))

    @property
    def behind_s(self) -> float:
        """How long it takes until links that were held have delivered what they had taken by now."""
        return max([0.0, *(link.last - self.now for link in self.held.values())])

    def heal(self) -> None:
        """Everything passes again, behind what links hold back already."""
        self.cuts.clear()
        self.data_cuts.clear()
        for link in self.held.values():
            link.until, link.every_s = -math.inf, 0.0

    def hold(self, pairs: set[Pair], *, until: float = -math.inf, every_s: float = 0.0) -> None:
        """From now on these links hold back until a time, or deliver in bursts."""
        for pair in sorted(pairs):
            link = self.held.setdefault(pair, Held())
            link.until, link.every_s = max(link.until, until), every_s

    def has_streams(self, source: Machine, target: Machine) -> bool:
        """Whether the data session of one machine reaches the other's."""
        pair = (source.key, target.key)
        return pair not in self.cuts and pair not in self.data_cuts

    def named(self, name: NodeId) -> list[Machine]:
        """Every machine that calls itself so (one, unless it has a twin)."""
        return [machine for machine in self.machines.values() if machine.name == name]

    def send(self, source: Machine, target: Machine, message: Message) -> None:
        """One message on its way: maybe lost, cut or late; in bad weather worse."""
        if source is target:
            self.later(SELF_DELAY_S, self.deliver, target, message.event)
            return
        pair = (source.key, target.key)
        if pair in self.cuts or (self.loss and self.rng.random() < self.loss):
            return
        low, high = self.delay_s
        if self.weather.is_calm:
            self._travel(pair, target, low + (high - low) * self.rng.random(), message.event)
            return
        for sender, receiver, extra_s, event in self.weather.through(*pair, message, self.rng):
            machine = self.machines.get(receiver)
            if machine is not None:  # an old message may be for a twin that has left
                delay_s = low + (high - low) * self.rng.random() + extra_s
                self._travel((sender, receiver), machine, delay_s, event)

    def spread(self, source: Machine, message: Message) -> None:
        """One message to all others; in calm weather four of five travel like this."""
        if not self.weather.is_calm:
            for other in self.machines.values():
                if other is not source:
                    self.send(source, other, message)
            return
        (low, high), loss, chance = self.delay_s, self.loss, self.rng.random
        event, key = message.event, source.key
        for other in self.machines.values():
            pair = (key, other.key)
            if other is source or pair in self.cuts or (loss and chance() < loss):
                continue
            self._travel(pair, other, low + (high - low) * chance(), event)

    def _travel(self, pair: Pair, target: Machine, delay_s: float, event: ev.Event) -> None:
        if self.held:
            link = self.held.get(pair)
            if link is not None:
                self.at(link.arrival(self.now, delay_s), self._arrive, pair, target, event)
                return
        self.later(delay_s, self._arrive, pair, target, event)

    def _arrive(self, pair: Pair, target: Machine, event: ev.Event) -> None:
        if pair not in self.cuts:
            self.deliver(target, event)
