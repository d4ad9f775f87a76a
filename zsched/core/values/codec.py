"""Bytes <-> values: MessagePack frames, versioned, size- and range-checked.

Knows: the frame (``[version, kind, {field: value}]``), which classes may travel, how many bytes each may take.
Does not know: keys, peers, what a value is for.

The codec of a class is compiled once from its type hints, so that a value's fields, their types and ranges stand in one
place only (the dataclass). Fields equal to their default are left out, unknown fields are ignored (a newer peer), a
missing field without a default, a wrong type, a value out of range, an unknown version or kind raise `WireError`,
whose ``reason`` is the word a counter is kept under. Nothing else ever escapes `decode`, whatever the bytes.
"""

from __future__ import annotations

import hashlib
import math
import types
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgpack

from zsched.core.values import decision, document, durable, messages, model, plan, rehearsal, snapshot
from zsched.core.values.beat import MAX_BEAT_BYTES, Beat
from zsched.core.values.errors import WireError
from zsched.core.values.profile import Profile

VERSION = 1
MAX_STRING = 512
SMALL = 8 * 1024
LARGE = 256 * 1024

T = TypeVar("T")
Reader = Callable[[Any], Any]
Writer = Callable[[Any], Any]

KINDS: dict[str, tuple[type, int]] = {
    "beat": (Beat, MAX_BEAT_BYTES),
    "profile": (Profile, 8 * SMALL),
    "proposal": (model.Proposal, SMALL),
    "utilities": (messages.Utilities, LARGE),
    "prepare": (messages.Prepare, SMALL),
    "promise": (messages.Promise, SMALL),
    "accept": (messages.Accept, SMALL),
    "accepted": (messages.Accepted, SMALL),
    "refused": (messages.Refused, 8 * SMALL),
    "ballots": (messages.Ballots, LARGE),
    "votes": (messages.Votes, LARGE),
    "fleet_question": (messages.FleetQuestion, LARGE),
    "fleet_answer": (messages.FleetAnswer, LARGE),
    "ask_document": (messages.AskDocument, SMALL),
    "document": (document.Document, LARGE),
    "learnt": (messages.Learnt, LARGE),
    "move_task": (messages.MoveTask, SMALL),
    "hold_task": (messages.HoldTask, SMALL),
    "tune_task": (messages.TuneTask, SMALL),
    "explain_task": (messages.ExplainTask, SMALL),
    "explanation": (decision.Explanation, LARGE),
    "restart_task": (messages.RestartTask, SMALL),
    "take_certificate": (messages.TakeCertificate, SMALL),
    "read_lines": (messages.ReadLines, SMALL),
    "change_fleet": (messages.ChangeFleet, LARGE),
    "read_fleet": (messages.ReadFleet, SMALL),
    "fleet_told": (messages.FleetTold, LARGE),
    "worker_lines": (messages.WorkerLines, LARGE),
    "read_history": (messages.ReadHistory, SMALL),
    "history_told": (messages.HistoryTold, LARGE),
    "strike": (rehearsal.Strike, SMALL),
    "keep_rehearsal": (rehearsal.KeepRehearsal, LARGE),
    "read_rehearsals": (rehearsal.ReadRehearsals, SMALL),
    "rehearsals_told": (rehearsal.RehearsalsTold, LARGE),
    "command_result": (messages.CommandResult, SMALL),
    "status": (snapshot.Snapshot, LARGE),
    "state": (durable.DurableState, LARGE),
    "role": (plan.Role, SMALL),
    "route_plan": (plan.RoutePlan, LARGE),
}
"""Every class that may travel between nodes, into the state file or over the relay's pipe, with its size bound."""

_KIND_OF: dict[type, str] = {cls: kind for kind, (cls, _) in KINDS.items()}


def register(kind: str, cls: type, max_bytes: int) -> None:
    """Add a class of another module of this program (the relay's pipe) to the codec.

    Raises:
        ValueError: the kind or the class is already there.
    """
    if kind in KINDS or cls in _KIND_OF:
        raise ValueError(f"wire kind {kind!r} is registered twice")
    KINDS[kind] = (cls, max_bytes)
    _KIND_OF[cls] = kind


# --- compiling a class's codec -------------------------------------------------------------------------------------


def _fail(what: str, value: object) -> WireError:
    return WireError("type", f"{what}, not {type(value).__name__}")


