"""Messages between nodes beyond the stages' own values: ballots of the register, answers, commands.

Knows: the fields of each message and their ranges. Does not know: keys, bytes, or who may send which.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum
from typing import Final, Generic, get_args

from zsched.core.values.decision import HistoryLine
from zsched.core.values.document import Document, Text
from zsched.core.values.electorate import FleetValue, check_id
from zsched.core.values.model import (
    MAX_FOR_S,
    Acceptance,
    Allocation,
    Asked,
    Ballot,
    NodeId,
    TaskId,
    Tuning,
    UtilityVector,
    V,
    check_counter,
    check_name,
)
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, Strike
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import MAX_ASKER, check_range

_CURSOR: Final = re.compile(r"([0-9]{1,20}:[0-9]{1,15})?")
"""A file of the log and an offset in it (`zsched.host.decision_log`)."""
MAX_CERTIFICATE: Final = 4096
"""Characters of a certificate that is sent to a node; those of `zsched pki` have 900."""


class Prepare(Struct, frozen=True, kw_only=True):
    """Phase 1 of a round: asks an elector to promise ``ballot`` (Synod, phase 1a)."""

    task: TaskId
    ballot: Ballot
    electorate: str
    """Hash of the electorate that the proposer counts with; a differing one is refused."""
    creation: int = 0
    generation_id: str = ""
    number: int = 0
    """Of the fleet value that the proposer counts by; another generation gets no answer, another number a no."""

    def __post_init__(self) -> None:
        check_name("prepare.task", self.task)


class Promise(Struct, Generic[V], frozen=True, kw_only=True):
    """An elector's yes to a `Prepare`: persisted, with its earlier acceptance (Synod, phase 1b)."""

    elector: NodeId
    task: TaskId
    ballot: Ballot
    accepted: Acceptance[V] | None = None
    disk: str = ""
    joining: int = 0
    """With ``disk``: the seat for which the elector answers; one that the round does not count with is no answer."""

    def __post_init__(self) -> None:
        check_name("promise.elector", self.elector)
        check_name("promise.task", self.task)


class Accept(Struct, Generic[V], frozen=True, kw_only=True):
    """Phase 2 of a round: asks an elector to accept ``acceptance`` (Synod, phase 2a)."""

    task: TaskId
    acceptance: Acceptance[V]
    electorate: str
    creation: int = 0
    generation_id: str = ""
    number: int = 0

    def __post_init__(self) -> None:
        check_name("accept.task", self.task)
        if self.acceptance.value.task != self.task:
            raise ValueError(f"accept: value of {self.acceptance.value.task!r} for task {self.task!r}")


class Accepted(Struct, frozen=True, kw_only=True):
    """An elector's yes to an `Accept`: persisted (Synod, phase 2b)."""

    elector: NodeId
    task: TaskId
    ballot: Ballot
    disk: str = ""
    joining: int = 0

    def __post_init__(self) -> None:
        check_name("accepted.elector", self.elector)
        check_name("accepted.task", self.task)


class Refusal(StrEnum):
    """Why an elector says no."""

    BALLOT = "ballot"  # it promised a higher one
    ELECTORATE = "electorate"  # the proposer counts with another electorate
    NOT_ELECTOR = "not_elector"  # it is none, or lost its state
    LEASE = "lease"  # an exclusive task's grant is still running
    RATE = "rate"  # this proposer asks too often
    VALUE = "value"  # it does not take this value for a true one: its fleet file knows no such node
    DOCUMENT = "document"  # it has not stored the document of this fleet value yet
    NUMBER = "number"  # it counts by another number of the fleet value, or has no such register
    YOUNG = "young"  # it has just started, and asks the others first what they remember of it


class Refused(Struct, frozen=True, kw_only=True):
    """An elector's no; ``promised`` tells the proposer which counter to beat."""

    elector: NodeId
    task: TaskId
    ballot: Ballot
    refusal: Refusal
    promised: Ballot
    number: int = 0
    """By which the elector counts."""
    fleet: FleetValue | None = None
    """The elector's learnt fleet value, for a proposer whose number is lower."""

    def __post_init__(self) -> None:
        check_name("refused.elector", self.elector)
        check_name("refused.task", self.task)


