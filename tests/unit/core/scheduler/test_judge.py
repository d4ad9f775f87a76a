from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from support.profiles import load_of, profile_of
from support.proposals import vector_of
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import (
    FIT_S,
    INITIAL_SETTLE_S,
    Judge,
    Judgement,
    Outcome,
    escape_ahead,
    escape_reason,
)
from zsched.core.scheduler.standing import LOST_S, Standing, compare
from zsched.core.values.fleet import TaskSpec, WorkerSpec
from zsched.core.values.model import Allocation, Asked, Pause, PeerState, Pin
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.veto import Filter, Veto

TUNING = tuning_of(cpu=1.0, memory=0.0, bonus=0.10)
SPEC = task_of(
    candidates=("edge1", "edge2", "edge3"), tuning=TUNING, price_s=0.25, worker=WorkerSpec(command=("worker",))
)
"""A lead of 0.05 over the bonus, as in `BETTER`, has cost a move in 3.5 s: 0.175 s, and 0.075 s that are expected."""


def standing(aggregates: Mapping[str, float], vetoed: Mapping[str, Veto] | None = None) -> Standing:
    return Standing(aggregates=aggregates, vetoed=vetoed or {}, vectors=(), voters_heard=3)


def allocation(owner: str | None = "edge1", *, paused: bool = False, pinned: bool = False) -> Allocation:
    revision = 0 if owner is None else 5
    return allocation_of(revision, owner, tuning=TUNING, paused=paused, pinned=pinned)


def judged(
    judge: Judge,
    aggregates: Mapping[str, float],
    now: float,
    *,
    escape: str | None = None,
    called: bool = False,
    agreed: Allocation | None = None,
    drained: str = "",
    fuse: Fuse | None = None,
    is_unheard: bool = False,
) -> Judgement:
    return judge.judge(
        standing(aggregates),
        agreed or allocation(),
        escape=escape,
        is_called=called,
        now=now,
        drained=drained,
        fuse=fuse,
        is_unheard=is_unheard,
    )


BETTER = {"edge1": 0.5, "edge2": 0.65}
EQUAL = {"edge1": 0.5, "edge2": 0.5}


# --- bonus ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("challenger", "leads"), [(0.4, False), (0.5, False), (0.6, False), (0.6 + 0.05 / 1024, False), (0.602, True)]
)
def test_a_challenger_must_beat_the_owner_with_its_bonus(challenger: float, *, leads: bool) -> None:
    judgement = judged(Judge(spec=SPEC), {"edge1": 0.5, "edge2": challenger}, now=0.0)

    assert judgement.outcome is (Outcome.WAIT if leads else Outcome.STAY)
    assert judgement.candidate == "edge1"
    assert judgement.aggregates == {"edge1": pytest.approx(0.6), "edge2": challenger}


def test_the_bonus_is_added_once_whatever_the_number_of_robots_and_rounds() -> None:
    judge = Judge(spec=SPEC)
    for voters in (1, 3, 9):
        vectors = {f"r{i}": vector_of(f"r{i}", {"edge1": 0.5}, 5) for i in range(voters)}
        joint = compare(SPEC, allocation(), vectors)
        for now in (0.0, 1.0, 2.0):
            judgement = judge.judge(joint, allocation(), escape=None, is_called=False, now=now)
            assert judgement.aggregate == pytest.approx(0.6)


# --- what staying costs --------------------------------------------------------------------------------------------


def test_a_lead_is_proposed_once_staying_has_cost_a_move() -> None:
    judge = Judge(spec=SPEC)
    outcomes = [(now, judged(judge, BETTER, now).outcome) for now in (10.0, 11.7, 13.4, 13.6)]

    assert outcomes == [(10.0, Outcome.WAIT), (11.7, Outcome.WAIT), (13.4, Outcome.WAIT), (13.6, Outcome.PROPOSE)]
    proposed = judged(judge, BETTER, 14.0)
    assert (proposed.candidate, proposed.is_escape) == ("edge2", False)
    assert proposed.aggregate == 0.65
    assert proposed.reason == "edge1 owes 0.27 s more than edge2"


