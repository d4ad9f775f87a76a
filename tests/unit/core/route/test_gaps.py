"""Gaps of output streams out of the relay's counts."""

from __future__ import annotations

from zsched.core.route.gaps import GAP_WINDOW_S, StreamGaps
from zsched.core.values.plan import StreamCount

STREAM = "echo/out/0"


def counted(gap_s: float | None = None, move_gap_s: float | None = None, epoch: int = 0) -> StreamCount:
    return StreamCount(stream=STREAM, gap_s=gap_s, move_gap_s=move_gap_s, move_epoch=epoch)


def test_the_longest_gap_of_the_last_seconds_is_told_until_it_is_too_old() -> None:
    gaps = StreamGaps()
    gaps.absorb([counted(0.2)], 100.0)
    gaps.absorb([counted(0.9)], 101.0)
    gaps.absorb([counted()], 102.0)
    gaps.absorb([counted(0.1)], 103.0)
    assert gaps.of(STREAM, 103.0) == 0.9
    assert gaps.of(STREAM, 101.0 + GAP_WINDOW_S) == 0.1, "the longest one has ended too long ago"
    assert gaps.of(STREAM, 103.0 + GAP_WINDOW_S) is None
    assert gaps.of("echo/out/1", 103.0) is None


def test_gaps_that_are_too_old_take_no_memory() -> None:
    gaps = StreamGaps()
    for number in range(50):
        gaps.absorb([counted(0.2)], 100.0 + number)
    assert len(gaps._gaps[STREAM]) == GAP_WINDOW_S


def test_the_gap_of_a_move_is_news_once() -> None:
    gaps = StreamGaps()
    assert gaps.absorb([counted(0.1)], 100.0) == ()
    first = counted(0.1, 0.4, 2)
    assert gaps.absorb([first], 101.0) == (first,)
    assert gaps.absorb([first], 102.0) == ()
    second = counted(0.1, 0.3, 3)
    assert gaps.absorb([second], 103.0) == (second,)
