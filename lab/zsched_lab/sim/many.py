"""Fleets with so many exclusive tasks, and such long names, that a beat has no room for all it has to say.

Knows: which schedules have them. Does not know: how a beat is made to fit (`zsched.core.membership.beat_room`).
"""

from __future__ import annotations

from random import Random
from typing import Final

from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import replace

MOST_NODES: Final = 4
"""They are dear to play: 40 tasks on 4 nodes cost as much as a dozen other schedules."""
SHARE: Final = 0.1
"""Of the schedules of small fleets whose tasks are exclusive: about one of fifty of all."""
COUNTS: Final = (20, 32, 40)
LONGEST: Final = 62
"""Characters of a name: one fewer than it may have, for forgers who name somebody else by one more."""


def with_many_tasks(rng: Random, fleet: Fleet) -> Fleet:
    """The same fleet, in some schedules with many more tasks like the first; all names are long."""
    if len(fleet.nodes) > MOST_NODES or not all(task.exclusive for task in fleet.tasks) or rng.random() > SHARE:
        return fleet

    def long(name: str) -> str:
        return name.ljust(LONGEST, "-")

    candidates = tuple(map(long, fleet.tasks[0].candidates))
    names = [task.name for task in fleet.tasks] + [f"task{number:02}" for number in range(rng.choice(COUNTS))]
    return replace(
        fleet,
        nodes=tuple(replace(node, name=long(node.name)) for node in fleet.nodes),
        electors=tuple(map(long, fleet.electors)),
        tasks=tuple(replace(fleet.tasks[0], name=long(name), candidates=candidates) for name in sorted(names)),
    )
