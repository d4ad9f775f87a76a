"""VOTE, the agreement under it: one rewritable value, agreed by a majority of electors (CASPaxos).

Knows: ballots, promises, acceptances, rounds, what is learnt. Does not know: what the value means (a subclass tells the
few things that a round needs of it), who won which vote, how anything travels or is stored.

Synod on a register that can be rewritten (Rystsov, arXiv 1802.07000): no leader, no log. The rules that keep it safe:

* an elector's promise and acceptance are persisted before the answer leaves (`ToDo.must_persist`); the same question
  again is the same answer, without a write, so a proposer that waits asks it again and keeps its ballot;
* a ballot carries exactly one value: a proposer that reads an accepted value it has not learnt re-accepts that one, and
  its own change follows under a higher ballot;
* where too many electors refuse that value for good (their fleet files know no such node), a change that its register
  lets replace it is applied to it at once, as CASPaxos has it: else a value that a minority has accepted would stand in
  the way for ever;
* among accepted values "newer" means the higher ballot;
* accepted is not learnt: an elector with an acceptance that it has not learnt runs an *identity round* (it re-accepts
  what it reads), and so does a proposer that does not know how its round ended; it never applies its change twice;
* every change names the revision that it is based on and is a function of the value read; one that changes nothing
  writes nothing.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import StrEnum
from random import Random
from typing import Generic

from zsched.core.values.change import Rewrite, RoundOutcome
from zsched.core.values.electorate import Electorate, electorate_of
from zsched.core.values.fleet import Timing
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import Acceptance, Ballot, NodeId, RegisterState, V
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, field, replace
from zsched.core.values.todo import ToDo
from zsched.core.values.words import shown

BACKOFF_CAP_S = 5.0
MAX_REVISION = 2**52  # half of what a counter may be: a value so far ahead is refused, for nothing could follow it
MAX_JUMP = 2**32  # no honest counter is so far ahead; one hostile frame must not use them all up
ROUND_BALLOTS = 6
SETTLE_BALLOTS = 3
"""A change is given up so many times ``ballot_s`` after it began."""
MAX_QUEUED = 16
"""Changes that may wait for the round under way; one more ends as a conflict, for those before it come first."""


class _Phase(StrEnum):
    WAIT = "wait"
    PREPARE = "prepare"
    ACCEPT = "accept"
    HELD = "held"  # a majority has promised, and the change is still to come


class _Round(Struct, Generic[V]):
    """One proposer's attempts at one change (or, without a change, an identity round)."""

    change: Rewrite[V] | None
    since: float
    """When it began (monotonic seconds); later by what this loop stood still."""
    ballots: float
    """It is given up after so many of a ballot's deadlines."""
    phase: _Phase = _Phase.WAIT
    deadline: float = 0.0
    ballot: Ballot | None = None
    known: int = 0  # the revision that was learnt when the prepare left
    promises: dict[NodeId, Acceptance[V] | None] = field(default_factory=dict)
    yes: dict[NodeId, bool] = field(default_factory=dict)
    no: dict[NodeId, Refusal] = field(default_factory=dict)
    value: V | None = None
    sent: V | None = None
    """Our own new value once an accept for it left: from then on the outcome may be unknown."""
    unfit: V | None = None
    """Another node's value that no majority will accept, since too many electors take it for false."""
    attempt: int = 0
    is_alone: bool = False
    """Its questions go in frames of their own: the first try, maybe in a frame with others, had no success."""
    is_ahead: bool = False
    """Only its promises are wanted yet: the change that follows takes this ballot."""


