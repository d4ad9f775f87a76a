"""Operators' flags: whom they keep out, who hands over, and when they end."""

from __future__ import annotations

import math
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from support.allocations import allocation_of
from support.decisions import figures_of
from support.fleets import task_of
from support.proposals import vector_of
from zsched.core.scheduler.decision import decide
from zsched.core.scheduler.flags import AGAIN_S, SPREAD_S, NodeFlags, told_flag
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Outcome
from zsched.core.values.decision import Figures
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.model import Asked, NodeId, PeerState, Pin

ROBOTS = ("robot1", "robot2", "robot3")
NODES = ("edge1", "edge2", "edge3")
SPEC = task_of(candidates=NODES, price_s=0.1)


def drain(node: NodeId = "edge1", for_s: float | None = None, revision: int = 3) -> Flag:
    return Flag(kind=FlagKind.DRAIN, subject=node, by="ada@robot1", for_s=for_s, revision=revision)


def ineligible(node: NodeId = "edge1", for_s: float | None = None) -> Flag:
    return Flag(kind=FlagKind.INELIGIBLE, subject=node, reason="loud", for_s=for_s, revision=4)


def test_a_drain_also_keeps_new_tasks_out_and_an_ineligible_node_hands_nothing_over() -> None:
    flags = NodeFlags(rank=0)
    assert flags.take((drain("edge1"), ineligible("edge1"), ineligible("edge2")), 100.0) == (
        "edge1 is drained by ada@robot1",
        "edge1 takes nothing new, by an operator (loud)",
        "edge2 takes nothing new, by an operator (loud)",
    )
    assert flags.closed == {"edge1": "drained by ada@robot1", "edge2": "takes nothing new, by an operator (loud)"}
    assert flags.drained == {"edge1": "drained by ada@robot1"}
    assert flags.take((ineligible("edge1"), ineligible("edge2")), 101.0) == (
        "edge1 is not drained any more, and still takes nothing new",
    )
    assert (dict(flags.drained), set(flags.closed)) == ({}, {"edge1", "edge2"})
    assert flags.take((), 102.0) == ("edge1 may get tasks again", "edge2 may get tasks again")
    assert flags.closed == {}


def test_a_node_that_leaves_hands_over_what_it_owns_and_is_told_so() -> None:
    flags = NodeFlags(rank=0)
    leave = Flag(kind=FlagKind.LEAVE, subject="edge1", by="ada@edge1", revision=3)
    assert flags.take((leave,), 100.0) == ("edge1 is leaving the fleet, by ada@edge1",)
    assert flags.drained == flags.closed == {"edge1": "leaving the fleet, by ada@edge1"}
    assert flags.take((), 101.0) == ("edge1 does not leave the fleet any more",)


def test_the_end_of_a_flag_is_told_when_its_time_is_over_and_again_until_it_is_agreed() -> None:
    flags, stays = NodeFlags(rank=2), ineligible("edge2")
    flags.take((drain(for_s=60.0), stays), 100.0)
    due = flags.next_deadline()
    assert due == 160.0 + 2 * SPREAD_S
    assert flags.due(due) == (stays,)
    assert flags.next_deadline() == due + AGAIN_S, "not at once again"
    flags.take((stays,), due + 1.0)
    assert flags.next_deadline() == math.inf


def test_a_flag_counts_from_when_it_was_learnt_and_one_that_is_given_again_counts_anew() -> None:
    flags, first = NodeFlags(rank=0), drain(for_s=60.0)
    flags.take((first,), 100.0)
    flags.take((first, ineligible("edge2")), 150.0)
    assert (flags.since(first), flags.next_deadline()) == (100.0, 160.0)
    again = drain(for_s=60.0, revision=9)
    flags.take((again,), 155.0)
    assert (flags.since(first), flags.since(again), flags.next_deadline()) == (None, 155.0, 215.0)


def test_two_orders_with_two_ends_end_one_after_the_other() -> None:
    flags = NodeFlags(rank=0)
    flags.take((drain(for_s=60.0), ineligible(for_s=90.0)), 100.0)
    assert flags.due(160.0) == (ineligible(for_s=90.0),)
    assert flags.due(190.0) == ()


def test_a_flag_without_an_author_is_told() -> None:
    assert told_flag(replace(drain(), by="", reason="")) == "drained by an operator"


# --- what a judgement makes of them ----------------------------------------------------------------------------------

SHARES = st.sampled_from((0.0, 0.2, 0.5, 0.55, 1.0))


@st.composite
def figures(draw: st.DrawFn) -> Figures:
    """Some standing with some flags; every robot has answered."""
    worth = {name: draw(SHARES) for name in NODES if draw(st.integers(0, 4))}
    subjects = st.lists(st.sampled_from(NODES), unique=True)
    flags = NodeFlags(rank=0)
    flags.take((*map(drain, draw(subjects)), *map(ineligible, draw(subjects))), 0.0)
    owner = draw(st.sampled_from((None, *NODES)))
    pin = draw(st.sampled_from((None, *NODES)))
    is_hard, is_paused = draw(st.booleans()), draw(st.integers(0, 4)) == 0
    allocation = allocation_of(
        5,
        owner,
        pin=None if pin is None else Pin(node=pin, asked=Asked(by="ada"), revision=5, is_hard=is_hard),
        pinned=pin is not None,
        paused=is_paused,
    )
    state = draw(st.sampled_from((PeerState.ALIVE, PeerState.ALIVE, PeerState.GONE)))
    return figures_of(
        SPEC,
        *ROBOTS,
        now=draw(st.sampled_from((0.0, 50.0))),
        allocation=allocation,
        vectors=tuple(vector_of(robot, worth, revision=5) for robot in ROBOTS),
        settled_for_s=draw(st.sampled_from((0.0, 100.0))),
        owner_state=PeerState.GONE if owner is None else state,
        is_called=draw(st.booleans()),
        closed=tuple(sorted(flags.closed.items())),
        drained="" if owner is None else flags.drained.get(owner, ""),
    )


@given(figures())
def test_a_flagged_node_gets_nothing_new_and_a_drained_owner_never_stays_while_another_is_fit(told: Figures) -> None:
    decided = decide(Judge(spec=SPEC), Fuse(), told)
    judgement, owner, closed = decided.judgement, told.allocation.owner, dict(told.closed)
    if judgement.candidate != owner:
        assert judgement.candidate not in closed
    fit = {one.candidate for vector in told.vectors for one in vector.utilities} - closed.keys() - {owner}
    if told.allocation.is_bound:
        fit &= {told.allocation.home}
    if told.drained and fit and not told.allocation.paused:
        assert judgement.outcome is Outcome.PROPOSE
        assert judgement.candidate in fit
    if owner is not None and not fit:
        assert judgement.candidate == owner, "no task is left without an owner"
