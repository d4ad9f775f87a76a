"""`zsched top` as text at both sizes it promises, and what a screen must never do; feed and memory behind it.

The recorded answer of a real fleet lies in ``recorded/`` with the screens it gives; ``UPDATE_GOLDEN=1 pytest ...``
writes the screens anew (look at the difference before you commit it).
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import re
import select
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from zsched.cli import app
from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_UNREACHABLE
from zsched.host.operator_socket import OperatorSocket
from zsched.tools.watch.feed import Feed, News, Past
from zsched.tools.watch.screen import LEAVE
from zsched.tools.watch.top import Frame, render_top

RECORDED = Path(__file__).parent / "recorded"
NOON = time.mktime((2026, 3, 4, 12, 0, 0, 0, 0, -1))
SIZES = {(80, 24): "80x24", (120, 40): "120x40"}
SMALL = Frame(width=80, height=24, is_colored=False, now=NOON)


def recorded() -> dict[str, Any]:
    status: dict[str, Any] = json.loads((RECORDED / "fleet.json").read_text())
    return status


def move(age_s: float, task: str, epoch: int, left: str | None, owner: str, reason: str) -> dict[str, Any]:
    told = {"epoch": epoch, "revision": epoch, "left": left, "owner": owner, "reason": reason}
    head = {"at": NOON - age_s, "node": "robot1", "life": 7, "task": task, "epoch": epoch}
    return {**head, "stage": "vote", "text": "learnt", "move": told}


def past_of(seconds: int = 40, status: dict[str, Any] | None = None) -> Past:
    """A fleet whose best edge got busy, and whose tasks moved 20 s ago."""
    past = Past()
    for number in range(seconds):
        now = copy.deepcopy(recorded() if status is None else status)
        for task in now["tasks"]:
            task["decision"]["age_s"] = 0.3
            task["owner"] = "edge1" if number < seconds - 20 else "edge2"
            busy = 0.9 - 0.02 * number
            task["decision"]["aggregates"] = {"edge1": max(busy, 0.1), "edge2": 0.7, "edge3": 0.4}
        entries: tuple[dict[str, Any], ...] = ()
        if number == seconds - 20:
            reason = "edge2 leads by 0.2 over edge1 with its bonus; staying has cost 0.21"
            entries = (
                move(250.0, "echo", 1, None, "edge1", "first placement: edge1 is worth most"),
                move(20.0, "echo", 2, "edge1", "edge2", reason),
                {"at": NOON - 19.9, "life": 7, "task": "echo", "epoch": 2, "took_s": 0.043},
            )
        past.take(News(at=NOON - seconds + number + 1, status=now, entries=entries))
    return past


@pytest.mark.parametrize(("size", "name"), SIZES.items(), ids=SIZES.values())
def test_a_recorded_fleet_looks_as_agreed(size: tuple[int, int], name: str) -> None:
    lines = render_top(past_of(), replace(SMALL, width=size[0], height=size[1]))
    golden = RECORDED / f"top.{name}.txt"
    text = "\n".join(lines) + "\n"
    if os.environ.get("UPDATE_GOLDEN"):
        golden.write_text(text)
    assert text == golden.read_text()
    assert len(lines) == size[1]


def test_an_owner_that_was_there_before_the_start_is_no_move_on_the_screen() -> None:
    past = past_of()
    known = move(5.0, "echo", 2, None, "edge2", "known from before the restart")
    known["move"]["is_known"] = True
    past.take(News(at=NOON, status=recorded(), entries=(known,)))
    text = "\n".join(render_top(past, replace(SMALL, width=120, height=40)))
    assert "known from" not in text
    assert "nobody -> edge2" not in text
    assert "edge1 -> edge2" in text


@pytest.mark.parametrize(("epoch", "shown"), [(1, ["nobody -> edge1"]), (7, [])])
def test_without_a_log_the_first_owner_told_is_a_move_only_as_the_first_placement(epoch: int, shown: list[str]) -> None:
    status = recorded()
    told = {"revision": epoch, "epoch": epoch, "owner": "edge1", "age_s": 9.0, "reason": "learnt from a peer"}
    status["tasks"] = [{**status["tasks"][0], "history": [told]}]
    past = Past()
    past.take(News(at=NOON, status=status, entries=()))
    text = "\n".join(render_top(past, replace(SMALL, width=120, height=40)))
    assert re.findall(r"nobody -> \w+", text) == shown


def visible(line: str) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", line)


@pytest.mark.parametrize("width", [60, 80, 97, 120, 200])
@pytest.mark.parametrize("height", [12, 24, 40, 60])
def test_no_screen_is_wider_or_higher_than_the_terminal(width: int, height: int) -> None:
    status = recorded()
    status["nodes"] = [{**status["nodes"][0], "name": f"edge{number}"} for number in range(30)]
    status["tasks"] = [{**status["tasks"][0], "name": f"task{number}"} for number in range(20)]
    status["problems"] = ["a problem that takes more words than any line of a terminal has room for " * 3] * 9
    for past in (past_of(), past_of(3, status)):
        for is_colored in (False, True):
            frame = replace(SMALL, width=width, height=height, is_colored=is_colored)
            lines = render_top(past, frame)
            assert len(lines) == height
            assert max(len(visible(line)) for line in lines) <= width


def test_a_daemon_that_went_away_is_said_below_its_last_figures() -> None:
    past = past_of()
    past.take(News(at=NOON + 5, status=None, why="no daemon there"))
    lines = render_top(past, replace(SMALL, now=NOON + 5))
    assert lines[-1] == "no answer since 12:00:00: no daemon there"
    assert any(line.startswith("echo ") for line in lines)
    nothing = Past()
    nothing.take(News(at=NOON, status=None, why="no daemon"))
    assert render_top(nothing, SMALL)[0] == "no daemon"


# --- what is kept ----------------------------------------------------------------------------------------------------


def test_without_a_log_the_moves_are_those_that_the_status_remembers() -> None:
    past, status = Past(), recorded()
    status["tasks"] = status["tasks"][:1]
    told = [("edge1", 60.0), ("edge1", 50.0), ("edge2", 9.0)]
    status["tasks"][0]["history"] = [
        {"epoch": 1, "revision": number, "owner": owner, "age_s": age_s, "reason": "because"}
        for number, (owner, age_s) in enumerate(told)
    ]
    past.take(News(at=NOON, status=status))
    assert [(one["from"], one["to"], one["age_s"]) for one in past.moves()] == [
        (None, "edge1", 60.0),
        ("edge1", "edge2", 9.0),
    ]


# --- who is asked ----------------------------------------------------------------------------------------------------


def test_the_feed_reads_on_in_the_log_and_waits_for_a_daemon_that_is_away(tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        if request["verb"] == "status":
            return recorded()
        number = int(request["cursor"] or 0) + 1
        entry = move(1.0, "echo", number, None, "edge1", "first")
        return {"node": "robot1", "now": NOON, "entries": [entry], "cursor": str(number), "more": False}

    found: list[Door] = []

    def find() -> Door:
        if not found:
            raise CliError(EXIT_UNREACHABLE, "no daemon yet")
        return found[0]

    feed = Feed(find)
    assert (feed.ask().status, feed.ask().why) == (None, "no daemon yet")
    daemon = OperatorSocket(tmp_path / "robot1.sock", answer)
    daemon.open()
    try:
        found.append(Door(socket=tmp_path / "robot1.sock"))
        first, second = feed.ask(), feed.ask()
    finally:
        daemon.close()
    assert [entry["epoch"] for news in (first, second) for entry in news.entries] == [1, 2]
    assert [one["verb"] for one in asked] == ["status", "log", "status", "log"]
    assert (third := feed.ask()).status is None
    assert "no daemon answers" in third.why


def test_a_log_that_cannot_be_read_hides_no_status(tmp_path: Path) -> None:
    """A worn SD card: `zsched web` said that no daemon answers, and a critical alert with it."""

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        return recorded() if request["verb"] == "status" else {"error": "OSError: [Errno 5] Input/output error"}

    daemon = OperatorSocket(tmp_path / "robot1.sock", answer)
    daemon.open()
    try:
        news = Feed(lambda: Door(socket=tmp_path / "robot1.sock")).ask()
    finally:
        daemon.close()
    assert news.status is not None
    assert (news.why, news.entries) == ("", ())
    assert "no events are shown: " in news.status["problems"][-1]
    assert "Input/output error" in news.status["problems"][-1]


def test_a_clock_that_is_set_back_hides_nothing_that_is_told_from_then_on() -> None:
    past, status = past_of(), recorded()
    newest = past.points["echo"][-1].at
    for task in status["tasks"]:
        task["decision"]["age_s"] = 0.1
        task["decision"]["aggregates"] = {"edge1": 0.125}
    past.take(News(at=newest - 3600, status=status))
    assert past.points["echo"][-1].totals == {"edge1": 0.125}
    assert len(past.points["echo"]) == 1


def test_a_certificate_that_goes_is_told_as_a_daemon_that_is_away() -> None:
    def find() -> Door:
        raise ConfigError("/etc/zsched/pki/certificate.pem: No such file or directory")

    news = Feed(find).ask()
    assert (news.status, news.code, news.why.startswith("/etc/zsched/pki/")) == (None, 78, True)


def test_another_node_s_log_is_not_asked_for(tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        return recorded()

    daemon = OperatorSocket(tmp_path / "robot1.sock", answer)
    daemon.open()
    try:
        assert Feed(lambda: Door(socket=tmp_path / "robot1.sock", node="robot2")).ask().status is not None
    finally:
        daemon.close()
    assert asked == [{"verb": "status", "node": "robot2"}]


# --- the verb --------------------------------------------------------------------------------------------------------


def test_once_prints_a_screen_and_exits_as_status_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("LINES", "24")
    status = recorded()
    empty = {"node": "robot1", "now": NOON, "entries": [], "cursor": "", "more": False}
    daemon = OperatorSocket(tmp_path / "robot1.sock", lambda request: status if request["verb"] == "status" else empty)
    daemon.open()
    try:
        fine = CliRunner().invoke(app, ["top", "--once"])
        status["tasks"][0]["owner"] = None
        degraded = CliRunner().invoke(app, ["top", "--once"])
        refused = CliRunner().invoke(app, ["top"])
    finally:
        daemon.close()
    assert (fine.exit_code, degraded.exit_code, refused.exit_code) == (0, 4, 2)
    assert fine.stdout.startswith("fleet testbed ")
    assert "\x1b" not in fine.stdout
    assert "needs a terminal" in refused.stderr


@contextlib.contextmanager
def live(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], int, Callable[[], bool]]]:
    """`zsched top` once it takes keys: (process, its terminal's other end, whether the terminal is as it was)."""
    empty = {"node": "robot1", "now": NOON, "entries": [], "cursor": "", "more": False}
    daemon = OperatorSocket(folder / "robot1.sock", lambda one: recorded() if one["verb"] == "status" else empty)
    controller, terminal = os.openpty()
    before = termios.tcgetattr(terminal)
    daemon.open()
    try:
        command = [sys.executable, "-m", "zsched.cli", "top", "--runtime-dir", str(folder)]
        plain = {**os.environ, "NO_COLOR": "1"}
        with subprocess.Popen(command, env=plain, stdin=terminal, stdout=terminal, stderr=terminal) as process:
            shown = b""
            while b"fleet testbed" not in shown:  # a screen: keys are taken
                assert select.select([controller], [], [], 60)[0], shown
                shown += os.read(controller, 1 << 16)
            try:
                yield process, controller, lambda: termios.tcgetattr(terminal) == before
            finally:
                process.kill()  # nothing where it has ended
    finally:
        daemon.close()
        os.close(controller)
        os.close(terminal)


def shown_to_the_end(controller: int) -> bytes:
    """What comes until the terminal is given back."""
    shown = b""
    while LEAVE.encode() not in shown and select.select([controller], [], [], 10)[0]:
        shown += os.read(controller, 1 << 16)
    return shown


def test_sigterm_gives_the_terminal_back_as_it_was(tmp_path: Path) -> None:
    with live(tmp_path) as (process, controller, is_as_before):
        assert not is_as_before()
        process.terminate()
        shown = shown_to_the_end(controller)
        assert process.wait(60) == 0
        assert shown.endswith(LEAVE.encode()), "back to what stood there"
        assert is_as_before()


def test_keys_that_come_at_once_count_each(tmp_path: Path) -> None:
    """A held arrow over a slow line, or `q` twice; they were no key together."""
    with live(tmp_path) as (process, controller, _):
        os.write(controller, b"\x1b[Bjq")
        assert shown_to_the_end(controller).endswith(LEAVE.encode())
        assert process.wait(60) == 0
