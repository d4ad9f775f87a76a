"""Each rule of `zsched.core.membership.peers`, with a clock that the tests hold."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from random import Random

import pytest

from support.beats import beat_of
from support.fleets import fleet_of
from zsched.config.timing import WAN, WIFI, WIRED
from zsched.core.membership.peers import LOSS_FACTOR, LOSSY_S, MAX_LAG_FACTOR, NEW_TIMES, Membership
from zsched.core.values.fleet import Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, PeerState

SMALL = ("me", "a", "b")
LARGE = ("me", "a", "b", "c")
ALIVE, SUSPECT, GONE, UNKNOWN = PeerState.ALIVE, PeerState.SUSPECT, PeerState.GONE, PeerState.UNKNOWN


class Ear:
    """A membership and the peers that beat into it."""

    def __init__(self, nodes: tuple[NodeId, ...], timing: Timing = WIFI) -> None:
        self.members = Membership("me", InForce(replace(fleet_of(of=nodes, electors=nodes), timing=timing)))
        self.timing = timing
        self.sequence = 0

    def beat(
        self, node: NodeId, now: float, *, incarnation: int = 1, suspects: tuple[NodeId, ...] = (), sequence: int = -1
    ) -> list[PeerState]:
        self.sequence += 1
        beat = beat_of(node, self.sequence if sequence < 0 else sequence, incarnation=incarnation, suspects=suspects)
        return [change.after for change in self.members.absorb_beat(beat, now)]

    def run(
        self, start: float, end: float, beating: tuple[NodeId, ...], suspects: tuple[NodeId, ...] = ()
    ) -> list[tuple[float, NodeId, PeerState]]:
        """Beats of ``beating`` at their period, a tick at each and at every deadline; (time, node, state) changes."""
        seen: list[tuple[float, NodeId, PeerState]] = []
        beats = [start + i * self.timing.beat_s for i in range(int((end - start) / self.timing.beat_s + 1e-9) + 1)]
        now = start
        while now < end:
            while beats and beats[0] <= now:
                for node in beating:
                    seen += [(now, node, state) for state in self.beat(node, now, suspects=suspects)]
                beats.pop(0)
            seen += [(now, change.node, change.after) for change in self.members.tick(now)]
            assert self.members.next_deadline() > now, "a deadline that tick does not serve spins the loop"
            now = min(self.members.next_deadline(), beats[0] if beats else end, end)
        return seen


def heard(nodes: tuple[NodeId, ...], timing: Timing = WIFI) -> Ear:
    """Everybody has just beaten, at time 0, and we have listened for long enough."""
    ear = Ear(nodes, timing)
    ear.members.tick(-60.0)
    for node in nodes[1:]:
        ear.beat(node, 0.0)
    return ear


def gone_at(seen: list[tuple[float, NodeId, PeerState]], node: NodeId) -> float | None:
    return next((at for at, name, state in seen if name == node and state is GONE), None)


def test_a_beat_tells_who_else_is_missed_and_not_that_time_is_up() -> None:
    """Behind it the suspect's own beat may wait: its time is judged by a tick, when all have been heard."""
    ear = heard(SMALL)
    ear.members.absorb_token_lost("a", 1, 0.1)
    assert ear.beat("b", 1.0) == []
    assert ear.members.state("a") is SUSPECT
    assert ear.beat("a", 1.0) == [ALIVE]
    ear.members.absorb_token_lost("a", 1, 1.1)
    assert ear.beat("b", 1.2, suspects=("a",)) == [GONE]


def test_a_token_that_goes_does_not_tell_that_another_one_s_time_is_up() -> None:
    ear = heard(LARGE)
    ear.members.absorb_token_lost("a", 1, 0.1)
    assert [change.node for change in ear.members.absorb_token_lost("b", 1, 1.0)] == ["b"]
    assert ear.members.state("a") is SUSPECT
    assert gone_at([(1.0, one.node, one.after) for one in ear.members.tick(1.0)], "a") == 1.0


