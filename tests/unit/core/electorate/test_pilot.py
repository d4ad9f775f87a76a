"""The pilot's rules one by one, without machines: what it hears, what it thinks, what it advises."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleet_values import fleet_value_of
from zsched.core.electorate.changes import AddElector, FleetChange, RemoveElector, SetAway
from zsched.core.electorate.pilot import PAUSE_SHARE, STEADY, Course, Pilot, Word, may_go
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.model import NodeKind

T = 10.0
COURSE = Course(
    members=tuple((name, NodeKind.ROBOT if name < "n" else NodeKind.EDGE) for name in "abcdexyz"),
    is_auto=True,
    silence_s=T,
    suspect_s=T,
    away_s=60.0,
)


def value(names: str, **changes: object) -> FleetValue:
    plain = fleet_value_of(
        7,
        *(Elector(name=name, disk=disk_of(name), joining=1) for name in names),
        number=3,
        fleet="f",
        generation_id="ab",
        document="d",
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


def disk_of(name: str) -> str:
    return f"{ord(name):02x}"


class Ear:
    """A pilot of ``a`` that hears beats every second."""

    def __init__(self, fleet: FleetValue, course: Course = COURSE) -> None:
        self.now, self.value, self.course = 0.0, fleet, course
        self.pilot = Pilot(me="a", disk=disk_of("a"), now=0.0)
        self.stagger_s = 1.0

    def hear(self, names: str, seconds: float, **words: object) -> None:
        """For so long these names beat; all of them say the same."""
        ends_at = self.now + seconds
        while self.now < ends_at:
            self.now += 1.0
            for name in names:
                self.say(name, **words)
            self.pilot.gone(self.value, self.course, self.now)

    def tick(self, now: float, *, is_busy: bool) -> FleetChange | None:
        return self.pilot.tick(self.value, self.course, now, stagger_s=self.stagger_s, is_busy=is_busy)

    def say(self, name: str, **words: object) -> None:
        word = Word(node=name, disk=disk_of(name), is_current=True)
        self.pilot.hear(replace(word, **words), self.value, self.course, self.now)  # type: ignore[arg-type]

    def gone(self) -> tuple[str, ...]:
        return self.pilot.gone(self.value, self.course, self.now)

    @property
    def wish(self) -> str:
        """The advice in short, or its reason."""
        advice = self.pilot.advise(self.value, self.course, self.now)
        match advice.change:
            case AddElector(name=name, disk=disk):
                return f"+{name}/{disk}"
            case RemoveElector(name=name):
                return f"-{name}"
            case SetAway(away=away):
                return f"away {','.join(away)}"
        return advice.reason


# --- gone ------------------------------------------------------------------------------------------------------------


def test_nothing_is_changed_while_the_fleet_goes_by_its_files() -> None:
    ear = Ear(value("abc", document=""))
    ear.hear("bc", 20.0)
    ear.hear("b", T)
    assert ear.gone() == ("c",)
    assert ear.wish == "no document is agreed yet"


def test_gone_is_an_elector_that_was_not_heard_with_its_name_and_disk_for_the_silence() -> None:
    ear = Ear(value("abc"))
    ear.hear("bc", 20.0)
    ear.hear("b", T - 1.0)
    assert ear.gone() == ()
    ear.hear("b", 1.0)
    assert ear.gone() == ("c",)
    ear.hear("c", 1.0, disk="99")
    assert ear.gone() == ("c",), "another disk is another member"
    ear.hear("c", 1.0)
    assert ear.gone() == ()


def test_a_second_machine_of_the_name_does_not_hide_the_first() -> None:
    ear = Ear(value("abc"))
    for _ in range(30):
        ear.hear("bc", 1.0)
        ear.say("b", disk="99")
    assert ear.gone() == ()


def test_a_node_that_may_not_elect_shows_no_disk_and_is_gone() -> None:
    ear = Ear(value("abc", electors=tuple(Elector(name=name) for name in "abc")))
    ear.hear("b", T)
    ear.hear("b", T, disk="")
    assert ear.gone() == ("b", "c"), "a seat of a fleet file names no disk, and still needs one"


def test_an_elector_that_lost_its_state_is_the_spare_for_its_own_seat() -> None:
    """Among three without another spare: it is there, and as another member it may be added."""
    ear = Ear(value("abc"))
    ear.hear("bc", T)
    for _ in range(int(STEADY * T)):
        ear.hear("b", 1.0, gone=("c",))
        ear.say("c", disk="")
    assert "two electors are no better than three" in ear.wish, "it does not say that it may return"
    for _ in range(int(STEADY * T)):
        assert ear.wish != "-c" or ear.now >= STEADY * T
        ear.hear("b", 1.0, gone=("c",))
        ear.say("c", disk="", may_return=True)
    assert ear.wish == "-c"
    ear.value = value("ab", revision=8, number=4)
    ear.say("c", disk="", may_return=True)
    assert ear.wish.startswith("2 electors"), "it is added once it shows a disk"


def test_a_pilot_that_has_paused_listens_anew() -> None:
    ear = Ear(value("abc"))
    ear.hear("bc", 20.0)
    ear.now += PAUSE_SHARE * T + 0.1
    assert ear.gone() == ()
    ear.now += PAUSE_SHARE * T - 0.1
    assert ear.gone() == (), "nothing was heard while it slept"
    for _ in range(3):
        ear.now += PAUSE_SHARE * T
        ear.say("b")
    assert ear.gone() == ("c",)


def test_a_new_seat_counts_as_heard() -> None:
    ear = Ear(value("abc"))
    ear.hear("bc", 30.0)
    ear.value = value("abcd", number=4, revision=8)
    assert ear.gone() == ()
    ear.hear("bc", T)
    assert ear.gone() == ("d",)


# --- removal ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("missed_by", "wish"),
    [
        ("", "c is gone for a: 3 electors must say so"),
        ("b", "c is gone for a, b: 3 electors must say so"),
        ("bd", "-c"),
    ],
)
def test_a_removal_needs_the_opinion_of_a_majority_of_the_electors(missed_by: str, wish: str) -> None:
    ear = Ear(value("abcde"))
    ear.hear("bde", 2 * T)
    for name in missed_by:
        ear.say(name, gone=("c",))
    assert ear.wish == wish


@pytest.mark.parametrize(
    "word", [{"is_current": False}, {"disk": "99"}, {"node": "z", "disk": disk_of("z")}, {"node": "c", "disk": "99"}]
)
def test_an_opinion_counts_of_an_elector_that_counts_as_we_do(word: dict[str, object]) -> None:
    ear = Ear(value("abcde"))
    ear.hear("bdez", 2 * T)
    ear.say("b", gone=("c",))
    ear.say("d", gone=("c",), **word)
    assert "must say so" in ear.wish


def test_an_old_opinion_does_not_count() -> None:
    ear = Ear(value("abcde"))
    ear.hear("bde", 2 * T)
    ear.say("d", gone=("c",))
    ear.hear("b", T - 1.0, gone=("c",))
    assert ear.wish == "-c", "a, b and d miss it"
    ear.hear("b", 1.0, gone=("c",))
    assert "c is gone for a, b;" in ear.wish, "d is silent itself"


def test_remove_first_then_add() -> None:
    ear = Ear(value("abcde"))
    ear.hear("bcdexy", STEADY * T)
    ear.hear("bdexy", T, gone=("c",))
    assert ear.wish == "-c"
    ear.value = value("abde", number=4, revision=8)
    assert ear.wish == f"+x/{disk_of('x')}"


def test_the_dead_are_removed_first_although_there_is_room() -> None:
    ear = Ear(value("abcd"))
    ear.hear("bcdxy", STEADY * T)
    ear.hear("bdxy", T, gone=("c",))
    assert ear.wish == "-c", "a, b, d and two more would be five"


def test_three_become_two_only_with_a_spare() -> None:
    ear = Ear(value("abc"))
    ear.hear("bcx", T)
    ear.hear("bx", 2 * T, gone=("c",))
    why = "c is gone, and no node is fit to follow it: two electors are no better than three"
    assert ear.wish == f"{why}; start it again, or bring another node"
    ear.hear("bx", 2 * T, gone=("c",))
    assert ear.wish == "-c"


def test_a_name_with_another_disk_may_follow_itself() -> None:
    ear = Ear(value("abc"))
    ear.hear("bc", T)
    for _ in range(int(STEADY * T) + 1):
        ear.hear("b", 1.0, gone=("c",))
        ear.say("c", disk="99")
    assert ear.wish == "-c"
    ear.value = value("ab", number=4, revision=8)
    assert ear.wish == "+c/99"


def test_two_are_not_made_one_by_silence() -> None:
    ear = Ear(value("ab"))
    ear.hear("x", STEADY * T + T)
    assert ear.wish == "b is gone for a: 2 electors must say so"


@pytest.mark.parametrize(("names", "wish"), [("abc", "-b"), ("ab", "-b"), ("a", "a is the last elector, and stays")])
def test_a_leaver_is_removed_at_once_but_the_last_one_stays(names: str, wish: str) -> None:
    ear = Ear(value(names), replace(COURSE, leaving=("a", "b") if names == "a" else ("b",)))
    ear.hear("bc", 2.0)
    assert ear.wish == wish


def test_a_leaver_waits_where_too_few_would_be_left_and_who_is_gone_is_replaced_first() -> None:
    ear = Ear(value("abc"), replace(COURSE, leaving=("b",)))
    ear.hear("b", T + 1.0)
    assert ear.wish == "b leaves when 2 of the other electors are alive; c is gone for a: 2 electors must say so"
    ear.hear("bx", STEADY * T + 1.0, gone=("c",))
    assert ear.wish == "-c"
    ear.value = value("ab", number=4, revision=8)
    assert ear.wish == "-b", "the one that stays is a majority of one"


def test_a_leaver_waits_for_an_elector_that_may_be_gone() -> None:
    """It was counted on until it had been silent for `replace_s`: the fleet had no majority after the leave."""
    ear = Ear(value("abc"))
    ear.hear("bc", 5.0)
    ear.hear("b", 3.0)
    ear.course = replace(COURSE, leaving=("b",), suspect_s=2.5)
    assert (ear.gone(), ear.wish) == ((), "b leaves when 2 of the other electors are alive")
    ear.hear("bc", 1.0)
    assert ear.wish == "-b"


def test_a_leaver_is_told_what_it_waits_for_and_why_nobody_follows_the_one_that_is_gone() -> None:
    ear = Ear(value("abc"), replace(COURSE, leaving=("b",)))
    ear.hear("bc", 5.0)
    ear.hear("b", T + 2.0, gone=("c",))
    assert ear.wish == (
        "b leaves when 2 of the other electors are alive; c is gone, and no node is fit to follow it: two electors are "
        "no better than three; start it again, or bring another node"
    )


def test_a_node_that_may_be_gone_becomes_no_elector() -> None:
    """An operator had just removed it, for it was dead: it came back in the middle of that command."""
    ear = Ear(value("ab"), replace(COURSE, suspect_s=2.5))
    ear.hear("bx", STEADY * T + 1.0)
    assert ear.wish == "+x/78"
    ear.hear("b", 4.0)
    assert ear.wish == "2 electors, 2 alive, 0 more could be one"
    ear.hear("bx", 1.0)
    assert ear.wish == "+x/78"


def test_whom_a_pilot_that_has_just_started_never_heard_is_not_counted_on() -> None:
    """It may be dead: without the leaver the fleet would have no majority any more."""
    ear = Ear(value("abc"), replace(COURSE, leaving=("b",)))
    ear.hear("b", 1.0)
    assert (ear.gone(), ear.wish) == ((), "b leaves when 2 of the other electors are alive")
    ear.hear("bc", 1.0)
    assert ear.wish == "-b"


def test_a_single_elector_that_leaves_hands_its_seat_to_one_that_is_fit() -> None:
    ear = Ear(value("a"))
    ear.hear("x", STEADY * T + 1.0)
    assert ear.wish == "1 electors, 1 alive, 1 more could be one", "two are no better than one"
    ear.course = replace(COURSE, leaving=("a",))
    assert ear.wish == f"+x/{disk_of('x')}"
    ear.value = value("ax", number=4, revision=8)
    ear.hear("x", 1.0)
    assert ear.wish == "-a"
    ear.value, ear.course = value("a"), replace(COURSE, leaving=("a", "x"))
    assert ear.wish == "a is the last elector, and stays", "who leaves too takes no seat"


def test_whom_the_document_does_not_name_leaves() -> None:
    ear = Ear(value("abc"), replace(COURSE, members=tuple(one for one in COURSE.members if one[0] != "b")))
    ear.hear("bc", 2.0)
    assert ear.wish == "-b"


def test_a_leaver_stays_until_it_has_learnt_a_settled_value_without_it() -> None:
    assert not may_go(value("abc"), "a")
    assert not may_go(value("bc", settled=False), "a")
    assert may_go(value("bc"), "a")


# --- addition --------------------------------------------------------------------------------------------------------


def test_a_candidate_was_heard_without_a_break_for_several_silences() -> None:
    ear = Ear(value("abcd"))
    ear.hear("bcdx", STEADY * T)
    assert ear.wish == "4 electors, 4 alive, 0 more could be one"
    ear.hear("bcdx", 1.0)
    assert ear.wish == f"+x/{disk_of('x')}"
    ear.hear("bcd", T)
    assert ear.wish == "4 electors, 4 alive, 0 more could be one", "it is silent"
    ear.hear("bcdx", T)
    assert ear.wish == "4 electors, 4 alive, 0 more could be one", "and begins again"


def test_who_leaves_is_no_candidate_until_its_flag_is_taken_back() -> None:
    ear = Ear(value("abcd"), replace(COURSE, leaving=("x",)))
    ear.hear("bcdx", STEADY * T + 1.0)
    assert ear.wish == "4 electors, 4 alive, 0 more could be one"
    ear.hear("bcdxy", STEADY * T + 1.0)
    assert ear.wish == f"+y/{disk_of('y')}", "x was heard for longer"
    ear.course = COURSE
    assert ear.wish == f"+x/{disk_of('x')}"


def test_who_leaves_is_no_spare_for_one_of_three_that_is_gone() -> None:
    ear = Ear(value("abc"), replace(COURSE, leaving=("x",)))
    ear.hear("bcx", T)
    ear.hear("bx", STEADY * T, gone=("c",))
    assert "two electors are no better than three" in ear.wish
    ear.course = COURSE
    assert ear.wish == "-c"


@pytest.mark.parametrize("word", [{"is_current": False}, {"disk": ""}])
def test_a_candidate_shows_the_present_number_and_a_disk(word: dict[str, object]) -> None:
    ear = Ear(value("abcd"))
    for _ in range(int(STEADY * T) + 2):
        ear.hear("bcd", 1.0)
        ear.say("x", **word)
    assert ear.wish == "4 electors, 4 alive, 0 more could be one"


def test_a_candidate_is_added_with_the_disk_of_its_newest_beat() -> None:
    ear = Ear(value("abcd"))
    ear.hear("bcdx", STEADY * T)
    ear.hear("bcdx", 2.0, disk="77")
    assert "0 more could be one" in ear.wish, "another disk is another member: it is not steady yet"
    for _ in range(int(STEADY * T)):
        ear.hear("bcd", 1.0)
        ear.say("x", disk="77")
    assert ear.wish == "+x/77"


def test_add_only_with_room_for_one_that_never_answers() -> None:
    ear = Ear(value("abcd"))
    ear.hear("bcdxyz", STEADY * T)
    ear.hear("bxyz", T)
    assert ear.wish.startswith("c is gone for a; d is gone for a")
    ear.hear("cd", 1.0)
    assert ear.wish == f"+x/{disk_of('x')}"


def test_one_elector_becomes_three_over_two_when_two_nodes_are_fit() -> None:
    ear = Ear(value("a"))
    ear.hear("b", 10.0)
    ear.hear("bx", STEADY * T + 1.0)
    assert ear.wish == f"+x/{disk_of('x')}", "the other kind first"
    ear.value = value("ax")
    ear.hear("bx", 1.0)
    assert ear.wish == f"+b/{disk_of('b')}", "the third follows at once"


def test_an_elector_whose_second_came_without_a_third_waits_for_one() -> None:
    ear = Ear(value("ax"))
    ear.hear("x", STEADY * T + 1.0)
    assert ear.wish == "2 electors, 2 alive, 0 more could be one"


@pytest.mark.parametrize(
    ("names", "spares", "wish"), [("abc", "x", "3 electors"), ("abc", "xy", "+x"), ("ab", "x", "+x")]
)
def test_the_aim_is_odd(names: str, spares: str, wish: str) -> None:
    ear = Ear(value(names))
    ear.hear(names[1:] + spares, STEADY * T + 1.0)
    assert ear.wish.startswith(wish)


def test_spread_over_robots_and_edges_then_the_steadiest() -> None:
    ear = Ear(value("abxy"))
    ear.hear("bxyd", 3.0)
    ear.hear("bxydcz", STEADY * T + T)
    ear.value = value("abcx")
    assert ear.wish == f"+y/{disk_of('y')}", "three robots and one edge: an edge, the steadier one"
    ear.value = value("abxy")
    assert ear.wish == f"+d/{disk_of('d')}", "as many of both: who was heard first"
    ear.value = value("axyz")
    assert ear.wish == f"+b/{disk_of('b')}", "one robot and three edges: a robot"


def test_electors_that_the_operator_names_stay() -> None:
    ear = Ear(value("abcde"), replace(COURSE, is_auto=False))
    ear.hear("bdexy", STEADY * T, gone=("c",))
    assert ear.wish == "the operator has named the electors"


def test_nothing_is_done_on_an_unsettled_value() -> None:
    ear = Ear(value("abcde", settled=False))
    ear.hear("bdexy", STEADY * T, gone=("c",))
    assert ear.wish == "number 3 is not settled"


# --- turns -----------------------------------------------------------------------------------------------------------


def test_electors_take_turns_and_a_change_that_was_lost_is_proposed_again() -> None:
    waits = []
    for revision in (7, 8, 9):
        ear = Ear(value("abc", revision=revision), replace(COURSE, leaving=("c",)))
        ear.hear("bc", 2.0)
        asked_at = [step * 0.1 for step in range(100) if ear.tick(ear.now + step * 0.1, is_busy=False) is not None]
        waits.append(round(asked_at[0]))
        assert asked_at[1] - asked_at[0] == pytest.approx(4.0), "all others have had their turn"
    assert sorted(waits) == [0, 1, 2]


@pytest.mark.parametrize(("revision", "rank"), [(9, 0), (7, 1), (8, 2)])
def test_who_has_a_later_turn_adds_an_elector_in_its_turn(revision: int, rank: int) -> None:
    """The advice tells for how long the candidate was heard: its words change every second, and it is the same."""
    ear = Ear(value("abc", revision=revision))
    ear.stagger_s = 2.0
    proposed = None
    while proposed is None and ear.now < 10 * STEADY * T:
        ear.hear("bcxy", 1.0)
        proposed = ear.tick(ear.now, is_busy=False)
    assert ear.now == 1.0 + STEADY * T + 2.0 * rank
    assert isinstance(proposed, AddElector)
    assert proposed.reason == f"x becomes an elector: heard without a break for {STEADY * T + 2.0 * rank:.0f} s"


def test_another_change_waits_for_its_turn_anew() -> None:
    ear = Ear(value("abc", revision=8))
    ear.hear("bcxy", STEADY * T + 1.0)
    turns = []
    for course in (COURSE, replace(COURSE, leaving=("c",))):
        ear.course = course
        turns.append([ear.tick(ear.now + step / 2, is_busy=False) for step in range(4)])
        ear.now += 2.0
    assert turns == [[None] * 4] * 2, "two turns of others come before it"
    assert isinstance(ear.tick(ear.now, is_busy=False), RemoveElector)


def test_a_node_without_its_seat_advises_nothing() -> None:
    ear = Ear(value("bcd"))
    ear.hear("bd", 2 * T, gone=("c",))
    assert ear.wish == "this node is no elector"
    ear.value = value("abc", electors=(Elector(name="a", disk="99"), Elector(name="b", disk="98")))
    assert ear.wish == "this node is no elector"


# --- away ------------------------------------------------------------------------------------------------------------


def away(ear: Ear) -> tuple[str, ...]:
    return ear.pilot.away(ear.value, ear.course, ear.now)


def test_a_robot_that_is_silent_for_long_is_away_and_is_back_at_its_first_beat() -> None:
    ear = Ear(value("ax"))
    ear.hear("bcdex", 2.0)
    ear.hear("cdex", 59.0)
    assert away(ear) == ()
    ear.hear("cdex", 1.0)
    assert away(ear) == ("b",), "edges and this node itself are never away"
    ear.value = value("ax", away=("b",))
    ear.hear("bcdex", 1.0)
    assert away(ear) == ()


def test_who_is_away_already_is_so_until_it_is_heard() -> None:
    ear = Ear(value("ax", away=("b",)))
    ear.hear("cdex", 1.0)
    assert away(ear) == ("b",), "although this node listens since a second only"


@pytest.mark.parametrize(
    ("before", "said", "wish"),
    [
        ((), ((), ("c",)), "c away"),
        ((), ((), ()), ""),
        (("c",), (("c",), ()), ""),
        (("c",), ((), ()), "c back"),
        (("b", "c"), (("c",), ("c",)), "b back"),
    ],
)
def test_away_and_back_need_a_majority_of_the_electors(
    before: tuple[str, ...], said: tuple[tuple[str, ...], ...], wish: str
) -> None:
    """The electors are a, which misses c alone, and x and y, which say this."""
    ear = Ear(value("axy", away=before), replace(COURSE, is_auto=False))
    ear.hear("bdexy", COURSE.away_s)
    for name, names in zip("xy", said, strict=True):
        ear.say(name, away=names)
    change = ear.pilot.advise(ear.value, ear.course, ear.now).change
    told = change.reason if isinstance(change, SetAway) else ""
    assert told.removeprefix("robots that do not vote: ") == wish


def test_one_of_three_electors_does_not_call_a_robot_back() -> None:
    ear = Ear(value("axy", away=("c",)), replace(COURSE, is_auto=False))
    ear.hear("bdex", COURSE.away_s)
    assert ear.wish == "the operator has named the electors", "this one misses it, x does not, y is silent"
    ear.hear("bdexy", 1.0)
    assert ear.wish == "away "


def test_robots_are_marked_on_an_unsettled_value_too() -> None:
    ear = Ear(value("a", settled=False))
    ear.hear("cde", COURSE.away_s)
    assert ear.wish == "away b"
    changed = ear.pilot.advise(ear.value, ear.course, ear.now).change
    assert changed is not None
    after = changed.apply(ear.value)
    assert (after.away, after.revision, after.number, after.settled) == (("b",), 8, 3, False)
    assert changed.apply(after) == after
