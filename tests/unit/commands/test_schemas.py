"""The schema files that are shipped: every JSON output is held against its own, with no field that the file has not."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import typer.main
from typer.testing import CliRunner

from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.common import SCHEMAS, known_majors, schema_of
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import Jobs, WorkerLoad
from zsched.core.values.snapshot import DecisionStatus, NodeStatus, QuorumStatus, Snapshot, TaskStatus, VoteStatus

RECORDED = Path(__file__).parent / "recorded_status"
FILES = sorted(SCHEMAS.glob("*.json"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_every_file_is_a_schema_and_is_called_by_its_name(file: Path) -> None:
    schema = json.loads(file.read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    name, major = file.name.removesuffix(".json").rsplit(".", 1)
    assert schema["title"] == schema["properties"]["schema"]["const"] == f"{name}/{major}"
    assert schema["description"]


def verbs_with_json(group: Any, *before: str) -> Iterator[tuple[str, ...]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from verbs_with_json(command, *before, name)
        elif any("--json" in param.opts for param in command.params):
            yield (*before, name)


VERBS = sorted(verbs_with_json(typer.main.get_command(app)))
BY_OPTION = [("replay",), ("site",)]
"""What `explain --replay` and `status --site` print."""


def test_every_verb_with_json_has_a_schema_and_no_file_is_left_over() -> None:
    assert [file.name for file in FILES] == sorted({f"{schema_of(words)}.1.json" for words in [*VERBS, *BY_OPTION]})


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_an_unknown_major_is_refused_with_those_there_are_before_anything_is_done(words: tuple[str, ...]) -> None:
    name = schema_of(words)
    for wanted in ("2", "0", "", "one"):
        result = CliRunner().invoke(app, [*words, f"--json={wanted}"])
        assert result.exit_code == 2
        assert result.stderr.endswith(f": --json={wanted}: {name} has the major version 1\n")


def test_the_known_major_is_what_json_alone_prints() -> None:
    plain, told = (CliRunner().invoke(app, ["version", flag]).stdout for flag in ("--json", "--json=1"))
    assert plain == told
    assert json.loads(plain)["schema"] == "zsched.version/1"


def test_a_schema_without_a_file_has_no_major() -> None:
    assert known_majors("zsched.stream") == [], "the files of zsched.stream.list are another schema's"
    assert known_majors("zsched.stream.list") == ["1"]


def test_version_and_check_are_as_their_schemas_say(tmp_path: Path) -> None:
    file = tmp_path / "fleet.yaml"
    file.write_text("fleet: hall\nnodes: {robot1: {kind: rowboat}}\ntasks: {}\n")
    good = Path(__file__).parents[3] / "configs" / "fleet.yaml"
    for words in (("version",), ("check", str(file)), ("check", str(good))):
        assert faults(json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)) == []


@pytest.mark.parametrize("name", ["healthy", "edge", "degraded"])
def test_recorded_statuses_of_older_daemons_are_as_the_schema_says(name: str) -> None:
    """A field that came later is not required: this command line shows what an older daemon answers, too."""
    assert faults({**json.loads((RECORDED / f"{name}.json").read_text()), "degraded": []}) == []


def test_every_field_of_a_status_is_in_the_schema() -> None:
    schema = json.loads((SCHEMAS / "zsched.status.1.json").read_text())
    told = {name: set(part["properties"]) for name, part in schema["$defs"].items() if "properties" in part}
    told["Snapshot"] = set(schema["properties"]) - {"degraded"}
    parts = (NodeStatus, TaskStatus, DecisionStatus, VoteStatus, QuorumStatus, StreamCount, WorkerLoad, Jobs)
    for cls in (Snapshot, *parts):
        assert told[cls.__name__] == {field.name for field in fields(cls)}


def test_a_field_too_many_a_wrong_type_and_a_missing_field_are_found() -> None:
    body: dict[str, Any] = {"schema": "zsched.version/1", "zsched": "1", "wire": 1, "zenoh": "1", "python": sys.version}
    assert faults(body) == []
    assert "was unexpected" in faults({**body, "more": 1})[0]
    assert "is not of type 'integer'" in faults({**body, "wire": "1"})[0]
    del body["zenoh"]
    assert faults(body) == ["$: 'zenoh' is a required property"]