# --- hearing ---------------------------------------------------------------------------------------------------------


def test_stranger_is_nobody() -> None:
    ear = Ear(SMALL)
    assert ear.beat("stranger", 0.0) == []
    assert ear.members.state("stranger") is UNKNOWN
    assert ear.members.absorb_token_lost("stranger", 1, 0.0) == ()


def test_own_beat_changes_nothing() -> None:
    ear = Ear(SMALL)
    assert ear.beat("me", 0.0) == []
    assert ear.members.state("me") is ALIVE


@pytest.mark.parametrize(("incarnation", "sequence"), [(1, 5), (1, 4), (0, 99)])
def test_repeated_older_or_former_beats_are_ignored(incarnation: int, sequence: int) -> None:
    ear = Ear(SMALL)
    ear.beat("a", 0.0, sequence=5)
    assert ear.beat("a", 1.0, incarnation=incarnation, sequence=sequence) == []
    (change,) = ear.members.tick(WIFI.suspect_s)[:1]  # the ignored beat did not prolong anything
    assert (change.node, change.after) == ("a", SUSPECT)


def test_old_beat_does_not_bring_a_gone_peer_back() -> None:
    ear = heard(SMALL)
    ear.members.tick(5.0)
    assert ear.members.state("a") is GONE
    assert ear.beat("a", 5.1, sequence=1) == []
    assert ear.members.state("a") is GONE


@pytest.mark.parametrize("state", [ALIVE, GONE])
def test_restart_with_a_higher_incarnation_counts_from_its_first_beat(state: PeerState) -> None:
    ear = heard(SMALL)
    now = 0.5 if state is ALIVE else 9.0
    ear.members.tick(now)
    assert ear.members.state("a") is state
    assert ear.beat("a", now, incarnation=2, sequence=0) == [ALIVE]
    assert ear.members.incarnation("a") == 2


FORGED = {"far ahead": (1, 10**9), "another life": (10**12, 1), "a little ahead": (1, 10), "a former life": (0, 9)}


@pytest.mark.parametrize("timing", [WIRED, WIFI, WAN])
@pytest.mark.parametrize(("incarnation", "sequence"), FORGED.values(), ids=list(FORGED))
def test_one_forged_beat_costs_its_node_nothing(timing: Timing, incarnation: int, sequence: int) -> None:
    """Whatever number it has, the real beats go on being heard, and nobody is suspected meanwhile."""
    ear = Ear(SMALL, timing)
    for step in range(4):
        ear.beat("a", step * timing.beat_s, sequence=step)
        ear.beat("b", step * timing.beat_s)
    at = 3.5 * timing.beat_s
    ear.beat("a", at, incarnation=incarnation, sequence=sequence)
    assert ear.members.is_doubtful("a") is (sequence != 10)
    for step in range(4, 40):
        now = step * timing.beat_s
        ear.beat("b", now)
        assert ear.beat("a", now, sequence=step) == []
        assert ear.members.tick(now) == ()
    assert not ear.members.is_doubtful("a")
    assert (ear.members.state("a"), ear.members.incarnation("a")) == (ALIVE, 1)


def test_a_course_that_others_interrupt_is_not_believed() -> None:
    """While the known course goes on, no number of forged beats takes its place."""
    ear = Ear(SMALL)
    for step in range(60):
        now = step * WIFI.beat_s
        ear.beat("a", now, sequence=step)
        ear.beat("a", now + 0.01, incarnation=9, sequence=1000 + step)
        assert ear.members.is_doubtful("a")
    assert ear.members.incarnation("a") == 1


def test_a_restart_that_nobody_saw_go_is_believed_with_its_third_beat() -> None:
    ear = heard(SMALL)
    for step, order in enumerate((True, True, False)):
        ear.beat("a", 0.1 + step / 100, incarnation=2, sequence=step)
        assert ear.members.is_doubtful("a") is order
    assert ear.members.incarnation("a") == 2


