"""What the lab knows of its fleet at a moment, as frozen values: made from status snapshots, shown by the live view.

Knows: the JSON of the schema ``zsched.status/1``. Does not know: sockets, terminals, pictures.

The snapshots are read leniently (a missing field is "not known"): the lab must be able to show a fleet in trouble.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from zsched.core.values.model import NodeId, TaskId
from zsched_lab.maps.picture import MapPicture

Status = Mapping[str, Any]
"""One decoded status snapshot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeView:
    """One node's row: ratios in [0, 1], ``None`` when nobody measured."""

    name: NodeId
    kind: str
    state: str
    cpu_ratio: float | None = None
    memory_ratio: float | None = None
    memory_used_mb: float | None = None
    link: str = ""
    worker: str = ""
    is_owner: bool = False
    is_loaded: bool = False
    """The lab injects load there now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskView:
    """The task as the freshest robot sees it."""

    name: TaskId
    owner: NodeId | None = None
    epoch: int = 0
    since_s: float | None = None
    phase: str = ""
    candidates: tuple[NodeId, ...] = ()
    aggregates: tuple[tuple[NodeId, float], ...] = ()
    utilities: tuple[tuple[NodeId, tuple[tuple[NodeId, float], ...]], ...] = ()
    """(voter, ((candidate, Eq. 4), ...))."""
    votes: tuple[tuple[NodeId, NodeId], ...] = ()
    """(voter, candidate) of the last vote that was heard."""
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapView:
    """What one robot sees of the merged map."""

    robot: NodeId
    maps: int = 0
    rate_hz: float | None = None
    """Over the last seconds; ``None`` before the first map."""
    age_s: float | None = None
    """Since the newest map."""
    gap_max_s: float | None = None
    scans: int = 0
    scans_total: int = 0
    picture: MapPicture | None = None
    """The newest map, small; ``None`` before the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """One allocation of the run, ``t_s`` seconds since its start."""

    task: TaskId
    epoch: int
    node: NodeId | None
    t_s: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Load:
    """One window of injected load as it really was, in seconds since the start."""

    node: NodeId
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetView:
    """Everything the live view shows."""

    title: str
    phase: str
    elapsed_s: float
    duration_s: float
    nodes: tuple[NodeView, ...] = ()
    task: TaskView | None = None
    maps: tuple[MapView, ...] = ()
    moves: int = 0
    events: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


def as_items(value: object) -> list[tuple[str, Any]]:
    """A JSON mapping, or list of pairs, as a list of pairs; anything else is empty."""
    if isinstance(value, Mapping):
        return [(str(key), item) for key, item in value.items()]
    if isinstance(value, list):
        return [(str(pair[0]), pair[1]) for pair in value if isinstance(pair, list) and len(pair) == 2]
    return []


def as_number(value: object) -> float | None:
    """A JSON number as float; anything else is "not measured"."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def as_records(value: object) -> list[Status]:
    """A JSON list of objects; anything else in it is dropped."""
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list) else []


def find_task(status: Status, task: TaskId) -> Status | None:
    """The task's part of a snapshot."""
    return next((part for part in as_records(status.get("tasks")) if part.get("name") == task), None)


def task_view(status: Status, task: TaskId) -> TaskView | None:
    """What the answering robot thinks of ``task``; ``None`` when its snapshot does not have it."""
    part = find_task(status, task)
    if part is None:
        return None
    decision: Status = part.get("decision") or {}
    vote: Status = part.get("vote") or {}
    aggregates = tuple((node, float(value)) for node, value in as_items(decision.get("aggregates")))
    votes = as_items(vote.get("votes")) or as_items(decision.get("votes"))
    return TaskView(
        name=task,
        owner=part.get("owner"),
        epoch=int(part.get("epoch") or 0),
        since_s=as_number(part.get("since_s")),
        phase=str(part.get("phase") or ""),
        candidates=tuple(part.get("candidates") or sorted(node for node, _ in aggregates)),
        aggregates=aggregates,
        utilities=tuple((voter, utility_row(row)) for voter, row in as_items(decision.get("utilities"))),
        votes=tuple((voter, str(candidate)) for voter, candidate in votes),
        reason=str(decision.get("reason") or ""),
    )


