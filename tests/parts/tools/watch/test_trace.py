"""`zsched trace` against a real collector's protocol: what arrives is decoded by OpenTelemetry's own definitions."""

from __future__ import annotations

import contextlib
import http.server
import json
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.host.clock import wall_s
from zsched.host.latch import Latch
from zsched.host.operator_socket import OperatorSocket
from zsched.tools.watch.trace import trace_id

STATUS: dict[str, Any] = json.loads(
    (Path(__file__).parents[3] / "unit/tools/watch/recorded/fleet.json").read_text(encoding="utf-8")
)


class Collector:
    """Takes spans over HTTP and keeps them."""

    def __init__(self) -> None:
        self.taken: list[Any] = []
        self.code = 200
        collector = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                data = self.rfile.read(int(self.headers["Content-Length"]))
                assert self.path == "/v1/traces"
                assert self.headers["Content-Type"] == "application/x-protobuf"
                if collector.code == 200:
                    collector.taken.append(ExportTraceServiceRequest.FromString(data))
                self.send_response(collector.code)
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
                pass

        self._server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@pytest.fixture
def collector() -> Iterator[Collector]:
    with contextlib.closing(Collector()) as made:
        yield made


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A daemon whose log holds an old move, and one of just now."""
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    now = wall_s()
    lines = [*move(now - 9000.0, 4, "edge1"), *move(now - 1.0, 5, "edge2")]
    page = {"node": "robot1", "now": now, "entries": lines, "cursor": "1", "more": False}
    daemon = OperatorSocket(tmp_path / "robot1.sock", lambda asked: STATUS if asked["verb"] == "status" else page)
    daemon.open()
    yield tmp_path
    daemon.close()


def move(at: float, epoch: int, owner: str) -> list[dict[str, Any]]:
    told = {"epoch": epoch, "revision": epoch, "left": "edge3", "owner": owner, "reason": "edge3 is gone", "votes": []}
    head = {"node": "robot1", "life": 7, "task": "echo"}
    return [
        {"at": at, "stage": "scheduler", "text": f"propose {owner}: edge3 is gone", "epoch": epoch - 1, **head},
        {"at": at + 0.05, "stage": "vote", "text": "learnt", "epoch": epoch, "move": told, **head},
        {
            "at": at + 0.125,
            "stage": "executor",
            "text": f"flipped to {owner} in 75 ms",
            "epoch": epoch,
            "took_s": 0.075,
            **head,
        },
    ]


@contextlib.contextmanager
def closing_endpoint() -> Iterator[str]:
    """A port that is bound, where nobody listens."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield f"http://127.0.0.1:{bound.getsockname()[1]}"


def run(collector: Collector, *arguments: str) -> Result:
    return CliRunner().invoke(app, ["trace", "--otlp", collector.url, "--once", *arguments])


def test_a_collector_gets_one_span_for_each_move(collector: Collector, folder: Path) -> None:
    assert folder.exists()
    done = run(collector, "--since", "1m")
    assert (done.exit_code, done.stderr) == (0, "1 spans sent, 0 refused\n")
    (request,) = collector.taken
    (resource,) = request.resource_spans
    about = {one.key: one.value.string_value for one in resource.resource.attributes}
    assert (
        about.items()
        >= {"service.name": "zsched", "service.namespace": "testbed", "service.instance.id": "robot1"}.items()
    )
    (span,) = resource.scope_spans[0].spans
    assert (span.name, int.from_bytes(span.trace_id, "big")) == ("move echo", trace_id("testbed", "echo", 5))
    assert span.end_time_unix_nano - span.start_time_unix_nano == pytest.approx(125e6, abs=2e3)
    told = {one.key: one.value for one in span.attributes}
    assert (told["zsched.from"].string_value, told["zsched.to"].string_value) == ("edge3", "edge2")
    assert (told["zsched.epoch"].int_value, told["zsched.switched_s"].double_value) == (5, 0.075)
    assert [event.name.split()[0] for event in span.events] == ["propose", "learnt", "flipped"]


def test_older_moves_are_sent_when_they_are_asked_for(collector: Collector, folder: Path) -> None:
    assert folder.exists()
    assert run(collector, "--since", "1d").stderr == "2 spans sent, 0 refused\n"
    assert len(collector.taken) == 2


