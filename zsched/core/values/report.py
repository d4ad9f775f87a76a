"""The status as JSON values (pure).

Knows: the schema ``zsched.status/1`` as JSON. Does not know: text for people (`zsched.commands.base.report`), sockets,
where the status came from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, Final, TypeAlias

from zsched.core.values.model import NodeId, Utility
from zsched.core.values.plan import StreamCount
from zsched.core.values.snapshot import DecisionStatus, Snapshot, VoteStatus

Json = dict[str, Any]


def snapshot_json(snapshot: Snapshot) -> Json:
    """The status as JSON values; pairs become objects, ``None`` becomes null, times are ages in seconds."""
    body: Json = plain(snapshot)
    return body


def plain(value: Any) -> Any:
    """A frozen value as JSON values, field by field; pairs of a name and a number become an object."""
    kind = type(value)
    if kind in _ATOMS:
        return value
    if kind is tuple:
        return [plain(item) for item in value]
    if kind not in _MAKERS:
        _MAKERS[kind] = _maker(kind)
    return _MAKERS[kind](value)


def _columns(utilities: tuple[tuple[NodeId, tuple[Utility, ...]], ...]) -> Json:
    return {voter: {one.candidate: _without_name(one) for one in column} for voter, column in utilities}


def _without_name(utility: Utility) -> Json:
    body: Json = plain(utility)
    del body["candidate"]
    return body


_Maker: TypeAlias = Callable[[Any], Any]
_ATOMS: Final = frozenset({str, int, float, bool, type(None)})
_OWN_FIELDS: Final[Mapping[type, Mapping[str, _Maker]]] = {
    Snapshot: {"counters": dict, "dropped_ages": dict},
    DecisionStatus: {"aggregates": dict, "utilities": _columns, "vetoed": dict, "unkept": dict, "owed": dict},
    VoteStatus: {"votes": dict},
    StreamCount: {"drops": dict},
}
"""Fields of pairs, by class. ``gauges`` are pairs wherever they are."""
_MAKERS: Final[dict[type, _Maker]] = {}
"""By class, filled when met: a status holds hundreds of values of a few classes, and is asked for every second."""


def _maker(kind: type) -> _Maker:
    if issubclass(kind, Enum):
        return lambda value: value.value
    if not is_dataclass(kind):
        return lambda value: value
    own = {"gauges": dict, **_OWN_FIELDS.get(kind, {})}
    makers = tuple((field.name, own.get(field.name, plain)) for field in fields(kind))
    return lambda value: {name: make(getattr(value, name)) for name, make in makers}
