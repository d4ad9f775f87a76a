"""The one door: `Node.handle` takes what happened and returns what to do; nothing else changes a node's state.

Knows: how the six stages follow each other, and the order of a batch (persist, then send, then apply). Does not know:
what each event means (the handlers beside it), clocks, random sources, sockets, files, processes; time and the
generator are passed in.

After the event is absorbed, `_advance` lets every stage act on the time that has passed, in the order in which the data
flows: PROFILE, GATEWAY, SCHEDULER, VOTE, EXECUTOR, ROUTE. Our own profile, utility and proposal enter by the same
methods as a peer's. What there is to do stands in one `ToDo`, which goes from stage to stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from zsched.core.node import beats, choice, documents, fleet, operators, orders, rehearsal, work
from zsched.core.node.stages import Handler, Stages
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import MoveOwner
from zsched.core.values.plan import WorkerRole
from zsched.core.values.todo import ToDo
from zsched.core.vote.joining import joined

_HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.DeadlineReached: lambda _node, _event, _todo, _now: None,
    **choice.HANDLERS,
    **work.HANDLERS,
    **beats.HANDLERS,
    **operators.HANDLERS,
    **documents.HANDLERS,
    **fleet.HANDLERS,
    **orders.HANDLERS,
    **rehearsal.HANDLERS,
}
_OFTEN_QUIET: Final = frozenset(
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
        ev.LinkRefused,
        ev.ClockCompared,
    }
)
_ASKED_OF_AN_ELECTOR: Final = (ev.PrepareAsked, ev.AcceptAsked, ev.BallotsAsked, ev.FleetAsked)


def in_parts(events: Sequence[ev.Event]) -> list[list[ev.Event]]:
    """Events that came together, in the parts that make a batch each: what is asked of this node as an elector is last.

    Such an answer waits for a write. What this node asks in the same batch would wait with it, while its deadline runs.
    Questions may come late: the network, too, keeps no order between those of one node and the beats of another.
    """
    parts: tuple[list[ev.Event], list[ev.Event]] = ([], [])
    for event in events:
        parts[isinstance(event, _ASKED_OF_AN_ELECTOR)].append(event)
    return [part for part in parts if part]


class Node(Stages):
    """One daemon's decision state, and its only door. It is made as `Stages` are."""

    # --- the door ----------------------------------------------------------------------------------------------------

    def start(self, now: float) -> tuple[do.Instruction, ...]:
        """The first batch: warm workers start, and what was learnt before the restart is carried out again."""
        todo = self._todo
        todo.must_persist = self.agreement.must_persist
        todo.add(*self.agreement.at_start.send)
        fleet.compare_file(self)
        documents.count_voters(self, todo)
        for name, executor in self.executors.items():
            executor.start(todo)
            value = self.registers[name].value
            if value.revision > 0:
                work.take_known(self, value, "known from before the restart", todo, now)
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

        After a stall many events wait. Whoever judged by the time after the first of them would take the senders of all
        other beats for silent, and a ballot for lost whose answers lie there. Events of any kind may be taken in so, in
        their order: a stage that hears a report remembers whether it has given the order before.
        """
        if now > self._promised:
            self._note_lag(now - self._promised, now)
        _HANDLERS[type(event)](self, event, self._todo, now)
        self._settle(now)

    def _note_lag(self, lag_s: float, now: float) -> None:
        self.loop_lag_s = max(self.loop_lag_s, lag_s)
        self.recent_lag.note(lag_s, now)
        self.membership.note_lag(lag_s)
        self.hangs.note_lag(lag_s, now)

    def _is_quiet(self, now: float) -> bool:
        """Whether the event left nothing but an answer before the deadline that was promised: nine in ten do.

        A later deadline is not worth computing then: waking up once too early costs less than thirty beats a second.
        """
        if now >= self._promised or self.beat_at < self._promised or now >= self.rounds.next_deadline():
            return False
        is_waiting = self.tenure.is_busy or self.unconfirmed or self.agreement.acceptor.has_parked
        return self._todo.is_only_sent and not is_waiting

    def _only_sent(self) -> tuple[do.Instruction, ...]:
        """The batch of an event that changed nothing here."""
        if not self._todo.send:
            return ()
        sent, self._todo.send = tuple(self._todo.send), []
        return sent

    def next_deadline(self) -> float:
        """When to call `handle` with `DeadlineReached` if nothing happens before (monotonic seconds)."""
        return self._promised

    def _finish(self, now: float) -> tuple[do.Instruction, ...]:
        self._advance(self._todo, now)
        # What our own beat has led to is the next batch's.
        todo, self._todo = self._todo, ToDo(must_beat=self._todo.must_beat, must_decide=self._todo.must_decide)
        if todo.stand_down is not None:
            todo.add(todo.stand_down)
        state = self.agreement.to_persist(now) if todo.must_persist else None
        first: tuple[do.Instruction, ...] = () if state is None else (do.PersistState(state=state),)
        # A limit that shrank may lie in the past already; that is no lag of this loop.
        self._promised = max(self._next_deadline(now), now)
        if todo.send:
            todo.send = joined(todo.send, self.agreement.unsettled)
        self.behind_write = tuple(todo.apply) if first else ()
        return (*first, *todo.send, *todo.apply)

    def _next_deadline(self, now: float) -> float:
        due = min(
            now if self._todo.must_beat else self.beat_at,
            self.membership.next_deadline(),
            self.rounds.next_deadline(),
            self.votes.next_deadline(),
            self.agreement.next_deadline(),
            self.expiry.next_deadline(),
            self.flags.next_deadline(),
            self.tenure.next_deadline(now),
        )
        for executor in self.executors.values():
            if (at := executor.next_deadline()) < due:
                due = at
        return due

    # --- the stages, in the data's order -----------------------------------------------------------------------------

    def _advance(self, todo: ToDo, now: float) -> None:
        """Let every stage act on the time that has passed."""
        self._tend_membership(todo, now)
        choice.publish_profile(self, todo, now)  # PROFILE, GATEWAY
        self._decide(todo, now)  # SCHEDULER
        self._agree(todo, now)  # VOTE
        self._settle(now)
        self._execute(todo, now)  # EXECUTOR, ROUTE
        beats.tend_pace(self, now)
        if todo.must_beat or now >= self.beat_at:
            beats.send_beat(self, todo, now)
            self._settle(now)

    def _tend_membership(self, todo: ToDo, now: float) -> None:
        for change in self.membership.tick(now):
            beats.on_transition(self, change, todo, now)

    def _decide(self, todo: ToDo, now: float) -> None:
        if todo.must_decide:
            self.rounds.hurry(now)
            todo.must_decide = False
        if not self.rounds.is_idle(now):
            values, states = self.values(), self.membership.states()
            for proposal in self.rounds.tick(values, states, todo, now):
                takes_turns = self.rounds.tasks[proposal.task].takes_turns
                self.votes.propose(proposal, values[proposal.task], states, todo, now, takes_turns=takes_turns)

    def _agree(self, todo: ToDo, now: float) -> None:
        if not self.votes.is_idle:
            self.votes.count(self.values(), self.membership.states(), todo, now)
        for task, change in self.votes.due_commits(now):
            if change.owner in self.flags.closed:  # since the vote
                self.votes.on_commit_ended(task)
            else:
                self.agreement.propose(task, change, todo, now)
        for task, retune in () if self.retuning.is_idle else self.retuning.due(self.values(), now):
            if not self.registers[task].is_busy:
                self.agreement.propose(task, retune, todo, now)
        if now >= self.expiry.next_deadline():
            for task, ending in self.expiry.due(self.values(), now):
                if not self.registers[task].is_busy:
                    self.agreement.propose(task, ending, todo, now)
        if now >= self.flags.next_deadline():
            self.agreement.orders.end_flags(self.flags.due(now), todo)
        if now >= self.agreement.next_deadline():
            self.agreement.tick(todo, now)

    def _execute(self, todo: ToDo, now: float) -> None:
        """Who may work here right now, and what each handover waits for."""
        if self.tenure.exclusive:
            self.tenure.tend_leases(self.beat_sequence, todo, now)
        # Also where no task is exclusive any more: the question may have come while one was.
        self.agreement.acceptor.retry_parked(todo, now)
        self.tenure.tend_isolation(self.membership, todo, now)
        if self.unconfirmed:
            work.take_up(self, todo, now)
        for executor in self.executors.values():
            if now >= executor.next_deadline():
                executor.tick(todo, now)
        if self.workers.has_unwatched:
            self.workers.let_go(self.busy())
        self._renew_workers(todo, now)

    def _renew_workers(self, todo: ToDo, now: float) -> None:
        """Start workers again that run by an old recipe, when it is their turn."""
        for name in self.renewals() if self.renewing.told else ():
            executor = self.executors[name]
            self.renewing.tend(
                executor.spec,
                self.registers[name].value,
                self.heard_candidates(executor.spec, now),
                todo,
                now,
                is_at_work=executor.role.role is not WorkerRole.IDLE,
                fleet_file=self.fleet_file,
            )

    def _settle(self, now: float) -> None:
        """What a stage has left for another one: calls to a vote, its end, changes that have ended, learnt values."""
        todo = self._todo
        if todo.is_settled:
            return
        for task, is_escape in todo.called:
            self.rounds.on_called(task, is_escape=is_escape, now=now)
        for task in todo.stayed:
            self.rounds.on_stayed(task)
        for change, outcome in todo.fleet_ended:
            self.agreement.orders.on_ended(change, outcome, todo)
        for ended in todo.ended:
            self.agreement.on_ended(ended, todo)
            if isinstance(ended.change, MoveOwner):
                self.votes.on_commit_ended(ended.task)
        learnt, fleet = todo.learnt, todo.in_force
        todo.called, todo.stayed, todo.ended, todo.learnt, todo.fleet_ended = [], [], [], [], []
        todo.in_force = None
        if fleet is not None:
            documents.take_effect(self, fleet, todo, now)
        if todo.must_tell:
            todo.must_tell = False
            if (word := self.agreement.word(now)) is not None:
                todo.must_beat = True
                todo.add(do.PublishLearnt(learnt=word))
        for value, reason in learnt:
            self.unconfirmed.pop(value.task, None)
            work.carry_out(self, value, reason, todo, now)
