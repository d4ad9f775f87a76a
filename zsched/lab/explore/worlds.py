"""Finds a world by its name: a shipped one, an office by seed, or any map_server file.

Knows: the names. Does not know: cells.
"""

from __future__ import annotations

from pathlib import Path

from zsched.errors import ConfigError
from zsched.lab.explore.office import office
from zsched.lab.explore.world import World, read_map_server, shipped

SHIPPED = ("turtlebot3",)


def load_world(name: str) -> World:
    """``turtlebot3``, ``office`` or ``office:SEED``, or the path of a map_server ``.yaml``.

    Raises:
        ConfigError: no such world, or its files cannot be read.
    """
    if name in SHIPPED:
        return read_map_server(shipped(name), name)
    kind, _, seed = name.partition(":")
    if kind == "office" and (not seed or seed.isdecimal()):
        return office(int(seed or "1"))
    if name.endswith((".yaml", ".yml")):
        return read_map_server(Path(name))
    raise ConfigError(f"no world {name!r}: give {', '.join(SHIPPED)}, office, office:SEED or a map_server .yaml")
