"""Makes keys of the fleet file from the fields of the values that hold them.

Knows: which block reads what a field holds, how its default is shown. Does not know: any key (`zsched.config.schema`).
"""

from __future__ import annotations

from dataclasses import fields
from enum import StrEnum
from typing import Any

from zsched.config.blocks import Block, Choice, Field, Flag, Number, Whole, plain_number
from zsched.core.values.limits import Key, Range


def keys(kind: type, *names: str, **blocks: Block[Any]) -> dict[str, Field]:
    """{key: what it takes} of a dataclass's fields that are keys, in their order.

    Args:
        kind: the dataclass.
        names: these fields only; none given: all.
        blocks: by field, what reads it where its default does not tell.
    """
    found = {}
    for one in fields(kind):
        key: Key | None = one.metadata.get("key")
        if key is not None and (not names or one.name in names):
            block = blocks.get(one.name) or _block(one.default, key.range)
            found[key.name or one.name] = Field(block, key.doc, default=key.shown or _shown(one.default))
    return found


def _block(default: Any, bounds: Range | None) -> Block[Any]:
    if isinstance(default, bool):
        return Flag()
    if isinstance(default, StrEnum):
        return Choice.of(type(default))
    assert bounds is not None, f"say which block reads a value such as {default!r}"
    if isinstance(default, int):
        return Whole(int(bounds.low), int(bounds.high))
    return Number(bounds.low, bounds.high, bounds.unit)


def _shown(value: object) -> str:
    """A default as the reference shows it."""
    if value in (None, "", ()):
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{plain_number(value) if isinstance(value, float) else value}`"
