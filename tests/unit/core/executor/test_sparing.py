"""A node that begins anew first looks whether somebody else could have its tasks meanwhile."""

from __future__ import annotations

import pytest

from support.allocations import allocation_of
from support.fleets import task_of
from support.profiles import load_of, profile_of
from zsched.core.executor.sparing import Sparing, lacking
from zsched.core.values.fleet import Standby, WorkerSpec
from zsched.core.values.profile import Profile, WorkerState

WARM = WorkerSpec(command=("work",))
COLD = WorkerSpec(command=("work",), standby=Standby.COLD)
FOREIGN = WorkerSpec()
READY, STARTING, STOPPED, FAILED = WorkerState.READY, WorkerState.STARTING, WorkerState.STOPPED, WorkerState.FAILED


def seen(node: str, state: WorkerState | None, *, draining: bool = False) -> Profile:
    return profile_of(node, workers=() if state is None else (load_of("merge", state),), draining=draining)


def sparing(me: str, owner: str | None, worker: WorkerSpec, *others: Profile | str, candidates: str = "abc") -> Sparing:
    spec = task_of("merge", tuple(candidates), worker=worker)
    values = {"merge": allocation_of(3, owner, task="merge")}
    known = {one if isinstance(one, str) else one.node: None if isinstance(one, str) else one for one in others}
    found = lacking((spec,), values, me, known)
    assert all(one.task == "merge" and one.why for one in found)
    return found[0].sparing if found else Sparing.FREE


@pytest.mark.parametrize(
    ("worker", "others", "wanted"),
    [
        (WARM, [seen("b", READY)], Sparing.FREE),
        (WARM, [seen("b", STARTING), seen("c", READY)], Sparing.FREE),
        (WARM, [seen("b", STARTING)], Sparing.STARTING),
        (WARM, [seen("b", STOPPED), seen("c", FAILED)], Sparing.STARTING),
        (WARM, [seen("b", None)], Sparing.STARTING),  # its first profile
        (WARM, ["b"], Sparing.STARTING),  # it has told nothing yet
        (WARM, [seen("b", READY, draining=True)], Sparing.AWAY),
        (WARM, [], Sparing.AWAY),
        (WARM, [seen("b", FAILED)], Sparing.AWAY),
        (WARM, [seen("b", FAILED), seen("c", FAILED)], Sparing.FREE),  # waiting would help nobody
        (COLD, [seen("b", STOPPED)], Sparing.FREE),
        (COLD, [seen("b", FAILED), seen("c", FAILED)], Sparing.FREE),
        (FOREIGN, [seen("b", None)], Sparing.FREE),
        (FOREIGN, [seen("b", STOPPED), seen("c", STOPPED)], Sparing.FREE),  # somebody else starts it, or does not
    ],
)
def test_an_owner_waits_for_who_could_have_its_task(
    worker: WorkerSpec, others: list[Profile | str], wanted: Sparing
) -> None:
    assert sparing("a", "a", worker, *others) is wanted


def test_the_only_candidate_waits_for_nobody() -> None:
    assert sparing("a", "a", WARM, candidates="a") is Sparing.FREE


def test_a_candidate_waits_while_the_owner_gives_its_task_away_or_is_away() -> None:
    assert sparing("b", "a", WARM, seen("a", READY)) is Sparing.FREE
    assert sparing("b", "a", WARM, seen("a", READY, draining=True)) is Sparing.STARTING
    assert sparing("b", "a", WARM, seen("c", READY)) is Sparing.AWAY
    assert sparing("d", "a", WARM, seen("a", READY, draining=True)) is Sparing.FREE, "it is no candidate"
    assert sparing("b", None, WARM) is Sparing.FREE, "nobody owns it anyhow"


def test_who_may_take_no_task_is_not_waited_for_and_may_own_one() -> None:
    spec = task_of("merge", ("a", "b"), worker=WARM)
    values = {"merge": allocation_of(3, "a", task="merge")}
    (found,) = lacking((spec,), values, "a", {"b": seen("b", READY)}, closed=["b"])
    assert found.sparing is Sparing.AWAY
    assert lacking((spec,), values, "b", {"a": seen("a", READY)}, closed=["a"]) == ()
