"""What happened: everything that may enter a node through `Node.handle`, in the past tense.

Knows: the facts that adapters report. Does not know: what follows from them.

``request`` is the adapter's handle of an open question; the answer's instruction carries it back.
"""

from __future__ import annotations

from zsched.core.values.beat import Beat
from zsched.core.values.document import Flag
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import (
    Accept,
    Accepted,
    Ballots,
    ChangeFleet,
    Command,
    ExplainTask,
    FleetAnswer,
    FleetQuestion,
    HoldTask,
    Learnt,
    MoveTask,
    Prepare,
    Promise,
    ReadFleet,
    ReadHistory,
    ReadLines,
    Refused,
    RestartTask,
    TakeCertificate,
    TuneTask,
    Utilities,
    Votes,
)
from zsched.core.values.model import MAX_COUNTER, NodeId, Proposal, TaskId, check_counter, check_name
from zsched.core.values.plan import DrainingSlot, StreamCount
from zsched.core.values.profile import DeviceSample, LinkSample, Profile, WorkerState
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, Strike
from zsched.core.values.struct import Struct
from zsched.core.values.words import Trouble, check_range


class DeadlineReached(Struct, frozen=True, kw_only=True):
    """The time that `Node.next_deadline` named has come (or the loop simply woke up)."""


class ClockCompared(Struct, frozen=True, kw_only=True):
    """This machine's clock that a time service slews was compared with the raw one (`zsched.host.clock.ClockWatch`)."""

    error_ratio: float
    """How much faster the clock ran over the last second or less; negative: slower."""
    jump_s: float = 0.0
    """How far the clocks moved apart since the comparison before; after a suspend, its length."""
    since_s: float = 0.0
    """How long ago that comparison was."""


# --- PROFILE, GATEWAY ------------------------------------------------------------------------------------------------


class ProfileSampled(Struct, frozen=True, kw_only=True):
    """This machine and its links were measured."""

    device: DeviceSample
    links: tuple[LinkSample, ...] = ()


class ProfileReceived(Struct, frozen=True, kw_only=True):
    """A peer published its profile."""

    profile: Profile


# --- SCHEDULER: the gather -------------------------------------------------------------------------------------------


class UtilityAsked(Struct, frozen=True, kw_only=True):
    """A peer gathers and asks for our vectors."""

    request: int
    asker: NodeId


class UtilityReceived(Struct, frozen=True, kw_only=True):
    """A peer answered our gather."""

    gather: int
    utilities: Utilities


# --- VOTE ------------------------------------------------------------------------------------------------------------


class ProposalReceived(Struct, frozen=True, kw_only=True):
    """A robot proposed a candidate (or to stay)."""

    proposal: Proposal


class PrepareAsked(Struct, frozen=True, kw_only=True):
    """A proposer asks this elector for a promise."""

    request: int
    asker: NodeId
    prepare: Prepare


class AcceptAsked(Struct, frozen=True, kw_only=True):
    """A proposer asks this elector to accept a value."""

    request: int
    asker: NodeId
    accept: Accept


class ElectorAnswered(Struct, frozen=True, kw_only=True):
    """An elector answered our prepare or accept."""

    answer: Promise | Accepted | Refused


class BallotsAsked(Struct, frozen=True, kw_only=True):
    """A proposer asks this elector several questions in one frame."""

    request: int
    asker: NodeId
    ballots: Ballots


class VotesReceived(Struct, frozen=True, kw_only=True):
    """An elector answered questions of ours that went in one frame."""

    votes: Votes


class LearntReceived(Struct, frozen=True, kw_only=True):
    """A peer sent its learnt values: unasked, after a commit, or in answer to our question (`AskLearnt`)."""

    learnt: Learnt
    is_answer: bool = False
    where: str = ""
    """An answer: the other end of its sender's link, as text for people; empty: not known."""


class LearntAsked(Struct, frozen=True, kw_only=True):
    """A peer asks for our learnt values."""

    request: int


class StateSaved(Struct, frozen=True, kw_only=True):
    """The durable state is on disk; the loop stood still for ``took_s``."""

    took_s: float


class PersistFailed(Struct, frozen=True, kw_only=True):
    """The durable state could not be written; nothing that depended on it was sent."""

    reason: str


