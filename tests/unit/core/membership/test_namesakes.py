"""A name that lives twice: what makes a node say so, and what does not."""

from __future__ import annotations

from dataclasses import replace

from support.beats import beat_of
from support.fleets import fleet_of
from zsched.core.membership.identity import QUIET_S
from zsched.core.membership.namesakes import BESIDE_BEATS, BESIDE_S, LIVES_KEPT, TWINS_TOLD, WHERE_EVERY_S, Namesakes
from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce

BEAT_S = 0.2


def here(beat_s: float) -> InForce:
    fleet = fleet_of()
    return InForce(replace(fleet, timing=replace(fleet.timing, beat_s=beat_s, suspect_s=beat_s)))


def beat(incarnation: int, sequence: int, node: str = "edge2") -> Beat:
    return beat_of(node, sequence, incarnation=incarnation)


def two(*, tokens: tuple[int, ...] = (7, 8), node: str = "edge2") -> Namesakes:
    namesakes = Namesakes(here(BEAT_S))
    for incarnation in tokens:
        namesakes.on_token(node, incarnation, is_present=True)
    return namesakes


def both(namesakes: Namesakes, start: float, seconds: float, node: str = "edge2") -> list[float]:
    """Beats of both lives side by side; when a twin was news."""
    news = []
    for step in range(round(seconds / BEAT_S) + 1):
        now = start + step * BEAT_S
        for incarnation, first in ((7, 500), (8, 1)):
            if namesakes.on_beat(beat(incarnation, first + round((now - 100.0) / BEAT_S), node), now):
                news.append(now)
    return news


def test_two_daemons_that_beat_beside_each_other_are_told_once_and_named() -> None:
    namesakes = two()
    (at,) = both(namesakes, 100.0, 4.0)
    assert 100.0 + BESIDE_S <= at <= 100.0 + BESIDE_S + 2 * BEAT_S
    assert namesakes.names(104.0) == ("edge2",)
    assert namesakes.lives(104.0) == (("edge2", 7, 520), ("edge2", 8, 21))
    (text,) = namesakes.problems(104.0)
    assert text == (
        "2 daemons call themselves 'edge2': somewhere (incarnation 7), somewhere (incarnation 8); "
        "stop one, or give its machine a name of its own"
    )


def test_slow_beats_take_so_many_of_them() -> None:
    namesakes = Namesakes(here(1.0))
    for incarnation in (7, 8):
        namesakes.on_token("edge2", incarnation, is_present=True)
    news = [
        step
        for step in range(12)
        for incarnation in (7, 8)
        if namesakes.on_beat(beat(incarnation, step), 100.0 + 0.9 * step)
    ]
    assert len(news) == 1
    assert 0.9 * news[0] >= BESIDE_BEATS


def test_without_a_second_token_beats_say_nothing() -> None:
    """Anybody can put beats, and what a daemon's earlier life has left in the air comes without a token, too."""
    namesakes, left = two(tokens=(7,)), two()
    left.on_token("edge2", 8, is_present=False)
    for one in (namesakes, left):
        assert both(one, 100.0, 10.0) == []
        assert one.problems(110.0) == ()


def test_beats_of_a_life_that_has_no_token_are_no_twin_beside_a_token_that_lingers() -> None:
    """After a restart two tokens are there for a while; a stranger puts beats of a third life."""
    namesakes = two()
    for step in range(50):
        now = 100.0 + step * BEAT_S
        assert not namesakes.on_beat(beat(8, step), now)
        assert not namesakes.on_beat(beat(9, step), now)
    assert namesakes.names(110.0) == ()


def test_a_token_alone_says_nothing() -> None:
    namesakes = two()
    assert not any(namesakes.on_beat(beat(7, 500 + step), 100.0 + step * BEAT_S) for step in range(50))
    assert namesakes.names(110.0) == ()


def test_a_restart_whose_old_token_lingers_is_no_twin() -> None:
    """The new life's beats come after the old one's; what the old link still held comes all at once."""
    namesakes = two()
    for step in range(20):
        namesakes.on_beat(beat(7, 500 + step), 100.0 + step * BEAT_S)
    for step in range(20):
        assert not namesakes.on_beat(beat(8, step), 104.0 + step * BEAT_S)
    for step in range(30):
        assert not namesakes.on_beat(beat(7, 520 + step), 108.0 + step / 1000)
    for step in range(20, 40):
        assert not namesakes.on_beat(beat(8, step), 104.0 + step * BEAT_S)


