"""Faults of a simulated machine's clock that its own watch sees: a time service slews it, or the machine has slept.

Knows: what the watch reports meanwhile and afterwards. Does not know: what a node makes of it
(`zsched.core.vote.clocks`).

Decisions go by a clock that nothing slews (`zsched.host.clock`), so a slew changes no time here: it is only reported.
A machine that has slept knows how long, some to a second only: then its clock is wrong from there on.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.vote.clocks import DOUBT_S
from zsched.host.clock import WINDOW_S, ClockWatch

LOOK_S = 0.2
"""The watch compares the clocks so often."""
SLEWS = (-0.083, -0.002, 0.0011, 0.083)
SHARE = 0.2
SUSPENDED = 0.1
ERRORS_S = (-0.9, -0.1, 0.0, 0.1, 0.9)


def clock_faults(rng: Random, fleet: Fleet, until: float) -> list[tuple[float, NodeId, float, float]]:
    """(at, node, seconds, size) of one or two slews, in every fifth schedule of a fleet with exclusive tasks."""
    names = [node.name for node in fleet.nodes]
    if not any(task.exclusive for task in fleet.tasks) or rng.random() > SHARE:
        return []
    return [
        (rng.uniform(0.0, until), rng.choice(names), rng.uniform(0.1, 5.0), rng.choice(SLEWS))
        for _ in range(rng.randint(1, 2))
    ]


def suspensions(rng: Random, fleet: Fleet, until: float) -> list[tuple[float, NodeId, float, float]]:
    """(at, node, seconds, error of the length in seconds) of one or two suspends, in every tenth schedule.

    Of machines that know its length to a second only, too.
    """
    names = [node.name for node in fleet.nodes]
    if rng.random() > SUSPENDED:
        return []
    return [
        (rng.uniform(0.0, until), rng.choice(names), 10 ** rng.uniform(-1.0, 0.8), rng.choice(ERRORS_S))
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


def awake(
    counted_s: float,
    *,
    tell: Callable[[ev.Event], None],
    later: Callable[[float, Callable[[], None]], None],
    is_believed: Callable[[], bool],
) -> None:
    """Report what the watch finds after the machine has slept, until its clock is believed again.

    The sleep, as long as the machine counts it, is in CLOCK_BOOTTIME only: `ClockWatch` is given the readings from
    before and after it.
    """
    watch, before = ClockWatch(), round(WINDOW_S / LOOK_S)
    for step in range(before):
        watch.judge(step * LOOK_S, 0.0)

    def look(step: int) -> None:
        drift = watch.judge(step * LOOK_S, counted_s)
        assert drift is not None
        tell(ev.ClockCompared(error_ratio=drift.error_ratio, jump_s=drift.jump_s, since_s=drift.since_s))
        if (step - before) * LOOK_S < DOUBT_S + 2 * LOOK_S or not is_believed():
            later(LOOK_S, lambda: look(step + 1))

    look(before)
