"""Decides which of the samples that an owner left open its answers prove done (`OnCrash.REPLAY`).

Knows: the timestamps of a task's inputs. Does not know: streams, slots, which answers have passed (its caller says so).

An answer has its input's timestamp. One that has passed proves little by itself: its callback may have died before it
put the next answer, and another sample may have had the same timestamp. So a sample is done when its answer has passed
and that of a later one of the same publisher as well: a worker takes those in order. The timestamp of several samples
proves nothing. Whatever is not proven is done once more.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from zenoh import Sample, Timestamp

MAX_STAMPS: Final = 8192


class LeftOpen(NamedTuple):
    """A sample that waits for the next owner."""

    sample: Sample
    stamp: Timestamp | None
    lane: int | None = None
    """The publisher that put it for an owner, ``None``: it was never sent."""


class Stamps:
    """The newest timestamps of a task's inputs, of all its streams on this node; any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._alone: OrderedDict[Timestamp, bool] = OrderedDict()
        self._floor: Timestamp | None = None
        """The newest that was forgotten: whether one below it is alone nobody knows any more."""

    def note(self, stamp: Timestamp) -> None:
        """A sample has this timestamp."""
        with self._lock:
            if stamp in self._alone:
                self._alone[stamp] = False
                return
            if self._floor is not None and not self._floor < stamp:  # type: ignore[operator] # zenoh's stubs
                return
            self._alone[stamp] = True
            if len(self._alone) > MAX_STAMPS:
                oldest, _ = self._alone.popitem(last=False)
                if self._floor is None or self._floor < oldest:  # type: ignore[operator] # zenoh's stubs
                    self._floor = oldest

    def is_alone(self, stamp: Timestamp) -> bool:
        """Whether one sample has this timestamp, and no other."""
        with self._lock:
            return self._alone.get(stamp, False)


def unproven(left: Sequence[LeftOpen], has_answer: Callable[[Timestamp], bool]) -> list[LeftOpen]:
    """What of it is to be done again; ``has_answer``: an answer of this sample, and of no other one, has passed."""
    answered: set[int] = set()
    again: list[LeftOpen] = []
    for one in reversed(left):
        is_answered = one.lane is not None and one.stamp is not None and has_answer(one.stamp)
        if not is_answered or one.lane not in answered:
            again.append(one)
        if is_answered and one.lane is not None:
            answered.add(one.lane)
    again.reverse()
    return again