# --- silence ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("timing", [WIRED, WIFI, WAN])
def test_silence_in_a_small_fleet_is_gone_after_the_suspicion_time(timing: Timing) -> None:
    ear = heard(SMALL, timing)
    seen = ear.run(0.0, 3 * timing.suspect_s, ("b",))
    assert [(node, state) for _, node, state in seen] == [("a", SUSPECT), ("a", GONE)]
    assert seen[-1][0] == pytest.approx(timing.suspect_s)


@pytest.mark.parametrize("timing", [WIRED, WIFI, WAN])
def test_silence_confirmed_by_a_second_observer_is_gone_at_once(timing: Timing) -> None:
    ear = heard(LARGE, timing)
    ear.run(0.0, timing.suspect_s + 0.01, ("b", "c"))
    assert ear.members.state("a") is SUSPECT
    assert ear.beat("b", timing.suspect_s + 0.02, suspects=("a",)) == [GONE]


def test_observer_that_accused_first_confirms_our_own_suspicion() -> None:
    ear = heard(LARGE)
    ear.beat("b", 0.1, suspects=("a",))
    assert ear.members.state("a") is ALIVE  # one observer's word alone accuses nobody
    seen = ear.run(0.2, 2.0, ("b",), suspects=("a",))
    assert gone_at(seen, "a") == pytest.approx(WIFI.suspect_s)


def test_accuser_that_is_not_alive_itself_does_not_confirm() -> None:
    ear = heard(LARGE)
    ear.beat("b", 0.0, suspects=("a",))
    ear.run(0.0, 1.15, ("c",))
    ear.beat("a", 1.15)
    ear.beat("c", 1.2)
    ear.run(1.2, 1.3, ())
    assert ear.members.state("b") is not ALIVE
    ear.members.absorb_token_lost("a", 1, 1.3)
    assert ear.members.state("a") is SUSPECT


def test_nobody_left_to_ask_is_gone_after_the_confirmation_time() -> None:
    """The cable is pulled: all fall silent together."""
    ear = heard(LARGE)
    seen = ear.run(0.0, 5.0, ())
    gone = [(at, node) for at, node, state in seen if state is GONE]
    assert [node for _, node in gone] == ["a", "b", "c"]
    assert [at for at, _ in gone] == [pytest.approx(WIFI.suspect_s + WIFI.confirm_s)] * 3


def test_refutation_within_the_confirmation_time() -> None:
    ear = heard(LARGE)
    ear.run(0.0, WIFI.suspect_s + 0.1, ("b", "c"))
    assert ear.members.suspects() == ("a",)
    assert ear.beat("a", WIFI.suspect_s + 0.1) == [ALIVE]
    assert ear.members.suspects() == ()


def test_refutation_wins_over_standing_accusations() -> None:
    ear = heard(LARGE)
    ear.beat("b", 0.1, suspects=("a",))
    ear.beat("c", 0.1, suspects=("a",))
    assert ear.beat("a", 0.2) == []
    assert ear.members.state("a") is ALIVE


# --- the partial cut -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("timing", [WIRED, WIFI, WAN])
def test_peer_that_others_still_hear_stays_suspect(timing: Timing) -> None:
    ear = heard(LARGE, timing)
    seen = ear.run(0.0, 20 * timing.suspect_s, ("b", "c"))
    assert [(node, state) for _, node, state in seen] == [("a", SUSPECT)]


def test_suspicion_is_young_until_it_is_confirmed_refuted_or_somebody_vouches() -> None:
    ear = heard(LARGE)
    assert ear.members.in_grace() == frozenset()
    ear.members.absorb_token_lost("a", 1, 0.1)
    assert ear.members.in_grace() == {"a"}
    ear.beat("a", 0.2)
    assert ear.members.in_grace() == frozenset()
    ear.members.absorb_token_lost("a", 1, 0.3)
    young_until = 0.3 + WIFI.confirm_s
    ear.run(0.3, young_until - 0.001, ("b", "c"))
    assert ear.members.in_grace() == {"a"}
    ear.run(young_until, young_until + WIFI.beat_s, ("b", "c"))
    assert ear.members.state("a") is SUSPECT, "others hear it"
    assert ear.members.in_grace() == frozenset(), "but we had our time to"


