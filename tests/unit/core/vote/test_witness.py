"""What peers remember of an elector: who is asked, what is kept, and when enough have been asked."""

from __future__ import annotations

import pytest

from support.beats import beat_of
from support.fleets import fleet_of
from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.vote.witness import ASK_ALL_S, Witness, as_seen, as_tuple

ELECTORS = ("robot1", "robot2", "robot3", "robot4", "robot5")
NODES = fleet_of(of=(*ELECTORS, "edge1"), electors=ELECTORS)


def witness(me: str = "robot1", votes: int = 10) -> Witness:
    return Witness(me=me, electors=ELECTORS, in_force=InForce(NODES), incarnation=7, votes=votes, started_at=100.0)


def said(by: str, incarnation: int = 3, votes: int = 0, *seen: tuple[str, int, int]) -> Learnt:
    return Learnt(node=by, values=(), incarnation=incarnation, votes=votes, seen=seen)


def beat(node: str, votes: int) -> Beat:
    return beat_of(node, incarnation=3, votes=votes)


@pytest.mark.parametrize(
    ("answered", "may"),
    [
        (("robot2",), False),
        (("robot2", "edge1"), False),
        (("robot2", "robot3"), True),
        (("robot1", "robot2"), False),  # this elector itself counts once
    ],
)
def test_more_than_half_of_the_electors_are_asked_this_one_included(answered: tuple[str, ...], may: bool) -> None:
    own = witness()
    for name in answered:
        own.on_answer(said(name))
    assert own.may_vote(100.0 + ASK_ALL_S) is may


def test_it_does_not_wait_when_everybody_has_answered_and_waits_when_only_the_electors_have() -> None:
    own = witness()
    for name in ELECTORS[1:]:
        own.on_answer(said(name))
    assert not own.may_vote(100.0), "the edge may have seen more of it"
    own.on_answer(said("edge1"))
    assert own.may_vote(100.0)


@pytest.mark.parametrize(
    ("me", "has_answered", "heard", "must"),
    [
        ("robot1", False, beat("edge1", 0), True),  # it may remember something of this elector
        ("robot1", True, beat("edge1", 99), False),  # what it counts, it says of no elector
        ("robot1", True, beat("robot2", 5), False),
        ("robot1", True, beat("robot2", 6), True),
        ("edge1", False, beat("robot2", 0), False),  # nobody remembers anything of a node that never votes
        ("edge1", False, beat("robot2", 1), True),
        ("edge1", True, beat("robot2", 5), False),
    ],
)
def test_a_peer_is_asked_once_by_an_elector_and_whenever_its_count_rises(
    me: str, has_answered: bool, heard: Beat, must: bool
) -> None:
    own = witness(me)
    if has_answered:
        own.on_answer(said(heard.node, votes=5))
    assert own.must_ask(heard) is must


def test_the_highest_life_and_count_of_electors_are_kept_whatever_comes_later() -> None:
    own = witness()
    for incarnation, votes in ((3, 20), (4, 18), (2, 19)):
        own.on_answer(said("robot2", incarnation, votes))
    own.on_answer(said("edge1", 9, 99))
    own.on_answer(said("robot3", 0, 0))
    assert own.seen == {"robot2": (4, 20), "robot3": (0, 0)}, "of one without a state, that it has none"


@pytest.mark.parametrize(("incarnation", "is_lost"), [(6, True), (7, False)])
def test_what_it_has_voted_since_its_start_is_known_of_this_life_only(incarnation: int, *, is_lost: bool) -> None:
    own = witness()
    own.votes += 2
    assert bool(own.on_answer(said("robot2", 3, 0, ("robot1", incarnation, 12)))) is is_lost


def test_the_operator_reads_who_remembers_what() -> None:
    assert witness().on_answer(said("robot2", 3, 0, ("robot1", 8, 2))) == (
        "robot2 remembers a later life of this elector (8, this is 7)"
    )
    assert witness().on_answer(said("robot2", 3, 0, ("robot1", 6, 11))) == (
        "robot2 remembers 11 votes of this elector, its state knows of 10"
    )
    assert witness().on_answer(said("robot2", 3, 0, ("robot3", 8, 99), ("robot1", 7, 10))) == ""


def test_what_was_seen_is_written_and_read_again() -> None:
    seen = {"robot2": (8, 120), "robot1": (7, 3)}
    assert as_tuple(seen) == (("robot1", 7, 3), ("robot2", 8, 120))
    assert as_seen(as_tuple(seen)) == seen


@pytest.mark.parametrize(
    ("has_twin", "votes", "is_lost"), [(False, 0, True), (True, 0, False), (True, 10, False), (True, 11, True)]
)
def test_a_later_life_is_a_twin_s_where_the_name_lives_twice_unless_it_has_voted_more(
    has_twin: bool, votes: int, is_lost: bool
) -> None:
    """A twin that came and left, and was heard by others, is not this elector's own forgotten past."""
    own = witness(votes=10)
    if has_twin:
        own.on_twin()
    assert bool(own.on_answer(said("robot2", 3, 0, ("robot1", 8, votes)))) is is_lost


def test_a_later_life_that_a_peer_did_not_know_of_at_our_start_is_a_twin_s() -> None:
    own = witness(votes=10)
    assert not own.on_answer(said("robot2"))
    assert not own.on_answer(said("robot2", 3, 0, ("robot1", 8, 0)))
    assert own.on_answer(said("robot2", 3, 0, ("robot1", 8, 11)))
    assert witness(votes=10).on_answer(said("robot3", 3, 0, ("robot1", 8, 0)))


def test_a_twin_s_life_is_told_with_this_one_s_votes() -> None:
    """A peer keeps the highest incarnation and the highest count, whichever of the two said it."""
    own = witness(votes=10)
    own.on_twin()
    own.votes = 15
    assert not own.on_answer(said("robot2", 3, 0, ("robot1", 8, 15)))
    assert own.on_answer(said("robot2", 3, 0, ("robot1", 8, 16)))
