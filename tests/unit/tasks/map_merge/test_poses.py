"""Operator's poses: arguments and files, with every fault named."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from zsched.core.values.errors import ConfigError
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.poses import read_poses


def test_arguments_are_read() -> None:
    poses = read_poses(["robot1=1.5,-2,0.5", "robot2=0,0,4"], None)
    assert poses["robot1"] == Pose2(x=1.5, y=-2.0, yaw=0.5)
    assert poses["robot2"].yaw == pytest.approx(4.0 - math.tau)


def test_yaml_and_json_are_read_and_the_argument_wins(tmp_path: Path) -> None:
    yaml = tmp_path / "poses.yaml"
    yaml.write_text("robot1: [1, 2, 0.5]\nrobot2: {x: 3, y: 4, yaw: 0}\n")
    assert read_poses(["robot1=9,9,0"], yaml) == {"robot1": Pose2(x=9.0, y=9.0), "robot2": Pose2(x=3.0, y=4.0)}
    as_json = tmp_path / "poses.json"
    as_json.write_text(json.dumps({"robot1": [1, 2, 0.5]}))
    assert read_poses([], as_json) == {"robot1": Pose2(x=1.0, y=2.0, yaw=0.5)}


@pytest.mark.parametrize("text", ["robot1", "robot1=1,2", "robot1=1,2,x", "robot1=1,2,nan", "=1,2,3", "Robot 1=1,2,3"])
def test_faulty_argument_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match="--pose"):
        read_poses([text], None)
