"""Finds a world by its name: a shipped one, an office by seed and length, or any map_server file.

Knows: the names. Does not know: cells.
"""

from __future__ import annotations

import re
from pathlib import Path

from zsched.core.values.errors import ConfigError
from zsched_lab.explore.office import OfficeSize, office
from zsched_lab.explore.world import World, read_map_server, shipped

SHIPPED = ("turtlebot3",)
OFFICE = re.compile(r"office(:(?P<seed>\d{1,9})(:(?P<length>\d{1,3}))?)?", re.ASCII)
LENGTHS_M = (6, 100)


def load_world(name: str) -> World:
    """``turtlebot3``, ``office``, ``office:SEED`` or ``office:SEED:LENGTH``, or the path of a map_server ``.yaml``.

    ``LENGTH`` of the corridors in whole metres, 6 to 100 (10).

    Raises:
        ConfigError: no such world, or its files cannot be read.
    """
    if name in SHIPPED:
        return read_map_server(shipped(name), name)
    if found := OFFICE.fullmatch(name):
        length = int(found["length"] or OfficeSize().length_m)
        if not LENGTHS_M[0] <= length <= LENGTHS_M[1]:
            raise ConfigError(f"world {name!r}: a length of {LENGTHS_M[0]} to {LENGTHS_M[1]} m is needed")
        return office(int(found["seed"] or "1"), OfficeSize(length_m=length))
    if name.endswith((".yaml", ".yml")):
        return read_map_server(Path(name))
    raise ConfigError(f"no world {name!r}: give {', '.join(SHIPPED)}, office:SEED:LENGTH or a map_server .yaml")
