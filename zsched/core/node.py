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
from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random
from typing import Any

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.batch import Batch
from zsched.core.executor.handover import Executor
from zsched.core.executor.progress import HangWatch
from zsched.core.executor.sealing import Sealing
from zsched.core.executor.tenure import Tenure
from zsched.core.executor.workers import Workers, failed_workers
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.round_trips import RoundTrips
from zsched.core.membership.beat_room import BeatRoom
from zsched.core.membership.identity import Identity, Verdict
from zsched.core.membership.knocking import Knocking
from zsched.core.membership.namesakes import Namesakes
from zsched.core.membership.peers import Membership, Transition
from zsched.core.membership.relink import Introductions
from zsched.core.profile.profile import Profiler
from zsched.core.profile.relay_ends import RelayEnds
from zsched.core.scheduler.probation import Probation
from zsched.core.scheduler.rounds import Rounds
from zsched.core.scheduler.scoring import NO_DOUBTS, Doubts
from zsched.core.status import PastValue, build_snapshot
from zsched.core.values.fleet import Fleet, TaskSpec, fleet_hash, runs_worker
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import (
    Allocation,
    Beat,
    DurableState,
    NodeId,
    NodeKind,
    PeerState,
    Proposal,
    TaskId,
    Weights,
    WorkerState,
)
from zsched.core.values.plan import StreamCount
from zsched.core.vote.agreement import NOTHING, Agreement, Effects

