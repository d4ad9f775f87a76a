from __future__ import annotations

import json

import numpy as np
import pytest

from zsched.tasks.map_merge.grid import Grid
from zsched_lab.maps.picture import FREE, WALL, MapPicture


def a_map(height: int, width: int) -> Grid:
    """Unknown, with a free rectangle whose lowest row is a wall."""
    data = np.full((height + 40, width + 60), -1, np.int8)
    data[10 : 10 + height, 20 : 20 + width] = 0
    data[10, 20 : 20 + width] = 100
    return Grid(data=data, resolution=0.05)


def test_a_picture_is_the_known_part_and_comes_back_from_its_record() -> None:
    picture = MapPicture.of(a_map(3, 5))

    assert picture.cells.tolist() == [[WALL] * 5, [FREE] * 5, [FREE] * 5]
    assert picture.known_m2 == pytest.approx(15 * 0.05**2)
    again = MapPicture.read(json.loads(json.dumps(picture.record())))
    assert again.cells.tolist() == picture.cells.tolist()
