"""What to do: every instruction of a node to its adapters, in the imperative.

Knows: the order. Does not know: how an adapter carries it out, or whether it worked (that comes back as an event).

The order of a batch is a contract: *persist, then send, then apply*. The shell carries a batch out in order. When the
state cannot be written, it drops the rest of the batch; any other failure it only reports as an event. Every batch is
safe when it is cut after any prefix.
"""

from __future__ import annotations

from dataclasses import dataclass

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
from zsched.core.values.model import Beat, NodeId, Profile, Proposal, TaskId
from zsched.core.values.plan import Role, RoutePlan
from zsched.core.values.rehearsal import KeepRehearsal, RehearsalsTold, Strike
from zsched.core.values.snapshot import Snapshot


@dataclass(frozen=True, slots=True, kw_only=True)
class PersistState:
    """Write the durable state; the rest of the batch must not happen unless it is on disk."""

    state: DurableState


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishBeat:
    """Send the heartbeat to everybody, best effort.

    An urgent beat (``is_news``) wakes its receivers up; a periodic one waits until they are awake anyway.
    """

    beat: Beat
    is_news: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishProfile:
    """Send our profile to every gateway; an urgent one (news other than figures) wakes its receivers up."""

    profile: Profile
    is_news: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class AskUtilities:
    """Query every robot's utilities once; answers come back as `UtilityReceived` with this number."""

    gather: int
    deadline_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerUtilities:
    """Answer a peer's gather."""

    request: int
    utilities: Utilities


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishProposal:
    """Send our ballot paper to every robot."""

    proposal: Proposal


@dataclass(frozen=True, slots=True, kw_only=True)
class SendPrepare:
    """Ask every elector (ourselves included) for a promise."""

    prepare: Prepare
    deadline_s: float
    may_join: bool = False
    """It may go in one frame with others of the same batch (`SendBallots`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SendAccept:
    """Ask every elector (ourselves included) to accept."""

    accept: Accept
    deadline_s: float
    may_join: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SendBallots:
    """Ask every elector (ourselves included) several questions in one frame."""

    ballots: Ballots
    deadline_s: float

    @property
    def parts(self) -> tuple[SendPrepare | SendAccept, ...]:
        """The questions, each as it would go alone."""
        return (
            *(SendPrepare(prepare=one, deadline_s=self.deadline_s) for one in self.ballots.prepares),
            *(SendAccept(accept=one, deadline_s=self.deadline_s) for one in self.ballots.accepts),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerElection:
    """Answer a proposer's prepare or accept."""

    request: int
    answer: Promise | Accepted | Refused


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerBallots:
    """Answer a proposer's questions that came in one frame."""

    request: int
    votes: Votes

    @property
    def parts(self) -> tuple[AnswerElection, ...]:
        """The answers, each as it would go alone."""
        return tuple(AnswerElection(request=self.request, answer=one) for one in self.votes.answers)


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishLearnt:
    """Send our learnt values to everybody."""

    learnt: Learnt


