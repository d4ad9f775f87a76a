"""PROFILE: how long a foreign worker's answers take, as this robot's relay measures them.

Knows: the counters of the relay's outputs, the owner that they come from. Does not know: streams, what a job needs of a
machine (`zsched.core.gateway.heard`).

A worker without the library tells nothing of its jobs, so nobody but the robots can say how long they take. An answer
counts that carries its input's timestamp. Any other one is at least as old as the newest input before it, which says
the less the faster inputs come: it is shown and decides nothing.

The robot's own way to the owner and back is taken off: it is another one for every candidate, and counts apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from zsched.core.profile.means import STALE_S, Ewma
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import MAX_JOB_S, MAX_JOBS_HZ, AnswerTime

SMOOTHING_S = 2.0
"""Time constant: the relay counts once a second."""


@dataclass(slots=True)
class _Seen:
    """The answers of one task's owner."""

    owner: NodeId
    age_s: Ewma
    hz: Ewma
    at: float


class Answers:
    """This robot's view of the tasks whose answers count."""

    def __init__(self) -> None:
        self._seen: dict[TaskId, _Seen] = {}

    def absorb(
        self,
        owners: Mapping[TaskId, NodeId],
        counts: tuple[StreamCount, ...],
        round_trips: Mapping[NodeId, float],
        now: float,
    ) -> None:
        """Take the relay's newest counters in.

        Args:
            owners: {task whose answers count: whose they are}; what was seen of others is forgotten.
            counts: of all streams.
            round_trips: {node: seconds there and back}, where measured; this node is not one of them.
            now: monotonic seconds.
        """
        before, self._seen = self._seen, {}
        for task, owner in owners.items():
            seen = before.get(task)
            if seen is None or seen.owner != owner:
                seen = _Seen(owner, Ewma(SMOOTHING_S), Ewma(SMOOTHING_S), now)
            prefix = f"{task}/out/"
            paired = [
                (count.answer_s, count.paired_hz)
                for count in counts
                if count.stream.startswith(prefix) and count.answer_s is not None and count.paired_hz
            ]
            if paired:  # a job ends with the last of its answers
                away_s = round_trips.get(owner, 0.0)
                seen.age_s.update(min(max(max(age_s for age_s, _ in paired) - away_s, 0.0), MAX_JOB_S), now)
                seen.hz.update(min(max(hz for _, hz in paired), MAX_JOBS_HZ), now)
                seen.at = now
            if now - seen.at <= STALE_S:
                self._seen[task] = seen

    def told(self, now: float) -> tuple[AnswerTime, ...]:
        """What this robot's profile tells; nothing of a task whose answers have ceased."""
        return tuple(
            AnswerTime(task=task, owner=seen.owner, age_s=round(seen.age_s.value, 4), hz=round(seen.hz.value, 3))
            for task, seen in sorted(self._seen.items())
            if now - seen.at <= STALE_S and seen.age_s.value is not None and seen.hz.value is not None
        )
