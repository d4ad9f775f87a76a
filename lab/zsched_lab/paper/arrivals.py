"""What the recorder heard of one run: each merged map at each robot, and each robot's own maps.

Knows: times, sizes, what a map knows of the truth. Does not know: files, figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zsched.core.values.model import NodeId
from zsched.tasks.map_merge.geometry import Pose2


@dataclass(frozen=True, slots=True)
class Arrival:
    """One merged map at one robot: when, how old its newest input was, how large."""

    t_s: float
    latency_s: float
    size: int
    known: float
    """Share of the truth's known cells that it knows, right or wrong."""
    walls: float = 0.0
    """Share of the truth's walls that it has where they are."""


@dataclass(slots=True)
class Streams:
    """What the recorder heard of one run."""

    maps: dict[NodeId, list[Arrival]] = field(default_factory=dict)
    sent: dict[NodeId, list[tuple[float, int]]] = field(default_factory=dict)
    """(when, bytes) of each robot's own maps."""
    held: dict[float, list[int]] = field(default_factory=dict)
    """{instant: keys of the maps that the robots held then}."""
    payloads: dict[int, bytes] = field(default_factory=dict)
    frames: dict[int, Pose2] = field(default_factory=dict)
    """{key: pose of that map's frame in the truth}."""
    stamps: set[int] = field(default_factory=set)
    """Keys of the merged maps of the drive: what two robots received once counts once."""
