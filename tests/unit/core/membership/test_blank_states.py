"""What speaks against a blank state, by what the fleet answers (`zsched init`)."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import tuning_of
from support.states import state_of
from zsched.core.values.durable import DurableState
from zsched.core.values.snapshot import QuorumStatus, Snapshot, TaskStatus
from zsched.core.vote.belief import GENERATION_STEP
from zsched.core.vote.generations import generation_of, objection

TUNING = tuning_of(cpu=1.0, memory=0.0)
GOOD = state_of("robot3", fleet="hall", incarnation=1, electorate="")
LOST = ("robot1", "robot2")


def says(
    node: str = "robot1",
    *,
    revision: int = 7,
    alive: int = 2,
    voted: tuple[str, ...] = (),
    stateless: tuple[str, ...] = (),
) -> Snapshot:
    """The status of one node of a fleet of three electors."""
    task = TaskStatus(
        name="merge",
        owner=None,
        epoch=0,
        revision=revision,
        since_s=None,
        owner_state="none",
        phase="idle",
        tuning=TUNING,
        candidates=(),
    )
    quorum = QuorumStatus(
        electors=3, needed=2, alive=alive, ok=alive >= 2, this_node="elector", voted=voted, stateless=stateless
    )
    return Snapshot(
        schema="",
        version="",
        fleet="hall",
        node=node,
        kind="robot",
        incarnation=1,
        up_s=1.0,
        loop_lag_s=0.0,
        quorum=quorum,
        nodes=(),
        tasks=(task,),
    )


def why(
    generation: int,
    *answers: Snapshot,
    good: DurableState | None = None,
    is_elector: bool = True,
    is_forced: bool = False,
) -> str | None:
    return objection("robot3", generation, good, answers, is_elector=is_elector, is_forced=is_forced)


def test_the_generation_shows_in_the_revisions() -> None:
    assert [generation_of(says(revision=one)) for one in (0, 7, GENERATION_STEP, 3 * GENERATION_STEP + 5)] == [
        0,
        0,
        1,
        3,
    ]


def test_a_first_state_is_refused_where_a_vote_is_remembered_or_the_fleet_is_further() -> None:
    assert why(0) is None
    assert why(0, says(), says("robot2", voted=("robot1",))) is None
    remembered = why(0, says(), says("robot2", voted=("robot3",))) or ""
    assert "robot2 knows robot3 as an elector that has voted" in remembered
    ahead = why(0, says(), says("robot2", revision=2 * GENERATION_STEP + 1)) or ""
    voted = why(0, says("robot2", revision=2 * GENERATION_STEP + 1, voted=("robot3",))) or ""
    assert "`zsched fleet recover --generation 3 --force` on every node" in voted, "no advice that is refused next"
    assert "the fleet lives in generation 2; join it with `zsched fleet recover --generation 2`" in ahead


@pytest.mark.parametrize("forced", [False, True])
def test_nothing_lets_a_node_vote_twice_in_a_generation_or_stay_behind_it(forced: bool) -> None:
    new = says(revision=GENERATION_STEP + 1, voted=("robot3",))
    assert "has voted" in (why(1, new, is_forced=forced) or "")
    assert "--generation 2 --force` on every node" in (why(1, new, is_forced=forced) or "")
    assert "join it with" in (why(1, says(revision=2 * GENERATION_STEP), is_forced=forced) or "")


def test_where_electors_are_agreed_no_generation_by_hand_is_advised() -> None:
    agreed = says("robot2", voted=("robot3",))
    agreed = replace(agreed, quorum=replace(agreed.quorum, number=4, names=("robot1", "robot2", "robot3")))
    told = why(0, agreed) or ""
    assert "would let it vote twice" in told
    assert "`zsched fleet recover --rejoin GENERATION` makes it a new member" in told
    assert "--generation" not in told
    assert why(0, replace(agreed, quorum=replace(agreed.quorum, names=("robot1", "robot2")))) is None, "it has no seat"


def test_a_node_joins_a_new_generation_that_others_have_begun_whatever_the_rest_says() -> None:
    """The rest still goes by the old one, and remembers votes of that."""
    new = says("robot1", revision=GENERATION_STEP, alive=1)
    assert why(1, says("edge1", voted=("robot3",)), new, good=GOOD) is None


def test_a_fleet_that_agrees_needs_no_new_generation() -> None:
    refused = why(1, says(alive=1), says("robot2", alive=2)) or ""
    assert "the fleet lives in generation 0 and agrees (robot2: 2 of 3 electors can answer, 2 needed)" in refused
    assert why(1, says(alive=2), is_elector=False) is not None
    assert why(1, says(alive=2), good=GOOD, is_forced=True) is None


def test_a_good_state_is_kept_until_somebody_says_that_too_many_are_lost() -> None:
    assert "no other node answered" in (why(1, good=GOOD) or "")
    assert "nobody who answered says" in (why(1, says(alive=1), good=GOOD) or ""), "the others may just be off"
    assert "nobody who answered says" in (why(1, says(alive=1, stateless=LOST[:1]), good=GOOD) or "")
    assert why(1, says(alive=1, stateless=LOST), good=GOOD) is None
    assert why(1, good=GOOD, is_forced=True) is None
    assert why(1) is None, "nothing is lost with a state that is not there"
    assert why(1, good=GOOD, is_elector=False) is None, "it has promised nothing"
