"""The place that the lab's robots explore: what is solid, how much room there is, and what can be known of it.

Knows: map_server's files, the shipped worlds, the cells. Does not know: robots, lasers, what was seen so far.

A cell is solid unless the map says that it is free: what nobody mapped is taken for a wall, so no robot leaves the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from zsched.core.values.errors import ConfigError
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import FREE, OCCUPIED, UNKNOWN, Cells, Grid, Mask

START_CLEARANCE_M = 0.25
START_SPACING_M = 0.8
"""Robots start side by side, as in the paper: at first they see the same."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """A known place: ``solid`` cells (rows, columns), row 0 at the bottom, with a solid rim all round.

    ``resolution`` in metres per cell; ``origin_x``, ``origin_y`` (m) of the outer corner of cell (0, 0) in the world's
    frame; ``home``: near which robots start (m).
    """

    name: str
    solid: Mask
    resolution: float
    origin_x: float
    origin_y: float
    home: tuple[float, float]
    clearance_m: npt.NDArray[np.float32] = field(init=False, repr=False)
    """From the middle of each cell to the next solid cell's nearest side, about; 0 in solid cells."""

    def __post_init__(self) -> None:
        cells = cv2.distanceTransform((~self.solid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        clearance = np.maximum(cells - 0.5, 0.0).astype(np.float32) * np.float32(self.resolution)
        object.__setattr__(self, "clearance_m", clearance)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) of a point; outside of the map the nearest cell of the rim, which is solid."""
        row = math.floor((y - self.origin_y) / self.resolution)
        column = math.floor((x - self.origin_x) / self.resolution)
        return min(max(row, 0), self.solid.shape[0] - 1), min(max(column, 0), self.solid.shape[1] - 1)

    def room_m(self, x: float, y: float) -> float:
        """How far the next solid cell is from a point, 0 inside of one."""
        return float(self.clearance_m[self.cell(x, y)])

    def truth(self) -> Grid:
        """What can be known: the free cells that hang together with `home`, and the solid cells that border on them."""
        _, labels = cv2.connectedComponents((~self.solid).astype(np.uint8), connectivity=4)
        open_cells = (labels == labels[self.cell(*self.home)]) & ~self.solid
        near = cv2.dilate(open_cells.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)).astype(np.bool_)
        data: Cells = np.full(self.solid.shape, UNKNOWN, dtype=np.int8)
        data[open_cells] = FREE
        data[near & self.solid] = OCCUPIED
        origin = Pose2(x=self.origin_x, y=self.origin_y)
        return Grid(data=data, resolution=self.resolution, origin=origin, frame_id="world")

    def starts(self, n: int) -> tuple[Pose2, ...]:
        """Where ``n`` robots start: near `home`, side by side, turned apart; the same for every call.

        Raises:
            ConfigError: there is no room for so many.
        """
        rows, columns = np.nonzero((self.clearance_m >= START_CLEARANCE_M) & (self.truth().data == FREE))
        # Corners of cells: half a cell off, the merger's nearest-cell sampling loses every other row of a straight map.
        points = np.stack((columns, rows), axis=1) * self.resolution + (self.origin_x, self.origin_y)
        order = np.argsort(np.hypot(points[:, 0] - self.home[0], points[:, 1] - self.home[1]), kind="stable")
        chosen: list[tuple[float, float]] = []
        for x, y in points[order].tolist():
            if len(chosen) == n:
                break
            if all(math.hypot(x - a, y - b) >= START_SPACING_M for a, b in chosen):
                chosen.append((x, y))
        if len(chosen) < n:
            raise ConfigError(f"world {self.name}: room for {len(chosen)} robots, not for {n}. Take a larger world.")
        return tuple(Pose2(x=x, y=y, yaw=math.tau * index / n) for index, (x, y) in enumerate(chosen))


def make_world(
    name: str, solid: Mask, resolution: float, origin: tuple[float, float], home: tuple[float, float] | None
) -> World:
    """A world with a solid rim put round ``solid``; without ``home`` robots start where there is most room."""
    rimmed = np.pad(solid, 1, constant_values=True)
    corner = (origin[0] - resolution, origin[1] - resolution)
    if home is None:
        cells = cv2.distanceTransform((~rimmed).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        row, column = np.unravel_index(int(cells.argmax()), cells.shape)
        home = (corner[0] + (int(column) + 0.5) * resolution, corner[1] + (int(row) + 0.5) * resolution)
    return World(name=name, solid=rimmed, resolution=resolution, origin_x=corner[0], origin_y=corner[1], home=home)


def shipped(name: str) -> Path:
    """The map_server file of a shipped world (licences: worlds/NOTICE)."""
    return Path(str(resources.files("zsched_lab") / "worlds" / name / "map.yaml"))


def read_map_server(path: Path, name: str = "") -> World:
    """A map_server ``.yaml`` with its image (``.pgm`` or whatever OpenCV reads), mode ``trinary``.

    Raises:
        ConfigError: one of the two files cannot be read, or a value in them is none.
    """
    try:
        meta = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        image_path = path.parent / str(meta["image"])
        resolution, origin = float(meta["resolution"]), [float(value) for value in meta["origin"]]
        negate, free_below = bool(int(meta.get("negate", 0))), float(meta["free_thresh"])
    except (OSError, UnicodeDecodeError, YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{path}: not a map_server file: {error!r}. Give image, resolution, origin, free_thresh."
        ) from error
    image = cv2.imread(str(image_path), cv2.IMREAD_GRAYSCALE) if image_path.is_file() else None
    if image is None or not resolution > 0.0 or len(origin) != 3 or abs(origin[2]) > 1e-9:
        raise ConfigError(
            f"{path}: needs a readable image ({image_path}), a resolution above 0 and an origin without yaw"
        )
    levels = image.astype(np.float32) / 255.0
    occupancy = levels if negate else 1.0 - levels
    solid: Mask = np.flipud(occupancy >= free_below)
    if bool(solid.all()):
        raise ConfigError(f"{path}: no free cell in {image_path}; check negate and free_thresh")
    return make_world(name or path.stem, solid, resolution, (origin[0], origin[1]), None)