class Register(ABC, Generic[V]):
    """One register on one node: acceptor (if it is an elector), proposer and learner."""

    def __init__(
        self,
        *,
        me: NodeId,
        incarnation: int,
        electors: tuple[NodeId, ...],
        electorate: str,
        is_elector: bool,
        initial: V,
        state: RegisterState[V],
        clocks: Callable[[], Timing],
        rng: Random,
        disk: str = "",
    ) -> None:
        self._me, self._incarnation, self._disk = me, incarnation, disk
        self._count, self._electorate = electorate_of(electors), electorate
        self._is_elector = is_elector
        self._initial = initial
        self._clocks, self._rng = clocks, rng
        self.state = state
        self.problem = ""
        """Why agreement stands still; the next learnt value ends it."""
        self.written_under: Electorate | None = None
        """With whom this node last saw a majority accept the newest value, or found the register blank."""
        self._counter = state.promised.counter
        self._round: _Round[V] | None = None
        self._queue: list[Rewrite[V]] = []
        self._settle_at = math.inf
        self._settle_tries = 0
        self._lease_over_at = -math.inf
        """An accept waits for the owner to leave: when its lease must be over."""

    @property
    def value(self) -> V:
        """The newest learnt value (revision 0 before anything was agreed)."""
        return self.state.learnt or self._initial

    @property
    def is_busy(self) -> bool:
        """Whether a change of this node's is under way."""
        return bool(self._queue) or (self._round is not None and self._round.change is not None)

    def next_deadline(self) -> float:
        """When `tick` may have something to do; infinity when never."""
        return self._settle_at if self._round is None else self._round.deadline

    def stop_electing(self) -> None:
        """This node lost its right to be an elector (disk, duplicate name) and answers no more."""
        self._is_elector = False

    def follow(self, electorate: str, initial: V, creation: int) -> None:
        """A node without a state has heard the fleet's generation: continue with its first value and counters."""
        self._electorate, self._initial = electorate, initial
        self.state = replace(self.state, creation=creation)
        learnt = self.state.learnt
        if learnt is not None and learnt.revision < initial.revision:
            self.state = RegisterState(
                task=self.state.task, creation=self.state.creation
            )  # it never promised anything, and this was another fleet's

    def begin_with(self, initial: V) -> None:
        """Another fleet is in force; its first value holds while nothing was learnt."""
        self._initial = initial

    @property
    def _ballot_s(self) -> float:
        """Deadline of one phase, by the clocks in force."""
        return self._clocks().ballot_s

    def _gives_up_at(self, running: _Round[V]) -> float:
        return running.since + running.ballots * self._ballot_s

    def count_with(self, count: Electorate, *, is_elector: bool, is_blank: bool, now: float) -> None:
        """A newer fleet value is learnt: rounds count with its electors, and the one under way begins again.

        Args:
            count: number and electors of that value.
            is_elector: this node has a seat there.
            is_blank: what this node has accepted belongs to a seat that it no longer has.
            now: monotonic seconds.
        """
        self._count, self._is_elector = count, is_elector
        if is_blank:
            self.state = replace(self.state, accepted=None)
            self._settle_at = math.inf
        running = self._round
        if running is not None and running.is_ahead:
            self._round = None  # whoever wanted it asks under the new number again, if at all
        elif running is not None:
            running.phase, running.deadline, running.ballot = _Phase.WAIT, now, None

    def close(self, todo: ToDo) -> None:
        """The register is removed: changes under way end."""
        running, queue = self._round, self._queue
        self._round, self._queue, self._settle_at = None, [], math.inf
        if running is not None and running.change is not None:
            is_sent = running.sent is not None
            self._end(running.change, RoundOutcome.UNKNOWN if is_sent else RoundOutcome.NO_QUORUM, todo)
        for change in queue:
            self._end(change, RoundOutcome.NO_QUORUM, todo)

    # --- what a round must know of the value -------------------------------------------------------------------

    @abstractmethod
    def _highest(self, value: V) -> int:
        """The highest counter in ``value``."""

    @abstractmethod
    def _prevails(self, value: V) -> bool:
        """Whether ``value`` counts more than another first value, which no ballot has brought."""

    @abstractmethod
    def _replaces(self, change: Rewrite[V]) -> bool:
        """Whether ``change`` may be applied to a value that no majority of electors takes."""

    def _may_carry(self, value: V) -> bool:
        """Whether this node has all that belongs to ``value``, so that it may ask others to accept it."""
        del value
        return True

    @abstractmethod
    def _named(self, value: V) -> str:
        """``value`` in a word, for a problem."""

    @abstractmethod
    def _ask(self, question: Prepare | Accept[V], todo: ToDo) -> None:
        """Send a question to every elector; answers are late after ``ballot_s``."""

    @abstractmethod
    def _hand_on(self, value: V, why: str | None, todo: ToDo) -> None:
        """A newer value is learnt; ``why``: of our own change, ``None``: of another node's."""

    @abstractmethod
    def _end(self, change: Rewrite[V], outcome: RoundOutcome, todo: ToDo) -> None:
        """A change of this node's has ended."""

    # --- acceptor ----------------------------------------------------------------------------------------------

    def on_prepare(self, prepare: Prepare, todo: ToDo) -> Promise[V] | Refused:
        """Phase 1b. A promise must not leave before it is on disk."""
        refusal = self._refusal(prepare, prepare.ballot)
        if refusal is None and prepare.ballot < self.state.promised:
            refusal = Refusal.BALLOT
        if refusal is not None:
            return self._no(prepare.ballot, refusal)
        if prepare.ballot != self.state.promised:  # else it is asked again, and the promise is on disk already
            self._set_state(promised=prepare.ballot)
            todo.must_persist = True
        return Promise(
            elector=self._me,
            task=self.state.task,
            ballot=prepare.ballot,
            accepted=self.state.accepted,
            disk=self._disk,
            joining=self._joining,
        )

    def would_accept(self, accept: Accept[V]) -> bool:
        """Whether `on_accept` would say yes now."""
        ballot = accept.acceptance.ballot
        return self._refusal(accept, ballot) is None and ballot >= self.state.promised

    def refuse(self, ballot: Ballot, refusal: Refusal) -> Refused:
        """A no for a reason outside the register (an exclusive task's lease)."""
        return self._no(ballot, refusal)

    def on_accept(self, accept: Accept[V], todo: ToDo, now: float) -> Accepted | Refused:
        """Phase 2b. A yes must not leave before it is on disk."""
        ballot = accept.acceptance.ballot
        refusal = self._refusal(accept, ballot)
        value = accept.acceptance.value
        if refusal is None and (ballot < self.state.promised or self._highest(value) > MAX_REVISION):
            refusal = Refusal.BALLOT
        if refusal is not None:
            return self._no(ballot, refusal)
        if accept.acceptance != self.state.accepted:  # else it is asked again, and on disk already
            self._set_state(promised=ballot, accepted=accept.acceptance)
            todo.must_persist = True
        if self._is_unlearnt():
            self._settle_tries = 0
            self._settle_at = now + 2 * self._ballot_s + self._jitter(0)
        return Accepted(elector=self._me, task=self.state.task, ballot=ballot, disk=self._disk, joining=self._joining)

    @property
    def _id(self) -> str:
        """The disk's id for ballots; a fleet file names no disks, and who goes by one compares ballots without."""
        return "" if self._count.is_founding else self._disk

    @property
    def _joining(self) -> int:
        seat = self._count.seat(self._me)
        return 0 if seat is None else seat.joining

    def _refusal(self, question: Prepare | Accept[V], ballot: Ballot) -> Refusal | None:
        if not self._is_elector:
            return Refusal.NOT_ELECTOR
        if self._count.is_founding and question.electorate != self._electorate:
            return Refusal.ELECTORATE
        count = question.generation_id, question.number, question.creation
        is_by_file = count == ("", 0, 0)  # of a node that knows no fleet values; then the electorate tells all
        is_same = count == (self._count.generation_id, self._count.number, self.state.creation)
        if not is_same and not (is_by_file and self._count.is_founding):
            return Refusal.NUMBER
        return Refusal.BALLOT if ballot.counter > self.state.promised.counter + MAX_JUMP else None

    def _no(self, ballot: Ballot, refusal: Refusal) -> Refused:
        return Refused(
            elector=self._me,
            task=self.state.task,
            ballot=ballot,
            refusal=refusal,
            promised=self.state.promised,
            number=self._count.number,
        )

    @property
    def is_unlearnt(self) -> bool:
        """Whether this node has accepted a value that is newer than what it has learnt."""
        return self._is_unlearnt()

    def _is_unlearnt(self) -> bool:
        accepted = self.state.accepted
        return accepted is not None and accepted.value.revision > self.value.revision

    def _set_state(
        self, *, promised: Ballot | None = None, accepted: Acceptance[V] | None = None, learnt: V | None = None
    ) -> None:
        self.state = RegisterState(
            task=self.state.task,
            creation=self.state.creation,
            promised=promised or self.state.promised,
            accepted=accepted or self.state.accepted,
            learnt=learnt or self.state.learnt,
        )

    # --- learner -----------------------------------------------------------------------------------------------

    def learn(self, value: V, todo: ToDo, now: float) -> None:
        """A committed value is known; older ones change nothing, nor do those of an earlier creation."""
        if self._highest(value) > MAX_REVISION:
            self.problem = f"revision {value.revision} cannot be"
            return
        current = self.state.learnt
        if value.revision < self._initial.revision:
            return
        if current is not None and value.revision <= current.revision:
            if value.revision == current.revision and value != current:
                both = f"{self._named(current)} and {self._named(value)}"
                self.problem = f"two values for revision {shown(value.revision)}: {both}"
            return
        self._set_state(learnt=value)
        self._lease_over_at = -math.inf
        self.problem = ""  # agreement goes on
        if not self._is_unlearnt():
            self._settle_at = math.inf
        outcome = self._outcome_by(value)
        todo.must_persist = True
        self._hand_on(value, self._why(outcome), todo)
        if outcome is not None:
            self._finish(todo, outcome, now)

    def _why(self, outcome: RoundOutcome | None) -> str | None:
        """Why a learnt value came about, if by our own change; ``None``: by another node's."""
        change = None if self._round is None else self._round.change
        return None if change is None or outcome is not RoundOutcome.COMMITTED else change.reason

    def _outcome_by(self, value: V) -> RoundOutcome | None:
        """The end of our change under way, given the learnt ``value``; ``None``: it goes on."""
        running = self._round
        if running is None or running.change is None:
            return None
        if running.sent is None:
            return RoundOutcome.CONFLICT if value.revision > running.change.base_revision else None
        if value.revision == running.sent.revision:
            return RoundOutcome.COMMITTED if value == running.sent else RoundOutcome.CONFLICT
        return RoundOutcome.UNKNOWN if value.revision > running.sent.revision else None  # ours may lie under it

    # --- proposer ----------------------------------------------------------------------------------------------

    def expect_release(self, now: float, at_most: float) -> None:
        """An accept waits for an exclusive task's owner to leave; its lease ends at ``at_most``."""
        if now >= self._lease_over_at:
            self._lease_over_at = at_most

    @property
    def wanted(self) -> tuple[Rewrite[V], ...]:
        """The changes that are under way here or wait, in their order."""
        running = None if self._round is None else self._round.change
        return tuple(self._queue) if running is None else (running, *self._queue)

    def propose(self, change: Rewrite[V], todo: ToDo, now: float) -> None:
        """Try to commit a change; its end appears in `ToDo.ended`, of this or a later call."""
        if len(self._queue) >= MAX_QUEUED:
            self._end(change, RoundOutcome.CONFLICT, todo)
            return
        self._queue.append(change)
        if self._round is not None and self._round.is_ahead:
            self._round = None  # those promises are for another change
        if self._round is None:
            self._start_next(todo, now)

    def propose_prepared(self, change: Rewrite[V], todo: ToDo, now: float) -> None:
        """Try to commit the change for which promises were asked ahead, if they are still wanted."""
        running = self._round
        if running is None or not running.is_ahead:
            self.propose(change, todo, now)
            return
        running.change, running.is_ahead = change, False
        running.since, running.ballots = now, ROUND_BALLOTS
        if self._outcome_by(self.value) is not None:
            self._finish(todo, RoundOutcome.CONFLICT, now)
        elif running.phase is _Phase.HELD:
            self._read(running, todo, now)

    def prepare_ahead(self, todo: ToDo, now: float) -> None:
        """Ask for promises for a change that is to follow soon, unless a round is under way.

        A ballot that a majority has promised, and with which nothing was asked yet, stays as good as any. When another
        one has overtaken it, the change is refused, and its end may be unknown: who wants it looks, and tries again.
        """
        if self._round is None:
            self._round = _Round(change=None, since=now, ballots=ROUND_BALLOTS, is_ahead=True)
            self._prepare(todo, now)

    def settle(self, todo: ToDo, now: float) -> None:
        """Run an identity round, unless a round is under way: learn the earlier acceptances."""
        if self._round is None:
            self._round = _Round(change=None, since=now, ballots=SETTLE_BALLOTS)
            if self._is_unlearnt() and self._settle_at == math.inf:
                self._settle_at = now + 2 * self._ballot_s  # after a restart nobody else asks again
            self._prepare(todo, now)

    def _start_next(self, todo: ToDo, now: float) -> None:
        """Begin with the next change that is not outdated; those before it end."""
        while self._queue and self._round is None:
            change = self._queue.pop(0)
            self._round = _Round(change=change, since=now, ballots=ROUND_BALLOTS)
            if self._outcome_by(self.value) is None:
                self._prepare(todo, now)
            else:
                self._end(change, RoundOutcome.CONFLICT, todo)
                self._round = None

    def _prepare(self, todo: ToDo, now: float) -> None:
        running = self._running()
        self._counter = max(self._counter, self.state.promised.counter) + 1
        ballot = Ballot(counter=self._counter, node=self._me, incarnation=self._incarnation, disk=self._id)
        running.promises, running.yes, running.value, running.ballot = {}, {}, None, ballot
        running.known = self.value.revision
        self._ask_promises(running, ballot, todo, now)

    def _ask_promises(self, running: _Round[V], ballot: Ballot, todo: ToDo, now: float) -> None:
        running.phase, running.deadline, running.no = _Phase.PREPARE, now + self._ballot_s, {}
        prepare = Prepare(
            task=self.state.task,
            ballot=ballot,
            electorate=self._electorate,
            creation=self.state.creation,
            generation_id=self._count.generation_id,
            number=self._count.number,
        )
        self._ask(prepare, todo)

    @property
    def _may_join(self) -> bool:
        """Whether a question of the round under way may travel with others: it reads, and nobody waits for it yet."""
        running = self._running()
        return running.change is None and not running.is_alone

    def _running(self) -> _Round[V]:
        assert self._round is not None
        return self._round

    def is_possible(self, answer: Promise[V] | Accepted | Refused) -> bool:
        """Whether an elector can have accepted what its promise tells: a value of this register, not too far ahead.

        No elector accepts another one, so such a promise is forged: no change and no question could be made of it.
        """
        held = answer.accepted if isinstance(answer, Promise) else None
        return held is None or (held.value.task == self.state.task and self._highest(held.value) <= MAX_REVISION)

    def on_answer(self, answer: Promise[V] | Accepted | Refused, todo: ToDo, now: float) -> None:
        """An elector answered; answers to older ballots, from strangers, and impossible ones change nothing."""
        running = self._round
        if running is None or answer.ballot != running.ballot or answer.elector not in self._count.names:
            return
        if not self.is_possible(answer):
            return
        if isinstance(answer, Refused):
            self._on_refused(running, answer, todo, now)
        elif not self._is_of_seat(answer):
            return
        elif isinstance(answer, Promise) and running.phase is _Phase.PREPARE:
            running.promises[answer.elector] = answer.accepted
            if len(running.promises) >= majority(len(self._count.electors)):
                self._read(running, todo, now)
        elif isinstance(answer, Accepted) and running.phase is _Phase.ACCEPT:
            running.yes[answer.elector] = True
            if len(running.yes) >= majority(len(self._count.electors)):
                self._commit(running, todo, now)

    def _is_of_seat(self, answer: Promise[V] | Accepted) -> bool:
        """Whether a yes is that of the seat with which this round counts, and not of another disk or joining."""
        seat = self._count.seat(answer.elector)
        return seat is not None and seat.is_held_by(answer.elector, answer.disk) and seat.joining == answer.joining

    def _read(self, running: _Round[V], todo: ToDo, now: float) -> None:
        """A majority promised: decide the value of this ballot."""
        accepted = [acceptance for acceptance in running.promises.values() if acceptance is not None]
        newest = max(accepted, key=lambda held: (held.ballot, self._prevails(held.value)), default=None)
        read = self._initial if newest is None else newest.value
        if read.revision < running.known:
            self.problem = f"a majority of electors has forgotten revision {shown(running.known)}"
            self._give_up(running, todo, now)
            return
        if read.revision < self.value.revision:  # learnt since we asked: a higher ballot has overtaken this one
            self._again(running, todo, now)
            return
        if not self._may_carry(read):
            self._again(running, todo, now)
            return
        if running.is_ahead and read.revision == self.value.revision:
            running.phase, running.deadline = _Phase.HELD, self._gives_up_at(running)
            return
        is_identity = running.change is None or running.sent is not None
        if is_identity and newest is None:
            self.written_under = self._count
            self._finish(todo, RoundOutcome.COMMITTED if running.sent is None else RoundOutcome.UNKNOWN, now)
            return
        if (moved := self._moved_on(running, read)) is not None:
            running.value = running.sent = moved
        elif read.revision > self.value.revision or running.change is None or running.sent is not None:
            running.value = read
        elif running.change.base_revision != read.revision:
            self._finish(todo, RoundOutcome.CONFLICT, now)
            return
        elif (changed := running.change.apply(read)) == read:
            self._finish(todo, RoundOutcome.UNCHANGED, now)
            return
        else:
            running.value = running.sent = changed
        assert running.ballot is not None
        self._accept(running, running.ballot, running.value, todo, now)

    def _moved_on(self, running: _Round[V], read: V) -> V | None:
        """Our change applied to a read value that no majority will accept; ``None``: not that case."""
        change = running.change
        if read != running.unfit or running.sent is not None or change is None or not self._replaces(change):
            return None
        moved = change.apply(read)
        return None if moved == read else moved

    def _commit(self, running: _Round[V], todo: ToDo, now: float) -> None:
        """A majority accepted: the value is chosen."""
        assert running.value is not None
        self.written_under = self._count
        self.learn(running.value, todo, now)
        if self._round is not running:
            return  # learning it has ended the round
        if running.change is None:
            self._finish(todo, RoundOutcome.COMMITTED, now)
        elif running.sent is None:
            self._prepare(todo, now)  # the other's value is settled; ours follows under a higher ballot
        else:
            self._finish(todo, RoundOutcome.CONFLICT, now)  # a majority has passed the ballot that carried ours

    def _on_refused(self, running: _Round[V], answer: Refused, todo: ToDo, now: float) -> None:
        if answer.refusal is Refusal.BALLOT and answer.promised <= answer.ballot:
            return  # the echo of a duplicated prepare: it has promised this very ballot
        if answer.promised.counter <= self._counter + MAX_JUMP:
            self._counter = max(self._counter, answer.promised.counter)
        running.no[answer.elector] = answer.refusal
        if len(self._count.electors) - len(running.no) < majority(len(self._count.electors)):
            if self._waits_for_others(running):
                return  # the same accept is sent once more at its deadline
            if Refusal.VALUE in running.no.values():
                running.unfit = running.value
            self._again(running, todo, now)

    @staticmethod
    def _waits_for_others(running: _Round[V]) -> bool:
        """Whether only what will end stands against our accept, and the ballot is good.

        That is an exclusive task's lease, or that an elector has not fetched the fleet's document yet.
        """
        passes = {Refusal.LEASE, Refusal.DOCUMENT}
        return running.phase is _Phase.ACCEPT and passes.issuperset(running.no.values()) and bool(running.no)

    def _ask_again(self, running: _Round[V], todo: ToDo, now: float) -> None:
        """Send the same question again: who has answered by then, on however slow a disk, answers at once.

        A new ballot would be another write everywhere, and of an accept it could only find out the outcome.
        """
        if now >= self._gives_up_at(running):
            self._give_up(running, todo, now)
            return
        assert running.ballot is not None
        running.is_alone = True
        if running.value is None:
            self._ask_promises(running, running.ballot, todo, now)
        else:
            self._accept(running, running.ballot, running.value, todo, now)

    def _accept(self, running: _Round[V], ballot: Ballot, value: V, todo: ToDo, now: float) -> None:
        running.phase, running.deadline, running.no = _Phase.ACCEPT, now + self._ballot_s, {}
        acceptance = Acceptance(ballot=ballot, value=value)
        accept = Accept(
            task=self.state.task,
            acceptance=acceptance,
            electorate=self._electorate,
            creation=self.state.creation,
            generation_id=self._count.generation_id,
            number=self._count.number,
        )
        self._ask(accept, todo)

    def _again(self, running: _Round[V], todo: ToDo, now: float) -> None:
        """This ballot cannot win: wait a little and try a higher one, or end.

        Once our own accept has left, the higher ballot only finds out its outcome.
        """
        wait = self._jitter(running.attempt)
        if now + wait >= self._gives_up_at(running):
            self._give_up(running, todo, now)
            return
        running.attempt += 1
        running.is_alone = True
        running.phase, running.deadline, running.ballot = _Phase.WAIT, now + wait, None

    def _give_up(self, running: _Round[V], todo: ToDo, now: float) -> None:
        self._finish(todo, RoundOutcome.NO_QUORUM if running.sent is None else RoundOutcome.UNKNOWN, now)

    def _finish(self, todo: ToDo, outcome: RoundOutcome, now: float) -> None:
        running = self._running()
        if running.change is not None:
            self._end(running.change, outcome, todo)
        self._round = None
        self._start_next(todo, now)

    def _jitter(self, attempt: int) -> float:
        """Doubling back-off with jitter, so that duelling proposers part."""
        base = self._clocks().stagger_s * 2.0 ** min(attempt, 16)  # bounded: a cut may last for days
        return min(base, BACKOFF_CAP_S) * (0.5 + self._rng.random())

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed."""
        running = self._round
        if running is not None and now >= running.deadline:
            running.since += now - running.deadline  # this loop stood still meanwhile, maybe in its own write
            if running.phase is _Phase.WAIT and now < (until := min(self._lease_over_at, self._gives_up_at(running))):
                running.deadline = until  # our next ballot would end the accept that waits
            elif running.phase is _Phase.WAIT:
                self._prepare(todo, now)  # no newer value has come: that would have ended the round
            elif running.phase is _Phase.HELD:
                self._give_up(running, todo, now)
            elif Refusal.BALLOT in running.no.values():
                self._again(running, todo, now)  # who has promised more than we have answers nothing else
            else:
                self._ask_again(running, todo, now)
        elif running is None and now >= self._settle_at:
            self._settle_tries += 1
            self._settle_at = now + 2 * self._ballot_s + self._jitter(self._settle_tries)
            if self._is_unlearnt():
                self.settle(todo, now)
            else:
                self._settle_at = math.inf
