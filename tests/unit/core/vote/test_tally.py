from __future__ import annotations

import itertools

import pytest

from support.proposals import proposal_of
from zsched.core.values.model import Proposal
from zsched.core.values.quorum import majority
from zsched.core.vote.tally import Tally, VoteOutcome, tally

THREE = ("r1", "r2", "r3")
FIVE = (*THREE, "r4", "r5")


def paper(voter: str, candidate: str, aggregate: float = 0.5, *, escape: bool = False) -> Proposal:
    return proposal_of(voter, candidate, base_revision=4, aggregate=aggregate, is_escape=escape)


def counted(
    *proposals: Proposal,
    voters: tuple[str, ...] = THREE,
    present: tuple[str, ...] | None = None,
    owner: str | None = "edge1",
    is_over: bool = False,
) -> Tally:
    return tally(
        {proposal.voter: proposal for proposal in proposals},
        voters=voters,
        present=frozenset(voters if present is None else present),
        owner=owner,
        is_over=is_over,
    )


def test_the_most_proposed_candidate_wins() -> None:
    result = counted(paper("r1", "edge2"), paper("r2", "edge3"), paper("r3", "edge2"))

    assert (result.outcome, result.winner) == (VoteOutcome.WON, "edge2")
    assert result.votes == (("r1", "edge2"), ("r2", "edge3"), ("r3", "edge2"))
    assert result.reason == "2 of 3 for edge2"


def test_staying_is_a_proposal_for_the_owner() -> None:
    result = counted(paper("r1", "edge2"), paper("r2", "edge1"), paper("r3", "edge1"))

    assert (result.outcome, result.winner) == (VoteOutcome.STAY, "edge1")


def test_plurality_suffices_when_all_have_voted() -> None:
    papers = [paper(voter, "edge2") for voter in FIVE[:2]]
    others = [paper("r3", "edge3"), paper("r4", "edge4"), paper("r5", "edge1")]

    assert counted(*papers, *others, voters=FIVE).winner == "edge2"


# --- quorum --------------------------------------------------------------------------------------------------------


def test_no_outcome_without_a_majority_of_the_configured_robots() -> None:
    one = [paper("r1", "edge2")]

    assert counted(*one).outcome is VoteOutcome.PENDING
    assert counted(*one, is_over=True).outcome is VoteOutcome.NO_QUORUM
    assert counted(*one, is_over=True).winner is None
    assert counted(*one, present=("r1",)).outcome is VoteOutcome.NO_QUORUM, "two that are gone are not waited for"


def test_two_of_four_are_no_majority() -> None:
    four = FIVE[:4]
    papers = [paper(voter, "edge2") for voter in four[:2]]

    assert counted(*papers, voters=four, is_over=True).outcome is VoteOutcome.NO_QUORUM
    assert counted(*papers, paper("r3", "edge2"), voters=four).outcome is VoteOutcome.WON


def test_strangers_and_edges_have_no_vote() -> None:
    result = counted(paper("edge7", "edge2"), paper("r9", "edge2"), paper("r1", "edge2"), is_over=True)

    assert result.outcome is VoteOutcome.NO_QUORUM
    assert result.votes == (("r1", "edge2"),)


@pytest.mark.parametrize(
    ("present", "papers", "outcome"),
    [
        (THREE, 1, VoteOutcome.PENDING),
        (THREE[:2], 1, VoteOutcome.PENDING),
        (THREE[:2], 2, VoteOutcome.WON),
        (THREE[:1], 1, VoteOutcome.WON),
        ((), 1, VoteOutcome.WON),
    ],
)
def test_an_escape_needs_a_majority_of_the_robots_that_are_not_gone(
    present: tuple[str, ...], papers: int, outcome: VoteOutcome
) -> None:
    result = counted(*[paper(voter, "edge2", escape=True) for voter in THREE[:papers]], present=present)

    assert (result.outcome, result.is_escape) == (outcome, True)


