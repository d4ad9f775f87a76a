"""`zsched web` over real connections: what is told, live events, every bound, and the page in a real browser."""

from __future__ import annotations

import contextlib
import copy
import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from support import browser
from support.signals import signal_another_thread, signal_at_once
from support.waiting import DEADLINE_S, until
from zsched.commands.base.ask import Door
from zsched.host.operator_socket import OperatorSocket
from zsched.tools.metrics import metrics_text
from zsched.tools.watch import hub as hubs
from zsched.tools.watch import web as webs
from zsched.tools.watch.feed import Feed
from zsched.tools.watch.gate import FILES, HEADERS, Gate
from zsched.tools.watch.hub import WAITING, Hub
from zsched.tools.watch.web import MOST_CONNECTIONS, MOST_HEAD_BYTES, WebServer

STATUS: dict[str, Any] = json.loads(
    (Path(__file__).parents[3] / "unit/tools/watch/recorded/fleet.json").read_text(encoding="utf-8")
)
TOKEN = "a-token-of-some-length"
PAIRS = 5
"""Of two signals close together that are tried."""


class FakeDaemon:
    """An operator socket that answers with the recorded status, and with a new line of the log when it is told to."""

    def __init__(self, folder: Path) -> None:
        self.status = copy.deepcopy(STATUS)
        for task in self.status["tasks"]:
            task["history"] = []
        self.lines: list[dict[str, Any]] = []
        self.asked: list[str] = []
        self.socket = OperatorSocket(folder / "robot1.sock", self.answer)
        self.socket.open()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        self.asked.append(request["verb"])
        if request["verb"] == "status":
            return self.status
        if request["verb"] == "explain":
            return {"detail": "the fleet has no task"}
        first = int(request["cursor"] or 0)
        found = self.lines[first:]
        return {"node": "robot1", "now": 100.0, "entries": found, "cursor": str(len(self.lines)), "more": False}

    def move(self, epoch: int, owner: str) -> None:
        told = {"epoch": epoch, "revision": epoch, "left": "edge1", "owner": owner, "reason": "edge1 is <b>gone</b>"}
        head = {"at": 99.0, "node": "robot1", "life": 1, "stage": "vote", "text": "learnt", "task": "echo"}
        self.lines.append({**head, "epoch": epoch, "move": told})


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[FakeDaemon]:
    made = FakeDaemon(tmp_path)
    yield made
    made.socket.close()


@contextlib.contextmanager
def serving(folder: Path, *, token: str = "", most_clients: int = 8, request_s: float = 5.0) -> Iterator[WebServer]:
    door = Door(socket=folder / "robot1.sock")
    hub = Hub(Feed(lambda: door), most_clients=most_clients)
    gate = Gate(names=frozenset({"localhost"}), token=token)
    with contextlib.closing(WebServer("127.0.0.1", 0, gate, hub, request_s=request_s)) as server:
        server.start()
        until(lambda: hub.status()["status"], "the first status")
        yield server


@pytest.fixture
def server(daemon: FakeDaemon, tmp_path: Path) -> Iterator[WebServer]:
    assert daemon.asked == []
    with serving(tmp_path) as made:
        yield made


def ask(server: WebServer, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=DEADLINE_S)
    with contextlib.closing(connection):
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


class Live:
    """A client of /api/live, as simple as one can be."""

    def __init__(self, server: WebServer, **headers: str) -> None:
        self.connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=DEADLINE_S)
        self.connection.request("GET", "/api/live", headers=headers)
        self.answer = self.connection.getresponse()

    def next(self) -> tuple[str, dict[str, Any]]:
        kind = self.answer.readline().decode()
        data = self.answer.readline().decode()
        assert self.answer.readline() == b"\n"
        return kind.removeprefix("event: ").strip(), json.loads(data.removeprefix("data: "))

    def close(self) -> None:
        self.answer.close()
        self.connection.close()


# --- what is told ----------------------------------------------------------------------------------------------------


