"""Draws a map in a terminal: walls as dots of braille, two by four in a character, what is free as their ground.

Knows: characters and colours. Does not know: where the map comes from.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.text import Text

from zsched_lab.maps.picture import UNKNOWN, WALL, MapPicture

DOTS_WIDE, DOTS_HIGH = 2, 4
BRAILLE = 0x2800
DOT = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""The bit of each dot of a character, from the top."""
GROUND = "on grey23"


def map_panel(picture: MapPicture | None, columns: int, rows: int) -> RenderableType:
    """The map in a frame of ``columns`` x ``rows`` characters."""
    known = "no map yet" if picture is None else f"{picture.known_m2:.0f} m²"
    lines = [] if picture is None else draw(picture, columns - 2, rows - 2)
    lines += [Text("")] * (rows - 2 - len(lines))
    return Panel(Group(*lines), title=f"the merged map, {known}", title_align="left", padding=(0, 0))


def draw(picture: MapPicture, columns: int, rows: int) -> list[Text]:
    """At most ``rows`` lines of ``columns`` characters, the map's shape kept."""
    dots = scaled(picture.cells, columns * DOTS_WIDE, rows * DOTS_HIGH)
    if dots.size == 0:
        return []
    high, wide = (-(-length // side) for length, side in zip(dots.shape, (DOTS_HIGH, DOTS_WIDE), strict=True))
    canvas = np.zeros((high * DOTS_HIGH, wide * DOTS_WIDE), np.uint8)
    canvas[: dots.shape[0], : dots.shape[1]] = dots
    parts = canvas.reshape(high, DOTS_HIGH, wide, DOTS_WIDE).transpose(0, 2, 1, 3)
    codes = BRAILLE + np.where(parts == WALL, DOT, 0).sum(axis=(2, 3))
    is_known = (parts != UNKNOWN).sum(axis=(2, 3)) * 2 >= DOTS_WIDE * DOTS_HIGH
    margin = " " * ((columns - wide) // 2)
    lines = []
    for row_codes, row_known in zip(codes, is_known, strict=True):
        line = Text(margin, no_wrap=True)
        for code, known in zip(row_codes, row_known, strict=True):
            line.append(chr(code) if code != BRAILLE else " ", GROUND if known else "")
        lines.append(line)
    return lines


def scaled(cells: npt.NDArray[np.uint8], wide: int, high: int) -> npt.NDArray[np.uint8]:
    """The cells on at most ``wide`` x ``high`` dots, row 0 now at the top; of the cells of a dot the highest counts."""
    if cells.size == 0 or wide <= 0 or high <= 0:
        return np.zeros((0, 0), np.uint8)
    ratio = min(wide / cells.shape[1], high / cells.shape[0])
    shape = [max(1, int(length * ratio)) for length in cells.shape]
    found = np.zeros(shape, np.uint8)
    rows, columns = (np.arange(length) * size // length for length, size in zip(cells.shape, shape, strict=True))
    np.maximum.at(found, (rows[:, None], columns[None, :]), cells)
    if ratio > 1:  # fewer cells than dots: each one fills those that fall to it
        rows, columns = (np.arange(size) * length // size for length, size in zip(cells.shape, shape, strict=True))
        found = cells[rows[:, None], columns[None, :]]
    return found[::-1]
