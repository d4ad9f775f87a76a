"""The one door: `Node.handle` takes what happened and returns what to do; nothing else changes a node's state.

Knows: how the six stages follow each other, and the order of a batch (persist, then send, then apply). Does not know:
clocks, random sources, sockets, files, processes; time and the generator are passed in.

After the event is absorbed, `_advance` lets every stage act on the time that has passed, in the order in which the data
flows: PROFILE, GATEWAY, SCHEDULER, VOTE, EXECUTOR, ROUTE. Our own profile, utility and proposal enter by the same
methods as a peer's.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.executor import Executor
from zsched.core.fleet import Fleet
from zsched.core.gateway import Gateway
from zsched.core.membership import Membership, Transition
from zsched.core.messages import CommandOutcome, CommandResult, Learnt
from zsched.core.model import (
    Allocation,
    Beat,
    DurableState,
    NodeId,
    NodeKind,
    PeerState,
    RegisterState,
    TaskId,
    Weights,
    WorkerState,
)
from zsched.core.plan import ReadyWhen, StreamCount
from zsched.core.profile import Profiler
from zsched.core.register import Change, MoveOwner, Register, Retune, RoundOutcome, Step
from zsched.core.rounds import Rounds
from zsched.core.status import PastValue, build_snapshot

HISTORY = 32
SETTLE_AFTER_START_S = 0.3
ASK_LEARNT_EVERY_S = 0.3


@dataclass(slots=True)
class _Batch:
    """One call's instructions, sorted into the order that makes every prefix safe."""

    is_dirty: bool
    send: list[do.Instruction]
    apply: list[do.Instruction]

    def add(self, *instructions: do.Instruction) -> None:
        """Sort instructions into sending (other nodes see it) and applying (this machine does it)."""
        for instruction in instructions:
            is_local = isinstance(
                instruction, do.ApplyRoutes | do.SetRole | do.StartWorker | do.StopWorker | do.RecordStory
            )
            (self.apply if is_local else self.send).append(instruction)