# --- VOTE: the fleet register and its documents ----------------------------------------------------------------------


class FleetAsked(Struct, frozen=True, kw_only=True):
    """A proposer asks this elector's fleet register."""

    request: int
    asker: NodeId
    question: FleetQuestion


class FleetAnswered(Struct, frozen=True, kw_only=True):
    """An elector answered our question to its fleet register."""

    answer: FleetAnswer


class DocumentAsked(Struct, frozen=True, kw_only=True):
    """A peer asks for the document with this hash."""

    request: int
    document: str


class DocumentStored(Struct, frozen=True, kw_only=True):
    """A document is on this node's disk, and it is valid here."""

    document: str
    """Its hash."""
    fleet: Fleet
    """What its text says."""
    flags: tuple[Flag, ...] = ()
    request: int | None = None
    """Of `StoreDocument`; ``None``: it was fetched from a peer."""


class DocumentRefused(Struct, frozen=True, kw_only=True):
    """A document is not valid here, or the disk refused it; nothing is stored."""

    document: str
    reason: str
    request: int | None = None
    """Of `StoreDocument`; ``None``: it was fetched from a peer."""
    is_of_disk: bool = False
    """It may be valid here: the disk refused it, and may take it another time."""
    is_taken_out: bool = False
    """It does not name this node."""


# --- membership ------------------------------------------------------------------------------------------------------


class BeatReceived(Struct, frozen=True, kw_only=True):
    """A peer's decision loop is alive."""

    beat: Beat


class TokenSeen(Struct, frozen=True, kw_only=True):
    """A daemon's liveliness token appeared."""

    node: NodeId
    incarnation: int


class TokenLost(Struct, frozen=True, kw_only=True):
    """A daemon's liveliness token went: its process closed, was killed, or its link's lease ended."""

    node: NodeId
    incarnation: int


# --- EXECUTOR, ROUTE -------------------------------------------------------------------------------------------------


class WorkerChanged(Struct, frozen=True, kw_only=True):
    """Our supervisor reports a worker of this node."""

    task: TaskId
    state: WorkerState
    reason: str = ""
    trouble: Trouble = Trouble.NONE


class WorkerTroubled(Struct, frozen=True, kw_only=True):
    """A worker of this node says that ``count`` of its callbacks have raised; ``text`` is the newest error.

    With ``count`` 0 the text tells of a mistake that lasts as long as the worker lives. With ``is_cold`` it tells why
    the worker, which may be starting, has begun an epoch without its predecessor's state.
    """

    task: TaskId
    count: int
    text: str
    is_cold: bool = False


class WorkerOutdated(Struct, frozen=True, kw_only=True):
    """A worker that somebody else started on this node should be started again; ``reason`` empty: no longer."""

    task: TaskId
    reason: str


class WorkerJobs(Struct, frozen=True, kw_only=True):
    """A worker of this node reports its jobs of this life to the relay, which forwards them.

    Counts and sums only rise, so a lost report costs nothing: means and rates are made of the differences
    (`zsched.core.profile.jobs`).
    """

    task: TaskId
    incarnation: str
    at_s: float
    """Time of the report: seconds since this life of the worker began, by its own clock."""
    done: int
    skipped: int = 0
    """Jobs that gave way to newer ones, undone."""
    waiting: int = 0
    """The fewest jobs that were waiting at any time since the report before."""
    time_s: float = 0.0
    """Sums over all done jobs: time from beginning to end..."""
    cpu_s: float = 0.0
    """...CPU time..."""
    wait_s: float | None = None
    """...time waiting for a CPU; ``None``: not known..."""
    age_s: float | None = None
    """...and time from arrival to end; ``None``: not known."""
    late: int | None = None
    """Jobs that took longer from arrival to end than the task's deadline; ``None``: it has none."""
    is_idle: bool = False
    """The worker is idle: no job in hand, and none waiting."""

    def __post_init__(self) -> None:
        check_name("jobs.task", self.task)
        for name in ("done", "skipped", "waiting"):
            check_counter(f"jobs.{name}", getattr(self, name))
        check_counter("jobs.late", self.late or 0)
        for name in ("at_s", "time_s", "cpu_s", "wait_s", "age_s"):
            check_range(f"jobs.{name}", getattr(self, name), 0.0, MAX_COUNTER)


