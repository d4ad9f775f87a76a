"""Runs a whole exploration in virtual time: robots and one merger in this process, merged maps a set time late.

Knows: the clock that it invents, the delay. Does not know: zenoh, processes, wall time.

The merger is the task's own (`zsched.tasks.map_merge.merger`, mode known). A merged map is made ``merge_period_s``
after the last one, once a robot's map has come since, from the newest map of each robot, and reaches the robots
``delay_s`` later. Claims arrive in the next step: they go from robot to robot, not over the merger. Everything follows
from the seed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import Merger, MergerSettings, Mode
from zsched_lab.explore.agent import Agent, RobotSettings
from zsched_lab.explore.body import Drift, Limits
from zsched_lab.explore.referee import Referee
from zsched_lab.explore.world import World
from zsched_lab.maps.mapping import RESOLUTION_M

STEP_S = 0.1
MERGE_PERIOD_S = 0.5
PATH_PERIOD_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualRun:
    """What is to be run; times in virtual seconds, ``delay_s`` from a merge to the robots.

    The drive begins after ``warm_up_s``, in which the robots stand, look and are merged; times count from there.
    ``resolution_m`` is that of the robots' maps and of the merged one. Steps take `STEP_S`: no merge is sooner.
    """

    world: World
    seed: int
    robots: int = 3
    delay_s: float = 0.0
    target: float = 0.9
    longest_s: float = 300.0
    warm_up_s: float = 0.0
    merge_period_s: float = MERGE_PERIOD_S
    resolution_m: float = RESOLUTION_M
    limits: Limits = Limits()
    drift: Drift = Drift()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VirtualResult:
    """What came of it. ``time_s`` to the target coverage of the map *as the robots have it*; ``None``: not reached."""

    time_s: float | None
    coverage: tuple[tuple[float, float], ...]
    """(t_s, share) of each merged map as it reached the robots."""
    merged: Grid | None
    paths: dict[str, tuple[Pose2, ...]]
    """True poses in the world, twice a second."""
    way_m: float
    goals: int


def run_virtual(plan: VirtualRun) -> VirtualResult:
    """Explore until the target is reached or the time is over."""
    agents = make_agents(plan)
    poses = {agent.settings.robot: agent.settings.start for agent in agents}
    merger = Merger(MergerSettings(mode=Mode.KNOWN, poses=poses, resolution=plan.resolution_m))
    referee = Referee(plan.world)
    for agent in agents:
        agent.explorer.take_transform(agent.settings.start)
    coming: deque[tuple[float, Grid]] = deque()
    seen: list[tuple[float, float]] = []
    paths: dict[str, list[Pose2]] = {robot: [] for robot in poses}
    merged: Grid | None = None
    is_merge_due, next_merge_s = False, -plan.warm_up_s
    warm_ticks = round(plan.warm_up_s / STEP_S)
    for tick in range(-warm_ticks, round(plan.longest_s / STEP_S)):
        now = tick * STEP_S
        is_merge_due |= step_robots(agents, merger, now)
        if tick % round(PATH_PERIOD_S / STEP_S) == 0:
            for agent in agents:
                paths[agent.settings.robot].append(agent.body.pose)
        if is_merge_due and now > next_merge_s - STEP_S / 2:
            is_merge_due, next_merge_s = False, max(next_merge_s + plan.merge_period_s, now)
            if (grid := merger.merge().grid) is not None:
                coming.append((now + plan.delay_s, grid))
        while coming and coming[0][0] <= now:
            merged = coming.popleft()[1]
            for agent in agents:
                agent.explorer.take_map(merged)
            seen.append((now, referee.coverage(merged)))
        if seen and seen[-1][1] >= plan.target:
            break
    return VirtualResult(
        time_s=seen[-1][0] if seen and seen[-1][1] >= plan.target else None,
        coverage=tuple(seen),
        merged=merged,
        paths={robot: tuple(path) for robot, path in paths.items()},
        way_m=sum(agent.body.way_m for agent in agents),
        goals=sum(agent.explorer.goals for agent in agents),
    )


def make_agents(plan: VirtualRun) -> tuple[Agent, ...]:
    """The robots at their starts, not in step with each other."""
    starts = plan.world.starts(plan.robots)
    return tuple(
        Agent(
            RobotSettings(
                robot=f"robot{index + 1}",
                start=start,
                seed=plan.seed,
                limits=plan.limits,
                drift=plan.drift,
                resolution_m=plan.resolution_m,
                hold_until_s=0.0 if plan.warm_up_s > 0.0 else None,
            ),
            plan.world,
            phase=index / plan.robots,
        )
        for index, start in enumerate(starts)
    )


def step_robots(agents: Sequence[Agent], merger: Merger, now: float) -> bool:
    """Let every robot act once; their maps go to the merger, their claims to each other. Whether a map has come."""
    has_map = False
    for agent in agents:
        outputs = agent.step(now, stamp_ns=round(now * 1e9))
        if outputs.grid is not None:
            merger.update(agent.settings.robot, outputs.grid)
            has_map = True
        if not outputs.is_claim_due:
            continue
        for other in agents:
            other.explorer.hear_claim(agent.settings.robot, outputs.claim, now)
    return has_map