def test_every_answer_bears_the_headers_and_files_are_as_shipped(server: WebServer) -> None:
    for path, (name, kind) in FILES.items():
        code, headers, body = ask(server, path)
        assert (code, headers["Content-Type"]) == (200, kind)
        assert body == (Path(webs.__file__).parent / "page" / name).read_bytes()
        assert ask(server, path, "HEAD")[2] == b""
    for path, method in (("/", "GET"), ("/none", "GET"), ("/", "POST"), ("/metrics", "GET"), ("/api/status", "GET")):
        _, headers, _ = ask(server, path, method)
        assert headers.items() >= HEADERS.items(), (path, method)
        assert "Server" not in headers


def test_metrics_are_those_of_metrics_print_and_another_parser_reads_them(
    server: WebServer, daemon: FakeDaemon
) -> None:
    code, headers, body = ask(server, "/metrics")
    assert (code, headers["Content-Type"]) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert body.decode() == metrics_text(STATUS)
    assert len(list(text_string_to_metric_families(body.decode()))) > 20
    daemon.socket.close()
    until(lambda: b"zsched_up 0" in ask(server, "/metrics")[2], "a daemon that is down")
    assert ask(server, "/metrics")[2].count(b"\n") == 3, "no old figure stays"


def test_refusals_come_over_the_wire_as_the_gate_says(daemon: FakeDaemon, tmp_path: Path) -> None:
    assert daemon.asked == []
    with serving(tmp_path, token=TOKEN) as server:
        assert ask(server, "/metrics")[0] == 401
        assert ask(server, "/metrics", Authorization=f"Bearer {TOKEN}")[0] == 200
        assert ask(server, f"/?token={TOKEN}")[0] == 400
        assert ask(server, "/", Host="evil.example")[0] == 421
        assert ask(server, "/", "DELETE")[0] == 405
        assert ask(server, "/api/live", Authorization=f"Bearer {TOKEN}", **{"Sec-Fetch-Site": "cross-site"})[0] == 403
        for junk in (
            b"\r\n\r\n",
            b"GET\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
            b"\x16\x03\x01\x00\n",
            b"GET / HTTP/1.1\r\n\r\n",
        ):
            with socket.create_connection(("127.0.0.1", server.port), DEADLINE_S) as connection:
                connection.sendall(junk)
                answer = connection.makefile("rb").read()
            assert b" 200 " not in answer.split(b"\r\n")[0], junk
        assert "status" in daemon.asked
        assert "explain" not in daemon.asked


def test_a_task_that_is_not_there_is_said(server: WebServer) -> None:
    code, _, body = ask(server, "/api/explain/nothing")
    assert (code, json.loads(body)) == (503, {"error": "the fleet has no task"})


# --- live ------------------------------------------------------------------------------------------------------------


def test_events_tell_everything_first_and_then_what_is_new(server: WebServer, daemon: FakeDaemon) -> None:
    with contextlib.closing(Live(server)) as live:
        assert live.answer.getheader("Content-Type") == "text/event-stream"
        kind, body = live.next()
        assert (kind, set(body["points"]), body["moves"]) == ("past", {"detect", "echo"}, [])
        kind, body = live.next()
        assert (kind, body["status"]["fleet"], body["degraded"]) == ("now", "testbed", [])
        daemon.move(3, "edge3")
        while (told := live.next())[0] != "log":
            assert told[0] == "now"
        assert [(move["epoch"], move["to"]) for move in told[1]["moves"]] == [(3, "edge3")]
        assert [event["text"] for event in told[1]["events"]] == ["learnt"]
    with contextlib.closing(Live(server)) as late:
        assert [move["to"] for move in late.next()[1]["moves"]] == ["edge3"]


def test_however_many_look_the_daemon_is_asked_once_in_a_second(server: WebServer, daemon: FakeDaemon) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(contextlib.closing(Live(server))) for _ in range(3)]
        for client in clients:
            assert [client.next()[0] for _ in range(3)] == ["past", "now", "now"]
        before = daemon.asked.count("status")
        for client in clients:
            client.next()
        assert daemon.asked.count("status") - before <= 2, "one more may be on its way"


def test_one_more_than_may_look_is_told_to_come_again(daemon: FakeDaemon, tmp_path: Path) -> None:
    assert daemon.asked == []
    with serving(tmp_path, most_clients=2) as server:
        lives = [Live(server) for _ in range(2)]
        refused = Live(server)
        assert (refused.answer.status, refused.answer.getheader("Retry-After")) == (503, "5")
        refused.close()
        lives.pop().close()
        until(lambda: look(server) == 200, "a free place")
        lives.pop().close()


