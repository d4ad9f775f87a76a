"""In which order the nodes of a secured fleet begin anew, and when each of them does."""

from __future__ import annotations

from itertools import combinations

from zsched.config.timing import WAN, WIFI, WIRED
from zsched.core.executor.sparing import Sparing
from zsched.runtime.reopening import (
    LONGEST_WAIT_S,
    OWNER_S,
    SETTLE_S,
    TURN_S,
    Moved,
    Reopening,
    first_wait_s,
    turns,
)

ELECTORS = ("edge1", "robot1", "robot2")
NODES = ("edge1", "edge2", "robot1", "robot2")
ORDER = turns(NODES, ELECTORS)
LIFE = 7
FIRST_S = first_wait_s(WIFI)


def lives(*names: str, anew: tuple[str, ...] = ()) -> dict[str, int | None]:
    """Who lives, and who of them in a new life."""
    return {name: LIFE + (name in anew) for name in names}


def others(me: str, *anew: str) -> dict[str, int | None]:
    return lives(*(name for name in NODES if name != me), anew=anew)


SINGLY = (("edge2",), ("edge1",), ("robot1",), ("robot2",))


def wanting(me: str, now: float = 0.0) -> Reopening:
    one = Reopening(me)
    one.want(SINGLY, others(me), now, first_s=FIRST_S)
    return one


def test_one_turn_of_others_and_an_elector_comes_first_so_a_new_node_waits_as_long_in_any_fleet() -> None:
    assert ORDER == (("robot2", "edge2"), ("edge1",), ("robot1",))
    assert turns(("robot1", "robot2"), ("robot1", "robot2")) == (("robot1",), ("robot2",))
    pair = turns(NODES[:3], ELECTORS[:2])
    assert pair == (("edge2",), ("edge1",), ("robot1",)), "one of two electors is half of them"
    large = [f"m{number:02d}" for number in range(1, 25)]
    order = turns(large, large[:5], robots=large[::2], tasks=[large[10:14]])
    assert order[1:5] == tuple((name,) for name in large[:4])
    assert large[4] in order[0], "two more, and three of five know the new rules"
    assert len(order) <= 4 + 3, "the other nineteen take as many turns as votes and tasks ask for"
    assert sorted(name for wave in order for name in wave) == large


def test_electors_have_the_same_order_whomever_a_node_hears() -> None:
    """Two nodes may hear others in the moment of the change: no two electors may think that they come first."""
    electors = ("e1", "e2", "e3", "e4")
    others = ("n1", "n2")
    whole = [name for wave in turns((*electors, *others), electors) for name in wave if name in electors]
    for count in range(1, len(electors) + 1):
        for heard in combinations(electors, count):
            for more in ((), others):
                order = [name for wave in turns((*heard, *more), electors) for name in wave if name in electors]
                assert order == [name for name in whole if name in heard]


def test_a_turn_leaves_a_majority_of_the_robots_and_a_candidate_of_every_task() -> None:
    robots = tuple(f"robot{number}" for number in range(1, 8))
    edges = ("edge1", "edge2", "edge3")
    tasks = [("edge1", "edge2", "gone"), ("edge3",), ("edge3", "robot7")]
    order = turns((*edges, *robots), ("robot1",), robots, tasks)
    for wave in order:
        assert len(set(robots) - set(wave)) > len(robots) / 2
        assert not {"edge1", "edge2"} <= set(wave), "who is gone cannot have it meanwhile"
        assert not {"edge3", "robot7"} <= set(wave)
    assert len(order) == 3, "robot1, and two turns of all others"
    electors = ("edge1", "edge3", "robot1")
    tasks = [("edge2", "robot1")]
    apart = (("robot1",), ("edge1",), ("edge3",))
    assert turns((*electors, "edge2"), electors, (), tasks) == (*apart, ("edge2",)), "two candidates of a task"
    assert turns((*electors, "robot2"), electors, ("robot1", "robot2")) == (*apart, ("robot2",)), "two of two votes"
    alone = turns(("edge1", "robot1"), (), ("robot1",), [("edge1",)])
    assert alone == (("edge1", "robot1"),), "a task with one candidate keeps nobody waiting"


def test_no_two_turns_have_the_same_latest() -> None:
    due = []
    for name in NODES:
        one = wanting(name, 100.0)
        assert one.due_at is not None
        assert not one.is_due(ELECTORS, others(name), one.due_at - 0.1)
        assert one.is_due(ELECTORS, others(name), one.due_at)
        due.append(one.due_at)
    assert min(due) == 100.0 + FIRST_S
    assert all(after - before >= TURN_S - 1e-9 for before, after in zip(sorted(due), sorted(due)[1:], strict=False))


def test_the_next_one_follows_when_those_before_it_live_anew() -> None:
    one = wanting("robot1")
    assert not one.is_due(ELECTORS, others("robot1", "edge1", "edge2"), FIRST_S - 0.1), "the first one may still wait"
    assert not one.is_due(ELECTORS, others("robot1", "edge2"), FIRST_S + 1.0), "edge1 has not begun anew"
    both = others("robot1", "edge1", "edge2")
    assert not one.is_due(ELECTORS, both, FIRST_S + 2.0)
    assert not one.is_due(ELECTORS, both, FIRST_S + 1.9 + SETTLE_S), "their workers start"
    assert one.is_due(ELECTORS, both, FIRST_S + 2.0 + SETTLE_S)
    lack = (Sparing.AWAY,)
    assert not one.is_due(ELECTORS, both, FIRST_S + 2.0 + SETTLE_S, lack=lack), "nobody could take its task"
    assert one.due_at is not None
    assert one.is_due(ELECTORS, both, one.due_at, lack=lack), "that is not waited for without end"


