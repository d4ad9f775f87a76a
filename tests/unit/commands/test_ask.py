"""A command that comes while a daemon begins again waits for it, and for nothing else."""

from __future__ import annotations

import os
import re
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from zsched.commands.base import ask
from zsched.commands.base.ask import AGAIN_S, Door, ask_door, door_of, find_door
from zsched.commands.base.change import asker, user_name
from zsched.commands.base.common import CliError, Json
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.fleet import Cell
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.host import paths as places
from zsched.host.operator_socket import OperatorSocket
from zsched.host.paths import again_path, socket_path

ENV = {"ZSCHED_NODE": "robot1"}


def test_a_daemon_that_begins_again_is_waited_for(tmp_path: Path) -> None:
    mark = again_path(tmp_path, "robot1")
    mark.touch()
    door = OperatorSocket(socket_path(tmp_path, "robot1"), lambda request: {"verb": request["verb"]})
    found: list[Door] = []
    asking = threading.Thread(target=lambda: found.append(find_door(tmp_path, None, ENV)), daemon=True)
    asking.start()
    time.sleep(4 * ask.LOOK_S)
    assert not found, "it waits"
    door.open()
    mark.unlink()
    asking.join(30)
    assert [one.socket for one in found] == [socket_path(tmp_path, "robot1")]
    assert ask_door(found[0], {"verb": "status"}) == {"verb": "status"}
    door.close()


class Begins:
    """A daemon that begins again just when it is asked: the connection ends, and its next socket answers.

    A quick one answers there, and has taken its mark away, before the one that asks sees the connection's end.
    """

    def __init__(self, folder: Path, is_quick: bool = False) -> None:
        self._is_quick = is_quick
        self._path, self._mark = socket_path(folder, "robot1"), again_path(folder, "robot1")
        self.heard: list[str] = []
        self._first = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._first.bind(str(self._path))
        self._next = OperatorSocket(self._path, self._answer)
        self._first.listen(1)
        self._thread = threading.Thread(target=self._begin_again, daemon=True)
        self._thread.start()

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        self.heard.append(request["verb"])
        return {"verb": request["verb"]}

    def _begin_again(self) -> None:
        connection, _ = self._first.accept()
        with connection, connection.makefile("rb") as lines:
            lines.readline()
            self._mark.touch()
            if self._is_quick:
                self._open_next()
        if not self._is_quick:
            self._open_next()

    def _open_next(self) -> None:
        self._first.close()
        self._path.unlink()
        self._next.open()
        self._mark.unlink()

    def close(self) -> None:
        self._thread.join(30)
        self._next.close()


@pytest.mark.parametrize("is_quick", [False, True])
def test_a_question_that_meets_a_daemon_beginning_again_is_asked_once_more(tmp_path: Path, is_quick: bool) -> None:
    daemon = Begins(tmp_path, is_quick)
    door = Door(socket=socket_path(tmp_path, "robot1"))
    assert ask_door(door, {"verb": "fleet"}) == {"verb": "fleet"}
    daemon.close()


def test_an_order_that_it_may_have_taken_is_not_given_twice(tmp_path: Path) -> None:
    daemon = Begins(tmp_path, is_quick=True)
    door = Door(socket=socket_path(tmp_path, "robot1"))
    with pytest.raises(CliError, match="it ended before it answered"):
        ask_door(door, {"verb": "move"})
    daemon.close()
    assert daemon.heard == []


def test_one_that_is_dead_is_told(tmp_path: Path) -> None:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(socket_path(tmp_path, "robot1")))
    listener.close()
    with pytest.raises(CliError, match="no daemon answers at"):
        ask_door(Door(socket=socket_path(tmp_path, "robot1")), {"verb": "fleet"})


@pytest.mark.parametrize("ago_s", [AGAIN_S + 1.0, None])
def test_one_that_never_came_back_is_no_daemon(tmp_path: Path, ago_s: float | None) -> None:
    if ago_s is not None:
        mark = again_path(tmp_path, "robot1")
        mark.touch()
        os.utime(mark, (time.time() - ago_s,) * 2)
    with pytest.raises(CliError, match="no daemon in") as caught:
        find_door(tmp_path, None, ENV)
    assert caught.value.code == EXIT_UNREACHABLE


