"""Filters travel by their names; what an older program says in words alone is read for one release."""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.fleets import task_of
from support.profiles import load_of, profile_of
from zsched.core.scheduler.eligibility import CHAIN, Case, Doubts, chain_of, veto
from zsched.core.scheduler.judge import escape_reason
from zsched.core.scheduler.standing import Standing, compare
from zsched.core.scheduler.usage import Use
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import PeerState, UtilityVector
from zsched.core.values.profile import WorkerState
from zsched.core.values.veto import Filter, Veto, read

SPEC = task_of(worker=WorkerSpec(command=("worker",)))
VECTOR = UtilityVector(voter="robot1", task="merge", revision=1, utilities=())
FULL = Veto(Filter.MEMORY, "needs 6144 MiB, has 5120 free")


def test_a_vector_carries_which_filter_keeps_whom_out() -> None:
    vector = VECTOR.refusing({"edge2": FULL, "edge1": Veto(Filter.DRAIN, "draining")})
    assert vector.refused == (("edge1", "draining"), ("edge2", FULL.why)), "as older programs read it"
    assert from_plain(as_plain(vector), UtilityVector).vetoes["edge2"] == FULL


def test_a_filter_that_is_unknown_here_keeps_out_all_the_same() -> None:
    told = as_plain(VECTOR.refusing({"edge1": FULL}))
    told["filters"] = ["wind"]
    assert from_plain(told, UtilityVector).vetoes == {"edge1": Veto(Filter.OTHER, FULL.why)}


@pytest.mark.parametrize(
    ("why", "expected"),
    [
        ("clock in doubt", Filter.LEASE),
        ("too few electors can give it a lease (1 of 3)", Filter.LEASE),
        ("needs 6144 MiB, has 5120 free", Filter.MEMORY),
        ("no fresh profile", Filter.OTHER),
    ],
)
def test_what_an_older_program_says_in_words_is_read(why: str, expected: Filter) -> None:
    told = as_plain(VECTOR.refusing({"edge1": Veto(Filter.HEARD, why)}))
    del told["filters"]
    assert from_plain(told, UtilityVector).vetoes == {"edge1": Veto(expected, why)}
    assert read(None, why).why == why


@pytest.mark.parametrize("kept_out_by", list(Filter))
def test_a_reworded_sentence_changes_nothing(kept_out_by: Filter) -> None:
    """Whether an owner is fled from hangs on the filter, whatever is said of it."""
    left = [_escape(Veto(kept_out_by, why)) is not None for why in ("reached by 1 of 3 robots", "needs 3 MiB", "")]
    assert left == [kept_out_by in (Filter.REACH, Filter.LEASE)] * 3


def _escape(told: Veto) -> Veto | None:
    standing = Standing(aggregates={}, vetoed={"edge1": told}, vectors=(), voters_heard=3)
    seen = profile_of("edge1", workers=(load_of(state=WorkerState.READY),))
    return escape_reason(SPEC, allocation_of(1, "edge1"), PeerState.ALIVE, seen, standing, 0.0)


def test_the_first_filter_of_the_chain_is_told_and_each_can_be_switched_off() -> None:
    seen = profile_of("edge2", draining=True, workers=(load_of(state=WorkerState.FAILED),))
    case = Case(
        spec=SPEC,
        node="edge2",
        is_owner=False,
        state=PeerState.ALIVE,
        doubts=Doubts(unproven={"edge2": "back for 1.2 s, its streams are not proven yet"}),
        profile=seen,
        needed_mb=500.0,
        use=Use(cpu_cores=1.0, memory_mb=seen.memory_mb + 1.0),
    )
    told, chain = [], dict(chain_of(case.spec, case.doubts))
    assert chain.keys() < CHAIN.keys(), "what keeps out nobody now is not looked at"
    while (found := veto(case, chain.items())) is not None:
        told.append(found.filter)
        del chain[found.filter]
    assert told == [Filter.STREAMS, Filter.DRAIN, Filter.WORKER, Filter.MEMORY]
    assert list(CHAIN) == [one for one in Filter if one in CHAIN], "in the order that `explain` tells"


def test_robots_that_refuse_for_different_filters_are_joined() -> None:
    vectors = {
        name: UtilityVector(voter=name, task="merge", revision=1, utilities=()).refusing({"edge1": why})
        for name, why in (("robot1", FULL), ("robot2", Veto(Filter.DRAIN, "draining")))
    }
    joint = compare(SPEC, allocation_of(1, "edge1"), vectors)
    assert joint.vetoed["edge1"].filter is Filter.DRAIN
    assert joint.vetoed["edge2"].filter is Filter.SCORES
