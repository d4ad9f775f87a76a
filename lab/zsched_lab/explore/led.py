"""Runs robots that SLAM and navigation lead in virtual time, as if every edge had all the CPU that they want.

Knows: the clock that it invents, the parts of the loop. Does not know: zenoh, processes, edges, wall time.

The parts are those of the live loop: laser, scan matching (its least work), the merger by ``estimate``, the explorer.
Nothing is ever late, so no placing can bring robots further: it is the ceiling of coverage over time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.merger import Merger, MergerSettings, Mode
from zsched.tasks.map_merge.pairs import Rule
from zsched_lab.explore.agent import CLAIM_PERIOD_S, Agent, RobotSettings
from zsched_lab.explore.body import Drift, Limits
from zsched_lab.explore.explorer import Explorer, avoid_s, first_of
from zsched_lab.explore.laser import LaserScan
from zsched_lab.explore.planner import Point
from zsched_lab.explore.referee import Referee
from zsched_lab.explore.slam_state import Slam, SlamSettings
from zsched_lab.explore.world import World

STEP_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class LedRun:
    """What is to be run; times in virtual seconds. The drive begins after ``warm_up_s``."""

    world: World
    seed: int
    robots: int = 3
    duration_s: float = 300.0
    warm_up_s: float = 0.0
    merge_period_s: float = 2.0
    map_period_s: float = 2.0
    min_agreeing: int = Rule().min_agreeing
    limits: Limits = Limits()
    drift: Drift = Drift()
    first: Mapping[str, Point] = field(default_factory=dict)
    """{robot: where it drives first, as far from its start in the world's directions}; others choose by themselves."""


@dataclass(slots=True, eq=False)
class _Robot:
    """One robot with its SLAM and its navigation."""

    agent: Agent
    slam: Slam
    navigation: Explorer
    placed: Pose2 | None = None
    """Where the merger has placed its map; ``None``: not yet."""
    is_blocked: bool = False
    errors_m: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True, kw_only=True)
class LedResult:
    """What came of it: (t_s, share of the world) of each merged map, and each robot's largest error of its pose (m)."""

    coverage: tuple[tuple[float, float], ...]
    pose_error_m: tuple[float, ...]
    placed: int
    """How many robots the merger has placed."""
    duration_s: float

    @property
    def mean(self) -> float:
        """The mean coverage over the drive: each map holds until the next."""
        held, total, at_s = 0.0, 0.0, 0.0
        for t_s, share in self.coverage:
            if t_s > 0.0:
                total, at_s = total + held * (t_s - at_s), t_s
            held = share
        return (total + held * (self.duration_s - at_s)) / self.duration_s


def run_led(plan: LedRun) -> LedResult:
    """Explore for the plan's time."""
    referee, robots = Referee(plan.world), _robots(plan)
    first = next(iter(robots))
    rule = Rule(min_agreeing=plan.min_agreeing)
    poses = {first: robots[first].agent.settings.start}
    merger = Merger(MergerSettings(mode=Mode.ESTIMATE, poses=poses, rule=rule))
    seen: list[tuple[float, float]] = []
    for tick in range(round((plan.warm_up_s + plan.duration_s) / STEP_S)):
        now = tick * STEP_S
        for name, robot in robots.items():
            _step(robot, name, merger, now)
        if tick % round(CLAIM_PERIOD_S / STEP_S) == 0:
            _claim(robots, now)
        if tick % round(plan.merge_period_s / STEP_S) == round(plan.merge_period_s / STEP_S) // 2:
            result = merger.merge()
            if result.grid is None:
                continue
            seen.append((now - plan.warm_up_s, referee.coverage(result.grid)))
            for name, pose in result.transforms.items():
                robots[name].placed = pose
                robots[name].navigation.take_transform(pose)
                robots[name].navigation.take_map(result.grid)
    return LedResult(
        coverage=tuple(seen),
        pose_error_m=tuple(max(robot.errors_m, default=0.0) for robot in robots.values()),
        placed=sum(robot.placed is not None for robot in robots.values()),
        duration_s=plan.duration_s,
    )


def _robots(plan: LedRun) -> dict[str, _Robot]:
    found = {}
    for index, start in enumerate(plan.world.starts(plan.robots)):
        name = f"robot{index + 1}"
        first = first_of(start, plan.first[name]) if name in plan.first else None
        settings = RobotSettings(
            robot=name,
            start=start,
            seed=plan.seed,
            limits=plan.limits,
            drift=plan.drift,
            has_slam=False,
            is_led=True,
            hold_until_s=plan.warm_up_s,
        )
        found[name] = _Robot(
            agent=Agent(settings, plan.world, phase=index / plan.robots),
            slam=Slam(SlamSettings(robot=name, map_period_s=plan.map_period_s)),
            navigation=Explorer(name, plan.limits, avoid_s(plan.limits), first),
        )
    return found


def _step(robot: _Robot, name: str, merger: Merger, now: float) -> None:
    """Let one robot act once; what it sees goes through SLAM and navigation at once."""
    stamp_ns = round(now * 1e9) + 1
    agent = robot.agent
    scan = agent.step(now, stamp_ns).scan
    robot.is_blocked |= agent.body.is_blocked
    if scan is not None:
        _lead(robot, name, merger, scan, now)


def _lead(robot: _Robot, name: str, merger: Merger, scan: LaserScan, now: float) -> None:
    agent, navigation = robot.agent, robot.navigation
    correction = robot.slam.take(scan, agent.body.belief)
    agent.localizer.take(correction.stamp_ns, correction.pose)
    if (grid := robot.slam.due_map(now)) is not None:
        merger.update(name, grid)
        if robot.placed is None:  # on its own map, until it is placed
            navigation.take_map(grid)
            navigation.take_transform(Pose2())
    navigation.step(correction.pose, now, is_blocked=robot.is_blocked)
    robot.is_blocked = False
    map_t_merged = (robot.placed or Pose2()).inverse()
    agent.follower.take_way(tuple(map_t_merged.apply_point(x, y) for x, y in navigation.way))
    believed, true = agent.settings.start.compose(agent.belief), agent.body.pose
    robot.errors_m.append(((believed.x - true.x) ** 2 + (believed.y - true.y) ** 2) ** 0.5)


def _claim(robots: dict[str, _Robot], now: float) -> None:
    """Robots that are placed tell each other where they go."""
    placed = {name: robot for name, robot in robots.items() if robot.placed is not None}
    for name, robot in placed.items():
        claim = robot.navigation.claim
        for other in placed.values():
            other.navigation.hear_claim(name, claim, now)
