"""The values of a rehearsal: its steps, what the documents promise for each, and what an operator asks of nodes.

Knows: fields and their ranges. Does not know: which step comes when (`zsched.tools.rehearsal.programme`).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from zsched.core.values.document import Text
from zsched.core.values.model import Asked, NodeId, TaskId, check_length, check_name
from zsched.core.values.struct import Struct
from zsched.core.values.words import check_range

MAX_CUT_S: Final = 60.0
"""The longest cut of a node's links."""
MAX_KEPT_BYTES: Final = 64 * 1024
"""Of one kept rehearsal, as JSON in UTF-8."""


class Step(StrEnum):
    """One thing that a rehearsal does to the task's owner."""

    MOVE = "move"  # the task is handed over by order
    DRAIN = "drain"  # the owner is drained until the step is over
    WORKER = "worker"  # the owner's worker is killed
    DAEMON = "daemon"  # the owner's daemon is killed; something must start it again
    LINK = "link"  # the owner's links carry nothing for a while


FAULTS: Final = (Step.WORKER, Step.DAEMON, Step.LINK)
"""The steps that the owner's node carries out itself."""


class Promised(Struct, frozen=True, kw_only=True):
    """What the documents promise of one step, for one task of one fleet file."""

    step: Step
    gap_s: float
    """At most this much longer than usual no answer comes to a robot."""
    decide_s: float | None = None
    """From the step to the agreed owner; ``None``: nothing is decided."""
    whole: tuple[str, ...] = ()
    """The streams that lose nothing."""


class Strike(Struct, frozen=True, kw_only=True):
    """Operator command to the owner: do this to yourself, so that the operator sees what the fleet makes of it."""

    task: TaskId
    step: Step
    asked: Asked
    cut_s: float = 0.0
    """How long the links are cut."""
    is_plan: bool = False
    """Only say whether it could be done; a drain itself is agreed by the fleet's document."""

    def __post_init__(self) -> None:
        check_name("strike.task", self.task)
        check_range("strike.cut_s", self.cut_s, 0.0, MAX_CUT_S)
        if self.step not in FAULTS and not (self.step is Step.DRAIN and self.is_plan):
            raise ValueError(f"strike.step: {self.step} is not done by a node to itself")


class KeepRehearsal(Struct, frozen=True, kw_only=True):
    """Operator command to one node: keep what a rehearsal has found."""

    task: TaskId
    name: str
    """Of the rehearsal."""
    body: Text
    """JSON (`zsched.rehearse/1`)."""
    told: str
    """One line for the history."""
    asked: Asked

    def __post_init__(self) -> None:
        check_name("rehearsal.task", self.task)
        check_name("rehearsal.name", self.name)
        check_length("rehearsal.told", self.told)
        if len(self.body.encode()) > MAX_KEPT_BYTES:  # half a character is a `ValueError`, too: no file can hold it
            raise ValueError(f"rehearsal.body: larger than {MAX_KEPT_BYTES} bytes")


class ReadRehearsals(Struct, frozen=True, kw_only=True):
    """Operator's question to one node: what it promises for a task, or what it has kept."""

    task: TaskId = ""
    """Tell what is promised for this task."""
    name: str = ""
    """Tell this rehearsal whole; empty: tell all names."""

    def __post_init__(self) -> None:
        if self.task:
            check_name("rehearsals.task", self.task)
        if self.name:
            check_name("rehearsals.name", self.name)


class RehearsalsTold(Struct, frozen=True, kw_only=True):
    """The answer to `ReadRehearsals`."""

    node: NodeId
    timing: str = ""
    """The timing profile."""
    promised: tuple[Promised, ...] = ()
    names: tuple[str, ...] = ()
    """Of the kept rehearsals, the newest last."""
    body: Text = Text("")
    """The one that was asked for; empty: there is none."""

    def __post_init__(self) -> None:
        check_name("rehearsals_told.node", self.node)
