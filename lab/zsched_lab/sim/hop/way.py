"""The time and the links of a played hop: frames arrive in order or are gone, and processes stand still.

Knows: events in their order, links that break, at once or unseen. Does not know: what is on a link, what must hold.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Final

FAULTS_END_S: Final = 12.0
REST_S: Final = 60.0
"""Longer than any pause between two tries."""
SIZE: Final = 100
"""Bytes of a sample."""

Action = Callable[[], None]


class HopError(AssertionError):
    """What must hold does not."""


@dataclass(slots=True)
class Scene:
    """The clock, and what is to happen."""

    rng: Random
    now: float = 0.0
    events: list[tuple[float, int, Action]] = field(default_factory=list)
    order: int = 0

    def clock(self) -> float:
        """The time (seconds)."""
        return self.now

    def after(self, delay_s: float, what: Action) -> None:
        """Do something later."""
        self.at(self.now + delay_s, what)

    def at(self, time_s: float, what: Action) -> None:
        """Do something at a time; of what has one time, the first comes first."""
        self.order += 1
        heapq.heappush(self.events, (time_s, self.order, what))

    def every(self, period_s: float, what: Action) -> None:
        """Do something again and again."""

        def again() -> None:
            what()
            self.after(period_s, again)

        again()

    def some(self, what: Action, most: int = 3) -> None:
        """Do something at most this many times while there are faults."""
        for _ in range(self.rng.randrange(most + 1)):
            self.after(self.rng.uniform(0.0, FAULTS_END_S), what)

    def often(self, what: Action) -> None:
        """Do something at a random rate while there are faults."""
        at, rate_hz = 0.0, self.rng.choice((2.0, 50.0, 300.0))
        while at < FAULTS_END_S:
            at += self.rng.expovariate(rate_hz)
            self.after(at, what)

    def run(self) -> None:
        """Let everything happen: faults, then rest."""
        while self.events and self.events[0][0] <= FAULTS_END_S + REST_S:
            self.now, _, what = heapq.heappop(self.events)
            what()


@dataclass(slots=True)
class Way:
    """The link between a sender and a receiver."""

    scene: Scene
    seen: Action
    """The sender sees that the link is gone, or there again."""
    link: int = 0
    """Its number: what was put on an earlier one is gone."""
    is_linked: bool = True
    is_late_to_see: bool = False
    """The sender does not know yet that the link is broken."""
    clear_at: dict[str, float] = field(default_factory=dict)
    """{direction: when its newest frame arrives}: a link keeps the order."""
    cuts: int = 0

    @property
    def is_seen(self) -> bool:
        """Whether the sender takes the link for whole."""
        return self.is_linked or self.is_late_to_see

    def carry(self, direction: str, what: Action) -> None:
        """Put a frame on the link: it arrives in order, or the link breaks before."""
        if not self.is_linked:
            return
        scene, link = self.scene, self.link
        at = max(self.clear_at.get(direction, 0.0), scene.now + scene.rng.uniform(0.0005, 0.02))
        self.clear_at[direction] = at
        scene.at(at, lambda: what() if link == self.link else None)

    def cut(self) -> None:
        """The link breaks; the sender sees it later, or only that it is back."""
        self.drop()
        self.cuts += 1
        self.is_linked, self.is_late_to_see = False, True
        self.scene.after(self.scene.rng.uniform(0.0, 1.0), self._see)
        self.scene.after(10 ** self.scene.rng.uniform(-2.0, 0.5), self._mend)

    def drop(self) -> None:
        """What is on the link is gone, and the link is there again before anybody has seen that."""
        self.link += 1
        self.clear_at.clear()

    def _see(self) -> None:
        self.is_late_to_see = False
        if not self.is_linked:
            self.seen()

    def _mend(self) -> None:
        self.is_linked, self.is_late_to_see = True, False
        self.seen()


@dataclass(slots=True, kw_only=True)
class Process:
    """One life of a receiver."""

    scene: Scene
    is_dead: bool = False
    frozen_until: float = 0.0
    waiting: list[Action] = field(default_factory=list)

    @property
    def is_running(self) -> bool:
        """Whether it is alive and not frozen."""
        return not self.is_dead and self.scene.now >= self.frozen_until

    def hear(self, what: Action) -> None:
        """Take a frame, when it runs."""
        if self.is_running:
            what()
        else:
            self.waiting.append(what)

    def freeze(self) -> None:
        """Stand still for a while."""
        length_s = 10 ** self.scene.rng.uniform(-1.0, 0.8)
        self.frozen_until = max(self.frozen_until, self.scene.now + length_s)
        self.scene.at(self.frozen_until, self._thaw)

    def _thaw(self) -> None:
        """It runs on: what waited comes at once."""
        if self.is_running:
            waiting, self.waiting = self.waiting, []
            for what in waiting:
                what()