def test_voucher_that_loses_some_beats_still_vouches() -> None:
    ear = heard(LARGE)
    rng, now = Random(3), 0.0
    while now < 60.0:
        now += 0.2
        if rng.random() > 0.3 or now % 1.0 < 0.2:
            ear.beat("b", now)
        ear.members.tick(now)
    assert ear.members.state("a") is SUSPECT


def test_voucher_that_falls_silent_vouches_no_more() -> None:
    ear = heard(LARGE)
    ear.run(0.0, 3.0, ("b", "c"))
    assert ear.members.state("a") is SUSPECT
    seen = ear.run(3.0, 6.0, ())
    assert {node for _, node, state in seen if state is GONE} == {"a", "b", "c"}


def test_voucher_that_changes_its_mind_confirms() -> None:
    ear = heard(LARGE)
    ear.run(0.0, 3.0, ("b", "c"))
    assert ear.beat("c", 3.1, suspects=("a",)) == [GONE]


def all_gone(nodes: tuple[NodeId, ...]) -> tuple[Ear, float]:
    """We were cut off from everybody; it is so long after the last beat."""
    ear = heard(nodes)
    now = WIFI.suspect_s + WIFI.confirm_s + 1.0
    ear.run(0.0, now, ())
    assert ear.members.alive() == ()
    return ear, now


@pytest.mark.parametrize("nodes", [SMALL, LARGE])
def test_who_comes_back_first_after_a_cut_speaks_for_whom_it_hears(nodes: tuple[NodeId, ...]) -> None:
    """The owner behind the same cut is not gone: its link only comes up a moment later."""
    ear, now = all_gone(nodes)
    assert ear.beat("a", now) == [ALIVE, *[SUSPECT] * (len(nodes) - 2)]
    ear.run(now, now + WIFI.suspect_s - 0.01, ("a",))
    assert ear.members.state("b") is SUSPECT
    assert ear.beat("b", now + WIFI.suspect_s) == [ALIVE]


def test_who_comes_back_first_and_misses_a_peer_too_leaves_it_gone() -> None:
    ear, now = all_gone(LARGE)
    assert ear.beat("a", now, suspects=("b",)) == [ALIVE, SUSPECT]
    assert ear.members.state("b") is GONE
    assert ear.beat("c", now) == [ALIVE]
    assert ear.members.state("b") is GONE, "c has not noticed yet, but a has"


def test_who_was_restarted_speaks_for_nobody() -> None:
    """It accuses nobody because it is new, not because it hears everybody."""
    ear, now = all_gone(LARGE)
    assert ear.beat("a", now, incarnation=2) == [ALIVE]


def test_word_for_a_peer_that_is_dead_holds_only_until_the_speaker_misses_it() -> None:
    ear, now = all_gone(LARGE)
    ear.beat("a", now)
    assert ear.beat("a", now + 0.1, suspects=("b",)) == [GONE]


def test_observer_that_never_heard_a_peer_excuses_it_only_while_it_is_new() -> None:
    """Else a robot that starts after a machine died would vouch for the dead for ever."""
    ear = Ear(LARGE)
    ear.members.tick(0.0)
    ear.beat("b", 0.0)
    ear.members.tick(WIFI.suspect_s - 0.01)
    assert ear.members.suspects() == ()
    ear.beat("b", 1.1)
    ear.members.tick(WIFI.suspect_s)
    assert ear.members.suspects() == ("a", "c")


