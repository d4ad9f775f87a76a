"""What a daemon and its relay say to each other, field by field, and a digest over it."""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from hashlib import blake2s
from typing import Any, Final, Union, get_args, get_origin

from zsched.core.values import codec as wire
from zsched.link.pipe.frames import COMMANDS, REPORTS
from zsched.link.pipe.protocol import RelayHello, RelayHere, RelayQuestion, RelayRefused

_GREETINGS: Final[tuple[type[Any], ...]] = (RelayHello, RelayQuestion, RelayHere, RelayRefused)


def words_digest() -> str:
    """16 hex digits over every class that passes the pipe: fields, types, defaults, members, bounds."""
    state = blake2s(digest_size=8)
    for line in words():
        state.update(line.encode() + b"\n")
    return state.hexdigest()


def words() -> list[str]:
    """One line per class, sorted: what `words_digest` is made of."""
    found: dict[str, str] = {f"wire {wire.VERSION}": f"wire {wire.VERSION}"}
    passing = (*COMMANDS, *REPORTS, *_GREETINGS)
    for cls in passing:
        _collect(cls, found)
    bounds = sorted(
        f"{kind}: {cls.__qualname__}, {bound} bytes" for kind, (cls, bound) in wire.KINDS.items() if cls in passing
    )
    return [*sorted(found.values()), *bounds]


def _collect(hint: Any, found: dict[str, str]) -> None:
    """Tell a type and all that it is made of."""
    for argument in get_args(hint):
        _collect(argument, found)
    cls = get_origin(hint) or hint
    if not isinstance(cls, type) or (name := name_of(hint)) in found:
        return
    if issubclass(cls, Enum):
        found[name] = f"{name}: {', '.join(str(member.value) for member in cls)}"
    elif is_dataclass(cls):
        found[name] = f"{name}: {'; '.join(_fields(hint))}"
        for inner in wire.hints_of(hint).values():
            _collect(inner, found)


def _fields(hint: Any) -> Iterator[str]:
    hints = wire.hints_of(hint)
    for one in fields(get_origin(hint) or hint):
        default = "" if one.default is MISSING else f" = {one.default!r}"
        yield f"{one.name}: {name_of(hints[one.name])}{default}"


def name_of(hint: Any) -> str:
    """A type's name, whatever module it is in."""
    if hint is Ellipsis:
        return "..."
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " | ".join(name_of(one) for one in arguments)
    own = getattr(origin or hint, "__qualname__", str(origin or hint))
    return own if not arguments else f"{own}[{', '.join(name_of(one) for one in arguments)}]"
