"""PROFILE: how long a foreign worker's answers take, as this robot's relay measures them.

Knows: the counters of the relay's outputs, the owner that they come from. Does not know: streams, what a job needs of a
machine (`zsched.core.gateway.job_need`).

A worker without the library tells nothing of its jobs, so nobody but the robots can say how long they take. An answer
counts that carries its input's timestamp. Any other one is at least as old as the newest input before it, which says
the less the faster inputs come: it is shown and decides nothing.

The robot's own way to the owner and back is taken off: it is another one for every candidate, and counts apart.

They are counted, as the owner counts what its worker uses (`WorkerLoad.spent_s`): the quotient of what both sums have
risen by is the CPU time of an answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from zsched.core.profile.means import STALE_S, Ewma
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import MAX_JOB_S, MAX_JOBS_HZ, AnswerTime

SMOOTHING_S = 2.0
"""Time constant of their age: the relay counts once a second."""
STALE_GAPS, MAX_STALE_S = 3.0, 60.0
"""After so many times as long as answers come apart, and after the second at the latest, their age counts no more."""


@dataclass(slots=True)
class _Seen:
    """The answers of one task's owner."""

    owner: NodeId
    at: float
    """When they were counted last..."""
    answered_at: float
    """...and when there was one."""
    until: float
    """When their age counts no more."""
    age_s: Ewma = field(default_factory=lambda: Ewma(SMOOTHING_S))
    count: float = 0.0


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
            if seen is None or seen.owner != owner:  # what this count tells may be of the owner before
                self._seen[task] = _Seen(owner, at=now, answered_at=now, until=now)
                continue
            self._seen[task] = seen
            prefix = f"{task}/out/"
            paired = [
                (count.answer_s, count.paired_hz)
                for count in counts
                if count.stream.startswith(prefix) and count.answer_s is not None and (count.paired_hz or 0.0) > 0.0
            ]
            if now > seen.until:
                seen.age_s.value = None  # what was before a break is another time
            if paired:  # a job ends with the last of its answers
                away_s = round_trips.get(owner, 0.0)
                seen.age_s.update(min(max(max(age_s for age_s, _ in paired) - away_s, 0.0), MAX_JOB_S), now)
                seen.count += (now - seen.at) * min(max(hz or 0.0 for _, hz in paired), MAX_JOBS_HZ)
                gap_s, seen.answered_at = now - seen.answered_at, now
                seen.until = now + max(STALE_S, min(STALE_GAPS * gap_s, MAX_STALE_S))
            seen.at = now

    def told(self, now: float) -> tuple[AnswerTime, ...]:
        """What this robot's profile tells; nothing of a task whose answers have ceased."""
        return tuple(
            AnswerTime(task=task, owner=seen.owner, age_s=round(seen.age_s.value, 4), count=round(seen.count, 2))
            for task, seen in sorted(self._seen.items())
            if now <= seen.until and seen.age_s.value is not None
        )
