"""Builds an office by seed: rooms along two corridors and a cross corridor, doors, furniture. Same seed, same office.

Knows: walls and doors as cells. Does not know: robots.

The plan is a ladder: two long corridors joined by short ones, with rooms on both sides of each. Every room has a door
to a corridor, some have a second one to their neighbour, so there are loops, dead ends and places that only one robot
need see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zsched.tasks.map_merge.grid import Mask
from zsched_lab.explore.world import World, make_world

RESOLUTION_M = 0.05
WALL_M = 0.15
DOOR_M = 1.0
CORRIDOR_M = 1.8
ROOM_DEPTH_M = 3.6
ROOM_WIDTH_M = (2.8, 4.6)
SIDE_DOOR_RATIO = 0.25
FURNITURE_PER_ROOM = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class OfficeSize:
    """How large: ``length_m`` of the corridors, ``corridors`` of them one above the other."""

    length_m: float = 10.0
    corridors: int = 2


class _Plan:
    """Cells that are carved and filled in metres."""

    def __init__(self, width_m: float, height_m: float) -> None:
        self.solid: Mask = np.ones((round(height_m / RESOLUTION_M), round(width_m / RESOLUTION_M)), dtype=np.bool_)

    def fill(self, x: float, y: float, width: float, height: float, *, solid: bool) -> None:
        rows = slice(round(y / RESOLUTION_M), round((y + height) / RESOLUTION_M))
        columns = slice(round(x / RESOLUTION_M), round((x + width) / RESOLUTION_M))
        self.solid[rows, columns] = solid


def office(seed: int, size: OfficeSize | None = None) -> World:
    """The office of a seed; robots start in the middle of the lower corridor."""
    size = size or OfficeSize()
    name = f"office:{seed}" + ("" if size == OfficeSize() else f":{size.length_m:g}")
    random = np.random.default_rng((seed, 0x0FF1CE))
    band = 2 * (ROOM_DEPTH_M + WALL_M) + CORRIDOR_M + WALL_M
    plan = _Plan(size.length_m + 2 * WALL_M, size.corridors * band + WALL_M)
    for floor in range(size.corridors):
        low = WALL_M + floor * band
        middle = low + ROOM_DEPTH_M + WALL_M
        plan.fill(WALL_M, middle, size.length_m, CORRIDOR_M, solid=False)
        _rooms(plan, random, size.length_m, low, middle - WALL_M)
        _rooms(plan, random, size.length_m, middle + CORRIDOR_M + WALL_M, middle + CORRIDOR_M)
    _cross_corridors(plan, size, band)
    home = (WALL_M + size.length_m / 2, WALL_M + ROOM_DEPTH_M + WALL_M + CORRIDOR_M / 2)
    return make_world(name, plan.solid, RESOLUTION_M, (0.0, 0.0), home)


def _rooms(plan: _Plan, random: np.random.Generator, length_m: float, low: float, door_wall: float) -> None:
    """One row of rooms whose lower side is at ``low``, each with a door in the wall that begins at ``door_wall``."""
    left = WALL_M
    end = WALL_M + length_m
    while end - left >= ROOM_WIDTH_M[0]:
        width = float(random.uniform(*ROOM_WIDTH_M))
        if end - (left + width + WALL_M) < ROOM_WIDTH_M[0]:
            width = end - left
        plan.fill(left, low, width, ROOM_DEPTH_M, solid=False)
        _furnish(plan, random, left, low, width)
        door = left + float(random.uniform(0.2, width - DOOR_M - 0.2))
        plan.fill(door, door_wall, DOOR_M, WALL_M, solid=False)
        if left + width < end - 0.01 and random.random() < SIDE_DOOR_RATIO:
            plan.fill(
                left + width, low + float(random.uniform(0.4, ROOM_DEPTH_M - DOOR_M - 0.4)), WALL_M, DOOR_M, solid=False
            )
        left += width + WALL_M


def _furnish(plan: _Plan, random: np.random.Generator, left: float, low: float, width: float) -> None:
    """Cupboards along the side walls: they hide corners, and no door."""
    for _ in range(int(random.integers(0, FURNITURE_PER_ROOM + 1))):
        deep, wide = float(random.uniform(0.3, 0.5)), float(random.uniform(0.4, 0.9))
        x = left if random.random() < 0.5 else left + width - deep
        y = low + float(random.uniform(0.6, ROOM_DEPTH_M - 0.6 - wide))
        plan.fill(x, y, deep, wide, solid=True)


def _cross_corridors(plan: _Plan, size: OfficeSize, band: float) -> None:
    """Join neighbouring corridors at a third and at two thirds of their length."""
    for floor in range(size.corridors - 1):
        middle = WALL_M + floor * band + ROOM_DEPTH_M + WALL_M
        for share in (0.33, 0.75):
            x = WALL_M + share * size.length_m
            height = band
            plan.fill(x - WALL_M, middle + CORRIDOR_M, CORRIDOR_M + 2 * WALL_M, height - CORRIDOR_M, solid=True)
            plan.fill(x, middle, CORRIDOR_M, height, solid=False)
