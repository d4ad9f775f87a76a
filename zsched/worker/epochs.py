"""Decides with which epoch a worker stamps an output.

Knows: the role's epoch, those before it that have not ended here, which ones have. Does not know: zenoh, inputs (it is
told the epoch of the input in hand), where roles come from.

When one epoch follows another on the same owner, or the owner that drains is the owner again, its inputs flow on. It
goes on stamping what it makes of the older epoch's inputs with the older epoch: the robots admit the newer one only
from their flip on, and that is when their first input of the newer epoch comes.

A robot's flip waits only so long for a role, so an input may be of a newer epoch than the role. What is made of it is
nobody's yet: A -> B -> A looks to a worker that heard of neither move like A still, but the robots have closed the
epoch that it believes in.
"""

from __future__ import annotations

from typing import Final

from zsched.core.values.plan import Role, WorkerRole

CARRY_S: Final = 2.5
"""The older epoch's inputs that have not come by then never will..."""
CARRY_LOOK_S: Final = 0.2
"""...and those that have come are processed first: the worker looks this often whether one still waits."""
MAX_CARRIED: Final = 4
"""So many older epochs are carried; when one more is left in that time, they and it end at once."""


class Epochs:
    """One worker's epochs. Its lock is the worker's."""

    def __init__(self) -> None:
        self.ended = -1
        """The newest epoch whose outputs are closed."""
        self._older: tuple[int, ...] = ()
        """Epochs that were carried when the newest role came, the oldest first."""

    def follow(self, before: Role, role: Role) -> None:
        """A new role: from now on an older epoch may be carried beside it."""
        has_worked = before.role is not WorkerRole.IDLE and role.role is WorkerRole.ACTIVE
        is_owner_again = has_worked and self.ended < before.epoch < role.epoch
        carried = self._carried()
        if is_owner_again and before.epoch and before.epoch not in carried and len(carried) < MAX_CARRIED:
            self._older = (*carried, before.epoch)

    def is_carried(self, epoch: int) -> bool:
        """True while the epoch's inputs are still worked on beside a newer role."""
        return epoch in self._carried()

    def _carried(self) -> tuple[int, ...]:
        return tuple(epoch for epoch in self._older if epoch > self.ended) if self._older else ()

    def resume(self, epoch: int) -> None:
        """It was told to stop, and works on in the same epoch after all."""
        if self.ended == epoch:
            self.ended = epoch - 1

    def close(self, epoch: int) -> tuple[int, ...]:
        """Nothing more will be stamped with ``epoch``, or with an older one that is carried; which ones end by that.

        The oldest first; none when that was so already.
        """
        if epoch <= self.ended:
            return ()
        older = tuple(one for one in self._carried() if one < epoch)
        self.ended = epoch
        return (*older, epoch)

    def stamp(self, role: Role, in_hand: int | None) -> int | None:
        """The epoch for an output made of an input of epoch ``in_hand``; ``None``: it is closed, or not told yet."""
        if in_hand is not None and in_hand > role.epoch:
            return None
        carried = self._carried()
        for epoch in carried:
            if in_hand is None or in_hand <= epoch:
                return epoch
        return role.epoch if role.epoch > self.ended or carried else None


def lets_out(before: Role, role: Role, now: float) -> bool:
    """Whether a role follows on which what was withheld under the one ``before`` it is answered first of all."""
    if role.role is WorkerRole.IDLE or role == before:
        return False
    if role.role is WorkerRole.DRAINING:
        return before.epoch != role.epoch
    was_held = before.lease_until_s is not None and now >= before.lease_until_s
    return before.role is not WorkerRole.ACTIVE or before.epoch != role.epoch or was_held
