"""Changes of a register that a node proposes, and how they end.

Knows: which fields of an allocation each change touches. Does not know: ballots and rounds
(`zsched.core.vote.register`), who wants a change and why.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Protocol, TypeVar

from zsched.core.values.model import Allocation, NodeId, TaskId, Tuning

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


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveOwner:
    """Change: another owner; the epoch rises with the revision."""

    base_revision: int
    owner: NodeId
    reason: str

    def apply(self, read: Allocation) -> Allocation:
        """The new value, with another owner, epoch and revision; for the present owner the value as read."""
        if self.owner == read.owner:
            return read
        return replace(read, revision=read.revision + 1, epoch=read.epoch + 1, owner=self.owner)


@dataclass(frozen=True, slots=True, kw_only=True)
class Retune:
    """Change: another tuning; owner and epoch stay, so routes do not move."""

    base_revision: int
    tuning: Tuning
    request: int | None = None
    """The operator's open question about this change."""

    @property
    def reason(self) -> str:
        """Why the value is what it is, once this is committed."""
        return "its tuning in the fleet file has changed" if self.request is None else "retuned by an operator"

    def apply(self, read: Allocation) -> Allocation:
        """The new value, with another tuning and revision; for the present tuning the value as read."""
        if self.tuning == read.tuning:
            return read
        return replace(read, revision=read.revision + 1, tuning=self.tuning)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetLeased:
    """Change: from now on no node works without a lease, or every node may (`zsched.core.executor.sealing`)."""

    base_revision: int
    leased: bool

    @property
    def reason(self) -> str:
        """Why the value is what it is, once this is committed."""
        return "nobody works without a lease any more" if self.leased else "not exclusive any more"

    def apply(self, read: Allocation) -> Allocation:
        """The new value; touches this field and the revision only."""
        return read if read.leased is self.leased else replace(read, revision=read.revision + 1, leased=self.leased)


Change = MoveOwner | Retune | SetLeased


class RoundOutcome(StrEnum):
    """How a change ended."""

    COMMITTED = "committed"
    CONFLICT = "conflict"  # its base is no longer the newest revision
    UNCHANGED = "unchanged"  # it asks for what is there already: nothing was written
    NO_QUORUM = "no_quorum"  # not started: no majority promised
    UNKNOWN = "unknown"  # some elector may have it, and no majority could be asked


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """A change of this node has ended."""

    task: TaskId
    change: Change
    outcome: RoundOutcome