def test_a_node_misses_another_one_once_it_has_told_so_for_as_long_as_that_may_be_refuted() -> None:
    ear = heard(LARGE)
    ear.beat("b", 0.1, suspects=("a",))
    ear.beat("b", 0.1 + WIFI.confirm_s / 2, suspects=("a",))
    missed = partial(ear.members.misses, "b", "a", for_s=WIFI.confirm_s)
    assert ear.members.misses("b", "a", 0.1, 0.0)
    assert not missed(0.1 + WIFI.confirm_s - 0.01)
    assert missed(0.1 + WIFI.confirm_s)
    assert not ear.members.misses("a", "b", 0.1 + WIFI.confirm_s, 0.0), "the other way is another one"
    ear.beat("b", 0.5)
    ear.beat("b", 0.6, suspects=("a",))
    assert not missed(0.6 + WIFI.confirm_s - 0.01), "it has heard it meanwhile"


def test_what_this_node_misses_itself_counts_by_the_same_time() -> None:
    ear = heard(LARGE)
    ear.run(0.0, WIFI.suspect_s, ("b", "c"))
    me = "me"
    assert [ear.members.misses(me, name, WIFI.suspect_s, 0.0) for name in ("a", "b", me)] == [False] * 3
    ear.members.tick(WIFI.suspect_s)
    assert not ear.members.misses(me, "a", WIFI.suspect_s + 0.1, WIFI.confirm_s)
    assert ear.members.misses(me, "a", WIFI.suspect_s + WIFI.confirm_s, WIFI.confirm_s)
    assert not ear.members.misses("a", "b", 1e6, 0.0), "who is not heard says nothing"


def test_a_peer_that_has_just_started_still_misses_whom_it_missed_in_its_life_before() -> None:
    """It accuses nobody because it is new: an owner whom it does not hear would get its task back for a moment."""
    ear = heard(LARGE)
    ear.beat("b", 0.1, suspects=("a",))
    ear.beat("b", 5.0, incarnation=2)
    until = 5.0 + NEW_TIMES * WIFI.suspect_s
    assert ear.members.misses("b", "a", until - 0.1, WIFI.confirm_s)
    assert not ear.members.misses("b", "a", until, WIFI.confirm_s)
    assert not ear.members.misses("b", "c", 5.1, 0.0)


# --- the token: fast path of a kill ----------------------------------------------------------------------------------


def test_killed_peer_is_suspect_at_once_and_gone_with_the_second_observer() -> None:
    ear = heard(LARGE)
    (change,) = ear.members.absorb_token_lost("a", 1, 0.05)
    assert (change.before, change.after, change.reason) == (ALIVE, SUSPECT, "its token went")
    assert ear.beat("b", 0.06, suspects=("a",)) == [GONE]


def test_killed_peer_of_three_is_gone_with_the_second_observer_too() -> None:
    ear = heard(SMALL)
    (change,) = ear.members.absorb_token_lost("a", 1, 0.05)
    assert change.after is SUSPECT
    assert ear.beat("b", 0.06, suspects=("a",)) == [GONE]


def test_killed_peer_in_a_small_fleet_is_gone_after_one_and_a_half_beats() -> None:
    ear = heard(SMALL)
    ear.members.absorb_token_lost("a", 1, 0.05)
    seen = ear.run(0.05, 2.0, ("b",))
    assert gone_at(seen, "a") == pytest.approx(0.05 + 1.5 * WIFI.beat_s)


@pytest.mark.parametrize("nodes", [SMALL, LARGE])
def test_lost_token_is_refuted_by_a_beat(nodes: tuple[NodeId, ...]) -> None:
    """The link broke and came back, the process lives."""
    ear = heard(nodes)
    ear.members.absorb_token_lost("a", 1, 0.05)
    assert ear.beat("a", 0.2) == [ALIVE]
    seen = ear.run(0.2, 1.3, nodes[1:])
    assert seen == []


@pytest.mark.parametrize("node", LARGE[1:])
def test_token_that_goes_just_after_its_node_came_back_is_the_old_link_s(node: str) -> None:
    """In every heal of a cut the beats came first, and some ten milliseconds later the old link's token went.

    The first to be heard again was gone; for the others it has spoken, so they are suspects when they beat.
    """
    ear, now = all_gone(LARGE)
    for heard_again in LARGE[1:]:
        ear.beat(heard_again, now)
    assert ear.members.absorb_token_lost(node, 1, now + 0.03) == ()
    assert ear.members.state(node) is ALIVE
    later = now + WIFI.control_lease_s
    ear.run(now, later, LARGE[1:])
    (change,) = ear.members.absorb_token_lost(node, 1, later)
    assert change.after is SUSPECT


