"""Owners that say that they rest: when their word counts, and for how long they are avoided."""

from __future__ import annotations

from support.profiles import load_of, profile_of
from zsched.core.doubt import DOUBT_S
from zsched.core.scheduler.rested import SURE_S, Rested
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.words import HAS_RESTED, RESTS

EDGES = ("edge1", "edge2")


def owner(node: str = "edge1", *, rests: bool = True, state: WorkerState = WorkerState.READY) -> Profile:
    return profile_of(node, workers=(load_of(state=state, reason=f"{RESTS} (why)" if rests else ""),))


def heard(rested: Rested, profile: Profile, start: float, for_s: float, *, is_explained: bool = False) -> float:
    """The same word each half second; the time of the last."""
    now = start
    while now < start + for_s:
        rested.hear("merge", profile, now, is_explained=is_explained)
        now += 0.5
    return now - 0.5


def test_a_word_counts_once_it_has_stood_for_a_while_and_then_for_a_minute() -> None:
    rested = Rested()
    heard(rested, owner(), 0.0, SURE_S)
    assert rested.reasons("merge", EDGES, SURE_S) == {}
    rested.hear("merge", owner(), SURE_S, is_explained=False)
    assert rested.reasons("merge", EDGES, SURE_S + DOUBT_S - 0.1) == {"edge1": HAS_RESTED}
    assert rested.reasons("merge", EDGES, SURE_S + DOUBT_S) == {}
    assert rested.reasons("slam", EDGES, SURE_S) == {}


def test_what_beats_explain_an_owner_at_work_and_one_that_is_not_ready_say_nothing() -> None:
    for profile, is_explained in (
        (owner(), True),
        (owner(rests=False), False),
        (owner(state=WorkerState.STARTING), False),
        (profile_of("edge1"), False),
    ):
        rested = Rested()
        heard(rested, owner(), 0.0, SURE_S)
        rested.hear("merge", profile, SURE_S, is_explained=is_explained)
        now = heard(rested, owner(), SURE_S + 0.5, SURE_S)
        assert rested.reasons("merge", EDGES, now) == {}, "it has begun anew"


def test_another_owner_has_its_own_time() -> None:
    rested = Rested()
    heard(rested, owner(), 0.0, SURE_S)
    now = heard(rested, owner("edge2"), SURE_S, SURE_S)
    assert rested.reasons("merge", EDGES, now) == {}


def test_an_owner_that_rests_again_and_again_and_never_for_long_has_rested() -> None:
    """2.8 s of each 3.5: its time began anew with each lease."""
    rested, now = Rested(), 0.0
    for _ in range(2):
        heard(rested, owner(), now, SURE_S)
        now = heard(rested, owner(rests=False), now + SURE_S, 0.5) + 0.5
        assert rested.reasons("merge", EDGES, now) == {}
    now = heard(rested, owner(), now, SURE_S)
    assert rested.reasons("merge", EDGES, now) == {"edge1": HAS_RESTED}


def test_the_time_in_which_another_one_has_the_task_is_no_rest() -> None:
    rested = Rested()
    now = heard(rested, owner(), 0.0, SURE_S)
    now = heard(rested, owner("edge2", rests=False), now + 0.5, 60.0)
    now = heard(rested, owner(), now + 0.5, SURE_S)
    assert rested.reasons("merge", EDGES, now) == {}


def test_nobody_is_avoided_where_all_have_rested() -> None:
    rested = Rested()
    now = heard(rested, owner(), 0.0, SURE_S + 1.0)
    assert rested.reasons("merge", ("edge1",), now) == {}
    now = heard(rested, owner("edge2"), now + 0.5, SURE_S + 1.0)
    assert rested.reasons("merge", EDGES, now) == {}
    assert rested.reasons("merge", (*EDGES, "edge3"), now) == dict.fromkeys(EDGES, HAS_RESTED)


def test_who_rests_again_after_a_trial_is_avoided_for_twice_as_long() -> None:
    rested = Rested()
    now = heard(rested, owner(), 0.0, SURE_S + 1.0) + DOUBT_S
    assert rested.reasons("merge", EDGES, now) == {}
    now = heard(rested, owner(), now, SURE_S + 1.0)
    assert rested.reasons("merge", EDGES, now + 2 * DOUBT_S - 0.1) == {"edge1": HAS_RESTED}
    assert rested.reasons("merge", EDGES, now + 2 * DOUBT_S) == {}


def test_ten_minutes_at_work_halve_the_time_and_a_rest_that_beats_explain_is_no_work() -> None:
    for is_explained, for_s in ((False, DOUBT_S), (True, 2 * DOUBT_S)):
        rested = Rested()
        now = heard(rested, owner(), 0.0, SURE_S + 1.0) + DOUBT_S
        now = heard(rested, owner(rests=False), now, 620.0, is_explained=is_explained) + 0.5
        now = heard(rested, owner(), now, SURE_S + 1.0)
        assert rested.reasons("merge", EDGES, now + for_s - 0.1) == {"edge1": HAS_RESTED}
        assert rested.reasons("merge", EDGES, now + for_s) == {}


def test_a_worker_that_is_not_ready_proves_nothing() -> None:
    rested = Rested()
    now = heard(rested, owner(), 0.0, SURE_S + 1.0) + DOUBT_S
    now = heard(rested, owner(rests=False, state=WorkerState.STARTING), now, 620.0) + 0.5
    now = heard(rested, owner(), now, SURE_S + 1.0)
    assert rested.reasons("merge", EDGES, now + 2 * DOUBT_S - 0.1) == {"edge1": HAS_RESTED}


def test_nothing_is_known_of_tasks_and_nodes_that_are_no_more() -> None:
    for tasks, nodes, is_known in (((), EDGES, False), (("merge",), ("edge2",), False), (("merge",), EDGES, True)):
        rested = Rested()
        now = heard(rested, owner(), 0.0, SURE_S + 1.0)
        rested.keep(tasks, nodes)
        assert bool(rested.reasons("merge", EDGES, now)) is is_known
        rested.hear("merge", owner(), now + 0.1, is_explained=False)  # who is no more begins anew
        assert bool(rested.reasons("merge", EDGES, now + 0.1)) is is_known


def test_three_seconds_make_a_word_sure() -> None:
    assert SURE_S == 3.0
