"""What the robots see: a recorded laser log that each replays a part of, or a known world that they explore.

Knows: the robots' programs and their options, the truth that maps are held against. Does not know: daemons, schemes.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from zsched.core.values.model import NodeId
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.body import Drift
from zsched_lab.explore.explorer import first_of
from zsched_lab.explore.worlds import load_world
from zsched_lab.maps.laser_log import load_log
from zsched_lab.maps.mapping import RESOLUTION_M, displacements, truth_grid

ODOMETRY = Drift(yaw=0.02, way=0.02)
"""Of robots whose SLAM corrects it: half a metre to two after 30 to 60 m, and up to 11 degrees (three offices)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """One robot of a run: who it is, its number of how many, the seed, where it is connected and what it gets."""

    robot: NodeId
    index: int
    robots: int
    seed: int
    endpoint: str
    records: Path
    duration_s: float
    target_coverage: float
    begin_s: float
    """When all robots begin, on the machine's monotonic clock."""
    drive_s: float | None = None
    """When they may drive, on the same clock; ``None``: from their begin on."""

    @property
    def begin(self) -> tuple[str, str]:
        """The same as an option of a robot's program."""
        return "--begin-s", f"{self.begin_s:.3f}"


class Robots(Protocol):
    """One kind of input."""

    @property
    def name(self) -> str:
        """As shown in reports; names no place of this machine."""

    @property
    def ends_when_covered(self) -> bool:
        """Whether the task is over when all robots hold the target, so that a late map costs time."""

    def truth(self) -> Grid:
        """What a perfect merged map knows, in the frame in which `frames` are."""

    def frames(self, robots: int, seed: int) -> tuple[Pose2, ...]:
        """The true pose of each robot's map frame."""

    def command(self, place: Place) -> list[str]:
        """The program of one robot's applications."""

    def helpers(self, endpoints: Mapping[NodeId, str]) -> Sequence[tuple[NodeId, list[str]]]:
        """(node, program) of what the robots have running elsewhere; ``endpoints`` are the nodes' data endpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogRobots:
    """Robots that replay a laser log, each its part, at an even pace."""

    log: Path

    @property
    def name(self) -> str:
        """The log's."""
        return f"log {self.log.name}"

    @property
    def ends_when_covered(self) -> bool:
        """The drive has a set length."""
        return False

    def truth(self) -> Grid:
        """The grid of the whole log."""
        return truth_grid(load_log(self.log))

    def frames(self, robots: int, seed: int) -> tuple[Pose2, ...]:
        """Anywhere near, turned by any angle."""
        return displacements(robots, seed)

    def command(self, place: Place) -> list[str]:
        """`zsched_lab.robots.app`."""
        command = [sys.executable, "-m", "zsched_lab.robots.app", "--robot", place.robot, "--index", str(place.index)]
        command += ["--robots", str(place.robots), "--seed", str(place.seed), "--log", str(self.log)]
        command += ["--endpoint", place.endpoint, "--records", str(place.records)]
        return [*command, *place.begin, "--replay-s", f"{place.duration_s:.3f}"]

    def helpers(self, endpoints: Mapping[NodeId, str]) -> Sequence[tuple[NodeId, list[str]]]:
        """None: the robots map on board."""
        del endpoints
        return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ExploreRobots:
    """Robots with a simulated laser in a known world, who choose where to go on the merged map that they receive."""

    world: str
    """As `zsched_lab.explore.worlds.load_world` takes it."""
    speed: float
    slam_on: Mapping[NodeId, NodeId] = field(default_factory=dict)
    """{robot: node that maps for it}; a robot that is not in it maps on board."""
    resolution_m: float = RESOLUTION_M
    """Of the robots' maps."""
    slam_cores: float | None = None
    """For scan matching, which then leads the robots together with navigation; ``None``: poses are given."""
    navigate_cores: float = 0.0
    map_period_s: float = 2.0
    first: Mapping[NodeId, tuple[float, float]] = field(default_factory=dict)
    """{robot: where navigation leads it first, as `Exploration.first`}."""
    ends_at_target: bool = True
    is_slam_task: bool = False
    """Whether SLAM is a task of the fleet (`slam_task`), so that nothing of it is to be started beside."""

    @property
    def name(self) -> str:
        """The world's."""
        return f"explore {Path(self.world).name}"

    @property
    def ends_when_covered(self) -> bool:
        """A late map costs time."""
        return self.ends_at_target

    def truth(self) -> Grid:
        """What can be seen of the world."""
        return load_world(self.world).truth()

    def frames(self, robots: int, seed: int) -> tuple[Pose2, ...]:
        """Where the robots start, side by side; the same for every seed."""
        del seed
        return load_world(self.world).starts(robots)

    def command(self, place: Place) -> list[str]:
        """`zsched_lab.explore.robot`."""
        command = [sys.executable, "-m", "zsched_lab.explore.robot", "--robot", place.robot, "--world", self.world]
        command += ["--index", str(place.index), "--robots", str(place.robots), "--seed", str(place.seed)]
        command += ["--endpoint", place.endpoint, "--records", str(place.records), "--speed", f"{self.speed:g}"]
        command += ["--target", f"{place.target_coverage:g}", "--resolution", f"{self.resolution_m:g}", *place.begin]
        command += [] if place.drive_s is None else ["--hold-until-s", f"{place.drive_s:.3f}"]
        if (node := self.slam_on.get(place.robot)) is None:
            return command
        command += ["--slam-on", node]
        if self.slam_cores is None:
            return command
        drift = ["--drift-yaw", f"{ODOMETRY.yaw:g}", "--drift-way", f"{ODOMETRY.way:g}"]
        task = ["--slam-task", slam_task(place.robot)] if self.is_slam_task else []
        return [*command, "--led", *drift, *task]

    def helpers(self, endpoints: Mapping[NodeId, str]) -> Sequence[tuple[NodeId, list[str]]]:
        """The robots' mapping, where it is placed on other nodes."""
        slam = [sys.executable, "-m", "zsched_lab.explore.slam", "--resolution", f"{self.resolution_m:g}"]
        navigate = [sys.executable, "-m", "zsched_lab.explore.navigate", "--cores", f"{self.navigate_cores:g}"]
        navigate += ["--speed", f"{self.speed:g}"]
        if self.slam_cores is not None:
            slam += ["--match", f"{self.slam_cores:g}", "--map-period", f"{self.map_period_s:g}"]
        firsts = self._firsts()
        modules: list[tuple[list[str], Mapping[NodeId, list[str]]]] = [] if self.is_slam_task else [(slam, {})]
        modules += [] if self.slam_cores is None else [(navigate, firsts)]
        return [
            (node, [*module, "--robot", robot, "--endpoint", endpoints[node], *own.get(robot, ())])
            for module, own in modules
            for robot, node in self.slam_on.items()
        ]

    def _firsts(self) -> Mapping[NodeId, list[str]]:
        """{robot: navigation's arguments for where it drives first}."""
        if not self.first:
            return {}  # without a look at the world
        starts = dict(zip(sorted(self.slam_on), self.frames(len(self.slam_on), 0), strict=True))
        goals = {robot: first_of(starts[robot], offset) for robot, offset in self.first.items()}
        return {robot: ["--first", *(f"{value:g}" for value in goal)] for robot, goal in goals.items()}


def slam_task(robot: NodeId) -> str:
    """The name of the task that is a robot's SLAM.

    >>> slam_task("robot1")
    'slam_robot1'
    """
    return f"slam_{robot}"
