"""What the documents promise of each step of a rehearsal, by the timing profile and the task's settings.

Knows: the limits of docs/design/timing.md and docs/guide/streams.md. Does not know: what a fleet really does.

The limits hold for machines whose daemons get their time. They count from the step. A stream's usual gap comes on top,
for a step may come just before the next answer was due.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from zsched.core.values.fleet import Fleet, Standby, TaskSpec, Timing
from zsched.core.values.plan import Direction, HandoverRule, OnCrash, ReadyWhen, StreamClass
from zsched.core.values.rehearsal import Promised, Step

FLIP_S: Final = 0.3
"""The relay waits at most this long for the new owner's worker to know its role."""
VOTE_S: Final = 0.1
"""A vote waits this much longer than two gathers for a silent robot."""
_WORDS: Final = {Direction.INPUT: "in", Direction.OUTPUT: "out"}


def promises(fleet: Fleet, task: TaskSpec) -> tuple[Promised, ...]:
    """The promises for every step, in the order of a rehearsal.

    A cut of the links must last longer than its ``decide_s``, or the owner keeps the task.
    """
    timing = fleet.timing
    commit_s = 2 * timing.ballot_s + len(fleet.voters) * timing.stagger_s
    decide_s = timing.gather_s + 2 * timing.gather_s + VOTE_S + commit_s + (timing.lease_s if task.exclusive else 0.0)
    gone_s = max(timing.confirm_s, 1.5 * timing.beat_s)
    hand_over_s = FLIP_S if task.worker.standby is Standby.WARM else FLIP_S + task.worker.start_deadline_s
    # how soon a drain is in force, and whether other tasks leave first, is measured and not promised
    planned, crashed = tuple(_whole(task, is_planned=True)), tuple(_whole(task, is_planned=False))
    in_place_s = task.worker.start_deadline_s + decide_s + hand_over_s
    dead_s, silent_s = gone_s + decide_s, _silent_s(timing) + gone_s + decide_s
    return (
        Promised(step=Step.MOVE, gap_s=hand_over_s, decide_s=commit_s, whole=planned),
        Promised(step=Step.DRAIN, gap_s=hand_over_s, whole=planned),
        Promised(step=Step.WORKER, gap_s=in_place_s, whole=crashed),
        Promised(step=Step.DAEMON, gap_s=dead_s + hand_over_s, decide_s=dead_s, whole=crashed),
        Promised(step=Step.LINK, gap_s=silent_s + hand_over_s, decide_s=silent_s, whole=crashed),
    )


def _silent_s(timing: Timing) -> float:
    """Silence is found up to one beat late, by the beats or by zenoh's lease."""
    return min(timing.suspect_s + timing.rest_beat_s, timing.control_lease_s)


def _whole(task: TaskSpec, *, is_planned: bool) -> Iterator[str]:
    """The streams that lose nothing, by their names; only the library's workers number what they take and give."""
    if task.worker.ready_when is not ReadyWhen.TOKEN:
        return
    for direction, word in _WORDS.items():
        rules = [rule for rule in task.rules if rule.direction is direction]
        for index, rule in enumerate(rules):
            settings = rule.settings
            if settings.stream_class is not StreamClass.RELIABLE:
                continue
            is_replayed = direction is Direction.INPUT and settings.on_crash is OnCrash.REPLAY
            is_in_order = direction is Direction.INPUT or settings.handover is HandoverRule.ALL
            if is_in_order if is_planned else is_replayed:
                yield f"{task.name}/{word}/{index}"