def test_an_echo_that_does_not_rise_is_no_life() -> None:
    namesakes = two()
    for step in range(30):
        now = 100.0 + step * BEAT_S
        assert not namesakes.on_beat(beat(7, 500 + step), now)
        assert not namesakes.on_beat(beat(8, 3), now)


def test_it_is_said_until_the_twin_has_been_away_for_long_enough() -> None:
    """A service manager starts a twin that leaves every six seconds: that is one problem, not one now and then."""
    namesakes = two()
    both(namesakes, 100.0, 2.0)
    namesakes.on_token("edge2", 8, is_present=False)
    assert namesakes.names(102.0) == (), "a beat tells of what is so right now"
    assert namesakes.problems(102.0 + QUIET_S - 0.01)
    assert namesakes.problems(102.0 + QUIET_S) == ()
    namesakes.on_token("edge2", 9, is_present=True)
    for step in range(10):
        assert not namesakes.on_beat(beat(7, 600 + step), 108.0 + step * BEAT_S)
        assert not namesakes.on_beat(beat(9, step), 108.0 + step * BEAT_S), "it is no news"
    assert "incarnation 9" in namesakes.problems(110.0)[0]


def test_a_twin_that_falls_silent_is_none_for_the_beats() -> None:
    namesakes = two()
    both(namesakes, 100.0, 2.0)
    assert namesakes.names(102.0 + BESIDE_S - 0.01) == ("edge2",)
    assert namesakes.names(102.0 + BESIDE_S) == ()
    assert namesakes.lives(102.0 + BESIDE_S) == ()


def test_both_are_asked_where_they_are_until_it_is_known() -> None:
    namesakes = two()
    assert not namesakes.must_ask("edge2", 100.0), "no twins yet"
    both(namesakes, 100.0, 2.0)
    assert namesakes.must_ask("edge2", 102.0)
    assert not namesakes.must_ask("edge2", 102.0 + WHERE_EVERY_S - 0.01)
    namesakes.on_answer("edge2", 7, "tcp/10.0.0.7:7447")
    both(namesakes, 102.2, WHERE_EVERY_S - 0.2)
    assert namesakes.must_ask("edge2", 102.0 + WHERE_EVERY_S)
    namesakes.on_answer("edge2", 8, "tcp/10.0.0.9:7447")
    both(namesakes, 104.4, 2.0)
    assert not namesakes.must_ask("edge2", 110.0)
    (text,) = namesakes.problems(106.4)
    assert "tcp/10.0.0.7:7447 (incarnation 7), tcp/10.0.0.9:7447 (incarnation 8)" in text
    assert not namesakes.must_ask("edge1", 110.0)


def test_a_stranger_s_tokens_and_names_are_bounded() -> None:
    namesakes = two(tokens=tuple(range(1000)))
    assert not namesakes.on_beat(beat(LIVES_KEPT, 1), 100.0), "not kept"
    assert [namesakes.on_beat(beat(one, 1), 100.0) for one in range(LIVES_KEPT)] == [False] * LIVES_KEPT
    for number in range(9):
        for incarnation in (7, 8):
            namesakes.on_token(f"n{number}", incarnation, is_present=True)
        both(namesakes, 200.0, 2.0, f"n{number}")
    assert namesakes.names(202.0) == tuple(f"n{number}" for number in range(TWINS_TOLD))


def test_one_that_beats_on_when_its_twin_has_stopped_is_no_twin() -> None:
    namesakes = two()
    both(namesakes, 100.0, 2.0)
    for step in range(round(BESIDE_S / BEAT_S) + 1):
        namesakes.on_beat(beat(7, 600 + step), 102.0 + step * BEAT_S)
    assert namesakes.names(102.0 + BESIDE_S) == ()


def test_tokens_over_the_bound_are_not_there_when_the_others_go() -> None:
    namesakes = two(tokens=tuple(range(20, 20 + LIVES_KEPT - 1)))
    for incarnation in (7, 8):  # the last that is kept, and one more
        namesakes.on_token("edge2", incarnation, is_present=True)
    for incarnation in range(20, 20 + LIVES_KEPT - 1):
        namesakes.on_token("edge2", incarnation, is_present=False)
    both(namesakes, 100.0, 2.0)
    assert namesakes.names(102.0) == (), "7 alone is known"
