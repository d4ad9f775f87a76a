"""Reads the poses that an operator gives: ``--pose robot1=x,y,yaw`` and ``--poses FILE``.

Knows: their text. Does not know: what they are used for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from zsched.core.values.errors import ConfigError
from zsched.core.values.words import NAME
from zsched.tasks.map_merge.geometry import Pose2, wrap_angle

_USAGE = "give robot=x,y,yaw in metres and radians, e.g. robot1=1.5,-2,1.57"


def read_poses(arguments: Iterable[str], file: Path | None) -> dict[str, Pose2]:
    """The poses of the robots' map frames in the world; an argument wins over the file.

    The file is YAML or JSON: ``{robot1: [x, y, yaw], robot2: {x: 1, y: 2, yaw: 0.5}}``.

    Raises:
        ConfigError: every faulty pose, each with its place.
    """
    faults: list[str] = []
    poses = {} if file is None else _file_poses(file, faults)
    for argument in arguments:
        robot, _, text = argument.partition("=")
        pose = _pose(text.split(","))
        if pose is None or NAME.fullmatch(robot) is None:
            faults.append(f"--pose {argument}: {_USAGE}")
        else:
            poses[robot] = pose
    if faults:
        raise ConfigError("\n".join(faults))
    return poses


def _file_poses(file: Path, faults: list[str]) -> dict[str, Pose2]:
    try:
        content = YAML(typ="safe", pure=True).load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, YAMLError) as error:
        raise ConfigError(f"{file}: poses cannot be read: {error}") from error
    if not isinstance(content, Mapping):
        raise ConfigError(f"{file}: expected a mapping of robots to poses, e.g. robot1: [1.5, -2, 1.57]")
    poses = {}
    for robot, value in content.items():
        fields = [value.get(key) for key in ("x", "y", "yaw")] if isinstance(value, Mapping) else value
        pose = _pose(fields) if isinstance(fields, list) else None
        if pose is None or NAME.fullmatch(str(robot)) is None:
            faults.append(f"{file}: {robot}: {value!r} is not a pose [x, y, yaw] of a robot")
        else:
            poses[str(robot)] = pose
    return poses


def _pose(fields: Sequence[object]) -> Pose2 | None:
    try:
        x, y, yaw = (float(str(field)) for field in fields)
    except ValueError:
        return None
    if not all(map(math.isfinite, (x, y, yaw))):
        return None
    return Pose2(x=x, y=y, yaw=wrap_angle(yaw))
