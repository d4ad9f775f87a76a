"""One judgement of one task with each figure that it went by: what `zsched explain` shows and `--replay` repeats.

Knows: the fields. Does not know: how a judgement comes about (`zsched.core.scheduler.decision`), text, files.

All of it is plain, so that it can travel and be written down without loss. Times are the deciding node's monotonic
seconds, because the judgement itself goes by them.
"""

from __future__ import annotations

from zsched.core.values.model import Allocation, NodeId, PeerState, Reach, TaskId, UtilityVector
from zsched.core.values.profile import Profile
from zsched.core.values.snapshot import VoteStatus
from zsched.core.values.struct import Struct
from zsched.core.values.words import Readings


class Rules(Struct, frozen=True, kw_only=True):
    """The settings of the fleet file by which a task is judged; what can be tuned stands in its allocation."""

    candidates: tuple[NodeId, ...]
    reach: Reach
    max_moves_per_minute: int
    price_s: float = 0.3
    memory_s: float = 1000.0
    start_deadline_s: float
    has_command: bool
    """Whether zsched starts the worker."""


class KeptMemory(Struct, frozen=True, kw_only=True):
    """What machines have kept of what they promised (`zsched.core.scheduler.kept.Kept`)."""

    owner: NodeId | None = None
    since: float = 0.0
    foretold: tuple[tuple[NodeId, float], ...] = ()
    """(machine, worth), sorted."""
    seen: tuple[tuple[NodeId, float, float, float], ...] = ()
    """(machine, what it promised, what it gave, when), sorted."""


class JudgeMemory(Struct, frozen=True, kw_only=True):
    """The memory that a judgement begins with (`zsched.core.scheduler.judge.Judge`)."""

    owed: tuple[tuple[NodeId, float], ...] = ()
    """(machine, seconds of work), sorted."""
    charged_at: float | None = None
    kept: KeptMemory = KeptMemory()
    not_ready_since: float | None = None
    away_s: float = 0.0
    away_until: float | None = None
    lost_since: float | None = None
    lost_s: float = 0.0
    reached_at: float | None = None
    seen_first_at: float | None = None
    fit_since: float | None = None


class FuseMemory(Struct, frozen=True, kw_only=True):
    """The record of moves that a judgement begins with (`zsched.core.scheduler.fuse.Fuse`)."""

    moves: tuple[tuple[float, bool], ...] = ()
    """(when, whether it was an escape), oldest first."""


class Figures(Struct, frozen=True, kw_only=True):
    """Everything that one judgement of one task at one robot goes by."""

    task: TaskId
    now: float
    rules: Rules
    allocation: Allocation
    """The value in force, with its tuning."""
    voters: tuple[NodeId, ...]
    """All robots of the fleet file."""
    present: tuple[NodeId, ...]
    """Those that are not gone."""
    vectors: tuple[UtilityVector, ...]
    """Of the robots that have answered in time, sorted."""
    electors: tuple[NodeId, ...]
    electors_heard: tuple[NodeId, ...]
    settled_for_s: float
    """Since when this robot knows the owner."""
    owner_state: PeerState = PeerState.UNKNOWN
    owner_profile: Profile | None = None
    """The owner's newest fresh profile."""
    is_called: bool = False
    is_called_escape: bool = False
    out: tuple[NodeId, ...] = ()
    """Candidates that a first placement does not wait for."""
    first: TaskId | None = None
    """The other task that moves first."""
    closed: tuple[tuple[NodeId, str], ...] = ()
    """(candidate, why it takes nothing new), by operators' flags; sorted."""
    claimed: tuple[tuple[NodeId, str], ...] = ()
    """(candidate, why it has no room for the task beside those that are about to go there); sorted. Only of a task that
    has lost its owner, which leaves it to them while it has another place."""
    drained: str = ""
    """Why the owner hands the task over, by an operator's flag; empty: it need not."""
    head_starts: Readings = ()
    """(candidate, how much more or less than its figures say it is worth), by the file; sorted."""
    judge: JudgeMemory = JudgeMemory()
    fuse: FuseMemory = FuseMemory()


class Verdict(Struct, frozen=True, kw_only=True):
    """A judgement as a plain value; ``aggregates`` with the bonus, by what was kept, sorted."""

    outcome: str
    candidate: NodeId | None
    aggregate: float
    reason: str
    is_escape: bool = False
    aggregates: tuple[tuple[NodeId, float], ...] = ()


class Need(Struct, frozen=True, kw_only=True):
    """What the task would use on one candidate, by the deciding robot's figures (cores, MiB)."""

    candidate: NodeId
    cpu_cores: float
    memory_mb: float


class Decision(Struct, frozen=True, kw_only=True):
    """A judgement with its figures."""

    figures: Figures
    verdict: Verdict
    needs: tuple[Need, ...] = ()
    """Of the candidates with a fresh profile."""


class Move(Struct, frozen=True, kw_only=True):
    """A change of owner that a node has learnt, or an owner that was there before the node knew of it."""

    epoch: int
    revision: int
    left: NodeId | None
    owner: NodeId | None
    reason: str
    votes: tuple[tuple[NodeId, NodeId], ...] = ()
    """(voter, candidate) of the vote that led to it, as far as this node heard it; edges hear none."""
    is_known: bool = False
    """No owner has changed: it is the first that the node learns of the task since its start. ``left`` is ``None``."""


class HistoryLine(Struct, frozen=True, kw_only=True):
    """One line of a decision log that the history of tasks is made from."""

    at: float
    """Seconds since the Unix epoch, by the wall clock of the node that has written it."""
    life: int
    """The daemon's incarnation."""
    task: TaskId = ""
    epoch: int = 0
    text: str = ""
    move: Move | None = None
    took_s: float | None = None
    gap_s: float | None = None
    rehearsal: str = ""
    is_rollout: bool = False
    by: str = ""
    """The operator who has changed something."""


class Explanation(Struct, frozen=True, kw_only=True):
    """A node's answer about the last judgement of one task."""

    node: NodeId
    kind: str
    task: TaskId
    allocation: Allocation
    robots: tuple[NodeId, ...]
    """That are alive: on an edge, whom to ask instead."""
    decision: Decision | None = None
    """``None``: an edge, or no round yet."""
    age_s: float = 0.0
    vote: VoteStatus | None = None
    knows_jobs: bool | None = None
    """Whether this node knows how long a job of the task takes, which a deadline needs; ``None``: it does not say."""
