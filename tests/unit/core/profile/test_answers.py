"""What a robot tells of the answers of a worker that tells nothing itself."""

from __future__ import annotations

import pytest

from zsched.core.profile.answers import MAX_STALE_S, STALE_GAPS, Answers
from zsched.core.profile.means import STALE_S
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import MAX_JOB_S, MAX_JOBS_HZ, AnswerTime

OWNERS = {"merge": "edge1"}
NEAR: dict[str, float] = {}


def out(answer_s: float | None, paired_hz: float | None, stream: str = "merge/out/0") -> StreamCount:
    return StreamCount(stream=stream, answer_s=answer_s, paired_hz=paired_hz)


def told(*counts: StreamCount, away_s: dict[str, float] = NEAR) -> tuple[AnswerTime, ...]:
    answers = begun()
    answers.absorb(OWNERS, counts, away_s, 100.0)
    return answers.told(100.0)


def begun(at: float = 99.0) -> Answers:
    """Its first count may still tell of an owner before, and counts nothing."""
    answers = Answers()
    answers.absorb(OWNERS, (out(77.0, 77.0),), NEAR, at)
    assert answers.told(at) == ()
    return answers


def test_an_answer_with_its_input_s_timestamp_is_told_without_the_robot_s_way() -> None:
    assert told(out(0.15, 5.0)) == (AnswerTime(task="merge", owner="edge1", age_s=0.15, count=5.0),)
    (far,) = told(out(0.15, 5.0), away_s={"edge1": 0.05, "edge2": 9.0})
    assert far.age_s == pytest.approx(0.1)
    assert told(out(0.15, 5.0), away_s={"edge1": 0.2})[0].age_s == 0.0, "a way is measured with some error"


def test_without_one_nothing_is_told() -> None:
    assert told() == told(out(None, None)) == told(out(0.15, None)) == ()
    assert told(out(0.15, 5.0, "other/out/0"), out(0.15, 5.0, "merge/in/0")) == ()


def test_a_job_with_several_outputs_ends_with_the_last_one() -> None:
    (one,) = told(out(0.1, 5.0), out(0.3, 4.0, "merge/out/1"), out(0.9, None, "merge/out/2"))
    assert (one.age_s, one.count) == (0.3, 5.0)


def test_figures_beyond_all_bounds_are_told_as_the_bounds() -> None:
    (one,) = told(out(1e9, 1e9))
    assert (one.age_s, one.count) == (MAX_JOB_S, MAX_JOBS_HZ)


def test_what_no_relay_counts_is_no_answer() -> None:
    """An application counts its own streams, and may count nonsense."""
    assert told(out(0.1, -1.0)) == ()
    assert told(out(-0.1, 1.0))[0].age_s == 0.0


def test_it_is_smoothed_and_ends_when_answers_cease() -> None:
    answers = begun()
    answers.absorb(OWNERS, (out(0.1, 5.0),), NEAR, 100.0)
    answers.absorb(OWNERS, (out(0.3, 5.0),), NEAR, 101.0)
    (one,) = answers.told(101.0)
    assert 0.1 < one.age_s < 0.3
    assert one.count == 10.0
    for at in (102.0, 101.0 + STALE_S):
        answers.absorb(OWNERS, (out(None, None),), NEAR, at)
        assert answers.told(at) == (one,)
    assert answers.told(101.1 + STALE_S) == ()
    answers.absorb(OWNERS, (out(0.7, 1.0),), NEAR, 120.0)
    (later,) = answers.told(120.0)
    assert later.age_s == 0.7, "what was before the break is another time"
    assert later.count > one.count, "a sum goes on"


@pytest.mark.parametrize("apart_s", [1, 4, 12])
def test_rare_answers_are_awaited_for_as_long_as_they_are_rare(apart_s: int) -> None:
    answers = begun(0.0)
    for at in range(1, 10 * apart_s + 1):
        answers.absorb(OWNERS, (out(2.0, 1.0) if at % apart_s == 0 else out(None, None),), NEAR, float(at))
        assert (at < apart_s) is (answers.told(at) == ())
    (one,) = answers.told(10 * apart_s)
    assert (one.age_s, one.count) == (2.0, 10.0)
    last = 10 * apart_s + max(STALE_S, STALE_GAPS * apart_s)
    assert answers.told(last) == (one,)
    assert answers.told(last + 0.1) == ()


def test_no_age_is_told_for_more_than_a_minute() -> None:
    answers = begun(0.0)
    answers.absorb(OWNERS, (out(2.0, 1.0),), NEAR, 300.0)
    assert answers.told(300.0 + MAX_STALE_S)
    assert answers.told(300.1 + MAX_STALE_S) == ()


def test_another_owner_s_answers_begin_anew_and_what_does_not_count_is_forgotten() -> None:
    answers = begun()
    answers.absorb(OWNERS, (out(0.1, 5.0),), NEAR, 100.0)
    answers.absorb({"merge": "edge2"}, (out(0.1, 5.0),), NEAR, 101.0)
    assert answers.told(101.0) == (), "the first count may be of the owner before"
    answers.absorb({"merge": "edge2"}, (out(0.5, 3.0),), NEAR, 102.0)
    assert answers.told(102.0) == (AnswerTime(task="merge", owner="edge2", age_s=0.5, count=3.0),)
    answers.absorb({}, (out(0.5, 5.0),), NEAR, 103.0)
    assert answers.told(103.0) == ()
