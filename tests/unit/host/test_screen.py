"""What people read at a terminal fits it; what another program reads stays as it is."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from zsched.commands.base.common import print_json
from zsched.host.screen import harmless, wrapped

WIDTH = 80
SENTENCE = "zsched apply: nothing was changed, for " + "the fleet has another revision by now and " * 3


def test_a_sentence_is_broken_between_its_words() -> None:
    told = wrapped(SENTENCE, WIDTH)
    assert all(len(line) <= WIDTH for line in told.split("\n"))
    assert [line[:2] for line in told.split("\n")[1:]] == ["  "] * (len(told.split("\n")) - 1)
    assert told.split() == SENTENCE.split()


@pytest.mark.parametrize(
    "command",
    [
        "zsched task add " + "a-file-with-a-name " * 5,
        "sudo zsched move map_merge edge2 --reason 'it is too hot: the fan of edge1 stands still since an hour' --yes",
        "  zsched pause map_merge -m 'a reason with a colon: and more of it, until the line is full and goes on'",
    ],
)
def test_a_command_stays_whole_for_it_is_copied(command: str) -> None:
    assert wrapped(command, WIDTH) == command
    quoted = f"`{command.strip()}`"
    assert quoted in wrapped(f"{SENTENCE}{quoted} does it", WIDTH).split("\n  ")


def shown_on_a_terminal(arguments: list[str], folder: Path) -> str:
    """What a program writes to stderr, which alone is a terminal of 80 columns."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, WIDTH, 0, 0))
    env = {name: value for name, value in os.environ.items() if name != "COLUMNS" and not name.startswith("ZSCHED_")}
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments], stdout=subprocess.PIPE, stderr=theirs, cwd=folder, env=env
    )
    os.close(theirs)
    said = b""
    while True:
        try:
            said += os.read(ours, 65536)
        except OSError:  # the last of them has closed it
            break
    os.close(ours)
    process.communicate()
    return said.decode().replace("\r\n", "\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["zsched", "status", "--runtime-dir", "nobody"], "or say where"),
        (
            ["zsched", "up", "--config", "fleet.yaml", "--node", "vm", "--state-dir", "s"],
            "say which one this",
        ),
        (["zsched", "check", "wrong.yaml"], "did you mean 'wifi'?"),
        (["zsched", "drain", "--only", "old", "--"], "Error: Invalid value for '--only': 'old' is not"),
        (["zsched", "status", "--interval", "0"], "Input should be greater"),
        (["zsched", "dev", "empty"], "zsched new python empty"),
    ],
)
def test_what_a_verb_refuses_fits_the_terminal(arguments: list[str], words: str, tmp_path: Path) -> None:
    example = (Path(__file__).parents[3] / "zsched/tools/examples/python/fleet.yaml").read_text()
    (tmp_path / "fleet.yaml").write_text(example)
    (tmp_path / "empty").mkdir()
    (tmp_path / "wrong.yaml").write_text(f"timing: wlan\n{example}".replace("nodes:", "nodez:"))
    said = shown_on_a_terminal(arguments, tmp_path)
    assert words in " ".join(said.split())
    assert [line for line in said.split("\n") if len(line) > WIDTH] == []


def test_json_for_a_terminal_holds_nothing_that_it_obeys_and_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    """JSON itself escapes the controls below 32 only; half a character could not even be written."""
    body = {"text": "a\x1b[2J\x7f\x9b2J\u202ecod.exe\u2066\ud800 \u00e9\u2713"}
    for is_line in (False, True):
        print_json(body, is_line=is_line)
        told = capsys.readouterr().out
        assert json.loads(told) == body
        assert harmless(told) == told
        assert "\u00e9\u2713" in told, "what people read stays"
