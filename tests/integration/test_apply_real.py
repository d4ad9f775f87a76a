"""`zsched apply` on real daemons: a task comes and goes by the document while a reliable stream of another one runs."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.operators import Operator, Stream
from support.sessions import matches
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

SECOND = """\
tasks:
  # the second shift
  second:
    candidates: {kind: edge}
    weights: {cpu: 0.5, memory: 0.5}
    scheduling: {score: paper}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in2", to: "{target}/second/{robot}/in"}]
    outputs: [{from: "{target}/second/{epoch}/{robot}/out", to: "{robot}/out2"}]
"""


def as_written(tree: dict[str, Any]) -> str:
    """The fleet file as an operator would write it, with comments."""
    lines = ["# ours", f"fleet: {tree['fleet']}", f"timing: {tree['timing']}  # on the shop floor"]
    for section in ("nodes", "tasks"):
        lines += [f"{section}:", *(f"  {name}: {json.dumps(held)}" for name, held in tree[section].items())]
    return "\n".join((*lines, "# end", ""))


def tasks_of(bed: Testbed, node: str) -> dict[str, str | None]:
    """{task: its owner}, as a node tells."""
    return {str(task["name"]): task["owner"] for task in bed.status(node)["tasks"]}


def lossless() -> dict[str, Any]:
    """A fleet whose stream loses nothing in a planned move."""
    tree = echo_fleet(edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"  # by `latest` a move cuts the old owner's late answers off
    return tree


@contextlib.contextmanager
def streaming(folder: Path, tree: dict[str, Any]) -> Iterator[tuple[Testbed, zenoh.Session, Stream]]:
    """A settled fleet, and an application of a robot that puts numbers; every one is answered in the end, in order."""
    with Testbed(folder, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        session = bed.app("robot1")
        stream = Stream(session)
        bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
        stream.start()
        yield bed, session, stream
        stream.end()
        bed.wait(lambda: len(stream.back) >= stream.sent, 60, "every sample is answered")
        assert stream.back == list(range(stream.sent))


def goes_by(bed: Testbed, node: str, revision: int) -> bool:
    """Whether a node has taken a revision over, and its task has no problem."""
    status = bed.status(node)
    return status["fleet_revision"] == revision and not status["tasks"][0]["problems"]


def has_more(stream: Stream, than: int) -> bool:
    """Whether a stream has brought 20 answers more."""
    return len(stream.back) > than + 20


def test_a_task_comes_and_goes_by_the_document_while_a_stream_runs(tmp_path: Path) -> None:
    tree = lossless()
    with streaming(tmp_path, tree) as (bed, session, stream):
        operator = Operator(bed)
        bed.wait(lambda: len(stream.back) > 20, 60, "the stream flows")

        # the first document is the file that runs; another text of it is another document
        file = tmp_path / "agreed.yaml"
        file.write_text(as_written(tree))
        assert operator.zsched("apply", file, "--plan").returncode == 10
        operator.done("apply", file, "--yes")
        assert operator.zsched("fleet", "export").stdout == file.read_bytes(), "byte for byte"
        first = int(bed.status("robot1")["fleet_revision"])

        # a task comes: it gets an owner, and its streams work
        fragment = tmp_path / "second.yaml"
        fragment.write_text(SECOND)
        told = operator.done("task", "add", fragment, "--yes", "-m", "more work")
        assert "task second begins, on one of edge1, edge2" in told
        bed.wait(lambda: all(tasks_of(bed, name).get("second") for name in bed.names), 60, "all nodes know its owner")
        back: list[bytes] = []
        sub = session.declare_subscriber("robot1/out2", lambda sample: back.append(sample.payload.to_bytes()))
        publisher = session.declare_publisher("robot1/in2")

        def answers() -> bool:
            publisher.put(b"1")
            return bool(back)

        bed.wait(answers, 60, "an answer of the task that came")
        assert f"(more work): task add {fragment}, on revision " in operator.done("history")

        # who saw the fleet before that is refused
        late = operator.zsched("apply", file, "--yes", "--accept", "remove-task", "--revision", first)
        assert late.returncode == 1
        assert b"is overtaken" in late.stderr
        assert "second" in tasks_of(bed, "robot2")

        # it goes: its worker and its streams end, the first stream has lost nothing
        operator.done("task", "remove", "second", "--yes", "--accept", "remove-task")
        bed.wait(lambda: all(list(tasks_of(bed, name)) == [TASK] for name in bed.names), 60, "the task is gone")
        left = file.read_text().replace("# end", "  # the second shift\n# end")
        assert operator.done("fleet", "export") == left, "the comment above it stays, and every other character"
        reached = len(stream.back)
        bed.wait(lambda: len(stream.back) > reached + 20, 60, "the stream flows on")
        sub.undeclare()


@pytest.mark.long
def test_a_task_becomes_exclusive_by_the_document_and_everybody_s_again_while_a_stream_runs(tmp_path: Path) -> None:
    tree = lossless()
    with streaming(tmp_path, tree) as (bed, _, stream):
        operator = Operator(bed)
        file = tmp_path / "agreed.yaml"
        for is_exclusive, accepted in ((False, ()), (True, ("make-exclusive",)), (False, ("end-exclusive",))):
            tree["tasks"][TASK]["exclusive"] = is_exclusive
            file.write_text(as_written(tree))
            operator.done("apply", file, "--yes", *(word for one in accepted for word in ("--accept", one)))
            revision = bed.status("robot1")["fleet_revision"]
            for name in bed.names:
                bed.wait(partial(goes_by, bed, name, revision), 60, f"{name} goes by it and has no problem")
            bed.wait(partial(has_more, stream, len(stream.back)), 60, "the stream flows on")


@pytest.mark.long
def test_up_with_another_file_founds_nothing_where_a_fleet_is(tmp_path: Path) -> None:
    """A file that was edited by hand is compared and named; by one of another fleet the state counts for nothing."""
    tree = echo_fleet(robots=1, edges=1)
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        file = tmp_path / "agreed.yaml"
        file.write_text(as_written(tree))
        operator = Operator(bed)
        operator.done("apply", file, "--yes")
        revision = bed.status("robot1")["fleet_revision"]
        bed.stop()

        edited = json.loads(json.dumps(tree))
        edited["tasks"]["second"] = {**tree["tasks"][TASK], "inputs": [], "outputs": []}
        bed.file.write_text(json.dumps(edited))
        bed.start()
        bed.wait_settled()
        bed.wait(lambda: "zsched apply" in str(bed.status("robot1")["problems"]), 60, "the difference is named")
        status = bed.status("robot1")
        assert (list(tasks_of(bed, "robot1")), status["fleet_revision"]) == ([TASK], revision)
        assert operator.done("fleet", "export") == file.read_text()

        bed.stop("edge1")
        state = (tmp_path / "edge1" / "state").read_bytes()
        bed.file.write_text(json.dumps({**edited, "fleet": "elsewhere"}))
        bed.start("edge1")
        bed.wait(lambda: bed.status("edge1")["fleet"] == "elsewhere", 60, "it goes by that file")
        assert "belongs to the fleet 'testbed', not 'elsewhere'" in bed.log("edge1")
        assert (tmp_path / "edge1" / "state").read_bytes() == state, "it is kept for its own fleet"
        assert bed.status("robot1")["fleet_revision"] == revision
        peers = {"robot1": "alive", "edge1": "gone"}
        bed.wait(
            lambda: {one["name"]: one["state"] for one in bed.status("robot1")["nodes"]} == peers, 60, "it is gone"
        )
