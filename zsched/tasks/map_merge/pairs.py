"""Decides which pairs of maps are aligned, and keeps the accepted alignments up to date.

Knows: the acceptance rule, when a search is worth its time, how an alignment is tracked, dropped or forgotten.
Does not know: which robot is the reference, what is published (`merger`).

Accepting is the hard part: a plausible score alone lets wrong merges through (a colonnade fits on itself one pillar
further). A found alignment is accepted when all three hold:

    score >= 0.75     agreeing wall cells >= 600 (at 0.05 m; scaled by 0.05 / resolution)     margin >= 1.3

where the margin is its quality over that of the next distinct candidate. A tracked one, or one that starts from a pose
the operator gave, has no rivals: there the first two decide, and that it stayed near its start. What was accepted once
is kept while nothing better is accepted; there is no fallback to "identity".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from zsched.core.values.struct import Struct, replace
from zsched.tasks.map_merge.align import Fit, WallMap, fit, refine
from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.search import Estimate, estimate

Pair = tuple[str, str]
"""Two robots, sorted by name."""

TRACK_REACH_M = 0.5
MAX_STEP_M = 1.0
MAX_STEP_RAD = math.radians(10.0)
"""ICP that runs farther than this from its start has left the place it was asked about."""
SEARCH_GROWTH = 1.1
"""A refused pair is searched again when either map's known area has grown by this factor since the last search."""
CHECK_GROWTH = 1.3
"""An accepted pair is searched again (mode estimate) when either map has grown by this factor."""
CONTRADICTION = 0.5
CONTRADICTIONS_TO_DROP = 5
"""A kept alignment under this score, this many times in a row, is dropped: the maps say that it is wrong."""


class Rule(Struct, frozen=True, kw_only=True):
    """The acceptance rule; ``min_agreeing`` in cells of 0.05 m."""

    min_score: float = 0.75
    min_agreeing: int = 600
    min_margin: float = 1.3

    def agreeing_at(self, resolution: float) -> int:
        """The least number of agreeing cells at ``resolution``: walls are lines, so it goes with 1 / resolution."""
        return math.ceil(self.min_agreeing * 0.05 / resolution)

    def refusal(self, found: Fit, resolution: float, margin: float | None) -> str:
        """Why the alignment is refused, empty when it is accepted; ``margin`` ``None``: there is no rival."""
        least = self.agreeing_at(resolution)
        if found.agreeing < least:
            return f"only {found.agreeing} wall cells agree, {least} are needed (too little overlap so far)"
        if found.score < self.min_score:
            return f"score {found.score:.2f} is under {self.min_score:g} (walls lie on free space)"
        if margin is not None and margin < self.min_margin:
            return f"another place fits nearly as well (margin {margin:.2f}, {self.min_margin:g} is needed)"
        return ""


class Alignment(Struct, frozen=True, kw_only=True):
    """What is known about one pair: the transform in use (if accepted), or the best refused one, with its figures.

    ``fit.a_t_b`` is the pose of the second robot's map frame in the first's. ``reason`` says why it is refused, or for
    an accepted one why the newest maps did not confirm it (empty: confirmed).
    """

    pair: Pair
    fit: Fit
    margin: float | None
    is_accepted: bool
    reason: str = ""


class _PairState(Struct):
    """The book-keeping of one pair."""

    alignment: Alignment | None = None
    versions: tuple[int, int] = (0, 0)
    """Versions of the two maps that `alignment` was last held against."""
    searched_areas: tuple[float, float] | None = None
    job: int | None = None
    """Number of the search that runs."""
    is_adopted: bool = False
    """Accepted by a previous owner, and not held against a map of this one's yet."""
    has_few_walls: bool = False
    """The newest search had nothing to judge."""
    contradictions: int = 0

    @property
    def accepted(self) -> Alignment | None:
        return self.alignment if self.alignment is not None and self.alignment.is_accepted else None


class MapVersion(Struct, frozen=True, kw_only=True, eq=False):
    """One robot's newest map, prepared, with a number that rises with every new map and its known area in m2."""

    number: int
    walls: WallMap
    area_m2: float


class SearchJob(Struct, frozen=True, kw_only=True, eq=False):
    """One search to run: pure, so it may run in any thread while merging goes on."""

    number: int
    pair: Pair
    a: WallMap
    b: WallMap
    held: Pose2 | None

    def run(self) -> Estimate | None:
        """Search; takes up to a second."""
        return estimate(self.a, self.b, self.held)


