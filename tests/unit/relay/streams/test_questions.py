"""Who is asked for what they hold: everybody until they have answered, and then no more."""

from __future__ import annotations

from zsched.relay.streams.questions import (
    BLIND_TRIES,
    EMPTY_TRIES,
    MAX_PAUSE_S,
    MAX_PENDING,
    PAUSE_S,
    SETTLE_S,
    Question,
    Questions,
    publisher_of,
)

ALL = "robot1/*/map/@adv/**"


def token(number: int) -> str:
    return f"robot1/{number}/map/@adv/pub/a1b2/{number}/_"


def questions() -> Questions:
    return Questions("robot1/*/map", 1)


def asked(of: Questions, now: float) -> Question:
    question = of.next(now)
    assert question is not None
    return question


def answer(question: Question, *numbers: int) -> None:
    for number in numbers:
        question.answers[publisher_of(token(number))] += 1


def test_a_token_names_its_publisher() -> None:
    assert publisher_of(token(7)) == ("robot1/7/map", "a1b2", "7")
    assert publisher_of("robot1/map/@adv/pub/a1b2/uhlc/_") == ("robot1/map", "a1b2", "uhlc")
    assert publisher_of("nonsense") == ("nonsense", "", "")


def test_who_has_answered_is_not_asked_again() -> None:
    some = questions()
    some.appeared(token(1), 0.0)
    question = asked(some, 0.0)
    assert question.selector == token(1)
    answer(question, 1)
    some.ended(question, 0.1, is_whole=True)
    assert some.next(99.0) is None
    assert some.next_due_s() is None


def test_an_answer_that_fails_to_come_is_asked_for_while_the_token_lives() -> None:
    some = questions()
    some.appeared(token(1), 0.0)
    now = 0.0
    pauses = []
    for _ in range(12):
        some.ended(asked(some, now), now, is_whole=False)
        assert some.next(now) is None
        due_s = some.next_due_s()
        assert due_s is not None
        pauses.append(due_s - now)
        now = due_s
    assert pauses[:3] == [PAUSE_S, 2 * PAUSE_S, 4 * PAUSE_S]
    assert pauses[-1] == MAX_PAUSE_S
    some.disappeared(token(1))
    assert some.next_due_s() is None


def test_an_empty_answer_is_believed_at_the_third_time() -> None:
    some = questions()
    some.appeared(token(1), 0.0)
    times = 0
    while (question := some.next(100.0 * times)) is not None:
        some.ended(question, 100.0 * times, is_whole=True)
        times += 1
    assert times == EMPTY_TRIES


def test_a_question_for_everything_that_fails_leaves_only_the_silent_ones() -> None:
    some = questions()
    for number in (1, 2):
        some.appeared(token(number), 0.0)
    some.ask_all(0.0)
    question = asked(some, 0.0)
    assert question.selector == ALL
    answer(question, 1)
    some.ended(question, 0.5, is_whole=False)
    assert asked(some, 99.0).selector == token(2)
    assert some.next(99.0) is None


def test_half_of_what_is_wanted_is_no_answer_when_the_question_failed() -> None:
    some = Questions("robot1/*/map", 2)
    some.appeared(token(1), 0.0)
    question = asked(some, 0.0)
    answer(question, 1)
    some.ended(question, 0.5, is_whole=False)
    again = asked(some, 99.0)
    answer(again, 1)
    some.ended(again, 99.0, is_whole=True)
    assert some.next_due_s() is None, "it has no more"


def test_too_many_that_wait_are_one_question() -> None:
    some = questions()
    for number in range(MAX_PENDING + 1):
        some.appeared(token(number), 0.0)
    assert asked(some, 0.0).selector == ALL
    assert some.next(0.0) is None


def test_who_appears_while_everything_is_asked_may_answer_that() -> None:
    some = questions()
    some.ask_all(0.0)
    question = asked(some, 0.0)
    for number in (1, 2):
        some.appeared(token(number), 0.0)
    assert some.next(0.0) is None
    answer(question, 1)
    assert asked(some, SETTLE_S).selector == token(2)
    assert some.next(SETTLE_S) is None


def test_a_failure_that_no_token_explains_repeats_the_question_for_everything() -> None:
    some = questions()
    some.ask_all(0.0)
    times = 0
    while (question := some.next(100.0 * times)) is not None:
        assert question.selector == ALL
        some.ended(question, 100.0 * times, is_whole=False)
        times += 1
    assert times == 1 + BLIND_TRIES
