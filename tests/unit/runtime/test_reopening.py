"""In which order the nodes of a secured fleet begin anew, and when each of them does."""

from __future__ import annotations

from zsched.runtime.reopening import FIRST_S, PATIENCE_S, TURN_S, Reopening, turns

ELECTORS = ("edge1", "robot1", "robot2")
NODES = ("edge1", "edge2", "robot1", "robot2")
ORDER = turns(NODES, ELECTORS)


def others(me: str) -> set[str]:
    return set(NODES) - {me}


def test_electors_come_last() -> None:
    assert ORDER == ("edge2", "edge1", "robot1", "robot2")


def test_no_two_have_the_same_turn() -> None:
    due = []
    for name in NODES:
        one = Reopening(name)
        one.want(ORDER, 100.0)
        assert one.due_at is not None
        assert not one.is_due(ELECTORS, others(name), one.due_at - 0.1)
        assert one.is_due(ELECTORS, others(name), one.due_at)
        due.append(one.due_at)
    assert min(due) == 100.0 + FIRST_S
    assert all(after - before >= TURN_S for before, after in zip(sorted(due), sorted(due)[1:], strict=False))


def test_a_turn_that_is_set_stays_until_nothing_is_wanted_any_more() -> None:
    one = Reopening("edge2")
    assert not one.is_due(ELECTORS, others("edge2"), 1e9)
    one.want(ORDER, 100.0)
    one.want(ORDER, 102.0)
    assert one.is_due(ELECTORS, others("edge2"), 103.0)
    one.forget()
    assert not one.is_due(ELECTORS, others("edge2"), 103.0)


def test_an_elector_waits_for_the_others_but_not_for_ever() -> None:
    one = Reopening("edge1")
    one.want(ORDER, 0.0)
    assert one.due_at is not None
    assert not one.is_due(ELECTORS, {"edge2", "robot1"}, one.due_at)
    assert one.is_due(ELECTORS, {"robot1", "robot2"}, one.due_at), "edge2 is no elector"
    assert one.is_due(ELECTORS, {"robot1"}, one.due_at + PATIENCE_S)
    edge = Reopening("edge2")
    edge.want(ORDER, 0.0)
    assert edge.is_due(ELECTORS, set(), FIRST_S), "who is no elector waits for nobody"


def test_a_single_elector_waits_for_nobody() -> None:
    one = Reopening("robot1")
    one.want(("robot1",), 0.0)
    assert one.is_due(("robot1",), (), FIRST_S)


def test_what_cannot_be_now_is_tried_again_later() -> None:
    one = Reopening("robot1")
    one.want(("robot1",), 0.0)
    one.put_off(FIRST_S)
    assert not one.is_due(("robot1",), (), FIRST_S + PATIENCE_S - 1)
    assert one.is_due(("robot1",), (), FIRST_S + PATIENCE_S)
