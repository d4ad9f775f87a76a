"""Merges the robots' newest grids: which are attached, where they lie, and the one map that comes of it.

Knows: modes, the reference robot, the canvas, what every robot hears about its map. Does not know: messages, time,
threads or zenoh.

Modes: ``known`` trusts the given poses; ``track`` refines from given poses or one search; ``estimate`` searches, tracks
by ICP and searches again as the maps grow. The world frame is the frame of the given poses where the reference robot
has one, else the reference robot's own map frame. Only maps that are connected to the reference are published.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict
from enum import StrEnum
from typing import Any

from zsched.core.values.struct import Struct, field, replace
from zsched.tasks.map_merge.align import Fit, prepare
from zsched.tasks.map_merge.compose import Extent, compose, extent_of
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import MAX_CELLS, MAX_SIDE_CELLS, Grid, crop_known
from zsched.tasks.map_merge.pairs import (
    Alignment,
    MapVersion,
    Pair,
    PairBook,
    Rule,
    SearchJob,
    broken_cycle,
    spanning_transforms,
)
from zsched.tasks.map_merge.search import Estimate

MAX_ROBOTS = 64
MAX_ALIGNED_CELLS = 16_000_000
"""Largest map that is aligned, 200 m x 200 m at 0.05 m: its lookups take 20 bytes per cell."""
RESTART_RATIO = 0.5
"""A map whose known area falls under this share of its last is a new map, in a new frame."""
SNAPSHOT_SCHEMA = "zsched.map_merge.snapshot/1"


class Mode(StrEnum):
    """How transforms come about."""

    KNOWN = "known"
    TRACK = "track"
    ESTIMATE = "estimate"


class RobotState(StrEnum):
    """What became of one robot's map in the newest merge."""

    ATTACHED = "attached"
    WAITING = "waiting"  # nothing to judge yet: no map, no pose, no attempt, or its partner is not connected
    REFUSED = "refused"  # judged, and not accepted


class MergerSettings(Struct, frozen=True, kw_only=True):
    """What the operator sets; ``resolution`` of the merged map in metres per cell, ``poses`` of map frames."""

    mode: Mode
    resolution: float = 0.05
    poses: Mapping[str, Pose2] = field(default_factory=dict)
    rule: Rule = Rule()
    world_frame: str = "world"


class RobotStatus(Struct, frozen=True, kw_only=True):
    """One robot's part in the newest merge; figures are ``None`` where nothing was measured.

    ``partner`` is the robot that the figures were measured against.
    """

    robot: str
    state: RobotState
    reason: str = ""
    partner: str | None = None
    score: float | None = None
    agreeing: int | None = None
    overlap: float | None = None
    margin: float | None = None


class MergeResult(Struct, frozen=True, kw_only=True, eq=False):
    """One merge: the map (``None``: nothing to publish yet), every robot's status, and the attached map frames.

    ``transforms`` {robot: its map frame in the world}; ``inputs`` {robot: stamp_ns} and ``frames`` {robot: child
    frame of its transform} of the merged grids, while the map has no stamp yet; ``revision`` rises whenever a transform
    changed; ``is_search_due``: merge again soon, a search waits.
    """

    grid: Grid | None
    statuses: tuple[RobotStatus, ...]
    transforms: Mapping[str, Pose2]
    inputs: Mapping[str, int]
    frames: Mapping[str, str]
    reference: str | None
    revision: int
    is_search_due: bool


