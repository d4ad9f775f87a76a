"""The words that are made of a worker's state, wherever it is shown."""

from __future__ import annotations

import pytest

from zsched.core.values.profile import WorkerState
from zsched.core.values.words import Trouble, has_lost_its_worker, told_of_worker

WAS = "was ready until it was killed"
AGAIN = "restarting in 2 s"


@pytest.mark.parametrize(
    ("state", "trouble", "reason", "told", "is_lost"),
    [
        (WorkerState.READY, Trouble.NONE, "", "is ready", False),
        (WorkerState.READY, Trouble.NONE, WAS, f"is ready: {WAS}", False),
        (WorkerState.READY, Trouble.RESTS, "no lease", "is ready: no lease", False),
        (WorkerState.STARTING, Trouble.NONE, "", "is starting", False),
        (WorkerState.STARTING, Trouble.NONE, AGAIN, f"is starting: {AGAIN}", False),
        (WorkerState.STARTING, Trouble.LOST, WAS, WAS, True),
        (WorkerState.STARTING, Trouble.AGAIN, AGAIN, f"is {AGAIN}", False),
        (WorkerState.FAILED, Trouble.NONE, "", "is failed", True),
        (WorkerState.FAILED, Trouble.AGAIN, AGAIN, f"is {AGAIN}", True),
        (WorkerState.STOPPED, Trouble.NONE, "", "is stopped", True),
        (WorkerState.STOPPED, Trouble.LOST, WAS, WAS, True),
    ],
)
def test_a_worker_is_told_and_missed_by_its_state_and_trouble(
    state: WorkerState, trouble: Trouble, reason: str, told: str, *, is_lost: bool
) -> None:
    assert told_of_worker(state, trouble, reason) == told
    assert has_lost_its_worker(state, trouble) is is_lost
