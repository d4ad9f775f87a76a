"""The base of the house's values: typed fields, compared and shown field by field.

A `Struct` is msgspec's, written in C: a class is made thirty times as fast as a dataclass, a value five times
(`docs/decisions/0042`). `dataclasses.fields`, `is_dataclass` and ``replace`` take it as well. Type checkers
see `msgspec.Struct` and the typed `dataclasses.replace`. Does not know: any value.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import Field
from typing import TYPE_CHECKING, Any, ClassVar, Final

import msgspec
from msgspec import NODEFAULT, field, structs

__all__ = ["Struct", "field", "replace"]


_FIELDS: Final[dict[type, dict[str, Field[Any]]]] = {}
"""By class, filled when asked: most are never asked."""


class _Probe(msgspec.Struct):
    """Has a default that is made: what msgspec keeps of one has no public name."""

    one: list[Any] = field(default_factory=list)


@dataclasses.dataclass(kw_only=True)
class _Like:
    """Has a field as `dataclasses.fields` takes it: the mark on it has no public name either."""

    one: int


_MADE: Final = type(_Probe.__struct_defaults__[0])
_FIELD: Final[Field[Any]] = dataclasses.fields(_Like)[0]


def _fields(kind: type[msgspec.Struct]) -> dict[str, Field[Any]]:
    names, defaults = kind.__struct_fields__, kind.__struct_defaults__
    hints: dict[str, Any] = {}
    for one in reversed(kind.__mro__):
        hints |= vars(one).get("__annotations__", {})
    held = dict(zip(names[len(names) - len(defaults) :], defaults, strict=True))
    return {name: _field(name, hints[name], held.get(name, NODEFAULT)) for name in names}


def _field(name: str, hint: Any, default: Any) -> Field[Any]:
    made = copy.copy(_FIELD)
    made.name, made.type = name, hint
    if isinstance(default, _MADE):
        made.default_factory = default.factory
    elif default is not NODEFAULT:
        made.default = default
    return made


class _Fields:
    """What `dataclasses` reads of a class, made when it is read."""

    def __get__(self, _: object, kind: type[msgspec.Struct]) -> dict[str, Field[Any]]:
        if kind not in _FIELDS:
            _FIELDS[kind] = _fields(kind)
        return _FIELDS[kind]


if TYPE_CHECKING:
    from dataclasses import replace

    from msgspec import Struct
else:

    class Struct(msgspec.Struct):
        """A value with typed fields.

        Options stand in each class's own line: ``class Beat(Struct, frozen=True, kw_only=True)``. Raises `TypeError`
        for a missing or unknown field, `AttributeError` where a frozen one is changed.
        """

        __dataclass_fields__: ClassVar[dict[str, Field]] = _Fields()

    def replace(value: Any, /, **changes: Any) -> Any:
        """A copy of a struct or dataclass with some fields changed; its own checks (``__post_init__``) run again."""
        if isinstance(value, msgspec.Struct):
            return structs.replace(value, **changes)
        return dataclasses.replace(value, **changes)