MOST_BALLOTS = 24
"""Tasks of one `Ballots`, so that no batch of the largest questions and answers is too large for a frame."""


class Ballots(Struct, frozen=True, kw_only=True):
    """Questions of several registers to an elector, in one frame: each counts as if it had come alone.

    Only what settles a fleet's electors travels so, and only at its first try: an elector of an older version does not
    read it.
    """

    prepares: tuple[Prepare, ...] = ()
    accepts: tuple[Accept, ...] = ()
    ahead: Prepare | None = None
    """To the fleet's register, for the change that says that the electors are settled."""
    fleet: FleetValue | None = None
    """The learnt fleet value by whose number is asked, while that is not settled: an elector may not know it yet."""

    def __post_init__(self) -> None:
        _check_batch("ballots", len(self.prepares) + len(self.accepts), has_more=self.ahead is not None)


class Votes(Struct, frozen=True, kw_only=True):
    """One elector's answers to `Ballots`; a question that it would not answer alone has none here."""

    promises: tuple[Promise, ...] = ()
    accepted: tuple[Accepted, ...] = ()
    refused: tuple[Refused, ...] = ()
    ahead: FleetAnswer | None = None
    """Of the fleet's register."""

    def __post_init__(self) -> None:
        _check_batch("votes", len(self.answers), has_more=self.ahead is not None)
        names = {one.elector for one in self.answers} | ({self.ahead.content.elector} if self.ahead else set())
        if len(names) != 1:
            raise ValueError("votes: expected the answers of one elector")

    @property
    def answers(self) -> tuple[Promise | Accepted | Refused, ...]:
        """All those of tasks' registers."""
        return (*self.promises, *self.accepted, *self.refused)

    @property
    def elector(self) -> NodeId:
        """Whose answers they are."""
        return self.answers[0].elector if self.ahead is None else self.ahead.content.elector


def _check_batch(what: str, count: int, *, has_more: bool) -> None:
    if not (0 if has_more else 1) <= count <= MOST_BALLOTS:
        raise ValueError(f"{what}: expected 1 to {MOST_BALLOTS}, not {count}")


def votes_of(answers: Iterable[Promise | Accepted | Refused], ahead: FleetAnswer | None = None) -> Votes:
    """One elector's answers as they travel: the newest fleet value goes along once, not with each no."""
    promises: list[Promise] = []
    accepted: list[Accepted] = []
    refused: list[Refused] = []
    told: FleetValue | None = None
    for answer in answers:
        if isinstance(answer, Promise):
            promises.append(answer)
        elif isinstance(answer, Accepted):
            accepted.append(answer)
        else:
            refused.append(replace(answer, fleet=None) if answer.fleet == told else answer)
            told = answer.fleet or told
    return Votes(promises=tuple(promises), accepted=tuple(accepted), refused=tuple(refused), ahead=ahead)


class FleetQuestion(Struct, frozen=True, kw_only=True):
    """A question of the fleet register to an elector: one of the two."""

    prepare: Prepare | None = None
    accept: Accept[FleetValue] | None = None

    def __post_init__(self) -> None:
        if (self.prepare is None) == (self.accept is None):
            raise ValueError("fleet_question: expected a prepare or an accept")

    @property
    def content(self) -> Prepare | Accept[FleetValue]:
        """The question itself."""
        asked = self.prepare or self.accept
        assert asked is not None
        return asked

    @property
    def ballot(self) -> Ballot:
        """The proposer's ballot."""
        content = self.content
        return content.ballot if isinstance(content, Prepare) else content.acceptance.ballot


def fleet_question(content: Prepare | Accept[FleetValue]) -> FleetQuestion:
    """A question of the fleet register as it travels."""
    return FleetQuestion(prepare=content) if isinstance(content, Prepare) else FleetQuestion(accept=content)