def test_token_of_a_restarted_peer_is_believed_at_once() -> None:
    ear, now = all_gone(LARGE)
    for node in LARGE[1:]:
        ear.beat(node, now, incarnation=2)
    (change,) = ear.members.absorb_token_lost("a", 2, now + 0.03)
    assert change.after is SUSPECT


def test_token_of_a_former_life_accuses_nobody() -> None:
    ear = heard(SMALL)
    ear.beat("a", 0.5, incarnation=2, sequence=0)
    assert ear.members.absorb_token_lost("a", 1, 0.6) == ()
    assert ear.members.state("a") is ALIVE


# --- self-doubt ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lag", "factor"), [(0.0, 1.0), (0.1, 1.5), (0.2, 2.0), (0.4, MAX_LAG_FACTOR), (1000.0, MAX_LAG_FACTOR)]
)
def test_lagging_node_doubts_itself_up_to_threefold(lag: float, factor: float) -> None:
    ear = heard(LARGE)
    ear.members.note_lag(lag)
    assert ear.members.next_deadline() == pytest.approx(factor * WIFI.suspect_s)
    seen = ear.run(0.0, 20.0, ())
    assert seen[0][0] == pytest.approx(factor * WIFI.suspect_s)
    assert gone_at(seen, "a") == pytest.approx(factor * (WIFI.suspect_s + WIFI.confirm_s))


def test_doubt_fades_by_halves_and_never_below_trust() -> None:
    ear = heard(LARGE)
    ear.members.note_lag(0.4)
    limits = []
    for _ in range(12):
        ear.members.fade_lag_factor()
        limits.append(ear.members.next_deadline() / WIFI.suspect_s)
    assert limits[:2] == [pytest.approx(2.0), pytest.approx(1.5)]
    assert limits[-1] == pytest.approx(1.0, abs=1e-3)
    assert min(limits) >= 1.0


def test_doubt_lengthens_the_grace_of_who_is_suspect_already() -> None:
    ear = heard(LARGE)
    ear.run(0.0, WIFI.suspect_s + 0.01, ())
    ear.members.note_lag(1.0)
    assert ear.members.next_deadline() == pytest.approx(WIFI.suspect_s + 3 * WIFI.confirm_s)