def look(server: WebServer) -> int:
    with contextlib.closing(Live(server)) as live:
        return live.answer.status


def test_who_is_too_far_behind_is_dropped_and_the_others_go_on(daemon: FakeDaemon, tmp_path: Path) -> None:
    hub = Hub(Feed(lambda: Door(socket=tmp_path / "robot1.sock")))
    slow, quick = hub.join(), hub.join()
    assert slow is not None
    assert quick is not None
    for _ in range(WAITING + 3):
        daemon.move(1, "edge1")
        hub._step()
        while not quick.messages.empty():
            assert quick.messages.get() is not None
    assert slow.is_dropped
    assert slow.messages.qsize() <= WAITING + 1
    assert not quick.is_dropped


# --- bounds ----------------------------------------------------------------------------------------------------------


def test_who_does_not_say_what_it_wants_is_cut_off_and_many_such_are_not_taken(
    daemon: FakeDaemon, tmp_path: Path
) -> None:
    assert daemon.asked == []
    with serving(tmp_path, request_s=1.0) as server, contextlib.ExitStack() as stack:
        silent = [
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), DEADLINE_S))
            for _ in range(MOST_CONNECTIONS)
        ]
        one_more = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), DEADLINE_S))
        assert one_more.recv(100).startswith(b"HTTP/1.1 503 ")
        silent[0].sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ")
        until(lambda: is_cut_off(silent[0]), "the end of who says a letter now and then", 20.0)
        assert silent[1].recv(100) == b""
        until(lambda: ask(server, "/")[0] == 200, "a connection is taken again")


@pytest.mark.parametrize("lines", ["GET /" + "x" * 60_000, "X: " + "x" * 60_000, f"X: {'x' * 1000}\r\n" * 60])
def test_a_head_of_more_than_some_kilobytes_is_not_read(server: WebServer, lines: str) -> None:
    """The library's own bounds are lines of 64 KiB, a hundred of them, and that of every connection."""
    some = {f"X-{number}": "x" * 1000 for number in range(15)}
    assert ask(server, "/", **some)[0] == 200
    head = ("" if lines.startswith("GET") else "GET / HTTP/1.1\r\n") + lines
    with socket.create_connection(("127.0.0.1", server.port), DEADLINE_S) as connection:
        connection.sendall(head[: MOST_HEAD_BYTES + 1].encode())
        assert connection.makefile("rb").readline() == b"HTTP/1.1 431 Request Header Fields Too Large\r\n"


def is_cut_off(connection: socket.socket) -> bool:
    """Says one more letter of a header, and looks whether anybody listens."""
    connection.settimeout(0.05)
    try:
        connection.sendall(b"x")
        return connection.recv(100) == b""
    except TimeoutError:
        return False
    except OSError:
        return True


def test_no_thread_is_left_at_the_end(daemon: FakeDaemon, tmp_path: Path) -> None:
    assert daemon.asked == []
    with serving(tmp_path) as server, contextlib.closing(Live(server)) as live:
        assert live.next()[0] == "past"
        server.close()
        while live.answer.readline():
            pass
    until(lambda: not [t for t in threading.enumerate() if t.name.startswith("zsched-web")], "the end of all threads")


def test_the_hub_asks_less_often_while_nobody_looks() -> None:
    assert hubs.IDLE_S >= 5 * hubs.PERIOD_S


# --- the verb, and a browser -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def verb(folder: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`zsched web` as a process, and the address that it tells."""
    command = [sys.executable, "-m", "zsched.cli", "web", "--listen", "127.0.0.1:0", "--runtime-dir", str(folder)]
    with subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            while "http://" not in line:
                assert line, "it has ended"
                line = process.stderr.readline()
            yield process, line.split()[2].rstrip(",;")
        finally:
            process.kill()