def test_a_move_of_long_ago_that_has_no_end_is_not_sent_unasked(
    collector: Collector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On an edge, which flips nothing, each start sent the newest move of every task once more."""
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    steps = iter([False, False, True])
    monkeypatch.setattr(Latch, "wait", lambda _latch, _s=None: next(steps))
    page = {"node": "robot1", "now": wall_s(), "entries": move(wall_s() - 9000.0, 4, "edge1")[:2], "cursor": "1"}
    first = iter([page["entries"]])

    def answer(asked: dict[str, Any]) -> dict[str, Any]:
        return STATUS if asked["verb"] == "status" else {**page, "entries": next(first, []), "more": False}

    with contextlib.closing(OperatorSocket(tmp_path / "robot1.sock", answer)) as daemon:
        daemon.open()
        result = CliRunner().invoke(app, ["trace", "--otlp", collector.url])
    assert (result.exit_code, result.stderr) == (0, "0 spans sent, 0 refused\n")


def test_spans_that_nobody_takes_are_counted(collector: Collector, folder: Path) -> None:
    assert folder.exists()
    collector.code = 400
    done = run(collector, "--since", "1m")
    assert (done.exit_code, "0 spans sent, 1 refused" in done.stderr) == (1, True)


def test_a_collector_that_is_not_there_is_told_of_once(folder: Path) -> None:
    assert folder.exists()
    with closing_endpoint() as url:
        done = CliRunner().invoke(app, ["trace", "--otlp", url, "--once", "--since", "1d"])
    assert done.exit_code == 1
    told = " ".join(done.stderr.split())
    assert told.count(f"zsched trace: {url} takes no spans (Connection refused): is it a collector") == 1
    assert told.endswith("and not kept 0 spans sent, 2 refused")


def test_a_daemon_that_is_away_is_told_of_once(
    folder: Path, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = iter(["away", "away", "away", "back", "away", "end"])

    def wait(_latch: Latch, _s: float | None = None) -> bool:
        step, here, gone = next(steps), folder / "robot1.sock", folder / "gone"
        if step == "away" and here.exists():
            here.rename(gone)
        elif step == "back":
            gone.rename(here)
        return step == "end"

    monkeypatch.setattr(Latch, "wait", wait)
    result = CliRunner().invoke(app, ["trace", "--otlp", collector.url])
    assert result.stderr.count("asking again") == 2


def test_a_log_that_cannot_be_read_is_no_quiet_fleet(
    tmp_path: Path, collector: Collector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It said "0 spans sent, 0 refused", and ended with 0."""

    def wait(_latch: Latch, _s: float | None = None) -> bool:
        return next(steps)

    def answer(asked: dict[str, Any]) -> dict[str, Any]:
        return STATUS if asked["verb"] == "status" else {"error": "OSError: [Errno 5] Input/output error"}

    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    steps = iter([False, False, True])
    monkeypatch.setattr(Latch, "wait", wait)
    with contextlib.closing(OperatorSocket(tmp_path / "robot1.sock", answer)) as daemon:
        daemon.open()
        once = run(collector)
        running = CliRunner().invoke(app, ["trace", "--otlp", collector.url])
    assert once.exit_code == 1
    assert "nothing was sent: " in once.stderr
    assert "Input/output error" in once.stderr
    assert (running.stderr.count("Input/output error"), collector.taken) == (1, []), "once, however often it is asked"


@pytest.mark.parametrize("url", ["nonsense", "127.0.0.1:4318", "grpc://127.0.0.1:4317", "http://", "http://[::1:4318"])
def test_what_is_no_address_of_a_collector_is_refused(folder: Path, url: str) -> None:
    assert folder.exists()
    refused = CliRunner().invoke(app, ["trace", "--otlp", url, "--once"])
    assert (refused.exit_code, f"--otlp {url}: no address of a collector" in refused.stderr) == (2, True)


def test_without_the_library_it_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert folder.exists()
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    refused = CliRunner().invoke(app, ["trace", "--once"])
    assert (refused.exit_code, "-m pip install 'zsched[trace]'" in refused.stderr) == (1, True)