def test_where_a_move_is_free_the_first_lead_is_followed() -> None:
    """The paper's schemes play so; what the bonus is for, it still does."""
    judge = Judge(spec=replace(SPEC, price_s=0.0))

    assert judged(judge, EQUAL, 0.0).outcome is Outcome.STAY
    assert judged(judge, BETTER, 0.5).outcome is Outcome.PROPOSE
    assert judged(Judge(spec=replace(SPEC, price_s=0.0)), BETTER, 0.0).outcome is Outcome.PROPOSE


def away(judge: Judge, *turns: tuple[WorkerState, float], start: float = 0.0) -> list[float]:
    """Of each look, for how long the owner's worker was away; it is in each state for so many seconds."""
    found, now = [], start
    for state, for_s in turns:
        for _ in range(round(for_s / 0.5)):
            now += 0.5
            found.append(judge.not_ready_for(profile(state=state), now))
    return found


def test_a_worker_that_is_ready_now_and_then_has_one_start_up_time_for_all_of_its_absences() -> None:
    """18 s away of each 45: it was never left, for each time had a start-up time of its own."""
    judge, turn = Judge(spec=SPEC), ((WorkerState.STARTING, 18.0), (WorkerState.READY, 27.0))
    longest = [max(away(judge, *turn, start=45.0 * count)) for count in range(3)]
    assert longest[1] < DEADLINE_S < longest[2]
    assert not judge.is_overdue(135.0), "now it is ready"


@pytest.mark.parametrize("between_s", [5.0, 30.0])
def test_one_that_is_started_anew_on_purpose_is_not_left_for_it(between_s: float) -> None:
    """Its first start, and two by an operator, of 12 s each."""
    judge = Judge(spec=SPEC)
    turns = [(WorkerState.STARTING, 12.0), (WorkerState.READY, between_s)] * 3
    assert max(away(judge, *turns)) < DEADLINE_S


def test_a_worker_that_is_ready_for_ten_times_as_long_has_all_its_time_again() -> None:
    judge, now = Judge(spec=SPEC), 0.0
    for _ in range(4):
        assert max(away(judge, (WorkerState.STARTING, 18.0), (WorkerState.READY, 181.0), start=now)) == 17.5
        now += 199.0


def test_an_absence_is_held_against_a_worker_for_its_start_up_time_at_most() -> None:
    """Nobody else could have the task."""
    judge = Judge(spec=SPEC)
    away(judge, (WorkerState.STARTING, 500.0), (WorkerState.READY, 30.0))
    assert max(away(judge, (WorkerState.STARTING, 500.0), (WorkerState.READY, 30.0), start=530.0)) == 499.5
    starting = profile(state=WorkerState.STARTING)
    assert judge.not_ready_for(starting, 1060.5) == pytest.approx(DEADLINE_S - 6.0, abs=0.2)
    told = escape_reason(SPEC, allocation(), PeerState.ALIVE, starting, standing({}), DEADLINE_S + 0.1, judge.held_s)
    assert str(told) == "the worker on edge1 has not been ready for 6.1 s, and 34 s of the time before"


OFTEN = ((WorkerState.STARTING, 18.0), (WorkerState.READY, 5.0)) * 2


def test_a_new_owner_begins_with_nothing_held_against_it() -> None:
    judge = Judge(spec=SPEC)
    away(judge, *OFTEN)
    judge.reset(is_new_owner=True)
    assert judge.not_ready_for(profile(state=WorkerState.STARTING), 47.0) == 0.0


def test_an_owner_that_is_not_heard_for_a_moment_has_its_time_neither_longer_nor_shorter() -> None:
    """A profile that came late each 15 s gave a worker that hung for good its whole start-up time again."""
    judge, starting = Judge(spec=SPEC), profile(state=WorkerState.STARTING)
    assert judge.not_ready_for(starting, 0.0) == 0.0
    assert judge.not_ready_for(starting, 15.0) == 15.0
    assert judge.not_ready_for(None, 16.0) == 0.0
    assert judge.not_ready_for(None, 116.0) == 0.0
    assert judge.not_ready_for(starting, 117.0) == 16.0
    assert judge.not_ready_for(starting, 117.0 + DEADLINE_S - 16.0 + 0.1) > DEADLINE_S


