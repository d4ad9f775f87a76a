"""The epoch an output is stamped with, step by step."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched.core.values.plan import Role, WorkerRole
from zsched.worker.epochs import MAX_CARRIED, Epochs, lets_out


def role(kind: WorkerRole, epoch: int) -> Role:
    return Role(task="t", role=kind, epoch=epoch)


IDLE = role(WorkerRole.IDLE, 0)
FIRST, SECOND = role(WorkerRole.ACTIVE, 1), role(WorkerRole.ACTIVE, 2)


def test_the_first_epoch_is_the_roles() -> None:
    epochs = Epochs()
    epochs.follow(IDLE, FIRST)
    assert [epochs.stamp(FIRST, in_hand) for in_hand in (None, 0, 1)] == [1, 1, 1]


def test_the_older_epochs_inputs_are_stamped_with_it_until_it_ends() -> None:
    epochs = Epochs()
    epochs.follow(IDLE, FIRST)
    epochs.follow(FIRST, SECOND)
    assert epochs.is_carried(1)
    assert [epochs.stamp(SECOND, in_hand) for in_hand in (None, 1, 2)] == [1, 1, 2]
    assert epochs.close(1)
    assert [epochs.stamp(SECOND, in_hand) for in_hand in (None, 1, 2)] == [2, 2, 2]
    assert not epochs.close(1)


def test_who_was_draining_carries_the_older_epoch_to_its_end() -> None:
    """There and back: the robots keep the slot that is left until it has drained."""
    epochs = Epochs()
    draining, third = role(WorkerRole.DRAINING, 1), role(WorkerRole.ACTIVE, 3)
    epochs.follow(IDLE, FIRST)
    epochs.follow(FIRST, draining)
    assert not epochs.is_carried(1)
    epochs.follow(draining, third)
    assert [epochs.stamp(third, in_hand) for in_hand in (None, 1, 3)] == [1, 1, 3]
    epochs.close(1)
    assert [epochs.stamp(third, in_hand) for in_hand in (None, 1, 3)] == [3, 3, 3]


def test_an_epoch_that_has_ended_is_not_carried() -> None:
    epochs = Epochs()
    epochs.follow(IDLE, FIRST)
    epochs.close(1)
    assert epochs.stamp(FIRST, None) is None
    epochs.follow(FIRST, SECOND)
    assert not epochs.is_carried(1)
    assert epochs.stamp(SECOND, 1) == 2


def test_two_epochs_on_both_are_carried_and_end_one_after_the_other() -> None:
    epochs = Epochs()
    third = role(WorkerRole.ACTIVE, 3)
    epochs.follow(IDLE, FIRST)
    epochs.follow(FIRST, SECOND)
    epochs.follow(SECOND, third)
    assert [epochs.is_carried(epoch) for epoch in (1, 2, 3)] == [True, True, False]
    assert [epochs.stamp(third, in_hand) for in_hand in (None, 1, 2, 3)] == [1, 1, 2, 3]
    assert epochs.close(1) == (1,)
    assert [epochs.stamp(third, in_hand) for in_hand in (None, 1, 2, 3)] == [2, 2, 2, 3]
    assert epochs.close(2) == (2,)
    assert [epochs.stamp(third, in_hand) for in_hand in (None, 1, 2, 3)] == [3, 3, 3, 3]


def test_with_a_newer_epoch_those_end_that_were_carried() -> None:
    epochs = Epochs()
    epochs.follow(IDLE, FIRST)
    epochs.follow(FIRST, SECOND)
    assert epochs.close(2) == (1, 2)
    assert epochs.close(1) == ()


def test_only_so_many_epochs_are_carried() -> None:
    epochs = Epochs()
    for epoch in range(1, MAX_CARRIED + 2):
        epochs.follow(role(WorkerRole.ACTIVE, epoch), role(WorkerRole.ACTIVE, epoch + 1))
    assert not epochs.is_carried(MAX_CARRIED + 1)
    assert epochs.close(MAX_CARRIED + 1) == tuple(range(1, MAX_CARRIED + 2))


def test_asked_to_leave_and_staying_after_all() -> None:
    epochs = Epochs()
    epochs.follow(IDLE, FIRST)
    epochs.close(1)
    epochs.resume(1)
    assert epochs.stamp(FIRST, 1) == 1


DRAINING = role(WorkerRole.DRAINING, 1)
LEASED = replace(FIRST, lease_until_s=10.0)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (IDLE, FIRST, True),
        (FIRST, SECOND, True),
        (FIRST, FIRST, False),
        (FIRST, IDLE, False),
        (FIRST, DRAINING, False),
        (IDLE, DRAINING, True),
        (DRAINING, FIRST, True),
        (replace(LEASED, lease_until_s=4.0), LEASED, True),
        (replace(LEASED, lease_until_s=6.0), LEASED, False),
    ],
)
def test_what_was_withheld_is_answered_once_a_role_allows_what_the_one_before_did_not(
    before: Role, after: Role, expected: bool
) -> None:
    assert lets_out(before, after, now=5.0) is expected


def test_an_input_of_a_newer_epoch_than_the_role_is_answered_in_none() -> None:
    """A -> B -> A: the robots have closed the epoch that a worker believes in which was told of neither move."""
    epochs = Epochs()
    third = role(WorkerRole.ACTIVE, 3)
    epochs.follow(IDLE, FIRST)
    assert [epochs.stamp(FIRST, in_hand) for in_hand in (1, 3)] == [1, None]
    assert epochs.stamp(role(WorkerRole.DRAINING, 1), 3) is None
    epochs.follow(FIRST, third)
    assert [epochs.stamp(third, in_hand) for in_hand in (1, 3, 4)] == [1, 3, None]
