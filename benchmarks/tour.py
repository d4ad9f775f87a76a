"""Plays every verb of `zsched --help` on a live fleet of six machines, and records the screens.

``python -m benchmarks.tour [--columns 80] [--rows 24] [--cast FILE] [--screens FOLDER] [--page FILE]``; about four
minutes.

The fleet is founded, joined and left by its verbs (`zsched_lab.fleet.hall`): three robots and three edges on loopback,
with certificates, one task, and an application that asks ten times a second. Each verb runs on a terminal of its own of
that size. ``--cast`` writes an asciicast (version 2), for `asciinema play`; ``--screens`` a text file for each verb;
``--page`` the transcript of docs/guide/tour.md: the verbs of `ON_PAGE`, whole, with the usual paths of a machine.
At the end: every line that is wider than the terminal, and every verb that was not played.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import pty
import re
import select
import shlex
import socket
import struct
import sys
import tempfile
import termios
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any, Final

import typer
import zenoh

from benchmarks.common import machine
from zsched.cli import app
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports
from zsched_lab.fleet.pace import at_pace

NODES: Final = ("robot1", "robot2", "robot3", "edge1", "edge2", "edge3")
ASKS_HZ: Final = 10.0
FLOWS_S: Final = 6.0
"""The first screen shows the rate of a stream that has flowed for so long."""
LONGEST_S: Final = 60.0
QUIT_S: Final = 15.0
SHOWN_PAUSE_S: Final = 1.0
"""Between two verbs of the recording; pauses within one are shortened to that, too."""
ESCAPES: Final = re.compile(r"\x1b(?:\[[0-9;?>]*[ -/]*[@-~]|\][^\x07]*\x07|[()][AB0]|[=>])")
HOST: Final = "robot1"
"""What the machine of a recording is called."""
PER_NODE: Final = 5
"""Ports of one node: its sessions, its local side, and what it dials from."""
TASK: Final = """\
tasks:
  echo:
    candidates: [robot1]
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in"}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out"}]
"""
ON_PAGE: Final = (
    "status",
    "explain echo",
    "history echo",
    "drain edge2 --yes -m tour",
)
"""What the page shows; the recording has every verb."""
PLACES: Final = (("/state", "/var/lib/zsched"), ("/etc", "/etc/zsched"), ("/run", "/run/zsched"))
_OTHER_WORDS: Final = (("echo:", "second:"), ("/echo/", "/second/"), ("/in", "/scan"), ("/out", "/seen"))
OTHER_TASK: Final = reduce(lambda text, words: text.replace(*words), _OTHER_WORDS, TASK)


@dataclass(slots=True, kw_only=True)
class Step:
    """One command: where, its words, and what is pressed after so many seconds."""

    node: str
    words: str
    keys: str = ""
    after_s: float = 2.0
    env: dict[str, str] = field(default_factory=dict)
    into: str = ""
    """A file in its node's folder, which takes what is printed (``> into``)."""

    @property
    def line(self) -> str:
        """What one types."""
        return f"zsched {self.words}{f' > {self.into}' if self.into else ''}"

    @property
    def verb(self) -> str:
        """The verb's name, of a group its first word."""
        return self.words.split()[0]


@dataclass(slots=True, kw_only=True)
class Seen:
    """What a terminal showed of one step."""

    step: Step
    code: int | None
    seconds: float
    events: list[tuple[float, str]]

    @property
    def text(self) -> str:
        """All of it without colours."""
        return ESCAPES.sub("", "".join(text for _, text in self.events)).replace("\r\n", "\n")


def the_tour(port: int) -> list[Step]:
    """Every verb, in an order that makes sense to who watches."""
    one = "robot1"
    plain = [
        "--version",
        "version",
        "status",
        "status -v",
        "status --node edge2",
        "explain echo",
        "explain echo --plan edge1=down",
        "history echo",
        "events",
        "explain --replay decisions.ndjson",
        "top --once",
        "ping edge1 -c 3",
        "stream list --window 1",
        "stream hz robot1/in --window 1 --count 1",
        "stream tail robot1/out --count 3",
        "tune echo",
        "tune echo bonus=0.1 --yes -m trial",
        "move echo edge2 --yes -m tour",
        "pin echo --yes -m tour --for 1h",
        "unpin echo --yes",
        "pause echo --yes -m tour",
        "resume echo --yes",
        "drain edge3 --only new --yes -m fan",
        "undrain edge3 --yes",
        "drain edge2 --yes -m tour",
        "undrain edge2 --yes",
        "restart echo --yes",
        "logs echo",
        "wait --until healthy --timeout 30",
        "doctor",
        "doctor --fleet",
        "rehearse echo --steps move,drain --yes",
        "metrics write zsched.prom",
        "bugreport report.tar.gz",
        "fleet show",
        "pki show",
        "task add second.yaml --plan",
        "node remove edge3 --plan",
        "check fleet.yaml",
        "apply fleet.yaml --plan",
        "record -o run.mcap --for 3s",
        "trace --help",
        "new python my-task",
        "fleet recover --plan",
        "invite robot4 --address 127.0.0.1:" + str(port + PER_NODE * len(NODES)) + " --plan",
        "join robot4.invite",
        "edit",
        "bench --help",
        "demo --help",
    ]
    found = [Step(node=one, words=words) for words in plain]
    for step in found:
        if step.verb == "edit":
            step.env["EDITOR"] = "true"
    found.insert(11, Step(node=one, words="top", keys="q", after_s=4.0))
    found += [
        Step(node=one, words=f"web --listen 127.0.0.1:{port + 39}", keys="\x03"),
        Step(node=one, words="dev my-task/fleet.yaml", keys="\x03", after_s=12.0),
        Step(node="robot3", words="leave --plan"),
        Step(node="edge3", words="up", keys="\x03", after_s=8.0),
    ]
    return found