def test_a_secured_endpoint_without_a_fleet_file_here_says_which_file_is_meant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "fleet.yaml"))
    with pytest.raises(CliError, match=r"lets in who has its certificate, and .*fleet\.yaml, which names it") as caught:
        ask_door(find_door(None, None, ENV, connect="tls/127.0.0.1:1"), {"verb": "status"})
    assert caught.value.code == EXIT_CONFIG


def test_a_cell_with_the_file_of_another_fleet_says_whose_it_is(tmp_path: Path) -> None:
    file = tmp_path / "hall-b.yaml"
    file.write_text("fleet: hall-c\nnodes: {robot1: {kind: robot}}\ntasks: {}\n")
    cell = Cell(name="hall-b", gateways=("tls/127.0.0.1:1", "tls/127.0.0.1:2"), file=str(file))
    with pytest.raises(CliError, match=f"^{file} is the file of fleet hall-c, and not of hall-b; put a copy") as caught:
        ask_door(door_of(cell, "hall-a", None), {"verb": "status"})
    assert caught.value.code == EXIT_CONFIG


def test_a_cell_s_file_without_a_certificate_of_that_cell_says_what_to_write_in_it(tmp_path: Path) -> None:
    """A copy of its fleet file names this machine's own folder, where the certificate is of another authority."""
    file = tmp_path / "hall-b.yaml"
    nodes = "robot1: {kind: robot, listen: {control: tls/127.0.0.1:1, data: tls/127.0.0.1:2}}"
    file.write_text(f"fleet: hall-b\nnodes: {{{nodes}}}\ntasks: {{}}\nsecurity: {{folder: {tmp_path}}}\n")
    cell = Cell(name="hall-b", gateways=("tls/127.0.0.1:1", "tls/127.0.0.1:2"), file=str(file))
    with pytest.raises(
        CliError, match=r"`security: \{folder: FOLDER\}` in .*hall-b\.yaml, with your operator's"
    ) as told:
        ask_door(door_of(cell, "hall-a", None), {"verb": "status"})
    assert told.value.code == EXIT_CONFIG


def test_a_name_that_a_cell_has_not_is_refused_with_those_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gateway:
        """It passes questions on, and nobody answers them."""

        def ask(self, node: str, _command: object) -> None:
            raise AdapterError(f"{node} did not answer within 3 s")

        def status(self) -> object:
            return SimpleNamespace(nodes=[SimpleNamespace(name="edge1"), SimpleNamespace(name="robot1")])

    monkeypatch.setattr(ask, "_client", lambda _gateway, _cell: Gateway())
    cell = Cell(name="hall-b", gateways=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    with pytest.raises(CliError, match=r"^fleet hall-b has no node 'nosuch'; there are edge1, robot1$") as caught:
        ask_door(door_of(cell, "hall-a", None, "nosuch"), {"verb": "status"})
    assert caught.value.code == EXIT_USAGE
    with pytest.raises(CliError, match=r"^hall-b/edge1 cannot be asked; by tcp/127.0.0.1:1: edge1 did not") as caught:
        ask_door(door_of(cell, "hall-a", None, "edge1"), {"verb": "status"})
    assert caught.value.code == EXIT_UNREACHABLE


def test_which_of_several_daemons_asks_another_cell_is_said_by_the_environment_alone(tmp_path: Path) -> None:
    """There `--node` is the node of the other cell."""
    doors = [OperatorSocket(socket_path(tmp_path, name), lambda _request: {"error": "no"}) for name in ("ra", "rb")]
    for door in doors:
        door.open()
    for node, way in ((None, "with --node or ZSCHED_NODE"), ("hall-b/rb", "asks hall-b: with ZSCHED_NODE")):
        with pytest.raises(CliError, match=f": ra, rb; say which one {way}$") as caught:
            find_door(tmp_path, node, {})
        assert caught.value.code == EXIT_USAGE
    for door in doors:
        door.close()


def test_nobody_at_a_plain_endpoint_may_be_a_secured_fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ask, "CONNECT_S", 0.2)
    with pytest.raises(CliError, match=r"; a secured fleet is asked at tls/127\.0\.0\.1:1$") as caught:
        ask_door(find_door(None, None, ENV, connect="127.0.0.1:1"), {"verb": "status"})
    assert caught.value.code == EXIT_UNREACHABLE