@dataclass(frozen=True, slots=True, kw_only=True)
class AskLearnt:
    """Ask one peer for its learnt values; the answer comes back as `LearntReceived`."""

    peer: NodeId
    deadline_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class IntroducePeers:
    """A node is missing on the control network: tell every node all addresses again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EndLinks:
    """These nodes are gone: end the control session's links to them that are still up. zenoh makes new ones."""

    nodes: tuple[NodeId, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TryAddresses:
    """Nobody was ever heard: find out what becomes of an attempt at each address (`AddressesTried`)."""

    addresses: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerLearnt:
    """Answer a peer's `AskLearnt`."""

    request: int
    learnt: Learnt


@dataclass(frozen=True, slots=True, kw_only=True)
class StartWorker:
    """Start this node's worker for the task; nothing happens if it runs."""

    task: TaskId


@dataclass(frozen=True, slots=True, kw_only=True)
class StopWorker:
    """Stop this node's worker for the task (a cold standby, after its drain)."""

    task: TaskId


@dataclass(frozen=True, slots=True, kw_only=True)
class ResetWorker:
    """Forget the failures of this node's worker for the task; it is started again if it is wanted."""

    task: TaskId


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartWorker:
    """This node's worker for the task hangs: kill it, count a failure, start it again."""

    task: TaskId
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StrikeDaemon:
    """An operator rehearses: answer whether this machine can do it to this daemon, and do it."""

    request: int
    strike: Strike
    fleet: Fleet
    """Whose links they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreRehearsal:
    """Keep what a rehearsal has found on this machine, and answer."""

    request: int
    rehearsal: KeepRehearsal


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerRehearsals:
    """Answer an operator's question for promises and kept rehearsals; what is kept is filled in from the disk."""

    request: int
    told: RehearsalsTold
    name: str
    """The rehearsal that is wanted whole."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenewWorker:
    """An operator wants this node's worker for the task stopped and started again; that is no failure."""

    task: TaskId


@dataclass(frozen=True, slots=True, kw_only=True)
class AdoptFleet:
    """Go by another fleet file: commands, environments, sessions to come, and what the relay watches.

    It is the first instruction of its batch that is not sent.
    """

    fleet: Fleet
    """As it was read: what this daemon cannot take over is to be told to the operator."""
    is_agreed: bool = False
    """It is an agreed document: electors and leases are those in force."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EndTask:
    """The task left the fleet file: the relay ends its streams and forgets it."""

    task: TaskId


@dataclass(frozen=True, slots=True, kw_only=True)
class SetRole:
    """Tell this node's worker its role."""

    role: Role


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyRoutes:
    """Give the relay the newest plan of one task."""

    plan: RoutePlan


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerStatus:
    """Answer an operator."""

    request: int
    snapshot: Snapshot


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerCommand:
    """Answer an operator's command."""

    request: int
    result: CommandResult


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerExplanation:
    """Answer an operator's question about a task's last judgement."""

    request: int
    explanation: Explanation


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerLines:
    """Answer an operator with what this node's worker for the task has printed behind line ``after``."""

    request: int
    task: TaskId
    after: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeCertificate:
    """Keep a newer certificate for this node's key (PEM) if it is one, and answer who has sent it."""

    request: int
    certificate: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StandDown:
    """End this daemon with the exit code of a wrong configuration: its name is alive elsewhere."""

    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordStory:
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


# --- of the fleet register -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class AskElectors:
    """Ask these electors (this node may be one) a question of the fleet register."""

    to: tuple[NodeId, ...]
    question: Prepare | Accept[FleetValue]
    deadline_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TellFleet:
    """Tell nodes the fleet value that this node has learnt."""

    to: tuple[NodeId, ...]
    value: FleetValue


@dataclass(frozen=True, slots=True, kw_only=True)
class AskFleet:
    """Ask a node for the fleet value that it has learnt: it counts by a higher number."""

    peer: NodeId


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerFleet:
    """Answer a question to the fleet register."""

    request: int
    answer: FleetAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreDocument:
    """An operator gave this document: check it and write it; `DocumentStored` or `DocumentRefused` comes back."""

    request: int
    content: Document


@dataclass(frozen=True, slots=True, kw_only=True)
class AmendDocument:
    """Write the stored document with this hash once more, with other flags.

    `DocumentStored` comes back, without a request. If the document is not stored here any more, nothing comes back.
    """

    document: str
    flags: tuple[Flag, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FetchDocument:
    """Fetch the document with this hash from one of the peers, in this order; check it and write it.

    `DocumentStored` or `DocumentRefused` comes back. If no peer has it, nothing comes back: the node asks again later.
    """

    document: str
    peers: tuple[NodeId, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerDocument:
    """Answer a peer with the document that has this hash, or with nothing if it is not stored here."""

    request: int
    document: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerFleetRead:
    """Answer an operator by which fleet value this node goes; with the value's document if that is asked for."""

    request: int
    told: FleetTold
    with_document: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class KeepDocuments:
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
    | ResetWorker
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
    | TakeCertificate
    | StandDown
    | RecordStory
)