class Node:
    """One daemon's whole decision state.

    Args:
        fleet: the validated fleet file.
        me: this node's name.
        durable: what the state file holds, with the incarnation of *this* start; ``None`` when there is no valid file
            (then this node is no elector).
        incarnation: this start's number (the durable one, or a guess above any seen when there is none).
        electorate: hash of the electorate in force.
        rng: seeded by the shell; the only source of chance.
        now: monotonic seconds.
        version: of the program, for status.
    """

    def __init__(
        self,
        *,
        fleet: Fleet,
        me: NodeId,
        durable: DurableState | None,
        incarnation: int,
        electorate: str,
        rng: Random,
        now: float,
        version: str = "",
    ) -> None:
        self.fleet, self.me, self.version = fleet, me, version
        self.kind = fleet.node(me).kind
        self.incarnation = incarnation
        self.started_at = now
        self.has_state = durable is not None
        self._durable = durable
        self.is_elector = self.has_state and me in fleet.electors
        self.counters: Counter[str] = Counter()
        self.problems: dict[str, str] = {}
        self.is_draining = False
        self.worker_states = self._initial_workers()
        self.stream_counts: tuple[StreamCount, ...] = ()
        self.history: dict[TaskId, deque[PastValue]] = {task.name: deque(maxlen=HISTORY) for task in fleet.tasks}
        self._reasons: dict[TaskId, str] = {}

        names = tuple(node.name for node in fleet.nodes)
        self.membership = Membership(me, names, fleet.timing)
        self.profiler = Profiler(me, incarnation, fleet.timing)
        self.gateway = Gateway(fleet)
        self.rounds = Rounds(fleet, me, self.gateway, rng, now)
        stored = {} if durable is None else {state.task: state for state in durable.registers}
        self.registers = {
            task.name: Register(
                me=me,
                incarnation=incarnation,
                electors=fleet.electors,
                electorate=electorate,
                is_elector=self.is_elector,
                initial=Allocation(task=task.name, revision=0, epoch=0, owner=None, tuning=task.tuning),
                state=stored.get(task.name, RegisterState(task=task.name)),
                ballot_s=fleet.timing.ballot_s,
                stagger_s=fleet.timing.stagger_s,
                rng=rng,
            )
            for task in fleet.tasks
        }
        self._foreign_registers = tuple(stored[name] for name in sorted(stored) if name not in self.registers)
        self.executors = {
            task.name: Executor(spec=task, me=me, has_streams=self.kind is NodeKind.ROBOT) for task in fleet.tasks
        }
        self._beat_at = now
        self._beat_sequence = 0
        self.loop_lag_s = 0.0
        self._promised = math.inf
        self._settle_at = now + SETTLE_AFTER_START_S if self.is_elector else math.inf
        self._asked_at: dict[NodeId, float] = {}
        self._batch = _Batch(False, [], [])
        self._handlers = self._table()

    def _initial_workers(self) -> dict[TaskId, WorkerState]:
        states = {}
        for task in self.fleet.tasks:
            if self.me in task.candidates:
                is_foreign = not task.worker.command and task.worker.ready_when is ReadyWhen.MATCHING
                states[task.name] = WorkerState.READY if is_foreign else WorkerState.STOPPED
        return states

    # --- the door ----------------------------------------------------------------------------------------------------

    def start(self, now: float) -> tuple[do.Instruction, ...]:
        """The first batch: warm workers start, and what was learnt before the restart is carried out again."""
        for name, executor in self.executors.items():
            self._batch.add(*executor.start())
            value = self.registers[name].value
            if value.revision > 0:
                self._reasons[name] = "known from before the restart"
                self._apply(value, now)
        return self._finish(now)

    def handle(self, event: ev.Event, now: float) -> tuple[do.Instruction, ...]:
        """Take one event in; the batch to carry out, in order (cut it anywhere, it stays safe).

        Args:
            event: what happened.
            now: monotonic seconds, never less than before.
        """
        self._note_lag(now)
        self._handlers[type(event)](event, now)
        return self._finish(now)

    def next_deadline(self) -> float:
        """When to call `handle` with `DeadlineReached` if nothing happens before (monotonic seconds)."""
        return self._promised

    def _finish(self, now: float) -> tuple[do.Instruction, ...]:
        self._advance(now)
        batch, self._batch = self._batch, _Batch(False, [], [])
        self._promised = self._next_deadline()
        first: tuple[do.Instruction, ...] = ()
        if batch.is_dirty and self._durable is not None:
            self._durable = self._to_persist()
            first = (do.PersistState(state=self._durable),)
        return (*first, *batch.send, *batch.apply)

    def _to_persist(self) -> DurableState:
        assert self._durable is not None
        states = tuple(self.registers[name].state for name in sorted(self.registers))
        return replace(self._durable, registers=(*states, *self._foreign_registers))

    def _next_deadline(self) -> float:
        return min(
            self._beat_at,
            self._settle_at,
            self.membership.next_deadline(),
            self.rounds.next_deadline(),
            *(register.next_deadline() for register in self.registers.values()),
            *(executor.next_deadline() for executor in self.executors.values()),
        )

    def _note_lag(self, now: float) -> None:
        lag_s = max(now - self._promised, 0.0)
        self.loop_lag_s = max(self.loop_lag_s, lag_s)
        self.membership.note_lag(lag_s)

    def _advance(self, now: float) -> None:
        """Let every stage act on the time that has passed, in the data's order."""
        for change in self.membership.tick(now):
            self._on_transition(change, now)
        self._publish_profile(now)
        self._batch.add(*self.rounds.tick(self.values(), self.membership.states(), now))
        for task, commit in self.rounds.due_commits(now):
            self._take(task, self.registers[task].propose(commit, now), now)
        self._tick_registers(now)
        for executor in self.executors.values():
            self._batch.add(*executor.tick(now))
        if now >= self._beat_at:
            self._beat(now)

    def _tick_registers(self, now: float) -> None:
        for name, register in self.registers.items():
            if now >= self._settle_at:
                self._take(name, register.settle(now), now)
            if now >= register.next_deadline():
                self._take(name, register.tick(now), now)
        if now >= self._settle_at:
            self._settle_at = math.inf

    def values(self) -> dict[TaskId, Allocation]:
        """{task: the newest learnt register value}."""
        return {name: register.value for name, register in self.registers.items()}

    def owned(self) -> tuple[TaskId, ...]:
        """The tasks that this node owns, as far as it has learnt."""
        return tuple(name for name, value in self.values().items() if value.owner == self.me)

    # --- membership --------------------------------------------------------------------------------------------------

    def _beat(self, now: float) -> None:
        self._beat_sequence += 1
        self.membership.fade_doubt()
        beat = Beat(
            node=self.me,
            incarnation=self.incarnation,
            sequence=self._beat_sequence,
            loop_lag_s=min(self.loop_lag_s, 86400.0),
            learnt=tuple((name, value.revision, value.epoch) for name, value in self.values().items()),
            suspects=self.membership.suspects(),
        )
        self.loop_lag_s = 0.0
        self._beat_at = now + self.fleet.timing.beat_s
        self._batch.add(do.PublishBeat(beat=beat))

    def _on_beat(self, event: ev.BeatReceived, now: float) -> None:
        beat = event.beat
        if beat.node == self.me:
            if beat.incarnation != self.incarnation:
                self.problems["membership"] = f"another daemon calls itself {self.me!r}"
            return
        for change in self.membership.absorb_beat(beat, now):
            self._on_transition(change, now)
        self._compare_revisions(beat, now)

    def _compare_revisions(self, beat: Beat, now: float) -> None:
        """A peer has learnt more than we: ask it."""
        is_behind = any(
            task in self.registers and revision > self.registers[task].value.revision
            for task, revision, _ in beat.learnt
        )
        if is_behind and now - self._asked_at.get(beat.node, -math.inf) >= ASK_LEARNT_EVERY_S:
            self._asked_at[beat.node] = now
            self._batch.add(do.AskLearnt(peer=beat.node, deadline_s=self.fleet.timing.ballot_s))

    def _on_token_lost(self, event: ev.TokenLost, now: float) -> None:
        for change in self.membership.absorb_token_lost(event.node, event.incarnation, now):
            self._on_transition(change, now)

    def _on_token_seen(self, event: ev.TokenSeen, _now: float) -> None:
        self.counters["tokens_seen"] += 1
        if event.node == self.me and event.incarnation != self.incarnation:
            self.problems["membership"] = f"another daemon calls itself {self.me!r}"

    def _on_transition(self, change: Transition, now: float) -> None:
        text = f"{change.node} {change.before} -> {change.after}: {change.reason}"
        self._batch.add(do.RecordStory(stage="membership", text=text))
        self._beat_at = now  # tell the others at once: they wait for a second observer
        if change.after is PeerState.GONE:
            for executor in self.executors.values():
                self._batch.add(*executor.on_gone(change.node))
        if any(value.owner == change.node for value in self.values().values()):
            self.rounds.hurry(now)

    # --- PROFILE, GATEWAY --------------------------------------------------------------------------------------------

    def _on_sampled(self, event: ev.ProfileSampled, now: float) -> None:
        self.profiler.absorb(event.device, event.links, now)

    def _publish_profile(self, now: float) -> None:
        profile = self.profiler.publishable(self.worker_states, is_draining=self.is_draining, now=now)
        if profile is not None:
            self.gateway.absorb(profile, now)
            self._batch.add(do.PublishProfile(profile=profile))

    def _on_profile(self, event: ev.ProfileReceived, now: float) -> None:
        profile = event.profile
        if profile.node == self.me:
            return
        reason = self.gateway.absorb(profile, now)
        if reason is not None:
            self.counters[f"profile_{reason}"] += 1
            return
        failed = {load.task for load in profile.workers if load.state is WorkerState.FAILED}
        owned = {name for name, value in self.values().items() if value.owner == profile.node}
        if owned and (profile.draining or owned & failed):
            self.rounds.hurry(now)

    # --- SCHEDULER, VOTE ---------------------------------------------------------------------------------------------

    def _on_utility_asked(self, event: ev.UtilityAsked, now: float) -> None:
        utilities = self.rounds.vectors(self.values(), self.membership.states(), now)
        self._batch.add(do.AnswerUtilities(request=event.request, utilities=utilities))

    def _on_utility(self, event: ev.UtilityReceived, _now: float) -> None:
        if event.utilities.voter not in self.fleet.voters:
            return  # edges hear the question too and have nothing to say
        if not self.rounds.absorb_utilities(event.gather, event.utilities):
            self.counters["utility_late"] += 1

    def _on_proposal(self, event: ev.ProposalReceived, now: float) -> None:
        proposal = event.proposal
        if proposal.task not in self.registers or proposal.voter not in self.fleet.voters:
            self.counters["proposal_foreign"] += 1
            return
        value = self.registers[proposal.task].value
        if proposal.base_revision != value.revision:
            self.counters["proposal_stale" if proposal.base_revision < value.revision else "proposal_ahead"] += 1
        if self.rounds.is_voter and proposal.candidate in self.fleet.task(proposal.task).candidates:
            self._batch.add(*self.rounds.absorb_proposal(proposal, value, self.membership.states(), now))

    def _on_prepare(self, event: ev.PrepareAsked, now: float) -> None:
        register = self.registers.get(event.prepare.task)
        if register is None or event.prepare.ballot.node != event.asker:
            self.counters["prepare_foreign"] += 1
            return
        step, answer = register.on_prepare(event.prepare)
        self._take(event.prepare.task, step, now)
        self._batch.add(do.AnswerElection(request=event.request, answer=answer))

    def _on_accept(self, event: ev.AcceptAsked, now: float) -> None:
        register = self.registers.get(event.accept.task)
        if register is None or event.accept.acceptance.ballot.node != event.asker:
            self.counters["accept_foreign"] += 1
            return
        step, answer = register.on_accept(event.accept, now)
        self._take(event.accept.task, step, now)
        self._batch.add(do.AnswerElection(request=event.request, answer=answer))

    def _on_elector_answer(self, event: ev.ElectorAnswered, now: float) -> None:
        register = self.registers.get(event.answer.task)
        if register is not None:
            self._take(event.answer.task, register.on_answer(event.answer, now), now)

    def _on_learnt(self, event: ev.LearntReceived, now: float) -> None:
        if event.learnt.node == self.me:
            return
        for value in event.learnt.values:
            register = self.registers.get(value.task)
            if register is None:
                self.counters["learnt_foreign"] += 1
                continue
            self._take(value.task, register.learn(value, now), now)

    def _on_learnt_asked(self, event: ev.LearntAsked, _now: float) -> None:
        self._batch.add(do.AnswerLearnt(request=event.request, learnt=self._learnt()))

    def _learnt(self) -> Learnt:
        return Learnt(node=self.me, values=tuple(value for value in self.values().values() if value.revision > 0))

    def _take(self, task: TaskId, step: Step, now: float) -> None:
        """Carry out what a register's step asks for."""
        self._batch.is_dirty |= step.is_dirty
        if step.problem:
            self.problems[f"register/{task}"] = step.problem
        deadline_s = self.fleet.timing.ballot_s
        if step.prepare is not None:
            self._batch.add(do.SendPrepare(prepare=step.prepare, deadline_s=deadline_s))
        if step.accept is not None:
            self._batch.add(do.SendAccept(accept=step.accept, deadline_s=deadline_s))
        if step.finished is not None:
            self._on_finished(task, *step.finished, step.learnt)
        if step.learnt is not None:
            self._apply(step.learnt, now)

    def _on_finished(self, task: TaskId, change: Change, outcome: RoundOutcome, learnt: Allocation | None) -> None:
        """A change that this node proposed has ended."""
        if outcome is RoundOutcome.COMMITTED:
            self._reasons[task] = change.reason if isinstance(change, MoveOwner) else "retuned by an operator"
            self._batch.add(do.PublishLearnt(learnt=self._learnt()))
        if isinstance(change, MoveOwner):
            self.rounds.on_commit_ended(task)
            text = f"move to {change.owner} on revision {change.base_revision}: {outcome}"
            epoch = learnt.epoch if learnt is not None else self.registers[task].value.epoch
            self._batch.add(do.RecordStory(stage="vote", text=text, task=task, epoch=epoch))
        elif change.request is not None:
            self._answer_retune(task, change.request, outcome)

    def _answer_retune(self, task: TaskId, request: int, outcome: RoundOutcome) -> None:
        words = {
            RoundOutcome.COMMITTED: (CommandOutcome.OK, "committed by a majority of the electors"),
            RoundOutcome.CONFLICT: (CommandOutcome.CONFLICT, "another change came first; look and try again"),
            RoundOutcome.NO_QUORUM: (CommandOutcome.NO_QUORUM, "no majority of the electors answered"),
            RoundOutcome.UNKNOWN: (CommandOutcome.UNKNOWN, "the electors fell silent; `zsched status` tells"),
        }
        kind, detail = words[outcome]
        revision = self.registers[task].value.revision
        result = CommandResult(outcome=kind, detail=f"{task}: {detail}", revision=revision)
        self._batch.add(do.AnswerCommand(request=request, result=result))

    def _on_persist_failed(self, event: ev.PersistFailed, _now: float) -> None:
        """The disk refused: no elector any more, but routes and workers go on (what was cut off is given again)."""
        self.problems["state"] = f"{event.reason}; this node is no elector until it is restarted"
        self._durable, self.is_elector = None, False
        for register in self.registers.values():
            register.stop_electing()
        for executor in self.executors.values():
            self._batch.add(*executor.again())

    # --- EXECUTOR, ROUTE ---------------------------------------------------------------------------------------------

    def _apply(self, value: Allocation, now: float) -> None:
        """A newer value is learnt (and will be on disk before this batch does anything)."""
        task, executor = value.task, self.executors[value.task]
        is_new_epoch = value.epoch > executor.epoch
        reason = self._reasons.pop(task, "learnt from a peer")
        self.history[task].append(PastValue(value=value, at=now, reason=reason))
        self.rounds.on_learnt(task, is_new_epoch=is_new_epoch, now=now)
        text = f"learnt revision {value.revision}: owner {value.owner}, weights {_weights(value.tuning.weights)}"
        self._batch.add(do.RecordStory(stage="vote", text=text, task=task, epoch=value.epoch))
        self._batch.add(*executor.execute(value, now))
        old = executor.predecessor
        if old is not None and self.membership.state(old) is PeerState.GONE:
            self._batch.add(*executor.on_gone(old))
        self._beat_at = now

    def _on_worker(self, event: ev.WorkerChanged, now: float) -> None:
        if self.worker_states.get(event.task) is event.state:
            return
        self.worker_states[event.task] = event.state
        text = f"worker {event.state}{': ' if event.reason else ''}{event.reason}"
        self._batch.add(do.RecordStory(stage="executor", text=text, task=event.task))
        if event.task in self.owned():
            self.rounds.hurry(now)

    def _on_slot_ready(self, event: ev.SlotReady, _now: float) -> None:
        if event.task in self.executors and event.is_ready:
            self._batch.add(*self.executors[event.task].on_ready(event.epoch))

    def _on_slot_flipped(self, event: ev.SlotFlipped, now: float) -> None:
        if event.task in self.executors:
            self._batch.add(*self.executors[event.task].on_flipped(event.epoch, event.replayed, now))

    def _on_slot_drained(self, event: ev.SlotDrained, _now: float) -> None:
        if event.task in self.executors:
            self._batch.add(*self.executors[event.task].on_drained(event.epoch))

    def _on_counted(self, event: ev.StreamsCounted, _now: float) -> None:
        self.stream_counts = event.counts

    def _on_relay(self, event: ev.RelayChanged, _now: float) -> None:
        self._set_problem("relay", None if event.is_running else f"the relay is down: {event.reason}")
        if not event.is_running:
            self.counters["relay_exits"] += 1

    # --- operators ---------------------------------------------------------------------------------------------------

    def _on_status(self, event: ev.StatusAsked, now: float) -> None:
        self._batch.add(do.AnswerStatus(request=event.request, snapshot=build_snapshot(self, now)))

    def _on_weights(self, event: ev.WeightsCommanded, now: float) -> None:
        command = event.command
        register = self.registers.get(command.task)
        try:
            weights = Weights(cpu=command.cpu, memory=command.memory, network=command.network)
        except ValueError as error:
            return self._refuse(event.request, CommandOutcome.INVALID, str(error))
        if register is None:
            known = ", ".join(sorted(self.registers))
            return self._refuse(event.request, CommandOutcome.INVALID, f"no task {command.task!r}; tasks: {known}")
        value = register.value
        if command.base_revision not in (None, value.revision):
            detail = f"revision is {value.revision}, not {command.base_revision}"
            return self._refuse(event.request, CommandOutcome.CONFLICT, detail)
        if weights == value.tuning.weights:
            return self._refuse(event.request, CommandOutcome.UNCHANGED, "these are the weights in force")
        change = Retune(
            base_revision=value.revision, tuning=replace(value.tuning, weights=weights), request=event.request
        )
        return self._take(command.task, register.propose(change, now), now)

    def _refuse(self, request: int, outcome: CommandOutcome, detail: str) -> None:
        self._batch.add(do.AnswerCommand(request=request, result=CommandResult(outcome=outcome, detail=detail)))

    def _on_dropped(self, event: ev.FrameDropped, _now: float) -> None:
        self.counters[f"dropped_{event.kind}_{event.reason}"] += 1

    def _on_problem(self, event: ev.ProblemReported, _now: float) -> None:
        self._set_problem(event.source, event.problem)

    def _set_problem(self, source: str, problem: str | None) -> None:
        if problem is None:
            self.problems.pop(source, None)
        else:
            self.problems[source] = problem

    def _on_stop(self, _event: ev.StopRequested, _now: float) -> None:
        """Drain: the profile says so, and the robots move what this node owns."""
        self.is_draining = True

    def _table(self) -> dict[type[Any], Callable[[Any, float], None]]:
        return {
            ev.DeadlineReached: lambda _event, _now: None,
            ev.ProfileSampled: self._on_sampled,
            ev.ProfileReceived: self._on_profile,
            ev.UtilityAsked: self._on_utility_asked,
            ev.UtilityReceived: self._on_utility,
            ev.ProposalReceived: self._on_proposal,
            ev.PrepareAsked: self._on_prepare,
            ev.AcceptAsked: self._on_accept,
            ev.ElectorAnswered: self._on_elector_answer,
            ev.LearntReceived: self._on_learnt,
            ev.LearntAsked: self._on_learnt_asked,
            ev.PersistFailed: self._on_persist_failed,
            ev.BeatReceived: self._on_beat,
            ev.TokenSeen: self._on_token_seen,
            ev.TokenLost: self._on_token_lost,
            ev.WorkerChanged: self._on_worker,
            ev.SlotReady: self._on_slot_ready,
            ev.SlotFlipped: self._on_slot_flipped,
            ev.SlotDrained: self._on_slot_drained,
            ev.StreamsCounted: self._on_counted,
            ev.RelayChanged: self._on_relay,
            ev.StatusAsked: self._on_status,
            ev.WeightsCommanded: self._on_weights,
            ev.FrameDropped: self._on_dropped,
            ev.ProblemReported: self._on_problem,
            ev.StopRequested: self._on_stop,
        }


def _weights(weights: Weights) -> str:
    return f"cpu={weights.cpu:g} memory={weights.memory:g} network={weights.network:g}"
