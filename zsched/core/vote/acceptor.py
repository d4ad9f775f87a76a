"""VOTE, the acceptor: which questions about its registers this node answers, and which wait for a lease.

Knows: whose ballot may be answered, at which rate, what an exclusive task's owner has to do with an accept. Does not
know: the rules of a round (`zsched.core.register.register`), what is learnt (`zsched.core.vote.agreement`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

from zsched.core.electorate.numbers import Numbers
from zsched.core.register.task_register import TaskRegister
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Accepted, Prepare, Promise, Refusal, Refused, fleet_answer
from zsched.core.values.model import Ballot, NodeId, TaskId
from zsched.core.values.todo import ToDo
from zsched.core.vote.belief import is_fit, is_fleet_fit
from zsched.core.vote.lease import Leases
from zsched.core.vote.witness import Witness

PREPARES_PER_S = 20.0
PREPARE_BURST = 40.0
"""Prepares of one peer: honest proposers back off far below this, only a broken one comes near."""
PARK_SHARE = 0.8
"""An accept that a lease forbids waits for this part of a ballot's deadline for the release; then it is refused."""


class Acceptor:
    """The answers of one node to proposers.

    Args:
        in_force: the fleet that the node goes by.
        registers: its tasks' registers; the table changes with the fleet.
        numbers: its fleet register.
        witness: what others remember of it.
        leases: of exclusive tasks.
        counters: of what gets no answer.
        is_elector: whether its state and the electors in force let it answer with more than refusals.
    """

    def __init__(
        self,
        *,
        in_force: InForce,
        registers: Mapping[TaskId, TaskRegister],
        numbers: Numbers,
        witness: Witness,
        leases: Leases,
        counters: Counter[str],
        is_elector: bool,
    ) -> None:
        self.is_elector = is_elector
        self.registers, self.witness, self.leases, self.counters = registers, witness, leases, counters
        self._numbers = numbers
        self._in_force = in_force
        self._buckets: dict[NodeId, tuple[float, float]] = in_force.by_node()
        self._parked: dict[tuple[TaskId, NodeId], tuple[ev.AcceptAsked, float]] = {}

    def next_deadline(self) -> float:
        """When a question has waited long enough; infinity: none waits."""
        return min((deadline for _, deadline in self._parked.values()), default=math.inf)

    def refuse_gone(self, todo: ToDo) -> None:
        """Registers count by another number: what waits for a task that has gone is refused."""
        roll = self._numbers.roll
        for key, (event, _) in tuple(self._parked.items()):
            if key[0] in self.registers:
                continue
            del self._parked[key]
            if roll is not None:
                todo.add(do.AnswerElection(request=event.request, answer=roll.refused(event.accept)))

    def on_prepare(self, event: ev.PrepareAsked, todo: ToDo, now: float, *, may_ask: bool | None = None) -> None:
        """A proposer asks for a promise: only for its own ballots, at a bounded rate (each promise costs an fsync).

        ``may_ask``: whether the rate allows it, where that is known already.
        """
        register = self.registers.get(event.prepare.task)
        if register is None or not self._is_its_own(event.prepare.ballot, event.asker):
            self.counters["prepare_foreign"] += 1
            return
        if self._numbers.is_foreign(event.prepare):
            self.counters["prepare_stranger"] += 1
            return
        ballot = event.prepare.ballot
        answer: Promise | Refused
        turned_away = self._numbers.turned_away(event.prepare, event.asker, todo)
        if not (self.may_ask(event.asker, now) if may_ask is None else may_ask):
            self.counters["prepare_rate"] += 1
            answer = register.refuse(ballot, Refusal.RATE)
        elif turned_away is not None:
            answer = turned_away
        elif self.is_elector and not self.witness.may_vote(now):
            answer = register.refuse(ballot, Refusal.YOUNG)
        else:
            before = register.state
            answer = register.on_prepare(event.prepare, todo)
            self.witness.votes += register.state is not before  # asked again, it is no other vote
        todo.add(do.AnswerElection(request=event.request, answer=answer))

    def on_fleet_asked(self, event: ev.FleetAsked, todo: ToDo, now: float, may_ask: bool | None = None) -> None:
        """A proposer asks this elector's fleet register: only for its own ballots, at the rate of all prepares.

        ``may_ask``: whether the rate allows it, where that is known already.
        """
        question = event.question.content
        if not self._is_its_own(event.question.ballot, event.asker):
            self.counters["fleet_foreign"] += 1
            return
        refusal = None
        is_prepare = isinstance(question, Prepare)
        if is_prepare and not (self.may_ask(event.asker, now) if may_ask is None else may_ask):
            self.counters["prepare_rate"] += 1
            refusal = Refusal.RATE
        elif not isinstance(question, Prepare) and not is_fleet_fit(self._numbers.value, question.acceptance.value):
            self.counters["accept_unfit"] += 1
            refusal = Refusal.VALUE
        elif self.is_elector and not self.witness.may_vote(now):
            refusal = Refusal.YOUNG
        before = self._numbers.state
        answer = self._numbers.on_question(question, event.asker, todo, now, refusal)
        if answer is not None:
            self.witness.votes += self._numbers.state is not before and not isinstance(answer, Refused)
            todo.add(do.AnswerFleet(request=event.request, answer=fleet_answer(answer)))

    def on_accept(self, event: ev.AcceptAsked, todo: ToDo, now: float, *, park_s: float | None = None) -> None:
        """A proposer asks this elector to accept a value: only under its own ballots.

        ``park_s``: the longest wait for an owner to leave (seconds); ``None``: by the file.
        """
        acceptance = event.accept.acceptance
        register = self.registers.get(event.accept.task)
        if register is None or not self._is_its_own(acceptance.ballot, event.asker):
            self.counters["accept_foreign"] += 1
            return
        if self._numbers.is_foreign(event.accept):
            self.counters["accept_stranger"] += 1
            return
        if not is_fit(self._in_force.fleet, acceptance.value, register):
            self.counters["accept_unfit"] += 1
            refused = register.refuse(acceptance.ballot, Refusal.VALUE)
        elif (turned_away := self._numbers.turned_away(event.accept, event.asker, todo)) is not None:
            refused = turned_away
        elif self.is_elector and not self.witness.may_vote(now):
            refused = register.refuse(acceptance.ballot, Refusal.YOUNG)
        else:
            at_most = PARK_SHARE * self._in_force.timing.ballot_s if park_s is None else park_s
            self._accept_or_park(event, now + at_most, todo, now)
            return
        todo.add(do.AnswerElection(request=event.request, answer=refused))

    def _accept_or_park(self, event: ev.AcceptAsked, deadline: float, todo: ToDo, now: float) -> None:
        """Accept, refuse, or let the question wait while an exclusive task's owner is asked to leave."""
        accept = event.accept
        register = self.registers[accept.task]
        key = (accept.task, event.asker)
        older = self._parked.pop(key, None)
        if older is not None and older[0] != event:
            todo.add(do.AnswerElection(request=older[0].request, answer=self._leased(older[0])))
        value = accept.acceptance.value
        if not register.would_accept(accept) or self.leases.may_accept(accept.task, value.owner, now):
            known, before = register.newest, register.state
            answer = register.on_accept(accept, todo, now)
            if isinstance(answer, Accepted) and (known is None or value.revision > known.revision):
                # An identity round's is none: the next owner may still wait.
                self.leases.on_newer_value(value)
            self.witness.votes += register.state is not before
            todo.add(do.AnswerElection(request=event.request, answer=answer))
        elif now >= deadline:
            todo.add(do.AnswerElection(request=event.request, answer=self._leased(event)))
        else:
            self._parked[key] = (event, deadline)
            todo.must_beat |= older is None  # an owner must hear that it is asked to leave

    def _leased(self, event: ev.AcceptAsked) -> Refused:
        register = self.registers[event.accept.task]
        return register.refuse(event.accept.acceptance.ballot, Refusal.LEASE)

    @property
    def has_parked(self) -> bool:
        """Whether a question waits for an exclusive task's owner to leave."""
        return bool(self._parked)

    def retry_parked(self, todo: ToDo, now: float) -> None:
        """A lease may have been released or run out, or a parked question may have waited long enough."""
        for event, deadline in tuple(self._parked.values()):
            self._accept_or_park(event, deadline, todo, now)

    def may_ask(self, asker: NodeId, now: float) -> bool:
        """Take one token of the asker's bucket (`PREPARES_PER_S`, at most `PREPARE_BURST` saved); a no costs none.

        Who is no node has no bucket: inventing names takes no memory.
        """
        if asker not in self._in_force.nodes:
            return False
        tokens, at = self._buckets.get(asker, (PREPARE_BURST, now))
        tokens = min(tokens + (now - at) * PREPARES_PER_S, PREPARE_BURST)
        may_ask = tokens >= 1.0
        self._buckets[asker] = (tokens - may_ask, now)
        return may_ask

    def _is_its_own(self, ballot: Ballot, asker: NodeId) -> bool:
        return ballot.node == asker and asker in self._in_force.nodes
