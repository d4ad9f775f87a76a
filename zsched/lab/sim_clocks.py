"""Faults of a simulated machine's clock that its own watch sees: a time service slews it, or the machine has slept.

Knows: what the watch reports meanwhile and afterwards. Does not know: what a node makes of it (`zsched.core.clocks`).

Decisions go by a clock that nothing slews (`zsched.clock`), so a slew changes no time here: it is only reported.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from zsched.core import events as ev
from zsched.core.clocks import DOUBT_S
from zsched.core.fleet import Fleet
from zsched.core.model import NodeId

LOOK_S = 0.2
"""The watch compares the clocks so often."""
SLEWS = (-0.083, -0.002, 0.0011, 0.083)
SHARE = 0.2


def clock_faults(rng: Random, fleet: Fleet, until: float) -> list[tuple[float, NodeId, float, float]]:
    """(at, node, seconds, size) of one or two slews, in every fifth schedule of a fleet with exclusive tasks."""
    names = [node.name for node in fleet.nodes]
    if not any(task.exclusive for task in fleet.tasks) or rng.random() > SHARE:
        return []
    return [
        (rng.uniform(0.0, until), rng.choice(names), rng.uniform(0.1, 5.0), rng.choice(SLEWS))
        for _ in range(rng.randint(1, 2))
    ]


def slew(
    size: float,
    seconds: float,
    *,
    tell: Callable[[ev.Event], None],
    later: Callable[[float, Callable[[], None]], None],
    is_over: Callable[[], bool],
    is_believed: Callable[[], bool] = lambda: True,
) -> None:
    """Report a slew for some seconds, or until the faults are over, and then that all is well until it is believed.

    That may take longer than `DOUBT_S`: a machine that stood still hears it all at once when it goes on.
    """
    left = DOUBT_S + 2 * LOOK_S

    def look(elapsed_s: float, well_s: float) -> None:
        is_bad = well_s == 0.0 and elapsed_s < seconds and not is_over()
        tell(ev.ClockCompared(error_ratio=size if is_bad else 0.0, since_s=LOOK_S))
        if well_s < left or not is_believed():
            later(LOOK_S, lambda: look(elapsed_s + LOOK_S, 0.0 if is_bad else well_s + LOOK_S))

    look(0.0, 0.0)