class FleetAnswer(Struct, frozen=True, kw_only=True):
    """An elector's answer to a `FleetQuestion`: one of the three."""

    promise: Promise[FleetValue] | None = None
    accepted: Accepted | None = None
    refused: Refused | None = None

    def __post_init__(self) -> None:
        if sum(one is not None for one in (self.promise, self.accepted, self.refused)) != 1:
            raise ValueError("fleet_answer: expected a promise, an acceptance or a refusal")

    @property
    def content(self) -> Promise[FleetValue] | Accepted | Refused:
        """The answer itself."""
        answer = self.promise or self.accepted or self.refused
        assert answer is not None
        return answer


def fleet_answer(content: Promise[FleetValue] | Accepted | Refused) -> FleetAnswer:
    """An answer of the fleet register as it travels."""
    if isinstance(content, Accepted):
        return FleetAnswer(accepted=content)
    return FleetAnswer(refused=content) if isinstance(content, Refused) else FleetAnswer(promise=content)


class AskDocument(Struct, frozen=True, kw_only=True):
    """Asks a node for the document with this hash; the answer is the `Document`, or nothing."""

    document: str

    def __post_init__(self) -> None:
        check_id("ask_document.document", self.document)


class Learnt(Struct, frozen=True, kw_only=True):
    """Register values that ``node`` has learnt, one per task; sent on every change and to late joiners."""

    node: NodeId
    values: tuple[Allocation, ...]
    generation: int = 0
    has_voted: bool = False
    """Whether ``node`` has ever promised anything as an elector."""
    lease_terms: str = ""
    """The terms of its leases (`zsched.core.values.fleet.lease_terms`)."""
    unleased: tuple[TaskId, ...] = ()
    """Tasks whose worker there may be working without a lease."""
    incarnation: int = 0
    """Incarnation of its state; 0: it has none."""
    fleet: FleetValue | None = None
    """The fleet value; ``None`` while it is the one that every node makes of its file."""
    votes: int = 0
    """How many promises and acceptances it has ever given."""
    seen: tuple[tuple[NodeId, int, int], ...] = ()
    """(elector, incarnation, votes) that it remembers of others (`zsched.core.vote.witness`)."""
    daemon: int = 0
    """Incarnation of the daemon that answers, whether it has a state or not."""
    twins: tuple[tuple[NodeId, int, int], ...] = ()
    """(name, incarnation, newest beat) of daemons that share a name (`zsched.core.membership.namesakes`)."""

    def __post_init__(self) -> None:
        check_name("learnt.node", self.node)
        check_counter("learnt.generation", self.generation)


class Utilities(Struct, frozen=True, kw_only=True):
    """A robot's answer to a gather: its vectors for all tasks."""

    voter: NodeId
    vectors: tuple[UtilityVector, ...]

    def __post_init__(self) -> None:
        check_name("utilities.voter", self.voter)


class ExplainTask(Struct, frozen=True, kw_only=True):
    """Operator question to one node: its last judgement of a task, with every figure."""

    task: TaskId

    def __post_init__(self) -> None:
        check_name("explain.task", self.task)


class RestartTask(Struct, frozen=True, kw_only=True):
    """Operator command to one node: stop its worker for the task, and start it again."""

    task: TaskId
    asked: Asked | None = None
    """``None``: by an older program."""

    def __post_init__(self) -> None:
        check_name("restart.task", self.task)


class TakeCertificate(Struct, frozen=True, kw_only=True):
    """Operator command to one node: go by a newer certificate for the key that it has.

    Nobody needs to be trusted for it: the node looks at the authority's signature.
    """

    certificate: Text
    """PEM."""

    def __post_init__(self) -> None:
        if len(self.certificate) > MAX_CERTIFICATE:
            raise ValueError(f"certificate: {len(self.certificate)} characters, at most {MAX_CERTIFICATE}")


