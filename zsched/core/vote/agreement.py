"""VOTE, where the registers meet the node: one register per task, the durable state they share, and who is told.

Knows: which messages a register's step becomes, what an operator's change is, what goes to disk. Does not know: the
rules of a round (`zsched.core.vote.register`), what a learnt allocation leads to (the node applies it).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from random import Random

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import CommandOutcome, CommandResult, Learnt, Promise, Refusal, Refused
from zsched.core.values.model import (
    NO_BALLOT,
    Allocation,
    Ballot,
    Beat,
    DurableState,
    NodeId,
    RegisterState,
    TaskId,
    Weights,
)
from zsched.core.vote.belief import GENERATION_STEP, MAX_GENERATION, is_fit, is_proven
from zsched.core.vote.generations import way_out
from zsched.core.vote.lease import Leases, hold_s
from zsched.core.vote.register import Change, MoveOwner, Register, Retune, RoundOutcome, Step
from zsched.core.vote.witness import Witness, as_seen, as_tuple

SETTLE_AFTER_START_S = 0.3
"""A starting elector learns first what was accepted before (an identity round), once its peers are connected."""
ASK_LEARNT_EVERY_S = 0.3
ASK_AT_ONCE_S = 0.05
"""One peer is asked so often at most: because of its beats, and because it says that it has just learnt something."""
READ_EVERY_S = 2.0
"""A value that no single node's word is enough for is read from a majority so often at most."""
PREPARES_PER_S = 20.0
PREPARE_BURST = 40.0
"""What one peer may cost an elector: proposers back off to far less, only a broken one comes near."""
PARK_SHARE = 0.8
"""An accept that a lease forbids waits for the release so long (of a ballot's deadline) before it is refused."""

_RETUNED = {
    RoundOutcome.COMMITTED: (CommandOutcome.OK, "committed by a majority of the electors"),
    RoundOutcome.CONFLICT: (CommandOutcome.CONFLICT, "another change came first; look and try again"),
    RoundOutcome.UNCHANGED: (CommandOutcome.UNCHANGED, "these are the weights in force"),
    RoundOutcome.NO_QUORUM: (CommandOutcome.NO_QUORUM, "no majority of the electors answered"),
    RoundOutcome.UNKNOWN: (CommandOutcome.UNKNOWN, "the electors fell silent; `zsched status` tells"),
}


@dataclass(slots=True)
class Effects:
    """What one call leads to: ``is_dirty`` first to disk, then ``send``, then every ``learnt`` value is applied."""

    is_dirty: bool = False
    send: list[do.Instruction] = field(default_factory=list)
    learnt: list[tuple[Allocation, str]] = field(default_factory=list)
    """(value, why it came about)."""
    is_urgent: bool = False
    """Beat at once: an owner must hear that it is asked to leave."""
    ended: list[TaskId] = field(default_factory=list)
    """Tasks whose move, proposed by this node, was committed, overtaken or given up."""


NOTHING = Effects()
"""Most calls lead to nothing: one shared value, never changed."""