def test_an_escape_never_goes_without_any_proposal_and_never_needs_more_than_the_usual_majority() -> None:
    assert counted(present=(), is_over=True).outcome is VoteOutcome.NO_QUORUM
    papers = [paper(voter, "edge2", escape=True) for voter in FIVE[:3]]
    assert counted(*papers, voters=FIVE).outcome is VoteOutcome.WON


def test_one_robot_that_flees_makes_the_vote_an_escape() -> None:
    papers = paper("r1", "edge2", escape=True), paper("r2", "edge2")
    result = counted(*papers, voters=FIVE, present=THREE, is_over=True)
    assert (result.outcome, result.winner, result.is_escape) == (VoteOutcome.WON, "edge2", True)


def test_gone_robots_lower_the_quorum_for_escapes_only() -> None:
    assert counted(paper("r1", "edge2"), present=("r1",), is_over=True).outcome is VoteOutcome.NO_QUORUM


# --- pending -------------------------------------------------------------------------------------------------------


def test_a_majority_for_one_is_decided_at_once_a_split_waits_for_those_still_missing() -> None:
    assert counted(paper("r1", "edge2"), paper("r2", "edge2")).outcome is VoteOutcome.WON
    split = (paper("r1", "edge2"), paper("r2", "edge3"))
    assert counted(*split).outcome is VoteOutcome.PENDING
    assert counted(*split, present=THREE[:2]).outcome is VoteOutcome.WON
    assert counted(*split, is_over=True).outcome is VoteOutcome.WON


def test_an_outcome_is_never_taken_back_by_a_later_proposal() -> None:
    """Every order of every ballot paper: once decided (before the time is over), further papers change nothing."""
    for choice in itertools.product(("edge1", "edge2", "edge3"), repeat=3):
        papers = [paper(voter, candidate) for voter, candidate in zip(THREE, choice, strict=True)]
        final = counted(*papers)
        assert final.outcome in (VoteOutcome.WON, VoteOutcome.STAY)
        for order in itertools.permutations(papers):
            for known in range(4):
                early = counted(*order[:known])
                if early.outcome is not VoteOutcome.PENDING:
                    assert (early.outcome, early.winner) == (final.outcome, final.winner)


# --- ties ----------------------------------------------------------------------------------------------------------


def test_a_tie_goes_to_the_owner_even_with_the_lowest_aggregate() -> None:
    result = counted(paper("r1", "edge1", 0.1), paper("r2", "edge2", 0.9), paper("r3", "edge3", 0.9))

    assert (result.outcome, result.winner) == (VoteOutcome.STAY, "edge1")


def test_a_tie_without_the_owner_goes_to_the_higher_aggregate() -> None:
    result = counted(paper("r1", "edge2", 0.5), paper("r2", "edge3", 0.6), paper("r3", "edge4", 0.55))

    assert result.winner == "edge3"


def test_aggregates_equal_to_one_in_1024_leave_it_to_the_lowest_name() -> None:
    result = counted(paper("r1", "edge3", 0.5 + 0.4 / 1024), paper("r2", "edge2", 0.5), owner=None, is_over=True)

    assert (result.outcome, result.winner) == (VoteOutcome.WON, "edge2")


def test_the_count_goes_before_the_aggregate() -> None:
    result = counted(paper("r1", "edge2", 0.1), paper("r2", "edge2", 0.1), paper("r3", "edge3", 1.0))

    assert result.winner == "edge2"


def test_every_robot_counts_alike_whatever_the_order_of_arrival() -> None:
    papers = [paper("r1", "edge3", 0.5), paper("r2", "edge2", 0.5), paper("r3", "edge4", 0.5)]

    assert len({counted(*order) for order in itertools.permutations(papers)}) == 1


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_a_lone_majority_is_the_same_number_everywhere(size: int) -> None:
    voters = FIVE[:size]
    needed = majority(size)
    papers = [paper(voter, "edge2") for voter in voters[:needed]]

    assert counted(*papers, voters=voters).outcome is VoteOutcome.WON
    assert counted(*papers[1:], voters=voters, is_over=True).outcome is VoteOutcome.NO_QUORUM
