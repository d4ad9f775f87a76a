"""SCHEDULER, second half: from a standing to a proposal, with stickiness.

Knows: bonus, escapes, an operator's pause and pin. Does not know: how utilities were computed or travel, what is owed
(`zsched.core.scheduler.ledger`), who else proposes what, how anything is committed.

`Judge` keeps the little memory that stickiness needs, per task, and turns a `Standing` into a `Judgement`: a candidate
to propose, or the owner, always with the reason.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from enum import StrEnum
from typing import Final

from zsched.core.scheduler.fuse import ESCAPES_PER_MINUTE, WINDOW_S, Fuse
from zsched.core.scheduler.kept import Kept
from zsched.core.scheduler.ledger import Ledger
from zsched.core.scheduler.standing import LOST_S, Standing, pick
from zsched.core.values.absence import Absences
from zsched.core.values.decision import JudgeMemory
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.model import Allocation, NodeId, Pause, PeerState, Pin, told_by
from zsched.core.values.profile import Profile, Renewal, WorkerState
from zsched.core.values.struct import Struct, field, replace
from zsched.core.values.veto import Filter, Veto
from zsched.core.values.words import told_of_worker

FIT_S: Final = 2.0
"""A task goes home to the node that it is pinned to once that could have had it for so long."""
INITIAL_SETTLE_S = 3.0
"""A task without an owner waits this long for candidates that still start."""
NO_HEAD_STARTS: Final[Mapping[NodeId, float]] = {}
FORGIVEN_RATIO: Final = 0.1
"""An owner's worker that is ready makes up so much of the time in which it was not."""


def _of_worker(since: float | None = None, total_s: float = 0.0, back_at: float | None = None) -> Absences:
    return Absences(forgiven_ratio=FORGIVEN_RATIO, since=since, total_s=total_s, back_at=back_at)


class Outcome(StrEnum):
    """What a robot makes of a standing."""

    STAY = "stay"
    WAIT = "wait"  # another one leads, but something holds the task back
    PROPOSE = "propose"
    NONE = "none"  # nobody to propose


class Judgement(Struct, frozen=True, kw_only=True):
    """A decision with its reason; ``candidate`` is whom this robot would vote for (the owner when it stays)."""

    outcome: Outcome
    candidate: NodeId | None
    aggregate: float
    reason: str
    is_escape: bool = False
    aggregates: Mapping[NodeId, float] = field(default_factory=dict)
    """With the owner's bonus."""
    unkept: Mapping[NodeId, float] = field(default_factory=dict)
    """{machine: what is taken off its worth, for what it did not keep}, of those from which something is."""
    owed: Mapping[NodeId, float] = field(default_factory=dict)
    """{who can have the task: seconds of work that it owes, with what it will lose}."""


