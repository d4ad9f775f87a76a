"""What to do: every instruction of a node to its adapters, in the imperative.

Knows: the order. Does not know: how an adapter carries it out, or whether it worked (that comes back as an event).

The order of a batch is a contract: *persist, then send, then apply*. The shell carries a batch out in order. When the
state cannot be written, it drops the rest of the batch; any other failure it only reports as an event. Every batch is
safe when it is cut after any prefix.
"""

from __future__ import annotations

from zsched.core.values.beat import Beat
from zsched.core.values.decision import Decision, Explanation, Move
from zsched.core.values.document import Document, Flag
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import (
    Accept,
    Accepted,
    Ballots,
    CommandResult,
    FleetAnswer,
    FleetTold,
    Learnt,
    Prepare,
    Promise,
    Refused,
    Utilities,
    Votes,
)
from zsched.core.values.model import NodeId, Proposal, TaskId
from zsched.core.values.plan import Role, RoutePlan
from zsched.core.values.profile import Profile
from zsched.core.values.rehearsal import KeepRehearsal, RehearsalsTold, Strike
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import Struct


class PersistState(Struct, frozen=True, kw_only=True):
    """Write the durable state; the rest of the batch must not happen unless it is on disk."""

    state: DurableState


class PublishBeat(Struct, frozen=True, kw_only=True):
    """Send the heartbeat to everybody, best effort.

    An urgent beat (``is_news``) wakes its receivers up; a periodic one waits until they are awake anyway.
    """

    beat: Beat
    is_news: bool = True


class PublishProfile(Struct, frozen=True, kw_only=True):
    """Send our profile to every gateway; an urgent one (news other than figures) wakes its receivers up."""

    profile: Profile
    is_news: bool = True


class AskUtilities(Struct, frozen=True, kw_only=True):
    """Query every robot's utilities once; answers come back as `UtilityReceived` with this number."""

    gather: int
    deadline_s: float


class AnswerUtilities(Struct, frozen=True, kw_only=True):
    """Answer a peer's gather."""

    request: int
    utilities: Utilities


class PublishProposal(Struct, frozen=True, kw_only=True):
    """Send our ballot paper to every robot."""

    proposal: Proposal


class SendPrepare(Struct, frozen=True, kw_only=True):
    """Ask every elector (ourselves included) for a promise."""

    prepare: Prepare
    deadline_s: float
    may_join: bool = False
    """It may go in one frame with others of the same batch (`SendBallots`)."""


class SendAccept(Struct, frozen=True, kw_only=True):
    """Ask every elector (ourselves included) to accept."""

    accept: Accept
    deadline_s: float
    may_join: bool = False


class SendBallots(Struct, frozen=True, kw_only=True):
    """Ask every elector (ourselves included) several questions in one frame."""

    ballots: Ballots
    deadline_s: float

    @property
    def parts(self) -> tuple[SendPrepare | SendAccept, ...]:
        """The questions to tasks' registers, each as it would go alone."""
        return (
            *(SendPrepare(prepare=one, deadline_s=self.deadline_s) for one in self.ballots.prepares),
            *(SendAccept(accept=one, deadline_s=self.deadline_s) for one in self.ballots.accepts),
        )


class AnswerElection(Struct, frozen=True, kw_only=True):
    """Answer a proposer's prepare or accept."""

    request: int
    answer: Promise | Accepted | Refused


class AnswerBallots(Struct, frozen=True, kw_only=True):
    """Answer a proposer's questions that came in one frame."""

    request: int
    votes: Votes

    @property
    def parts(self) -> tuple[AnswerElection, ...]:
        """The answers of tasks' registers, each as it would go alone."""
        return tuple(AnswerElection(request=self.request, answer=one) for one in self.votes.answers)


class PublishLearnt(Struct, frozen=True, kw_only=True):
    """Send our learnt values to everybody."""

    learnt: Learnt


class AskLearnt(Struct, frozen=True, kw_only=True):
    """Ask one peer for its learnt values; the answer comes back as `LearntReceived`."""

    peer: NodeId
    deadline_s: float


class IntroducePeers(Struct, frozen=True, kw_only=True):
    """A node is missing on the control network: tell every node all addresses again."""


