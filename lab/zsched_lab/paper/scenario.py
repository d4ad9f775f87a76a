"""Reads a scenario: which fleet, which nodes are weak, what is injected where and when, which radio each link follows.

Knows: the scenario file's keys, units and ranges. Does not know: schemes, processes, figures.

One scenario and one seed are one story: every scheme meets the same windows of load, the same radio, the same robots.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId
from zsched.core.values.words import check_range
from zsched.tasks.map_merge.merger import Mode
from zsched.tasks.map_merge.pairs import Rule

MATRIX = "matrix"
"""The block of the scenario itself: all schemes at its level, and the sweep over the others."""
MAX_CORES = 1.5
"""The nodes' quotas together, so that robots, daemons and the lab itself find CPU on a machine with two cores."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeShare:
    """What one node may use: ``cpu_cores`` (quota), ``memory_mb`` (limit); ``ballast_mb`` is taken from the start.

    ``overhead_cores`` come on top of the quota: what zsched's own processes take there while nothing happens, where
    ``cpu_cores`` is to be there for the tasks alone. ``work_cores`` come on top for the tasks: what their programs take
    beyond the shares of ``cpu_cores`` that the scenario gives them, which is another part on every machine.
    """

    cpu_cores: float
    memory_mb: float
    ballast_mb: float = 0.0
    overhead_cores: float = 0.0
    work_cores: float = 0.0

    def __post_init__(self) -> None:
        check_range("cpu_cores", self.cpu_cores, 0.05, MAX_CORES)
        check_range("memory_mb", self.memory_mb, 128.0, 1e6)
        check_range("ballast_mb", self.ballast_mb, 0.0, self.memory_mb)
        check_range("overhead_cores", self.overhead_cores, 0.0, MAX_CORES)
        check_range("work_cores", self.work_cores, 0.0, MAX_CORES)

    @property
    def quota_cores(self) -> float:
        """What the node's group may use in all."""
        return self.cpu_cores + self.work_cores + self.overhead_cores


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadLevel:
    """How strong one injected load is: how many models (camera ``streams``), each taking ``share`` of an edge's CPU.

    ``share`` is of the largest quota among the nodes (0: all that it can get), so a weak edge is filled by what a
    strong one bears. ``side`` is the frame's side in pixels (a multiple of 32); ``memory_mb`` what such a process
    takes, for the oracle.
    """

    streams: int = 1
    share: float = 0.6
    side: int = 640
    memory_mb: float = 189.0

    def __post_init__(self) -> None:
        check_range("streams", self.streams, 1, 64)
        check_range("share", self.share, 0.0, 1.0)
        check_range("side", self.side, 32, 4096)
        check_range("memory_mb", self.memory_mb, 0.0, 1e6)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadPlan:
    """When load comes: in each of ``lanes``, windows of ``busy_s`` and pauses of ``idle_s`` (low, high) alternate.

    Two lanes never load one node at a time; the first windows begin after ``first_s``.
    """

    lanes: int = 2
    busy_s: tuple[float, float] = (10.0, 16.0)
    idle_s: tuple[float, float] = (2.0, 5.0)
    first_s: float = 4.0

    def __post_init__(self) -> None:
        check_range("lanes", self.lanes, 0, 64)
        check_range("first_s", self.first_s, 0.0, 3600.0)
        for name in ("busy_s", "idle_s"):
            low, high = getattr(self, name)
            check_range(name, low, 0.0, 3600.0)
            check_range(name, high, low, 3600.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Radio:
    """The recorded drive that a node's link follows: ``file`` within the folder of drives, from ``offset_s`` on."""

    file: str
    column: str = "c_rssi"
    offset_s: float = 0.0


class LinkView(StrEnum):
    """``access_point``: each node knows its own way to the access point; what a pair is worth, the task's `link` says.

    ``direct``: every node hears each other node's signal itself, so that a candidate's signal is the same for all
    (the paper's Eq. 3 has one signal per candidate).
    """

    ACCESS_POINT = "access_point"
    DIRECT = "direct"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exploration:
    """The closed loop: ``world`` by its name, ``speed`` in m/s; the run ends at the target, or after ``duration_s``.

    ``{seed}`` in ``world`` is the run's seed: each run has a world of its own, the same for all schemes.
    """

    world: str = "office:{seed}"
    speed: float = 1.0
    duration_s: float = 50.0
    target_coverage: float = 0.8
    slam_on: Mapping[NodeId, NodeId] = field(default_factory=dict)
    """{robot: the node that maps for it, inside its share}, as the paper places SLAM on the edges."""
    slam_share: float | None = None
    """Of a whole edge's CPU, for scan matching that gives the robot its pose; ``None``: poses are given."""
    navigate_share: float = 0.0
    """Of a whole edge's CPU, for the planning beside such a SLAM: it plans again as often as that allows."""
    map_period_s: float = 2.0
    """From one map of such a SLAM to the next."""
    first: Mapping[NodeId, tuple[float, float]] = field(default_factory=dict)
    """{robot that such a SLAM leads: where it drives first, [x, y] m from its start in the world's directions}."""
    ends_at_target: bool = True
    """Whether a run is over when every robot holds the target; else it takes its whole time."""

    def __post_init__(self) -> None:
        check_range("explore.speed", self.speed, 0.01, 5.0)
        check_range("explore.duration_s", self.duration_s, 5.0, 600.0)
        check_range("explore.target_coverage", self.target_coverage, 0.01, 1.0)
        check_range("explore.navigate_share", self.navigate_share, 0.0, 1.0)
        check_range("explore.map_period_s", self.map_period_s, 0.1, 60.0)
        if self.slam_share is not None:
            check_range("explore.slam_share", self.slam_share, 0.0, 1.0)
            if not self.slam_on:
                raise ValueError("explore.slam_share: say which node maps for which robot (explore.slam_on)")
        for robot, offset in self.first.items():
            if self.slam_share is None or robot not in self.slam_on:
                raise ValueError(f"explore.first: {robot} is led by no SLAM (explore.slam_share, explore.slam_on)")
            if len(offset) != 2:
                raise ValueError(f"explore.first: {robot}: give [x, y] in m, not {list(offset)}")
            for value in offset:
                check_range("explore.first", value, -100.0, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """What every node's link carries, each way, in Mbit/s (``None``: as much as the machine); needs namespaces."""

    bandwidth_mbit: float | None = None

    def __post_init__(self) -> None:
        if self.bandwidth_mbit is not None:
            check_range("links.bandwidth_mbit", self.bandwidth_mbit, 0.1, 1e5)


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeTask:
    """The task itself: the merger's ``mode``, at most ``rate_hz`` maps a second, ``resolution_m`` of maps and merge.

    ``min_agreeing``: the wall cells (of 0.05 m) that must agree before two maps are joined; small worlds have few.
    With ``mode: estimate`` the merger knows where the first robot started, and nothing of the others.
    """

    mode: str = "known"
    rate_hz: float = 4.0
    resolution_m: float = 0.05
    min_agreeing: int = Rule().min_agreeing

    def __post_init__(self) -> None:
        Mode(self.mode)
        check_range("merge.rate_hz", self.rate_hz, 0.1, 100.0)
        check_range("merge.resolution_m", self.resolution_m, 0.01, 1.0)
        check_range("merge.min_agreeing", self.min_agreeing, 1, 100_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Rows of their own beside the matrix: these schemes, how many runs, and what is different there."""

    schemes: tuple[str, ...] = ()
    runs: int = 2
    world: str | None = None
    """``None``: the scenario's."""
    level: str | None = None
    """``None``: the scenario's."""
    links: LinkLimits = LinkLimits()
    merge: Mapping[str, Any] = field(default_factory=dict)
    """What is different in `Scenario.merge`."""
    alternates: bool = False
    """Whether every second run takes the schemes in reverse, so that a machine that drifts favours none of them."""

    def __post_init__(self) -> None:
        check_range("runs", self.runs, 1, 1000)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """The strength of the injected load over all levels: these schemes, how many runs each."""

    schemes: tuple[str, ...] = ()
    runs: int = 2

    def __post_init__(self) -> None:
        check_range("sweep.runs", self.runs, 1, 1000)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One evaluation, but for the scheme and the number of the run.

    ``duration_s`` counts from the robots' start; ``target_coverage`` ends the task (share of the truth's known cells,
    at every robot); ``pressure_limit`` is the share of time in which processes outside the nodes' quotas may have
    waited for a CPU: above it the run is invalid. For ``warm_up_s`` before the drive the robots stand and map, so that
    the task runs and is measured; nothing of that counts.
    """

    name: str
    fleet: Path
    duration_s: float
    seed: int
    runs: int
    """Of each scheme of the paper and of ours."""
    level: str
    levels: Mapping[str, LoadLevel]
    schemes: tuple[str, ...] = ()
    """Those of the matrix; none: all."""
    yardstick_runs: int = 3
    sweep: Sweep = Sweep()
    explore: Exploration = Exploration()
    blocks: Mapping[str, Block] = field(default_factory=dict)
    nodes: Mapping[NodeId, NodeShare] = field(default_factory=dict)
    load: LoadPlan = LoadPlan()
    links: Mapping[NodeId, Radio] = field(default_factory=dict)
    link_view: LinkView = LinkView.ACCESS_POINT
    merge: MergeTask = MergeTask()
    target_coverage: float = 0.9
    pressure_limit: float = 0.2
    idle_floor: float = 0.0
    """A run is invalid, too, when the machine idled for less of the time than this: it could not keep its quotas."""
    warm_up_s: float = 0.0
    main: str = MATRIX
    """What is judged: the matrix, or a block; with a block there is no matrix and no sweep."""
    quick: str = MATRIX
    """What ``--quick`` runs when the robots explore."""

    def __post_init__(self) -> None:
        check_range("duration_s", self.duration_s, 5.0, 600.0)
        check_range("runs", self.runs, 1, 1000)
        check_range("yardstick_runs", self.yardstick_runs, 1, 1000)
        check_range("target_coverage", self.target_coverage, 0.01, 1.0)
        check_range("pressure_limit", self.pressure_limit, 0.0, 1.0)
        check_range("idle_floor", self.idle_floor, 0.0, 1.0)
        check_range("warm_up_s", self.warm_up_s, 0.0, 600.0)
        total = sum(share.quota_cores for share in self.nodes.values())
        if total > MAX_CORES:
            raise ValueError(f"nodes: quotas of {total:g} cores in all, at most {MAX_CORES:g}")
        if self.level not in self.levels:
            raise ValueError(f"level: {self.level!r} is none of {', '.join(self.levels)}")
        doubled = sorted(({*self.levels, MATRIX}) & self.blocks.keys())
        if doubled:
            raise ValueError(f"blocks: {', '.join(doubled)} is taken; choose another name")
        for name, block in self.blocks.items():
            if block.level not in (None, *self.levels):
                raise ValueError(f"blocks: {name}: level {block.level!r} is none of {', '.join(self.levels)}")
            replace(self.merge, **block.merge)

    @property
    def full_cores(self) -> float:
        """The quota of the strongest node: a whole edge; 0 without nodes."""
        return max((share.cpu_cores for share in self.nodes.values()), default=0.0)

    def run_seed(self, run: int) -> int:
        """The seed of run ``run``: the same for every scheme and level."""
        return self.seed + run


def load_scenario(path: Path) -> Scenario:
    """Read a scenario file.

    Raises:
        ConfigError: it cannot be read, a key is unknown or missing, or a value is out of range; says which.
    """
    try:
        tree = YAML(typ="safe").load(path)
    except Exception as error:
        raise ConfigError(f"{path}: not readable as a scenario: {error}") from error
    if not isinstance(tree, dict):
        raise ConfigError(f"{path}: no scenario in it; see configs/lab/paper.scenario.yml")
    try:
        return _scenario(path, dict(tree))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}; see configs/lab/paper.scenario.yml") from error


def _scenario(path: Path, tree: dict[str, Any]) -> Scenario:
    fleet = path.parent / str(tree.pop("fleet", "fleet.yaml"))
    levels = {str(name): LoadLevel(**spec) for name, spec in dict(tree.pop("levels", None) or {}).items()}
    nodes = {str(name): NodeShare(**spec) for name, spec in dict(tree.pop("nodes", None) or {}).items()}
    links = {str(name): Radio(**spec) for name, spec in dict(tree.pop("links", None) or {}).items()}
    load, sweep = LoadPlan(**_tuples(tree.pop("load", {}))), Sweep(**_tuples(tree.pop("sweep", {})))
    view = LinkView(tree.pop("link_view", LinkView.ACCESS_POINT))
    rows = {str(name): _block(dict(spec)) for name, spec in dict(tree.pop("blocks", None) or {}).items()}
    loop = dict(tree.pop("explore", None) or {})
    explore = Exploration(**{**loop, "first": _tuples(loop.get("first") or {})})
    merge = MergeTask(**dict(tree.pop("merge", None) or {}))
    known = {str(name): value for name, value in _tuples(tree).items()}
    blocks: dict[str, Any] = {"levels": levels, "nodes": nodes, "links": links, "link_view": view, "blocks": rows}
    for key in ("main", "quick"):
        if known.get(key, MATRIX) not in (MATRIX, *rows):
            raise ValueError(f"{key}: {known[key]!r} is none of {', '.join((MATRIX, *rows))}")
    return Scenario(fleet=fleet, load=load, sweep=sweep, explore=explore, merge=merge, **blocks, **known)


def _block(spec: dict[str, Any]) -> Block:
    return Block(links=LinkLimits(**dict(spec.pop("links", None) or {})), **_tuples(spec))


def _tuples(tree: Any) -> dict[str, Any]:
    return {str(name): tuple(value) if isinstance(value, list) else value for name, value in dict(tree or {}).items()}
