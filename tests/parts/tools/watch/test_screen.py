"""`zsched top` as a process on a terminal of its own: it draws, follows the size, ends on `q`, and leaves no trace."""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import json
import os
import pty
import re
import select
import shutil
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.waiting import DEADLINE_S, until
from zsched.core.values.exits import EXIT_UNREACHABLE
from zsched.host.operator_socket import OperatorSocket
from zsched.host.screen import drawn as drawn_lines
from zsched.tools.watch.screen import ENTER, LEAVE

STATUS: dict[str, Any] = json.loads(
    (Path(__file__).parents[3] / "unit/tools/watch/recorded/fleet.json").read_text(encoding="utf-8")
)
EMPTY = {"node": "robot1", "now": 0.0, "entries": [], "cursor": "", "more": False}


class Terminal:
    """A terminal with `zsched top` on it."""

    def __init__(self, folder: Path) -> None:
        self.controller, self._terminal = pty.openpty()
        self.resize(80, 24)
        self.before = termios.tcgetattr(self._terminal)
        words = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
        self.process = subprocess.Popen(
            ["setsid", "--ctty", sys.executable, "-m", "zsched.cli", "top", "--interval", "0.2"],
            env={**words, "TERM": "xterm", "ZSCHED_RUNTIME_DIR": str(folder)},
            stdin=self._terminal,
            stdout=self._terminal,
            stderr=subprocess.PIPE,
        )
        self.seen = ""
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        """What was read may end within a character."""

    def resize(self, columns: int, lines: int) -> None:
        fcntl.ioctl(self._terminal, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))

    def type(self, keys: str) -> None:
        os.write(self.controller, keys.encode())

    def read(self) -> str:
        while select.select([self.controller], [], [], 0.0)[0]:
            self.seen += self._decoder.decode(os.read(self.controller, 65536))
        return self.seen

    def wait_for(self, text: str) -> None:
        until(lambda: text in self.read(), f"{text!r} on the screen")

    def screen(self) -> list[str]:
        """The lines of the newest whole screen."""
        return re.sub(r"\x1b\[[0-9;]*m|\x1b\[[JK]", "", self.read()).split("\x1b[H")[-2].split("\r\n")

    def attributes(self) -> list[Any]:
        return termios.tcgetattr(self._terminal)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self.controller)
        os.close(self._terminal)


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[OperatorSocket]:
    made = OperatorSocket(tmp_path / "robot1.sock", lambda request: STATUS if request["verb"] == "status" else EMPTY)
    made.open()
    yield made
    made.close()


@pytest.fixture
def terminal(daemon: OperatorSocket) -> Iterator[Terminal]:
    made = Terminal(daemon.path.parent)
    with contextlib.closing(made):
        yield made


def test_it_draws_follows_the_size_and_leaves_the_terminal_as_it_was_on_q(terminal: Terminal) -> None:
    terminal.wait_for("q ends")
    assert terminal.seen.startswith(ENTER)
    until(lambda: terminal.read().count("\x1b[H") > 3, "more screens")
    assert len(terminal.screen()) == 24
    terminal.resize(120, 40)
    until(lambda: len(terminal.screen()) == 40, "a screen of 40 lines")
    terminal.type("q")
    assert terminal.process.wait(DEADLINE_S) == 0
    assert terminal.read().endswith(LEAVE)
    assert terminal.attributes() == terminal.before


@pytest.mark.skipif(shutil.which("tmux") is None, reason="tmux draws the screen")
def test_a_line_of_wide_characters_is_cut_and_moves_no_other(tmp_path: Path) -> None:
    """A character of two columns makes a line twice as wide as its length, and the whole line keeps its last one."""
    lines = ["a" * 40, "\u6f22" * 40, "next", *[""] * 2, "z" * 40]
    drawn = tmp_path / "drawn"
    drawn.write_text(ENTER + drawn_lines(["old" * 13] * 6, "\r\n") + drawn_lines(lines, "\r\n"), encoding="utf-8")
    tmux = ["tmux", "-u", "-S", str(tmp_path / "tmux")]
    cat = f"stty raw; cat {drawn}; sleep 60"
    words = {**os.environ, "LC_ALL": "C.UTF-8"}
    subprocess.run([*tmux, "new-session", "-d", "-x", "40", "-y", "6", cat], check=True, timeout=10, env=words)

    def seen() -> list[str]:
        shown = subprocess.run([*tmux, "capture-pane", "-p"], check=True, timeout=10, capture_output=True, env=words)
        return shown.stdout.decode().splitlines()

    try:
        until(lambda: seen()[-1].startswith("z"), "the last line")
        assert seen() == ["a" * 40, "\u6f22" * 20, "next", "", "", "z" * 40]
    finally:
        subprocess.run([*tmux, "kill-server"], check=True, timeout=10, env=words)


def test_a_daemon_that_goes_away_is_said_and_ctrl_c_ends(terminal: Terminal, daemon: OperatorSocket) -> None:
    terminal.wait_for("q ends")
    daemon.close()
    terminal.wait_for("no answer since")
    terminal.type("\x03")
    assert terminal.process.wait(DEADLINE_S) == EXIT_UNREACHABLE
    assert terminal.read().endswith(LEAVE)
    assert terminal.attributes() == terminal.before
