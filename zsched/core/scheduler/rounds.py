"""SCHEDULER in motion at one robot, all tasks: gather, judge, hand out proposals.

Knows: the round's course and its deadlines. Does not know: how scores arise (`scoring`), stickiness (`judge`), what
becomes of a proposal (`zsched.core.vote.voting`), bytes.

A robot judges every ``decide_s``, by the others' utilities: it gathers them, unless all is at rest
(`zsched.core.scheduler.rest`). It gathers at once when an owner is gone or another robot's proposal
for a move arrives: the first proposal *calls* the vote, so rounds need no synchronised clocks. In a called vote every
robot answers with today's winner, or with the owner: what a move costs does not count, the caller's
did (docs/decisions/0004).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from random import Random

from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.round_trips import RoundTrips
from zsched.core.scheduler.claims import claims_of_others, taken
from zsched.core.scheduler.decision import decide, rules_of, verdict_of
from zsched.core.scheduler.eligibility import NO_DOUBTS, Doubts, has_living_owner, is_out
from zsched.core.scheduler.flags import NodeFlags
from zsched.core.scheduler.fuse import Fuse
from zsched.core.scheduler.judge import Judge, Judgement, Outcome
from zsched.core.scheduler.kept import LEASELESS_S
from zsched.core.scheduler.rest import Answers, is_like
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import Standing
from zsched.core.scheduler.turns import Turn, in_turn, who_moves_first
from zsched.core.scheduler.usage import book
from zsched.core.values.decision import Decision, Figures, Need, Rules
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import AskUtilities, RecordStory
from zsched.core.values.messages import Utilities
from zsched.core.values.model import (
    MAX_AGGREGATE,
    Allocation,
    NodeId,
    PeerState,
    Proposal,
    TaskId,
    Tuning,
    UtilityVector,
)
from zsched.core.values.struct import Struct
from zsched.core.values.todo import ToDo
from zsched.core.values.veto import Filter

HEARD = (PeerState.ALIVE, PeerState.SUSPECT)
FRESH_MARGIN_S = 0.001
"""For the rounding of sums: a profile is surely fresh until this much before its end."""


class _Gather(Struct):
    number: int
    deadline: float
    expected: list[NodeId]
    vectors: dict[NodeId, tuple[UtilityVector, ...]]
    answered: Answers | None = None
    """The answers that it goes by without asking; ``None``: it asks."""


@dataclass(slots=True)
class TaskRound:
    """One task's standing at this robot: what it last decided, heard and counted."""

    spec: TaskSpec
    judge: Judge
    settled_at: float
    """When this node learnt the current epoch."""
    is_called: bool = False
    is_called_escape: bool = False
    file: TaskSpec = field(init=False)
    """What the fleet file says; ``spec`` is that as operators have tuned it."""
    tuning: Tuning | None = None
    """By which ``spec`` was made; ``None``: by none."""
    rules: Rules = field(init=False)
    figures: Figures | None = None
    """What the last judgement went by."""
    standing: Standing | None = None
    judgement: Judgement | None = None
    judged_at: float = -math.inf
    silent: tuple[NodeId, ...] = ()
    fuse: Fuse = field(default_factory=Fuse)
    takes_turns: bool = False
    """Whether what was last judged waits for other tasks' moves."""
    is_waiting_its_turn: bool = False
    told: str = ""
    """The last decision written to the journal; the same one again is not."""

    def __post_init__(self) -> None:
        self.file = self.spec
        self.rules = rules_of(self.spec)

    def lacks_lease(self, node: NodeId) -> bool:
        """Whether that kept a node out when the task was judged last."""
        return self.standing is not None and self.standing.kept_out_by(node) in (Filter.LEASE, Filter.RESTS)

    def under(self, tuning: Tuning) -> None:
        """Judge from now on by the file's settings and this tuning."""
        if tuning is not self.tuning:
            self.tuning = tuning
            self._judge_by(self.file.under(tuning))

    def _judge_by(self, spec: TaskSpec) -> None:
        if spec != self.spec:
            self.spec = spec
            self.judge.by(spec)
            self.rules = rules_of(spec)

    def by(self, spec: TaskSpec) -> TaskRound:
        """The same standing by another version of the task's file; the last judgement was by the one before."""
        if spec != self.file:
            self.file = spec
            self._judge_by(spec if self.tuning is None else spec.under(self.tuning))
            self.figures = self.standing = self.judgement = None
            self.told = ""
        return self