def _read_str(value: Any) -> str:
    if type(value) is not str or len(value) > MAX_STRING:
        raise _fail(f"expected a string of at most {MAX_STRING}", value)
    return value


def _read_text(value: Any) -> str:
    """A document's text: its class checks how long it is."""
    if type(value) is not str:
        raise _fail("expected a string", value)
    return value


def _read_int(value: Any) -> int:
    if type(value) is not int:
        raise _fail("expected an integer", value)
    return value


def _read_float(value: Any) -> float:
    if type(value) is int:
        value = float(value)
    if type(value) is not float or not math.isfinite(value):
        raise _fail("expected a finite number", value)
    return value


def _read_bool(value: Any) -> bool:
    if type(value) is not bool:
        raise _fail("expected a boolean", value)
    return value


def _same(value: Any) -> Any:
    return value


def _write_str(value: str) -> str:
    """Names never get near the bound; a reason for people that does is cut rather than refused by the receiver."""
    if len(value) > MAX_STRING:
        value = value[: MAX_STRING - 1] + "…"
    return value if value.isascii() else value.encode("utf-8", "replace").decode()


_SCALARS: dict[Any, Reader] = {
    str: _read_str,
    document.Text: _read_text,
    int: _read_int,
    float: _read_float,
    bool: _read_bool,
}
_AS_IT_IS = {
    str: f"type({{0}}) is str and len({{0}}) <= {MAX_STRING}",
    int: "type({0}) is int",
    float: "type({0}) is float and -inf < {0} < inf",
    bool: "type({0}) is bool",
}
"""When a scalar that was read is the value; else its reader says what is wrong with it, or converts it."""
_CODECS: dict[type, tuple[Reader, Writer]] = {}


def hints_of(cls: Any) -> dict[str, Any]:
    """{field: its type} of a dataclass; a generic one without a parameter is of a task's register."""
    origin, arguments = get_origin(cls) or cls, get_args(cls) or (model.Allocation,)
    hints = get_type_hints(origin)
    return {name: _filled(hint, arguments) for name, hint in hints.items()}


def _filled(hint: Any, arguments: tuple[Any, ...]) -> Any:
    """A type hint with its type variable replaced."""
    if isinstance(hint, TypeVar):
        return arguments[0]
    if not getattr(hint, "__parameters__", ()):
        return hint
    return hint[arguments]