class WorkerShown(Struct, frozen=True, kw_only=True):
    """The relay saw the token of another node's worker come over a living link, or go."""

    node: NodeId
    task: TaskId
    incarnation: str
    is_present: bool = True


class SlotReady(Struct, frozen=True, kw_only=True):
    """The relay sees the new owner's worker ready (or no longer) for the slot of ``epoch``."""

    task: TaskId
    epoch: int
    is_ready: bool = True
    has_token: bool | None = None
    """Not ready: whether the relay sees the worker's token all the same; ``None``: it does not say."""
    untaken: tuple[str, ...] = ()
    """Not ready: the inputs' keys at the owner that nobody subscribes to."""


class SlotFlipped(Struct, frozen=True, kw_only=True):
    """The relay switched every stream of the task to the slot of ``epoch``; ``replayed`` kept values went first."""

    task: TaskId
    epoch: int
    replayed: int = 0
    draining: tuple[DrainingSlot, ...] = ()
    """What it has left, the oldest first: another daemon may have opened that."""


class SlotDrained(Struct, frozen=True, kw_only=True):
    """The end markers of the old slot have come back."""

    task: TaskId
    epoch: int
    """Epoch of the slot that is drained, a predecessor."""


class RoleEnded(Struct, frozen=True, kw_only=True):
    """This node's worker reports that it no longer works in ``epoch``, or it is dead.

    The report does not say to which stop order it belongs. Where it might belong to an earlier one,
    `zsched.core.vote.lease.Leases.on_stopped` does not believe it.
    """

    task: TaskId
    epoch: int


class StreamsCounted(Struct, frozen=True, kw_only=True):
    """The relay's counters."""

    counts: tuple[StreamCount, ...]


class RelayChanged(Struct, frozen=True, kw_only=True):
    """The relay process started or ended; a new one gets the newest plans again."""

    is_running: bool
    reason: str = ""


# --- operators -------------------------------------------------------------------------------------------------------


class StatusAsked(Struct, frozen=True, kw_only=True):
    """An operator (here or at another node) asks for the status."""

    request: int


class MoveCommanded(Struct, frozen=True, kw_only=True):
    """An operator hands a task over to another node."""

    request: int
    command: MoveTask


class HoldCommanded(Struct, frozen=True, kw_only=True):
    """An operator pauses or pins a task, or ends that."""

    request: int
    command: HoldTask


class TuneCommanded(Struct, frozen=True, kw_only=True):
    """An operator changes a task's tuning."""

    request: int
    command: TuneTask


class ExplanationAsked(Struct, frozen=True, kw_only=True):
    """An operator asks for this node's last judgement of a task."""

    request: int
    command: ExplainTask


class RestartCommanded(Struct, frozen=True, kw_only=True):
    """An operator orders that this node's worker is started again."""

    request: int
    command: RestartTask


class CertificateSent(Struct, frozen=True, kw_only=True):
    """Somebody has sent a newer certificate for this node's key."""

    request: int
    command: TakeCertificate


class StrikeCommanded(Struct, frozen=True, kw_only=True):
    """An operator rehearses: this node is to do something to itself."""

    request: int
    command: Strike
    is_near: bool = False
    """It came over this daemon's own operator socket."""


class RehearsalKept(Struct, frozen=True, kw_only=True):
    """An operator has rehearsed, and this node is to keep what was found."""

    request: int
    command: KeepRehearsal


class RehearsalsAsked(Struct, frozen=True, kw_only=True):
    """An operator asks for promises, or for rehearsals that were kept."""

    request: int
    command: ReadRehearsals


class LinesAsked(Struct, frozen=True, kw_only=True):
    """An operator asks what this node's worker has printed."""

    request: int
    command: ReadLines


class HistoryAsked(Struct, frozen=True, kw_only=True):
    """An operator asks what this node's decision log tells of moves."""

    request: int
    command: ReadHistory


class FleetCommanded(Struct, frozen=True, kw_only=True):
    """An operator changes the fleet."""

    request: int
    command: ChangeFleet


class FleetReadAsked(Struct, frozen=True, kw_only=True):
    """An operator asks by which fleet value and document this node goes."""

    request: int
    command: ReadFleet


