"""Whether a daemon can go on with a relay that knows other words, and what of a command such a relay does not know.

Knows: what passes the pipe, class by class and field by field, as text that one version writes and another one reads.
Does not know: pipes, processes, plans.

The codec leaves out what equals its default, and reads past what it does not know (`zsched.wire.codec`). So a word that
was added with a default harms nobody who does not use it: a relay without it is asked for nothing that it has not, and
a daemon without it is told more than it reads. All else is another language. Meanings are not seen here:
`zsched.ipc.takeover.PROTOCOL` is raised for them, and where a daemon relies on a report that earlier relays never send.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, Final, get_args, get_origin

from zsched.core.values.struct import Struct
from zsched.ipc.pipe import COMMANDS, REPORTS
from zsched.ipc.protocol import RelayHello, RelayHere, RelayRefused
from zsched.ipc.words import name_of, words_digest
from zsched.wire import codec as wire

ALWAYS: Final = "always said"
"""In place of the default of a field that has none."""

_Word = dict[str, list[str]] | list[str]
"""Of a class: {field: [its type, its default]}; of an enum: its members."""


class Vocabulary(Struct, frozen=True, kw_only=True):
    """All that one version's daemons and relays say to each other."""

    digest: str
    """As `words_digest` has it."""
    wire: int
    told: dict[str, _Word]
    """What a relay is told: commands and the greeting, and all that they are made of."""
    heard: dict[str, _Word]
    """What it answers."""
    bounds: dict[str, int]
    """The bytes that a frame of a kind has at most."""


@functools.cache
def own() -> Vocabulary:
    """This version's."""
    told: dict[str, _Word] = {}
    heard: dict[str, _Word] = {}
    for cls in (*COMMANDS, RelayHello):
        _collect(cls, told)
    for cls in (*REPORTS, RelayHere, RelayRefused):
        _collect(cls, heard)
    passing = (*COMMANDS, *REPORTS, RelayHello, RelayHere, RelayRefused)
    bounds = {kind: bound for kind, (cls, bound) in sorted(wire.KINDS.items()) if cls in passing}
    return Vocabulary(digest=words_digest(), wire=wire.VERSION, told=told, heard=heard, bounds=bounds)


def written(vocabulary: Vocabulary) -> str:
    """As text for another version."""
    return json.dumps({field.name: getattr(vocabulary, field.name) for field in fields(Vocabulary)})


def read(text: str | bytes) -> Vocabulary | None:
    """What another version has written; ``None``: it is not to be understood."""
    try:
        found = json.loads(text)
        told, heard = _words(found["told"]), _words(found["heard"])
        bounds = {str(kind): int(bound) for kind, bound in found["bounds"].items()}
        return Vocabulary(digest=str(found["digest"]), wire=int(found["wire"]), told=told, heard=heard, bounds=bounds)
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def misunderstanding(relay: Vocabulary, daemon: Vocabulary) -> str:
    """Why a daemon cannot go on with a relay, whatever it is going to say; empty: it can."""
    if relay.wire != daemon.wire:
        return f"frames of version {relay.wire}, not {daemon.wire}"
    doubts = [
        *_unlike(relay.told, daemon.told, "the relay"),
        *_unlike(daemon.heard, relay.heard, "the daemon"),
        *(
            f"{kind}: {bound} bytes, not {daemon.bounds[kind]}"
            for kind, bound in relay.bounds.items()
            if daemon.bounds.get(kind, bound) != bound
        ),
    ]
    for name, mine in daemon.heard.items():
        theirs = relay.heard.get(name)
        if isinstance(mine, list) and isinstance(theirs, list) and (more := [one for one in theirs if one not in mine]):
            doubts.append(f"{name} {more[0]} is not known to the daemon")
    return doubts[0] if doubts else ""


def lack(value: Any, relay: Vocabulary) -> str:
    """What a command says that the relay does not know; empty: it knows all of it."""
    if isinstance(value, tuple):
        return next((found for one in value if (found := lack(one, relay))), "")
    name, known = type(value).__qualname__, relay.told.get(type(value).__qualname__)
    if isinstance(value, Enum):
        return "" if isinstance(known, list) and value.value in known else f"{name} {value.value}"
    if not is_dataclass(value):
        return ""
    if not isinstance(known, dict):
        return name
    for field in fields(value):
        item = getattr(value, field.name)
        if field.name not in known:
            if item != field.default:
                return f"{name}.{field.name}"
        elif found := lack(item, relay):
            return found
    return ""


def _unlike(reader: dict[str, _Word], writer: dict[str, _Word], who: str) -> Iterator[str]:
    """What of the writer's words the reader (``who``) would take for something else, or miss."""
    for name, theirs in reader.items():
        mine = writer.get(name)
        if mine is None or (isinstance(mine, list) and isinstance(theirs, list)):
            continue  # never said; members are looked at one by one
        if isinstance(mine, list) or isinstance(theirs, list):
            yield f"{name} is another kind of word"
            continue
        for field, said in theirs.items():
            if field not in mine and said[1] == ALWAYS:
                yield f"{who} wants {name}.{field}, which is not said"
            elif mine.get(field, said) != said:
                yield f"{name}.{field} is {' = '.join(said)} to {who}, not {' = '.join(mine[field])}"
        for field, said in mine.items():
            if field not in theirs and said[1] == ALWAYS and who == "the relay":
                yield f"{name}.{field} is always said, and {who} does not know it"


def _collect(hint: Any, found: dict[str, _Word]) -> None:
    for argument in get_args(hint):
        _collect(argument, found)
    cls = get_origin(hint) or hint
    if not isinstance(cls, type) or cls.__qualname__ in found:
        return
    if issubclass(cls, Enum):
        found[cls.__qualname__] = [str(member.value) for member in cls]
    elif is_dataclass(cls):
        hints = wire.hints_of(hint)
        found[cls.__qualname__] = {
            field.name: [name_of(hints[field.name]), _default(field.default)] for field in fields(cls)
        }
        for inner in hints.values():
            _collect(inner, found)


def _default(value: Any) -> str:
    """A default as text; of a class only what is not its own default, for that is looked at where it stands."""
    if value is MISSING:
        return ALWAYS
    if is_dataclass(value):
        said = ((field.name, getattr(value, field.name), field.default) for field in fields(value))
        inner = ", ".join(f"{name}={_default(one)}" for name, one, default in said if one != default)
        return f"{type(value).__qualname__}({inner})"
    return repr(value.value) if isinstance(value, Enum) else repr(value)


def _words(found: dict[str, Any]) -> dict[str, _Word]:
    return {str(name): _word(word) for name, word in found.items()}


def _word(found: Any) -> _Word:
    if isinstance(found, list):
        return _texts(found)
    return {str(field): _texts(said) for field, said in found.items()}


def _texts(found: Iterable[Any]) -> list[str]:
    return [str(one) for one in found]
