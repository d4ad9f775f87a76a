"""`zsched.core.hop.room`: a fast link's buffer grows, a thin radio's stays small, whatever else goes by it."""

from __future__ import annotations

import math

import pytest

from zsched.core.hop.room import (
    AHEAD_S,
    BACKLOG_S,
    LARGE,
    MAX_PAUSE_S,
    OWN,
    PAUSE_S,
    SLOW_TIMES,
    SMALL,
    STALE_S,
    Account,
    Room,
)

LOOK_S = 0.05
MBIT = 1e6 / 8
BOUNDLESS = 4 << 20
"""What a buffer that the kernel sizes may hold."""


class Link:
    """A link that takes ``rate`` bytes a second behind a buffer; puts wait for room."""

    def __init__(self, rate: float, round_trip_s: float = 0.0005) -> None:
        self.room = Room()
        self.rate, self.round_trip_s = rate, round_trip_s
        self.acked = self.unsent = 0.0
        self.now = 0.0
        self.sizes = [SMALL]

    @property
    def holds(self) -> float:
        return min(self.unsent, BOUNDLESS if self.room.size == OWN else self.room.size)

    def put(self, size: int) -> None:
        self.unsent += size

    def run(self, seconds: float, look_s: float = LOOK_S) -> None:
        for _ in range(round(seconds / look_s)):
            limit = BOUNDLESS if self.room.size == OWN else self.room.size
            rate = min(self.rate, limit / self.round_trip_s)
            taken = min(self.unsent, rate * look_s)
            self.unsent -= taken
            self.acked += taken
            self.now += look_s
            seen = Account(acked=int(self.acked), held=int(self.holds), round_trip_s=self.round_trip_s)
            self.sizes.append(self.room.look(seen, self.now))

    @property
    def largest(self) -> float:
        return max(math.inf if size == OWN else size for size in self.sizes)


def test_a_fast_links_buffer_grows_to_the_kernels_own_in_a_few_samples() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(6):
        link.put(1 << 20)
        link.run(0.1)
    assert link.room.size == OWN


def test_a_large_sample_now_and_then_is_enough_though_looks_are_far_apart() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(6):
        link.put(1 << 20)
        link.run(1.0, look_s=1.0)
    assert link.room.size == OWN


def test_small_samples_in_between_that_wait_for_their_acknowledgement_change_nothing() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(20):
        link.put(1 << 20)
        for _ in range(4):
            link.run(LOOK_S)
            link.put(4096)
    assert link.room.size == OWN


@pytest.mark.parametrize("mbit", [1, 5, 20])
def test_a_thin_links_buffer_stays_small_under_maps(mbit: float) -> None:
    link = Link(rate=mbit * MBIT, round_trip_s=0.002)
    link.put(64 << 20)
    link.run(10.0)
    assert link.largest == SMALL


def test_a_thin_link_that_looks_fast_for_a_moment_is_found_out_and_left_alone_for_longer_each_time() -> None:
    link = Link(rate=20 * MBIT, round_trip_s=0.002)
    larger_s = 0.0
    for _ in range(100):
        link.put(200_000)  # 80 ms of the link
        link.run(0.1)
    for _ in range(100):
        link.put(250_000)  # all that it takes, and a little more
        link.run(0.1)
        larger_s += 0.1 * (link.room.size != SMALL)
    assert link.largest <= 4 * SMALL
    assert link.room.size == SMALL
    assert larger_s < 2.0


@pytest.mark.parametrize(("mbit", "expected"), [(40, SMALL), (60, 2 * SMALL), (110, 4 * SMALL), (250, LARGE)])
def test_a_link_in_between_holds_what_it_takes_in_time(mbit: float, expected: int) -> None:
    link = Link(rate=mbit * MBIT)
    link.put(1 << 30)
    link.run(10.0)
    assert link.room.size == expected
    assert expected / link.rate <= AHEAD_S


def test_a_link_that_becomes_thin_gets_a_small_buffer_within_few_looks() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(6):
        link.put(1 << 20)
        link.run(0.1)
    assert link.room.size == OWN
    link.rate = 20 * MBIT
    link.put(4 << 20)
    link.run(LOOK_S * (SLOW_TIMES + 1))
    assert link.room.size == SMALL


def test_a_receiver_that_stands_still_gets_a_small_buffer() -> None:
    link = Link(rate=10_000 * MBIT)
    link.put(64 << 20)
    link.run(1.0)
    link.rate = 0.0
    link.put(4 << 20)
    link.run(BACKLOG_S + 3 * LOOK_S)
    assert link.room.size == SMALL