class FrameDropped(Struct, frozen=True, kw_only=True):
    """Frames came that are invalid or not for us: only a counter rises."""

    kind: str
    reason: str
    count: int = 1


class LinkRefused(Struct, frozen=True, kw_only=True):
    """Somebody has dialled us with a certificate of this fleet that is not let in."""

    key: str
    """Label of the certificate's key, such as ``robot1.k2``."""


class Commanded(Struct, frozen=True, kw_only=True):
    """A command that changes something came, and its seal is right: it is told with the name of whoever gave it."""

    by: str
    """Label of the certificate, such as ``ana.operator``."""
    what: str
    """The command's class."""
    task: TaskId
    """Empty: the fleet."""


class AddressesTried(Struct, frozen=True, kw_only=True):
    """What became of one attempt at each address that this node dials: (address, a few words or nothing)."""

    found: tuple[tuple[str, str], ...]


class ProblemReported(Struct, frozen=True, kw_only=True):
    """An adapter has trouble (``problem``), or no longer has (``None``); ``source`` names it for the status."""

    source: str
    problem: str | None


class RecipeCompared(Struct, frozen=True, kw_only=True):
    """What the process of this node's worker was started with was compared with what it would be started with now."""

    task: TaskId
    is_old: bool
    """It runs by an old command, environment or session; false as well once it has ended."""


class FleetChanged(Struct, frozen=True, kw_only=True):
    """Another fleet file, read and validated, holds on this node from now on."""

    fleet: Fleet


class StopRequested(Struct, frozen=True, kw_only=True):
    """The daemon must stop: this node takes no new task and hands its tasks over."""


Event = (
    DeadlineReached
    | ClockCompared
    | ProfileSampled
    | ProfileReceived
    | UtilityAsked
    | UtilityReceived
    | ProposalReceived
    | PrepareAsked
    | AcceptAsked
    | ElectorAnswered
    | BallotsAsked
    | VotesReceived
    | LearntReceived
    | LearntAsked
    | StateSaved
    | PersistFailed
    | FleetAsked
    | FleetAnswered
    | DocumentAsked
    | DocumentStored
    | DocumentRefused
    | BeatReceived
    | TokenSeen
    | TokenLost
    | WorkerChanged
    | WorkerTroubled
    | WorkerOutdated
    | WorkerJobs
    | WorkerShown
    | SlotReady
    | SlotFlipped
    | SlotDrained
    | RoleEnded
    | StreamsCounted
    | RelayChanged
    | StatusAsked
    | MoveCommanded
    | HoldCommanded
    | TuneCommanded
    | ExplanationAsked
    | RestartCommanded
    | CertificateSent
    | StrikeCommanded
    | RehearsalKept
    | RehearsalsAsked
    | LinesAsked
    | HistoryAsked
    | FleetCommanded
    | FleetReadAsked
    | FrameDropped
    | LinkRefused
    | Commanded
    | AddressesTried
    | ProblemReported
    | RecipeCompared
    | FleetChanged
    | StopRequested
)


def commanded(request: int, command: Command, *, is_near: bool = False) -> Event:
    """The event of an operator's command; ``is_near``: it came over this daemon's own operator socket."""
    if isinstance(command, Strike):
        return StrikeCommanded(request=request, command=command, is_near=is_near)
    if isinstance(command, KeepRehearsal):
        return RehearsalKept(request=request, command=command)
    if isinstance(command, ReadRehearsals):
        return RehearsalsAsked(request=request, command=command)
    if isinstance(command, ExplainTask):
        return ExplanationAsked(request=request, command=command)
    if isinstance(command, RestartTask):
        return RestartCommanded(request=request, command=command)
    if isinstance(command, TakeCertificate):
        return CertificateSent(request=request, command=command)
    if isinstance(command, MoveTask):
        return MoveCommanded(request=request, command=command)
    if isinstance(command, HoldTask):
        return HoldCommanded(request=request, command=command)
    if isinstance(command, TuneTask):
        return TuneCommanded(request=request, command=command)
    if isinstance(command, ReadLines):
        return LinesAsked(request=request, command=command)
    if isinstance(command, ReadHistory):
        return HistoryAsked(request=request, command=command)
    if isinstance(command, ChangeFleet):
        return FleetCommanded(request=request, command=command)
    return FleetReadAsked(request=request, command=command)
