"""The fleet's document: the fleet file's text as its operator wrote it, and what operators have said since.

Knows: the fields of a document and their sizes. Does not know: what the text means (`zsched.config`), its hash
(`zsched.core.values.codec`), who agrees on it (`zsched.core.electorate`).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import NewType

from zsched.core.values.model import NodeId, TaskId, check_counter, check_length, check_name
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import check_range

Text = NewType("Text", str)
"""A string that may be longer than any other on the wire: at most `MAX_DOCUMENT_BYTES` in UTF-8."""
MAX_DOCUMENT_BYTES = 192 * 1024
"""Of a document's text in UTF-8: with its flags it fits into one frame."""
MAX_FLAGS = 64
"""Flags of a document."""
MAX_FLAG_S = 366 * 86_400
"""The longest time of a flag: 366 days."""
MAX_ROLLOUTS = 64
MAX_HELD_BYTES = 16 * 1024
"""Of the command and the environment that one rollout keeps, in UTF-8."""


class FlagKind(StrEnum):
    """What an operator has said of a node."""

    DRAIN = "drain"  # its tasks move away, and none comes
    INELIGIBLE = "ineligible"  # no task comes; what it owns stays
    LEAVE = "leave"  # as drained, and it gives its seat among the electors up


class Flag(Struct, frozen=True, kw_only=True):
    """One thing that an operator has said of a node, until it is taken back or its time is over."""

    kind: FlagKind
    subject: NodeId
    """The node."""
    reason: str = ""
    by: str = ""
    """The operator: the name in the certificate, or else the person that the program names."""
    for_s: float | None = None
    """How long it lasts, in seconds; ``None``: until it is taken back."""
    revision: int = 0
    """Of the fleet value that brought it: nodes count its age from when they learnt that."""

    def __post_init__(self) -> None:
        check_name("flag.subject", self.subject)
        check_counter("flag.revision", self.revision)
        check_range("flag.for_s", self.for_s, 0.0, MAX_FLAG_S)
        for what in ("reason", "by"):
            check_length(f"flag.{what}", getattr(self, what))


class Rollout(Struct, frozen=True, kw_only=True):
    """A changed worker that a few nodes run already; all others run the one of before, until an operator goes on."""

    task: TaskId
    first: tuple[NodeId, ...]
    """The nodes that run the worker as the text has it; sorted."""
    command: tuple[Text, ...]
    """What every other node runs: program and arguments..."""
    env: tuple[tuple[Text, Text], ...] = ()
    """...and environment."""
    reason: str = ""
    by: str = ""
    """The operator: the name in the certificate, or else the person that the program names."""
    revision: int = 0
    """Of the fleet value that brought it."""

    def __post_init__(self) -> None:
        check_name("rollout.task", self.task)
        check_counter("rollout.revision", self.revision)
        for node in self.first:
            check_name("rollout.first", node)
        for what in ("reason", "by"):
            check_length(f"rollout.{what}", getattr(self, what))
        words = (*self.command, *(word for pair in self.env for word in pair))
        if sum(len(word.encode("utf-8", "surrogatepass")) for word in words) > MAX_HELD_BYTES:
            raise ValueError(f"rollout.command: with its environment larger than {MAX_HELD_BYTES} bytes")


class Document(Struct, frozen=True, kw_only=True):
    """What all machines of a fleet go by, once it is agreed."""

    text: Text
    """The fleet file, comments and all."""
    flags: tuple[Flag, ...] = ()
    rollouts: tuple[Rollout, ...] = ()
    """At most one of a task; sorted."""

    def __post_init__(self) -> None:
        if len(self.text.encode("utf-8", "surrogatepass")) > MAX_DOCUMENT_BYTES:
            raise ValueError(f"document.text: larger than {MAX_DOCUMENT_BYTES} bytes")
        if len(self.flags) > MAX_FLAGS:
            raise ValueError(f"document.flags: more than {MAX_FLAGS}")
        tasks = [one.task for one in self.rollouts]
        if len(tasks) > MAX_ROLLOUTS or len(set(tasks)) < len(tasks):
            raise ValueError(f"document.rollouts: more than {MAX_ROLLOUTS}, or two of one task")


def in_the_name_of(by: str, content: Document, flags: Iterable[Flag], rollouts: Iterable[Rollout]) -> Document:
    """The document, in which all that ``flags`` and ``rollouts``, those so far, do not have is said by ``by``."""
    known, waiting = frozenset(flags), frozenset(rollouts)
    return replace(
        content,
        flags=tuple(flag if flag in known else replace(flag, by=by) for flag in content.flags),
        rollouts=tuple(one if one in waiting else replace(one, by=by) for one in content.rollouts),
    )