def test_pauses_make_no_buffer_smaller() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(6):
        link.put(1 << 20)
        link.run(0.1)
    for _ in range(20):  # as over TLS, where the kernel waits for an acknowledgement
        link.put(1 << 20)
        link.rate = 5e6  # it begins and ends between two looks
        link.run(LOOK_S)
        link.rate = 0.0
        link.run(0.35)
        link.rate = 5e6
        link.run(LOOK_S)
        link.rate = 10_000 * MBIT
        link.run(2 * LOOK_S)
    assert link.room.size == OWN


def test_a_link_that_takes_something_at_every_other_look_only_is_thin_all_the_same() -> None:
    link = Link(rate=10_000 * MBIT)
    for _ in range(6):
        link.put(1 << 20)
        link.run(0.1)
    link.put(8 << 20)
    for _ in range(10):
        link.rate = 0.0
        link.run(LOOK_S)
        link.rate = 1 * MBIT
        link.run(LOOK_S)
    assert link.room.size == SMALL


def test_a_long_way_gets_a_buffer_for_what_is_under_way() -> None:
    link = Link(rate=100 * MBIT, round_trip_s=0.3)
    link.put(1 << 30)
    link.run(20.0)
    assert link.room.size == OWN


@pytest.mark.parametrize(("later_s", "expected"), [(0.0, SMALL), (0.001, 2 * SMALL)])
def test_what_was_between_two_looks_is_known_for_so_long_and_two_round_trips(later_s: float, expected: int) -> None:
    """A buffer that was never empty tells how fast its link is; else the link is at least so fast."""
    room, round_trip_s = Room(), 0.25
    room.look(Account(acked=0, held=SMALL, round_trip_s=round_trip_s), 0.0)
    seen = Account(acked=2 * SMALL, held=SMALL, round_trip_s=round_trip_s)
    assert room.look(seen, STALE_S + 2 * round_trip_s + later_s) == expected


def test_a_slow_look_makes_no_buffer_smaller_but_so_many_in_succession_do_each_time_anew() -> None:
    room, seen, now = Room(), Account(acked=0, held=LARGE, round_trip_s=0.0), 0.0
    room.look(seen, now)

    def took(size: int) -> int:
        """The size after a look at a buffer that was full, on a link for which ``size`` is the right one."""
        nonlocal seen, now
        now += LOOK_S
        seen = Account(acked=seen.acked + int(1.01 * size * LOOK_S / AHEAD_S), held=LARGE, round_trip_s=0.0)
        return room.look(seen, now)

    assert took(LARGE) == LARGE, "it grows at once"
    for _ in range(2):
        assert took(LARGE) == LARGE
        for _ in range(SLOW_TIMES - 1):
            assert took(2 * SMALL) == LARGE
    assert took(2 * SMALL) == 2 * SMALL
    for _ in range(SLOW_TIMES - 1):
        assert took(SMALL) == 2 * SMALL
    assert took(SMALL) == SMALL


def test_after_it_shrank_it_grows_later_each_time_and_soon_again_once_the_link_was_fast() -> None:
    room = Room()
    now, acked = 0.0, 0

    def until_it_grows(step: int = 200_000) -> float:
        nonlocal now, acked
        began = now
        while room.size == SMALL:
            now, acked = now + LOOK_S, acked + step
            room.look(Account(acked=acked, held=0, round_trip_s=0.0), now)
        return now - began

    def shrink() -> None:
        nonlocal now, acked
        for _ in range(SLOW_TIMES + 1):
            now, acked = now + LOOK_S, acked + 1500
            room.look(Account(acked=acked, held=2 * SMALL, round_trip_s=0.0), now)
        assert room.size == SMALL

    until_it_grows()
    pauses = []
    for _ in range(8):
        shrink()
        pauses.append(until_it_grows())
    expected = [min(PAUSE_S * 2**count, MAX_PAUSE_S) for count in range(8)]
    assert pauses == pytest.approx(expected, abs=2 * LOOK_S)
    while room.size != OWN:
        now, acked = now + LOOK_S, acked + (4 << 20)
        room.look(Account(acked=acked, held=0, round_trip_s=0.0), now)
    shrink()
    assert until_it_grows() < 2 * PAUSE_S


@pytest.mark.parametrize(("later_s", "expected"), [(-0.01, LARGE), (0.01, SMALL)])
def test_a_long_way_that_takes_nothing_is_given_two_round_trips_more(later_s: float, expected: int) -> None:
    room, round_trip_s = Room(), 0.25
    for now, acked in ((0.0, 0), (0.5, LARGE), (1.0, LARGE)):
        room.look(Account(acked=acked, held=LARGE, round_trip_s=round_trip_s), now)
    full_since = 0.5
    assert room.size == LARGE
    seen = Account(acked=LARGE, held=LARGE, round_trip_s=round_trip_s)
    assert room.look(seen, full_since + BACKLOG_S + 2 * round_trip_s + later_s) == expected