def test_an_owner_that_the_robots_lose_again_and_again_is_lost() -> None:
    """2.8 s of each 3.6: the 3 s began anew each time."""
    judge = Judge(spec=SPEC)
    longest = [max(judge.lost_for(step < 8, 0.1 * step + 3.6 * count) for step in range(36)) for count in range(3)]
    assert longest[0] < LOST_S
    assert longest[2] >= LOST_S
    other = Judge(spec=SPEC)
    other.recall(judge.memory())
    assert other.lost_for(False, 11.0) == judge.lost_for(False, 11.0) > LOST_S


def test_for_how_long_the_owner_is_not_reached_begins_anew_with_each_time_and_each_owner() -> None:
    judge, other = Judge(spec=SPEC), Judge(spec=SPEC)
    assert [judge.lost_for(is_reached, now) for is_reached, now in ((True, 0.0), (False, 1.0), (False, 2.5))] == [
        0,
        0,
        1.5,
    ]
    other.recall(judge.memory())
    assert other.lost_for(False, 3.0) == 2.0
    assert [judge.lost_for(is_reached, now) for is_reached, now in ((True, 3.0), (False, 4.0))] == [0, 0]
    judge.reset()
    assert judge.lost_for(False, 5.0) == 1.0
    judge.reset(is_new_owner=True)
    assert judge.lost_for(False, 6.0) == 0.0


# --- escape --------------------------------------------------------------------------------------------------------


def test_an_escape_costs_nothing_and_excludes_the_owner() -> None:
    judgement = judged(Judge(spec=SPEC), {"edge1": 0.9, "edge2": 0.1, "edge3": 0.2}, 0.0, escape="edge1 is gone")

    assert (judgement.outcome, judgement.candidate, judgement.is_escape) == (Outcome.PROPOSE, "edge3", True)
    assert judgement.reason == "edge1 is gone"
    assert judgement.aggregates == {"edge2": 0.1, "edge3": 0.2}


def test_an_escape_without_anywhere_to_go_proposes_nothing() -> None:
    judgement = judged(Judge(spec=SPEC), {"edge1": 0.9}, 0.0, escape="edge1 is gone")

    assert (judgement.outcome, judgement.candidate, judgement.is_escape) == (Outcome.NONE, "edge1", False)


# --- called votes --------------------------------------------------------------------------------------------------


def test_a_called_vote_is_answered_with_today_s_winner_whatever_a_move_costs() -> None:
    judgement = judged(Judge(spec=SPEC), BETTER, 0.0, called=True)

    assert (judgement.outcome, judgement.candidate, judgement.is_escape) == (Outcome.PROPOSE, "edge2", False)
    assert judgement.reason.startswith("vote called")


def test_a_called_vote_is_answered_with_the_owner_when_nobody_beats_its_bonus() -> None:
    judgement = judged(Judge(spec=SPEC), {"edge1": 0.5, "edge2": 0.59}, 0.0, called=True)

    assert (judgement.outcome, judgement.candidate) == (Outcome.STAY, "edge1")
    assert judgement.aggregate == pytest.approx(0.6)


# --- first placement -----------------------------------------------------------------------------------------------


def test_first_placement_takes_the_best_at_once_when_all_are_there() -> None:
    everybody = {"edge1": 0.2, "edge2": 0.7, "edge3": 0.6}
    judgement = judged(Judge(spec=SPEC), everybody, 0.0, agreed=allocation(None))

    assert (judgement.outcome, judgement.candidate) == (Outcome.PROPOSE, "edge2")
    assert judgement.aggregates == everybody, "nobody has a bonus yet"
    assert not judgement.is_escape


def test_first_placement_waits_a_little_for_those_that_are_still_starting() -> None:
    judge = Judge(spec=SPEC)

    assert judged(judge, {}, 0.0, agreed=allocation(None)).outcome is Outcome.NONE
    waiting = judged(judge, BETTER, 5.0, agreed=allocation(None))
    assert (waiting.outcome, waiting.candidate) == (Outcome.WAIT, None)
    assert "edge3" in waiting.reason
    assert judged(judge, BETTER, 5.0 + INITIAL_SETTLE_S - 0.1, agreed=allocation(None)).outcome is Outcome.WAIT
    late = judged(judge, BETTER, 5.0 + INITIAL_SETTLE_S, agreed=allocation(None))
    assert (late.outcome, late.candidate) == (Outcome.PROPOSE, "edge2")


