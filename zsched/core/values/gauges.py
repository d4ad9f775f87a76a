"""The gauges: figures of a machine, beside CPU, memory and links, that a task may weigh or limit.

Knows: each gauge's name, range, worth and limit. Does not know: how one is read (a file of the gauge's name in
`zsched/host/machine/gauges/`).

A new gauge is a row of `GAUGES` and that file. The name is the key in the fleet file (`weights:`, `limits:`), in
profiles and in JSON.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from zsched.core.values.struct import Struct
from zsched.core.values.words import GaugeName, Readings, check_range


class Gauge(Struct, frozen=True, kw_only=True):
    """One figure of a machine."""

    name: GaugeName
    low: float
    high: float
    """A reading outside of [low, high] is a fault of its driver, and counts as none."""
    best: float
    worst: float
    """The readings that are worth 1 and 0; the worth between them is linear."""
    margin: float
    """A node that does not have the task must be so far inside a limit: a reading at the limit moves nothing twice."""
    is_needed: bool
    """Whether a node without a reading cannot have a task that weighs or limits the gauge. Otherwise it counts as the
    best reading."""
    unit: str
    says: str
    """What the reading is."""

    @property
    def is_floor(self) -> bool:
        """Whether a limit is the least allowed reading; otherwise it is the most."""
        return self.best > self.worst

    def term(self, reading: float) -> float:
        """The worth of a reading, in [0, 1]."""
        return min(max((reading - self.worst) / (self.best - self.worst), 0.0), 1.0)

    def shown(self, reading: float) -> str:
        """A reading for people.

        >>> GAUGES[1].shown(0.18), GAUGES[2].shown(85.0)
        ('18 %', '85 °C')
        """
        return f"{reading * 100:.0f} %" if not self.unit else f"{reading:.0f} {self.unit}"

    def back_from(self, limit: float) -> float:
        """The reading from which on a machine beyond the limit may get the task (again), within what it can read."""
        return min(max(limit + (self.margin if self.is_floor else -self.margin), self.low), self.high)

    def is_far_beyond(self, reading: float | None, limit: float) -> bool:
        """Whether a reading is beyond the limit by more than the margin.

        >>> [GAUGES[1].is_far_beyond(reading, 0.2) for reading in (None, 0.3, 0.16, 0.14)]
        [False, False, False, True]
        """
        beyond = 0.0 if reading is None else limit - reading if self.is_floor else reading - limit
        return beyond > self.margin

    def fault(
        self, reading: float | None, limit: float, *, has_margin: bool, is_reckoned: bool = False, is_old: bool = False
    ) -> str:
        """Why a node with this reading may not have a task with this limit; empty: it may.

        Args:
            reading: in the gauge's unit, predicted with the task; ``None``: not measured.
            limit: the task's.
            has_margin: whether it must be inside by the margin; an owner is left at the limit itself.
            is_reckoned: whether the reading has what the task would add.
            is_old: whether it is the last one, of a reader that has failed since.

        >>> battery = GAUGES[1]
        >>> battery.fault(0.18, 0.2, has_margin=False)
        'battery is at 18 %, limit 20 %'
        >>> battery.fault(0.22, 0.2, has_margin=False), battery.fault(0.22, 0.2, has_margin=True)
        ('', 'battery is at 22 %, limit 20 %, back from 25 % on')
        """
        if reading is None:
            return f"{self.name} is not measured" if self.is_needed else ""
        if limit == (self.low if self.is_floor else self.high):
            return ""  # no reading is beyond it: it only asks for the gauge
        sign = 1.0 if self.is_floor else -1.0
        inside = sign * (reading - limit)
        at = f"{'would be' if is_reckoned else 'was last' if is_old else 'is'} at {self.shown(reading)}"
        if inside < 0.0:
            return f"{self.name} {at}, limit {self.shown(limit)}"
        back = self.back_from(limit)
        if not has_margin or sign * (reading - back) >= 0.0:
            return ""
        return f"{self.name} {at}, limit {self.shown(limit)}, back from {self.shown(back)} on"


GAUGES: Final = (
    Gauge(
        name="gpu",
        low=0.0,
        high=1.0,
        best=0.0,
        worst=1.0,
        margin=0.1,
        is_needed=True,
        unit="",
        says="the use of the freest GPU",
    ),
    Gauge(
        name="battery",
        low=0.0,
        high=1.0,
        best=1.0,
        worst=0.0,
        margin=0.05,
        is_needed=False,
        unit="",
        says="the battery's charge",
    ),
    Gauge(
        name="temperature_c",
        low=-60.0,
        high=200.0,
        best=40.0,
        worst=100.0,
        margin=5.0,
        is_needed=False,
        unit="°C",
        says="the temperature of the hottest sensor",
    ),
)
BY_NAME: Final[Mapping[GaugeName, Gauge]] = {gauge.name: gauge for gauge in GAUGES}


def possible(readings: Readings) -> Readings:
    """The readings of gauges that this program knows, in their order, without those that no machine can have.

    >>> possible((("battery", 0.5), ("gpu", 7.0), ("wind", 3.0)))
    (('battery', 0.5),)
    """
    found = dict(readings)
    known = ((gauge, found[gauge.name]) for gauge in GAUGES if gauge.name in found)
    return tuple((gauge.name, reading) for gauge, reading in known if gauge.low <= reading <= gauge.high)


def check_limits(limits: Readings) -> None:
    """Raise `ValueError` unless every limit is of a known gauge and in its range."""
    for name, limit in limits:
        if name not in BY_NAME:
            raise ValueError(f"limits: there is no gauge {name!r}")
        check_range(f"limits.{name}", limit, BY_NAME[name].low, BY_NAME[name].high)
