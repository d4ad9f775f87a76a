"""The small parts of a development run: shares of the CPUs, files that were saved, lines of a daemon's log."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from zsched.cli import app
from zsched.commands.base.common import CliError
from zsched.config.load import load_fleet
from zsched.core.values.model import NodeId
from zsched.host.latch import Latch
from zsched.tools.dev.run import LASTING_S, Lasting, Run
from zsched.tools.dev.verb import DEFAULT_JOINS, ENTER, _commands, application, entrance, json5
from zsched.tools.dev.watch import Watched

EXAMPLE = Path(__file__).parents[4] / "zsched" / "tools" / "examples" / "python" / "fleet.yaml"


def test_a_saved_file_is_noticed_once_and_one_that_is_away_is_not(tmp_path: Path) -> None:
    worker, other = tmp_path / "worker.py", tmp_path / "other.py"
    worker.write_text("1")
    other.write_text("1")
    commands = {"shout": ("python", "worker.py", "--fast"), "sing": ("python", str(other)), "none": ()}
    watched = Watched(commands, tmp_path)
    assert watched.files == {"shout": (worker,), "sing": (other,), "none": ()}
    assert watched.changed() == {}
    worker.write_text("1 2")
    assert watched.changed() == {"shout": "worker.py"}
    assert watched.changed() == {}
    other.unlink()  # as an editor does for a moment
    assert watched.changed() == {}
    other.write_text("3")
    os.utime(other, ns=(1, 1))
    assert watched.changed() == {"sing": "other.py"}


def test_the_application_is_started_by_one_line_from_any_folder(tmp_path: Path) -> None:
    folder = tmp_path / "my task"
    folder.mkdir()
    assert application(folder, ("python", "worker.py"), DEFAULT_JOINS) is None
    (folder / "ask.py").write_text("")
    file = str(folder / "ask.py")
    for worker, joins, expected in (
        (("python", "worker.py"), DEFAULT_JOINS, [sys.executable, file]),
        (("python", "worker.py"), "tcp/127.0.0.1:61234", [sys.executable, file, "tcp/127.0.0.1:61234"]),
        (("/usr/bin/python3", "worker.py"), DEFAULT_JOINS, ["/usr/bin/python3", file]),
        (("/opt/detector",), DEFAULT_JOINS, [sys.executable, file]),
        ((), DEFAULT_JOINS, [sys.executable, file]),
    ):
        words = application(folder, worker, joins)
        assert words is not None
        assert shlex.split(words) == expected


def test_a_worker_is_named_alone_or_with_its_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text("")
    (tmp_path / "binary").write_text("")
    fleet = load_fleet(EXAMPLE)
    assert _commands(fleet, EXAMPLE, ["my.py"]) == {"shout": ("python", str(tmp_path / "my.py"))}
    assert _commands(fleet, EXAMPLE, ["shout=binary"]) == {"shout": (str(tmp_path / "binary"),)}
    several = replace(fleet, tasks=(*fleet.tasks, replace(fleet.tasks[0], name="sing")))
    for tasks, given, told in (
        (fleet, "nowhere.py", r"nowhere\.py is no file"),
        (fleet, "sout=my.py", "no task 'sout'; did you mean shout"),
        (several, "my.py", r"several tasks \(shout, sing\).*--task TASK=worker.py"),
    ):
        with pytest.raises(CliError, match=told) as error:
            _commands(tasks, EXAMPLE, [given])
        assert error.value.code == 2


def test_a_fleet_without_tasks_has_nothing_to_run(tmp_path: Path) -> None:
    """`zsched fleet create` writes such a file, and `zsched check` only warns of it."""
    (tmp_path / "fleet.yaml").write_text("fleet: x\nnodes:\n  robot1: {kind: robot}\ntasks: {}\n")
    for words in (("dev", str(tmp_path)), ("dev", str(tmp_path), "--task", __file__)):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 78
        assert "fleet.yaml has no task, and there is nothing to run; write one under `tasks:`" in result.stderr


def test_the_snippet_is_the_configuration_of_a_client() -> None:
    config = zenoh.Config.from_json5(json5("tcp/127.0.0.1:7458"))
    assert config.get_json("mode") == '"client"'
    assert config.get_json("connect/endpoints") == '["tcp/127.0.0.1:7458"]'
    assert config.get_json("transport/shared_memory/enabled") == "false"  # some containers may lock no memory
    assert max(map(len, json5("tcp/127.0.0.1:65535").splitlines())) <= 76  # indented, on a terminal of 80 columns


class _Nodes:
    """Nodes that only tell what is asked of them."""

    def __init__(self) -> None:
        self.fleet = load_fleet(EXAMPLE)
        self.folder = self.file = self.work_folder = Path()
        self.stopped: list[NodeId] = []

    def is_up(self, _node: NodeId) -> bool:
        return True

    def loaded(self) -> tuple[NodeId, ...]:
        return ()

    def stop(self, node: NodeId) -> None:
        self.stopped.append(node)


@pytest.mark.parametrize(
    ("state", "said", "stopped"),
    [
        ("ready", "move: edge1 is told to stop, hands shout over, and starts again", ["edge1"]),
        ("starting", "move: shout stays on edge1: the worker on edge2 is starting", []),
        ("stopped", "move: shout stays on edge1: the worker on edge2 is stopped", []),
    ],
)
def test_a_task_is_moved_only_to_a_worker_that_is_ready(state: str, said: str, stopped: list[str]) -> None:
    nodes, told = _Nodes(), list[str]()
    run = Run(nodes, Watched({}, EXAMPLE.parent), say=told.append, show=lambda _: None, stop=Latch())  # type: ignore[arg-type]
    run._owners = {"shout": (NodeId("edge1"), 1)}
    run._status = {"nodes": [{"name": "edge2", "workers": [{"task": "shout", "state": state}]}]}
    run._obey("m")
    assert told == [said]
    assert nodes.stopped == stopped


def test_a_worker_s_file_that_is_written_later_is_noticed(tmp_path: Path) -> None:
    watched = Watched({"shout": ("python", "worker.py"), "echo": ("python", "-m", "zsched.tasks.echo")}, tmp_path)
    assert watched.changed() == {}
    (tmp_path / "worker.py").write_text("1")
    assert watched.changed() == {"shout": "worker.py"}
    assert watched.files["echo"] == ()


def test_another_terminal_asks_this_fleet_by_every_verb(tmp_path: Path) -> None:
    work = tmp_path / "my task"
    work.mkdir()
    nodes = _Nodes()
    nodes.folder, nodes.file, nodes.work_folder = tmp_path, tmp_path / "fleet.yaml", work
    script = tmp_path / ENTER
    script.write_text(entrance(nodes, NodeId("robot1")))  # type: ignore[arg-type]
    code = f"source {script} && pwd && env | grep ^ZSCHED_ | sort"
    told = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert told == [
        str(work),
        f"ZSCHED_CONFIG={tmp_path}/fleet.yaml",
        "ZSCHED_NODE=robot1",
        f"ZSCHED_RUNTIME_DIR={tmp_path}",
        f"ZSCHED_STATE_DIR={tmp_path}/robot1",
    ]


def test_a_failed_worker_whose_file_is_not_watched_is_tried_again_by_a_verb(tmp_path: Path) -> None:
    nodes, told = _Nodes(), list[str]()
    nodes.folder = tmp_path
    command = ("python", "-m", "shout")
    run = Run(nodes, Watched({"shout": command}, tmp_path), say=told.append, show=lambda _: None, stop=Latch())  # type: ignore[arg-type]
    run._tell_worker(NodeId("edge1"), "shout", "failed")
    assert f"then `zsched restart shout edge1 --runtime-dir {tmp_path} --node edge1`" in told[0]


def test_what_is_wrong_with_a_task_is_told_once_when_it_has_lasted_and_again_when_it_comes_back() -> None:
    lasting = Lasting()
    waits = "shout: this robot's streams have waited for edge1 for {} s: nobody subscribes to edge1/shout"
    assert lasting.told([waits.format(2)], 100.0) == []
    assert lasting.told([], 102.0) == [], "a move makes such a problem for a moment"
    assert lasting.told([waits.format(2)], 103.0) == []
    assert lasting.told([waits.format(7), "shout: it may hang"], 103.0 + LASTING_S) == [waits.format(7)]
    assert lasting.told([waits.format(8), "shout: it may hang"], 103.1 + LASTING_S) == []
    assert lasting.told(["shout: it may hang"], 103.0 + 2 * LASTING_S) == ["shout: it may hang"]
    assert lasting.told([waits.format(2)], 120.0) == []
    assert lasting.told([waits.format(7)], 120.0 + LASTING_S) == [waits.format(7)]


def test_a_run_tells_what_is_wrong_with_its_tasks_but_no_failed_worker_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes, told = _Nodes(), list[str]()
    nodes.folder = Path("/run/dev")
    run = Run(nodes, Watched({}, EXAMPLE.parent), say=told.append, show=lambda _: None, stop=Latch())  # type: ignore[arg-type]
    task = {
        "name": "shout",
        "owner": None,
        "epoch": 0,
        "problems": ["the worker on edge1 failed: exited with status 3", "the worker on edge2: it may hang"],
        "problem_kinds": ["worker_failed", "other"],
    }
    node = {"name": "edge1", "workers": [{"task": "shout", "state": "failed"}]}
    monkeypatch.setattr(nodes, "status", lambda: {"tasks": [task], "nodes": [node]}, raising=False)
    run._look(100.0)
    run._look(100.0 + LASTING_S)
    assert [line for line in told if "has failed" not in line] == ["shout: the worker on edge2: it may hang"]
