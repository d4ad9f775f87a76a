"""The programs that the documents show, as they stand there, on a real fleet: the application and both workers."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

ROOT = Path(__file__).parents[2]
QUESTIONS = [f"question {number}" for number in range(10)]
README_TASK = """
shout:
  candidates: {kind: edge}
  weights: {cpu: 0.5, memory: 0.5, network: 0}
  worker: {command: [python, /opt/shout/shout.py]}
  inputs: [{from: "{robot}/question", to: "{target}/shout/{robot}/question", class: reliable}]
  outputs: [{from: "{target}/shout/{epoch}/answer", to: "{robot}/answer", class: reliable, handover: all}]
"""


def examples(name: str, language: str) -> list[str]:
    """The code blocks of a document in one language, in order."""
    text = (ROOT / name).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def worker_of(name: str, number: int) -> tuple[str, str]:
    """A worker's program and its task in the fleet file."""
    tasks = examples(name, "yaml") if name == "docs/guide/worker.md" else [README_TASK]
    return examples(name, "python")[number], tasks[number]


def fleet_of(folder: Path, program: str, task: str) -> dict[str, Any]:
    """One robot and one edge, with a document's task and the worker's program in a file."""
    (folder / "shout.py").write_text(program)
    tree = echo_fleet(robots=1, edges=1, timing="wired")
    del tree["tasks"][TASK]
    tree["tasks"] = YAML(typ="safe").load(task.replace("/opt/shout", str(folder)))
    return tree


def run_application(
    bed: Testbed, page: str = "docs/guide/streams.md", changes: dict[str, str] | None = None
) -> list[str]:
    """A page's application on robot1: what it prints; it must end by itself."""
    text = examples(page, "python")[0]
    for old, new in {"tcp/127.0.0.1:7458": bed.fleet.node("robot1").listen_data, **(changes or {})}.items():
        assert old in text
        text = text.replace(old, new)
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=30, check=False, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize(
    ("name", "number", "is_loud"),
    [("docs/guide/worker.md", 0, True), ("docs/guide/worker.md", 1, True), ("README.md", 0, False)],
)
def test_a_worker_of_the_documents_answers_the_application_of_the_documents(
    tmp_path: Path, name: str, number: int, is_loud: bool
) -> None:
    with Testbed(tmp_path, fleet_of(tmp_path, *worker_of(name, number))) as bed:
        bed.init()
        bed.start()
        assert bed.wait_settled() == "edge1"
        bed.wait(lambda: not bed.task("robot1")["problems"], 60, "the worker takes its inputs")
        said = run_application(bed)
        # the first ones may be put before the relay's subscription is known to the application
        assert said == [text.upper() if is_loud else text for text in QUESTIONS][-len(said) :]
        assert len(said) >= len(QUESTIONS) - 2


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


def test_the_first_fleet_answers_its_application(tmp_path: Path) -> None:
    """The task and the application of docs/guide/first-fleet.md, on two robots and an edge that all may own it."""
    page = YAML(typ="safe").load(examples("docs/guide/first-fleet.md", "yaml")[0])
    tree = echo_fleet(robots=2, edges=1, timing=page["timing"])
    tree["electorate"], tree["tasks"] = page["electorate"], page["tasks"]
    assert sorted(tree["nodes"]) == sorted(page["nodes"])
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        bed.wait(lambda: not bed.task("robot1")["problems"], 60, "the worker takes its inputs")
        said = run_application(bed, "docs/guide/first-fleet.md", {"range(1000)": "range(20)"})
    assert len(said) >= 17  # the first ones may be put too early, and the last answers come too late
    first = int(said[0].split()[1])
    last = first + len(said)
    assert said == [f"message {number} application/octet-stream;{owner}" for number in range(first, last)]
