"""Decides where one robot drives: the frontier on the merged map, the way there, the velocity of this moment.

Knows: the newest merged map and where the robot stands in it, others' claims, time as an argument. Does not know: the
robot's own map, the truth, zenoh.

    WAITING    no merged map yet, or the merger has not placed this robot's map: the robot stands
    DRIVING    on its way to a frontier
    IDLE       the newest merged map has no frontier that this robot can reach and has not just been at

The only map it has is the one that comes back from the merger. On a late map it drives on to places that it or others
have long seen, and stands when it has been at all of them: that is what a slow merger costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.body import Limits, Twist
from zsched_lab.explore.follower import BACK_S, BACK_SPEED, next_corner, towards
from zsched_lab.explore.frontier import Claim, Frontier, choose, find_frontiers
from zsched_lab.explore.planner import PlanMap, Point, distances, plan_map, way_to

PLAN_PERIOD_S = 0.5
"""Plans at most this often, and only for a reason: a new map, a reached goal, a wall."""
REACHED_M = 0.4
AVOID_S = 8.0
"""A frontier that the robot has been at, or could not get to, does not count for this long, ..."""
AVOID_M = 8.0
"""... or for as long as a slow robot needs for this way: else it is back before it has got anywhere."""
CLAIM_LIFE_S = 3.0


class State(StrEnum):
    """What the robot does."""

    WAITING = "waiting"
    DRIVING = "driving"
    IDLE = "idle"


def avoid_s(limits: Limits) -> float:
    """How long a robot of these limits is to avoid a frontier, in s.

    >>> avoid_s(Limits(speed=1.0)), round(avoid_s(Limits(speed=0.22)), 1)
    (8.0, 36.4)
    """
    return max(AVOID_S, AVOID_M / limits.speed)


def first_of(start: Pose2, offset: Point) -> Point:
    """Where a robot at ``start`` drives first, in its map frame: ``offset`` away in the world's directions.

    >>> first_of(Pose2(x=4.0, yaw=math.pi), (3.0, 0.0))
    (-3.0, 0.0)
    """
    x, y = start.inverse().apply_point(start.x + offset[0], start.y + offset[1])
    return round(x, 3), round(y, 3) + 0.0


@dataclass(slots=True)
class _Goal:
    frontier: Frontier
    way: tuple[Point, ...]
    next: int = 0


class Explorer:
    """One robot's explorer; all points are in the merged frame, but poses that are handed in by `step`."""

    def __init__(self, robot: str, limits: Limits, avoid_s: float = AVOID_S, first: Point | None = None) -> None:
        """``avoid_s``: for how long a frontier does not count that the robot has been at, or could not get to.

        ``first``: where it drives before it chooses by itself, straight, in its own map frame; a wall ends that, too.
        """
        self._robot = robot
        self._first = first
        self._avoid_s = avoid_s
        self._limits = limits
        self._map: Grid | None = None
        self._plan: PlanMap | None = None
        self._merged_t_map: Pose2 | None = None
        self._claims: dict[str, tuple[float, Claim]] = {}
        self._avoided: list[tuple[float, Point]] = []
        self._goal: _Goal | None = None
        self._is_due = False
        self._next_plan_s = float("-inf")
        self._back_until_s = float("-inf")
        self.state = State.WAITING
        self.goals = 0
        """How many goals it has set out for."""

    @property
    def goal(self) -> Point | None:
        """Where it drives to."""
        return None if self._goal is None else self._goal.frontier.point

    @property
    def claim(self) -> Claim | None:
        """What to tell the others; ``None``: it goes nowhere."""
        if self._goal is None:
            return None
        x, y = self._goal.frontier.point
        return Claim(robot=self._robot, x=x, y=y, way_m=round(self._goal.frontier.way_m, 2))

    @property
    def way(self) -> tuple[Point, ...]:
        """The corners of the way that are still ahead; none: it goes nowhere."""
        if self._first is not None and self._merged_t_map is not None:
            return (self._merged_t_map.apply_point(*self._first),)
        return () if self._goal is None else self._goal.way[self._goal.next :]

    def take_map(self, grid: Grid) -> None:
        """The newest merged map."""
        self._map, self._is_due = grid, True

    def look_again(self) -> None:
        """Plan again on the map that it has."""
        self._is_due = self._map is not None

    def take_transform(self, merged_t_map: Pose2) -> None:
        """Where the merger has placed this robot's map frame."""
        self._merged_t_map = merged_t_map

    def hear_claim(self, robot: str, claim: Claim | None, now: float) -> None:
        """A robot's newest word: what it claims; ``None``: it goes nowhere."""
        if claim is None:
            self._claims.pop(robot, None)
        elif robot != self._robot:
            self._claims[robot] = (now, claim)

    def step(self, pose: Pose2, now: float, *, is_blocked: bool = False) -> Twist:
        """The velocity for this moment; ``pose`` is what the robot believes, in its own map frame."""
        if self._map is None or self._merged_t_map is None:
            return Twist()
        if self._first is not None:
            if not is_blocked and math.dist((pose.x, pose.y), self._first) >= REACHED_M:
                return towards(self._first, pose, self._limits)
            self._first, self._is_due = None, True
        here = self._merged_t_map.compose(pose)
        self._notice(here, now, is_blocked=is_blocked)
        if self._is_due and now >= self._next_plan_s:
            self._next_plan_s = now + PLAN_PERIOD_S
            self._is_due = False
            self._decide(here)
        if now < self._back_until_s:
            return Twist(speed=BACK_SPEED * self._limits.speed)
        return Twist() if self._goal is None else self._follow(self._goal, here)

    def _notice(self, here: Pose2, now: float, *, is_blocked: bool) -> None:
        """Goals that are reached, walls that are met, words that are too old."""
        self._avoided = [(until, point) for until, point in self._avoided if until > now]
        self._claims = {robot: kept for robot, kept in self._claims.items() if now - kept[0] < CLAIM_LIFE_S}
        if self._goal is None or now < self._back_until_s:
            return
        if is_blocked:
            self._back_until_s = now + BACK_S
        end = self._goal.way[-1]
        if is_blocked or math.dist((here.x, here.y), end) < REACHED_M:
            self._avoided.append((now + self._avoid_s, self._goal.frontier.point))
            self._goal, self._is_due = None, True

    def _decide(self, here: Pose2) -> None:
        """Choose a frontier on the newest merged map, and the way to it."""
        assert self._map is not None
        self._plan = plan_map(self._map)
        field = distances(self._plan, (here.x, here.y))
        claims = [claim for _, claim in self._claims.values()]
        mine = self.claim
        # Of two that go to one place the nearer one stays. If both gave way, both would come back, again and again.
        taken = [one for one in claims if mine is None or not one.contests(mine) or one.goes_before(mine)]
        frontiers = find_frontiers(self._plan, field, [(claim.x, claim.y) for claim in taken])
        before = self.goal
        chosen = choose(self._robot, frontiers, claims, before, [point for _, point in self._avoided])
        way = () if chosen is None else way_to(self._plan, field, chosen.cell)
        if chosen is None or not way:
            self._goal, self.state = None, State.IDLE
            self._is_due = bool(self._avoided)  # what it avoids now counts again soon
            return
        if before is None or math.dist(before, chosen.point) > REACHED_M:
            self.goals += 1
        self._goal, self.state = _Goal(frontier=chosen, way=way), State.DRIVING

    def _follow(self, goal: _Goal, here: Pose2) -> Twist:
        """Towards the next corner of the way."""
        goal.next = next_corner(goal.way, goal.next, here)
        return towards(goal.way[goal.next], here, self._limits)
