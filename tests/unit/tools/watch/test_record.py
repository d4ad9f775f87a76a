"""`zsched record`: what is in the file, read back by another implementation and held against the schemas in it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from typer.testing import CliRunner, Result

from support.mcap_files import read_mcap
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.ask import Door
from zsched.core.values.fleet import Cell
from zsched.host.operator_socket import OperatorSocket
from zsched.tools.watch.tracks import FRAMES, GRID, JSON_SCHEMAS, of_entry, of_status, ros_keys, topic_of

RECORDED = Path(__file__).parent / "recorded"


def recorded() -> dict[str, Any]:
    status: dict[str, Any] = json.loads((RECORDED / "fleet.json").read_text())
    return status


def entry(text: str, **more: Any) -> dict[str, Any]:
    return {"at": 1_790_000_000.25, "node": "robot1", "life": 7, "stage": "vote", "text": text} | more


MOVE = {
    "epoch": 3,
    "revision": 3,
    "left": "edge2",
    "owner": "edge3",
    "reason": "edge2 is gone",
    "votes": [["robot1", "edge3"]],
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A daemon whose log has an old line, and a new one with every further question."""
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["verb"] == "status":
            return recorded()
        number = int(request["cursor"] or 0)
        new = [entry("of before", at=1.0)] if number == 0 else [entry("learnt", task="echo", epoch=3, move=MOVE)]
        return {"node": "robot1", "now": 2.0, "entries": new, "cursor": str(number + 1), "more": False}

    daemon = OperatorSocket(tmp_path / "robot1.sock", answer)
    daemon.open()
    yield tmp_path
    daemon.close()


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["record", *map(str, arguments)])


def test_the_file_holds_every_topic_and_the_moves_since_its_beginning(folder: Path) -> None:
    file = folder / "run.mcap"
    done = run("-o", file, "--for", "0.5s", "--interval", "0.2")
    assert (done.exit_code, done.stdout) == (0, ""), done.stderr
    messages = read_mcap(file)
    assert f"{file}: {len(messages)} messages of 15 topics" in done.stderr
    topics = {topic: kind for topic, kind, _, _ in messages}
    assert topics["/zsched/tasks/echo"] == "zsched.Task"
    assert topics["/zsched/streams/echo/in/0"] == "zsched.Stream"
    assert topics["/zsched/nodes/robot1"] == "zsched.Node"
    assert topics["/zsched/status"] == "zsched.status.1"
    tasks = [json.loads(data) for topic, _, _, data in messages if topic == "/zsched/tasks/echo"]
    assert len(tasks) >= 2
    assert tasks[0]["owner"] == "edge2"
    assert set(tasks[0]["utilities"]) == {"edge1", "edge2", "edge3"}
    logs = [(at, json.loads(data)) for topic, _, at, data in messages if topic == "/zsched/log"]
    assert {body["message"] for _, body in logs} == {"echo: learnt"}, "not what the log held before"
    assert logs[0][0] == 1_790_000_000_250_000_000
    assert logs[0][1]["timestamp"] == {"sec": 1_790_000_000, "nsec": 250_000_000}
    move = next(json.loads(data) for topic, _, _, data in messages if topic == "/zsched/moves")
    assert move == {
        "task": "echo",
        "epoch": 3,
        "revision": 3,
        "left": "edge2",
        "owner": "edge3",
        "reason": "edge2 is gone",
        "votes": {"robot1": "edge3"},
    }


def test_what_has_happened_since_the_last_look_is_in_the_file(folder: Path) -> None:
    """With an interval as long as the recording there was no log, and no move at all."""
    file = folder / "run.mcap"
    done = run("-o", file, "--for", "0.3s", "--interval", "60")
    assert done.exit_code == 0, done.stderr
    assert {"/zsched/log", "/zsched/moves"} <= {topic for topic, _, _, _ in read_mcap(file)}


def test_every_message_is_as_its_schema_says() -> None:
    checked = 0
    for message in (*of_status(recorded(), 5.0), *of_entry(entry("x")), *of_entry(entry("y", task="echo", move=MOVE))):
        if message.schema == "zsched.status.1":
            assert faults(message.body) == []
            continue
        schema = json.loads(JSON_SCHEMAS[message.schema])
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(message.body, {**schema, "additionalProperties": False})
        checked += 1
    assert checked > 10


def test_maps_and_frames_are_found_by_their_ros_type() -> None:
    status = recorded()
    maps, frames = "0/robot1/map/nav_msgs::msg::dds_::OccupancyGrid_/*", "0/tf/tf2_msgs::msg::dds_::TFMessage_/*"
    stream = status["tasks"][0]["streams"][0]
    stream["from_expr"], stream["to_expr"] = maps, frames
    assert ros_keys(status) == {maps: GRID, frames: FRAMES}
    assert ros_keys(recorded()) == {}
    assert topic_of(frames) == "/tf"


def test_a_file_that_is_there_is_kept(folder: Path) -> None:
    file = folder / "run.mcap"
    file.write_text("mine")
    refused = run("-o", file, "--for", "0.1s")
    assert (refused.exit_code, "is there already: name a new file" in refused.stderr) == (1, True)
    assert file.read_text() == "mine"


def test_a_disk_that_is_full_is_told_with_the_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is written last may find it when the file is closed."""
    opened = Path.open
    full = Path("/dev/full")

    def open_full(path: Path, mode: str = "r", *more: Any, **words: Any) -> Any:
        return opened(full, "wb") if mode == "xb" else opened(path, mode, *more, **words)

    monkeypatch.setattr(Path, "open", open_full)
    file = folder / "run.mcap"
    failed = run("-o", file, "--for", "0.1s")
    assert failed.exit_code == 1
    assert f"{file} cannot be written any more: No space left on device" in " ".join(failed.stderr.split())


def test_what_cannot_be_done_is_said_before_anything_is_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "run.mcap"
    for words, code, text in (
        (("--map", "a//b"), 2, "is no key expression"),
        (("--map", "a", "--connect", "tcp/127.0.0.1:1"), 2, "--map and --tf join the data network"),
        (("--tf", "a//b"), 2, "--tf: 'a//b' is no key expression"),
        (("--tf", "a", "--connect", "tcp/127.0.0.1:1"), 2, "--connect only asks"),
        (("--for", "soon"), 2, "is no duration"),
        (("--runtime-dir", folder / "none"), 3, "no daemon in"),
    ):
        refused = run("-o", file, *words)
        assert (refused.exit_code, text in refused.stderr) == (code, True), refused.stderr
    cell = Door(socket=Path(), endpoint="x", cell=Cell(name="hall-b", gateways=("tcp/127.0.0.1:1",)))
    with monkeypatch.context() as patched:
        patched.setattr("zsched.commands.base.ask.find_door", lambda *_given, **_more: cell)
        refused = run("-o", file, "--node", "hall-b/robot3", "--map", "robot3/map")
    assert (refused.exit_code, "on a machine of that fleet" in refused.stderr) == (2, True), refused.stderr
    assert run("-o", folder / "none" / "x.mcap").exit_code == 1
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    refused = run("-o", file)
    assert (refused.exit_code, "-m pip install 'zsched[mcap]'" in refused.stderr) == (1, True)
    assert not file.exists()
