"""`--node CELL/NODE` and `status --site` where there is no such cell, nobody answers, or the machine has no daemon."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.doors import answering
from support.schemas import faults
from zsched.commands.base import ask
from zsched.commands.base.ask import ask_door, find_door
from zsched.commands.base.change import asker, user_name
from zsched.commands.base.common import CliError, Json
from zsched.commands.base.options import Answers
from zsched.commands.look.cells import show_site
from zsched.commands.look.history import history
from zsched.core.values.exits import EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched_lab.fleet.loopback import free_endpoint, own_address


@pytest.fixture
def gateways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, str]]:
    """A machine without a daemon, whose fleet file names a cell at two addresses where nobody listens."""
    ends = (free_endpoint(), free_endpoint())
    listen = {"control": free_endpoint(), "data": free_endpoint()}
    robot = {"kind": "robot", "host": own_address(), "listen": listen}
    tree = {"fleet": "hall-a", "nodes": {"robot1": robot}, "site": {"hall-b": {"gateways": list(ends)}}}
    file = tmp_path / "fleet.yaml"
    file.write_text(json.dumps(tree))
    monkeypatch.setenv("ZSCHED_CONFIG", str(file))
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setattr(ask, "CONNECT_S", 0.2)
    yield ends
    ask._answered.clear()


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("hall-x/robot7", "the site has no cell 'hall-x'"),
        ("hall-b/Robot7", "'hall-b/Robot7' is neither a node's name nor CELL/NODE"),
        ("hall-b/", "'hall-b/' is neither a node's name nor CELL/NODE"),
    ],
)
@pytest.mark.usefixtures("gateways")
def test_a_cell_that_there_is_not_is_a_fault_of_usage(word: str, told: str) -> None:
    with pytest.raises(CliError, match=told) as refused:
        find_door(None, word)
    assert refused.value.code == EXIT_USAGE


def asked(*, is_json: bool) -> Answers:
    return Answers({"node": None, "runtime_dir": None, "connect": None, "json_": is_json})


def test_a_cell_without_an_answer_names_each_gateway(gateways: tuple[str, str]) -> None:
    door = find_door(None, "hall-b/robot7")
    with pytest.raises(CliError, match=r"hall-b/robot7 cannot be asked; by tcp/.*; by tcp/") as refused:
        ask_door(door, {"verb": "status"})
    assert refused.value.code == EXIT_UNREACHABLE
    assert all(f"by {gateway}" in str(refused.value) for gateway in gateways)


@pytest.mark.usefixtures("gateways")
def test_what_only_a_machine_itself_tells_is_refused_before_anybody_is_asked() -> None:
    with pytest.raises(CliError, match="only the machine of a node tells its log") as refused:
        ask_door(find_door(None, "hall-b/robot7"), {"verb": "log"})
    assert refused.value.code == EXIT_USAGE


@pytest.mark.usefixtures("gateways")
def test_an_order_tells_the_fleet_and_the_machine_it_comes_from() -> None:
    name, _, place = asker(find_door(None, "hall-b/robot7")).partition("@hall-a/")
    assert name == user_name()
    assert place


@pytest.mark.usefixtures("gateways")
def test_a_site_of_which_no_cell_answers_exits_with_3(capsys: pytest.CaptureFixture[str]) -> None:
    assert show_site(asked(is_json=False)) == EXIT_UNREACHABLE
    assert "hall-b: cell hall-b cannot be asked" in capsys.readouterr().out


@pytest.mark.usefixtures("gateways")
def test_a_history_of_which_no_cell_tells_exits_with_3(capsys: pytest.CaptureFixture[str]) -> None:
    assert history(asked(is_json=False), site=True) == EXIT_UNREACHABLE
    assert capsys.readouterr().out.startswith("PROBLEMS\n  hall-b: cell hall-b cannot be asked; by tcp/")


def ours(request: Json) -> Json:
    """The daemon of this machine: one move, and no document."""
    if request["verb"] == "fleet":
        return {"node": "robot1", "text": ""}
    move = {"epoch": 2, "revision": 3, "left": "edge1", "owner": "edge2", "reason": "edge1 is gone"}
    entry = {"at": 1_790_000_000.0, "life": 7, "task": "echo", "text": "learnt", "move": move}
    return {"node": "robot1", "now": 1_790_000_060.0, "entries": [entry], "cursor": "1:9", "more": False}


@pytest.mark.usefixtures("gateways")
def test_a_silent_cell_is_named_and_the_history_of_the_others_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with answering(ours, tmp_path, monkeypatch):
        assert history(asked(is_json=False), site=True) == EXIT_OK
        move, title, problem = capsys.readouterr().out.splitlines()
        assert move.startswith("hall-a   1m00s ago  ")
        assert move.endswith("echo epoch 2  edge1 -> edge2: edge1 is gone")
        assert (title, problem.startswith("  hall-b: cell hall-b cannot be asked")) == ("PROBLEMS", True)
        assert history(asked(is_json=False), "other", site=True) == EXIT_OK
        assert capsys.readouterr().out.startswith("no move and no order of other in hall-a\nPROBLEMS\n")
        assert history(asked(is_json=True), site=True) == EXIT_OK
    told = json.loads(capsys.readouterr().out)
    assert faults(told) == []
    assert [(move["cell"], move["to"]) for move in told["moves"]] == [("hall-a", "edge2")]
    assert [(cell["name"], cell["node"], cell["error"] is None) for cell in told["cells"]] == [
        ("hall-a", "robot1", True),
        ("hall-b", None, False),
    ]