# --- the operator --------------------------------------------------------------------------------------------------


ADA = Asked(by="ada@robot1", reason="new battery")
PAUSE = Pause(asked=ADA, revision=5)


def pinned_to(node: str, *, owner: str | None = "edge1", is_hard: bool = False, is_paused: bool = False) -> Allocation:
    pin = Pin(node=node, asked=ADA, revision=5, is_hard=is_hard)
    pause = PAUSE if is_paused else None
    return allocation_of(5, owner, tuning=TUNING, pinned=True, pin=pin, paused=is_paused, pause=pause)


@pytest.mark.parametrize("escape", [None, "edge1 is gone"])
@pytest.mark.parametrize("called", [True, False])
def test_a_paused_task_stays_whatever_happens(escape: str | None, *, called: bool) -> None:
    agreed = replace(allocation(paused=True), pause=PAUSE)
    judgement = judged(Judge(spec=SPEC), BETTER, 0.0, escape=escape, called=called, agreed=agreed)

    assert (judgement.outcome, judgement.candidate, judgement.is_escape) == (Outcome.STAY, "edge1", False)
    assert judgement.reason == "paused by ada@robot1 (new battery)"
    held = judged(Judge(spec=SPEC), BETTER, 0.0, escape=escape, agreed=pinned_to("edge2", is_paused=True))
    assert held.outcome is Outcome.STAY, "a pause comes before a pin"


@pytest.mark.parametrize("called", [True, False])
@pytest.mark.parametrize("agreed", [pinned_to("edge1"), allocation(pinned=True)])
def test_a_pinned_task_does_not_move_of_its_own_will_but_it_escapes(agreed: Allocation, *, called: bool) -> None:
    judge = Judge(spec=SPEC)
    stays = [judged(judge, BETTER, float(second), called=called, agreed=agreed) for second in range(60)]
    assert {(judgement.outcome, judgement.candidate) for judgement in stays} == {(Outcome.STAY, "edge1")}
    assert stays[0].reason.startswith("pinned to edge1 by ")
    flees = judged(judge, BETTER, 60.0, escape="edge1 is gone", called=called, agreed=agreed)
    assert (flees.outcome, flees.candidate, flees.is_escape) == (Outcome.PROPOSE, "edge2", True)


@pytest.mark.parametrize("agreed", [pinned_to("edge1"), pinned_to("edge3"), allocation(pinned=True)])
def test_a_pin_holds_no_task_on_a_machine_that_has_never_been_heard(agreed: Allocation) -> None:
    """The site comes back from a loss of power, and its owner does not: nobody ever took that one for gone."""
    judge, others = Judge(spec=SPEC), {"edge2": 0.5}
    found = [judged(judge, others, 0.1 * step, agreed=agreed, is_unheard=True) for step in range(2)]
    assert {one.outcome for one in found} == {Outcome.WAIT}
    leaves = judged(judge, others, 0.6, agreed=agreed, is_unheard=True)
    assert (leaves.outcome, leaves.candidate) == (Outcome.PROPOSE, "edge2")
    judge = Judge(spec=SPEC)
    stays = {judged(judge, others, float(second), agreed=agreed).outcome for second in range(60)}
    assert stays == {Outcome.STAY}, "it is heard, and has only no figures now"


def test_a_task_that_is_pinned_hard_waits_for_a_machine_that_has_never_been_heard() -> None:
    agreed = pinned_to("edge1", is_hard=True)
    judge = Judge(spec=SPEC)
    found = {
        judged(judge, {"edge2": 0.5}, float(second), agreed=agreed, is_unheard=True).outcome for second in range(9)
    }
    assert found == {Outcome.NONE}