class Merger:
    """The state machine over grids. Not thread-safe.

    With ``searches_itself`` each merge runs at most one search that is due; else the caller takes `next_search`, runs
    it wherever it likes and brings the outcome back with `finish_search`.
    """

    def __init__(self, settings: MergerSettings, *, searches_itself: bool = True) -> None:
        self._settings = settings
        self._searches_itself = searches_itself
        self._grids: dict[str, Grid | None] = {}
        self._numbers: dict[str, int] = {}
        self._versions: dict[str, MapVersion] = {}
        self._areas: dict[str, float] = {}
        self._refusals: dict[str, str] = {}
        """{robot: why its newest map is not taken}; an older one may be in the merged map."""
        hints = dict(settings.poses) if settings.mode is Mode.TRACK else {}
        self._pairs = PairBook(
            rule=settings.rule,
            resolution=settings.resolution,
            hints=hints,
            is_rechecking=settings.mode is Mode.ESTIMATE,
        )
        self._reference: str | None = None
        self._tree: frozenset[Pair] = frozenset()
        self._extent: Extent | None = None
        self._transforms: dict[str, Pose2] = {}
        self._revision = 0

    @property
    def needs_reference(self) -> bool:
        """Whether the next merge chooses the reference robot: worth waiting a moment for the lowest name."""
        return self._reference is None and self._settings.mode is not Mode.KNOWN

    @property
    def searches(self) -> int:
        """How many searches ran so far: merges with one take a hundred times longer."""
        return self._pairs.searches

    def update(self, robot: str, grid: Grid) -> str:
        """Take a robot's newest grid; returns why it is not taken (empty: taken)."""
        if robot not in self._grids and len(self._grids) >= MAX_ROBOTS:
            return f"more than {MAX_ROBOTS} robots"
        cropped = crop_known(grid)
        if cropped is not None and (refusal := self._too_large(cropped)):
            self._refusals[robot] = refusal
            return refusal
        self._refusals.pop(robot, None)
        area = 0.0 if cropped is None else cropped.known_area_m2
        if area < RESTART_RATIO * self._areas.get(robot, 0.0):
            self._pairs.forget(robot)
        self._grids[robot] = cropped
        self._areas[robot] = area
        self._numbers[robot] = self._numbers.get(robot, 0) + 1
        return ""

    def _too_large(self, grid: Grid) -> str:
        """Why the grid is too large for this merger at its own resolution, empty when it is not."""
        most = MAX_CELLS if self._settings.mode is Mode.KNOWN else MAX_ALIGNED_CELLS
        ratio = grid.resolution / self._settings.resolution
        cells = grid.width * grid.height * ratio**2
        if cells <= most and max(grid.width, grid.height) * ratio <= MAX_SIDE_CELLS:
            return ""
        size = f"{grid.width * grid.resolution:.0f} m x {grid.height * grid.resolution:.0f} m"
        return f"its map of {size} is too large at {self._settings.resolution:g} m per cell (see --resolution)"

    def remove(self, robot: str) -> None:
        """Leave a robot's map out from now on (its stream was deleted).

        Its alignments stay: others may be connected through it, and it may come back in the same frame.
        """
        for known in (self._grids, self._versions, self._refusals):
            known.pop(robot, None)

    def merge(self) -> MergeResult:
        """Bring the alignments up to date and lay the connected maps over each other."""
        grids = {robot: grid for robot, grid in sorted(self._grids.items()) if grid is not None}
        if self._reference is None and self._settings.mode is not Mode.KNOWN:
            self._reference = next(iter(grids), None)
        is_search_due = False
        if self._settings.mode is Mode.KNOWN:
            transforms = {robot: self._settings.poses[robot] for robot in grids if robot in self._settings.poses}
        else:
            is_search_due = self._align(grids)
            transforms = self._connected()
        attached, oversize = self._fitting(grids, transforms)
        grid = self._compose(grids, attached)
        if attached != self._transforms:
            self._transforms, self._revision = attached, self._revision + 1
        return MergeResult(
            grid=grid,
            statuses=tuple(self._status(robot, attached, oversize) for robot in sorted(self._robots())),
            transforms=attached,
            inputs={robot: grids[robot].stamp_ns for robot in attached},
            frames={robot: _child_frame(robot, grids[robot].frame_id) for robot in attached},
            reference=self._reference,
            revision=self._revision,
            is_search_due=is_search_due,
        )

    def next_search(self) -> SearchJob | None:
        """The search that is due most, as of the newest merge; ``None`` when none is."""
        maps = {robot: version for robot, version in self._versions.items() if self._grids.get(robot) is not None}
        return self._pairs.next_search(maps)

    def finish_search(self, job: SearchJob, found: Estimate | None) -> None:
        """Bring back what a search found; the next merge uses it."""
        self._pairs.finish_search(job, found)

    def snapshot(self) -> bytes:
        """The transforms as bytes, for the next owner: it then tracks instead of searching again."""
        edges = [{"pair": edge.pair, "margin": edge.margin, "fit": asdict(edge.fit)} for edge in self._pairs.accepted]
        state = {
            "schema": SNAPSHOT_SCHEMA,
            "mode": self._settings.mode.value,
            "resolution": self._settings.resolution,
            "reference": self._reference,
            "revision": self._revision,
            "extent": None if self._extent is None else asdict(self._extent),
            "edges": edges,
            "areas": self._areas,
        }
        return json.dumps(state).encode()

    def restore(self, snapshot: bytes) -> str:
        """Take over a previous owner's transforms; returns why they are not taken (empty: taken).

        An owner that comes back takes them over too: the robots have followed its predecessor's map meanwhile, and a
        robot may have started again in another frame. So what it had accepted itself is over. The
        canvas then covers what either had, unless the world frame is another.
        """
        try:
            state = json.loads(snapshot)
            if state["schema"] != SNAPSHOT_SCHEMA:
                return f"snapshot of schema {state['schema']!r}"
            if (state["mode"], state["resolution"]) != (self._settings.mode.value, self._settings.resolution):
                return "snapshot of another mode or resolution"
            edges = [_edge(raw) for raw in state["edges"]]
            extent = None if state["extent"] is None else Extent(**{k: int(v) for k, v in state["extent"].items()})
            reference = None if state["reference"] is None else str(state["reference"])
            revision = int(state["revision"])
            areas = {str(robot): float(area) for robot, area in state.get("areas", {}).items()}
        except (ValueError, OverflowError, TypeError, KeyError, AttributeError, RecursionError) as error:
            return f"malformed snapshot: {error!r}"
        if extent is not None and (extent.is_too_large or extent.width <= 0 or extent.height <= 0):
            return "malformed snapshot: extent"
        if len(areas) > MAX_ROBOTS or not all(0.0 <= area < math.inf for area in areas.values()):
            return "malformed snapshot: areas"
        self._pairs.take_over(edges)
        self._areas = areas
        if reference is None and extent is None:
            return ""  # the predecessor never had a map
        is_same_world = self._reference in {None, reference}
        if is_same_world:
            both = self._extent if extent is None else extent.union(self._extent)
            extent = extent if both is not None and both.is_too_large else both
        self._extent, self._reference, self._revision = extent, reference, max(revision, self._revision)
        return ""

    def _robots(self) -> set[str]:
        return {*self._grids, *self._settings.poses, *self._refusals}

    def _align(self, grids: Mapping[str, Grid]) -> bool:
        """Bring all pairs up to date; returns whether a search is still due."""
        for robot, grid in grids.items():
            number = self._numbers[robot]
            if robot not in self._versions or self._versions[robot].number != number:
                self._versions[robot] = MapVersion(
                    number=number, walls=prepare(grid, self._settings.resolution), area_m2=self._areas[robot]
                )
        maps = {robot: self._versions[robot] for robot in grids}
        self._pairs.refresh(maps)
        if self._searches_itself and (job := self._pairs.next_search(maps)) is not None:
            self._pairs.finish_search(job, job.run())
        while (broken := broken_cycle(self._pairs.accepted, self._centre)) is not None:
            self._pairs.refuse(*broken)
        return self._pairs.is_search_due(maps)

    def _centre(self, robot: str) -> tuple[float, float]:
        version = self._versions.get(robot)
        return (0.0, 0.0) if version is None else version.walls.centre

    def _connected(self) -> dict[str, Pose2]:
        """The map frames of the reference's component in the world."""
        if self._reference is None:
            return {}
        world_t_reference = self._settings.poses.get(self._reference, Pose2())
        poses, self._tree = spanning_transforms(self._reference, self._pairs.accepted, self._tree)
        return {robot: world_t_reference.compose(pose) for robot, pose in poses.items()}

    def _fitting(
        self, grids: Mapping[str, Grid], transforms: Mapping[str, Pose2]
    ) -> tuple[dict[str, Pose2], frozenset[str]]:
        """The transforms of the maps that fit on the canvas (grown for them), and the robots whose map does not."""
        attached: dict[str, Pose2] = {}
        oversize: set[str] = set()
        for robot in sorted(transforms, key=lambda name: (name != self._reference, name)):
            if robot not in grids:
                continue
            part = extent_of(grids[robot], transforms[robot], self._settings.resolution)
            grown = part.union(self._extent).in_blocks()
            if grown.is_too_large:
                oversize.add(robot)
                continue
            self._extent, attached[robot] = grown, transforms[robot]
        return dict(sorted(attached.items())), frozenset(oversize)

    def _compose(self, grids: Mapping[str, Grid], attached: Mapping[str, Pose2]) -> Grid | None:
        if self._extent is None or not attached:
            return None
        return compose(
            [(grids[robot], pose) for robot, pose in attached.items()],
            self._extent,
            self._settings.resolution,
            frame_id=self._settings.world_frame,
        )

    def _status(self, robot: str, attached: Mapping[str, Pose2], oversize: frozenset[str]) -> RobotStatus:
        status = self._status_of_taken(robot, attached, oversize)
        if robot not in self._refusals:
            return status
        return replace(status, state=RobotState.REFUSED, reason=self._refusals[robot])

    def _status_of_taken(self, robot: str, attached: Mapping[str, Pose2], oversize: frozenset[str]) -> RobotStatus:
        if self._grids.get(robot) is None:
            reason = "its map is empty" if robot in self._grids else "no map received yet"
            return RobotStatus(robot=robot, state=RobotState.WAITING, reason=reason)
        if robot in oversize:
            reason = "the merged map would become too large with it: check its pose, origin and size"
            return RobotStatus(robot=robot, state=RobotState.REFUSED, reason=reason)
        if self._settings.mode is Mode.KNOWN:
            if robot in attached:
                return RobotStatus(robot=robot, state=RobotState.ATTACHED, reason="by the given pose")
            return RobotStatus(robot=robot, state=RobotState.WAITING, reason="no pose given for it (--pose)")
        if robot == self._reference:
            return RobotStatus(robot=robot, state=RobotState.ATTACHED, reason="the reference")
        return self._aligned_status(robot, is_attached=robot in attached)

    def _aligned_status(self, robot: str, *, is_attached: bool) -> RobotStatus:
        """The status of a robot that needs an alignment, with the figures of the one that decides."""
        accepted = [edge for edge in self._pairs.accepted if robot in edge.pair]
        if accepted:
            in_tree = [edge for edge in accepted if edge.pair in self._tree]
            edge = max(in_tree or accepted, key=lambda e: e.fit.quality)
            state = RobotState.ATTACHED if is_attached else RobotState.WAITING
            reason = edge.reason if is_attached else "aligned, but with no robot that is connected to the reference"
            return _with_figures(robot, state, reason, edge)
        refused = self._pairs.refused_with(robot)
        if refused:
            return _with_figures(robot, RobotState.REFUSED, refused[0].reason, refused[0])
        return RobotStatus(robot=robot, state=RobotState.WAITING, reason=self._pairs.pending_reason(robot))


