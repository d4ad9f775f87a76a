"""What a machine gave counts while it promises the same again."""

from __future__ import annotations

import pytest

from zsched.core.scheduler.kept import LEASELESS_S, RISES_S, SAME_WORTH, Kept

MEMORY_S = 1000.0
HOME = {"edge1": 0.6, "edge2": 0.9}


def look(kept: Kept, worth: dict[str, float], owner: str | None, now: float) -> None:
    kept.look(worth, owner, now)


def worth_of_edge2(kept: Kept, now: float, promised: float = 0.9, owner: str | None = "edge1") -> float:
    return kept.corrected({"edge1": 0.6, "edge2": promised}, owner, MEMORY_S, now)["edge2"]


def gave(*told: tuple[float, float]) -> Kept:
    """The task went from edge1 to edge2 at 1, which was worth so much in (at, worth); at 100 it is back."""
    kept = Kept()
    look(kept, HOME, "edge1", 0.0)
    for at, worth in ((1.0, told[0][1]), *told):
        look(kept, {"edge1": 0.6, "edge2": worth}, "edge2", at)
    look(kept, HOME, "edge1", 100.0)
    return kept


def test_a_machine_that_looks_better_than_it_is_counts_as_what_it_gave() -> None:
    kept = gave((1.5, 0.5))
    assert worth_of_edge2(kept, 1.5) == pytest.approx(0.5)
    assert worth_of_edge2(kept, 1.5 + MEMORY_S) == pytest.approx(0.7), "half of it is forgotten"
    assert worth_of_edge2(kept, 1.5, owner="edge2") == 0.9, "where the task is, what is seen counts"
    assert worth_of_edge2(gave((1.5, 0.95)), 1.5) == 0.9, "who gives more is no better than its word"


def test_another_promise_is_another_chance() -> None:
    kept = gave((1.5, 0.5))
    assert worth_of_edge2(kept, 1.5, 0.79) == 0.79
    assert worth_of_edge2(kept, 1.5, 0.9 + SAME_WORTH + 0.01) == 0.9 + SAME_WORTH + 0.01
    assert worth_of_edge2(kept, 1.5, 0.81) == pytest.approx(0.41), "it lacks as much as before"


def test_the_newest_figure_counts_while_the_use_still_rises_and_then_the_best() -> None:
    assert worth_of_edge2(gave((1.5, 0.9), (1.0 + RISES_S - 0.1, 0.5)), 5.0) == pytest.approx(0.5, abs=0.01)
    settled = gave((1.0 + RISES_S, 0.85), (2.0 + RISES_S, 0.5))
    assert worth_of_edge2(settled, 2.0 + RISES_S) == pytest.approx(0.85, abs=0.01), "a load that came is not its doing"


def test_a_robot_that_has_just_started_holds_nothing_against_an_owner() -> None:
    kept = Kept()
    look(kept, {"edge1": 0.6, "edge2": 0.2}, "edge2", 0.0)
    look(kept, HOME, "edge1", 1.0)
    assert worth_of_edge2(kept, 1.0) == 0.9


def test_each_stay_is_judged_anew() -> None:
    kept = gave((1.5, 0.5))
    look(kept, {"edge1": 0.6, "edge2": 0.88}, "edge2", 101.0)
    assert worth_of_edge2(kept, 101.0) == pytest.approx(0.5), "not by its first moment"
    look(kept, {"edge1": 0.6, "edge2": 0.88}, "edge2", 101.0 + RISES_S)
    assert worth_of_edge2(kept, 101.0 + RISES_S) == pytest.approx(0.88)


def test_one_that_fails_again_soon_gave_half_of_that() -> None:
    kept = gave((1.0 + RISES_S, 0.9))
    for times in (1, 2, 3):
        kept.fail("edge2", 100.0)
        assert worth_of_edge2(kept, 100.0) == pytest.approx(0.9 / 2**times)
        look(kept, {"edge1": 0.6, "edge2": 0.9}, "edge2", 100.5)
        look(kept, HOME, "edge1", 101.0)


def test_an_owner_that_cannot_be_scored_tells_nothing() -> None:
    kept = Kept()
    look(kept, HOME, "edge1", 0.0)
    look(kept, {"edge1": 0.6}, "edge2", 1.0)
    assert worth_of_edge2(kept, 1.0) == 0.9


def test_a_machine_that_failed_counts_as_half_of_what_it_promised_and_again_half() -> None:
    kept = Kept()
    look(kept, HOME, "edge1", 0.0)
    kept.fail("edge2", 0.0)
    assert worth_of_edge2(kept, 0.0) == pytest.approx(0.45)
    kept.fail("edge2", 0.0)
    assert worth_of_edge2(kept, 0.0) == pytest.approx(0.225)
    kept.fail("edge3", 0.0)
    assert "edge3" not in kept.seen, "nobody knows what it promised"


def test_what_a_machine_gives_again_is_kept_anew_however_short_the_stay() -> None:
    """It was tried again and again once the first record had faded: 58 moves in ten minutes."""
    kept = gave((1.0 + RISES_S, 0.5))
    for at in (2000.0, 4000.0, 6000.0):
        assert worth_of_edge2(kept, at) > 0.7, "it has faded"
        look(kept, {"edge1": 0.6, "edge2": 0.5}, "edge2", at)
        look(kept, HOME, "edge1", at + 2.0)
        assert worth_of_edge2(kept, at + 2.0) == pytest.approx(0.5, abs=0.01)


def test_a_machine_without_a_lease_is_not_judged_anew_for_a_minute() -> None:
    kept = gave((1.0 + RISES_S, 0.9))
    kept.fail("edge2", 100.0, LEASELESS_S)
    assert (kept.has_failed("edge2", 159.0), kept.has_failed("edge2", 161.0)) == (True, False)
    for at in (101.0, 150.0):
        look(kept, {"edge1": 0.6, "edge2": 0.9}, "edge2", at)
    assert worth_of_edge2(kept, 150.0) == pytest.approx(0.45)
    for at in (161.0, 170.0):
        look(kept, {"edge1": 0.6, "edge2": 0.9}, "edge2", at)
    assert worth_of_edge2(kept, 170.0) == pytest.approx(0.9)
