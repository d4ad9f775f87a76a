from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from support.allocations import allocation_of
from support.fleets import task_of, tuning_of
from zsched.core.scheduler import rounds
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.standing import Standing
from zsched_lab.paper.ruled_daemon import install
from zsched_lab.paper.rules import EVERY_S, RANDOM_PERIOD_S, JudgeMaker, Rule, RuleName, RulePlan, read_plan

TUNING = tuning_of(bonus=0.0)
SPEC = task_of(candidates=("e1", "e2", "e3"), tuning=TUNING, price_s=0.0)
OWNED = allocation_of(owner="e1", tuning=TUNING)
VALUES = {"e1": 0.50, "e2": 0.52, "e3": 0.30}


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.json"
    RulePlan(zero_s=100.0, seed=3, best=((0.0, "e3"), (10.0, "e2"))).save(path)
    return path


def judged(judge: Judge, values: dict[str, float], now: float, *, is_called: bool = False) -> Judgement:
    standing = Standing(aggregates=values, vetoed={}, vectors=(), voters_heard=3)
    return judge.judge(standing, OWNED, escape=None, is_called=is_called, now=now, fuse=Fuse())


def test_undamped_is_the_products_argmax() -> None:
    judgement = judged(JudgeMaker(name=RuleName.UNDAMPED)(spec=SPEC), VALUES, 0.0)

    assert (judgement.outcome, judgement.candidate) == (Outcome.PROPOSE, "e2")


def test_undamped_has_no_bound_on_moves() -> None:
    fuse = Fuse()
    for at in range(20):
        fuse.note_move(is_escape=False, now=float(at))
    standing = Standing(aggregates=VALUES, vetoed={}, vectors=(), voters_heard=3)
    given = {"escape": None, "is_called": False, "now": 20.0, "fuse": fuse}

    assert Judge(spec=SPEC).judge(standing, OWNED, **given).outcome is not Outcome.PROPOSE  # type: ignore[arg-type]  # one dict for both
    assert JudgeMaker(name=RuleName.UNDAMPED)(spec=SPEC).judge(standing, OWNED, **given).outcome is Outcome.PROPOSE


def test_the_literal_cost_drives_the_task_away_from_equals() -> None:
    equal = {"e1": 0.5, "e2": 0.49, "e3": 0.3}

    assert judged(JudgeMaker(name=RuleName.PENALTY)(spec=SPEC), equal, 0.0).candidate == "e2"
    assert judged(JudgeMaker(name=RuleName.UNDAMPED)(spec=SPEC), equal, 0.0).candidate == "e1"


def test_first_match_takes_the_first_whatever_it_is_worth() -> None:
    rule = Rule(name=RuleName.FIRST)

    assert rule.apply({"e2": 0.1, "e3": 0.9}, "e3", 0.0, is_called=False) == {"e2": 1.0, "e3": 0.0}
    assert rule.apply({}, None, 0.0, is_called=False) == {}


def test_the_oracle_follows_its_plan_once_it_is_there(tmp_path: Path, plan: Path) -> None:
    late = tmp_path / "late.json"
    rule = Rule(name=RuleName.ORACLE, plan_path=late)
    assert rule.apply(VALUES, "e1", 101.0, is_called=False) == VALUES

    plan.rename(late)

    assert rule.apply(VALUES, "e1", 101.0, is_called=False) == {"e1": 0.0, "e2": 0.0, "e3": 1.0}
    assert rule.apply(VALUES, "e1", 110.5, is_called=False) == {"e1": 0.0, "e2": 1.0, "e3": 0.0}
    without = {"e1": 0.5, "e3": 0.3}
    # e2 may not have the task now: the owner keeps it, unless it may not either.
    assert rule.apply(without, "e1", 110.5, is_called=False) == {"e1": 1.0, "e3": 0.0}
    assert rule.apply(without, "e2", 110.5, is_called=False) == without


def test_random_is_one_lot_per_window_for_all_robots(plan: Path) -> None:
    robots = [Rule(name=RuleName.RANDOM, plan_path=plan) for _ in range(3)]
    chosen = []
    for window in range(30):
        now = 100.0 + window * RANDOM_PERIOD_S
        picks = [
            max(r.apply(VALUES, "e1", now + i, is_called=False).items(), key=lambda p: p[1])[0]
            for i, r in enumerate(robots)
        ]
        assert len(set(picks)) == 1
        chosen.append(picks[0])
    assert set(chosen) == {"e1", "e2", "e3"}


def test_every_decides_once_in_its_window_but_answers_a_called_vote(plan: Path) -> None:
    judge = JudgeMaker(name=RuleName.EVERY, plan_path=plan)(spec=SPEC)

    assert judged(judge, VALUES, 100.0).candidate == "e2"
    assert judged(judge, VALUES, 101.0).candidate == "e1"
    assert judged(judge, VALUES, 102.0, is_called=True).candidate == "e2"
    assert judged(judge, VALUES, 100.0 + EVERY_S + 0.1).candidate == "e2"


def test_a_plan_is_read_back_and_an_absent_one_is_none(tmp_path: Path, plan: Path) -> None:
    read = read_plan(plan)

    assert read is not None
    assert (read.zero_s, read.seed, read.best_at(3.0), read.best_at(12.0), read.best_at(-1.0)) == (
        100.0,
        3,
        "e3",
        "e2",
        None,
    )
    assert read_plan(tmp_path / "nothing") is None


def test_the_program_puts_the_rule_where_the_product_makes_its_judges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rounds, "Judge", Judge)  # put back at the end
    maker = install(RuleName.PENALTY, None)

    judge = vars(rounds)["Judge"](spec=SPEC)

    assert maker.made == [judge]
    assert (
        judge.judge(
            Standing(aggregates={"e1": 0.5, "e2": 0.49}, vetoed={}, vectors=(), voters_heard=3),
            replace(OWNED),
            escape=None,
            is_called=False,
            now=1.0,
        ).candidate
        == "e2"
    )