@dataclasses.dataclass(slots=True)
class Judge:
    """The memory of one task's stickiness at one robot."""

    spec: TaskSpec
    absences: Absences = dataclasses.field(default_factory=_of_worker)
    """Of the owner's worker that is ready."""
    lost: Absences = dataclasses.field(default_factory=Absences)
    """Of the owner from where the robots reach."""
    ledger: Ledger = dataclasses.field(default_factory=Ledger)
    kept: Kept = dataclasses.field(default_factory=Kept)
    seen_first_at: float | None = None
    """When a first candidate could be scored (a task that nobody owns waits for the others)."""

    fit_since: float | None = None
    """Since when the node could have the task to which it is pinned, and which has not got it."""

    out: AbstractSet[NodeId] = frozenset()
    """The candidates that a first placement does not wait for: they cannot have the task."""

    def reset(self, *, is_new_owner: bool = False) -> None:
        """The value changed; what is owed stays."""
        self.fit_since = None
        if is_new_owner:
            self.lost, self.absences = Absences(), _of_worker()

    def forgive(self) -> None:
        """A vote was lost: the others see nothing of it, and what is owed is forgotten; else each round had a vote."""
        self.fit_since, self.ledger = None, Ledger(at=self.ledger.at)

    def by(self, spec: TaskSpec) -> None:
        """Judge by other settings; by another start-up time what was away in the one before does not count."""
        if spec.worker.start_deadline_s != self.spec.worker.start_deadline_s:
            since = self.absences.since
            self.absences = _of_worker(None if since is None else since + self.held_s)
        self.spec = spec
        self.kept.keep(spec.candidates)

    def not_ready_for(self, profile: Profile | None, now: float) -> float:
        """For how many seconds the owner's worker was heard not to be ready; who is not heard says nothing about it.

        A worker that is started anew on purpose, once or twice, is waited for; one that is ready now and then
        is left once its absences are longer than a start-up (`zsched.core.values.absence`).
        """
        if profile is None:
            self.absences.skip(now)
            return 0.0
        load = profile.worker(self.spec.name)
        is_away = load is None or load.state is not WorkerState.READY
        return self.absences.look(is_away, now, self.spec.worker.start_deadline_s)

    @property
    def held_s(self) -> float:
        """What former absences take of an owner's start-up time, in seconds."""
        return self.absences.held_s(self.spec.worker.start_deadline_s)

    def lost_for(self, is_reached: bool, now: float) -> float:
        """For how many seconds the robots have not reached the owner, with what former times count."""
        return self.lost.look(not is_reached, now, LOST_S)

    def is_overdue(self, now: float) -> bool:
        """Whether the owner's worker was heard not to be ready for longer than a start may take."""
        since = self.absences.since
        return since is not None and now - since > self.spec.worker.start_deadline_s

    def memory(self) -> JudgeMemory:
        """What this judge remembers, as a value."""
        return JudgeMemory(
            owed=tuple(sorted(self.ledger.owed.items())),
            charged_at=self.ledger.at,
            kept=self.kept.memory(),
            not_ready_since=self.absences.since,
            away_s=self.absences.total_s,
            away_until=self.absences.back_at,
            lost_since=self.lost.since,
            lost_s=self.lost.total_s,
            reached_at=self.lost.back_at,
            seen_first_at=self.seen_first_at,
            fit_since=self.fit_since,
        )

    def recall(self, memory: JudgeMemory) -> None:
        """Remember that, and nothing else."""
        self.lost = Absences(since=memory.lost_since, total_s=memory.lost_s, back_at=memory.reached_at)
        self.absences = _of_worker(memory.not_ready_since, memory.away_s, memory.away_until)
        self.ledger, self.kept = Ledger(owed=dict(memory.owed), at=memory.charged_at), Kept.of(memory.kept)
        self.seen_first_at, self.fit_since = memory.seen_first_at, memory.fit_since

    def judge(
        self,
        standing: Standing,
        allocation: Allocation,
        *,
        escape: str | None,
        is_called: bool,
        now: float,
        fuse: Fuse | None = None,
        drained: str = "",
        is_unheard: bool = False,
        head_starts: Mapping[NodeId, float] = NO_HEAD_STARTS,
    ) -> Judgement:
        """Decide by one standing.

        Args:
            standing: the joint view.
            allocation: what is agreed now.
            escape: why the owner must be left at once (`escape_reason`), or ``None``.
            is_called: another robot called a vote: answer with who owes least, whatever a move costs.
            now: monotonic seconds.
            fuse: the task's record of moves; ``None``: they are not bounded.
            drained: why the owner hands the task over, by an operator's order; empty: it need not.
            is_unheard: nobody here has ever heard the owner.
            head_starts: {candidate: how much more it is worth, by the file}.
        """
        owner = allocation.owner
        is_drain = escape is None and bool(drained)
        leaving = f"{owner} is {drained}" if is_drain else escape
        told = {name: value + head_starts.get(name, 0.0) for name, value in standing.aggregates.items()}
        machines = told if standing.machines is None else {name: standing.machines[name] for name in told}
        self.kept.look(machines, owner, now)
        kept = self.kept.corrected(machines, owner, self.spec.memory_s, now)
        unkept = {name: machines[name] - value for name, value in kept.items() if value < machines[name]}
        worth = {name: value - unkept.get(name, 0.0) for name, value in told.items()}
        if owner in worth:
            worth[owner] += allocation.tuning.bonus
        home = allocation.home
        scored = {
            name: value
            for name, value in worth.items()
            if (leaving is None or name != owner) and (not allocation.is_bound or name in (home, owner))
        }
        self._watch_home(home in scored and home != owner and not self.kept.has_failed(home, now), now)
        owed = self._charge(worth, min((0.0, *head_starts.values())), owner, now)
        expected = {name: owed[name] for name in scored}
        winner = (
            home if home is not None and home in scored else pick({name: -one for name, one in expected.items()}, owner)
        )
        if winner is None:
            reason = _nobody(allocation, f"{leaving}; it keeps the task, for " if is_drain else "")
            return Judgement(outcome=Outcome.NONE, candidate=owner, aggregate=0.0, reason=reason, unkept=unkept)
        rests = standing.kept_out_by(owner) is Filter.RESTS
        is_kept = home is not None and not rests and not (is_unheard and winner != home)
        outcome, reason = self._outcome(winner, expected, allocation, leaving, is_called, now, is_kept)
        is_bounded = outcome is Outcome.PROPOSE and owner is not None and not is_drain
        if is_bounded and fuse is not None and (cap := self._cap(fuse, is_escape=escape is not None, now=now)):
            outcome, reason = Outcome.WAIT, f"{reason}; {cap}"
        chosen = winner if outcome is Outcome.PROPOSE else owner
        return Judgement(
            outcome=outcome,
            candidate=chosen,
            aggregate=scored.get(chosen, 0.0) if chosen is not None else 0.0,
            reason=reason,
            is_escape=escape is not None and outcome is Outcome.PROPOSE,
            aggregates=scored,
            unkept=unkept,
            owed=expected,
        )

    def _watch_home(self, is_fit: bool, now: float) -> None:
        """Note since when the node could have the task to which it is pinned."""
        if not is_fit:
            self.fit_since = None
        elif self.fit_since is None:
            self.fit_since = now

    def _charge(
        self, worth: Mapping[NodeId, float], least: float, owner: NodeId | None, now: float
    ) -> dict[NodeId, float]:
        """Charge everybody; {machine: what it owes, with what it will lose}. ``least``: worth of one that has none."""
        names = dict.fromkeys((*self.spec.candidates, *worth, *(() if owner is None else (owner,))))
        losses = {name: 1.0 - worth.get(name, least) for name in sorted(names)}
        self.ledger.charge(losses, owner, price_s=self.spec.price_s, memory_s=self.spec.memory_s, now=now)
        return self.ledger.expected(losses)

    def _cap(self, fuse: Fuse, *, is_escape: bool, now: float) -> str | None:
        """Why no further move is allowed in this minute, or ``None``."""
        limit = ESCAPES_PER_MINUTE if is_escape else self.spec.max_moves_per_minute
        done = fuse.moves_within(WINDOW_S, now, escapes=is_escape)
        return None if done < limit else f"{done} moves in the last minute, at most {limit}"

    def _outcome(
        self,
        winner: NodeId,
        expected: Mapping[NodeId, float],
        allocation: Allocation,
        leaving: str | None,
        is_called: bool,
        now: float,
        is_kept: bool,
    ) -> tuple[Outcome, str]:
        """``is_kept``: by a pin, which holds no task on a machine that has never been heard."""
        owner = allocation.owner
        if allocation.paused:
            return Outcome.STAY, f"paused by {by(allocation.pause)}"
        if owner is None:
            if winner == allocation.home:
                return Outcome.PROPOSE, f"first placement: pinned to {winner} by {by(allocation.pin)}"
            return self._initial(winner, expected, is_called=is_called, now=now)
        if leaving is not None:
            return Outcome.PROPOSE, leaving
        if is_kept:
            return self._pinned(winner, allocation, is_called, now)
        if winner == owner:
            return Outcome.STAY, "nobody better"
        if owner in expected:
            more_s = expected[owner] - expected[winner]
            why = f"{owner} owes {more_s:.2f} s more than {winner}"
        else:
            more_s = self.ledger.owed.get(owner, 0.0) - self.ledger.owed.get(winner, 0.0)
            why = f"{owner} cannot be scored, and owes {more_s:.2f} s more than {winner}"
        price_s = self.spec.price_s
        if is_called:
            return Outcome.PROPOSE, f"vote called; {why}"
        if more_s < price_s:
            return Outcome.WAIT, f"{why}; a move costs {price_s:g} s"
        return Outcome.PROPOSE, why

    def _pinned(self, winner: NodeId, allocation: Allocation, is_called: bool, now: float) -> tuple[Outcome, str]:
        """No voluntary moves; but the task goes to the node it is pinned to, once that could have had it for a time."""
        home, owner = allocation.home, allocation.owner
        told = f"pinned to {home} by {by(allocation.pin)}"
        if home == owner:
            return Outcome.STAY, told
        if winner != home:
            return Outcome.STAY, f"{told}, which cannot have it now"
        if is_called:
            return Outcome.PROPOSE, told
        fit_s = 0.0 if self.fit_since is None else now - self.fit_since
        told = f"{told}, fit for {fit_s:.1f} of {FIT_S:g} s"
        return (Outcome.PROPOSE if fit_s >= FIT_S else Outcome.WAIT), told

    def _initial(
        self, winner: NodeId, expected: Mapping[NodeId, float], *, is_called: bool, now: float
    ) -> tuple[Outcome, str]:
        if self.seen_first_at is None:
            self.seen_first_at = now
        waited = now - self.seen_first_at
        missing = [name for name in self.spec.candidates if name not in expected and name not in self.out]
        if missing and waited < INITIAL_SETTLE_S and not is_called:  # who calls has waited for all of us
            return Outcome.WAIT, f"first placement waits for {', '.join(missing)}"
        return Outcome.PROPOSE, f"first placement: {winner} is worth most"


