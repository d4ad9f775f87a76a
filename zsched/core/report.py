"""The status as JSON values (pure).

Knows: the schema ``zsched.status/1`` as JSON. Does not know: text for people (`zsched.commands.report`), sockets, where
the status came from.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

from zsched.core.values.model import Utility
from zsched.core.values.plan import StreamCount
from zsched.core.values.snapshot import DecisionStatus, Snapshot, VoteStatus

Json = dict[str, Any]


def snapshot_json(snapshot: Snapshot) -> Json:
    """The status as JSON values; pairs become objects, ``None`` becomes null, times are ages in seconds."""
    body = plain(snapshot)
    body["counters"] = dict(snapshot.counters)
    body["dropped_ages"] = dict(snapshot.dropped_ages)
    for task, status in zip(body["tasks"], snapshot.tasks, strict=True):
        task["decision"] = None if status.decision is None else _decision(status.decision)
        task["vote"] = None if status.vote is None else _vote(status.vote)
        task["streams"] = [_stream(count) for count in status.streams]
    result: Json = body
    return result


def _decision(decision: DecisionStatus) -> Json:
    return {
        **plain(decision),
        "aggregates": dict(decision.aggregates),
        "utilities": {voter: {u.candidate: _utility(u) for u in column} for voter, column in decision.utilities},
        "vetoed": dict(decision.vetoed),
        "penalties": dict(decision.penalties),
    }


def _utility(utility: Utility) -> Json:
    body: Json = plain(utility)
    del body["candidate"]
    return body


def _vote(vote: VoteStatus) -> Json:
    return {**plain(vote), "votes": dict(vote.votes)}


def _stream(count: StreamCount) -> Json:
    return {**plain(count), "drops": dict(count.drops)}


def _plain_field(name: str, value: Any) -> Any:
    """Pairs of a gauge and a number become an object."""
    return dict(value) if name == "gauges" else plain(value)


def plain(value: Any) -> Any:
    """A frozen value as JSON values, field by field."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain_field(field.name, getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    return value
