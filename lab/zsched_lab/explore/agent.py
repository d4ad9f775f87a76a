"""One simulated robot in one piece: body, laser, mapping and explorer, stepped by a clock that is handed in.

Knows: when scans are taken and maps, claims are due. Does not know: zenoh, wall time, how maps are merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.explore.body import Body, Drift, Limits, Twist
from zsched_lab.explore.explorer import Explorer
from zsched_lab.explore.follower import Follower
from zsched_lab.explore.frontier import Claim
from zsched_lab.explore.laser import SCAN_PERIOD_S, Laser, LaserScan
from zsched_lab.explore.localizer import Localizer
from zsched_lab.explore.mapper import ScanMapper
from zsched_lab.explore.world import World
from zsched_lab.maps.mapping import RESOLUTION_M

MAP_PERIOD_S = 0.5
CLAIM_PERIOD_S = 0.5
STILL_PERIOD_S = 1.0
"""A robot that stands maps once in this time: the same scan twice tells nothing new."""
MOVED_M, TURNED_RAD = 0.02, 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSettings:
    """One robot; ``start`` in the world is its map frame's pose too."""

    robot: str
    start: Pose2
    seed: int = 1
    limits: Limits = Limits()
    drift: Drift = Drift()
    resolution_m: float = RESOLUTION_M
    """Of its own map."""
    has_slam: bool = True
    """Whether it maps itself; else it only hands out scans, for an edge to map."""
    is_led: bool = False
    """Whether SLAM on an edge gives it its pose, and navigation there its way: without fresh poses it stands."""
    hold_until_s: float | None = None
    """It stands, and looks, until then (the clock of `Agent.step`); ``None``: it drives at once."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outputs:
    """What became due in a step."""

    grid: Grid | None = None
    scan: LaserScan | None = None
    claim: Claim | None = None
    is_claim_due: bool = False


class Agent:
    """The robot. ``phase`` (0..1) of a map period: robots are not in step.

    A robot that maps itself sends its maps this much later; one whose scans go elsewhere begins this much later.
    """

    def __init__(self, settings: RobotSettings, world: World, *, phase: float = 0.0) -> None:
        # Seeds of words and numbers: robots of one run, and one robot's parts, draw apart.
        seeds = np.random.SeedSequence((settings.seed, *settings.robot.encode())).spawn(2)
        body_random, laser_random = (np.random.default_rng(seed) for seed in seeds)
        self.settings = settings
        self.body = Body(world, settings.start, settings.limits, settings.drift, body_random)
        self.explorer = Explorer(settings.robot, settings.limits)
        self.localizer = Localizer()
        self.follower = Follower(settings.limits)
        self.stopped_s = 0.0
        """How long it has stood since it might drive, because its last correction was too old."""
        self._laser = Laser(world, laser_random)
        self._mapper = ScanMapper(resolution=settings.resolution_m, frame_id=f"{settings.robot}/map")
        self._phase = phase
        self._last_s: float | None = None
        self._next_scan_s = self._next_map_s = self._next_claim_s = 0.0
        self._mapped: tuple[Pose2, float] | None = None
        self.scans = 0

    def step(self, now: float, stamp_ns: int) -> Outputs:
        """Move up to ``now``, look, map, decide; returns what is to be sent. ``now`` only rises."""
        if self._last_s is None:
            self._last_s = now
            self._next_claim_s = now
            self._next_map_s = now + self._phase * MAP_PERIOD_S
            self._next_scan_s = now if self.settings.has_slam else self._next_map_s
        self.body.move(self._twist(now, stamp_ns, now - self._last_s), now - self._last_s)
        self._last_s = now
        scan = self._look(now, stamp_ns)
        is_map_due = self.settings.has_slam and now >= self._next_map_s
        if is_map_due:
            self._next_map_s = max(self._next_map_s + MAP_PERIOD_S, now)
        is_claim_due = now >= self._next_claim_s
        if is_claim_due:
            self._next_claim_s = max(self._next_claim_s + CLAIM_PERIOD_S, now)
        return Outputs(
            grid=self._mapper.grid(stamp_ns) if is_map_due else None,
            scan=scan,
            claim=self.explorer.claim if is_claim_due else None,
            is_claim_due=is_claim_due and not self.settings.is_led,
        )

    @property
    def belief(self) -> Pose2:
        """Where it believes to be, in its map frame."""
        return self.localizer.belief(self.body.belief) if self.settings.is_led else self.body.belief

    def _twist(self, now: float, stamp_ns: int, seconds: float) -> Twist:
        """The velocity of this moment, for the next ``seconds``."""
        hold_until_s = self.settings.hold_until_s
        if hold_until_s is not None and now < hold_until_s:
            return Twist()
        if not self.settings.is_led:
            return self.explorer.step(self.body.belief, now, is_blocked=self.body.is_blocked)
        if self.localizer.is_lost(stamp_ns):
            self.stopped_s += seconds
            return Twist()
        return self.follower.step(self.belief, now, is_blocked=self.body.is_blocked)

    def _look(self, now: float, stamp_ns: int) -> LaserScan | None:
        """Take the scan that is due and map it, if it can tell something new."""
        if now < self._next_scan_s:
            return None
        self._next_scan_s = max(self._next_scan_s + SCAN_PERIOD_S, now)
        belief = self.body.belief
        if self._mapped is not None and not self.settings.is_led:  # SLAM is kept at work at the laser's own rate
            way, turn = difference(belief, self._mapped[0])
            if way < MOVED_M and turn < TURNED_RAD and now - self._mapped[1] < STILL_PERIOD_S:
                return None
        self._mapped = (belief, now)
        self.scans += 1
        scan = self._laser.scan(self.body.pose, stamp_ns)
        if self.settings.has_slam:
            self._mapper.add(belief, scan)
        if self.settings.is_led:
            self.localizer.note(stamp_ns, belief)
        return scan