def _codec(hint: Any) -> tuple[Reader, Writer]:
    """The (reader, writer) of a type hint."""
    if hint in _SCALARS:
        return _SCALARS[hint], _write_str if hint is str else _same
    origin = get_origin(hint)
    if origin is tuple:
        return _tuple_codec(get_args(hint))
    if origin in (Union, types.UnionType):
        return _optional_codec(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _enum_codec(hint)
    if is_dataclass(origin or hint):
        if hint not in _CODECS:
            _CODECS[hint] = _dataclass_codec(hint)
        return _CODECS[hint]
    raise TypeError(f"no codec for {hint!r}")


def _enum_codec(hint: type[Enum]) -> tuple[Reader, Writer]:
    members = {member.value: member for member in hint}

    def read(value: Any) -> Enum:
        if type(value) is not str or not (value in members or "" in members):
            raise _fail(f"expected one of {sorted(members)}", value)
        return members.get(value) or members[""]  # where nothing may be said, so may what a later program says

    return read, lambda value: value.value


class _Source:
    """The text of a function and the names it uses: written out field by field, as `dataclasses` does for ``__init__``.

    A loop over the fields takes twice as long, and beats are read thirty times a second. Only field names of our own
    classes get into the text, never what a frame holds.
    """

    def __init__(self, **names: Any) -> None:
        self.names: dict[str, Any] = {"inf": math.inf, **names}
        self.lines: list[str] = []

    def reading(self, hint: Any, variable: str) -> str:
        """An expression for what a variable holds, read as ``hint``."""
        inner = _inner(hint)
        if inner is not None:
            return f"None if {variable} is None else {self.reading(inner, variable)}"
        call = f"{self._name(_codec(hint)[0])}({variable})"
        return f"{variable} if {_AS_IT_IS[hint].format(variable)} else {call}" if hint in _AS_IT_IS else call

    def writing(self, hint: Any, variable: str) -> str:
        """An expression for what a variable of this type is written as."""
        inner = _inner(hint)
        if inner is not None:
            return f"None if {variable} is None else {self.writing(inner, variable)}"
        writer = _codec(hint)[1]
        return variable if writer is _same else f"{self._name(writer)}({variable})"

    def _name(self, used: Any) -> str:
        name = f"_{len(self.names)}"
        self.names[name] = used
        return name

    def function(self) -> Any:
        """The function ``f`` that the lines define."""
        exec("\n".join(self.lines), self.names)  # noqa: S102 - our own text, see above
        return self.names["f"]


def _inner(hint: Any) -> Any:
    """What an optional hint holds beside ``None``; ``None`` for any other hint."""
    if get_origin(hint) not in (Union, types.UnionType):
        return None
    (inner,) = [arg for arg in get_args(hint) if arg is not type(None)]
    return inner


def _optional_codec(hint: Any) -> tuple[Reader, Writer]:
    read, write = _Source(), _Source()
    read.lines = ["def f(x):", f" return {read.reading(hint, 'x')}"]
    write.lines = ["def f(x):", f" return {write.writing(hint, 'x')}"]
    return read.function(), write.function()


def _tuple_codec(args: tuple[Any, ...]) -> tuple[Reader, Writer]:
    if len(args) == 2 and args[1] is Ellipsis:
        read_item, write_item = _codec(args[0])

        def read_many(value: Any) -> tuple[Any, ...]:
            if type(value) is not list:
                raise _fail("expected a list", value)
            return tuple([read_item(item) for item in value])

        return read_many, lambda value: [write_item(item) for item in value]
    return _fixed_codec(args)


def _fixed_codec(args: tuple[Any, ...]) -> tuple[Reader, Writer]:
    read, write = _Source(fail=_fail), _Source()
    items = [f"x{index}" for index in range(len(args))]
    unpacked = f" {', '.join(items)}, = x"
    read.lines = ["def f(x):", f" if type(x) is not list or len(x) != {len(args)}:"]
    read.lines += [f"  raise fail('expected a list of {len(args)}', x)", unpacked]
    read.lines += [f" return {', '.join(read.reading(*each) for each in zip(args, items, strict=True))},"]
    write.lines = ["def f(x):", unpacked]
    write.lines += [f" return [{', '.join(write.writing(*each) for each in zip(args, items, strict=True))}]"]
    return read.function(), write.function()


def _dataclass_codec(cls: type) -> tuple[Reader, Writer]:
    hints = hints_of(cls)
    cls = get_origin(cls) or cls
    read, write = _Source(cls=cls, fail=_fail, WireError=WireError), _Source()
    read.lines = ["def f(value):", " if type(value) is not dict:"]
    read.lines += [f"  raise fail('expected a map ({cls.__name__})', value)"]
    write.lines = ["def f(value):", " body = {}"]
    arguments = []
    for index, field in enumerate(fields(cls)):
        name, hint, item, default = field.name, hints[field.name], f"item{index}", f"default{index}"
        read.names[default] = write.names[default] = field.default
        arguments.append(f"{name}={item}")
        read.lines += [f" if {name!r} in value:", f"  {item} = value[{name!r}]"]
        read.lines += [f"  {item} = {read.reading(hint, item)}", " else:"]
        write.lines += [f" {item} = value.{name}"]
        if field.default is MISSING:
            read.lines += [f"  raise WireError('missing', '{cls.__name__}.{name}')"]
            write.lines += [f" body[{name!r}] = {write.writing(hint, item)}"]
        else:
            read.lines += [f"  {item} = {default}"]
            write.lines += [f" if {item} is not {default} and {item} != {default}:"]
            write.lines += [f"  body[{name!r}] = {write.writing(hint, item)}"]
    read.lines += [f" return cls({', '.join(arguments)})"]
    write.lines += [" return body"]
    return read.function(), write.function()


# --- frames --------------------------------------------------------------------------------------------------------


def encode(value: object) -> bytes:
    """The frame of a value whose class is in `KINDS`.

    Raises:
        KeyError: the class may not travel.
        WireError: the frame would be larger than its kind allows (``reason`` "size"), or holds what no frame can (an
            integer over 64 bits: "range"): a bug or a fleet too large.
    """
    kind = _KIND_OF[type(value)]
    cls, bound = KINDS[kind]
    _, write = _CODECS.get(cls) or _codec(cls)
    try:
        frame: bytes = msgpack.packb([VERSION, kind, write(value)], use_bin_type=True)
    except (ValueError, OverflowError) as error:
        raise WireError("range", f"{kind}: {error}"[:200]) from error
    if len(frame) > bound:
        raise WireError("size", f"{kind}: {len(frame)} bytes, at most {bound}")
    return frame


def decode(frame: bytes, *classes: type[T]) -> T:
    """The value in a frame, which must be of one of ``classes``.

    Raises:
        WireError: anything at all is wrong; ``reason`` is one of size, garbage, frame, version, kind, type, missing,
            range.
    """
    bound = max([KINDS[_KIND_OF[cls]][1] for cls in classes])
    if len(frame) > bound:
        raise WireError("size", f"{len(frame)} bytes, at most {bound}")
    try:
        parts = msgpack.unpackb(frame, raw=False, strict_map_key=True, timestamp=0)
    except Exception as error:  # hostile bytes: whatever msgpack raises means the same
        raise WireError("garbage", type(error).__name__) from error
    if type(parts) is not list or len(parts) < 3:
        raise WireError("frame", "expected [version, kind, body]")
    version, kind, body = parts[:3]
    if version != VERSION or type(version) is not int:
        raise WireError("version", f"{_quoted(version)}, this is {VERSION}")
    for cls in classes:
        if kind == _KIND_OF[cls]:
            return _read_body(cls, body, len(frame))
    raise WireError("kind", _quoted(kind))


def _quoted(value: Any) -> str:
    """A hostile value in a few characters; containers by type only (the repr of a deep one exceeds the stack)."""
    return f"{value!r:.40}" if isinstance(value, str | int | float) else type(value).__name__


def _read_body(cls: type[T], body: Any, size: int) -> T:
    bound = KINDS[_KIND_OF[cls]][1]
    if size > bound:
        raise WireError("size", f"{size} bytes, at most {bound}")
    try:
        reader, _ = _CODECS.get(cls) or _codec(cls)
        value: T = reader(body)
    except (ValueError, TypeError, OverflowError) as error:
        raise WireError("range", str(error)[:200]) from error
    return value


# --- without a frame: what is written as JSON ---------------------------------------------------------------------


def as_plain(value: object) -> Any:
    """Lists, maps, strings and numbers, which JSON can hold without loss; fields at their default are left out.

    The value's class need not be in `KINDS`.
    """
    return _codec(type(value))[1](value)


def from_plain(body: Any, cls: type[T]) -> T:
    """The value again.

    Raises:
        WireError: as `decode`.
    """
    try:
        value: T = _codec(cls)[0](body)
    except (ValueError, TypeError, OverflowError) as error:
        raise WireError("range", str(error)[:200]) from error
    return value


def document_hash(content: document.Document) -> str:
    """32 hex digits over a document's frame: its name in fleet values, and on disks."""
    return _named(encode(content))


def decode_document(frame: bytes, name: str) -> document.Document:
    """The document in a frame, which must be the one with the hash ``name``.

    Raises:
        WireError: anything is wrong; ``reason`` "checksum": it is another document.
    """
    if _named(frame) != name:
        raise WireError("checksum", f"these bytes are not the document {name}")
    return decode(frame, document.Document)


def _named(frame: bytes) -> str:
    return hashlib.blake2s(frame, digest_size=16, person=b"zsched1", salt=b"document").hexdigest()


# --- the state file's payload --------------------------------------------------------------------------------------


def encode_state(state: durable.DurableState) -> bytes:
    """The state file's whole content: a magic line, the checksum, the frame."""
    frame = encode(state)
    return b"zsched-state/1 " + hashlib.blake2s(frame).hexdigest().encode() + b"\n" + frame


def decode_state(content: bytes) -> durable.DurableState:
    """The state in a file's content.

    Raises:
        WireError: torn, foreign or damaged content.
    """
    header, newline, frame = content.partition(b"\n")
    words = header.split(b" ")
    if not newline or len(words) != 2 or words[0] != b"zsched-state/1":
        raise WireError("frame", "not a zsched state file of version 1")
    if hashlib.blake2s(frame).hexdigest().encode() != words[1]:
        raise WireError("checksum", "the content does not match its checksum (torn or damaged)")
    return decode(frame, durable.DurableState)