class PairBook:
    """All pairs of one merger. Not thread-safe; ``resolution`` in metres per cell is that of every prepared map."""

    def __init__(self, *, rule: Rule, resolution: float, hints: dict[str, Pose2], is_rechecking: bool) -> None:
        self._rule = rule
        self._resolution = resolution
        self._hints = hints
        self._is_rechecking = is_rechecking
        self._states: dict[Pair, _PairState] = {}
        self.searches = 0

    @property
    def accepted(self) -> tuple[Alignment, ...]:
        """The alignments in use, by pair."""
        found = (state.accepted for _pair, state in sorted(self._states.items()))
        return tuple(alignment for alignment in found if alignment is not None)

    def refused_with(self, robot: str) -> tuple[Alignment, ...]:
        """The refused attempts that involve ``robot``, the most agreeing first."""
        found = [state.alignment for pair, state in self._states.items() if robot in pair and state.accepted is None]
        attempts = [alignment for alignment in found if alignment is not None]
        return tuple(sorted(attempts, key=lambda alignment: -alignment.fit.quality))

    def pending_reason(self, robot: str) -> str:
        """Why a robot with a map has no judged alignment yet."""
        states = [state for pair, state in self._states.items() if robot in pair]
        if any(state.job is not None for state in states):
            return "its search is under way"
        if any(state.has_few_walls for state in states):
            return "the maps have too few walls so far"
        return "its map waits for a search"

    def take_over(self, alignments: Iterable[Alignment]) -> None:
        """Take over the alignments that the previous owner had accepted; others of before count no more.

        They are searched again as its own would be: once a map has grown from what it is at the next `refresh`.
        """
        for state in self._states.values():
            if state.accepted is not None:
                state.alignment = None
        for one in alignments:
            self._states[one.pair] = _PairState(alignment=one, is_adopted=self._hint(one.pair) is None)

    def forget(self, robot: str) -> None:
        """Drop everything about a robot whose map frame is a new one."""
        for pair in [pair for pair in self._states if robot in pair]:
            del self._states[pair]

    def refuse(self, pair: Pair, reason: str) -> None:
        """Withdraw an accepted alignment (the circle does not close)."""
        state = self._states[pair]
        if state.alignment is not None:
            state.alignment = replace(state.alignment, is_accepted=False, reason=reason)

    def refresh(self, maps: dict[str, MapVersion]) -> None:
        """Bring every pair with a new map up to date, without searching: track what is accepted, try given poses."""
        for pair in _pairs(maps):
            state = self._states.setdefault(pair, _PairState())
            versions = (maps[pair[0]].number, maps[pair[1]].number)
            if state.versions == versions:
                continue
            state.versions = versions
            if state.is_adopted:
                state.searched_areas, state.is_adopted = (maps[pair[0]].area_m2, maps[pair[1]].area_m2), False
            a, b = maps[pair[0]].walls, maps[pair[1]].walls
            if state.accepted is not None:
                self._track(state, state.accepted, a, b)
            elif (start := self._hint(pair)) is not None:
                state.alignment = self._from_start(pair, start, a, b)

    def is_search_due(self, maps: dict[str, MapVersion]) -> bool:
        """Whether `next_search` would give one."""
        return any(self._is_due(pair, maps) for pair in _pairs(maps))

    def next_search(self, maps: dict[str, MapVersion]) -> SearchJob | None:
        """The search of the pair that waits longest for one, ``None`` when none is due.

        One at a time: a search takes up to a second, and the merge must not wait for all of them.
        """
        due = [pair for pair in _pairs(maps) if self._is_due(pair, maps)]
        if not due:
            return None
        due.sort(key=lambda pair: self._searched_area(pair) / (maps[pair[0]].area_m2 + maps[pair[1]].area_m2))
        pair = due[0]
        a, b = maps[pair[0]], maps[pair[1]]
        state = self._states.setdefault(pair, _PairState())
        state.searched_areas = (a.area_m2, b.area_m2)
        self.searches += 1
        state.job = self.searches
        held = None if state.accepted is None else state.accepted.fit.a_t_b
        return SearchJob(number=self.searches, pair=pair, a=a.walls, b=b.walls, held=held)

    def finish_search(self, job: SearchJob, found: Estimate | None) -> None:
        """Take in what a search found; nothing when the pair was forgotten meanwhile."""
        state = self._states.get(job.pair)
        if state is None or state.job != job.number:
            return
        state.job = None
        if found is None:
            state.has_few_walls = True
            return
        reason = self._rule.refusal(found.best, self._resolution, found.margin)
        if reason and state.accepted is not None:
            return  # nothing better is accepted: what was accepted stays
        state.alignment = Alignment(
            pair=job.pair, fit=found.best, margin=found.margin, is_accepted=not reason, reason=reason
        )
        state.contradictions = 0

    def _hint(self, pair: Pair) -> Pose2 | None:
        a, b = (self._hints.get(robot) for robot in pair)
        return None if a is None or b is None else a.inverse().compose(b)

    def _track(self, state: _PairState, held: Alignment, a: WallMap, b: WallMap) -> None:
        moved = self._from_start(held.pair, held.fit.a_t_b, a, b)
        if moved.is_accepted:
            state.alignment = replace(moved, margin=held.margin)
            state.contradictions = 0
            return
        kept = fit(a, b, held.fit.a_t_b)
        state.contradictions = state.contradictions + 1 if kept.score < CONTRADICTION else 0
        is_dropped = state.contradictions >= CONTRADICTIONS_TO_DROP
        reason = f"dropped: {moved.reason}" if is_dropped else f"kept, not confirmed by the newest maps: {moved.reason}"
        state.alignment = Alignment(
            pair=held.pair, fit=kept, margin=held.margin, is_accepted=not is_dropped, reason=reason
        )

    def _from_start(self, pair: Pair, start: Pose2, a: WallMap, b: WallMap) -> Alignment:
        """Refine from a start that is trusted to be near, and judge without a margin."""
        found = fit(a, b, refine(a, b, start, reach_m=TRACK_REACH_M))
        metres, radians = difference(start, found.a_t_b, b.centre)
        reason = self._rule.refusal(found, self._resolution, None)
        if metres > MAX_STEP_M or radians > MAX_STEP_RAD:
            reason = f"the walls fit only {metres:.1f} m, {math.degrees(radians):.0f} deg away from the start"
        return Alignment(pair=pair, fit=found, margin=None, is_accepted=not reason, reason=reason)

    def _is_due(self, pair: Pair, maps: dict[str, MapVersion]) -> bool:
        state = self._states.get(pair, _PairState())
        if state.accepted is None and self._hint(pair) is not None:
            return False  # the operator's pose says where to look
        if state.accepted is not None and not (self._is_rechecking or state.accepted.reason):
            return False
        if state.searched_areas is None:
            return state.accepted is None
        growth = SEARCH_GROWTH if state.accepted is None or state.accepted.reason else CHECK_GROWTH
        areas = (maps[pair[0]].area_m2, maps[pair[1]].area_m2)
        return any(now >= before * growth for now, before in zip(areas, state.searched_areas, strict=True))

    def _searched_area(self, pair: Pair) -> float:
        state = self._states.get(pair)
        return 0.0 if state is None or state.searched_areas is None else sum(state.searched_areas)