def played(hall: Hall, step: Step, size: tuple[int, int]) -> Seen:
    """Run one command on a terminal of its own."""
    rows, columns = size
    home = hall.folder / step.node
    places = {"CONFIG": home / "etc" / "fleet.yaml", "STATE_DIR": home / "state", "RUNTIME_DIR": home / "run"}
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(home)
        env = {**os.environ, **{f"ZSCHED_{name}": str(path) for name, path in places.items()}, **step.env}
        env |= {"ZSCHED_NODE": step.node, "ZSCHED_AUTHORITY": str(hall.folder / "stick"), "TERM": "xterm-256color"}
        for name in ("COLUMNS", "LINES", "NO_COLOR"):
            env.pop(name, None)
        if step.into:
            os.dup2(os.open(step.into, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 1)
        time.sleep(0.1)  # its terminal is given its size meanwhile
        os.execve(sys.executable, [sys.executable, "-m", "zsched.cli", *shlex.split(step.words)], env)  # noqa: S606
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    began = time.monotonic()
    events: list[tuple[float, str]] = []
    is_pressed = not step.keys
    rest = b""
    while (now := time.monotonic() - began) < LONGEST_S:
        if not is_pressed and now > step.after_s:
            os.write(terminal, step.keys.encode())
            is_pressed = True
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                chunk = os.read(terminal, 65536)
            except OSError:
                break  # a terminal ends like that
            if not chunk:
                break
            rest += chunk
            text = rest.decode(errors="ignore")
            rest = rest[len(text.encode()) :]
            events.append((now, text))
    else:
        os.kill(pid, 9)
    os.close(terminal)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return Seen(step=step, code=code, seconds=time.monotonic() - began, events=events)


def patiently(hall: Hall, *words: str) -> str:
    """A verb on robot1, given again while its daemon begins again after the change before; what it printed."""
    end = time.monotonic() + LONGEST_S
    while (done := hall.run("robot1", *words)).returncode != 0:
        if time.monotonic() > end:
            raise SystemExit(f"zsched {' '.join(words)}: {done.stdout}{done.stderr}")
        time.sleep(0.5)
    return done.stdout


def found_fleet(hall: Hall, port: int) -> None:
    """Six machines by the verbs."""
    hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}")
    hall.start("robot1")
    (hall.folder / "echo.yaml").write_text(TASK)
    patiently(hall, "task", "add", str(hall.folder / "echo.yaml"), "--yes")
    for at, name in enumerate(NODES[1:], 1):
        where = ["--kind", name.rstrip("0123456789"), "--address", f"127.0.0.1:{port + PER_NODE * at}"]
        where += ["--candidate-for", "echo"] if name.startswith("edge") else []
        invitation = hall.folder / f"{name}.invite"
        where += ["--accept", "pause-task"]  # the only candidate's worker starts again for another robot
        invitation.write_text(patiently(hall, "invite", name, *where, "--yes"))
        hall.zsched(name, "join", str(invitation))
        hall.start(name)
    patiently(hall, "wait", "--until", "healthy", "--timeout", "60")
    home = hall.folder / "robot1"
    (home / "fleet.yaml").write_text(patiently(hall, "fleet", "export"))
    (home / "second.yaml").write_text(OTHER_TASK)
    log = min((home / "state").rglob("*.ndjson*"))
    (home / "decisions.ndjson").symlink_to(log)


