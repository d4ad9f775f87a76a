"""Every ROS type and type hash that files of this repository name is one of real ROS 2."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from zsched.core.route.ros2 import ACTION_PARTS

ROOT = Path(__file__).parents[2]
NAMED = ("configs", "docs", "zsched", "tests", "README.md")
TYPE = r"(?P<package>[a-z][a-z0-9_]*)(?:/|::)(?P<kind>msg|srv|action)(?:/|::(?:dds_::)?)(?P<name>[A-Z][A-Za-z0-9_]*)"
HASHED = re.compile(TYPE + r"(?:(?!RIHS)[^=]){0,80}?(?P<hash>RIHS01_[0-9a-f]{64})", re.DOTALL)
NOT_IN_WHEELS = {"nav2_msgs/action/Spin", "tf2_msgs/msg/TFMessage"}
"""Of these two only names are known, and the hash of the second one is calculated (REP 2016)."""


def texts(*below: str) -> Iterator[str]:
    for one in below:
        path = ROOT / one
        for file in [path] if path.is_file() else sorted(path.rglob("*")):
            if file.suffix in (".md", ".yaml", ".yml", ".py", ".json", ".sh"):
                yield file.read_text(errors="replace")


def name_of(match: re.Match[str]) -> str:
    return f"{match['package']}/{match['kind']}/{match['name'].rstrip('_')}"


class Wheels:
    """Type descriptions of the wheels."""

    def __init__(self, share: Path) -> None:
        self._share = share
        self.packages = {path.name for path in share.iterdir() if (path / "package.xml").exists()}

    def described(self, package: str, kind: str, name: str) -> Any:
        file = self._share / package / kind / f"{name}.json"
        return json.loads(file.read_text()) if file.exists() else None

    def hashes(self, name: str) -> dict[str, str]:
        """Of a type and of everything that it is made of; empty: there is no such type."""
        package, kind, word = name.split("/")
        own = word.partition("_")[0]
        found = self.described(package, kind, own)
        return {} if found is None else {one["type_name"]: one["hash_string"] for one in found["type_hashes"]}


def hash_of(description: dict[str, Any]) -> str:
    """REP 2016: SHA-256 over the description without default values, as JSON with a space behind each mark."""

    def plain(one: dict[str, Any]) -> dict[str, Any]:
        fields = [{"name": field["name"], "type": field["type"]} for field in one["fields"]]
        return {"type_name": one["type_name"], "fields": fields}

    made = {
        "type_description": plain(description["type_description"]),
        "referenced_type_descriptions": [plain(one) for one in description["referenced_type_descriptions"]],
    }
    return "RIHS01_" + hashlib.sha256(json.dumps(made).encode()).hexdigest()


@pytest.fixture
def wheels(ros: Any) -> Wheels:
    return Wheels(ros.share)


def test_types_that_files_name_are_types_of_ros(wheels: Wheels) -> None:
    named = {
        name_of(match) for text in texts("configs", "docs", "zsched", "README.md") for match in re.finditer(TYPE, text)
    }
    known = {name for name in named if name.split("/")[0] in wheels.packages | {"nav2_msgs", "tf2_msgs"}}
    assert {"nav_msgs/msg/OccupancyGrid", "std_srvs/srv/Trigger", "lifecycle_msgs/srv/ChangeState"} <= known
    assert {name.partition("_Se")[0].partition("_Fe")[0] for name in known if not wheels.hashes(name)} == NOT_IN_WHEELS


def test_hashes_that_files_name_are_those_of_ros(wheels: Wheels) -> None:
    transforms = wheels.described("geometry_msgs", "msg", "TransformStamped")["type_description_msg"]
    made = {
        "type_id": 145,
        "capacity": 0,
        "string_capacity": 0,
        "nested_type_name": "geometry_msgs/msg/TransformStamped",
    }
    message = {
        "type_description": {"type_name": "tf2_msgs/msg/TFMessage", "fields": [{"name": "transforms", "type": made}]},
        "referenced_type_descriptions": sorted(
            [transforms["type_description"], *transforms["referenced_type_descriptions"]],
            key=lambda one: str(one["type_name"]),
        ),
    }
    assert (
        hash_of(transforms) == wheels.hashes("geometry_msgs/msg/TransformStamped")["geometry_msgs/msg/TransformStamped"]
    )
    named = {(name_of(match), match["hash"]) for text in texts(*NAMED) for match in HASHED.finditer(text)}
    calculated = {"tf2_msgs/msg/TFMessage": hash_of(message)}
    real = {name: (wheels.hashes(name) | calculated).get(name) for name, _ in named}
    assert len(named) > 20, "the words of live nodes are among them"
    assert {(name, told) for name, told in named if told != real[name]} == set()


def test_an_actions_parts_have_the_types_that_ros_generates(wheels: Wheels) -> None:
    generated = wheels.hashes("test_msgs/action/Fibonacci")
    for part in ACTION_PARTS:
        name = part.type_name("test_msgs/action/Fibonacci")
        assert name in (wheels.hashes(name) if part.common_type else generated), name
