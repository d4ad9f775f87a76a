"""The parcel's key and numbers, what a taker has had, and circles."""

from __future__ import annotations

import pytest
import zenoh

from zsched.tasks.crossing.parcels import ANY_TAKER, MAX_LIVES, Had, Parcel, given_key, has_been_in, parts_of


def parameters(number: int, life: str = "a1") -> str:
    selector = Parcel(name="robot1/map", life=life, number=number).selector("edge1/take", "hall-a")
    return selector.partition("?")[2]


def test_a_parcel_asks_one_taker_or_all_of_them_and_no_wildcard_of_an_application_matches() -> None:
    served = given_key("edge1/from_hall_a", "hall-a", "**")
    for taker in ("edge1/from_hall_a", ANY_TAKER):
        key = Parcel(name="robot1/map", life="a1", number=1).selector(taker, "hall-a").partition("?")[0]
        assert zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(served))
        assert parts_of(key)[1] == "hall-a/robot1/map"
        assert not zenoh.KeyExpr("**").intersects(zenoh.KeyExpr(key))
        assert not zenoh.KeyExpr(served).intersects(zenoh.KeyExpr(key.replace("hall-a", "hall-c")))


def test_what_comes_again_has_been_had_and_the_next_has_not() -> None:
    had = Had()
    assert not had.has(parameters(1))
    had.note(parameters(1))
    had.note(parameters(2))
    assert [had.has(parameters(number)) for number in (1, 2, 3)] == [True, True, False]
    assert not had.has(parameters(1, life="b2"))  # another giver, or its next life


@pytest.mark.parametrize("garbage", ["", "life=a1", "life=a1;number=", "life=a1;number=-1", "number=one", ";;=;"])
def test_without_a_number_nothing_has_been_had(garbage: str) -> None:
    had = Had()
    had.note(garbage)
    assert not had.has(garbage)


def test_the_newest_lives_are_remembered() -> None:
    had = Had()
    for life in range(MAX_LIVES + 1):
        had.note(parameters(1, life=str(life)))
    assert [had.has(parameters(1, life=str(life))) for life in (0, 1, MAX_LIVES)] == [False, True, True]


@pytest.mark.parametrize(
    ("name", "has_been"),
    [
        ("robot1/map", False),
        ("robot1/hall-b/robot7/map", True),
        ("robot1/hall-c/robot2/hall-b/robot7/map", True),
        ("robot1/hall-bb/map", False),
    ],
)
def test_a_stream_that_has_come_through_a_cell_is_known_by_its_key(name: str, has_been: bool) -> None:
    assert has_been_in(name, "hall-b") is has_been