class ReadLines(Struct, frozen=True, kw_only=True):
    """Operator's question to one node: what its worker for the task has printed behind line ``after``."""

    task: TaskId
    after: int = 0

    def __post_init__(self) -> None:
        check_name("lines.task", self.task)
        check_counter("lines.after", self.after)


class ReadHistory(Struct, frozen=True, kw_only=True):
    """Operator's question to one node: what its decision log tells of moves, rehearsals and rollouts."""

    cursor: str = ""
    """Where the page before ended; empty: begin with the oldest line."""

    def __post_init__(self) -> None:
        if _CURSOR.fullmatch(self.cursor) is None:
            raise ValueError(f"history.cursor: {self.cursor!r:.80} is no place in a log")


class ChangeFleet(Struct, frozen=True, kw_only=True):
    """Operator command to one node: commit one change of the fleet. Exactly one of the three changes is given.

    The answer comes when a majority of the electors has the change; settling them may go on after that.
    """

    document: Document | None = None
    """Go by this document: the first one that is agreed, or another one."""
    add_elector: NodeId = ""
    """Let this node be an elector, too; it holds its seat with the disk whose id is ``disk``."""
    disk: str = ""
    remove_elector: NodeId = ""
    base_revision: int | None = None
    """The fleet value's revision that the operator saw; ``None``: whatever is current at this node."""
    reason: str = ""
    """What for, as the operator's program says it; it stands in the journal."""
    asked: Asked | None = None
    """``None``: by an older program."""

    def __post_init__(self) -> None:
        for name in filter(None, (self.add_elector, self.remove_elector)):
            check_name("fleet.elector", name)
        check_id("fleet.disk", self.disk)
        check_counter("fleet.base_revision", self.base_revision or 0)
        if sum(map(bool, (self.document, self.add_elector, self.remove_elector))) != 1:
            raise ValueError("fleet: expected one of document, add_elector and remove_elector")
        if self.add_elector and not self.disk:
            raise ValueError(f"fleet.disk: {self.add_elector} needs the id of its disk")


class ReadFleet(Struct, frozen=True, kw_only=True):
    """Operator's question to one node: by which fleet value and document it goes."""

    with_document: bool = True
    """Tell the document itself, too: it may be large."""


class MoveTask(Struct, frozen=True, kw_only=True):
    """Operator command: hand a task over to a candidate, through the register."""

    task: TaskId
    node: NodeId
    asked: Asked
    origin: NodeId | None = None
    """Only while this node is the owner."""
    base_revision: int | None = None
    is_plan: bool = False
    """Only say whether it could be done."""

    def __post_init__(self) -> None:
        check_name("move.task", self.task)
        check_name("move.node", self.node)


class Hold(StrEnum):
    """An operator's lasting order about a task, or the end of one."""

    PAUSE = "pause"
    RESUME = "resume"
    PIN = "pin"
    UNPIN = "unpin"


class HoldTask(Struct, frozen=True, kw_only=True):
    """Operator command: give a lasting order about a task, or end it, through the register."""

    task: TaskId
    hold: Hold
    asked: Asked
    node: NodeId = ""
    """Where a task is pinned; empty: to its owner."""
    is_hard: bool = False
    for_s: float | None = None
    base_revision: int | None = None

    def __post_init__(self) -> None:
        check_name("hold.task", self.task)
        if self.node:
            check_name("hold.node", self.node)
        check_range("hold.for_s", self.for_s, 1.0, MAX_FOR_S)


class TuneTask(Struct, frozen=True, kw_only=True):
    """Operator command: another tuning of a task, made of that of ``base_revision``, through the register."""

    task: TaskId
    tuning: Tuning
    base_revision: int
    asked: Asked

    def __post_init__(self) -> None:
        check_name("tune.task", self.task)
        check_counter("tune.base_revision", self.base_revision)