class Agreement:
    """All registers of one node.

    Args:
        fleet: the validated fleet file.
        me: this node's name.
        durable: what the state file holds; ``None``: this node is no elector.
        incarnation: this start's number, part of every ballot.
        electorate: hash of the electorate in force.
        rng: for back-off.
        now: monotonic seconds.
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
    ) -> None:
        self._fleet, self._me = fleet, me
        self._nodes = frozenset(node.name for node in fleet.nodes)
        self._durable = durable
        self.generation = None if durable is None else durable.generation
        """``None``: this node has no state, and has not been told yet which one the fleet is of."""
        self.newest_generation = self.generation or 0
        """That any beat has named: what the operator's next one must exceed."""
        self.apart: set[NodeId] = set()
        """Electors whose newest beat says that they are of another generation, or count with other electors (who may
        leave them out: then they are none by their own file)."""
        self._has_state, self._electorate = durable is not None, electorate
        self._disputed = "" if durable is None else durable.disputed
        self._lost = "" if durable is None else durable.lost
        self.witness = Witness(
            me=me,
            electors=fleet.electors,
            nodes=self._nodes,
            incarnation=incarnation,
            votes=0 if durable is None else durable.votes,
            started_at=now,
            seen={} if durable is None else as_seen(durable.seen),
        )
        self.voted = set() if durable is None else set(durable.voted)
        self.is_elector = durable is not None and me in fleet.electors and not self._disputed and not self._lost
        self.problems: dict[str, str] = {}
        if self._lost:
            self.problems["state"] = _lost_text(self._lost, self.newest_generation)
        if self._disputed:
            self.problems["state"] = f"{self._disputed}; no elector until `zsched init --settle`"
        self.counters: Counter[str] = Counter()
        self._buckets: dict[NodeId, tuple[float, float]] = {}
        stored = {} if durable is None else {state.task: state for state in durable.registers}
        # What blank electors have agreed on: a generation's first value, which the operator has written everywhere.
        start = (self.generation or 0) * GENERATION_STEP
        self.registers = {
            task.name: Register(
                me=me,
                incarnation=incarnation,
                electors=fleet.electors,
                electorate=self.electorate,
                is_elector=self.is_elector,
                initial=task.first_value(start),
                state=stored.get(task.name, RegisterState(task=task.name)),
                ballot_s=fleet.timing.ballot_s,
                stagger_s=fleet.timing.stagger_s,
                rng=rng,
            )
            for task in fleet.tasks
        }
        # A task that left the fleet file may come back: its promises must not be forgotten.
        self._foreign = tuple(stored[name] for name in sorted(stored) if name not in self.registers)
        self._settle_at = now + SETTLE_AFTER_START_S if self.is_elector else math.inf
        self._asked_at: dict[tuple[NodeId, bool], float] = {}
        """{(peer, whether for a newer revision): when}: a vote that was heard of delays nobody who is behind."""
        self._read_at: dict[TaskId, float] = {}
        self.leases = Leases(
            fleet=fleet,
            me=me,
            incarnation=incarnation,
            standing=self.standing() if self.is_elector else {},
            now=now,
            granted_s=0.0 if durable is None else durable.lease_s,
        )
        self._parked: dict[tuple[TaskId, NodeId], tuple[ev.AcceptAsked, float]] = {}
        self._seen: list[RegisterState] = []
        """The registers' states of which `values` and `accepted` are told."""
        self._values: dict[TaskId, Allocation] = {}
        self._accepted: dict[TaskId, tuple[NodeId, int]] = {}

    @property
    def electorate(self) -> str:
        """The electorate's hash; generations refuse each other's ballots."""
        return f"{self._electorate}/{self.generation}" if self.generation else self._electorate

    # --- queries -----------------------------------------------------------------------------------------------------

    def values(self) -> Mapping[TaskId, Allocation]:
        """{task: the newest learnt value}; a new mapping whenever one changes."""
        self._look()
        return self._values

    def _look(self) -> None:
        """See whether a register has changed: beats ask thirty times a second, and it hardly ever has."""
        states = [register.state for register in self.registers.values()]
        if states == self._seen:
            return
        self._seen = states
        self._values = {name: register.value for name, register in self.registers.items()}
        newest = {name: _newest(register) for name, register in self.registers.items()}
        self._accepted = {
            name: (value.owner, value.epoch)
            for name, value in newest.items()
            if value is not None and value.owner is not None and value.leased
        }

    def learnt(self) -> Learnt:
        """What this node tells others: learnt values only, never accepted ones."""
        values = tuple(value for value in self.values().values() if value.revision > 0)
        return Learnt(node=self._me, values=values, generation=self.generation or 0, has_voted=self.has_voted)

    def answer(self) -> Learnt:
        """What this node answers a peer: what it has learnt, and what it remembers of electors and of itself."""
        return replace(
            self.learnt(),
            incarnation=0 if self._durable is None else self.witness.incarnation,
            votes=0 if self._durable is None else self.witness.votes,  # what the disk refused was never voted
            seen=as_tuple(self.witness.seen),
            lease_terms=self.leases.terms,
        )

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        due = self._settle_at
        for register in self.registers.values():
            due = min(due, register.next_deadline())
        return min(due, *(deadline for _, deadline in self._parked.values())) if self._parked else due

    def accepted(self) -> Mapping[TaskId, tuple[NodeId, int]]:
        """{leased task: (owner, epoch)} that this elector echoes: of the newest value that it has accepted or learnt.

        Learnt counts too: what was committed without this elector would else never be echoed by it, and with another
        elector away no majority could be. An accepted value that is newer than what is learnt comes first, so nobody
        is echoed any more whom a newer acceptance replaces.
        """
        self._look()
        return self._accepted

    def standing(self) -> dict[TaskId, Allocation | None]:
        """{task: the newest value here}: an elector that does not know when it granted accepts its owner only."""
        return {name: _newest(register) for name, register in self.registers.items()}

    def to_persist(self, now: float) -> DurableState | None:
        """The state to write now, or ``None`` when this node keeps none."""
        if self._durable is None:
            return None
        states = tuple(self.registers[name].state for name in sorted(self.registers))
        self._durable = replace(
            self._durable,
            registers=(*states, *self._foreign),
            voted=tuple(sorted(self.voted)),
            disputed=self._disputed,
            lease_s=self.leases.to_remember_s(now),
            votes=self.witness.votes,
            seen=as_tuple(self.witness.seen),
            lost=self._lost,
        )
        return self._durable

    @property
    def must_persist(self) -> bool:
        """Whether the state file must say something before this node's first answer."""
        return self._durable is not None and self.leases.is_news(self._durable.lease_s)

    @property
    def has_voted(self) -> bool:
        """Whether this elector has ever promised anything (in any life that its state remembers)."""
        return any(register.state.promised != NO_BALLOT for register in self.registers.values())

    # --- electors ----------------------------------------------------------------------------------------------------

    def on_prepare(self, event: ev.PrepareAsked, now: float) -> Effects:
        """A proposer asks for a promise; only for its own ballots, and not too often (each promise costs an fsync)."""
        register = self.registers.get(event.prepare.task)
        if register is None or not self._is_its_own(event.prepare.ballot, event.asker):
            self.counters["prepare_foreign"] += 1
            return Effects()
        if not self._may_ask(event.asker, now):
            self.counters["prepare_rate"] += 1
            answer: Promise | Refused = register.refuse(event.prepare.ballot, Refusal.RATE)
            return Effects(send=[do.AnswerElection(request=event.request, answer=answer)])
        if self.is_elector and not self.witness.may_vote(now):
            answer = register.refuse(event.prepare.ballot, Refusal.YOUNG)
            return Effects(send=[do.AnswerElection(request=event.request, answer=answer)])
        step, answer = register.on_prepare(event.prepare)
        self.witness.votes += step.is_dirty
        return Effects(is_dirty=step.is_dirty, send=[do.AnswerElection(request=event.request, answer=answer)])

    def _may_ask(self, asker: NodeId, now: float) -> bool:
        """One token of the asker's bucket (`PREPARES_PER_S`, at most `PREPARE_BURST` saved); a no costs none."""
        tokens, at = self._buckets.get(asker, (PREPARE_BURST, now))
        tokens = min(tokens + (now - at) * PREPARES_PER_S, PREPARE_BURST)
        may_ask = tokens >= 1.0
        self._buckets[asker] = (tokens - may_ask, now)
        return may_ask

    def on_accept(self, event: ev.AcceptAsked, now: float) -> Effects:
        """A proposer asks to accept a value; only under its own ballots."""
        register = self.registers.get(event.accept.task)
        if register is None or not self._is_its_own(event.accept.acceptance.ballot, event.asker):
            self.counters["accept_foreign"] += 1
            return Effects()
        effects = Effects()
        if not is_fit(self._fleet, event.accept.acceptance.value, register):
            self.counters["accept_unfit"] += 1
            answer = register.refuse(event.accept.acceptance.ballot, Refusal.VALUE)
            return Effects(send=[do.AnswerElection(request=event.request, answer=answer)])
        if self.is_elector and not self.witness.may_vote(now):
            answer = register.refuse(event.accept.acceptance.ballot, Refusal.YOUNG)
            return Effects(send=[do.AnswerElection(request=event.request, answer=answer)])
        self._accept_or_park(event, now + PARK_SHARE * self._fleet.timing.ballot_s, effects, now)
        return effects

    def _accept_or_park(self, event: ev.AcceptAsked, deadline: float, effects: Effects, now: float) -> None:
        """Accept, refuse, or let the question wait while an exclusive task's owner is asked to leave."""
        accept = event.accept
        register = self.registers[accept.task]
        key = (accept.task, event.asker)
        older = self._parked.pop(key, None)
        if older is not None and older[0] != event:
            effects.send.append(do.AnswerElection(request=older[0].request, answer=self._leased(older[0])))
        is_free = not register.would_accept(accept) or self.leases.may_accept(
            accept.task, accept.acceptance.value.owner, now
        )
        if is_free:
            known = _newest(register)
            step, answer = register.on_accept(accept, now)
            if step.is_dirty and (known is None or accept.acceptance.value.revision > known.revision):
                # An identity round's is none: the next owner may still wait.
                self.leases.on_newer_value(accept.acceptance.value)
            effects.is_dirty |= step.is_dirty
            self.witness.votes += step.is_dirty
            effects.send.append(do.AnswerElection(request=event.request, answer=answer))
        elif now >= deadline:
            effects.send.append(do.AnswerElection(request=event.request, answer=self._leased(event)))
        else:
            self._parked[key] = (event, deadline)
            effects.is_urgent = older is None

    def _leased(self, event: ev.AcceptAsked) -> Refused:
        register = self.registers[event.accept.task]
        return register.refuse(event.accept.acceptance.ballot, Refusal.LEASE)

    @property
    def has_parked(self) -> bool:
        """Whether a question waits for an exclusive task's owner to leave."""
        return bool(self._parked)

    def retry_parked(self, now: float) -> Effects:
        """A lease may have been released or run out, or a parked question may have waited long enough."""
        if not self._parked:
            return NOTHING
        effects = Effects()
        for event, deadline in tuple(self._parked.values()):
            self._accept_or_park(event, deadline, effects, now)
        return effects

    def on_answer(self, event: ev.ElectorAnswered, now: float) -> Effects:
        """An elector answered our prepare or accept."""
        effects = Effects()
        register = self.registers.get(event.answer.task)
        if register is None or event.answer.elector not in self._fleet.electors:
            self.counters["answer_foreign"] += 1
        else:
            self._take(event.answer.task, register.on_answer(event.answer, now), effects)
        return effects

    def _is_its_own(self, ballot: Ballot, asker: NodeId) -> bool:
        return ballot.node == asker and asker in self._nodes

    def note_asked(self, beat: Beat, now: float) -> None:
        """An elector (maybe this one) asks owners to leave: somebody's accept waits for that."""
        if beat.node not in self._fleet.electors:
            return
        for task, _, epoch in beat.asked_to_leave:
            register = self.registers.get(task)
            if register is not None and epoch == register.value.epoch:
                register.expect_release(now, now + hold_s(self._fleet.timing.lease_s))

    # --- learners ----------------------------------------------------------------------------------------------------

    def on_learnt(self, event: ev.LearntReceived, now: float) -> Effects:
        """A peer told what it has learnt: unasked, that is a reason to ask it; its answer may be believed."""
        learnt = event.learnt
        if learnt.node == self._me:
            return NOTHING
        if learnt.node not in self._nodes:
            self.counters["learnt_foreign"] += 1
            return NOTHING
        if event.is_answer:
            self._follow(learnt)
        if not self._is_our_generation(learnt.node, learnt.generation):
            return NOTHING
        if not event.is_answer:
            newer = [(value.task, value.revision) for value in learnt.values]
            return self._ask(learnt.node, newer, ASK_AT_ONCE_S, now)
        effects = self._lose(self.witness.on_answer(learnt))
        if learnt.has_voted and learnt.node in self._fleet.electors and learnt.node not in self.voted:
            self.voted.add(learnt.node)
            effects.is_dirty |= self._durable is not None
        for value in learnt.values:
            register = self.registers.get(value.task)
            if register is None:
                self.counters["learnt_foreign"] += 1
            elif is_proven(self._fleet, learnt, value, register, has_generation=self.generation is not None):
                step = register.learn(value, now)
                if step.learnt is not None:
                    self.leases.on_newer_value(value)
                self._take(value.task, step, effects)
            elif value.revision > register.value.revision:
                self._read(value.task, register, effects, now)
        return effects

    def _read(self, task: TaskId, register: Register, effects: Effects, now: float) -> None:
        """Ask a majority what is in force (an identity round), for one peer's word is not enough."""
        self.counters["learnt_unproven"] += 1
        if now - self._read_at.get(task, -math.inf) >= READ_EVERY_S:
            self._read_at[task] = now
            self._take(task, register.settle(now), effects)

    def _hear_electorate(self, beat: Beat) -> None:
        """Keep whether an elector refuses our ballots, and we its: it has other electors, or another generation."""
        is_apart = beat.generation != self.generation or beat.electorate not in ("", self.electorate)
        is_apart |= self._is_no_elector_there(beat)
        if is_apart and not self._is_guest_of(beat.generation) and beat.node in self._fleet.electors:
            self.apart.add(beat.node)
        elif self.apart:
            self.apart.discard(beat.node)

    def _is_no_elector_there(self, beat: Beat) -> bool:
        """Whether a node that this file has as an elector counts with others, and does not have itself among them.

        It tells no electorate then, and no lost state either: who has lost one is an elector by its own file. The terms
        tell such a node from one that is too old to tell its electorate.
        """
        terms = beat.lease_terms.partition(",")[0]  # behind it a clock is in doubt
        return not beat.electorate and not beat.has_lost_state and terms not in ("", self.leases.terms)

    def _is_our_generation(self, node: NodeId, generation: int) -> bool:
        """Whether a node's learnt values mean anything here; the difference is shown."""
        is_ours = generation == self.generation or self._is_guest_of(generation)
        if is_ours and not self.problems:
            return True  # thirty beats a second come by here
        source = f"generation/{node}"
        if is_ours:
            self.problems.pop(source, None)
            return True
        ours = self.generation or 0
        command = f"`zsched init --generation {max(generation, ours)}`"
        where = f"there, with that daemon stopped: {command}"
        if generation > ours:
            where = f"stop this daemon, {command} here, start it; so on every node that is behind"
        self.problems[source] = f"{node} is of generation {generation}, this node of {ours}; {where}"
        return False

    def _is_guest_of(self, generation: int) -> bool:
        """Whether this node, without a state, goes by what a newer generation says."""
        return not self._has_state and (self.generation is None or generation > self.generation)

    def _follow(self, learnt: Learnt) -> None:
        """An elector that keeps a state has answered: without one this node is of the newest generation it hears of."""
        is_elector = learnt.node in self._fleet.electors and (learnt.incarnation > 0 or learnt.has_voted)
        if not is_elector or learnt.generation > MAX_GENERATION or not self._is_guest_of(learnt.generation):
            return
        self.generation = learnt.generation
        self.witness.seen.clear()  # of another generation's states
        self.voted.clear()
        for task in self._fleet.tasks:
            initial = task.first_value(learnt.generation * GENERATION_STEP)
            self.registers[task.name].follow(self.electorate, initial)

    def dispute(self, reason: str) -> Effects:
        """Our name is used by somebody else too: no elector any more, on disk, until the operator settles it."""
        if self._disputed:
            return Effects()
        self._disputed = reason
        self.problems["state"] = f"{reason}; no elector until `zsched init --settle`"
        self._stop_electing()
        return Effects(is_dirty=self._durable is not None)

    def _lose(self, why: str) -> Effects:
        """Our state has forgotten what others have seen of it: no elector any more, on disk."""
        if not why or self._lost or not self.is_elector:
            return Effects()
        self._lost = why
        self.problems["state"] = _lost_text(why, self.newest_generation)
        self._stop_electing()
        return Effects(is_dirty=True)

    def compare(self, beat: Beat, now: float) -> Effects:
        """A peer's beat may show that it has learnt more than we, or has voted: then ask it."""
        self.newest_generation = max(self.newest_generation, min(beat.generation, MAX_GENERATION))
        self._hear_electorate(beat)
        if not self._is_our_generation(beat.node, beat.generation):
            return NOTHING
        is_news = beat.has_voted and beat.node not in self.voted and beat.node in self._fleet.electors
        is_news |= self.witness.must_ask(beat)
        is_news |= self._is_guest_of(beat.generation) and beat.node in self._fleet.electors
        newer = [(task, revision) for task, revision, _ in beat.learnt]
        return self._ask(beat.node, newer, ASK_LEARNT_EVERY_S, now, is_news=is_news)

    def _ask(
        self, peer: NodeId, told: list[tuple[TaskId, int]], every_s: float, now: float, *, is_news: bool = False
    ) -> Effects:
        """Ask a peer for what it has learnt, when it tells of a newer revision (or of other news)."""
        is_behind = False
        for task, revision in told:
            register = self.registers.get(task)
            is_behind |= register is not None and revision > register.value.revision
        if not is_behind and not is_news:
            return NOTHING
        if now - self._asked_at.get((peer, is_behind), -math.inf) < every_s:
            return NOTHING
        self._asked_at[peer, is_behind] = now
        return Effects(send=[do.AskLearnt(peer=peer, deadline_s=self._fleet.timing.ballot_s)])

    # --- proposers ---------------------------------------------------------------------------------------------------

    def propose(self, task: TaskId, change: Change, now: float) -> Effects:
        """Try to commit a change."""
        effects = Effects()
        if self.generation is None:  # nobody would answer, for every ballot names the generation
            self._end(task, change, RoundOutcome.NO_QUORUM, effects)
            return effects
        self._take(task, self.registers[task].propose(change, now), effects)
        return effects

    def retune(self, event: ev.WeightsCommanded, now: float) -> Effects:
        """An operator changes a task's weights; the answer comes when the change has ended."""
        command = event.command
        register = self.registers.get(command.task)
        if register is None:
            known = ", ".join(sorted(self.registers))
            return _refusal(event.request, CommandOutcome.INVALID, f"no task {command.task!r}; tasks: {known}")
        try:
            weights = Weights(cpu=command.cpu, memory=command.memory, network=command.network)
        except ValueError as error:
            return _refusal(event.request, CommandOutcome.INVALID, str(error))
        value = register.value
        if command.base_revision not in (None, value.revision):
            detail = f"revision is {value.revision}, not {command.base_revision}"
            return _refusal(event.request, CommandOutcome.CONFLICT, detail)
        if weights == value.tuning.weights:
            return _refusal(event.request, CommandOutcome.UNCHANGED, "these are the weights in force")
        change = Retune(
            base_revision=value.revision, tuning=replace(value.tuning, weights=weights), request=event.request
        )
        return self.propose(command.task, change, now)

    def tick(self, now: float) -> Effects:
        """Time has passed."""
        effects = Effects()
        for name, register in self.registers.items():
            if now >= self._settle_at:
                self._take(name, register.settle(now), effects)
            if now >= register.next_deadline():
                self._take(name, register.tick(now), effects)
        if now >= self._settle_at:
            self._settle_at = math.inf
        return effects

    def on_persist_failed(self, reason: str) -> None:
        """The disk refused: no elector any more, and nothing is written any more."""
        self.problems["state"] = f"{reason}; this node is no elector until it is restarted"
        self._durable = None
        self._stop_electing()

    def _stop_electing(self) -> None:
        self.is_elector = False
        self.leases.stop_granting()
        for register in self.registers.values():
            register.stop_electing()

    # --- steps -------------------------------------------------------------------------------------------------------

    def _take(self, task: TaskId, step: Step, effects: Effects) -> None:
        effects.is_dirty |= step.is_dirty
        if step.problem:
            self.problems[f"register/{task}"] = step.problem
        elif step.learnt is not None:
            self.problems.pop(f"register/{task}", None)  # agreement goes on
        deadline_s = self._fleet.timing.ballot_s
        if step.prepare is not None:
            effects.send.append(do.SendPrepare(prepare=step.prepare, deadline_s=deadline_s))
        if step.accept is not None:
            effects.send.append(do.SendAccept(accept=step.accept, deadline_s=deadline_s))
        reason = "learnt from a peer"
        if step.finished is not None:
            reason = self._end(task, *step.finished, effects) or reason
        if step.learnt is not None:
            effects.learnt.append((step.learnt, reason))

    def _end(self, task: TaskId, change: Change, outcome: RoundOutcome, effects: Effects) -> str:
        """A change that this node proposed has ended; why the value is what it is, if it was committed."""
        value = self.registers[task].value
        reason = ""
        if outcome is RoundOutcome.COMMITTED:
            reason = _why(change)
            effects.send.append(do.PublishLearnt(learnt=self.learnt()))
        if isinstance(change, MoveOwner):
            effects.ended.append(task)
            text = f"move to {change.owner} on revision {change.base_revision}: {outcome}"
            effects.send.append(do.RecordStory(stage="vote", text=text, task=task, epoch=value.epoch))
        elif isinstance(change, Retune) and change.request is not None:
            kind, detail = _RETUNED[outcome]
            result = CommandResult(outcome=kind, detail=f"{task}: {detail}", revision=value.revision)
            effects.send.append(do.AnswerCommand(request=change.request, result=result))
        return reason


def _refusal(request: int, outcome: CommandOutcome, detail: str) -> Effects:
    result = CommandResult(outcome=outcome, detail=detail)
    return Effects(send=[do.AnswerCommand(request=request, result=result)])


def _newest(register: Register) -> Allocation | None:
    """The value of the higher revision among accepted and learnt; the learnt one when they are of the same."""
    accepted, learnt = register.state.accepted, register.state.learnt
    if accepted is None:
        return learnt
    return accepted.value if learnt is None or accepted.value.revision > learnt.revision else learnt


def _lost_text(why: str, newest_generation: int) -> str:
    return (
        f"{why}: it was brought back from a backup, or its disk has lost what it said was written; "
        f"no elector until a new generation ({way_out(newest_generation + 1)})"
    )


def _why(change: Change) -> str:
    if isinstance(change, MoveOwner):
        return change.reason
    if isinstance(change, Retune):
        return "retuned by an operator"
    return "nobody works without a lease any more" if change.leased else "not exclusive any more"