class EndLinks(Struct, frozen=True, kw_only=True):
    """These nodes are gone: end the control session's links to them that are still up. zenoh makes new ones."""

    nodes: tuple[NodeId, ...]


class TryAddresses(Struct, frozen=True, kw_only=True):
    """Nobody was ever heard: find out what becomes of an attempt at each address (`AddressesTried`)."""

    addresses: tuple[str, ...]


class AnswerLearnt(Struct, frozen=True, kw_only=True):
    """Answer a peer's `AskLearnt`."""

    request: int
    learnt: Learnt


class StartWorker(Struct, frozen=True, kw_only=True):
    """Start this node's worker for the task; nothing happens if it runs."""

    task: TaskId


class StopWorker(Struct, frozen=True, kw_only=True):
    """Stop this node's worker for the task (a cold standby, after its drain)."""

    task: TaskId


class RestartWorker(Struct, frozen=True, kw_only=True):
    """This node's worker for the task hangs: kill it, count a failure, start it again."""

    task: TaskId
    reason: str


class StrikeDaemon(Struct, frozen=True, kw_only=True):
    """An operator rehearses: answer whether this machine can do it to this daemon, and do it."""

    request: int
    strike: Strike
    fleet: Fleet
    """Whose links they are."""


class StoreRehearsal(Struct, frozen=True, kw_only=True):
    """Keep what a rehearsal has found on this machine, and answer."""

    request: int
    rehearsal: KeepRehearsal


class AnswerRehearsals(Struct, frozen=True, kw_only=True):
    """Answer an operator's question for promises and kept rehearsals; what is kept is filled in from the disk."""

    request: int
    told: RehearsalsTold
    name: str
    """The rehearsal that is wanted whole."""


class RenewWorker(Struct, frozen=True, kw_only=True):
    """An operator wants this node's worker for the task stopped and started again; that is no failure."""

    task: TaskId


class AdoptFleet(Struct, frozen=True, kw_only=True):
    """Go by another fleet file: commands, environments, sessions to come, and what the relay watches.

    It is the first instruction of its batch that is not sent.
    """

    fleet: Fleet
    """As it was read: what this daemon cannot take over is to be told to the operator."""
    is_agreed: bool = False
    """It is an agreed document: electors and leases are those in force."""


class EndTask(Struct, frozen=True, kw_only=True):
    """The task left the fleet file: the relay ends its streams and forgets it."""

    task: TaskId


class SetRole(Struct, frozen=True, kw_only=True):
    """Tell this node's worker its role."""

    role: Role


class ApplyRoutes(Struct, frozen=True, kw_only=True):
    """Give the relay the newest plan of one task."""

    plan: RoutePlan


class AnswerStatus(Struct, frozen=True, kw_only=True):
    """Answer an operator."""

    request: int
    snapshot: Snapshot


class AnswerCommand(Struct, frozen=True, kw_only=True):
    """Answer an operator's command."""

    request: int
    result: CommandResult


class AnswerExplanation(Struct, frozen=True, kw_only=True):
    """Answer an operator's question about a task's last judgement."""

    request: int
    explanation: Explanation


class AnswerLines(Struct, frozen=True, kw_only=True):
    """Answer an operator with what this node's worker for the task has printed behind line ``after``."""

    request: int
    task: TaskId
    after: int


class AnswerHistory(Struct, frozen=True, kw_only=True):
    """Answer an operator with a page of this node's decision log: its moves behind ``cursor``."""

    request: int
    cursor: str


class TakeCertificate(Struct, frozen=True, kw_only=True):
    """Keep a newer certificate for this node's key (PEM) if it is one, and answer who has sent it."""

    request: int
    certificate: str


class StandDown(Struct, frozen=True, kw_only=True):
    """End this daemon with the exit code of a wrong configuration: its name is alive elsewhere."""

    reason: str