@pytest.mark.parametrize(
    ("node", "is_let_in", "why"),
    [
        ("edge1", True, "in a secured fleet robot1 passes on no command from elsewhere: ask edge1 itself"),
        ("robot1", True, None),
        ("edge1", False, "its document must name ana (`security: {operators: [...]}` for people), not revoke the key"),
    ],
)
def test_a_silent_node_of_a_secured_fleet_is_not_taken_for_a_wrong_address(
    monkeypatch: pytest.MonkeyPatch, node: str, *, is_let_in: bool, why: str | None
) -> None:
    class There:
        """robot1, which passes on questions for the status only."""

        def ask(self, node: str, _command: object) -> None:
            raise AdapterError(f"{node} did not answer within 3 s")

        def status(self) -> object:
            if not is_let_in:
                raise AdapterError("it is silent")
            return SimpleNamespace(node="robot1")

    monkeypatch.setattr(ask, "_client", lambda _endpoint: There())
    monkeypatch.setattr(ask, "_visit", lambda *_given: SimpleNamespace(is_guest=False, asker="ana"))
    door = Door(socket=Path(), endpoint="tls/robot1:7457", node=node)
    with pytest.raises(CliError) as caught:
        ask_door(door, {"verb": "restart", "task": "merge", "by": "ana"})
    assert caught.value.code == EXIT_UNREACHABLE
    if why is None:
        assert str(caught.value) == "robot1 did not answer within 3 s"
    else:
        assert why in str(caught.value)


@pytest.mark.parametrize(
    ("endpoint", "node", "code"),
    [("tcp/robot1:7457", "edge1", 0), ("tls/robot1:7457", "robot1", 0), ("tls/robot1:7457", "edge1", EXIT_UNREACHABLE)],
)
def test_an_order_without_an_answer_may_have_been_carried_out_unless_it_was_not_passed_on(
    monkeypatch: pytest.MonkeyPatch, endpoint: str, node: str, code: int
) -> None:
    class There:
        """robot1, which tells every status."""

        def ask(self, node: str, _command: object) -> None:
            raise AdapterError(f"{node} did not answer within 3 s") from TimeoutError()

        def status(self) -> object:
            return SimpleNamespace(node="robot1")

    monkeypatch.setattr(ask, "_client", lambda _endpoint: There())
    monkeypatch.setattr(ask, "_visit", lambda *_given: SimpleNamespace(is_guest=False, asker="ana"))
    door, order = Door(socket=Path(), endpoint=endpoint, node=node), {"verb": "restart", "task": "merge", "by": "ana"}
    if code == 0:
        told = {"outcome": "unknown", "detail": f"{node} did not answer within 3 s", "revision": None}
        assert ask_door(door, order) == told
        return
    with pytest.raises(CliError, match="passes on no command from elsewhere") as caught:
        ask_door(door, order)
    assert caught.value.code == code


def test_where_systemd_has_the_unit_it_says_how_systemd_starts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`zsched up` by hand would leave files of root where the service's user writes."""
    unit, file = tmp_path / "zsched.service", tmp_path / "fleet.yaml"
    monkeypatch.setattr(ask, "UNITS", (unit,))
    monkeypatch.setattr(places, "SYSTEM_RUNTIME", tmp_path)
    env = {**ENV, "ZSCHED_CONFIG": str(file)}
    file.touch()
    with pytest.raises(CliError, match="start one with `zsched up`"):
        find_door(tmp_path, None, env)
    unit.touch()
    with pytest.raises(CliError, match="start it with `sudo systemctl start zsched`"):
        find_door(tmp_path, None, env)
    (tmp_path / "mine").mkdir()
    with pytest.raises(CliError, match="start one with `zsched up`"):
        find_door(tmp_path / "mine", None, env)


