from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from zsched.core.values.errors import ConfigError
from zsched.tasks.map_merge.grid import FREE, OCCUPIED
from zsched_lab.explore.office import OfficeSize, office
from zsched_lab.explore.world import START_CLEARANCE_M, START_SPACING_M, read_map_server, shipped
from zsched_lab.explore.worlds import load_world


def write_map(folder: Path, text: str, image: np.ndarray[tuple[int, int], np.dtype[np.uint8]] | None) -> Path:
    path = folder / "map.yaml"
    path.write_text(text)
    if image is not None:
        cv2.imwrite(str(folder / "map.pgm"), image)
    return path


META = "image: map.pgm\nresolution: 0.1\norigin: [-1.0, 2.0, 0.0]\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def test_the_shipped_turtlebot3_world_is_the_place_of_the_paper() -> None:
    world = load_world("turtlebot3")
    truth = world.truth()
    assert truth.resolution == 0.05
    assert 18.0 < float(np.count_nonzero(truth.free)) * 0.05**2 < 21.0
    # Nine pillars and one outer wall: ten pieces of solid that border on the free place.
    pieces, _ = cv2.connectedComponents(truth.occupied.astype(np.uint8), connectivity=8)
    assert pieces - 1 == 10
    assert (shipped("turtlebot3").parent.parent / "NOTICE").read_text().count("Apache") > 0


def test_what_can_be_known_is_closed() -> None:
    truth = office(1).truth()
    free = truth.free
    beside = cv2.dilate(free.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)).astype(np.bool_)
    assert (truth.data[beside & ~free] == OCCUPIED).all()
    pieces, _ = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    assert pieces - 1 == 1


@pytest.mark.parametrize("name", ["turtlebot3", "office:1", "office:2", "office:3"])
def test_robots_start_side_by_side_with_room(name: str) -> None:
    world = load_world(name)
    starts = world.starts(3)
    assert starts == world.starts(3)
    truth = world.truth()
    for index, start in enumerate(starts):
        assert world.room_m(start.x, start.y) >= START_CLEARANCE_M - world.resolution
        assert truth.data[world.cell(start.x, start.y)] == FREE
        assert all(math.dist((start.x, start.y), (b.x, b.y)) >= START_SPACING_M - 1e-9 for b in starts[:index])
        # On the corners of cells (see World.starts): half a cell off, the merger loses rows of straight maps.
        assert ((start.x - world.origin_x) / world.resolution) % 1.0 == pytest.approx(0.0, abs=1e-6) or (
            (start.x - world.origin_x) / world.resolution
        ) % 1.0 == pytest.approx(1.0, abs=1e-6)


def test_too_many_robots_are_refused() -> None:
    with pytest.raises(ConfigError, match="room for"):
        load_world("turtlebot3").starts(100)


def test_the_same_seed_builds_the_same_office_and_another_seed_another() -> None:
    one, two, other = office(7), office(7), office(8)
    assert np.array_equal(one.solid, two.solid)
    assert not np.array_equal(one.solid, other.solid)
    assert office(7, OfficeSize(length_m=20.0)).solid.shape[1] > one.solid.shape[1]


def test_a_map_server_file_is_read_upright_and_unknown_is_solid(tmp_path: Path) -> None:
    image = np.full((20, 30), 254, dtype=np.uint8)
    image[0, :] = 0  # the upper side
    image[10, 5] = 205  # unknown
    world = read_map_server(write_map(tmp_path, META, image))
    assert world.resolution == 0.1
    assert world.room_m(-0.45, 2.95) == 0.0  # the unknown cell: row 10 from above is row 9 from below
    assert world.room_m(-0.95, 3.95) == 0.0  # the upper side is the far one
    assert world.room_m(-0.25, 2.25) > 0.0
    assert world.cell(-100.0, 100.0) == (world.solid.shape[0] - 1, 0)
    assert world.solid[world.cell(-100.0, 100.0)]


@pytest.mark.parametrize(
    ("text", "has_image", "why"),
    [
        (META, False, "readable image"),
        (META.replace("0.1", "fast"), True, "not a map_server file"),
        (META.replace("0.1", "-0.1"), True, "above 0"),
        (META.replace("2.0, 0.0]", "2.0, 0.5]"), True, "without yaw"),
        ("image: [", True, "not a map_server file"),
        ("just words", True, "not a map_server file"),
        (META + "negate: 1\n", True, "no free cell"),
    ],
)
def test_a_bad_map_server_file_is_refused_with_the_reason(tmp_path: Path, text: str, has_image: bool, why: str) -> None:
    image = np.full((5, 5), 254, dtype=np.uint8) if has_image else None
    with pytest.raises(ConfigError, match=why):
        read_map_server(write_map(tmp_path, text, image))
