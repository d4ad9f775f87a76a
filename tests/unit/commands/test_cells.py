"""`zsched status --site` and `zsched history --site` on a machine whose daemon does not run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError
from zsched.commands.base.places import Places
from zsched.commands.look import cells, history
from zsched.commands.members.belongings import found
from zsched.core.values.exits import EXIT_UNREACHABLE

FILE = """\
fleet: hall-a
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
"""
SITE = "site: {hall-b: {gateways: [tcp/192.0.2.31:7457, tcp/192.0.2.32:7457]}}\n"
VERBS = (("status", "--site"), ("history", "--site"))


def run(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    """One with an empty folder for sockets."""
    for name, place in (("CONFIG", "etc/fleet.yaml"), ("STATE_DIR", "state"), ("RUNTIME_DIR", "run")):
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / place))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    (tmp_path / "etc").mkdir()
    return Places(config=tmp_path / "etc" / "fleet.yaml", state=tmp_path / "state")


@pytest.mark.parametrize("words", VERBS)
def test_the_cells_are_those_of_the_stored_document(
    machine: Places, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    asked: list[str] = []

    def ask(door: Door, _request: dict[str, Any]) -> dict[str, Any]:
        asked.append(door.endpoint)
        raise CliError(EXIT_UNREACHABLE, "nobody is there")

    monkeypatch.setattr(cells, "ask_door", ask)
    monkeypatch.setattr(history, "ask_door", ask)
    found(FILE + SITE, "robot1", machine, is_plan=False)
    machine.config.write_text(FILE)
    result = run(*words, "--json")
    assert result.exit_code == 3
    assert [(cell["name"], cell["error"]) for cell in json.loads(result.stdout)["cells"]] == [
        ("hall-b", "nobody is there")
    ]
    assert asked == ["tcp/192.0.2.31:7457"]
    machine.config.write_text(FILE.replace("hall-a", "hall-c"))
    assert "what it has of fleet hall-c names no other" in run(*words).stderr, "another fleet's document is not meant"
