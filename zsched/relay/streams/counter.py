"""Counts what one stream carried and what it dropped, with the reason.

Knows: `StreamCount`. Does not know: zenoh, routes. Its owner's lock guards it.
"""

from __future__ import annotations

from dataclasses import dataclass

from zsched.core.values.plan import STILL_S, StreamCount
from zsched.host.clock import monotonic_s
from zsched.relay.streams.tally import Tally


@dataclass(slots=True)
class _Answers:
    """Answers of one kind since the last count."""

    count: int = 0
    sum_s: float = 0.0


class StreamCounter:
    """Counters of one stream since it was opened."""

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self._messages = 0
        self._bytes = 0
        self._drops: dict[str, int] = {}
        self._last_seen: float | None = None
        self.lost = 0
        self.doubled = 0
        self.reordered = 0
        self.replayed = 0
        self.repeated = 0
        self.unsent = 0
        self._answers: tuple[_Answers, _Answers] = _Answers(), _Answers()
        """Those without their input's timestamp, and those with it."""
        self._answers_since = monotonic_s()
        self._passed_at: float | None = None
        self._passed_epoch = 0
        self._gap_s: float | None = None
        self._move_gap_s: float | None = None
        self._move_epoch = 0

    def seen(self, size: int) -> None:
        """A sample of ``size`` bytes came in."""
        self._messages += 1
        self._bytes += size
        self._last_seen = monotonic_s()

    def answered(self, took_s: float, *, is_paired: bool) -> None:
        """An answer has come, ``took_s`` after its input; ``is_paired``: it has that input's timestamp."""
        answers = self._answers[is_paired]
        answers.count += 1
        answers.sum_s += took_s

    def passed(self, epoch: int, now: float) -> None:
        """An answer of the owner of ``epoch`` went on to the applications at ``now`` (monotonic seconds)."""
        before = self._passed_at
        if before is not None:
            gap_s = max(0.0, now - before)
            if self._gap_s is None or gap_s > self._gap_s:
                self._gap_s = gap_s
            if epoch > self._passed_epoch:
                self._move_gap_s, self._move_epoch = gap_s, epoch
        self._passed_at, self._passed_epoch = now, max(epoch, self._passed_epoch)

    @property
    def is_still(self) -> bool:
        """Whether no sample has come in for `STILL_S`."""
        return self._last_seen is None or monotonic_s() - self._last_seen >= STILL_S

    @property
    def last_seen(self) -> float:
        """When the newest sample came in (monotonic seconds); now, before the first."""
        return monotonic_s() if self._last_seen is None else self._last_seen

    def dropped(self, reason: str, count: int = 1) -> None:
        """``count`` samples did not go on, because of ``reason``."""
        if count:
            self._drops[reason] = self._drops.get(reason, 0) + count

    def value(self, tally: Tally | None = None, *, has_acks: bool = False) -> StreamCount:
        """The counters now, with what became of the samples of an input; ``last_seen_s`` is an age in seconds.

        ``has_acks``: a worker has acknowledged some, or will.
        """
        said = tally or Tally()
        drops = self._drops
        if said.errors or said.uncounted:
            more = {"error": drops.get("error", 0) + said.errors, "uncounted": said.uncounted}
            drops = {**drops, **{reason: count for reason, count in more.items() if count}}
        age = None if self._last_seen is None else round(max(0.0, monotonic_s() - self._last_seen), 3)
        answer_s, paired_hz = self._take_answers(monotonic_s())
        gap_s, self._gap_s = self._gap_s, None
        return StreamCount(
            stream=self.stream,
            messages=self._messages,
            bytes=self._bytes,
            drops=tuple(sorted(drops.items())),
            last_seen_s=age,
            acknowledged=said.acknowledged if has_acks else None,
            in_flight=None if tally is None else said.in_flight + said.waiting,
            lost=self.lost + said.lost,
            doubled=self.doubled + said.doubled,
            reordered=self.reordered + said.reordered,
            replayed=self.replayed + said.resent,
            at_most_lost=said.at_most_lost,
            repeated=self.repeated,
            unsent=self.unsent,
            unconfirmed=said.unconfirmed,
            answer_s=answer_s,
            paired_hz=paired_hz,
            gap_s=None if gap_s is None else round(gap_s, 4),
            move_gap_s=None if self._move_gap_s is None else round(self._move_gap_s, 4),
            move_epoch=self._move_epoch,
        )

    def _take_answers(self, now: float) -> tuple[float | None, float | None]:
        """(mean seconds of the answers since the last time, how many a second were paired), and begin anew."""
        any_one, paired = self._answers
        elapsed_s, self._answers_since = now - self._answers_since, now
        self._answers = _Answers(), _Answers()
        told = paired if paired.count else any_one
        answer_s = round(told.sum_s / told.count, 4) if told.count else None
        return answer_s, round(paired.count / elapsed_s, 3) if paired.count and elapsed_s > 0.0 else None