def _child_frame(robot: str, frame_id: str) -> str:
    """The map's own frame, where that names the robot: all robots hear the transforms, and many have a ``map``."""
    names_it = re.search(rf"(?<![A-Za-z0-9]){re.escape(robot)}(?![A-Za-z0-9])", frame_id) is not None
    return frame_id if names_it else f"{robot}/map"


def _with_figures(robot: str, state: RobotState, reason: str, edge: Alignment) -> RobotStatus:
    partner = edge.pair[0] if edge.pair[1] == robot else edge.pair[1]
    return RobotStatus(
        robot=robot,
        state=state,
        reason=reason,
        partner=partner,
        score=edge.fit.score,
        agreeing=edge.fit.agreeing,
        overlap=edge.fit.overlap,
        margin=edge.margin,
    )


def _edge(raw: dict[str, Any]) -> Alignment:
    """An accepted alignment out of a snapshot. Raises `ValueError`, `TypeError` or `KeyError` when it is none."""
    a, b = (str(name) for name in raw["pair"])
    values = raw["fit"]
    pose = Pose2(**{name: float(value) for name, value in values["a_t_b"].items()})
    score, agreeing, overlap = float(values["score"]), int(values["agreeing"]), float(values["overlap"])
    if a >= b or not pose.is_finite or not 0.0 <= score <= 1.0 or agreeing < 0 or not math.isfinite(overlap):
        raise ValueError(f"edge {a!r} - {b!r}")
    margin = None if raw["margin"] is None else float(raw["margin"])
    found = Fit(a_t_b=pose, score=score, agreeing=agreeing, overlap=overlap)
    return Alignment(pair=(a, b), fit=found, margin=margin, is_accepted=True, reason="")
