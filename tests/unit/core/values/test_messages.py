"""What each message refuses, and that it can be built and is frozen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from zsched.core.values.messages import (
    Accept,
    Accepted,
    FleetAnswer,
    Learnt,
    Prepare,
    Promise,
    Refusal,
    Refused,
    Utilities,
    votes_of,
)
from zsched.core.values.model import NO_BALLOT, Acceptance, Ballot
from zsched.core.values.relay_protocol import EndMarker

BALLOT = Ballot(counter=1, node="r1", incarnation=1)
VALUE = allocation_of(owner="e1")
ACCEPTANCE = Acceptance(ballot=BALLOT, value=VALUE)
PROMISE = Promise(elector="r2", task="merge", ballot=BALLOT)
ACCEPTED = Accepted(elector="r2", task="merge", ballot=BALLOT)
REFUSED = Refused(elector="r2", task="merge", ballot=BALLOT, refusal=Refusal.BALLOT, promised=BALLOT)
BAD_NAMES = ("", "Robot", "a/b", "-a", "é", "a" * 64, "*", "a\n")

BUILDERS: dict[str, Callable[[str], object]] = {
    "prepare.task": lambda name: Prepare(task=name, ballot=BALLOT, electorate="x"),
    "promise.elector": lambda name: Promise(elector=name, task="merge", ballot=BALLOT),
    "accept.task": lambda name: Accept(task=name, acceptance=ACCEPTANCE, electorate="x"),
    "accepted.elector": lambda name: Accepted(elector=name, task="merge", ballot=BALLOT),
    "refused.elector": lambda name: Refused(
        elector=name, task="merge", ballot=BALLOT, refusal=Refusal.BALLOT, promised=BALLOT
    ),
    "learnt.node": lambda name: Learnt(node=name, values=(VALUE,)),
    "utilities.voter": lambda name: Utilities(voter=name, vectors=()),
}


@pytest.mark.parametrize("name", BAD_NAMES)
@pytest.mark.parametrize("field", BUILDERS)
def test_message_with_a_malformed_name_is_refused_by_field(field: str, name: str) -> None:
    with pytest.raises(ValueError, match=field):
        BUILDERS[field](name)


def test_accept_of_another_tasks_value_is_refused() -> None:
    with pytest.raises(ValueError, match="accept: value of 'other' for task 'merge'"):
        Accept(task="merge", acceptance=replace(ACCEPTANCE, value=replace(VALUE, task="other")), electorate="x")


@pytest.mark.parametrize("answers", [[PROMISE], [ACCEPTED], [REFUSED], [PROMISE, ACCEPTED, REFUSED]])
def test_votes_are_those_of_the_elector_that_answers(answers: list[Promise | Accepted | Refused]) -> None:
    votes = votes_of(answers)
    assert (votes.elector, votes.answers) == ("r2", tuple(answers))
    ahead = votes_of([], FleetAnswer(accepted=replace(ACCEPTED, task="fleet")))
    assert (ahead.elector, ahead.answers) == ("r2", ())
    with pytest.raises(ValueError, match="the answers of one elector"):
        votes_of([*answers, replace(PROMISE, elector="r1")])


def test_ballots_are_ordered_by_counter_then_node_then_incarnation() -> None:
    ordered = [
        NO_BALLOT,
        Ballot(counter=1, node="a", incarnation=9),
        Ballot(counter=1, node="b", incarnation=1),
        Ballot(counter=1, node="b", incarnation=2),
        Ballot(counter=2, node="a", incarnation=1),
    ]
    assert sorted(set(ordered)) == ordered


def test_a_marker_says_nothing_of_what_it_leaves_out() -> None:
    marker = EndMarker(epoch=3, count=7)
    assert (marker.replayed, marker.slot, marker.had, marker.age_s) == (0, 0, None, None)
    assert (marker.is_whole, marker.is_given_up) == (False, False)