def _pairs(robots: Iterable[str]) -> list[Pair]:
    names = sorted(robots)
    return [(a, b) for index, a in enumerate(names) for b in names[index + 1 :]]


# --- the graph of accepted alignments --------------------------------------------------------------------------------

CYCLE_M = 0.5
CYCLE_RAD = math.radians(3.0)


def broken_cycle(
    accepted: Iterable[Alignment], centre_of: Callable[[str], tuple[float, float]]
) -> tuple[Pair, str] | None:
    """The weakest alignment of a triangle that does not close (within 0.5 m and 3 degrees), with the reason.

    Three alignments a->b->c->a must be the identity; held at the middle of a's map, where it matters. Call it again
    after the alignment was withdrawn, until it returns ``None``.
    """
    edges = {alignment.pair: alignment for alignment in accepted}
    robots = sorted({robot for pair in edges for robot in pair})
    for index, a in enumerate(robots):
        for b, c in _pairs(robots[index + 1 :]):
            if not ((a, b) in edges and (b, c) in edges and (a, c) in edges):
                continue
            around = edges[a, b].fit.a_t_b.compose(edges[b, c].fit.a_t_b).compose(edges[a, c].fit.a_t_b.inverse())
            metres, radians = difference(around, Pose2(), centre_of(a))
            if metres <= CYCLE_M and radians <= CYCLE_RAD:
                continue
            weakest = min((edges[a, b], edges[b, c], edges[a, c]), key=lambda edge: edge.fit.quality)
            return weakest.pair, (
                f"the circle {a} - {b} - {c} does not close ({metres:.1f} m, {math.degrees(radians):.1f} deg)"
            )
    return None


def spanning_transforms(
    reference: str, accepted: Iterable[Alignment], preferred: frozenset[Pair]
) -> tuple[dict[str, Pose2], frozenset[Pair]]:
    """The pose of every connected robot's map frame in the reference's, along the strongest alignments.

    A maximum spanning tree (Prim) by quality; pairs of the ``preferred`` tree count 1.3 times, so that two alignments
    of like strength do not take turns and shake the map.

    Returns:
        {robot: pose}, the reference included, and the pairs of the tree.
    """
    edges = list(accepted)
    poses, tree = {reference: Pose2()}, set[Pair]()
    while True:
        crossing = [edge for edge in edges if (edge.pair[0] in poses) != (edge.pair[1] in poses)]
        if not crossing:
            return poses, frozenset(tree)
        best = max(crossing, key=lambda edge: edge.fit.quality * (1.3 if edge.pair in preferred else 1.0))
        a, b = best.pair
        if a in poses:
            poses[b] = poses[a].compose(best.fit.a_t_b)
        else:
            poses[a] = poses[b].compose(best.fit.a_t_b.inverse())
        tree.add(best.pair)