def test_on_a_machine_that_is_no_node_yet_it_says_how_it_becomes_one(tmp_path: Path) -> None:
    """`zsched up` would only say that its fleet file is missing."""
    with pytest.raises(CliError) as caught:
        find_door(tmp_path, None, {**ENV, "ZSCHED_CONFIG": str(tmp_path / "fleet.yaml")})
    for word in (f"no fleet file {tmp_path}/fleet.yaml", "zsched fleet create NAME", "zsched join INVITATION"):
        assert word in str(caught.value)
    assert "zsched up" not in str(caught.value)


def test_folders_that_are_closed_to_who_asks_are_no_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: Any) -> Any:
        raise PermissionError(13, "Permission denied", str(path))

    env = {**ENV, "ZSCHED_CONFIG": str(tmp_path / "closed" / "fleet.yaml")}
    for method in ("exists", "glob"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, method, refuse)
            patch.setattr(ask, "UNITS", ())
            with pytest.raises(CliError, match="no daemon in"):
                find_door(tmp_path, None, env)


def test_in_a_secured_cell_a_command_goes_to_the_gateway_that_it_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, str]] = []

    class Gateway:
        def __init__(self, name: str) -> None:
            self.name = name

        def ask(self, node: str | None, command: object) -> object:
            if command is None:
                return self.status()
            asked.append((self.name, str(node)))
            return CommandResult(outcome=CommandOutcome.OK, detail="")

        def status(self) -> object:
            if self.name == "edge2":
                raise AdapterError("it is gone")
            return SimpleNamespace(node=self.name, nodes=[SimpleNamespace(name=name) for name in ("edge1", "robot1")])

    names = {"tls/127.0.0.1:1": "edge1", "tls/127.0.0.1:2": "edge2", "tls/127.0.0.1:3": "robot1"}
    monkeypatch.setattr(ask, "_client", lambda gateway, _cell: Gateway(names[gateway]))
    monkeypatch.setattr(ask, "_visit", lambda *_given: SimpleNamespace(is_guest=False))
    cell = Cell(name="hall-b", gateways=tuple(names), file=str(tmp_path / "none"))
    order = {"verb": "restart", "task": "merge", "by": "ada@robot9"}
    assert ask_door(door_of(cell, "hall-a", None, "robot1"), order)["outcome"] == "ok"
    assert ask_door(door_of(cell, "hall-a", None, "edge1"), order)["outcome"] == "ok"
    assert asked == [("robot1", "robot1"), ("edge1", "edge1")]
    with pytest.raises(
        CliError, match=r"^robot2 is none of the gateways of hall-b that answer \(edge1, robot1\)"
    ) as none:
        ask_door(door_of(cell, "hall-a", None, "robot2"), order)
    assert none.value.code == EXIT_FAILED


def test_an_order_by_an_operator_s_certificate_has_its_name_and_any_other_that_of_the_user(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {"tls/robot1:1": "ana.operator", "tls/robot1:2": ""}
    monkeypatch.setattr(ask, "_visit", lambda endpoint, _cell: SimpleNamespace(operator=names[endpoint]))
    assert asker(Door(socket=Path(), endpoint="tls/robot1:1")) == "ana.operator"
    assert asker(Door(socket=Path(), endpoint="tls/robot1:2")).startswith(f"{user_name()}@")
    assert asker(Door(socket=Path("run/robot1.sock"))) == f"{user_name()}@robot1"


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"verb": "explain", "task": "Map Merge"}, "explain: explain.task: 'Map Merge' is not a name"),
        ({"verb": "change", "text": "#" * (1 << 18), "by": "ada@desk"}, "change: document.text: larger than"),
    ],
)
def test_what_no_node_takes_is_refused_without_a_daemon_here_as_by_one(request_: Json, said: str) -> None:
    """A wrong word, or a file that is too large, is no fault of the program: no traceback."""
    with pytest.raises(CliError, match=re.escape(said)) as refused:
        ask_door(Door(socket=Path(), endpoint="tcp/192.0.2.1:7457"), request_)
    assert refused.value.code == EXIT_FAILED
