"""Says what a field may hold, beside the field: its range, and the key of the fleet file that gives it.

As ``beat_s: float = key(0.2, "Period of the heartbeat.", Range(0.01, 3600, "s"))``. The default, the sentence and the
range stand there only: `zsched.config.keys` makes the fleet file's schema of them. Does not know: YAML.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Final, TypeVar

from zsched.core.values.words import check_range

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Range:
    """A number in [low, high]; ``unit`` is for the reader only."""

    low: float
    high: float
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Key:
    """What the fleet file's reference says of a field, and its range if it has one."""

    doc: str
    range: Range | None
    name: str
    """The key, where it is not the field's name."""
    shown: str
    """The default in words, where the field's own is another one or says nothing."""


def key(default: T, doc: str, bounds: Range | None = None, *, name: str = "", shown: str = "") -> T:
    """A field of a dataclass that the fleet file has a key for."""
    return field(default=default, metadata={"key": Key(doc, bounds, name, shown)})


_RANGES: Final[dict[type, list[tuple[str, Range]]]] = {}
"""{class: its fields that have a range}, filled when asked."""


def check_ranges(value: Any, prefix: str = "") -> None:
    """Raise `ValueError` unless every field of a dataclass is in its range (``None``, "not given", passes)."""
    kind = type(value)
    if kind not in _RANGES:
        held: list[tuple[str, Key | None]] = [(one.name, one.metadata.get("key")) for one in fields(value)]
        _RANGES[kind] = [(name, key.range) for name, key in held if key is not None and key.range is not None]
    for name, bounds in _RANGES[kind]:
        given = getattr(value, name)
        if given is not None and not bounds.low <= given <= bounds.high:  # names are put together for an error only
            check_range(f"{prefix}{name}", given, bounds.low, bounds.high)
