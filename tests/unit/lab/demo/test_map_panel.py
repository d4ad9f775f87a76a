from __future__ import annotations

import numpy as np

from zsched_lab.demo.map_panel import GROUND, draw, scaled
from zsched_lab.maps.picture import FREE, WALL, MapPicture


def a_picture(*rows: str) -> MapPicture:
    """From the top, as it is seen: # wall, . free."""
    codes = {"#": WALL, ".": FREE, " ": 0}
    cells = np.array([[codes[letter] for letter in row] for row in reversed(rows)], np.uint8)
    return MapPicture(cells=cells, known_m2=1.0)


def test_walls_are_dots_and_what_is_free_is_their_ground() -> None:
    lines = draw(a_picture("##  ", "#.  ", "#.  ", "#.  "), 2, 1)

    assert [line.plain for line in lines] == ["\u284f "], "the left dots of the first character, and its upper right"
    assert [str(span.style) for span in lines[0].spans] == [GROUND], "nobody has seen the second"


def test_a_map_keeps_its_shape_and_fills_the_room_that_it_has() -> None:
    wide = a_picture("#" * 40, *["." * 40] * 19)

    assert scaled(wide.cells, 20, 100).shape == (10, 20)
    assert scaled(wide.cells, 80, 40).shape == (40, 80)
    assert (scaled(wide.cells, 20, 100)[0] == WALL).all(), "a thin wall is not lost, and is on top"
    assert len(draw(wide, 10, 25)) == 3
    assert {line.cell_len for line in draw(wide, 10, 25)} == {10}


def test_there_may_be_no_map_and_no_room() -> None:
    empty = MapPicture(cells=np.zeros((0, 0), np.uint8), known_m2=0.0)

    assert draw(empty, 10, 5) == []
    assert draw(a_picture("#"), 0, 0) == []