class Rounds:
    """All tasks' rounds at one robot (on edges it is idle)."""

    def __init__(
        self,
        in_force: InForce,
        me: NodeId,
        gateway: Gateway,
        turns: Mapping[TaskId, Turn],
        rng: Random,
        now: float,
        doubts: Callable[[TaskSpec, float], Doubts] = lambda _spec, _now: NO_DOUBTS,
        round_trips: RoundTrips | None = None,
        flags: NodeFlags | None = None,
    ) -> None:
        self._flags = flags or NodeFlags(rank=0)
        self._me, self._gateway, self._turns, self._rng = me, gateway, turns, rng
        self._doubts = doubts
        self._round_trips = round_trips or RoundTrips(me)
        self._in_force = in_force
        self.tasks: dict[TaskId, TaskRound] = {}
        self._gather: _Gather | None = None
        self.on_fleet(now)
        self._number = 0
        self._round_at = now if self.is_voter else math.inf

    def on_fleet(self, now: float, anew: AbstractSet[TaskId] = frozenset()) -> None:
        """Another fleet is in force; what is remembered of a task that stays is kept, but for those ``anew``.

        A gather under way ends without a judgement, for it has asked the robots of before; another one follows at once.
        """
        kept = {name: task for name, task in self.tasks.items() if name not in anew}
        self.tasks = {
            name: kept[name].by(spec) if name in kept else TaskRound(spec=spec, judge=Judge(spec=spec), settled_at=now)
            for name, spec in self._in_force.tasks.items()
        }
        if self._gather is not None:
            self._gather = None
            self.hurry(now)
        nothing = Utilities(voter=self._me, vectors=())
        self._answer: tuple[int, float, object, Utilities] = (-1, -math.inf, None, nothing)
        """(gateway's version, until when, (states, values, doubts), vectors): the newest answer to a gather."""
        self._kept: Answers | None = None
        self._must_ask = True
        """Something has happened since the last gather that may need a decision."""

    @property
    def is_voter(self) -> bool:
        """Whether this node is a robot."""
        return self._me in self._in_force.robots

    # --- time ----------------------------------------------------------------------------------------------------

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        return self._round_at if self._gather is None else self._gather.deadline

    def is_idle(self, now: float) -> bool:
        """Whether `tick` has nothing to do: no gather runs, and none is due."""
        return self._gather is None and now < self._round_at

    def hurry(self, now: float) -> None:
        """Something happened that may need a decision: run a round now."""
        if self.is_voter:
            self._round_at, self._must_ask = min(self._round_at, now), True

    # --- SCHEDULER: the gather -----------------------------------------------------------------------------------

    def vectors(self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], now: float) -> Utilities:
        """This robot's vectors of all tasks (Alg. 2, Calculate_Utility); none on an edge."""
        if not self.is_voter:
            return Utilities(voter=self._me, vectors=())
        version, until, seen, answer = self._answer
        for name, task in self.tasks.items():
            task.under(values[name].tuning)
        doubts = {name: self._doubts(task.spec, now) for name, task in self.tasks.items()}
        if version == self._gateway.version and now <= until and seen == (states, values, doubts):
            return answer  # several robots ask within a round, and nothing has changed since
        bookings = book((task.spec for task in self.tasks.values()), values)
        round_trips = self._round_trips.seconds()
        answer = Utilities(
            voter=self._me,
            vectors=tuple(
                score(
                    task.spec,
                    values[name],
                    self._me,
                    self._gateway,
                    states,
                    now,
                    bookings,
                    doubts[name],
                    round_trips,
                )
                for name, task in self.tasks.items()
            ),
        )
        until = self._gateway.fresh_until(now) - FRESH_MARGIN_S
        self._answer = (self._gateway.version, until, (states, values, doubts), answer)
        return answer

    def tick(
        self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> Iterator[Proposal]:
        """Time has passed: start or close a gather, and hand out what this robot proposes.

        One at a time, for moves take turns: the next task is judged when the vote has taken in the one before.
        """
        if self._gather is not None:
            running = self._gather  # a robot that is not alive any more is not waited for
            running.expected = [name for name in running.expected if states[name] is PeerState.ALIVE]
            if not running.expected or now >= running.deadline:
                yield from self._close(values, states, todo, now)
        elif now >= self._round_at:
            others = self._open(values, states, todo, now)
            if not others:
                yield from self._close(values, states, todo, now)

    def _open(
        self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> list[NodeId]:
        """Start a gather; the other robots that it asks: none while all is at rest (`zsched.core.scheduler.rest`)."""
        timing = self._in_force.timing
        self._round_at = now + timing.decide_s * (0.9 + 0.2 * self._rng.random())
        self._number += 1
        own = self.vectors(values, states, now)
        expected = [name for name in self._in_force.voters if name != self._me and states[name] is PeerState.ALIVE]
        answered = self._kept if self._rests(own.vectors, states, now) else None
        self._gather = _Gather(
            number=self._number,
            deadline=now + timing.gather_s,
            expected=expected if answered is None else [],
            vectors={**({} if answered is None else answered.vectors), self._me: own.vectors},
            answered=answered,
        )
        if answered is not None:
            return []
        self._must_ask = False
        if expected:
            todo.add(AskUtilities(gather=self._number, deadline_s=timing.gather_s))
        return expected

    def _rests(self, own: tuple[UtilityVector, ...], states: Mapping[NodeId, PeerState], now: float) -> bool:
        """Whether the answers of the last gather still hold, so that nobody need be asked."""
        kept = self._kept
        if kept is None or self._must_ask or now >= kept.at + self._in_force.timing.profile_ttl_s:
            return False
        judgements = (task.judgement for task in self.tasks.values())
        stays = all(one is not None and one.outcome is Outcome.STAY for one in judgements)
        return stays and states == kept.states and is_like(own, kept.vectors[self._me])

    def absorb_utilities(self, gather: int, utilities: Utilities) -> bool:
        """A robot answered; false when the answer is late, foreign or not its own."""
        running = self._gather
        if running is None or gather != running.number or utilities.voter not in running.expected:
            return False
        if any(vector.voter != utilities.voter for vector in utilities.vectors):
            return False
        running.expected.remove(utilities.voter)
        if not running.expected:
            running.deadline = -math.inf  # nobody is waited for any more
        running.vectors[utilities.voter] = utilities.vectors
        return True

    def _close(
        self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> Iterator[Proposal]:
        """Everybody alive has answered, or the deadline passed: judge every task."""
        assert self._gather is not None
        gathered, self._gather = self._gather, None
        if gathered.answered is None:
            whole = Answers(vectors=gathered.vectors, states=states, at=now)
            self._kept = None if gathered.expected else whole
        for name in self._judging_order(values, states, now):
            task = self.tasks[name]
            vectors = {
                voter: vector
                for voter, all_vectors in sorted(gathered.vectors.items())
                for vector in all_vectors
                if vector.task == name and voter in self._in_force.voters
            }
            task.silent = tuple(voter for voter in self._in_force.voters if voter not in vectors)
            proposal = self._judge(task, tuple(vectors.values()), values, states, todo, now)
            if proposal is not None:
                yield proposal

    def _judging_order(
        self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], now: float
    ) -> list[TaskId]:
        """Tasks that have lost their owner come first, in an order that all robots share (`claims`)."""
        lost = {name for name, task in self.tasks.items() if self._is_lost(task.spec, values[name], states, now)}
        return [*sorted(lost), *(name for name in in_turn(self._turns) if name not in lost)]

    def _is_lost(self, spec: TaskSpec, allocation: Allocation, states: Mapping[NodeId, PeerState], now: float) -> bool:
        """Whether it had an owner, which does not live any more."""
        owner = allocation.owner
        if owner is None:
            return False
        state, profile = states.get(owner, PeerState.GONE), self._gateway.fresh(owner, now)
        is_spared = state is PeerState.SUSPECT and owner in self._doubts(spec, now).in_grace
        return not has_living_owner(spec, state, profile, is_spared=is_spared)

    # --- SCHEDULER: the decision ---------------------------------------------------------------------------------

    def _judge(
        self,
        task: TaskRound,
        vectors: tuple[UtilityVector, ...],
        values: Mapping[TaskId, Allocation],
        states: Mapping[NodeId, PeerState],
        todo: ToDo,
        now: float,
    ) -> Proposal | None:
        allocation = values[task.spec.name]
        task.under(allocation.tuning)
        figures = self._figures(task, vectors, values, states, now)
        is_called, task.is_called, task.is_called_escape = task.is_called, False, False
        decided = decide(task.judge, task.fuse, figures)
        judgement = decided.judgement
        task.standing, task.judgement, task.judged_at = decided.standing, judgement, now
        task.figures, task.is_waiting_its_turn = figures, decided.is_waiting_its_turn
        task.takes_turns = decided.takes_turns
        self._tell(task, judgement, allocation, todo)
        if self._turns[task.spec.name].commit is not None:
            return None
        if judgement.outcome is not Outcome.PROPOSE and not is_called:
            return None
        return self._proposal(task, judgement, allocation)

    def _proposal(self, task: TaskRound, judgement: Judgement, allocation: Allocation) -> Proposal | None:
        if judgement.candidate is None:  # too few robots heard: not even staying is ours to propose
            return None
        return Proposal(
            voter=self._me,
            task=task.spec.name,
            base_revision=allocation.revision,
            candidate=judgement.candidate,
            aggregate=min(max(judgement.aggregate, 0.0), MAX_AGGREGATE),
            is_escape=judgement.is_escape,
            reason=judgement.reason[:200],
        )

    def _out(self, spec: TaskSpec, now: float) -> tuple[NodeId, ...]:
        """The candidates that say themselves, or of which an operator says, that they cannot have the task now."""
        profiles = ((name, self._gateway.fresh(name, now)) for name in spec.candidates)
        told = tuple([name for name, profile in profiles if profile is not None and is_out(spec, profile)])
        return (*told, *(name for name in spec.candidates if name in self._flags.closed and name not in told))

    def _figures(
        self,
        task: TaskRound,
        vectors: tuple[UtilityVector, ...],
        values: Mapping[TaskId, Allocation],
        states: Mapping[NodeId, PeerState],
        now: float,
    ) -> Figures:
        """Everything that the judgement goes by, read once."""
        name, is_called, gone = task.spec.name, task.is_called, PeerState.GONE
        allocation = values[name]
        owner = allocation.owner
        profile = None if owner is None else self._gateway.fresh(owner, now)
        self._gateway.learn_demand(name, owner, now)
        return Figures(
            task=name,
            now=now,
            rules=task.rules,
            allocation=allocation,
            voters=self._in_force.voters,
            present=tuple([voter for voter in self._in_force.voters if states[voter] is not gone]),
            vectors=vectors,
            electors=self._in_force.electors,
            electors_heard=tuple([one for one in self._in_force.electors if states.get(one, gone) in HEARD]),
            settled_for_s=now - task.settled_at,
            owner_state=gone if owner is None else states.get(owner, gone),
            owner_profile=profile,
            is_called=is_called,
            is_called_escape=task.is_called_escape,
            out=self._out(task.spec, now) if owner is None else (),
            first=who_moves_first(self._turns, name, is_called=is_called, now=now),
            closed=tuple(sorted(self._flags.closed.items())),
            claimed=tuple(sorted(self._claimed(task.spec, values, states, now).items())),
            drained="" if owner is None else self._flags.drained.get(owner, ""),
            head_starts=task.spec.head_starts({other: one.owner for other, one in values.items()}),
            judge=task.judge.memory(),
            fuse=task.fuse.memory(),
        )

    def _claimed(
        self,
        spec: TaskSpec,
        values: Mapping[TaskId, Allocation],
        states: Mapping[NodeId, PeerState],
        now: float,
    ) -> Mapping[NodeId, str]:
        """Of a task that has lost its owner: the candidates that others are about to fill."""
        claims = claims_of_others(self._turns, spec.name, now)
        if not claims or not self._is_lost(spec, values[spec.name], states, now):
            return {}
        specs = tuple(task.spec for task in self.tasks.values())
        return taken(spec, claims, specs, values, self._gateway, now)

    def decision(self, name: TaskId, now: float) -> Decision | None:
        """The last judgement with all its figures; ``None`` before the first."""
        task = self.tasks[name]
        if task.figures is None or task.judgement is None:
            return None
        needs = []
        for candidate in task.spec.candidates:
            profile = self._gateway.fresh(candidate, now)
            if profile is not None:
                need = self._gateway.demand(task.spec, profile)
                needs.append(Need(candidate=candidate, cpu_cores=need.cpu_cores, memory_mb=need.memory_mb))
        return Decision(figures=task.figures, verdict=verdict_of(task.judgement), needs=tuple(needs))

    def _tell(self, task: TaskRound, judgement: Judgement, allocation: Allocation, todo: ToDo) -> None:
        text = f"{judgement.outcome} {judgement.candidate or '-'}"
        if text == task.told:
            return
        task.told = text
        scores = " ".join(f"{name}={value:.4f}" for name, value in sorted(judgement.aggregates.items()))
        told = f"{text}: {judgement.reason} [{scores}]"
        name = task.spec.name
        decision = self.decision(name, task.judged_at)
        todo.add(RecordStory(stage="scheduler", text=told, task=name, epoch=allocation.epoch, decision=decision))

    # --- what the later stages tell ------------------------------------------------------------------------------

    def on_called(self, name: TaskId, *, is_escape: bool, now: float) -> None:
        """Another robot has called this one to a vote: judge now, and answer it."""
        self.tasks[name].is_called = True
        self.tasks[name].is_called_escape |= is_escape
        if self._gather is None:
            self.hurry(now)

    def on_stayed(self, name: TaskId) -> None:
        """A vote has ended with: stay."""
        self.tasks[name].judge.forgive()

    def on_moved(
        self,
        name: TaskId,
        left: NodeId | None,
        *,
        has_failed: bool,
        now: float,
        was_draining: bool = False,
        is_escape: bool = False,
        is_ordered: bool = False,
    ) -> None:
        """A new owner is known: ``left`` is the one before (``None``: the first placement, which is no move).

        A node that drained was told to: that says nothing against it, however soon, and though it is gone by now. Nor
        does an operator's move. ``is_escape``: it was fled from, though it may not have failed.
        """
        if left is None or is_ordered:
            return
        task = self.tasks[name]
        task.fuse.note_move(is_escape=has_failed or is_escape, now=now)
        if has_failed and not was_draining:
            task.judge.kept.fail(left, now, LEASELESS_S if task.lacks_lease(left) else 0.0)

    def forgive(self, name: TaskId, node: NodeId, now: float) -> None:
        """An operator has mended what was held against a node; judge again at once."""
        self.tasks[name].judge.kept.seen.pop(node, None)
        self.hurry(now)

    def on_learnt(self, name: TaskId, *, is_new_epoch: bool, now: float, tuning: Tuning | None = None) -> None:
        """A newer revision is known, and its tuning: an edge, which judges nothing, tells it all the same."""
        task = self.tasks[name]
        task.told = ""
        task.is_called = task.is_called_escape = False  # a call is to a vote on the value before
        if tuning is not None:
            task.under(tuning)
        task.judge.reset(is_new_owner=is_new_epoch)
        if is_new_epoch:
            task.settled_at = now
        if self._gather is not None and len(self.tasks) > 1:
            # What was gathered says nothing of what this task will use at its new owner: no other may move by it.
            self._gather = None
            self.hurry(now)
        if any(other.is_waiting_its_turn for other in self.tasks.values()):
            self.hurry(now)
