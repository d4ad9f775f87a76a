"""Names, ranges and words that values share with who only shows them, or looks whether a name is one.

Knows: the alphabet of names, first words of reasons. Does not know: any value. It loads in no time, so a verb of the
command line that needs no value (`status`, `history`) does without `zsched.core.values.model`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum

GaugeName = str
"""A gauge's name (`zsched.core.values.gauges`), of the alphabet of `NAME`."""
Readings = tuple[tuple[GaugeName, float], ...]
"""One number for each of some gauges; a gauge that is not there was not measured."""

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}")
"""Of a node, a task or a fleet."""
A_NAME = "lower-case letters, digits, '-' and '_', at most 63, the first a letter or a digit"
"""`NAME` in words."""
MAX_ASKER, MAX_ASKED = 96, 200
"""Characters of an operator's name and reason: they travel with every ballot of a task."""
CREATION_STEP = 2**32
"""Revision and epoch of a task that was created as number C start at C times this."""
PAPER_METRICS = ("cpu", "memory", "network")
"""The metrics of Eq. 1 to 3; the others are gauges."""

_INTENDED = frozenset({"cut", "loop", "retried", "superseded", "thinned", "uncounted"})
"""Reasons of drops by which nobody misses a sample: a rule wants them, or the sample came by another way."""

COUNTED_ANEW = "since the relay's start or the stream's last change"
"""A stream keeps its count over both, so a message in it may have come before."""


class Trouble(StrEnum):
    """What is wrong with a worker, for decisions; its reason says it to people."""

    NONE = ""
    RESTS = "rests"  # it is ready, and may not work: it has no lease
    LOST = "lost"  # it was ready and no longer is; its supervisor calls that starting
    AGAIN = "again"  # it has failed and is, or will be, started again


def shown(number: int) -> int:
    """A task's epoch or revision for people, who count from 1 in each creation and generation.

    >>> shown(4294967297), shown(7)
    (1, 7)
    """
    return number % CREATION_STEP


def meant(number: int | None, now: int) -> int:
    """The epoch or revision that people mean by a number, where the present one is ``now``: ``None`` is that one.

    >>> meant(3, 4294967300), meant(4294967298, 4294967300), meant(None, 7)
    (4294967299, 4294967298, 7)
    """
    number = now if number is None else number
    return number if number >= CREATION_STEP else now - shown(now) + number


def told_of_silence(electors: int) -> str:
    """Why a change has no majority: the only elector is this machine, which others' silence does not concern."""
    alone = "this machine is overloaded, or its disk is slow: its own vote came too late"
    return alone if electors == 1 else "no majority of the electors answered"


def told_of_worker(state: str, trouble: str, reason: str) -> str:
    """The state of a worker (`zsched.core.values.profile.WorkerState`) in words, to follow its name."""
    how = reason if trouble == Trouble.AGAIN else f"{state}{': ' if reason else ''}{reason}"
    return reason if trouble == Trouble.LOST else f"is {how}"


def has_lost_its_worker(state: str, trouble: str) -> bool:
    """Whether an owner with such a worker does no work, and will not soon: it failed, stopped, or was ready and is not.

    ``state`` is a `zsched.core.values.profile.WorkerState`. One that starts for the first time is not among them.
    """
    return state in ("failed", "stopped") or (state == "starting" and trouble == Trouble.LOST)


def check_range(field: str, value: float | None, low: float, high: float) -> None:
    """Raise `ValueError` unless ``low <= value <= high`` (``None``, "not measured", passes; NaN does not)."""
    if value is not None and not low <= value <= high:
        raise ValueError(f"{field}: {value!r} is not in [{low:.10g}, {high:.10g}]")


def missed(drops: Iterable[tuple[str, int]], lost: int, at_most_lost: int) -> int:
    """Samples of a stream that somebody may miss: dropped for no rule's sake, lost on the way, or with an owner.

    ``drops``: (reason, how many) of each reason.
    """
    return sum(number for reason, number in drops if reason not in _INTENDED) + lost + at_most_lost
