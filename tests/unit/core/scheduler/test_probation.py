"""Who was gone and is back gets no task before its streams are proven: each proof, and the limit."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.membership.peers import Transition
from zsched.core.node.beats import on_transition
from zsched.core.node.node import Node
from zsched.core.scheduler.probation import LEASE_MARGIN_S, LIMIT_S, Probation
from zsched.core.values.fleet import Standby, TaskSpec, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import PeerState
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.todo import ToDo

TASK = task_of(tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("true",)))
FLEET = fleet_of(TASK, of=TASK.candidates, electors=("edge1",))
GONE_AT, BACK_AT = 100.0, 105.0
STOOD_S = FLEET.timing.zenoh_lease_s + LEASE_MARGIN_S


def probation(*, seen_at: float | None = 50.0, is_back: bool = True) -> Probation:
    """edge1 was gone from 100 to 105 s; its worker's token came at ``seen_at``."""
    known = Probation(InForce(FLEET))
    if seen_at is not None and seen_at < GONE_AT:
        known.on_token("edge1", "merge", "1", is_present=True, now=seen_at)
    known.on_gone("edge1", GONE_AT)
    if seen_at is not None and seen_at > GONE_AT:
        known.on_token("edge1", "merge", "1", is_present=True, now=seen_at)
    if is_back:
        known.on_back("edge1", BACK_AT)
    return known


def doubted(known: Probation, after_s: float, spec: TaskSpec = TASK) -> bool:
    return "edge1" in known.doubts(spec, BACK_AT + after_s)


def test_a_node_that_was_never_gone_is_not_doubted() -> None:
    assert not Probation(InForce(FLEET)).doubts(TASK, 1.0)
    known = probation(is_back=False)
    assert not known.doubts(TASK, BACK_AT), "a node that is gone is not eligible anyway"


def test_a_token_that_stood_all_the_time_proves_nothing_before_a_lease_would_have_ended_its_link() -> None:
    known = probation()
    assert doubted(known, 0.0)
    assert known.doubts(TASK, BACK_AT + 1.2) == {"edge1": "back for 1.2 s, its streams are not proven yet"}
    assert doubted(known, STOOD_S - 0.01)
    assert not doubted(known, STOOD_S)


@pytest.mark.parametrize("seen_at", [102.0, 105.0])
def test_a_token_that_came_after_the_node_was_gone_proves_its_streams_at_once(seen_at: float) -> None:
    assert not doubted(probation(seen_at=seen_at), 0.0)


def test_a_token_that_comes_after_the_return_ends_the_doubt() -> None:
    known = probation(seen_at=None)
    assert doubted(known, STOOD_S + 1.0), "no link to its worker"
    known.on_token("edge1", "merge", "2", is_present=True, now=BACK_AT + 3.0)
    assert not doubted(known, 3.0)


def test_a_token_that_goes_again_is_no_proof() -> None:
    known = probation(seen_at=102.0)
    known.on_token("edge1", "merge", "1", is_present=False, now=106.0)
    assert doubted(known, 2.0)


def test_the_token_of_the_next_worker_counts_although_the_old_one_s_goes_late() -> None:
    known = probation()
    known.on_token("edge1", "merge", "2", is_present=True, now=106.0)
    known.on_token("edge1", "merge", "1", is_present=False, now=106.1)
    assert not doubted(known, 1.2)


def test_another_task_s_token_proves_nothing() -> None:
    known = probation(seen_at=None)
    known.on_token("edge1", "guard", "1", is_present=True, now=BACK_AT)
    assert doubted(known, 0.1)


@pytest.mark.parametrize(
    "worker",
    [replace(TASK.worker, standby=Standby.COLD), WorkerSpec(command=(), ready_when=ReadyWhen.MATCHING)],
)
def test_a_worker_that_shows_no_token_is_waited_for_by_the_lease_only(worker: WorkerSpec) -> None:
    known, spec = probation(seen_at=None), replace(TASK, worker=worker)
    assert doubted(known, STOOD_S - 0.01, spec)
    assert not doubted(known, STOOD_S, spec)


def test_doubt_has_a_limit_and_begins_anew_with_the_next_end() -> None:
    known = probation(seen_at=None)
    assert doubted(known, LIMIT_S - 0.01)
    assert not doubted(known, LIMIT_S)
    known.on_gone("edge1", 200.0)
    known.on_back("edge1", 201.0)
    assert "edge1" in known.doubts(TASK, 201.0)


def test_a_new_relay_tells_its_tokens_anew() -> None:
    known = probation()
    known.forget_tokens()
    assert doubted(known, STOOD_S)
    known.on_token("edge1", "merge", "1", is_present=True, now=BACK_AT + 3.0)
    assert not doubted(known, 3.0)


def test_a_node_doubts_a_peer_that_was_gone_and_is_back() -> None:
    node = Node(fleet=FLEET, me="edge2", durable=None, incarnation=7, electorate="e", rng=Random(1), now=100.0)
    on_transition(
        node, Transition(node="edge1", before=PeerState.SUSPECT, after=PeerState.GONE, reason="silent"), ToDo(), 100.0
    )
    assert node.probation.doubts(TASK, 101.0) == {}, "it is not there at all"
    on_transition(
        node, Transition(node="edge1", before=PeerState.GONE, after=PeerState.ALIVE, reason="it beats"), ToDo(), 101.0
    )
    assert list(node.probation.doubts(TASK, 101.1)) == ["edge1"]