Command = (
    Strike
    | KeepRehearsal
    | ReadRehearsals
    | ExplainTask
    | RestartTask
    | TakeCertificate
    | ReadLines
    | ReadHistory
    | MoveTask
    | HoldTask
    | TuneTask
    | ChangeFleet
    | ReadFleet
)
COMMANDS: tuple[type, ...] = get_args(Command)
Ordered = Strike | KeepRehearsal | RestartTask | MoveTask | HoldTask | TuneTask | ChangeFleet
"""Commands that carry who gives them (``asked``)."""
Asking = ExplainTask | ReadLines | ReadHistory | ReadFleet | ReadRehearsals
"""Commands that only ask: given twice they change nothing."""
Agreed = MoveTask | HoldTask | TuneTask | ChangeFleet
"""Orders whose end comes when the electors have agreed, or cannot. A node knows the end of the others at once."""


def asked_by(name: str, command: Ordered) -> Command:
    """An order that ``name`` gives, whoever it says has given it (an older tool says nothing)."""
    said = command.asked
    return replace(command, asked=Asked(by=name) if said is None else replace(said, by=name))


def asked_at(node: NodeId, command: Command) -> Command:
    """A command as ``node`` may pass it on: a program there names its user, and neither an operator nor another node.

    The user may come from another cell (``user@fleet/node``). A program that names nobody leaves the node's own name.
    """
    if not isinstance(command, Ordered):
        return command
    if command.asked is None:
        return asked_by(node, command)
    user, _, place = command.asked.by.partition("@")
    if place == node or place.endswith(f"/{node}"):
        return command
    return asked_by(f"{user[: MAX_ASKER - len(node) - 1]}@{node}", command)


class FleetTold(Struct, frozen=True, kw_only=True):
    """The answer to `ReadFleet`."""

    node: NodeId
    value: FleetValue | None
    """What it has learnt; ``None`` while it does not know the fleet's generation."""
    fleet_file: str
    """Hash of the fleet by which it goes, whether a document or its own file says it (`fleet_hash`)."""
    disk: str = ""
    """Id of the disk with which it may be an elector; empty: it has no state."""
    content: Document | None = None
    """The document of the value; ``None``: not asked for, none is agreed, or it is not stored there."""

    def __post_init__(self) -> None:
        check_name("fleet_told.node", self.node)
        check_id("fleet_told.disk", self.disk)


class WorkerLine(Struct, frozen=True, kw_only=True):
    """One line that a worker has printed."""

    number: int
    """Counted since the daemon started, from 1; one that is left out was not kept."""
    age_s: float
    text: str


class WorkerLines(Struct, frozen=True, kw_only=True):
    """The answer to `ReadLines`: the oldest lines behind the one that was named, as many as fit."""

    node: NodeId
    task: TaskId
    lines: tuple[WorkerLine, ...] = ()
    newest: int = 0
    """The number of the newest line that is kept: more can be had while ``lines`` end before it."""
    is_here: bool = True
    """Whether this node starts a worker of the task; if it does not, there is no output to keep."""

    def __post_init__(self) -> None:
        check_name("worker_lines.node", self.node)
        check_name("worker_lines.task", self.task)


class HistoryTold(Struct, frozen=True, kw_only=True):
    """The answer to `ReadHistory`: a page of the log, the oldest line first."""

    node: NodeId
    now: float
    """Its wall clock: ages are made of it and of the lines' times, which are by the same clock."""
    lines: tuple[HistoryLine, ...] = ()
    cursor: str = ""
    """Where the page ends."""
    has_more: bool = False

    def __post_init__(self) -> None:
        check_name("history_told.node", self.node)


class CommandOutcome(StrEnum):
    """How a command ended; `OK` and `UNCHANGED` are success."""

    OK = "ok"
    UNCHANGED = "unchanged"
    CONFLICT = "conflict"  # the value had changed meanwhile
    NO_QUORUM = "no_quorum"
    INVALID = "invalid"
    UNKNOWN = "unknown"  # the round's outcome is not known; ask status


class CommandResult(Struct, frozen=True, kw_only=True):
    """The answer to an operator's command."""

    outcome: CommandOutcome
    detail: str
    revision: int | None = None
