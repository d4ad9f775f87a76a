"""Decides whether the counters of an input stream account for every sample.

Knows: `StreamCount`. Does not know: relays, workers, why a sample was lost.

Every sample that came, or was given to one owner more, is somewhere: its worker processed it, it is known to be lost,
it was dropped for a reason, it is on its way (queued, or sent and not acknowledged), it was on its way to a worker that
died, or it waits for the first owner (class ``latest``)::

    messages + repeated = acknowledged + lost + drops + in flight + at most lost + unsent + unconfirmed

The last is what went to workers that acknowledge nothing; towards `zsched.worker` it is 0.

What is missing on the right was lost silently; what is too much was counted twice. Both are bugs of ours.

The books outlive who keeps them. What a relay (or an application) that has gone had counted is added to what the next
one counts; what it had in hand is at most lost, and so is what it had taken since its last count.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from zsched.core.values.plan import StreamCount
from zsched.core.values.struct import replace

_SUMS: Final = (
    *("messages", "bytes", "lost", "doubled", "reordered", "replayed"),
    *("at_most_lost", "repeated", "unsent", "unconfirmed"),
)


def unaccounted(count: StreamCount) -> int | None:
    """Samples that the counters say nothing of (below 0: counted twice); ``None``: no input.

    Counters are read while samples move; one that is in a thread's hand is accounted for, so 0 holds at any time.
    """
    if count.in_flight is None:
        return None
    known = (count.acknowledged or 0) + given_up(count) + count.unconfirmed
    return count.messages + count.repeated - known - count.in_flight - count.unsent


def given_up(count: StreamCount) -> int:
    """Samples that the counters of an input or an output call lost, perhaps lost, or dropped."""
    return count.lost + count.at_most_lost + sum(number for _, number in count.drops)


def closed(count: StreamCount) -> StreamCount:
    """What stays of the counters of somebody who has gone.

    What was in flight may be done or not; nothing is in flight any more, and nothing moves.
    """
    return replace(
        count,
        at_most_lost=count.at_most_lost + (count.in_flight or 0),
        in_flight=None if count.in_flight is None else 0,
        last_seen_s=None,
        answer_s=None,
        paired_hz=None,
        gap_s=None,
        move_gap_s=None,
        move_epoch=0,
    )


def together(first: StreamCount, other: StreamCount) -> StreamCount:
    """The counters of both; times are those of the one that has them, the first before the other.

    Times of answers are those of the one whose answers had their inputs' timestamps.
    """
    drops = dict(first.drops)
    for reason, count in other.drops:
        drops[reason] = drops.get(reason, 0) + count
    timed = min(first, other, key=lambda one: (one.paired_hz is None, one.answer_s is None))  # the first, of two alike
    return replace(
        first,
        **{name: getattr(first, name) + getattr(other, name) for name in _SUMS},
        drops=tuple(sorted(drops.items())),
        acknowledged=_both(first.acknowledged, other.acknowledged),
        in_flight=_both(first.in_flight, other.in_flight),
        last_seen_s=min((s for s in (first.last_seen_s, other.last_seen_s) if s is not None), default=None),
        answer_s=timed.answer_s,
        paired_hz=timed.paired_hz,
        gap_s=other.gap_s if first.gap_s is None else first.gap_s,
        move_gap_s=other.move_gap_s if first.move_gap_s is None else first.move_gap_s,
        move_epoch=max(first.move_epoch, other.move_epoch),
    )


def add_to(table: dict[str, StreamCount], count: StreamCount) -> None:
    """Add a stream's counters to those under its name."""
    before = table.get(count.stream)
    table[count.stream] = count if before is None else together(before, count)


def without(count: StreamCount, part: StreamCount) -> StreamCount:
    """The counters of a stream without ``part`` of what they have counted; times stay."""
    drops, less = dict(count.drops), dict(part.drops)
    left = {reason: number - less.get(reason, 0) for reason, number in drops.items()}
    return replace(
        count,
        **{name: getattr(count, name) - getattr(part, name) for name in _SUMS},
        drops=tuple(sorted((reason, number) for reason, number in left.items() if number)),
    )


def added(counts: tuple[StreamCount, ...], more: Mapping[str, StreamCount]) -> tuple[StreamCount, ...]:
    """Counters with those of others, by stream; of a stream that has gone nobody is told."""
    if not more:
        return counts
    return tuple(together(count, more[count.stream]) if count.stream in more else count for count in counts)


def _both(first: int | None, other: int | None) -> int | None:
    return None if first is None and other is None else (first or 0) + (other or 0)