def _nobody(allocation: Allocation, why: str) -> str:
    """Why nobody is proposed, after ``why``."""
    home = allocation.home
    if not allocation.is_bound:
        return f"{why}no other candidate can have it" if why else "no candidate can have it"
    if why and home == allocation.owner:
        return f"{why}it is pinned there (hard)"
    return f"{why}{home} cannot have it, and it is pinned there (hard)"


def by(order: Pause | Pin | None) -> str:
    """Who has given an order, with the reason."""
    return "the operator" if order is None else told_by(order.asked)


def escape_reason(
    spec: TaskSpec,
    allocation: Allocation,
    owner_state: PeerState,
    profile: Profile | None,
    standing: Standing,
    not_ready_for_s: float,
    held_s: float = 0.0,
) -> Veto | None:
    """Why the owner must be left now, whatever a move costs (but never without the quorum).

    Args:
        spec: the task.
        allocation: the current one, with an owner.
        owner_state: how this node sees the owner.
        profile: the owner's newest fresh profile.
        standing: the joint view (its veto of the owner is an escape).
        not_ready_for_s: for how long the owner's worker was heard not to be ready.
        held_s: of that, what former absences count (`Judge.held_s`).
    """
    owner = allocation.owner
    if owner is None:
        return None
    if owner_state in (PeerState.GONE, PeerState.SUSPECT):
        return Veto(Filter.HEARD, f"{owner} is {'gone' if owner_state is PeerState.GONE else 'silent'}")
    if owner not in spec.candidates:
        return Veto(Filter.ORDER, f"{owner} is no candidate any more")
    if profile is not None:
        load = profile.worker(spec.name)
        if profile.draining:
            return Veto(Filter.DRAIN, f"{owner} is draining")
        why = "" if load is None or not load.reason else f": {load.reason}"
        if load is not None and load.state is WorkerState.FAILED:
            return Veto(Filter.WORKER, f"the worker on {owner} failed{why}")
        if load is not None and load.renewal is Renewal.LEAVES:
            return Veto(Filter.WORKER, f"{owner} gives it away: its worker starts again, by the changed fleet file")
        start_s = spec.worker.start_deadline_s
        if _is_told(spec, profile) and not_ready_for_s > start_s:
            often = f", and {start_s + held_s:.0f} s of the time before" if held_s else ""
            late = f"the worker on {owner} has not been ready for {not_ready_for_s - held_s:.1f} s{often}{why}"
            return Veto(Filter.WORKER, late)
    veto = standing.vetoed.get(owner)
    if veto is not None and veto.filter is Filter.REACH:
        return replace(veto, why=f"{owner} is {veto}")
    if veto is not None and veto.filter is Filter.LEASE:  # its exclusive worker has stopped, or is about to
        return replace(veto, why=f"{owner}: {veto}")
    return None


def _is_told(spec: TaskSpec, profile: Profile) -> bool:
    """Whether a node's profile says how its worker is: of a foreign one its daemon may not know."""
    return profile.worker(spec.name) is not None or bool(spec.worker.command)


def escape_ahead(
    spec: TaskSpec, allocation: Allocation, profile: Profile | None, not_ready_for_s: float, *, has_other: bool
) -> str:
    """What comes of an owner whose worker is not ready, and why; empty when nothing will.

    With ``has_other`` (somebody else can have the task) it says when the owner will be left.
    """
    is_held = allocation.paused or allocation.is_bound
    if profile is None or is_held or not _is_told(spec, profile):
        return ""
    load = profile.worker(spec.name)
    how = "is not there" if load is None else told_of_worker(load.state, load.trouble, load.reason)
    if not has_other:
        return f"the worker on {allocation.owner} {how}; nobody else can have the task"
    left_s = max(spec.worker.start_deadline_s - not_ready_for_s, 0.0)
    return f"{allocation.owner} will be left in {left_s:.0f} s, for its worker {how}"