# --- never stuck -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nodes", [("me", "a"), SMALL, LARGE, ("me", "a", "b", "c", "d", "e")])
def test_random_beats_cuts_and_kills_end_where_the_truth_is(nodes: tuple[NodeId, ...]) -> None:
    """Whatever came before: who is dead is gone in the end, who beats is alive, and no deadline is ever in the past."""
    for seed in range(40):
        rng = Random(seed)
        ear = Ear(nodes, replace(rng.choice((WIRED, WIFI, WAN))))
        now = 0.0
        for _ in range(60):
            now += rng.uniform(0.0, ear.timing.suspect_s / 2)
            peer = rng.choice(nodes[1:])
            action = rng.random()
            if action < 0.6:
                ear.beat(peer, now, suspects=tuple(n for n in nodes if rng.random() < 0.1))
            elif action < 0.7:
                ear.members.absorb_token_lost(peer, 1, now)
            elif action < 0.8:
                ear.members.note_lag(rng.uniform(0.0, 1.0))
            ear.members.tick(now)
        dead = set(nodes[1 + len(nodes) // 2 :]) | {nodes[1]}
        living = tuple(n for n in nodes[1:] if n not in dead)
        ear.members.fade_lag_factor()
        ear.run(now, now + 6 * ear.timing.suspect_s, living, suspects=tuple(sorted(dead)))
        states = ear.members.states()
        assert all(states[n] in (GONE, UNKNOWN) for n in dead), f"seed {seed}: {states}"
        assert all(states[n] is ALIVE for n in living), f"seed {seed}: {states}"


def test_deadline_reached_exactly_is_served() -> None:
    """A virtual clock jumps to the deadline itself: rounding must not leave it unserved (else the loop spins)."""
    for seed in range(2000):
        ear = Ear(SMALL)
        ear.beat("a", Random(seed).uniform(0.0, 1e6))
        now = ear.members.next_deadline()
        assert [change.node for change in ear.members.tick(now)][:1] == ["a"]


def test_somebody_is_missed_as_long_as_one_peer_is_not_alive() -> None:
    ear = Ear(("me", "a", "b"))
    seen = [ear.members.misses_anybody]
    for node in ("a", "b"):
        ear.beat(node, 0.0)
        seen.append(ear.members.misses_anybody)
    assert seen == [True, True, False]
    ear.run(0.0, 5.0, ("a",))
    assert ear.members.state("b") is GONE
    assert [ear.members.misses_anybody] == [True]


def test_a_restart_of_the_very_first_life_refutes_the_end_of_its_token_at_once() -> None:
    """A beat of the same life may have been on its way when the token went; one of the next life was not."""
    for incarnation, expected in ((0, []), (1, [ALIVE])):
        ear = Ear(SMALL)
        ear.members.tick(-60.0)
        ear.beat("b", 0.0)
        ear.beat("a", 0.0, incarnation=0)
        ear.members.absorb_token_lost("a", 0, 0.01)
        assert ear.members.state("a") is SUSPECT
        assert ear.beat("a", 0.02, incarnation=incarnation) == expected


# --- the pace of beats ------------------------------------------------------------------------------------------------


def calm_ear() -> Ear:
    """Everybody's newest beat, number 2, was calm, at time 0."""
    ear = Ear(LARGE)
    ear.members.tick(-60.0)
    for node in ("a", "b", "c"):
        ear.members.absorb_beat(beat_of(node, 1, calm=True), -0.4)
        ear.members.absorb_beat(beat_of(node, 2, calm=True), 0.0)
    return ear


def test_a_fleet_is_calm_when_every_living_peer_says_so() -> None:
    ear = calm_ear()
    found = [ear.members.are_calm]
    for sequence, is_calm in ((3, False), (4, True)):
        ear.members.absorb_beat(beat_of("b", sequence, calm=is_calm), 0.4 * (sequence - 2))
        found.append(ear.members.are_calm)
    assert found == [True, False, True]
    assert not ear.members.is_uneasy(0.8)


def test_a_missing_beat_is_uneasy_until_the_next_one_comes_in_order() -> None:
    ear = calm_ear()
    ear.members.absorb_beat(beat_of("c", 4, calm=True), 0.4)
    assert ear.members.is_uneasy(0.4)
    ear.members.absorb_beat(beat_of("c", 5, calm=True), 0.8)
    assert not ear.members.is_uneasy(0.8)


@pytest.mark.parametrize(("calm", "late_s"), [(True, 1.0), (False, 0.5)])
def test_a_late_beat_is_uneasy_by_the_pace_that_its_sender_has_told(calm: bool, late_s: float) -> None:
    ear = heard(("me", "a"))
    ear.members.absorb_beat(beat_of("a", ear.sequence + 1, calm=calm), 0.0)
    assert not ear.members.is_uneasy(late_s - 0.01)
    assert ear.members.is_uneasy(late_s)


def test_a_lagging_loop_is_uneasy() -> None:
    ear = calm_ear()
    ear.members.note_lag(0.05)
    assert ear.members.is_uneasy(0.1)
    for _ in range(3):
        ear.members.fade_lag_factor()
    assert not ear.members.is_uneasy(0.1)


@pytest.mark.parametrize("calm", [True, False])
def test_another_life_begins_once_two_beats_of_the_pace_are_missing(calm: bool) -> None:
    ear = heard(LARGE)
    ear.members.absorb_beat(beat_of("a", 9, calm=calm), 0.0)
    period_s = WIFI.rest_beat_s if calm else WIFI.beat_s
    ear.members.absorb_beat(beat_of("a", 1, incarnation=2), 2 * period_s - 0.01)
    assert ear.members.incarnation("a") == 1
    ear.members.absorb_beat(beat_of("a", 2, incarnation=2), 2 * period_s + 0.01)
    assert ear.members.incarnation("a") == 2


# --- links that lose packets -----------------------------------------------------------------------------------------


def hold_up(ear: Ear, node: NodeId, now: float, *, silent_s: float, missing: int = 0, lag_s: float = 0.0) -> float:
    """The node beats at ``now``, and next after this silence, of which ``lag_s`` was its own; the time of that."""
    for at, lag in ((now, 0.0), (now + silent_s, lag_s)):
        ear.sequence += 1 + (missing if at > now else 0)
        ear.members.absorb_beat(replace(beat_of(node, ear.sequence), loop_lag_s=lag), at)
    return now + silent_s


def silence_before_suspicion(ear: Ear, node: NodeId, now: float) -> float:
    """How long ``node`` may be silent after a beat at ``now``."""
    ear.beat(node, now)
    seen = ear.run(now + 0.01, now + 5.0, ())
    return round(next(at for at, name, state in seen if name == node and state is SUSPECT) - now, 6)


def test_beats_that_are_held_up_twice_lengthen_the_silence_that_counts() -> None:
    ear = heard(LARGE)
    at = hold_up(ear, "a", 10.0, silent_s=0.7)
    at = hold_up(ear, "b", at + 5.0, silent_s=0.7)
    assert silence_before_suspicion(ear, "c", at) == pytest.approx(LOSS_FACTOR * WIFI.suspect_s)


def test_one_moment_that_holds_several_up_changes_nothing() -> None:
    ear = heard(LARGE)
    for node in ("a", "b"):
        at = hold_up(ear, node, 10.0, silent_s=0.7)
    assert silence_before_suspicion(ear, "c", at) == pytest.approx(WIFI.suspect_s)


@pytest.mark.parametrize(
    "what", [{"silent_s": 0.5}, {"silent_s": 2.6}, {"silent_s": 0.7, "missing": 1}, {"silent_s": 0.7, "lag_s": 0.4}]
)
def test_what_is_no_loss_on_the_way_changes_nothing(what: dict[str, float]) -> None:
    """A beat in its time, a cut, a beat that never came, a sender that slept."""
    ear = heard(LARGE)
    at = 10.0
    for node in ("a", "b", "a"):
        at = hold_up(ear, node, at + 3.0, **what)  # type: ignore[arg-type]  # the keywords of the table
    assert silence_before_suspicion(ear, "c", at) == pytest.approx(WIFI.suspect_s)


def test_own_lag_is_not_taken_for_loss() -> None:
    ear = heard(LARGE)
    at = 10.0
    for node in ("a", "b"):
        ear.members.note_lag(0.3)
        at = hold_up(ear, node, at + 3.0, silent_s=0.7)
    for _ in range(20):
        ear.members.fade_lag_factor()
    assert silence_before_suspicion(ear, "c", at) == pytest.approx(WIFI.suspect_s, abs=0.01)


def test_the_longer_silence_ends_with_the_losses() -> None:
    ear = heard(LARGE)
    at = hold_up(ear, "a", 10.0, silent_s=0.7)
    at = hold_up(ear, "b", at + 5.0, silent_s=0.7)
    assert silence_before_suspicion(ear, "c", at + LOSSY_S - 1.5) == pytest.approx(1.5)
    ear = heard(LARGE)
    at = hold_up(ear, "a", 10.0, silent_s=0.7)
    at = hold_up(ear, "b", at + 5.0, silent_s=0.7)
    assert silence_before_suspicion(ear, "c", at + LOSSY_S) == pytest.approx(WIFI.suspect_s)
