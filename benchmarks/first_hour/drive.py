"""What happens inside of the clean machine: types the guide's commands on terminals, and writes what came of it.

``python3 drive.py PLAY REPORT``; needs the standard library alone, since the machine has nothing else yet. PLAY holds
the commands as the guide has them, and each task with the files that its author writes.
"""

from __future__ import annotations

import json
import os
import pty
import re
import select
import sys
import time
from pathlib import Path
from typing import Any

HOME = Path("/root")
CLONE = HOME / "zsched"
PROMPT = re.compile(rb"<rc (\d+)>")
COLUMNS, LINES = "100", "30"
INSTALL_S, COMMAND_S, FLEET_S, ANSWER_S, END_S = 400.0, 60.0, 120.0, 60.0, 40.0


class StumbledError(Exception):
    """A command of the guide did not do what the guide says."""


class Terminal:
    """A shell on a pseudo-terminal, as a stranger opens it; what is typed into it is counted."""

    def __init__(self, folder: Path) -> None:
        self.said = b""
        self.typed: list[str] = []
        pid, self._fd = pty.fork()
        if pid == 0:
            os.chdir(folder)
            names = {"HOME": str(HOME), "PATH": os.environ["PATH"], "TERM": "xterm-256color", "PS1": "<rc $?>"}
            pip = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
            sizes = {"COLUMNS": COLUMNS, "LINES": LINES, "VIRTUAL_ENV_DISABLE_PROMPT": "1"}
            os.execve("/bin/bash", ["bash", "--norc", "--noprofile", "-i"], {**names, **pip, **sizes})  # noqa: S606 - a terminal is a shell
        self.wait(PROMPT, COMMAND_S)

    def wait(self, pattern: re.Pattern[bytes], within_s: float, after: int = 0) -> re.Match[bytes]:
        """The first match in what it says from byte ``after`` on."""
        end = time.monotonic() + within_s
        while (match := pattern.search(self.said, after)) is None:
            if time.monotonic() > end:
                raise StumbledError(f"no {pattern.pattern!r} after {within_s:g} s; it said: {self._tail()}")
            if select.select([self._fd], [], [], 0.2)[0]:
                try:
                    self.said += os.read(self._fd, 65536)
                except OSError as error:
                    raise StumbledError(f"the terminal has ended: {self._tail()}") from error
        return match

    def _tail(self) -> str:
        return self.said[-1500:].decode(errors="replace")

    def type(self, line: str) -> int:
        """Type a command line; where in ``said`` its output begins."""
        self.typed.append(line)
        at = len(self.said)
        os.write(self._fd, line.encode() + b"\n")
        return at

    def run(self, line: str, within_s: float = COMMAND_S) -> None:
        """Type a command line, and wait until it has ended well."""
        match = self.wait(PROMPT, within_s, self.type(line))
        if match[1] != b"0":
            raise StumbledError(f"`{line}` ended with {match[1].decode()}: {self._tail()}")

    def press(self, key: str) -> int:
        """Press a key; where in ``said`` its output begins."""
        at = len(self.said)
        os.write(self._fd, key.encode())
        return at


def play_task(example: str, play: dict[str, Any], terminal: Terminal) -> dict[str, Any]:
    """From the example to answers that go on after a kill; what it took."""
    began, first = time.monotonic(), len(terminal.typed)
    folder = HOME / f"my-{example}"
    terminal.run(play["begin"].replace("new python", f"new {example}").replace("my-task", folder.name))
    own: dict[str, str] = play["tasks"][example]["files"]
    for name, text in own.items():
        (folder / name).write_text(text)
    answer = re.compile(play["tasks"][example]["answer"].encode())
    terminal.type(play["run"].replace("my-task", folder.name))
    started = len(terminal.said)
    terminal.wait(re.compile(rb": on \w+ \(epoch 1"), FLEET_S, started)
    placed_s = time.monotonic() - began
    other = Terminal(HOME)
    printed = re.compile(rb"dev: the application, in another terminal:\s+([^\r\n]+)")
    other.type(terminal.wait(printed, COMMAND_S, started)[1].decode())
    other.wait(answer, ANSWER_S)
    answered_s = time.monotonic() - began
    told = terminal.press("k")
    victim = terminal.wait(re.compile(rb"kill: (\w+) is dead"), COMMAND_S, told)[1].decode()
    killed, at = time.monotonic(), len(other.said)
    survivor = re.compile(rf"\(by (?!{victim}\))(\w+)\)".encode())
    by = other.wait(survivor, ANSWER_S, at)[1].decode()
    gap_s = time.monotonic() - killed
    terminal.wait(re.compile(f"{victim} starts again".encode()), COMMAND_S, told)
    total_s = time.monotonic() - began
    other.press("\x03")
    other.wait(PROMPT, COMMAND_S, at)
    at = terminal.press("q")
    ended = terminal.wait(PROMPT, END_S, at)[1].decode()
    lines = [*terminal.typed[first:], *other.typed]
    return {
        "seconds": total_s,
        "placed_s": placed_s,
        "answered_s": answered_s,
        "other_answers_after_s": gap_s,
        "killed": victim,
        "answered_by": by,
        "commands": lines,
        "files": sorted(own),
        "ended_with": int(ended),
        "left": left(),
        "screen": terminal.said[started:].decode(errors="replace"),
    }


def left() -> list[str]:
    """What there still is of a run."""
    found = [str(path) for path in Path("/tmp").glob("zsched-dev-*")]  # noqa: S108 - where it puts its folder
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and b"ZSCHED_DEV_RUN=" in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_text().replace("\0", " "))
        except OSError:
            continue
    return found


def main() -> None:
    """Play all of it."""
    play = json.loads(Path(sys.argv[1]).read_text())
    report: dict[str, Any] = {"tasks": {}}
    try:
        terminal = Terminal(CLONE)
        began = time.monotonic()
        for line in play["install"]:
            terminal.run(line, INSTALL_S)
        report["install"] = {"seconds": time.monotonic() - began, "commands": list(terminal.typed)}
        for example in play["tasks"]:
            report["tasks"][example] = play_task(example, play, terminal)
            Path(sys.argv[2]).write_text(json.dumps(report, indent=1))
    except StumbledError as error:
        report["stumbled"] = str(error)
    Path(sys.argv[2]).write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