class RecordStory(Struct, frozen=True, kw_only=True):
    """One line for the journal and the decision log: a decision, a commit, a handover step, a peer's change."""

    stage: str
    """One of the six words (``profile``..``route``), or ``membership``."""
    text: str
    task: TaskId = ""
    epoch: int = 0
    decision: Decision | None = None
    """With it, this is a judgement that has changed."""
    move: Move | None = None
    """With it, this is a change of owner."""
    took_s: float | None = None
    """With it, this node's streams have switched to the owner of ``epoch``, this long after it learnt the value."""
    gap_s: float | None = None
    """With it, one of this node's output streams was without an answer for this long, until the owner of ``epoch``
    answered."""
    rehearsal: str = ""
    """With it, an operator has rehearsed; this is the rehearsal's name."""
    is_rollout: bool = False
    """It tells of a changed worker that waits for an operator's look, or waits no more."""
    by: str = ""
    """With it, an operator has changed something; this is who."""


# --- of the fleet register -------------------------------------------------------------------------------------------


class AskElectors(Struct, frozen=True, kw_only=True):
    """Ask these electors (this node may be one) a question of the fleet register."""

    to: tuple[NodeId, ...]
    question: Prepare | Accept[FleetValue]
    deadline_s: float
    may_join: bool = False
    """It may go in one frame with questions of tasks' registers to the same electors (`SendBallots`)."""


class TellFleet(Struct, frozen=True, kw_only=True):
    """Tell nodes the fleet value that this node has learnt."""

    to: tuple[NodeId, ...]
    value: FleetValue


class AskFleet(Struct, frozen=True, kw_only=True):
    """Ask a node for the fleet value that it has learnt: it counts by a higher number."""

    peer: NodeId


class AnswerFleet(Struct, frozen=True, kw_only=True):
    """Answer a question to the fleet register."""

    request: int
    answer: FleetAnswer


class StoreDocument(Struct, frozen=True, kw_only=True):
    """An operator gave this document: check it and write it; `DocumentStored` or `DocumentRefused` comes back."""

    request: int
    content: Document


class AmendDocument(Struct, frozen=True, kw_only=True):
    """Write the stored document with this hash once more, with other flags.

    `DocumentStored` comes back, without a request. If the document is not stored here any more, nothing comes back.
    """

    document: str
    flags: tuple[Flag, ...]


class FetchDocument(Struct, frozen=True, kw_only=True):
    """Fetch the document with this hash from one of the peers, in this order; check it and write it.

    `DocumentStored` or `DocumentRefused` comes back. If no peer has it, nothing comes back: the node asks again later.
    """

    document: str
    peers: tuple[NodeId, ...]


class AnswerDocument(Struct, frozen=True, kw_only=True):
    """Answer a peer with the document that has this hash, or with nothing if it is not stored here."""

    request: int
    document: str


class AnswerFleetRead(Struct, frozen=True, kw_only=True):
    """Answer an operator by which fleet value this node goes; with the value's document if that is asked for."""

    request: int
    told: FleetTold
    with_document: bool


class KeepDocuments(Struct, frozen=True, kw_only=True):
    """Delete every stored document but these."""

    documents: tuple[str, ...]


FleetInstruction = AskElectors | TellFleet | AskFleet
"""What the fleet register asks of other nodes; `zsched.core.electorate.numbers` says which instructions carry it."""


Instruction = (
    PersistState
    | PublishBeat
    | PublishProfile
    | AskUtilities
    | AnswerUtilities
    | PublishProposal
    | SendPrepare
    | SendAccept
    | SendBallots
    | AnswerElection
    | AnswerBallots
    | AskElectors
    | AnswerFleet
    | StoreDocument
    | AmendDocument
    | FetchDocument
    | AnswerDocument
    | AnswerFleetRead
    | KeepDocuments
    | PublishLearnt
    | AskLearnt
    | AnswerLearnt
    | IntroducePeers
    | EndLinks
    | TryAddresses
    | StartWorker
    | StopWorker
    | RestartWorker
    | RenewWorker
    | StrikeDaemon
    | StoreRehearsal
    | AnswerRehearsals
    | AdoptFleet
    | EndTask
    | SetRole
    | ApplyRoutes
    | AnswerStatus
    | AnswerCommand
    | AnswerExplanation
    | AnswerLines
    | AnswerHistory
    | TakeCertificate
    | StandDown
    | RecordStory
)
