"""What a check is, what it may look at, and what it may say.

Knows: verdicts, what a check needs before it can be made. Does not know: any check, how results are shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Any, Final, TypeAlias

from zsched.config.difference import SEAT_AGAIN
from zsched.config.load import CheckResult
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field
from zsched.host.paths import is_there

Json: TypeAlias = dict[str, Any]


class Verdict(StrEnum):
    """What came of a check."""

    PASS = "PASS"
    SKIP = "SKIP"
    WARN = "WARN"
    FAIL = "FAIL"


SEAT_ADVICE: Final = f"while {{names}} run: {', '.join(SEAT_AGAIN)}"
"""Of electors that the document names, and that are none."""
OTHER_ELECTORS: Final = (
    "the files name other electors: restart no daemon, for one that starts by the other file is no elector any more; "
    "docs/guide/service.md, Add or remove a machine"
)
"""Of a daemon that goes by another fleet file, where no document is agreed."""
_ORDER = (Verdict.SKIP, Verdict.PASS, Verdict.WARN, Verdict.FAIL)


class Result(Struct, frozen=True, kw_only=True):
    """One check's verdict, what was seen, and what to do about it."""

    verdict: Verdict
    evidence: tuple[str, ...]
    fix: str = ""


def passed(*evidence: str) -> Result:
    """Nothing is wrong."""
    return Result(verdict=Verdict.PASS, evidence=evidence)


def skipped(*evidence: str) -> Result:
    """The check does not apply here, or could not be made."""
    return Result(verdict=Verdict.SKIP, evidence=evidence)


def warned(*evidence: str, fix: str) -> Result:
    """It works, and is not as it should be."""
    return Result(verdict=Verdict.WARN, evidence=evidence, fix=fix)


def failed(*evidence: str, fix: str) -> Result:
    """Something does not work."""
    return Result(verdict=Verdict.FAIL, evidence=evidence, fix=fix)


def counted(number: int, plural: str) -> str:
    """A count with its noun: ``1 node``, ``2 nodes``."""
    return f"{number} {plural if number != 1 else plural.removesuffix('s')}"


def joined(parts: Iterable[Result], otherwise: Result) -> Result:
    """One result of several: the worst verdict, and the evidence and fixes of those that have it or are faults.

    Without parts it is ``otherwise``.
    """
    found = list(parts)
    if not found:
        return otherwise
    worst = max((part.verdict for part in found), key=_ORDER.index)
    shown = [part for part in found if part.verdict in (Verdict.WARN, Verdict.FAIL) or part.verdict is worst]
    evidence = tuple(line for part in shown for line in part.evidence)
    fixes = dict.fromkeys(part.fix for part in shown if part.fix)
    return Result(verdict=worst, evidence=evidence, fix="; ".join(fixes))


class Needs(IntEnum):
    """What must be there before a check can be made."""

    NOTHING = 0
    FILE = 1
    """A valid fleet file."""
    NODE = 2
    """This machine is a node of it."""
    STATUS = 3
    """The daemon on this machine answers."""
    FLEET = 4
    """The whole fleet is asked (``--fleet``), by a valid fleet file."""


class Scene(Struct, frozen=True, kw_only=True):
    """All that checks look at; ``root`` is "/" but in tests."""

    file: Path
    """The fleet file."""
    reading: CheckResult
    """What the file says."""
    node: NodeId
    """What this machine is called."""
    state_folder: Path
    document: CheckResult | None = None
    """What the agreed document says, with the electors that are agreed; ``None``: none is agreed, or it is not here."""
    text: str = ""
    """The document itself."""
    revision: int = 0
    """Of the fleet value that has this document."""
    unseated: tuple[NodeId, ...] = ()
    """The electors that the document names, and that are none."""
    own: Json | None = None
    """The status of the daemon on this machine; ``None`` when it does not answer."""
    refusal: str = ""
    """Why it does not."""
    relay_version: str = ""
    """Of the relay that runs here; empty: none runs, or its note may not be read."""
    is_fleet: bool = False
    statuses: Mapping[NodeId, Json] = field(default_factory=dict)
    """Of every node that answers, with ``is_fleet``; the own one is among them."""
    answered_s: Mapping[NodeId, float] = field(default_factory=dict)
    """How long the answer of each node took that was asked through the daemon here."""
    sides: Mapping[str, str] = field(default_factory=dict)
    """How to join the data network here: {side: zenoh configuration}."""
    root: Path = Path("/")

    @property
    def known(self) -> Fleet | None:
        """By what this machine goes: the agreed document, else the fleet file; ``None``: neither can be read."""
        held = None if self.document is None else self.document.fleet
        return self.reading.fleet if held is None else held

    @property
    def fleet(self) -> Fleet:
        """The same; only for checks that need it."""
        if self.known is None:
            raise InvariantError("a check of the doctor needs a fleet file and does not say so")
        return self.known

    @property
    def source(self) -> str:
        """Where that stands."""
        return str(self.file) if self.document is None else f"the agreed document (revision {self.revision})"

    @property
    def me(self) -> NodeSpec:
        """This machine in the fleet; only for checks that need it."""
        return self.fleet.node(self.node)

    @property
    def status(self) -> Json:
        """The own daemon's status; only for checks that need it."""
        if self.own is None:
            raise InvariantError("a check of the doctor needs a status and does not say so")
        return self.own

    @property
    def is_node(self) -> bool:
        """Whether the fleet names this machine."""
        fleet = self.known
        return fleet is not None and any(spec.name == self.node for spec in fleet.nodes)

    @property
    def is_visit(self) -> bool:
        """Whether this is no node of the fleet, such as an operator's laptop: then only the fleet is looked at."""
        is_bare = self.own is None and not is_there(self.state_folder)
        return self.is_fleet and self.known is not None and not self.is_node and is_bare

    def at(self, path: str | Path) -> Path:
        """Where an absolute path of the machine is."""
        return self.root / str(path).lstrip("/")


def goes_by_other_electors(scene: Scene, status: Json) -> bool:
    """Whether the node that answered ``status`` has other electors in force than the fleet file here names."""
    return sorted(status["quorum"]["names"]) != sorted(scene.fleet.electors)


class Check(Struct, frozen=True, kw_only=True):
    """One question about this machine or its fleet. ``name`` is ``family.word`` and never changes its meaning."""

    name: str
    asks: str
    """The question, of which "yes" is a pass."""
    run: Callable[[Scene], Result]
    needs: Needs = Needs.NODE
