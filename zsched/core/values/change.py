"""Changes of a register that a node proposes, and how they end.

Knows: which fields of an allocation each change touches. Does not know: ballots and rounds
(`zsched.core.register.register`), who wants a change and why.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Protocol, TypeVar

from zsched.core.values.messages import CommandOutcome
from zsched.core.values.model import Allocation, Asked, NodeId, Pause, Pin, TaskId, Tuning, told_by
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import told_of_silence

_Value = TypeVar("_Value")


class Rewrite(Protocol[_Value]):
    """A change of what a register holds."""

    @property
    def base_revision(self) -> int:
        """The revision that it is based on."""

    @property
    def reason(self) -> str:
        """Why the value is what it is, once this is committed."""

    def apply(self, read: _Value) -> _Value:
        """The new value, of the next revision; what was read when nothing is to change."""


class MoveOwner(Struct, frozen=True, kw_only=True):
    """Change: another owner; the epoch rises with the revision."""

    base_revision: int
    owner: NodeId
    reason: str
    asked: Asked | None = None
    """The operator who ordered it; ``None``: the robots have voted for it."""
    request: int | None = None
    """The operator's open question about this change."""

    def apply(self, read: Allocation) -> Allocation:
        """The new value, with another owner, epoch and revision; for the present owner the value as read."""
        if self.owner == read.owner:
            return read
        revision, epoch = read.revision + 1, read.epoch + 1
        return replace(read, revision=revision, epoch=epoch, owner=self.owner, asked=self.asked)


class Retune(Struct, frozen=True, kw_only=True):
    """Change: another tuning; owner and epoch stay, so routes do not move."""

    base_revision: int
    tuning: Tuning
    request: int | None = None
    """The operator's open question about this change."""
    asked: Asked | None = None

    @property
    def reason(self) -> str:
        """Why the value is what it is, once this is committed."""
        if self.asked is not None:
            return f"retuned by {told_by(self.asked)}"
        return "its tuning in the fleet file has changed" if self.request is None else "retuned by an operator"

    def apply(self, read: Allocation) -> Allocation:
        """The new value, with another tuning and revision; for the present tuning the value as read."""
        if self.tuning == read.tuning:
            return read
        return replace(read, revision=read.revision + 1, tuning=self.tuning, asked=self.asked)


class SetHold(Struct, frozen=True, kw_only=True):
    """Change: both of an operator's lasting orders about the task, its pause and its pin; ``None`` ends one."""

    base_revision: int
    pause: Pause | None
    pin: Pin | None
    reason: str
    asked: Asked | None = None
    """``None``: an order's time was over."""
    request: int | None = None
    """The operator's open question about this change."""

    def apply(self, read: Allocation) -> Allocation:
        """The new value, with other orders and revision; owner and epoch stay. For the present orders as read."""
        pinned, paused = self.pin is not None, self.pause is not None
        if (self.pin, self.pause, pinned, paused) == (read.pin, read.pause, read.pinned, read.paused):
            return read
        return replace(
            read,
            revision=read.revision + 1,
            pin=self.pin,
            pause=self.pause,
            pinned=pinned,
            paused=paused,
            asked=self.asked,
        )


class SetLeased(Struct, frozen=True, kw_only=True):
    """Change: from now on no node works without a lease, or every node may (`zsched.core.executor.sealing`)."""

    base_revision: int
    leased: bool

    @property
    def reason(self) -> str:
        """Why the value is what it is, once this is committed."""
        return "nobody works without a lease any more" if self.leased else "not exclusive any more"

    def apply(self, read: Allocation) -> Allocation:
        """The new value; touches this field and the revision only."""
        if read.leased is self.leased:
            return read
        return replace(read, revision=read.revision + 1, leased=self.leased, asked=None)


Change = MoveOwner | Retune | SetHold | SetLeased


class RoundOutcome(StrEnum):
    """How a change ended."""

    COMMITTED = "committed"
    CONFLICT = "conflict"  # its base is no longer the newest revision
    UNCHANGED = "unchanged"  # it asks for what is there already: nothing was written
    NO_QUORUM = "no_quorum"  # not started: no majority promised
    UNKNOWN = "unknown"  # some elector may have it, and no majority could be asked


def told_end(outcome: RoundOutcome, electors: int) -> tuple[CommandOutcome, str]:
    """How a change has ended among so many electors, for its operator."""
    return {
        RoundOutcome.COMMITTED: (CommandOutcome.OK, "committed by a majority of the electors"),
        RoundOutcome.CONFLICT: (CommandOutcome.CONFLICT, "another change came first"),
        RoundOutcome.UNCHANGED: (CommandOutcome.UNCHANGED, "it is so already"),
        RoundOutcome.NO_QUORUM: (CommandOutcome.NO_QUORUM, told_of_silence(electors)),
        RoundOutcome.UNKNOWN: (CommandOutcome.UNKNOWN, "the electors fell silent"),
    }[outcome]


class Ended(Struct, frozen=True, kw_only=True):
    """A change of this node has ended."""

    task: TaskId
    change: Change
    outcome: RoundOutcome