def test_the_pinned_node_gets_the_task_back_once_it_has_been_fit_for_a_time() -> None:
    judge, agreed = Judge(spec=SPEC), pinned_to("edge2")
    away = judged(judge, {"edge1": 0.5, "edge3": 0.9}, 0.0, agreed=agreed)
    assert (away.outcome, away.reason) == (
        Outcome.STAY,
        "pinned to edge2 by ada@robot1 (new battery), which cannot have it now",
    )
    worse = {"edge1": 0.9, "edge2": 0.1, "edge3": 1.0}
    assert judged(judge, worse, 10.0, agreed=agreed).outcome is Outcome.WAIT
    waiting = judged(judge, worse, 10.0 + FIT_S - 0.1, agreed=agreed)
    assert (waiting.outcome, waiting.candidate) == (Outcome.WAIT, "edge1")
    assert judged(judge, {"edge1": 0.5}, 10.0 + FIT_S, agreed=agreed).outcome is Outcome.STAY, "not fit"
    assert judged(judge, worse, 11.0 + FIT_S, agreed=agreed).outcome is Outcome.WAIT, "counted anew"
    back = judged(judge, worse, 11.0 + 2 * FIT_S, agreed=agreed)
    assert (back.outcome, back.candidate, back.is_escape) == (Outcome.PROPOSE, "edge2", False)
    again = Judge(spec=SPEC)
    again.recall(judge.memory())
    assert judged(again, worse, 11.0 + 2 * FIT_S, agreed=agreed) == back


def test_a_vote_that_is_called_sends_a_pinned_task_home_and_nowhere_else() -> None:
    assert judged(Judge(spec=SPEC), BETTER, 0.0, called=True, agreed=pinned_to("edge2")).candidate == "edge2"
    away = judged(Judge(spec=SPEC), BETTER, 0.0, called=True, agreed=pinned_to("edge3"))
    assert (away.outcome, away.candidate) == (Outcome.STAY, "edge1")


def test_an_escape_prefers_the_node_that_the_task_is_pinned_to() -> None:
    three = {"edge1": 0.5, "edge2": 0.1, "edge3": 0.9}
    home = judged(Judge(spec=SPEC), three, 0.0, escape="edge1 is gone", agreed=pinned_to("edge2"))
    assert (home.outcome, home.candidate, home.is_escape) == (Outcome.PROPOSE, "edge2", True)


@pytest.mark.parametrize("escape", [None, "edge1 is gone"])
@pytest.mark.parametrize("owner", ["edge1", "edge3", None])
@pytest.mark.parametrize("called", [True, False])
def test_a_hard_pin_never_brings_another_owner(owner: str | None, escape: str | None, *, called: bool) -> None:
    escape = escape if owner == "edge1" else None
    for home, fit in (("edge1", {"edge2": 0.9, "edge3": 0.5}), ("edge2", {"edge1": 0.5, "edge3": 0.5})):
        judge, agreed = Judge(spec=SPEC), pinned_to(home, owner=owner, is_hard=True)
        for second in range(60):
            judgement = judged(judge, fit, float(second), escape=escape, called=called, agreed=agreed)
            assert judgement.candidate in (home, owner), judgement
    nobody = judged(Judge(spec=SPEC), {"edge3": 0.5}, 0.0, agreed=pinned_to("edge2", owner=None, is_hard=True))
    assert nobody.reason == "edge2 cannot have it, and it is pinned there (hard)"


def test_a_pinned_task_without_an_owner_goes_to_its_node_at_once() -> None:
    fit = {"edge1": 0.1, "edge2": 0.9}
    home = judged(Judge(spec=SPEC), fit, 0.0, agreed=pinned_to("edge1", owner=None))
    assert (home.outcome, home.candidate) == (Outcome.PROPOSE, "edge1")
    other = judged(Judge(spec=SPEC), {"edge2": 0.9}, 0.0, agreed=pinned_to("edge1", owner=None))
    assert (other.outcome, other.candidate) == (Outcome.WAIT, None)


@pytest.mark.parametrize("spread", [0.3, 0.6, 1.0])
def test_an_owner_that_cannot_be_scored_is_left_also_for_a_machine_that_the_file_avoids(spread: float) -> None:
    judge, vetoed = Judge(spec=SPEC), {"edge1": Veto(Filter.LIMIT, "battery is at 3 %, limit 20 %")}
    for tick in range(10):
        told = judge.judge(
            standing({"edge2": 0.6}, vetoed),
            allocation(),
            escape=None,
            is_called=False,
            now=tick * 0.5,
            head_starts={"edge2": -spread},
        )
    assert (told.outcome, told.candidate) == (Outcome.PROPOSE, "edge2")


# --- escape_reason -------------------------------------------------------------------------------------------------


