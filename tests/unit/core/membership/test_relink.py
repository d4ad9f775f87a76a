"""When peers are introduced: not at once, soon, then ever more rarely, and from the start when somebody goes again."""

from __future__ import annotations

from itertools import pairwise

from zsched.core.membership.relink import (
    FIRST_PAUSE_S,
    LINK_WAIT_S,
    MAX_PAUSE_S,
    MUTE_PAUSE_S,
    MUTE_S,
    Introductions,
    MuteLinks,
)


def times(introductions: Introductions, begin: float, end: float) -> list[float]:
    ticks = (begin + number * 0.1 for number in range(round((end - begin) * 10)))
    return [now for now in ticks if introductions.is_due(now, is_missing=True)]


def test_a_link_that_comes_back_by_itself_needs_none() -> None:
    introductions = Introductions()

    assert times(introductions, 0.0, LINK_WAIT_S) == []
    assert not introductions.is_due(LINK_WAIT_S, is_missing=False)
    assert not introductions.is_due(LINK_WAIT_S + 0.1, is_missing=True)


def test_who_stays_away_costs_ever_less() -> None:
    found = times(Introductions(), 0.0, 600.0)

    pauses = [later - earlier for earlier, later in pairwise(found)]
    assert LINK_WAIT_S <= found[0] < LINK_WAIT_S + 0.15
    assert FIRST_PAUSE_S <= pauses[0] < FIRST_PAUSE_S + 0.15
    assert pauses == sorted(pauses)
    assert MAX_PAUSE_S <= pauses[-1] < MAX_PAUSE_S + 0.15


def test_the_next_absence_begins_from_the_start() -> None:
    introductions = Introductions()
    times(introductions, 0.0, 300.0)
    introductions.is_due(300.0, is_missing=False)

    first, second, *_ = times(introductions, 301.0, 320.0)

    assert first < 301.0 + LINK_WAIT_S + 0.15
    assert second - first < FIRST_PAUSE_S + 0.15


def test_a_gone_nodes_link_is_ended_after_a_while_then_ever_more_rarely() -> None:
    links = MuteLinks()
    ticks = [number * 0.1 for number in range(6000)]

    found = [now for now in ticks if links.due(now, ("edge1",)) == ("edge1",)]

    pauses = [later - earlier for earlier, later in pairwise(found)]
    assert MUTE_S <= found[0] < MUTE_S + 0.15
    assert FIRST_PAUSE_S <= pauses[0] < FIRST_PAUSE_S + 0.15
    assert pauses == sorted(pauses)
    assert MUTE_PAUSE_S <= pauses[-1] < MUTE_PAUSE_S + 0.15


def test_each_gone_node_has_its_own_times() -> None:
    links = MuteLinks()
    for number in range(6000):
        links.due(number * 0.1, ("edge1",))
    links.due(600.0, ("edge1", "edge2"))

    assert "edge2" in links.due(600.0 + MUTE_S, ("edge1", "edge2"))
    assert links.due(606.0, ()) == ()
    assert links.due(607.0, ("edge2",)) == ()
    assert links.due(607.0 + MUTE_S, ("edge2",)) == ("edge2",), "from the start"
