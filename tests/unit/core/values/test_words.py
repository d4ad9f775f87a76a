"""The words that are made of a worker's state, wherever it is shown."""

from __future__ import annotations

import pytest

from zsched.core.values.profile import WorkerState
from zsched.core.values.words import RESTARTING, WAS_READY, has_lost_its_worker, told_of_worker

WAS = f"{WAS_READY}it was killed"
AGAIN = f"{RESTARTING} in 2 s"


@pytest.mark.parametrize(
    ("state", "reason", "told", "is_lost"),
    [
        (WorkerState.READY, "", "is ready", False),
        (WorkerState.READY, WAS, f"is ready: {WAS}", False),
        (WorkerState.STARTING, "", "is starting", False),
        (WorkerState.STARTING, WAS, WAS, True),
        (WorkerState.STARTING, AGAIN, f"is {AGAIN}", False),
        (WorkerState.FAILED, "", "is failed", True),
        (WorkerState.FAILED, AGAIN, f"is {AGAIN}", True),
        (WorkerState.STOPPED, "", "is stopped", True),
    ],
)
def test_a_worker_is_told_and_missed_by_its_state_and_why(
    state: WorkerState, reason: str, told: str, *, is_lost: bool
) -> None:
    assert told_of_worker(state, reason) == told
    assert has_lost_its_worker(state, reason) is is_lost
