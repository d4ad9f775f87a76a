"""Slow beats among faults: schedules in which a fleet is calm 0.3 s after the last change, and so again and again.

With the real 5 s most schedules never reach the slow pace, for faults follow each other.
"""

from __future__ import annotations

from collections import Counter

import pytest

from zsched.core.membership import pace
from zsched.core.values.beat import Beat
from zsched_lab.sim.simulate import Job, play_all

SEEDS = range(9_100_000, 9_100_016)
LEAST_SLOW = 0.05
"""At least this share of the beats is followed by a slow one."""


@pytest.mark.long
def test_fleets_that_slow_down_between_faults_keep_every_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pace, "FULL_S", 0.3)
    counted, next_at = Counter[bool](), pace.Pace.next_at

    def count(self: pace.Pace, beat: Beat, *, are_all_calm: bool) -> float:
        at = next_at(self, beat, are_all_calm=are_all_calm)
        counted[self.is_slow] += 1
        return at

    monkeypatch.setattr(pace.Pace, "next_at", count)
    violations = {job.seed: result.violation for job, result in play_all((Job(seed=seed) for seed in SEEDS), 1)}
    assert not {seed: told for seed, told in violations.items() if told}
    assert counted[True] > LEAST_SLOW * counted.total(), counted
