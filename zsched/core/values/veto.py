"""Why a machine may not have a task: which filter keeps it out, with its figures in words.

Knows: the filters and their order. Does not know: how one is looked at (`zsched.core.scheduler.eligibility`, where the
robots' views are joined: `zsched.core.scheduler.standing`).
"""

from __future__ import annotations

from enum import StrEnum

from zsched.core.values.struct import Struct


class Filter(StrEnum):
    """In the order in which they are looked at; the first that keeps a machine out is told."""

    HEARD = "heard"
    LEASE = "lease"  # of an exclusive task: enough electors can give it one, and its clock is not in doubt
    TERMS = "terms"  # of an exclusive task: its leases hang on the same settings as ours
    RESTS = "rests"  # of an exclusive task: its owner does not say that it has no lease
    STREAMS = "streams"  # it was gone, and its streams are proven again
    PROFILE = "profile"  # its figures are fresh
    DRAIN = "drain"
    WORKER = "worker"
    MEMORY = "memory"
    LIMIT = "limit"  # of a gauge
    MARGIN = "margin"  # of a gauge's limit, as long as somebody keeps the task
    LINK = "link"  # something measures the way to it, where that has a weight
    FIGURES = "figures"  # likewise of its other figures
    SCORES = "scores"  # enough robots score it
    REACH = "reach"  # enough robots reach it
    ORDER = "order"  # no operator keeps tasks from it
    ROOM = "room"  # other tasks that are about to go there leave room for this one
    OTHER = "other"  # told by a program that knows more filters


class Veto(Struct, frozen=True):
    """A filter keeps a machine out.

    >>> str(Veto(Filter.MEMORY, "needs 6144 MiB, has 5120 free"))
    'needs 6144 MiB, has 5120 free'
    """

    filter: Filter
    why: str

    def __str__(self) -> str:
        """For people."""
        return self.why


_KNOWN = {one.value: one for one in Filter}
_FORMER = (
    ("clock in doubt", Filter.LEASE),
    ("too few electors can give it a lease", Filter.LEASE),
    ("it rested there for want of a lease", Filter.LEASE),
    ("needs ", Filter.MEMORY),
)


def read(name: str | None, why: str) -> Veto:
    """A veto as it came; ``name`` is of a filter that may be unknown here.

    ``None``: a program of before filters had names. What such a one says is read for one release.

    >>> read("wind", "too strong").filter, read(None, "needs 6144 MiB, has 5120 free").filter
    (<Filter.OTHER: 'other'>, <Filter.MEMORY: 'memory'>)
    """
    if name is None:
        return Veto(next((known for begin, known in _FORMER if why.startswith(begin)), Filter.OTHER), why)
    return Veto(_KNOWN.get(name, Filter.OTHER), why)