def profile(
    *, state: WorkerState | None = WorkerState.READY, memory: float | None = 1000.0, draining: bool = False
) -> Profile:
    return profile_of(
        sequence=0,
        cpu_used_cores=4.0,
        memory_used_mb=memory,
        workers=() if state is None else (load_of(state=state),),
        draining=draining,
    )


def reason(
    seen: Profile | None = None,
    *,
    state: PeerState = PeerState.ALIVE,
    vetoed: Mapping[str, Veto] | None = None,
    not_ready: float = 0.0,
    spec: TaskSpec = SPEC,
    owner: str | None = "edge1",
) -> str | None:
    veto = escape_reason(spec, allocation(owner), state, seen, standing({}, vetoed), not_ready)
    return None if veto is None else veto.why


DEADLINE_S = SPEC.worker.start_deadline_s


@pytest.mark.parametrize("is_away", [False, True])
def test_by_another_start_up_time_former_absences_do_not_count(*, is_away: bool) -> None:
    """Two starts of 100 s, of 120 s that it had, made the next one an escape at once when the document gave it 20 s."""
    judge = Judge(spec=replace(SPEC, worker=replace(SPEC.worker, start_deadline_s=120.0)))
    for begins in (0.0, 200.0):
        judge.not_ready_for(profile(state=WorkerState.STARTING), begins)
        if begins == 0.0 or not is_away:
            judge.not_ready_for(profile(), begins + 100.0)
    former_s = judge.not_ready_for(profile(state=WorkerState.STARTING), 300.0)
    judge.by(replace(judge.spec, price_s=3.0))
    assert judge.not_ready_for(profile(state=WorkerState.STARTING), 301.0) == former_s + 1.0
    judge.by(SPEC)
    assert (judge.spec, judge.held_s) == (SPEC, 0.0)
    assert judge.not_ready_for(profile(state=WorkerState.STARTING), 302.0) == (102.0 if is_away else 2.0)


FOREIGN = task_of(candidates=SPEC.candidates, tuning=TUNING)


def test_a_healthy_owner_is_not_left_however_busy() -> None:
    assert reason(profile()) is None
    assert reason(None) is None, "a lost profile is no proof"
    assert reason(profile(), owner=None) is None


def test_an_owner_that_is_not_ready_is_only_said_to_be_left_when_somebody_else_can_have_the_task() -> None:
    starting = profile(state=WorkerState.STARTING)
    left = escape_ahead(SPEC, allocation(), starting, DEADLINE_S - 4.0, has_other=True)
    assert left == "edge1 will be left in 4 s, for its worker is starting"
    stays = escape_ahead(SPEC, allocation(), starting, DEADLINE_S - 4.0, has_other=False)
    assert stays == "the worker on edge1 is starting; nobody else can have the task"


def test_of_an_owner_without_a_profile_or_a_word_of_its_foreign_worker_nothing_is_foretold() -> None:
    assert not escape_ahead(SPEC, allocation(), None, 0.0, has_other=True)
    assert not escape_ahead(FOREIGN, allocation(), profile(state=None), 0.0, has_other=True)
    assert escape_ahead(SPEC, allocation(), profile(state=None), 0.0, has_other=True), "our own worker is not there"


def test_a_gone_or_silent_owner_is_left() -> None:
    assert reason(profile(), state=PeerState.GONE) == "edge1 is gone"
    assert reason(None, state=PeerState.SUSPECT) == "edge1 is silent"


def test_a_draining_owner_or_one_whose_worker_failed_is_left() -> None:
    assert reason(profile(draining=True)) == "edge1 is draining"
    assert reason(profile(state=WorkerState.FAILED)) == "the worker on edge1 failed"


def test_an_owner_that_is_no_candidate_any_more_is_left() -> None:
    fewer = task_of(candidates=("edge2", "edge3"), tuning=TUNING)

    assert reason(profile(), spec=fewer) == "edge1 is no candidate any more"


@pytest.mark.parametrize("state", [WorkerState.STARTING, WorkerState.STOPPED, None])
def test_not_ready_is_an_escape_only_after_the_start_up_deadline(state: WorkerState | None) -> None:
    assert reason(profile(state=state), not_ready=DEADLINE_S) is None
    assert (
        reason(profile(state=state), not_ready=DEADLINE_S + 0.5) == "the worker on edge1 has not been ready for 20.5 s"
    )