def utility_row(row: object) -> tuple[tuple[NodeId, float], ...]:
    """One voter's utilities: ``{node: {"value": v}}`` or ``[{"candidate": node, "value": v}]``."""
    if isinstance(row, Mapping):
        pairs: Iterable[tuple[str, Any]] = ((str(node), item) for node, item in row.items())
    else:
        pairs = ((str(item.get("candidate")), item) for item in as_records(row))
    found = ((node, as_number(item.get("value") if isinstance(item, Mapping) else item)) for node, item in pairs)
    return tuple((node, value) for node, value in found if value is not None)


def node_views(
    statuses: Mapping[NodeId, Status],
    kinds: Mapping[NodeId, str],
    task: TaskId,
    owner: NodeId | None,
    loaded: frozenset[NodeId],
) -> tuple[NodeView, ...]:
    """One row per configured node: its own word on itself when it answers, else what a peer says of it."""
    return tuple(
        node_view(name, kinds[name], statuses, task, owner, loaded) for name in sorted(kinds, key=row_order(kinds))
    )


def row_order(kinds: Mapping[NodeId, str]) -> Any:
    """Sort key: robots before edges, then by name."""
    return lambda name: (kinds[name] != "robot", name)


def node_view(
    name: NodeId,
    kind: str,
    statuses: Mapping[NodeId, Status],
    task: TaskId,
    owner: NodeId | None,
    loaded: frozenset[NodeId],
) -> NodeView:
    """The row of one node."""
    part = own_or_heard(name, statuses)
    state = "no answer" if name not in statuses else str(part.get("state") or "alive")
    workers = [load for load in as_records(part.get("workers")) if load.get("task") == task]
    return NodeView(
        name=name,
        kind=kind,
        state=state,
        cpu_ratio=as_number(part.get("cpu_ratio")),
        memory_ratio=as_number(part.get("memory_ratio")),
        memory_used_mb=as_number(part.get("memory_used_mb")),
        link=link_text(as_records(part.get("links"))),
        worker=str(workers[0].get("state") or "") if workers else "",
        is_owner=name == owner,
        is_loaded=name in loaded,
    )


def own_or_heard(name: NodeId, statuses: Mapping[NodeId, Status]) -> Status:
    """The node's part of its own snapshot, else of any other that lists it, else nothing."""
    order = [name, *(other for other in statuses if other != name)]
    for answering in order:
        for part in as_records(statuses.get(answering, {}).get("nodes")):
            if part.get("name") == name:
                return part
    return {}


def link_text(links: list[Status]) -> str:
    """The node's links in a few characters: ``wired``, or the weakest signal in dBm."""
    signals = [value for link in links if (value := as_number(link.get("rssi_dbm"))) is not None]
    if signals:
        return f"{min(signals):.0f} dBm"
    return str(links[0].get("source") or "") if links else ""


def problems(statuses: Mapping[NodeId, Status]) -> tuple[str, ...]:
    """Every node's problems, each once, with the node that said it."""
    seen: dict[str, NodeId] = {}
    for node in sorted(statuses):
        told = list(statuses[node].get("problems") or ())
        for part in as_records(statuses[node].get("tasks")):
            told.extend(part.get("problems") or ())
        for problem in told:
            seen.setdefault(str(problem), node)
    return tuple(f"{node}: {problem}" for problem, node in seen.items())


def past_allocations(status: Status, task: TaskId, heard_s: float) -> list[Move]:
    """The allocations in a snapshot's history, on the clock of ``heard_s`` (when the snapshot was taken)."""
    part = find_task(status, task)
    now_s = as_number(status.get("now_s"))
    moves = []
    for past in as_records(part.get("history") if part else None):
        age_s = as_number(past.get("age_s"))
        at_s = as_number(past.get("t_s"))
        if age_s is None and at_s is not None and now_s is not None:
            age_s = now_s - at_s
        epoch = int(past.get("epoch") or 0)
        if age_s is None or epoch < 1:
            continue
        reason = str(past.get("reason") or "")
        moves.append(Move(task=task, epoch=epoch, node=past.get("owner"), t_s=heard_s - age_s, reason=reason))
    return moves


def merge_moves(known: Mapping[int, Move], told: Iterable[Move]) -> dict[int, Move]:
    """One move per epoch: the earliest time that any node told, and the reason of one that knows it."""
    merged = dict(known)
    for move in told:
        old = merged.get(move.epoch)
        if old is None:
            merged[move.epoch] = move
            continue
        merged[move.epoch] = Move(
            task=move.task,
            epoch=move.epoch,
            node=old.node,
            t_s=min(old.t_s, move.t_s),
            reason=max(old.reason, move.reason, key=len),
        )
    return merged
