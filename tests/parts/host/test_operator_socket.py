"""The operators' door: limits, hostile lines, concurrent connections, whose file it is."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import resource
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.waiting import until
from zsched.core.values.errors import AdapterError
from zsched.host import operator_socket
from zsched.host.operator_client import ask
from zsched.host.operator_socket import MAX_CONNECTIONS, MAX_LINE, RETRY_S, OperatorSocket

Json = dict[str, Any]


def echo(request: Json) -> Json:
    if request["verb"] == "raise":
        raise RuntimeError("a bug")
    return {"heard": copy.deepcopy(request)}


@pytest.fixture
def door(tmp_path: Path) -> Iterator[OperatorSocket]:
    made = OperatorSocket(tmp_path / "run" / "robot1.sock", echo)
    made.open()
    yield made
    made.close()


@contextlib.contextmanager
def connected(door: OperatorSocket) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(str(door.path))  # before the limit: with one, a full queue is an error at once
        connection.settimeout(5)
        yield connection


def read_line(connection: socket.socket) -> bytes:
    """One line, or what came before the other side closed."""
    received = b""
    while not received.endswith(b"\n"):
        chunk = connection.recv(65536)
        if not chunk:
            break
        received += chunk
    return received


# --- requests --------------------------------------------------------------------------------------------------------


def test_question_is_answered(door: OperatorSocket) -> None:
    assert ask(door.path, {"verb": "status", "node": "ü"}) == {"heard": {"verb": "status", "node": "ü"}}


def test_one_connection_asks_as_often_as_it_likes(door: OperatorSocket) -> None:
    with connected(door) as connection:
        for number in range(20):
            connection.sendall(json.dumps({"verb": "status", "n": number}).encode() + b"\n")
            assert json.loads(read_line(connection))["heard"]["n"] == number


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"\n", "not a JSON object on one line"),
        (b"not json\n", "not a JSON object on one line"),
        (b"\xff\xfe\x00\x01\n", "not a JSON object on one line"),
        (b"[" * 200_000 + b"\n", "nested too deeply"),
        *(
            (b'{"verb": "status", "node": ' + b"[" * deep + b"]" * deep + b"}\n", "nested too deeply")
            for deep in (950, 9000)
        ),
        (b"[1, 2]\n", "expected an object with a verb"),
        (b"{}\n", "expected an object with a verb"),
        (b'{"verb": 5}\n', "expected an object with a verb"),
        (b'{"verb": "raise"}\n', "RuntimeError: a bug"),
    ],
    ids=["empty", "text", "binary", "deep", "as deep as is read", "deeper", "list", "no verb", "verb 5", "bug"],
)
def test_bad_line_is_an_error_and_the_connection_lives(door: OperatorSocket, line: bytes, says: str) -> None:
    with connected(door) as connection:
        connection.sendall(line)
        assert says in json.loads(read_line(connection))["error"]
        connection.sendall(b'{"verb": "status"}\n')
        assert json.loads(read_line(connection)) == {"heard": {"verb": "status"}}


def test_endless_line_is_refused_once_and_cut_off(door: OperatorSocket) -> None:
    with connected(door) as connection:
        with contextlib.suppress(BrokenPipeError):
            connection.sendall(b"x" * (MAX_LINE + 10))
        answer = read_line(connection)
        assert "less than 1 MiB" in json.loads(answer)["error"]
        with contextlib.suppress(ConnectionResetError):
            assert connection.recv(10) == b""
    assert ask(door.path, {"verb": "status"})


def test_half_a_line_is_not_carried_out(tmp_path: Path) -> None:
    """What was cut off in the middle may happen to be whole JSON: still nobody has said that it ends there."""
    asked: list[Json] = []

    def note(request: Json) -> Json:
        asked.append(request)
        return {}

    door = OperatorSocket(tmp_path / "s", note)
    door.open()
    try:
        with connected(door) as connection:
            connection.sendall(b'{"verb": "weights"}')
            connection.shutdown(socket.SHUT_WR)
            assert "error" in json.loads(read_line(connection))
        assert ask(door.path, {"verb": "status"}) == {}
        assert asked == [{"verb": "status"}]
    finally:
        door.close()


def test_operator_that_goes_without_reading_harms_nobody(door: OperatorSocket) -> None:
    for _ in range(2 * MAX_CONNECTIONS):
        with connected(door) as connection:
            connection.sendall(b'{"verb": "status"}\n{"verb"')
    until(lambda: is_answered(door), "an answer, once the queue is empty")
    until(lambda: not door._open, "every connection's thread has ended")


def is_answered(door: OperatorSocket) -> bool:
    with contextlib.suppress(AdapterError):
        return bool(ask(door.path, {"verb": "status"}))
    return False


# --- connections -----------------------------------------------------------------------------------------------------


def test_slow_answers_do_not_hold_each_other_up(tmp_path: Path) -> None:
    """As many as there are places are answered at the same time."""
    together = threading.Barrier(MAX_CONNECTIONS, timeout=60)

    def wait(_request: Json) -> Json:
        together.wait()
        return {"ok": True}

    door = OperatorSocket(tmp_path / "s", wait)
    door.open()
    answers: list[Json] = []
    threads = [
        threading.Thread(target=lambda: answers.append(ask(door.path, {"verb": "x"}, 60)))
        for _ in range(MAX_CONNECTIONS)
    ]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
    finally:
        door.close()
    assert answers == [{"ok": True}] * MAX_CONNECTIONS


def test_who_is_silent_keeps_nobody_from_asking(door: OperatorSocket) -> None:
    """Also after thousands of connections, of which none is given up by its owner."""
    with contextlib.ExitStack() as stack:
        held = [stack.enter_context(connected(door)) for _ in range(MAX_CONNECTIONS)]
        for connection in held:
            connection.sendall(b'{"verb": "status"}\n')
            read_line(connection)
        for _ in range(20 * MAX_CONNECTIONS):
            stack.enter_context(connected(door))
        until(lambda: is_answered(door), "an answer")
        assert read_line(held[0]) == b"", "the first of them had to go"
    until(lambda: not door._open, "every connection's thread has ended")


def test_one_more_than_can_be_answered_at_once_is_told_so(tmp_path: Path) -> None:
    goes_on = threading.Event()
    door = OperatorSocket(tmp_path / "s", lambda _request: {"ok": goes_on.wait(60)})
    door.open()
    try:
        with contextlib.ExitStack() as stack:
            for _ in range(MAX_CONNECTIONS):
                stack.enter_context(connected(door)).sendall(b'{"verb": "x"}\n')
            until(lambda: list(door._open.values()) == [True] * MAX_CONNECTIONS, "all are being answered")
            assert "busy" in ask(door.path, {"verb": "status"})["error"]
            goes_on.set()
            until(lambda: "ok" in ask(door.path, {"verb": "status"}), "a place, once they have their answers")
    finally:
        goes_on.set()
        door.close()


def test_a_time_without_descriptors_is_outlived(door: OperatorSocket, caplog: pytest.LogCaptureFixture) -> None:
    """Nobody can be taken meanwhile, and afterwards everybody can, as well who waits since then."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken: list[int] = []
    with contextlib.ExitStack() as stack:
        waiting = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(3)]
        highest = max(int(path.name) for path in Path("/proc/self/fd").iterdir())
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 2, before[1]))
        try:
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open("/dev/null", os.O_RDONLY))
            for connection in waiting:  # the kernel may have kept a descriptor for the first
                connection.connect(str(door.path))
                connection.sendall(b'{"verb": "status"}\n')
            until(lambda: "no_connection_taken" in caplog.text, "the daemon notices")
            threading.Event().wait(5 * RETRY_S)
            assert caplog.text.count("no_connection_taken") == 1, "it says so once"
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            for descriptor in taken:
                os.close(descriptor)
        for connection in waiting:
            connection.settimeout(10)
            assert read_line(connection), "it is answered now"
    assert is_answered(door)