HISTORY = 32
_OFTEN_QUIET = frozenset(
    {
        ev.BeatReceived,
        ev.ProfileReceived,
        ev.UtilityAsked,
        ev.UtilityReceived,
        ev.LearntAsked,
        ev.TokenSeen,
        ev.StreamsCounted,
        ev.WorkerTroubled,
        ev.WorkerJobs,
        ev.FrameDropped,
        ev.ClockCompared,
    }
)


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
        self.has_foreign_state = False
        """The state file is whole, and of another electorate than the fleet file: it stays on its disk."""
        self.lacks_state_file = False
        self.counters: Counter[str] = Counter()
        self.problems: dict[str, str] = {}
        self.is_draining = False
        self._workers = Workers.of(fleet, me)
        self.worker_states = self._workers.states
        self.stream_counts: tuple[StreamCount, ...] = ()
        self.dropped: dict[str, tuple[int, float]] = {}
        """{stream: (how many samples it has dropped, when that last rose)}."""
        self.relay_ends = RelayEnds()
        self.joins_at: tuple[str, ...] = ()
        """Where applications on this machine join its streams, for the status."""
        self.history: dict[TaskId, deque[PastValue]] = {task.name: deque(maxlen=HISTORY) for task in fleet.tasks}

        names = tuple(node.name for node in fleet.nodes)
        self.membership = Membership(me, names, fleet.timing)
        self.profiler = Profiler(me, incarnation, fleet.timing)
        self.gateway = Gateway(fleet)
        self.round_trips = RoundTrips(me)
        self._has_deadlines = any(task.tuning.deadline_ms is not None for task in fleet.tasks)
        self._probation = Probation(fleet)
        self.rounds = Rounds(fleet, me, self.gateway, rng, now, self._doubts, self.round_trips)
        self.agreement = Agreement(
            fleet=fleet,
            me=me,
            durable=durable,
            incarnation=incarnation,
            electorate=electorate,
            rng=rng,
            now=now,
        )
        self.registers = self.agreement.registers
        self.executors = {
            task.name: Executor(spec=task, me=me, has_streams=self.kind is NodeKind.ROBOT) for task in fleet.tasks
        }
        self.stateless: set[NodeId] = set()
        """Electors whose newest beat says that they answer no proposer."""
        self.unready: dict[TaskId, tuple[int, float]] = {}
        """{task: (epoch, since when)} of the slots whose worker our relay does not see any more."""
        self.lacks: dict[TaskId, ev.SlotReady] = {}
        """{task: what our relay misses of such a worker}."""
        self.fleet_file = fleet_hash(fleet)
        self.fleet_path = ""
        """Where that file lies, for the status."""
        self._identity = Identity(me, incarnation, self.fleet_file, now, fleet.timing.beat_s)
        self.namesakes = Namesakes(fleet.timing.beat_s)
        self.knocking = Knocking(self.fleet_file)
        self._introductions = Introductions()
        self._hangs = HangWatch(fleet)
        self._tenure = Tenure(fleet, me, self.agreement.leases, self.executors)
        self.sealing = Sealing(fleet, me, self.executors, self.agreement.leases.over_at)
        self._beat_at = self._turn_at = now
        self._beat_sequence = 0
        self._beat_room = BeatRoom()
        self.loop_lag_s = 0.0
        self._promised = math.inf
        self._batch = Batch()
        self._handlers = self._table()

    # --- the door ----------------------------------------------------------------------------------------------------

    def start(self, now: float) -> tuple[do.Instruction, ...]:
        """The first batch: warm workers start, and what was learnt before the restart is carried out again."""
        self._batch.is_dirty = self.agreement.must_persist
        for name, executor in self.executors.items():
            self._batch.add(*executor.start())
            value = self.registers[name].value
            if value.revision > 0:
                self._apply(value, "known from before the restart", now)
        return self._finish(now)

    def handle(self, event: ev.Event, now: float) -> tuple[do.Instruction, ...]:
        """Take one event in; the batch to carry out, in order (cut it anywhere, it stays safe).

        Args:
            event: what happened.
            now: monotonic seconds, never less than before.
        """
        self.absorb(event, now)
        if type(event) in _OFTEN_QUIET and self._is_quiet(now):
            return self._only_sent()
        return self._finish(now)

    def absorb(self, event: ev.Event, now: float) -> None:
        """Take an event in and act on nothing yet, nor on the time that has passed: `handle` must follow at once.

        After a stall many beats wait. Whoever judged by the time after the first of them would take the senders of all
        others for silent.
        """
        if now > self._promised:
            self._note_lag(now - self._promised, now)
        self._handlers[type(event)](event, now)

    def _is_quiet(self, now: float) -> bool:
        """Whether the event left nothing but an answer before the deadline that was promised: nine in ten do.

        A later deadline is not worth computing then: waking up once too early costs less than thirty beats a second.
        """
        if now >= self._promised or now >= self._beat_at or now >= self.rounds.next_deadline():
            return False
        batch = self._batch
        return not (batch.is_dirty or batch.apply or self._tenure.is_busy or self.agreement.has_parked)

    def _only_sent(self) -> tuple[do.Instruction, ...]:
        """The batch of an event that changed nothing here."""
        if not self._batch.send:
            return ()
        sent, self._batch.send = tuple(self._batch.send), []
        return sent

    def next_deadline(self) -> float:
        """When to call `handle` with `DeadlineReached` if nothing happens before (monotonic seconds)."""
        return self._promised

    def _finish(self, now: float) -> tuple[do.Instruction, ...]:
        self._advance(now)
        batch, self._batch = self._batch, Batch()
        # A limit that shrank may lie in the past already; that is no lag of this loop.
        self._promised = max(self._next_deadline(now), now)
        state = self.agreement.to_persist(now) if batch.is_dirty else None
        first: tuple[do.Instruction, ...] = () if state is None else (do.PersistState(state=state),)
        return (*first, *batch.send, *batch.apply)

    def _next_deadline(self, now: float) -> float:
        due = min(
            self._beat_at,
            self.membership.next_deadline(),
            self.rounds.next_deadline(),
            self.agreement.next_deadline(),
            self._tenure.next_deadline(now),
        )
        for executor in self.executors.values():
            due = min(due, executor.next_deadline())
        return due

    def _note_lag(self, lag_s: float, now: float) -> None:
        self.loop_lag_s = max(self.loop_lag_s, lag_s)
        self.membership.note_lag(lag_s)
        self._hangs.note_lag(lag_s, now)

    def _advance(self, now: float) -> None:
        """Let every stage act on the time that has passed, in the data's order."""
        for change in self.membership.tick(now):
            self._on_transition(change, now)
        self._publish_profile(now)
        if not self.rounds.is_idle(now):
            self._batch.add(*self.rounds.tick(self.values(), self.membership.states(), now))
        for task, commit in self.rounds.due_commits(now):
            self._agree(self.agreement.propose(task, commit, now), now)
        if now >= self.agreement.next_deadline():
            self._agree(self.agreement.tick(now), now)
        self._tend(now)
        for executor in self.executors.values():
            if now >= executor.next_deadline():
                self._batch.add(*executor.tick(now))
        if now >= self._beat_at:
            self._beat(now)

    def values(self) -> Mapping[TaskId, Allocation]:
        """{task: the newest learnt register value}."""
        return self.agreement.values()

    def owned(self) -> tuple[TaskId, ...]:
        """The tasks that this node owns, as far as it has learnt."""
        return tuple(name for name, value in self.values().items() if value.owner == self.me)

    def movable(self, now: float) -> tuple[TaskId, ...]:
        """What of it another candidate could take, as far as is known: one that lives and does not drain itself."""
        return tuple(name for name in self.owned() if any(map(self._can_take(now), self.fleet.task(name).candidates)))

    def _can_take(self, now: float) -> Callable[[NodeId], bool]:
        def can(node: NodeId) -> bool:
            is_there = node != self.me and self.membership.state(node) is PeerState.ALIVE
            return is_there and not self._was_draining(node, now)

        return can

    # --- membership --------------------------------------------------------------------------------------------------

    def _beat(self, now: float) -> None:
        self._beat_sequence += 1
        if "membership" in self.problems:
            self._complain(now)
        self.membership.fade_doubt()
        parts = self.agreement.leases.on_sent(self._beat_sequence, now)
        beat = Beat(
            node=self.me,
            incarnation=self.incarnation,
            sequence=self._beat_sequence,
            loop_lag_s=min(self.loop_lag_s, 86400.0),
            learnt=tuple((name, value.revision, value.epoch) for name, value in self.values().items()),
            suspects=self.membership.suspects(),
            echoes=parts.echoes,
            released=parts.released,
            asked_to_leave=parts.asked_to_leave,
            fleet_file=self.fleet_file,
            has_voted=self.agreement.has_voted,
            generation=self.agreement.generation or 0,
            lease_terms=self.agreement.leases.terms_told,
            votes=self.agreement.witness.votes,
            has_lost_state=self.me in self.fleet.electors and not self.agreement.is_elector,
            electorate=self.agreement.electorate if self.agreement.is_elector else "",
            twins=self.namesakes.names(now),
        )
        self.loop_lag_s = 0.0
        is_in_turn = self._beat_at == self._turn_at  # whoever has news has brought the next beat forward
        self._beat_at = self._turn_at = now + self.fleet.timing.beat_s
        self._batch.add(do.PublishBeat(beat=self._fitting(beat), is_news=not is_in_turn))
        self._seal(now)
        self._hear_leases(beat, now, is_newest=True)
        if self._introductions.is_due(now, is_missing=self.membership.misses_anybody):
            self._batch.add(do.IntroducePeers())

    def _fitting(self, beat: Beat) -> Beat:
        """The beat as it is sent: never too large to be sent."""
        sent, left_out = self._beat_room.fit(beat)
        if left_out:
            self.counters["beat_parts_left_out"] += left_out
        if left_out or "beat" in self.problems:
            text = f"{left_out} parts have no room in a beat and come in turn: fewer exclusive tasks, or shorter names"
            self._set_problem("beat", text if left_out else None)
        return sent

    def _on_beat(self, event: ev.BeatReceived, now: float) -> None:
        beat = event.beat
        if beat.node == self.me:
            self._on_own_name(beat, now)
            return
        if not self.membership.is_known(beat.node):
            self.counters["beat_foreign"] += 1
            self.knocking.on_beat(beat, now)
            return
        if self.namesakes.on_beat(beat, now):
            self._beat_at = now  # the two of them may not hear each other
            text = f"two daemons call themselves {beat.node}"
            self._batch.add(do.RecordStory(stage="membership", text=text))
        if self.namesakes.must_ask(beat.node, now):
            self._ask_peer(beat.node)
        for change in self.membership.absorb_beat(beat, now):
            self._on_transition(change, now)
        if self.membership.is_doubtful(beat.node):
            self.counters["beat_doubtful"] += 1
            return
        if self.me in beat.twins:
            self.agreement.witness.on_twin()
            if self._identity.must_ask(beat.node, now):
                self._ask_peer(beat.node)
        self._agree(self.agreement.compare(beat, now), now)
        if beat.has_lost_state:
            self.stateless.add(beat.node)
        elif self.stateless:
            self.stateless.discard(beat.node)
        self.sealing.hear(beat)
        if beat.fleet_file != self.fleet_file or self.problems:
            self._set_problem(f"fleet/{beat.node}", self._identity.file_complaint(beat, self.fleet_path))
        self._hear_leases(beat, now, is_newest=self.membership.is_newest(beat.node))

    def _on_own_name(self, beat: Beat, now: float) -> None:
        """A beat in our own name that may not be ours."""
        self.agreement.witness.on_twin()
        self._heed(self._identity.on_own_name(beat, self._beat_sequence, now), now)

    def _ask_peer(self, peer: NodeId) -> None:
        self._batch.add(do.AskLearnt(peer=peer, deadline_s=self.fleet.timing.ballot_s))

    def _heed(self, verdict: Verdict, now: float) -> None:
        """Do what another daemon of our name means for this one."""
        if verdict is Verdict.OURS:
            return
        complaint = self._complain(now)
        if verdict is Verdict.LEAVE:
            self._batch.add(do.StandDown(reason=f"{complaint}; stop it, or give this machine a name of its own"))
        elif verdict is Verdict.DISPUTE:
            self._agree(self.agreement.dispute(complaint), now)

    def _complain(self, now: float) -> str:
        """Show whether somebody else uses our name."""
        complaint = self._identity.complaint(now)
        self._set_problem("membership", complaint)
        return complaint or ""

    def _hear_leases(self, beat: Beat, now: float, *, is_newest: bool) -> None:
        if not self._tenure.exclusive:
            return  # thirty beats a second come by here
        if self._tenure.hear(beat, self.agreement.accepted(), now, is_newest=is_newest):
            self._beat_at = now  # a first grant: the new owner waits for its echo
        self.agreement.note_asked(beat, now)
        if beat.released:
            self._agree(self.agreement.retry_parked(now), now)

    def _tend(self, now: float) -> None:
        """Who may work here right now: leases of exclusive tasks, and whether we are cut off."""
        if self._tenure.exclusive:
            instructions, has_released = self._tenure.tend_leases(self._beat_sequence, now)
            self._batch.add(*instructions)
            if has_released:
                self._beat_at = now
        # Also where no task is exclusive any more: the question may have come while one was.
        self._agree(self.agreement.retry_parked(now), now)
        self._batch.add(*self._tenure.tend_isolation(self.membership, now))

    def _on_clock(self, event: ev.ClockCompared, now: float) -> None:
        if self._tenure.on_clock(event, self.agreement.standing(), self._beat_sequence, now):
            self._beat_at = now  # the others must hear whether our echoes count
            self._set_problem("clock", self._tenure.clock.complaint)

    def _seal(self, now: float) -> None:
        """As an owner: what our file says of exclusive tasks shall hold for everybody."""
        for task, change in self.sealing.due(self.values(), now):
            if not self.registers[task].is_busy:
                self._agree(self.agreement.propose(task, change, now), now)
        for peer in self.sealing.to_ask(self.values(), now):
            self._ask_peer(peer)

    def _on_role_ended(self, event: ev.RoleEnded, now: float) -> None:
        if event.task in self.executors:
            self.executors[event.task].on_role_ended(event.epoch)
        if self.agreement.leases.on_stopped(event.task, event.epoch, self._beat_sequence):
            self._beat_at = now

    def _on_token_lost(self, event: ev.TokenLost, now: float) -> None:
        if event.node == self.me:
            self._identity.on_token(event.incarnation, is_present=False)
            self._complain(now)
        elif self.membership.is_known(event.node):
            self.namesakes.on_token(event.node, event.incarnation, is_present=False)
        for change in self.membership.absorb_token_lost(event.node, event.incarnation, now):
            self._on_transition(change, now)

    def _on_token_seen(self, event: ev.TokenSeen, now: float) -> None:
        self.counters["tokens_seen"] += 1
        if event.node == self.me:
            self._identity.on_token(event.incarnation, is_present=True)
            self._complain(now)
        elif self.membership.is_known(event.node):
            self.namesakes.on_token(event.node, event.incarnation, is_present=True)

    def _on_transition(self, change: Transition, now: float) -> None:
        text = f"{change.node} {change.before} -> {change.after}: {change.reason}"
        self._batch.add(do.RecordStory(stage="membership", text=text))
        self._beat_at = now  # tell the others at once: they wait for a second observer
        if change.after is PeerState.ALIVE:
            self._probation.on_back(change.node, now)
            if change.before in (PeerState.SUSPECT, PeerState.GONE):
                self._hangs.on_back(change.node, now)
        if change.after is PeerState.GONE:
            self._probation.on_gone(change.node, now)
            for executor in self.executors.values():
                self._batch.add(*executor.on_gone(change.node))
        if any(value.owner == change.node for value in self.values().values()):
            self.rounds.hurry(now)

    # --- PROFILE, GATEWAY --------------------------------------------------------------------------------------------

    def _on_sampled(self, event: ev.ProfileSampled, now: float) -> None:
        self.profiler.absorb(event.device, event.links, now)

    def _on_jobs(self, event: ev.WorkerJobs, now: float) -> None:
        if event.task not in self.worker_states or not self.profiler.note_jobs(event, now):
            self.counters["jobs_refused"] += 1

    def _publish_profile(self, now: float) -> None:
        progress = self._hangs.reports(now)
        profile = self.profiler.publishable(
            self.worker_states,
            is_draining=self.is_draining,
            now=now,
            progress=progress,
            reasons=self._workers.told(now),
            echoes=self.round_trips.echoes(now),
            relay=self.relay_ends.told(now),
        )
        if profile is not None:
            if self._has_deadlines:
                self.round_trips.note_sent(profile, now)
            self.gateway.absorb(profile, now)
            self._batch.add(do.PublishProfile(profile=profile, is_news=self.profiler.has_news))
            self._batch.add(*self._hangs.look(self.owned(), self.executors, self.gateway, now))

    def _on_profile(self, event: ev.ProfileReceived, now: float) -> None:
        profile = event.profile
        if profile.node == self.me:
            return
        reason = self.gateway.absorb(profile, now, self.membership.incarnation(profile.node))
        if reason is not None:
            self.counters[f"profile_{reason}"] += 1
            return
        if self._has_deadlines:
            self.round_trips.note_heard(profile, self.incarnation, now)
        if profile.progress:
            self._batch.add(*self._hangs.look(self.owned(), self.executors, self.gateway, now))
        failed = failed_workers(profile)
        values = self.values()
        owned = {name for name, value in values.items() if value.owner == profile.node}
        if owned and (profile.draining or owned & failed):
            self.rounds.hurry(now)
        elif any(self._is_orphan(value.owner) for value in values.values()):
            self.rounds.hurry(now)  # this may be the candidate that the task waits for

    def _is_orphan(self, owner: NodeId | None) -> bool:
        """Whether a task's owner is gone: nobody could be found for it so far."""
        return owner is not None and self.membership.state(owner) is PeerState.GONE

    # --- SCHEDULER, VOTE ---------------------------------------------------------------------------------------------

    def _doubts(self, spec: TaskSpec, now: float) -> Doubts:
        in_grace, unproven = self.membership.in_grace(), self._probation.doubts(spec, now)
        unfit = self.agreement.leases.unfit() if self.executors[spec.name].is_leased else {}
        if not in_grace and not unproven and not unfit:
            return NO_DOUBTS
        return Doubts(in_grace=in_grace, unproven=unproven, unfit=unfit)

    def _on_utility_asked(self, event: ev.UtilityAsked, now: float) -> None:
        utilities = self.rounds.vectors(self.values(), self.membership.states(), now)
        self._batch.add(do.AnswerUtilities(request=event.request, utilities=utilities))

    def _on_utility(self, event: ev.UtilityReceived, _now: float) -> None:
        voter = event.utilities.voter
        if not self.membership.is_known(voter):
            self.counters["utility_foreign"] += 1
            return
        if voter not in self.fleet.voters:
            return  # edges hear the question too and have nothing to say
        if not self.rounds.absorb_utilities(event.gather, event.utilities):
            self.counters["utility_late"] += 1

    def _on_proposal(self, event: ev.ProposalReceived, now: float) -> None:
        proposal = event.proposal
        if proposal.voter == self.me or not self._is_ours(proposal):
            self.counters["proposal_foreign"] += 1
            return
        value = self.registers[proposal.task].value
        if proposal.base_revision != value.revision:
            self.counters["proposal_stale" if proposal.base_revision < value.revision else "proposal_ahead"] += 1
        if self.rounds.is_voter:
            self._batch.add(*self.rounds.absorb_proposal(proposal, value, self.membership.states(), now))

    def _is_ours(self, proposal: Proposal) -> bool:
        if proposal.task not in self.registers or proposal.voter not in self.fleet.voters:
            return False
        return proposal.candidate in self.fleet.task(proposal.task).candidates

    def _agree(self, effects: Effects, now: float) -> None:
        """Carry out what the registers ask for."""
        if effects is NOTHING:
            return
        self._batch.is_dirty |= effects.is_dirty
        self._batch.add(*effects.send)
        if effects.is_urgent:
            self._beat_at = now
        for task in effects.ended:
            self.rounds.on_commit_ended(task)
        for value, reason in effects.learnt:
            self._apply(value, reason, now)

    def _on_learnt(self, event: ev.LearntReceived, now: float) -> None:
        self._agree(self.agreement.on_learnt(event, now), now)
        if event.is_answer and self.membership.is_known(event.learnt.node):
            self.sealing.on_answer(event.learnt)
            self._on_twins(event, now)

    def _on_twins(self, event: ev.LearntReceived, now: float) -> None:
        """A peer's answer says where it is, and whether it hears our name twice."""
        learnt = event.learnt
        self.namesakes.on_answer(learnt.node, learnt.daemon, event.where)
        lives = {incarnation: sequence for name, incarnation, sequence in learnt.twins if name == self.me}
        if lives and learnt.node != self.me:
            self._heed(self._identity.on_told(learnt.node, lives, self._beat_sequence, now), now)

    def _on_learnt_asked(self, event: ev.LearntAsked, now: float) -> None:
        learnt = replace(
            self.agreement.answer(),
            unleased=self.sealing.unleased(now),
            daemon=self.incarnation,
            twins=self.namesakes.lives(now),
        )
        self._batch.add(do.AnswerLearnt(request=event.request, learnt=learnt))

    def _on_persist_failed(self, event: ev.PersistFailed, _now: float) -> None:
        """The disk refused: routes and workers go on (what was cut off is given again)."""
        self.agreement.on_persist_failed(event.reason)
        for executor in self.executors.values():
            self._batch.add(*executor.again())

    # --- EXECUTOR, ROUTE ---------------------------------------------------------------------------------------------

    def _apply(self, value: Allocation, reason: str, now: float) -> None:
        """A newer value is learnt (and will be on disk before this batch does anything)."""
        task, executor = value.task, self.executors[value.task]
        is_new_epoch = value.epoch > executor.epoch
        self.history[task].append(PastValue(value=value, at=now, reason=reason))
        if is_new_epoch:
            left = executor.owner
            failed, drained = self._has_failed(task, left, now), self._was_draining(left, now)
            self.rounds.on_moved(task, left, has_failed=failed, was_draining=drained, now=now)
        self.rounds.on_learnt(task, is_new_epoch=is_new_epoch, now=now)
        text = f"learnt revision {value.revision}: owner {value.owner}, weights {_weights(value.tuning.weights)}"
        self._batch.add(do.RecordStory(stage="vote", text=text, task=task, epoch=value.epoch))
        self._batch.add(*executor.execute(value, now))
        self._tenure.hold(value, self._beat_sequence + 1)
        for old in executor.predecessors:
            if self.membership.state(old) is PeerState.GONE:
                self._batch.add(*executor.on_gone(old))
        self._beat_at = now

    def _was_draining(self, node: NodeId | None, now: float) -> bool:
        """Whether an owner was told to stop, by the last that was heard of it."""
        data = None if node is None else self.gateway.newest(node, now)
        return data is not None and data.profile.draining

    def _has_failed(self, task: TaskId, node: NodeId | None, now: float) -> bool:
        """Whether an owner was fled from: it is not there, or its worker has failed."""
        if node is None or node == self.me:
            return False
        if self.membership.state(node) in (PeerState.SUSPECT, PeerState.GONE):
            return True
        profile = self.gateway.fresh(node, now)
        return profile is not None and task in failed_workers(profile)

    def _on_worker(self, event: ev.WorkerChanged, now: float) -> None:
        was_ready = self.worker_states.get(event.task) is WorkerState.READY
        story = self._workers.on_changed(event)
        if story is not None:
            if event.state in (WorkerState.STOPPED, WorkerState.FAILED):
                self.executors[event.task].on_worker_ended()
            if was_ready:
                self.agreement.leases.on_worker_lost(event.task)
            self._hangs.note_worker(event.task, event.state, now)
            self._batch.add(story)
            if event.task in self.owned():
                self.rounds.hurry(now)

    def _on_worker_shown(self, event: ev.WorkerShown, now: float) -> None:
        if event.task not in self.executors or not self.membership.is_known(event.node):
            return
        self._probation.on_token(event.node, event.task, event.incarnation, is_present=event.is_present, now=now)
        if event.is_present and self._is_orphan(self.registers[event.task].value.owner):
            self.rounds.hurry(now)  # this may be the candidate that the task waits for

    def _on_slot_ready(self, event: ev.SlotReady, now: float) -> None:
        if event.task not in self.executors:
            return
        if not event.is_ready:
            known, since = self.unready.get(event.task, (-1, now))
            self.unready[event.task] = (event.epoch, since if known == event.epoch else now)
            self.lacks[event.task] = event
            return
        self.unready.pop(event.task, None)
        self.lacks.pop(event.task, None)
        self._batch.add(*self.executors[event.task].on_ready(event.epoch))

    def _on_slot_flipped(self, event: ev.SlotFlipped, now: float) -> None:
        if event.task in self.executors:
            self._batch.add(*self.executors[event.task].on_flipped(event.epoch, event.replayed, now))

    def _on_slot_drained(self, event: ev.SlotDrained, _now: float) -> None:
        if event.task in self.executors:
            self._batch.add(*self.executors[event.task].on_drained(event.epoch))

    def _on_counted(self, event: ev.StreamsCounted, now: float) -> None:
        self.stream_counts = event.counts
        for count in event.counts:
            dropped = sum(number for _, number in count.drops)
            if dropped and self.dropped.get(count.stream, (0, 0.0))[0] != dropped:
                self.dropped[count.stream] = (dropped, now)
        self._hangs.absorb(event.counts, self.executors, now)
        self.rounds.absorb_counts(event.counts, now)

    def _on_relay(self, event: ev.RelayChanged, now: float) -> None:
        self.relay_ends.on_changed(event, now)
        self._set_problem("relay", None if event.is_running else f"the relay is down: {event.reason}")
        if not event.is_running:
            self._probation.forget_tokens()
            self.unready |= {name: (one.epoch, now) for name, one in self.executors.items() if one.routes}
            self.counters["relay_exits"] += 1

    # --- operators ---------------------------------------------------------------------------------------------------

    def _on_status(self, event: ev.StatusAsked, now: float) -> None:
        self._batch.add(do.AnswerStatus(request=event.request, snapshot=build_snapshot(self, now)))

    def _on_retry(self, event: ev.RetryCommanded, now: float) -> None:
        """Forget failures: of our own worker if it is meant, and what we hold against nodes."""
        task, whose = event.command.task, event.command.node
        if task not in self.executors or (whose and not self._may_work(task, whose)):
            detail = f"no task {task!r}" if task not in self.executors else f"{whose!r} is no candidate of {task}"
            result = CommandResult(outcome=CommandOutcome.INVALID, detail=detail)
            self._batch.add(do.AnswerCommand(request=event.request, result=result))
            return
        self.rounds.forgive(task, whose or None, now)
        state = self.worker_states.get(task) if whose in ("", self.me) else None
        if state is not None:
            self._batch.add(do.ResetWorker(task=task))
        detail = self._forgiven(whose) if state is None else f"its failures are forgotten, it was {state}"
        result = CommandResult(outcome=CommandOutcome.OK, detail=detail)
        self._batch.add(do.AnswerCommand(request=event.request, result=result))

    def _may_work(self, task: TaskId, node: NodeId) -> bool:
        return self.membership.is_known(node) and runs_worker(self.fleet.task(task), node, self.fleet.node(node).kind)

    def _forgiven(self, whose: NodeId) -> str:
        """What a node forgets that has no worker that is meant: robots take penalties off candidates."""
        if not self.rounds.is_voter:
            return "nothing to forget here"
        return f"takes no penalty off {whose or 'any candidate'} any more"

    def _on_dropped(self, event: ev.FrameDropped, _now: float) -> None:
        self.counters[f"dropped_{event.kind}_{event.reason}"] += 1

    def _on_problem(self, event: ev.ProblemReported, _now: float) -> None:
        self._set_problem(event.source, event.problem)

    def _set_problem(self, source: str, problem: str | None) -> None:
        if problem is None:
            self.problems.pop(source, None)
        else:
            self.problems[source] = problem

    def _on_stop(self, _event: ev.StopRequested, now: float) -> None:
        """Drain: the profile says so, and the robots move what this node owns."""
        self.is_draining = True
        if self.owned():
            self.rounds.hurry(now)

    def _table(self) -> dict[type[Any], Callable[[Any, float], None]]:
        return {
            ev.DeadlineReached: lambda _event, _now: None,
            ev.ClockCompared: self._on_clock,
            ev.ProfileSampled: self._on_sampled,
            ev.ProfileReceived: self._on_profile,
            ev.UtilityAsked: self._on_utility_asked,
            ev.UtilityReceived: self._on_utility,
            ev.ProposalReceived: self._on_proposal,
            ev.PrepareAsked: lambda event, now: self._agree(self.agreement.on_prepare(event, now), now),
            ev.AcceptAsked: lambda event, now: self._agree(self.agreement.on_accept(event, now), now),
            ev.ElectorAnswered: lambda event, now: self._agree(self.agreement.on_answer(event, now), now),
            ev.LearntReceived: self._on_learnt,
            ev.LearntAsked: self._on_learnt_asked,
            ev.PersistFailed: self._on_persist_failed,
            ev.BeatReceived: self._on_beat,
            ev.TokenSeen: self._on_token_seen,
            ev.TokenLost: self._on_token_lost,
            ev.WorkerChanged: self._on_worker,
            ev.WorkerTroubled: self._workers.on_troubled,
            ev.WorkerOutdated: self._workers.on_outdated,
            ev.WorkerJobs: self._on_jobs,
            ev.WorkerShown: self._on_worker_shown,
            ev.SlotReady: self._on_slot_ready,
            ev.SlotFlipped: self._on_slot_flipped,
            ev.SlotDrained: self._on_slot_drained,
            ev.RoleEnded: self._on_role_ended,
            ev.StreamsCounted: self._on_counted,
            ev.RelayChanged: self._on_relay,
            ev.StatusAsked: self._on_status,
            ev.WeightsCommanded: lambda event, now: self._agree(self.agreement.retune(event, now), now),
            ev.RetryCommanded: self._on_retry,
            ev.FrameDropped: self._on_dropped,
            ev.ProblemReported: self._on_problem,
            ev.StopRequested: self._on_stop,
        }


def _weights(weights: Weights) -> str:
    return f"cpu={weights.cpu:g} memory={weights.memory:g} network={weights.network:g}"
