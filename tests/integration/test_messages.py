"""What a newcomer is told: every command of tests/integration/messages.md is typed, and says what the page says."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.rights import WITHOUT_RIGHTS
from support.waiting import until
from zsched.tools.example import Example, write_example

pytestmark = pytest.mark.long

REPO = Path(__file__).parents[2]
PAGE = REPO / "tests" / "integration" / "messages.md"
CLI = (sys.executable, "-m", "zsched.cli")
QUOTED = re.compile(r"(`+)\s?(.+?)\s?\1(?!`)")
DEAF = "import time\ntime.sleep(3600)\n"
RAISES = """\
from zsched.worker import Worker

with Worker.from_env() as worker:

    def on_question(sample):
        raise ValueError("no model file")

    worker.subscribe("{prefix}/robot1/question", on_question)
    worker.ready()
    while worker.wait(1.0):
        pass
"""
AT_FAULT = """
  alone:
    candidates: [edge1]
    weights: {cpu: 1}
    worker: {ready: matching}
    inputs: [{from: "{robot}/scan", to: "{target}/alone/{robot}/scan"}]
  deaf:
    candidates: [edge1]
    weights: {cpu: 1}
    worker: {command: [python, deaf.py], ready: matching, start_deadline_s: 2}
    inputs: [{from: "{robot}/scan", to: "{target}/deaf/{robot}/scan"}]
  silent:
    candidates: [edge1]
    weights: {cpu: 1}
    worker: {command: [python, deaf.py], start_deadline_s: 2}
    inputs: [{from: "{robot}/scan", to: "{target}/silent/{robot}/scan"}]
  raises:
    candidates: [edge2]
    weights: {cpu: 1}
    worker: {command: [python, raises.py]}
    inputs: [{from: "{robot}/question", to: "{target}/raises/{robot}/question"}]
  idle:
    candidates: [edge2]
    weights: {cpu: 1}
    worker: {command: [python, raises.py]}
    inputs: [{from: "{robot}/odometry", to: "{target}/idle/{robot}/question"}]
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One case of the page."""

    case: str
    typed: str
    says: tuple[str, ...]
    held_by: str


def rows() -> list[Row]:
    """Every row of the page's tables."""
    found = []
    for line in PAGE.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")] if line.startswith("| ") else []
        if len(cells) == 4 and cells[0] not in ("case", "---"):
            says = tuple(match[2] for match in QUOTED.finditer(cells[2]))
            found.append(
                Row(case=cells[0], typed=cells[1].strip("`"), says=says, held_by=cells[3].rstrip("| ").strip("`"))
            )
    return found


def of(held_by: str) -> list[object]:
    """The rows that are held so, as parameters."""
    return [pytest.param(row, id=row.case.replace(" ", "_")) for row in rows() if row.held_by == held_by]


def said(typed: str, folder: Path, *more: str, before: tuple[str, ...] = ()) -> str:
    """What the real program says to a command, on both of its outputs, with single blanks."""
    words = shlex.split(typed)
    assert words[0] == "zsched"
    done = subprocess.run(
        [*before, *CLI, *words[1:], *more],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if not name.startswith("ZSCHED_")} | {"COLUMNS": "200"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    return " ".join((done.stdout + done.stderr).split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, and the same with one fault each."""
    place = tmp_path_factory.mktemp("newcomer")
    write_example(Example.PYTHON, place)
    good = (place / "fleet.yaml").read_text()
    files = {
        "spaced.yaml": good.replace("command: [python, worker.py]", "command: python stats.py"),
        "wlan.yaml": good.replace("timing: wifi", "timing: wlan"),
        "shifted.yaml": good.replace("electorate: [robot1, edge1, edge2]", "electorate: [robot1]"),
        "empty.yaml": "",
        "closed.yaml": good,
    }
    for name, text in files.items():
        (place / name).write_text(text)
        assert text != good or name == "closed.yaml", name
    (place / "closed.yaml").chmod(0)
    (place / "closed").mkdir(mode=0)
    said("zsched init -c fleet.yaml --node robot1 --state-dir s", place)
    return place


@pytest.mark.parametrize("row", of("here"))
def test_what_is_typed_is_answered_as_the_page_says(row: Row, folder: Path) -> None:
    text = said(row.typed, folder, before=WITHOUT_RIGHTS if "closed" in row.typed else ())
    assert row.says
    for fragment in row.says:
        assert fragment in text, row.case


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A fleet with workers at fault: its folder, and where its daemons' sockets are."""
    place = tmp_path_factory.mktemp("faulty")
    write_example(Example.PYTHON, place)
    (place / "deaf.py").write_text(DEAF)
    (place / "raises.py").write_text(RAISES)
    (place / "fleet.yaml").write_text((place / "fleet.yaml").read_text() + AT_FAULT)
    log = place / "dev.log"
    with log.open("w") as out:
        process = subprocess.Popen(
            [*CLI, "dev"], cwd=place, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True
        )
    try:
        match = until(lambda: re.search(r"--runtime-dir (\S+)", log.read_text()), "it says where its daemons are")
        endpoint = re.search(r"robot1 .* data endpoint (\S+)", log.read_text())
        assert match is not None
        assert endpoint is not None
        until(lambda: "shout: on " in log.read_text(), "the task without a fault is placed", 90.0)
        ask = [sys.executable, "ask.py", endpoint[1]]
        application = subprocess.Popen(ask, cwd=place, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            yield place, match[1]
        finally:
            application.kill()
            application.wait()
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


@pytest.mark.timeout(240)
@pytest.mark.parametrize("row", of("live"))
def test_a_live_fleet_says_what_the_page_says(row: Row, runtime: tuple[Path, str]) -> None:
    folder, sockets = runtime
    more = ["--runtime-dir", sockets, *(["--window", "0.5", "--count", "1"] if " hz " in row.typed else [])]
    last = ""

    def is_said() -> bool:
        nonlocal last
        last = said(row.typed, folder, *more)
        return all(fragment in last for fragment in row.says)

    assert row.says
    try:
        until(is_said, row.case, 60.0)
    except AssertionError as error:
        raise AssertionError(f"{error}\n{row.says}\n{last}") from None


def test_every_other_row_names_a_test_that_there_is() -> None:
    everything = "\n".join(path.read_text() for path in (REPO / "tests").rglob("test_*.py"))
    named = [row.held_by for row in rows() if row.held_by not in ("here", "live", "Makefile")]
    assert named
    assert [name for name in named if f"def {name}(" not in everything] == []
    assert [row for row in rows() if row.held_by == "Makefile" and row.says[0] in (REPO / "Makefile").read_text()]
