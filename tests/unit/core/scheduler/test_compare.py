from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from support.proposals import vector_of
from zsched.core.scheduler.standing import Standing, compare, pick, rounded
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Reach, ScoreForm, Tuning, Utility, UtilityVector, Weights
from zsched.core.values.quorum import majority

SPEC = task_of(candidates=("edge1", "edge2", "edge3"), tuning=tuning_of(cpu=1.0, memory=0.0))
GONE = -1.0
"""In `vote`: this robot does not reach the candidate."""


def vote(
    voter: str, *, revision: int = 7, refused: Mapping[str, str] | None = None, **utilities: float
) -> UtilityVector:
    return vector_of(voter, utilities, revision, refused=tuple(sorted((refused or {}).items())))


def joined(*vectors: UtilityVector, spec: TaskSpec = SPEC) -> Standing:
    allocation = allocation_of(7, epoch=3, tuning=SPEC.tuning)
    return compare(spec, allocation, {vector.voter: vector for vector in vectors})


def test_columns_are_averaged_over_the_robots() -> None:
    standing = joined(
        vote("r1", edge1=0.9, edge2=0.1), vote("r2", edge1=0.1, edge2=0.2), vote("r3", edge1=0.2, edge2=0.3)
    )

    assert standing.aggregates == {"edge1": pytest.approx(0.4), "edge2": pytest.approx(0.2)}
    assert {name: str(veto) for name, veto in standing.vetoed.items()} == {"edge3": "not scored by enough robots"}
    assert standing.voters_heard == 3


@pytest.mark.parametrize(
    ("reach", "unreached", "is_vetoed"),
    [
        (Reach.MAJORITY, 0, False),
        (Reach.MAJORITY, 1, False),
        (Reach.MAJORITY, 2, True),
        (Reach.MAJORITY, 3, True),
        (Reach.ALL, 0, False),
        (Reach.ALL, 1, True),
    ],
)
def test_a_candidate_that_too_few_reach_is_vetoed(reach: Reach, unreached: int, *, is_vetoed: bool) -> None:
    vectors = [vote(f"r{i}", edge1=GONE if i < unreached else 0.9) for i in range(3)]
    standing = joined(*vectors, spec=replace(SPEC, reach=reach))

    assert ("edge1" not in standing.aggregates) is is_vetoed
    if is_vetoed:
        assert str(standing.vetoed["edge1"]) == f"reached by {3 - unreached} of 3 robots"


def test_half_of_the_robots_is_no_majority_that_reaches() -> None:
    standing = joined(*[vote(f"r{i}", edge1=GONE if i < 2 else 0.9) for i in range(4)])

    assert str(standing.vetoed["edge1"]) == "reached by 2 of 4 robots"


def test_refused_by_most_is_vetoed_with_their_reason_by_one_is_not() -> None:
    refusal = {"edge1": "draining"}
    one = joined(vote("r1", refused=refusal), vote("r2", edge1=0.5), vote("r3", edge1=0.7))
    two = joined(vote("r1", refused=refusal), vote("r2", refused=refusal), vote("r3", edge1=0.7))

    assert one.aggregates == {"edge1": pytest.approx(0.6)}
    assert str(two.vetoed["edge1"]) == "draining"


def test_reach_all_tells_not_scored_from_not_reached() -> None:
    """One lost profile vetoes under `reach: all`, but it is no proof that the owner is out of reach."""
    every = replace(SPEC, reach=Reach.ALL)
    missing = vote("r1", refused={"edge1": "no fresh profile"})

    stale = joined(missing, vote("r2", edge1=0.5), vote("r3", edge1=0.5), spec=every)
    assert str(stale.vetoed["edge1"]) == "no fresh profile"
    both = joined(missing, vote("r2", edge1=GONE), vote("r3", edge1=0.5), spec=every)
    assert str(both.vetoed["edge1"]) == "reached by 1 of 3 robots"