def test_the_verb_waits_for_a_daemon_and_ends_on_sigterm(tmp_path: Path) -> None:
    with verb(tmp_path) as (process, address):
        port = int(address.rstrip("/").rpartition(":")[2])
        with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=DEADLINE_S)) as connection:
            connection.request("GET", "/api/status")
            body = json.loads(connection.getresponse().read())
        assert body["status"] is None
        made = FakeDaemon(tmp_path)
        try:
            until(lambda: made.asked, "a question to the daemon that came")
        finally:
            made.socket.close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0


@pytest.mark.parametrize("is_pair", [True, False], ids=["SIGHUP and SIGTERM", "another thread's"])
def test_the_verb_ends_whichever_thread_has_the_signal(tmp_path: Path, is_pair: bool) -> None:
    """The kernel gives the second signal to another thread, and a wait without an end never let its handler run."""
    for _ in range(PAIRS if is_pair else 1):
        with verb(tmp_path) as (process, _):
            if is_pair:
                signal_at_once(process, signal.SIGHUP, signal.SIGTERM)
            else:
                signal_another_thread(process, signal.SIGTERM)
            assert process.wait(20) in (0, -signal.SIGTERM)  # the second one may come when it has ended


@pytest.mark.skipif(browser.PATH is None, reason=browser.WHY_NOT)
def test_a_browser_shows_the_page_at_both_widths_without_a_word_on_its_console(
    server: WebServer, daemon: FakeDaemon, tmp_path: Path
) -> None:
    daemon.move(3, "edge3")
    hostile = "<img src=x onerror=alert(1)>"
    daemon.status["nodes"][0]["workers"][0]["task"] = hostile
    daemon.status["tasks"][-1]["name"] = "constructor"  # as of every object in JavaScript
    text = "document.body.innerText"
    with browser.browsing(tmp_path) as page:
        for width in (1280, 390):
            page.open(server.address, width, 900)
            page.wait_for(f"{text}.includes('epoch 3: edge1 \u2192 edge3: edge1 is <b>gone</b>')")
            page.wait_for("document.querySelectorAll('#tasks path').length === 6")
            for words in ("fleet testbed", "constructor", "edge2/echo/robot1/in", "quorum 3 of 3", hostile):
                page.wait_for(f"{text}.includes({json.dumps(words)})")  # status and log come one after the other
            links = page.value("[...document.querySelectorAll('#topology text')].map((one) => one.textContent)")
            assert {"-57", "-66", "-81", "edge1", "robot3"} <= set(links)
            boxes = "[...document.querySelectorAll('#topology .box')]"
            assert page.value(f"{boxes}.map((box) => box.getBoundingClientRect().width > 80)") == [True] * 6
            assert page.value(f"{boxes}.filter((box) => box.matches('.owner')).length") == 1
            assert page.value("document.documentElement.scrollWidth <= window.innerWidth"), "no sideways scrolling"
            assert page.value("document.images.length") == 0
            page.value("document.querySelector('#tasks button').click()")
            page.wait_for(f"{text}.includes('the fleet has no task')")
        before = page.value("document.getElementById('link').textContent")
        page.wait_for(f"document.getElementById('link').textContent !== {json.dumps(before)}")
        daemon.socket.close()
        page.wait_for("document.getElementById('link').textContent.startsWith('no answer since')")
        told = [one for one in page.said if "503" not in one]  # the refused explanation is told as a failed load
    assert told == []


@pytest.mark.skipif(browser.PATH is None, reason=browser.WHY_NOT)
def test_a_browser_asks_for_the_token_and_takes_one_from_behind_the_hash(daemon: FakeDaemon, tmp_path: Path) -> None:
    assert daemon.asked == []
    with serving(tmp_path, token=TOKEN) as server, browser.browsing(tmp_path) as page:
        page.open(server.address, 390, 900)
        page.wait_for("!document.getElementById('ask').hidden")
        page.value(f"document.getElementById('token').value = {json.dumps(TOKEN)}")
        page.value("document.querySelector('#ask button').click()")
        page.wait_for("document.body.innerText.includes('fleet testbed')")
        page.value("sessionStorage.clear()")
        page.open("about:blank", 390, 900)
        page.open(f"{server.address}#token={TOKEN}", 390, 900)
        page.wait_for("document.body.innerText.includes('fleet testbed')")
        assert page.value("location.href") == server.address, "the address does not keep it"