@contextlib.contextmanager
def application(hall: Hall) -> Iterator[None]:
    """Something that asks robot1's task ten times a second."""
    joins_at = tuple(json.loads(patiently(hall, "status", "--json"))["joins_at"])
    with zenoh.open(zenoh.Config.from_json5(client_config(connect=joins_at, connect_s=20.0))) as session:
        publisher = session.declare_publisher("robot1/in")
        with at_pace(ASKS_HZ, lambda: publisher.put(b"message")):
            yield


def write_cast(file: Path, seen: Sequence[Seen], size: tuple[int, int], folder: Path, title: str) -> None:
    """An asciicast of all steps, one after another; what took long is shortened."""
    rows, columns = size
    lines: list[Any] = [{"version": 2, "width": columns, "height": rows, "title": title}]
    now = 0.0
    for one in seen:
        lines.append([round(now, 2), "o", f"\x1b[1m{one.step.node}$ {one.step.line}\x1b[0m\r\n"])
        before = 0.0
        for at, text in one.events:
            now += min(at - before, SHOWN_PAUSE_S)
            before = at
            lines.append([round(now, 2), "o", usual(text, folder)])
        now += SHOWN_PAUSE_S
        lines.append([round(now, 2), "o", "\r\n"])
    file.write_text("".join(f"{json.dumps(line, ensure_ascii=False)}\n" for line in lines))


def usual(text: str, folder: Path) -> str:
    """The text with the paths of an installed machine in place of those of this run, and a host's name of a robot's."""
    text = re.sub(rf"(?<![\w-]){re.escape(socket.gethostname())}(?![\w-])", HOST, text)
    for name in NODES:
        for here, there in PLACES:
            text = text.replace(f"{folder / name}{here}", there)
    return text.replace(sys.prefix, "/opt/zsched").replace(f"{folder}/", "")


def write_page(file: Path, seen: Sequence[Seen], folder: Path) -> None:
    """The chosen screens in place of those that the page has; text around its blocks stays."""
    text = file.read_text()
    for one in seen:
        if one.step.words not in ON_PAGE:
            continue
        shown = "\n".join(line.rstrip() for line in usual(one.text, folder).rstrip().splitlines())
        words = re.escape(f"$ zsched {one.step.words}\n")
        found = list(re.finditer(rf"```\n{words}.*?```", text, re.DOTALL))
        if len(found) != 1:
            raise SystemExit(f"{file} has {len(found)} blocks of `zsched {one.step.words}`")
        block = f"```\n$ zsched {one.step.words}\n{shown}\n```"
        text = text[: found[0].start()] + block + text[found[0].end() :]
    file.write_text(text)


def too_wide(one: Seen, columns: int) -> list[str]:
    """Lines that the terminal breaks; full screens place their own."""
    if any("\x1b[?1049h" in text for _, text in one.events):
        return []
    return [line for line in one.text.splitlines() if len(line.rstrip()) > columns]


def main() -> None:
    """Found the fleet, play, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--columns", type=int, default=80)
    parser.add_argument("--rows", type=int, default=24)
    parser.add_argument("--cast", type=Path, help="the recording")
    parser.add_argument("--page", type=Path, help="the guide's page, whose blocks are written anew")
    parser.add_argument("--screens", type=Path, help="a folder for a text file of each verb")
    options = parser.parse_args()
    size = (options.rows, options.columns)
    print(machine(), flush=True)
    port = block_of_ports(40)
    seen: list[Seen] = []
    with tempfile.TemporaryDirectory(prefix="tour-", dir="/tmp") as name, Hall(Path(name)) as hall:
        found_fleet(hall, port)
        with application(hall):
            time.sleep(FLOWS_S)
            for step in the_tour(port):
                if step.verb == "up":
                    hall.stop(step.node)
                seen.append(played(hall, step, size))
                print(f"{seen[-1].seconds:5.1f} s  {seen[-1].code}  {step.node}$ zsched {step.words}", flush=True)
    if options.cast:
        write_cast(options.cast, seen, size, Path(name), "every verb of zsched, six machines")
    if options.page:
        write_page(options.page, seen, Path(name))
    if options.screens:
        options.screens.mkdir(parents=True, exist_ok=True)
        for at, one in enumerate(seen):
            title = re.sub(r"[^a-z0-9]+", "-", one.step.words.lower())[:40].strip("-")
            head = f"{one.step.node}$ zsched {one.step.words}   [{one.code}]\n"
            (options.screens / f"{at:02}-{title}.txt").write_text(head + one.text)
    for one in seen:
        for line in too_wide(one, options.columns):
            print(f"too wide  zsched {one.step.words}: {line.rstrip()[:200]}")
    group: Any = typer.main.get_command(app)
    verbs = {name for name, command in group.commands.items() if not command.hidden}
    print(f"not played: {', '.join(sorted(verbs - {one.step.verb for one in seen})) or 'none'}")


if __name__ == "__main__":
    main()