def test_strangers_in_a_vector_change_nothing_and_nobody_heard_vetoes_all() -> None:
    assert "edge9" not in joined(vote("r1", edge9=1.0, edge1=0.1)).aggregates
    assert set(joined().vetoed) == set(SPEC.candidates)
    assert joined().voters_heard == 0


# --- pick ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("aggregates", "owner", "picked"),
    [
        ({}, "edge1", None),
        ({"edge1": 0.5, "edge2": 0.6}, "edge1", "edge2"),
        ({"edge1": 0.5, "edge2": 0.5}, "edge2", "edge2"),
        ({"edge2": 0.5, "edge1": 0.5}, None, "edge1"),
        ({"edge2": 0.5, "edge1": 0.5}, "edge3", "edge1"),
        ({"edge1": 0.5, "edge2": 0.5 + 0.4 / 1024}, "edge1", "edge1"),
        ({"edge1": 0.5, "edge2": 0.5 + 1 / 1024}, "edge1", "edge2"),
    ],
)
def test_pick_takes_the_highest_to_one_in_1024_then_the_owner_then_the_name(
    aggregates: Mapping[str, float], owner: str | None, picked: str | None
) -> None:
    assert pick(aggregates, owner) == picked


def test_sums_that_differ_by_their_order_only_are_one_number() -> None:
    assert rounded(0.1 + 0.2 + 0.3) == rounded(0.3 + 0.2 + 0.1)
    assert [majority(count) for count in range(1, 8)] == [1, 2, 2, 3, 3, 4, 4]


def test_a_candidate_gains_nothing_by_a_far_robot_that_leaves_it_out() -> None:
    """Both are alike to each robot; the far one doubts edge2 for a moment."""
    near = [vote(name, edge1=0.9, edge2=0.9) for name in ("r1", "r2")]
    far, doubts = vote("r3", edge1=0.1, edge2=0.1), vote("r3", edge1=0.1, refused={"edge2": "was gone"})

    both = joined(*near, far).aggregates
    assert both["edge1"] == both["edge2"]
    assert joined(*near, doubts).aggregates == {
        "edge1": pytest.approx(0.9),
        "edge2": pytest.approx(0.9),
    }
    first = [vote(name, edge1=0.9, refused={"edge2": "was gone"}) for name in ("r1", "r2")]
    last = [vote(name, edge2=0.5, refused={"edge1": "was gone"}) for name in ("r4", "r5")]
    found = joined(*first, vote("r3", edge1=0.3, edge2=0.2, edge3=0.2), *last)
    assert found.aggregates == {"edge1": pytest.approx(0.7), "edge2": pytest.approx(0.4)}, "one robot scores both"
    assert {name: str(veto) for name, veto in found.vetoed.items()} == {"edge3": "not scored by enough robots"}


@pytest.mark.parametrize(
    ("cpu", "machines"), [(0.5, {"edge1": 0.8, "edge2": 0.6}), (0.0, {"edge1": 1.0, "edge2": 1.0})]
)
def test_what_a_machine_is_worth_by_itself_does_not_follow_its_signal(cpu: float, machines: dict[str, float]) -> None:
    """A robot that drives away has broken no promise: on recorded drives such tasks stayed 1.1 dB farther away."""
    weights = Weights(cpu=cpu, memory=0.0, network=1.0 - cpu)
    agreed = allocation_of(7, epoch=3, tuning=Tuning(weights=weights, score=ScoreForm.SERVICE))
    for signal in (0.9, 0.3):
        utilities = tuple(
            Utility(candidate=name, value=signal / 2, cpu=own, network=signal)
            for name, own in (("edge1", 0.8), ("edge2", 0.6))
        )
        vectors = {
            name: UtilityVector(voter=name, task="merge", revision=7, utilities=utilities) for name in ("r1", "r2")
        }
        assert compare(SPEC, agreed, vectors).machines == machines
    assert joined(vote("r1", edge1=0.9), vote("r2", edge1=0.1)).machines is None, "without a weight of the network"