def test_a_foreign_worker_that_is_not_there_is_an_escape_after_the_same_deadline() -> None:
    away = profile(state=WorkerState.STOPPED)
    told = replace(away, workers=(replace(away.workers[0], reason="nobody subscribes to a/key"),))
    assert reason(told, not_ready=DEADLINE_S, spec=FOREIGN) is None
    assert (
        reason(told, not_ready=DEADLINE_S + 0.5, spec=FOREIGN)
        == "the worker on edge1 has not been ready for 20.5 s: nobody subscribes to a/key"
    )
    assert reason(profile(state=None), not_ready=DEADLINE_S + 100.0, spec=FOREIGN) is None, "its daemon does not know"


def test_an_owner_that_too_few_robots_reach_is_left_one_that_is_not_scored_is_not() -> None:
    few = Veto(Filter.REACH, "reached by 1 of 3 robots")
    assert reason(profile(), vetoed={"edge1": few}) == "edge1 is reached by 1 of 3 robots"
    assert reason(profile(), vetoed={"edge1": Veto(Filter.PROFILE, "no fresh profile")}) is None
    assert reason(profile(), vetoed={"edge2": few}) is None


# --- what a machine owes ---------------------------------------------------------------------------------------------


def moved_after(spec: TaskSpec, *aggregates: Mapping[str, float]) -> float:
    """Seconds of a judgement every half second, by these figures in turns, until the first proposal; or inf."""
    judge = Judge(spec=spec)
    for tick in range(120):
        if judged(judge, aggregates[tick % len(aggregates)], 100.0 + tick / 2).outcome is Outcome.PROPOSE:
            return tick / 2
    return math.inf


DEAR = replace(SPEC, price_s=0.5)
ALONE: Mapping[str, float] = {"edge2": 0.1}
"""The owner cannot be scored."""


@pytest.mark.parametrize(("challenger", "after_s"), [(0.64, 11.0), (0.7, 3.5), (0.8, 1.0), (1.0, 0.0), (0.6, math.inf)])
def test_a_task_moves_once_staying_has_cost_a_move(challenger: float, after_s: float) -> None:
    """The owner has 0.5 and a bonus of 0.1: the lead beyond, times the seconds that were and 1.5, must be 0.5 s."""
    assert after_s <= moved_after(DEAR, {"edge1": 0.5, "edge2": challenger + 1e-6}) <= after_s + 0.5, "half of it fades"


def test_challengers_that_take_turns_do_not_save_the_owner() -> None:
    turns = {"edge1": 0.5, "edge2": 0.7, "edge3": 0.6}, {"edge1": 0.5, "edge2": 0.6, "edge3": 0.7}
    assert moved_after(DEAR, *turns) <= 7.5


def test_what_a_lead_has_cost_is_made_up_for_while_nobody_leads() -> None:
    """A lead of 0.1 for half a second, then as long a time with the owner 0.1 ahead."""
    assert moved_after(DEAR, {"edge1": 0.5, "edge2": 0.7}, EQUAL) == math.inf


@pytest.mark.parametrize("price_s", [0.0, 0.5, 3.0])
def test_an_owner_that_cannot_be_scored_loses_all_of_its_time(price_s: float) -> None:
    """Its rival loses 0.9 of it."""
    priced = replace(SPEC, price_s=price_s)
    assert 10.0 * price_s <= moved_after(priced, ALONE) <= 11.0 * price_s


def test_a_move_that_was_wrong_is_taken_back_once_it_has_cost_a_move_as_well() -> None:
    """The account of the machine that was left ends at a price above the least: it is no outcast."""
    judge = Judge(spec=DEAR)
    for number in range(200):
        judged(judge, {"edge1": 0.1, "edge2": 0.9}, number / 2)
    back = allocation_of(6, "edge2", tuning=TUNING)
    outcomes = [judged(judge, {"edge1": 0.9, "edge2": 0.1}, 100.0 + tick / 2, agreed=back).outcome for tick in range(3)]
    assert outcomes[0] is Outcome.PROPOSE, "a lead of 0.7 is expected to cost 1.05 s, which is more than both prices"