def test_silent_connection_is_closed_after_a_while(door: OperatorSocket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_socket, "IDLE_S", 0.05)
    with connected(door) as connection:
        assert connection.recv(1) == b""


# --- the file --------------------------------------------------------------------------------------------------------


def test_only_owner_and_group_may_ask(door: OperatorSocket) -> None:
    assert stat.S_IMODE(door.path.stat().st_mode) == 0o660


def test_close_removes_the_file_and_can_be_said_twice(door: OperatorSocket) -> None:
    door.close()
    assert not door.path.exists()
    door.close()
    with pytest.raises(AdapterError, match="no daemon answers"):
        ask(door.path, {"verb": "status"})


def test_stale_socket_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "robot1.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as dead:
        dead.bind(str(path))
    door = OperatorSocket(path, echo)
    door.open()
    try:
        assert ask(path, {"verb": "status"})
    finally:
        door.close()


def test_socket_that_somebody_answers_on_is_left_alone(door: OperatorSocket) -> None:
    second = OperatorSocket(door.path, echo)
    with pytest.raises(AdapterError, match=r"a daemon answers on .* already"):
        second.open()
    second.close()
    assert ask(door.path, {"verb": "status"}), "the first one's file is still there"


def test_socket_of_a_daemon_that_is_too_busy_to_accept_is_left_alone(tmp_path: Path) -> None:
    """A stopped daemon's queue of connections fills up; its socket is not stale."""
    path = tmp_path / "robot1.sock"
    with contextlib.ExitStack() as stack:
        busy = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        busy.bind(str(path))
        busy.listen(0)
        for _ in range(2):
            waiting = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            waiting.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                waiting.connect(str(path))
        with pytest.raises(AdapterError, match=r"a daemon answers on .* already"):
            OperatorSocket(path, echo).open()
        with pytest.raises(AdapterError, match="is it wedged"):
            ask(path, {"verb": "status"}, 0.05)
        assert path.exists()


def test_path_that_is_too_long_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match="shorter --runtime-dir"):
        OperatorSocket(tmp_path / ("x" * 100), echo).open()


def test_folder_that_cannot_be_made_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(AdapterError, match="check --runtime-dir"):
        OperatorSocket(tmp_path / "file" / "robot1.sock", echo).open()


# --- asking ----------------------------------------------------------------------------------------------------------


def test_ask_says_whether_nobody_is_there_or_nobody_answers(tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match="start it with `zsched up`"):
        ask(tmp_path / "none.sock", {"verb": "status"})
    path = tmp_path / "mute.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as mute:
        mute.bind(str(path))
        mute.listen()
        with pytest.raises(AdapterError, match=r"within 0\.05 s; is it wedged"):
            ask(path, {"verb": "status"}, 0.05)


@pytest.mark.parametrize(("answer", "says"), [(b"[1]\n", "no object"), (b"hello\n", "no daemon answers")])
def test_ask_refuses_answers_that_are_no_object(tmp_path: Path, answer: bytes, says: str) -> None:
    path = tmp_path / "odd.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as odd:
        odd.bind(str(path))
        odd.listen()

        def serve() -> None:
            connection, _ = odd.accept()
            with connection:
                connection.recv(65536)
                connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(AdapterError, match=says):
            ask(path, {"verb": "status"})
        thread.join(60)
    assert os.path.lexists(path)
