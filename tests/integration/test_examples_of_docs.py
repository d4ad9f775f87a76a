"""The programs that the documents show, as they stand there, on a real fleet: the application and both workers."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from support.waiting import until
from zsched_lab.fleet.hall import Hall, block_of_ports
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

ROOT = Path(__file__).parents[2]
QUESTIONS = [f"question {number}" for number in range(10)]


def examples(name: str, language: str) -> list[str]:
    """The code blocks of a document in one language, in order."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def worker_of(name: str, number: int) -> tuple[str, str]:
    """A worker's program and its task in the fleet file."""
    return examples(name, "python")[number], examples(name, "yaml")[number]


def fleet_of(folder: Path, program: str, task: str) -> dict[str, Any]:
    """One robot and one edge, with a document's task and the worker's program in a file."""
    (folder / "shout.py").write_text(program)
    tree = echo_fleet(robots=1, edges=1, timing="wired")
    del tree["tasks"][TASK]
    tree |= YAML(typ="safe").load(task.replace("/opt/shout", str(folder)))
    return tree


def run_application(bed: Testbed) -> list[str]:
    """The application of docs/guide/streams.md on robot1: what it prints."""
    text = examples("docs/guide/streams.md", "python")[0]
    assert "tcp/127.0.0.1:7458" in text
    return run_text(text.replace("tcp/127.0.0.1:7458", bed.fleet.node("robot1").listen_data))


def run_text(text: str) -> list[str]:
    """What a program prints; it must end by itself."""
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=30, check=False, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_worker_of_the_documents_answers_the_application_of_the_documents(tmp_path: Path, number: int) -> None:
    with Testbed(tmp_path, fleet_of(tmp_path, *worker_of("docs/guide/worker.md", number))) as bed:
        bed.init()
        bed.start()
        assert bed.wait_settled() == "edge1"
        bed.wait(lambda: not bed.task("robot1")["problems"], 60, "the worker takes its inputs")
        said = run_application(bed)
        # the first ones may be put before the relay's subscription is known to the application
        assert said == [text.upper() for text in QUESTIONS][-len(said) :]
        assert len(said) >= len(QUESTIONS) - 2


@pytest.mark.long
def test_a_program_without_the_library_is_told_to_say_ready_matching(tmp_path: Path) -> None:
    program, task = worker_of("docs/guide/worker.md", 1)
    tree = fleet_of(tmp_path, program, task.replace(", ready: matching", ""))
    tree["tasks"]["shout"]["worker"] |= {"start_deadline_s": 2, "max_failures": 1}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        told = bed.wait(lambda: bed.task("robot1")["problems"], 60, "the problem line")
        assert "the worker on edge1 failed: not ready within 2 s" in told[0]
        assert "`ready: matching`" in told[0]
        assert "@zsched/testbed/worker/edge1/shout/" in told[0]


@pytest.mark.long
def test_the_first_fleet_by_its_verbs_answers_its_application(tmp_path: Path) -> None:
    """docs/guide/first-fleet.md, with its task and its application: a secured fleet of two robots and an edge."""
    page, port = "docs/guide/first-fleet.md", block_of_ports(30)
    (tmp_path / "echo.yaml").write_text(examples(page, "yaml")[0])
    with Hall(tmp_path) as hall:
        hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}")
        hall.start("robot1")
        hall.zsched("robot1", "wait", "--until", "quorum", "--timeout", "30")
        hall.zsched("robot1", "task", "add", str(tmp_path / "echo.yaml"), "--yes")
        for count, (name, kind) in enumerate((("robot2", "robot"), ("edge1", "edge")), 1):
            words = ("--kind", kind, "--address", f"127.0.0.1:{port + 10 * count}", "--candidate-for", "echo", "--yes")
            (tmp_path / f"{name}.invite").write_text(hall.zsched("robot1", "invite", name, *words))
            hall.zsched(name, "join", str(tmp_path / f"{name}.invite"))
            hall.start(name)
            until(lambda name=name: name in hall.alive("robot1"), f"{name} joins")  # type: ignore[misc]
        everybody = {"robot1", "robot2", "edge1"}
        until(lambda: all(hall.alive(name) == everybody for name in everybody), "all hear each other")
        hall.zsched("robot1", "wait", "--until", "healthy", "--timeout", "60")
        joins_at = str(hall.status("robot1")["joins_at"][0])
        assert joins_at.endswith(f":{port + 3}"), "three ports behind its control session, as the page says"
        text = examples(page, "python")[0]
        for old, new in {"tcp/127.0.0.1:7460": joins_at, "itertools.count()": "range(20)"}.items():
            assert old in text
            text = text.replace(old, new)
        said = run_text(text)
        doctor = json.loads(hall.run("robot1", "doctor", "--fleet", "--json").stdout)
    verdicts = {one["id"]: one["verdict"] for one in doctor["checks"]}
    wanted = ("file.in_force", "file.warnings", "state.elector", "fleet.files", "worker.command", "stream.twice")
    assert {name: verdicts[name] for name in wanted} == dict.fromkeys(wanted, "PASS"), doctor
    assert len(said) >= 17  # the first ones may be put too early, and the last answers come too late
    first = int(said[0].split()[1])
    last = first + len(said)
    answers, owners = zip(*(line.rsplit(";", 1) for line in said), strict=True)
    assert list(answers) == [f"message {number} application/octet-stream" for number in range(first, last)]
    assert set(owners) <= everybody  # a busy machine may move it meanwhile
