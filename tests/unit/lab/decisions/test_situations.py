"""The ten situations for readers of docs/design/scheduling.md go as they went when they were written down."""

from __future__ import annotations

import re

import pytest

from zsched_lab.decisions.situations import BANDS, BEFORE_S, SITUATIONS, Next, Situation, play

Move = tuple[str, float, float, str]
STAYS = None
FOLLOWED: dict[str, dict[str, Move | None]] = {
    "within the bonus": {"map": STAYS},
    "a large lead, the best one drained": {"map": ("edge3", 0.0, 1.0, "edge1 owes")},
    "a small lead": {"map": ("edge2", 2.2, 4.5, "edge1 owes")},
    "a worker that does not start": {"map": ("edge3", 5.1, 6.5, "the worker on edge1 has not been ready")},
    "paused, and its owner is gone": {"map": STAYS},
    "pinned to a machine that is back": {"map": ("edge1", 1.0, 1.9, "pinned to edge1")},
    "two tasks, room for one": {"map": STAYS, "plan": ("edge2", 0.0, 1.0, "edge1 owes")},
    "a machine that has not kept its promise": {"map": STAYS},
    "a preferred machine is free again": {"map": ("edge2", 5.3, 8.0, "edge1 owes")},
    "an exclusive owner that rests, and nobody else can": {"map": STAYS},
}
"""{situation: {task: where it goes, within which seconds, for which reason}}; no answer is near the end of its band."""


@pytest.mark.parametrize("situation", SITUATIONS, ids=lambda one: one.name)
def test_each_goes_as_it_went(situation: Situation) -> None:
    (check, before, now), answers = play(situation)
    assert [one.task for one in answers] == list(FOLLOWED[situation.name])
    for one in answers:
        holds(one, FOLLOWED[situation.name][one.task])
        assert re.search(rf"^(tasks )?.*\b{one.task}\b.*: a machine is worth", check, re.MULTILINE)
        assert "a lead is followed after" in check
        assert re.search(rf"^{one.task} +{one.was} ", now, re.MULTILINE), "the screen shows where it is"
    ups = [int(found[1]) for screen in (before, now) if (found := re.search(r"up (\d+)s", screen))]
    assert ups[1] - ups[0] == BEFORE_S


def holds(told: Next, expected: Move | None) -> None:
    if expected is None:
        assert told.moves == ()
        return
    where, least_s, most_s, reason = expected
    ((after_s, to, why),) = told.moves
    assert (to, told.owner) == (where, where)
    assert least_s <= after_s <= most_s
    assert sum(end <= least_s for end in BANDS) == sum(end <= most_s for end in BANDS), "one answer of the question"
    assert reason in why
