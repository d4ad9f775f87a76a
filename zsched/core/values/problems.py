"""Which problem it is: programs go by its kind, people read its sentence.

Knows: the kinds that something hangs on, the order in which problems are shown. Does not know: a sentence. It loads in
no time, as `zsched.core.values.words`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

ProblemKey = tuple[str, str]
"""(kind, subject: a node, a task, a part of the relay; or empty)."""
Told = str | tuple[str, str]
"""(kind, sentence); or a sentence that only people read."""


class Problem(StrEnum):
    """The kinds that something hangs on; what only people read is `OTHER`, or has its source's name (``measuring``)."""

    BEAT = "beat"
    CERTIFICATE = "certificate"
    """This node's own is not valid, or not for long."""
    CLOCK = "clock"
    """This node's cannot be trusted."""
    DOCUMENT = "fleet/document"
    """The agreed document is not in force here."""
    FLEET = "fleet"
    """A changed file is not in force here; with a subject: that node goes by another file, or is in none."""
    GENERATION = "generation"
    """The subject is a node of another generation."""
    MEMBERSHIP = "membership"
    """Another daemon has this node's name."""
    NEVER_INITIALISED = "never_initialised"
    """No elector has a state, and no node remembers one."""
    NO_QUORUM = "no_quorum"
    NO_SPARE = "no_spare"
    """No other living candidate could take the task over."""
    NOTHING_AGREED = "nothing_agreed"
    """Too many electors are without their states."""
    OTHER = "other"
    OWN_FILE = "fleet/file"
    """The fleet file here differs from the agreed document, which it may for good."""
    RELAY = "relay"
    """It is down; with a subject: a part of it does not work."""
    STATE = "state"
    """Why this node is no elector."""
    STATELESS = "stateless"
    """Electors are without their states."""
    TAKEN_OUT = "taken_out"
    """The agreed document does not name this node: `zsched leave` puts its files away."""
    WORKER_FAILED = "worker_failed"


def told_of(problems: Mapping[ProblemKey, str]) -> list[Told]:
    """All of these, in the order of the sources with which their sentences begin."""
    of = {(kind, subject): f"{kind}/{subject}" if subject else kind for kind, subject in problems}
    of |= {key: str(Problem.DOCUMENT) for key in of if key[0] == Problem.TAKEN_OUT}
    return [(key[0], f"{of[key]}: {problems[key]}") for key in sorted(problems, key=of.__getitem__)]


def parted(*found: Told) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The sentences, and the kind of each."""
    pairs = [(Problem.OTHER, one) if isinstance(one, str) else one for one in found]
    return tuple(text for _, text in pairs), tuple(str(kind) for kind, _ in pairs)


def of_kind(said: Mapping[str, Any], *kinds: str) -> list[str]:
    """Those sentences in a plain status, or in one of its tasks; none where an older daemon tells no kinds."""
    return [text for text, kind in zip(said["problems"], said.get("problem_kinds", ()), strict=False) if kind in kinds]
