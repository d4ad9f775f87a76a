"""An explanation's sums: made again here from its own terms; and what it says a move would take, tried out."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from support.allocations import allocation_of
from support.decisions import figures_of
from support.fleets import task_of, tuning_of
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.scheduler.explain import (
    Explained,
    explained,
    judged_again,
    seen_by,
    without,
)
from zsched.core.scheduler.ledger import AHEAD_S
from zsched.core.scheduler.standing import RESOLUTION, pick
from zsched.core.values.decision import Decision, FuseMemory, JudgeMemory, KeptMemory, Need
from zsched.core.values.model import (
    Allocation,
    Asked,
    Pin,
    ScoreForm,
    Tuning,
    Utility,
    UtilityVector,
)

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")
TUNING = replace(tuning_of(cpu=0.5, memory=0.3, network=0.2, bonus=0.05), score=ScoreForm.SERVICE)
TERMS = {"edge1": (0.9, 0.8, 0.7), "edge2": (0.95, 0.9, 0.5), "edge3": (0.4, 0.9, 0.9)}


def value_of(terms: tuple[float, float, float], tuning: Tuning) -> float:
    """By hand, as `service_utility` and Eq. 4 have it."""
    weights = (tuning.weights.cpu, tuning.weights.memory, tuning.weights.network)
    if tuning.score is ScoreForm.PAPER:
        return sum(weight * term for weight, term in zip(weights, terms, strict=True)) / sum(weights)
    most = max(weights)
    powers = [math.pow(term, weight / most) for weight, term in zip(weights, terms, strict=True) if weight]
    return math.prod(powers)


def decision_of(tuning: Tuning = TUNING, *, owner: str | None = "edge1", **changes: object) -> Decision:
    """Three robots that see the edges a little differently."""
    vectors = []
    for number, robot in enumerate(ROBOTS):
        column = []
        for name, terms in TERMS.items():
            cpu, memory, network = (round(term - 0.03 * number, 6) for term in terms)
            value = value_of((cpu, memory, network), tuning)
            column.append(Utility(candidate=name, value=value, cpu=cpu, memory=memory, network=network))
        vectors.append(UtilityVector(voter=robot, task="merge", revision=4, utilities=tuple(column)))
    given = {
        "allocation": allocation_of(4, owner, 3, tuning=tuning),
        "vectors": tuple(vectors),
    }
    figures = figures_of(task_of(candidates=EDGES, price_s=0.15), *ROBOTS, **{**given, **changes})
    needs = (Need(candidate="edge1", cpu_cores=0.4, memory_mb=250.0),)
    return Decision(figures=figures, verdict=verdict_of(decide_again(figures).judgement), needs=needs)


def decision_worth(worth: Mapping[str, float], *, bonus: float = 0.0) -> Decision:
    """Three robots that agree on what each edge is worth; edge1 owns the task."""
    decision = decision_of(replace(TUNING, bonus=bonus))
    vectors = tuple(
        replace(
            vector,
            utilities=tuple(replace(one, value=worth[one.candidate]) for one in vector.utilities),
        )
        for vector in decision.figures.vectors
    )
    return judged_again(decision, replace(decision.figures, vectors=vectors, judge=JudgeMemory()))


def check_sums(told: Explained, decision: Decision) -> None:
    """Every number from the ones before it, and the total as the judgement had it."""
    tuning = told.tuning
    for one in told.candidates:
        seen = []
        for view in one.robots:
            if view.utility is None:
                continue
            seen.append(view.utility)
            if view.reachable:
                assert None not in (view.cpu, view.memory, view.network)
                terms = (view.cpu or 0.0, view.memory or 0.0, view.network or 0.0)
                assert view.utility == pytest.approx(value_of(terms, tuning), abs=1e-12)
        if one.joint is not None:
            assert one.joint == statistics.fmean(seen)
        if one.total is not None:
            assert one.joint is not None
            assert one.total == one.joint - one.unkept + one.bonus
    assert {one.node: one.total for one in told.candidates if one.total is not None} == dict(
        decision.verdict.aggregates
    )


@pytest.mark.parametrize("score", list(ScoreForm))
@pytest.mark.parametrize("owner", [None, *EDGES])
def test_the_numbers_add_up(score: ScoreForm, owner: str | None) -> None:
    tuning = replace(TUNING, score=score)
    promised = {one.node: one.joint or 0.0 for one in explained(decision_of(tuning, owner=owner)).candidates}
    kept = KeptMemory(owner=owner, seen=(("edge3", promised["edge3"], 0.0, 990.0),))
    decision = decision_of(tuning, owner=owner, judge=JudgeMemory(kept=kept))
    told = explained(decision)
    check_sums(told, decision)
    assert [one.node for one in told.candidates if one.is_owner] == ([] if owner is None else [owner])
    totals = {one.node: one.total for one in told.candidates if one.total is not None}
    assert told.candidates[0].node == pick(totals, owner)
    assert [one.unkept > 0.0 for one in sorted(told.candidates, key=lambda one: one.node)] == [
        False,
        False,
        owner != "edge3",
    ]
    assert told.margin is not None


def test_a_silent_robot_and_its_revision_are_told() -> None:
    decision = decision_of()
    late = replace(decision.figures.vectors[1], revision=3)
    few = judged_again(decision, replace(decision.figures, vectors=(decision.figures.vectors[0], late)))
    told = explained(few)
    assert (told.heard, told.silent, told.needed) == (("robot1",), ("robot2", "robot3"), 2)
    assert told.outcome == "none"
    assert told.changes == ("2 robots must tell their utilities, 1 did",)


def test_what_was_not_kept_of_a_promise_that_holds_a_preference_is_told_as_it_was_judged() -> None:
    """edge2 promised 0.9 with what the file adds, and gave 0.6."""
    decision = decision_worth({"edge1": 0.5, "edge2": 0.4, "edge3": 0.3})
    kept = KeptMemory(owner="edge1", seen=(("edge2", 0.9, 0.6, decision.figures.now),))
    figures = replace(decision.figures, head_starts=(("edge2", 0.5),), judge=JudgeMemory(kept=kept))
    again = judged_again(decision, figures)
    (edge2,) = (one for one in explained(again).candidates if one.node == "edge2")
    assert edge2.unkept == pytest.approx(0.3)
    assert edge2.bonus == 0.5
    assert edge2.total == pytest.approx(dict(again.verdict.aggregates)["edge2"])


@pytest.mark.parametrize("seed", range(20))
def test_a_candidate_leads_once_it_has_the_worth_that_it_is_told_to_lack(seed: int) -> None:
    worth = dict(
        zip(EDGES, sorted((Random(seed + k / 3).uniform(0.2, 0.9) for k in range(3)), reverse=True), strict=True)
    )
    told = explained(decision_worth(worth))
    assert told.outcome == "stay"
    lack = float(told.changes[0].removeprefix("edge2 lacks ").split(" ")[0])
    for change, begin in ((2 * RESOLUTION, "edge1 owes"), (-2 * RESOLUTION, "edge2 lacks")):
        again = explained(decision_worth({**worth, "edge2": worth["edge2"] + lack + change}))
        assert again.changes[0].startswith(begin)


def test_a_leader_that_waits_is_told_what_its_lead_has_cost() -> None:
    figures = replace(decision_of(owner="edge3").figures, judge=JudgeMemory(owed=(("edge3", 0.25),), charged_at=1000.0))
    dear = judged_again(decision_of(owner="edge3"), replace(figures, rules=replace(figures.rules, price_s=3.0)))
    told = explained(dear)
    assert told.outcome == "wait"
    first, own = told.candidates[0], next(one for one in told.candidates if one.is_owner)
    assert first.owed_s is not None
    assert own.owed_s is not None
    more_s = own.owed_s - first.owed_s
    assert own.total is not None
    assert first.total is not None
    assert more_s == pytest.approx(0.25 + AHEAD_S * (first.total - own.total))
    assert told.changes[:2] == (
        f"edge3 owes {more_s:.2f} s more than {first.node}, and must go on losing:",
        "until that is the price of a move, 3 s",
    )


@pytest.mark.parametrize(
    ("held_by", "told_of"),
    [
        ({"first": "count"}, "until count has moved"),
        ({"electors_heard": ("robot1",)}, "until 2 of 3 electors are heard (1 are)"),
        (
            {"fuse": FuseMemory(moves=((990.0, False),) * 30)},
            "until fewer than {most} moves lie in the last minute",
        ),
    ],
    ids=["another task", "silent electors", "many moves"],
)
def test_a_leader_is_told_what_else_it_waits_for(held_by: dict[str, Any], told_of: str) -> None:
    decision = decision_of(owner="edge3", **held_by)
    changes = explained(decision).changes
    assert told_of.format(most=decision.figures.rules.max_moves_per_minute) in changes
    free = explained(decision_of(owner="edge3")).changes
    assert not any(text.startswith("until") for text in free)


def test_without_the_owner_the_best_of_the_others_gets_the_task() -> None:
    decision = decision_of()
    again = judged_again(decision, without(decision.figures, "edge1"))
    assert (again.verdict.outcome, again.verdict.candidate, again.verdict.reason) == (
        "propose",
        "edge2",
        "edge1 is gone",
    )
    told = explained(again)
    check_sums(told, again)
    gone = next(one for one in told.candidates if one.node == "edge1")
    assert (gone.total, gone.bonus) == (None, 0.0)
    assert "edge1 is gone" in gone.why_not


def test_without_another_candidate_or_a_robot_the_task_stays() -> None:
    decision = decision_of()
    again = judged_again(decision, without(decision.figures, "edge2"))
    assert (again.verdict.outcome, again.verdict.candidate) == ("stay", "edge1")
    assert next(one for one in explained(again).candidates if one.node == "edge2").why_not == "reached by 0 of 3 robots"
    fewer = without(decision.figures, "robot3")
    assert (fewer.present, fewer.electors_heard) == (("robot1", "robot2"), ("robot1", "robot2"))
    assert [vector.voter for vector in fewer.vectors] == ["robot1", "robot2"]
    assert judged_again(decision, fewer).verdict.outcome == "stay"


def test_an_operator_s_flags_stand_beside_the_sums() -> None:
    decision = decision_of(
        drained="drained by ada", closed=(("edge1", "drained by ada"), ("edge2", "takes nothing new, by ada"))
    )
    told = explained(decision)
    check_sums(told, decision)
    sums = {one.node: one for one in told.candidates}
    assert (told.outcome, told.candidate, told.is_escape) == ("propose", "edge3", False)
    assert (sums["edge1"].total, sums["edge1"].bonus, sums["edge1"].why_not) == (None, 0.0, "edge1 is drained by ada")
    assert (sums["edge2"].total, sums["edge2"].why_not) == (None, "takes nothing new, by ada")
    assert len(sums["edge2"].robots) == len(ROBOTS), "what they are worth is told all the same"
    all_closed = decision_of(drained="drained by ada", closed=tuple((name, "drained by ada") for name in EDGES))
    assert explained(all_closed).changes == (
        "another candidate must be able to have the task",
        "edge2 cannot have it: drained by ada",
        "edge3 cannot have it: drained by ada",
    )


ADA = Asked(by="ada@robot1", reason="new battery")


def held(*, is_hard: bool = False, is_paused: bool = False, is_pinned: bool = True) -> Allocation:
    pin = Pin(node="edge1", asked=ADA, revision=4, is_hard=is_hard) if is_pinned else None
    return allocation_of(4, "edge1", 3, tuning=TUNING, pinned=is_pinned, pin=pin, paused=is_paused)


@pytest.mark.parametrize(
    ("allocation", "is_left", "word"),
    [
        (held(is_pinned=False), False, None),
        (held(is_paused=True, is_pinned=False), False, "paused"),
        (held(is_paused=True, is_pinned=False), True, "paused"),
        (held(is_paused=True), False, "paused"),
        (held(), False, "pinned"),
        (held(), True, None),
        (held(is_hard=True), False, "pinned"),
        (held(is_hard=True), True, "pinned"),
    ],
)
def test_an_order_that_holds_a_task_is_named_and_only_a_hard_pin_holds_one_that_must_leave(
    allocation: Allocation, is_left: bool, word: str | None
) -> None:
    """Too few electors are heard, so that no move is proposed at all."""
    drained = "drained by ada" if is_left else ""
    told = explained(decision_of(allocation=allocation, drained=drained, electors_heard=("robot1",)))
    named = [text for text in told.changes if text.startswith("an operator must end")]
    assert named == ([] if word is None else [f"an operator must end that the task is {word}"])


def test_what_would_take_a_task_to_the_node_it_is_pinned_to_is_told_by_the_pin_alone() -> None:
    """It said that the pin must end, and by how much another must lead, of a task that its pin took home."""
    pin = Pin(node="edge2", asked=ADA, revision=4, is_hard=False)
    agreed = allocation_of(4, "edge1", 3, tuning=TUNING, pinned=True, pin=pin)
    on_its_way = decision_of(allocation=agreed, judge=JudgeMemory(fit_since=999.5))
    assert "fit for 0.5 of" in on_its_way.verdict.reason
    assert explained(on_its_way).changes == (f"what holds it back must end: {on_its_way.verdict.reason}",)
    lost = decision_of(allocation=agreed)
    vectors = tuple(
        replace(
            one,
            utilities=tuple(utility for utility in one.utilities if utility.candidate != "edge2"),
            refused=(("edge2", "draining"),),
        )
        for one in lost.figures.vectors
    )
    told = explained(judged_again(lost, replace(lost.figures, vectors=vectors)))
    assert told.changes[:2] == ("an operator must end that the task is pinned", "or edge2 must be able to have it")
    assert any(text.startswith("edge2 cannot have it: ") for text in told.changes)
    assert not [text for text in told.changes if "leads" in text or "worth" in text]


# --- what one robot sees ---------------------------------------------------------------------------------------------


def test_a_sight_names_who_is_heard_and_who_is_not() -> None:
    """The voters are not the electors here: the one that went may be another than the one that is silent."""
    decision = decision_of(
        present=("robot1", "robot3"), electors=("edge1", "edge2", "robot1"), electors_heard=("edge1", "robot1")
    )
    sight = seen_by(decision, "robot1", "robot3")
    assert (sight.robots, sight.gone) == (("robot1", "robot3"), ("robot2",))
    assert (sight.electors, sight.electors_silent) == (("edge1", "robot1"), ("edge2",))
    assert (sight.best, sight.is_heard, sight.is_own) == ("edge1", True, False)
    assert seen_by(decision, "robot3", "robot3").is_own


def test_a_robot_that_is_not_heard_sees_nobody_as_the_best() -> None:
    decision = decision_of()
    fewer = judged_again(decision, replace(decision.figures, vectors=decision.figures.vectors[:2]))
    sight = seen_by(fewer, "robot3", "robot1")
    assert (sight.best, sight.is_heard) == (None, False)