def test_the_first_turn_waits_until_all_have_learnt_of_the_change() -> None:
    """6.5 round trips (docs/decisions/0102); a round trip is at most `ballot_s`, or no vote comes to its end."""
    assert first_wait_s(WIRED) == first_wait_s(WIFI) == 2.0
    assert first_wait_s(WAN) == 4.0, "300 ms there and back, 6.5 times"


def test_an_owner_waits_longer_for_a_candidate_that_starts_but_not_for_ever() -> None:
    one, lack = wanting("robot1"), (Sparing.AWAY, Sparing.STARTING)
    both = others("robot1", "edge1", "edge2")
    assert one.due_at is not None
    assert not one.is_due(ELECTORS, both, one.due_at, lack=lack), "its task would have no owner until one is ready"
    assert one.is_due(ELECTORS, both, one.due_at, lack=()), "one is ready"
    assert not one.is_due(ELECTORS, both, one.due_at + OWNER_S - 0.1, lack=lack)
    assert one.is_due(ELECTORS, both, one.due_at + OWNER_S, lack=lack)


def test_one_that_dies_again_is_waited_for_until_the_latest() -> None:
    one = wanting("robot1")
    assert not one.is_due(ELECTORS, others("robot1", "edge1", "edge2"), 4.0)
    assert not one.is_due(ELECTORS, lives("edge1", "robot2", anew=("edge1",)), 4.5)
    both = others("robot1", "edge1", "edge2")
    assert not one.is_due(ELECTORS, both, 5.0 + SETTLE_S / 2), "it counts anew"
    assert one.is_due(ELECTORS, both, 5.0 + 2 * SETTLE_S)


def test_a_life_that_was_not_known_before_proves_nothing() -> None:
    one = Reopening("edge1")
    one.want(SINGLY, lives("robot1", "robot2"), 0.0, first_s=FIRST_S)
    assert not one.is_due(ELECTORS, others("edge1", "edge2"), FIRST_S + 5.0)
    assert one.due_at == FIRST_S + TURN_S


def test_a_turn_that_is_set_stays_until_nothing_is_wanted_any_more() -> None:
    one = Reopening("edge2")
    assert not one.is_due(ELECTORS, others("edge2"), 1e9)
    one.want(SINGLY, others("edge2"), 100.0, first_s=FIRST_S)
    one.want(SINGLY, others("edge2"), 101.5, first_s=FIRST_S)
    assert one.is_due(ELECTORS, others("edge2"), 100.0 + FIRST_S)
    one.forget()
    assert not one.is_due(ELECTORS, others("edge2"), 103.0)


def test_an_elector_waits_for_the_others_but_not_for_ever() -> None:
    one = wanting("edge1")
    assert one.due_at is not None
    assert not one.is_due(ELECTORS, lives("edge2", "robot1"), one.due_at)
    assert one.is_due(ELECTORS, lives("robot1", "robot2"), one.due_at), "edge2 is no elector"
    assert one.is_due(ELECTORS, lives("robot1"), one.due_at + LONGEST_WAIT_S)
    edge = wanting("edge2")
    assert edge.is_due(ELECTORS, {}, FIRST_S), "who is no elector waits for nobody"


def test_a_single_elector_waits_for_nobody() -> None:
    one = Reopening("robot1")
    one.want((("robot1",),), {}, 0.0, first_s=FIRST_S)
    assert one.is_due(("robot1",), {}, FIRST_S)


def test_what_cannot_be_now_is_tried_again_later() -> None:
    one = Reopening("robot1")
    one.want((("robot1",),), {}, 0.0, first_s=FIRST_S)
    one.put_off(FIRST_S)
    assert not one.is_due(("robot1",), {}, FIRST_S + LONGEST_WAIT_S - 1)
    assert one.is_due(("robot1",), {}, FIRST_S + LONGEST_WAIT_S)


def test_a_node_that_moves_is_waited_for_where_it_was_until_it_is_gone_there() -> None:
    book = Moved()
    assert book.left({"edge1": 7}) == frozenset(), "nobody has moved"
    book.take(("edge1", "edge2"))
    assert book.left({"edge1": 7, "edge2": 8}) == frozenset(), "both are heard where they were"
    book.take(("edge1", "edge2"))
    assert book.left({"edge1": 7}) == {"edge2"}, "it is gone"
    assert book.left({"edge1": 9, "edge2": 8}) == {"edge1"}, "it has begun again elsewhere: its data session is there"
    book.take(("edge1",))
    assert book.left({"edge1": 7}) == frozenset()
    book.take(())
    assert book.left({}) == frozenset()


def test_who_was_gone_before_it_was_known_to_move_has_left() -> None:
    book = Moved()
    book.take(("edge1",))
    assert book.left({}) == {"edge1"}
