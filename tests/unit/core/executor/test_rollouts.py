"""A changed worker that waits for a look: who runs which worker, what is told, what the hashes say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

import pytest

from support.fleets import fleet_of, task_of
from support.states import state_of
from support.storm import ELECTORATE
from zsched.core.executor.rollouts import Rollouts, waiting
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.codec import decode, document_hash, encode
from zsched.core.values.document import MAX_HELD_BYTES, Document, Rollout, Text
from zsched.core.values.fleet import Fleet, OnIsolation, TaskSpec, WorkerSpec, file_hash

OLD, NEW = ("merge", "--old"), ("merge", "--new")
ENV = (("GAIN", "1"),)


def rollout(*first: str, by: str = "ada@robot1", reason: str = "new net") -> Rollout:
    command, env = tuple(Text(word) for word in OLD), tuple((Text(name), Text(value)) for name, value in ENV)
    return Rollout(task="merge", first=first, command=command, env=env, by=by, reason=reason, revision=9)


def task(said: Rollout | None, on_isolation: OnIsolation = OnIsolation.HOLD) -> TaskSpec:
    return replace(task_of(worker=WorkerSpec(command=NEW, stop_grace_s=7.0)), rollout=said, on_isolation=on_isolation)


def fleet(said: Rollout | None) -> Fleet:
    return fleet_of(task(said))


def test_the_first_nodes_run_the_changed_worker_and_all_others_that_of_before() -> None:
    spec = task(rollout("edge2"))
    assert spec.worker_on("edge2") == spec.worker
    before = spec.worker_on("edge1")
    assert (before.command, before.env) == (OLD, ENV)
    assert before.stop_grace_s == 7.0, "what is no part of its process is as the text says"
    assert task(None).worker_on("edge1").command == NEW


def test_every_node_that_has_such_a_worker_waits_but_the_first() -> None:
    assert waiting(fleet(rollout("edge2")), task(rollout("edge2"))) == ("edge1",)
    alone = task(rollout("edge2"), on_isolation=OnIsolation.LOCAL)
    assert waiting(fleet_of(alone), alone) == ("edge1", "robot1", "robot2", "robot3")
    assert waiting(fleet(None), task(None)) == ()


def test_a_document_carries_it_and_one_without_has_the_frame_of_before() -> None:
    plain, said = (
        Document(text=Text("fleet: hall\n")),
        Document(text=Text("fleet: hall\n"), rollouts=(rollout("edge2"),)),
    )
    assert b"rollouts" not in encode(plain)
    assert document_hash(plain) != document_hash(said)
    assert decode(encode(said), Document) == said


@pytest.mark.parametrize(
    "make",
    [
        lambda: rollout("Edge 2"),
        lambda: replace(rollout("edge2"), command=(Text("x" * (MAX_HELD_BYTES + 1)),)),
        lambda: rollout("edge2", reason="x" * 401),
        lambda: Document(text=Text(""), rollouts=(rollout("edge1"), rollout("edge2"))),
    ],
)
def test_what_no_document_may_hold_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match="rollout"):
        make()


def test_it_is_known_since_it_was_learnt_and_each_change_is_told_once() -> None:
    book = Rollouts()
    first, wider = rollout("edge2"), rollout("edge1", "edge2", by="", reason="")
    assert book.take(fleet(first), 10.0) == (
        ("merge", "edge2 first, the others wait with the worker of before: ada@robot1 (new net)"),
    )
    assert book.take(fleet(first), 20.0) == ()
    assert book.since("merge") == 10.0
    ((_, text),) = book.take(fleet(wider), 30.0)
    assert text == "edge1 and edge2 first, the others wait with the worker of before: an operator"
    assert book.since("merge") == 30.0
    assert book.take(fleet(None), 40.0) == (("merge", "all run the changed worker now"),)
    assert book.since("merge") is None
    book.take(fleet(first), 50.0)
    back = fleet_of(replace(task(None), worker=WorkerSpec(command=OLD, env=ENV)))
    assert book.take(back, 60.0) == (("merge", "the worker of before is everybody's again"),)


def test_a_node_tells_its_runtime_and_its_operators() -> None:
    node = Node(
        fleet=fleet(None),
        me="robot1",
        durable=state_of("robot1", electorate=ELECTORATE),
        incarnation=7,
        electorate=ELECTORATE,
        rng=Random(1),
        now=100.0,
    )
    node.start(100.0)
    held = fleet(rollout("edge2"))
    batch = node.handle(ev.FleetChanged(fleet=held), 101.0)
    assert [one.fleet for one in batch if isinstance(one, do.AdoptFleet)] == [held]
    told = [one.text for one in batch if isinstance(one, do.RecordStory) and one.is_rollout]
    assert told == ["changed worker: edge2 first, the others wait with the worker of before: ada@robot1 (new net)"]
    shown = build_snapshot(node, 105.0)
    (status,) = shown.tasks
    assert status.rollout is not None
    assert (status.rollout.first, status.rollout.waiting, status.rollout.known_s) == (("edge2",), ("edge1",), 4.0)
    assert any(
        "edge1 waits with that of before: `zsched task promote merge` goes on" in problem for problem in status.problems
    )
    assert shown.fleet_file == file_hash(held), "who compares files sees no other file"
    node.handle(ev.FleetChanged(fleet=fleet(None)), 106.0)
    assert build_snapshot(node, 107.0).tasks[0].rollout is None
