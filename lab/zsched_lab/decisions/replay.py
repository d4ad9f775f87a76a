"""Plays a history to many rules at once, in steps of 0.1 s.

Knows: when which robot has a round. Does not know: what a rule does in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random

from zsched.core.values.fleet import Fleet
from zsched.core.values.model import Weights
from zsched_lab.decisions.rules import Move, Rule
from zsched_lab.decisions.view import START_S, Feed, Look, Sight, View
from zsched_lab.decisions.world import DT_S, World, weighing

TICKS = 2
"""Per step: robots' rounds come between the readings, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One rule in a comparison: how it looks at the fleet, and how it is made for a view."""

    name: str
    make: Callable[[Sight], Rule]
    look: Look = Look()
    weights: Weights | None = None
    """``None``: the task's own."""


def replay(world: World, entries: tuple[Entry, ...], seed: int = 0) -> Mapping[str, list[Move]]:
    """{entry: its moves}, after one pass over the history."""
    feeds = {look: Feed(world, look) for look in dict.fromkeys(entry.look for entry in entries)}
    views: dict[tuple[Look, Weights | None], View] = {}
    rules: dict[str, Rule] = {}
    for entry in entries:
        key = (entry.look, entry.weights)
        if key not in views:
            views[key] = View(weighing(world, entry.weights), feeds[entry.look])
        rules[entry.name] = entry.make(views[key])
    due = rounds(world.fleet, world.steps, seed)
    for tick in range(world.steps * TICKS):
        if tick % TICKS == 0:
            for feed in feeds.values():
                feed.step(tick // TICKS)
        at_s = tick * DT_S / TICKS
        now, seats = START_S + at_s, due[tick]
        for rule in rules.values():
            rule.round(seats, at_s, now)
    return {name: rule.moves for name, rule in rules.items()}


def rounds(fleet: Fleet, steps: int, seed: int) -> list[tuple[int, ...]]:
    """Which robots have a round at each tick: every ``decide_s``, jittered as `Rounds` does, not synchronised."""
    rng, period_s = Random(seed), fleet.timing.decide_s
    ticks = steps * TICKS
    out: list[list[int]] = [[] for _ in range(ticks)]
    for seat in range(len(fleet.voters)):
        at_s = rng.random() * period_s
        while (tick := round(at_s * TICKS / DT_S)) < ticks:
            out[tick].append(seat)
            at_s += period_s * (0.9 + 0.2 * rng.random())
    return [tuple(seats) for seats in out]