def test_a_vote_that_was_lost_forgives_what_was_owed_and_a_gap_in_the_judgements_costs_little() -> None:
    judge, slight = Judge(spec=DEAR), {"edge1": 0.5, "edge2": 0.7}
    for tick in range(9):
        last = judged(judge, slight, 100.0 + tick / 2)
    assert last.outcome is Outcome.PROPOSE
    judge.forgive()
    assert judged(judge, slight, 104.5).outcome is Outcome.WAIT
    slighter = {"edge1": 0.5, "edge2": 0.62}
    judge = Judge(spec=DEAR)
    assert judged(judge, slighter, 100.0).outcome is Outcome.WAIT
    assert judged(judge, slighter, 900.0).outcome is Outcome.WAIT, "nobody looked for so long"


# --- an operator's drain ---------------------------------------------------------------------------------------------

DRAIN = "drained by ada@robot1 (new fan)"
WORSE = {"edge1": 0.9, "edge2": 0.2}


@pytest.mark.parametrize("agreed", [allocation(), pinned_to("edge1"), pinned_to("edge3")])
def test_a_drained_owner_is_left_for_a_worse_one_at_once_and_planned(agreed: Allocation) -> None:
    """Neither bonus, price, cap nor pin holds it."""
    fuse = Fuse()
    for number in range(10):
        fuse.note_move(is_escape=False, now=99.0 + number / 10)
    left = judged(Judge(spec=SPEC), WORSE, 100.0, agreed=agreed, drained=DRAIN, fuse=fuse)
    assert (left.outcome, left.candidate, left.is_escape) == (Outcome.PROPOSE, "edge2", False)
    assert left.reason == f"edge1 is {DRAIN}"


def test_a_drained_owner_goes_to_the_node_that_the_task_is_pinned_to() -> None:
    three = {"edge1": 0.9, "edge2": 0.2, "edge3": 0.5}
    assert judged(Judge(spec=SPEC), three, 0.0, drained=DRAIN, agreed=pinned_to("edge2")).candidate == "edge2"
    assert judged(Judge(spec=SPEC), three, 0.0, drained=DRAIN).candidate == "edge3"
    bound = judged(Judge(spec=SPEC), three, 0.0, drained=DRAIN, agreed=pinned_to("edge2", is_hard=True))
    assert bound.candidate == "edge2"


@pytest.mark.parametrize(
    ("aggregates", "agreed", "why"),
    [
        ({"edge1": 0.5}, allocation(), "no other candidate can have it"),
        (BETTER, pinned_to("edge1", is_hard=True), "it is pinned there (hard)"),
        (BETTER, pinned_to("edge3", is_hard=True), "edge3 cannot have it, and it is pinned there (hard)"),
    ],
)
def test_a_drained_owner_keeps_what_nobody_else_may_have(
    aggregates: Mapping[str, float], agreed: Allocation, why: str
) -> None:
    kept = judged(Judge(spec=SPEC), aggregates, 0.0, drained=DRAIN, agreed=agreed)
    assert (kept.outcome, kept.candidate) == (Outcome.NONE, "edge1")
    assert kept.reason == f"edge1 is {DRAIN}; it keeps the task, for {why}"


def test_a_paused_task_is_not_moved_by_a_drain() -> None:
    agreed = replace(allocation(paused=True), pause=Pause(asked=ADA, revision=5))
    held = judged(Judge(spec=SPEC), BETTER, 0.0, drained=DRAIN, agreed=agreed)
    assert (held.outcome, held.candidate) == (Outcome.STAY, "edge1")


def test_an_escape_from_a_drained_owner_stays_an_escape() -> None:
    left = judged(Judge(spec=SPEC), WORSE, 0.0, drained=DRAIN, escape="edge1 is gone")
    assert (left.outcome, left.candidate, left.is_escape, left.reason) == (
        Outcome.PROPOSE,
        "edge2",
        True,
        "edge1 is gone",
    )


def test_a_drain_is_not_held_against_its_machine() -> None:
    judge = Judge(spec=SPEC)
    for number in range(20):
        judged(judge, EQUAL, float(number), drained=DRAIN)
    assert judged(judge, EQUAL, 20.0).outcome is Outcome.STAY
