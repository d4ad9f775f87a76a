"""Decides which command a worker's `driver:` stands for: each is a program of zsched's that keeps an engine's worker.

Knows: the keys of each driver, the words of each program (`zsched.drivers`). Does not know: what the programs do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final

from zsched.config.blocks import Choice, Field, Here, Located, Section, Text
from zsched.config.reader import Collector


class Driver(StrEnum):
    """What keeps the worker's process."""

    PROCESS = "process"
    SYSTEMD = "systemd"


_UNIT: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9:_.\\-]{0,200}(@[A-Za-z0-9:_.\\-]*)?\.service")
_OWN: Final[Mapping[Driver, tuple[str, ...]]] = {
    Driver.PROCESS: ("command",),
    Driver.SYSTEMD: ("unit",),
}
"""The keys of each driver, the first one needed (but that of a process: somebody else may start it)."""


def _unit_fault(text: str) -> str | None:
    if _UNIT.fullmatch(text) is not None:
        return None
    return "NAME.service, or NAME@.service of a template"


DRIVER_KEYS: Final = {
    "driver": Field(
        Choice.of(Driver),
        "What keeps the worker: `process`: its `command`; `systemd`: a `unit` of each machine.",
        default=f"`{Driver.PROCESS}`",
    ),
    "unit": Field(
        Here(Text("a systemd service", _unit_fault)),
        "Driver `systemd`: the unit. Of a template, `NAME@.service`, the instance is NODE-TASK.",
    ),
}


def command_of(section: Section, out: Collector) -> tuple[str, ...] | None:
    """The command that the worker's driver stands for; ``None``: the driver is a process, or has a fault."""
    driver: Driver = section.get("driver", Driver.PROCESS)
    for other, own in _OWN.items():
        for name in own if other is not driver else ():
            if name in section.places and name not in _OWN[driver]:
                hint = f"delete it, or say driver: {other}"
                out.error(section.where(name), f"driver {driver} has no {name!r}", hint)
                return None
    if driver is Driver.PROCESS:
        return None
    needed = _OWN[driver][0]
    if needed not in section.places:
        out.error(section.where("driver"), f"driver {driver} needs the key {needed!r}", f"{needed}: ...")
        return None
    if not section.is_whole:
        return None
    program = ("python", "-m", f"zsched.drivers.{driver}")
    return (*program, *_WORDS[driver](section), *(word for name in section.get("env", {}) for word in ("--env", name)))


def _systemd_words(section: Section) -> tuple[str, ...]:
    unit: Located[str] = section.get("unit")
    return ("--unit", unit.value)


_WORDS: Final[Mapping[Driver, Callable[[Section], tuple[str, ...]]]] = {Driver.SYSTEMD: _systemd_words}
