"""EXECUTOR, beside the handover: decides whether a worker may work now. Leases, and robots that are cut off.

Knows: when a worker here must stop, may go on, or works alone. Does not know: grants and echoes
(`zsched.core.vote.lease`), the handover's table (`zsched.core.executor.handover`), how a role reaches a worker.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from zsched.core.executor.handover import Executor
from zsched.core.membership.peers import Membership
from zsched.core.values.absence import Absences
from zsched.core.values.beat import Beat
from zsched.core.values.events import ClockCompared
from zsched.core.values.fleet import OnIsolation
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, NodeId, PeerState, TaskId
from zsched.core.values.quorum import majority
from zsched.core.values.todo import ToDo
from zsched.core.vote.clocks import ClockDoubt
from zsched.core.vote.lease import Leases

ALONE_AFTER_S = 0.5
"""With `on_isolation: local` a robot works alone after this time without the owner and without a quorum."""


@dataclass(slots=True)
class Tenure:
    """One node's right to work, for all tasks."""

    in_force: InForce
    me: NodeId
    leases: Leases
    executors: Mapping[TaskId, Executor]
    clock: ClockDoubt = field(default_factory=ClockDoubt)
    _absences: dict[TaskId, tuple[int, Absences]] = field(init=False)
    """{exclusive task that this node owns: (the epoch, of its valid lease in it)}."""
    _alone_since: dict[TaskId, float] = field(init=False)

    def __post_init__(self) -> None:
        self._absences, self._alone_since = self.in_force.by_task(), self.in_force.by_task()

    @property
    def exclusive(self) -> tuple[TaskId, ...]:
        """The tasks whose workers need a lease: by this node's file, or for everybody."""
        return tuple(name for name, executor in self.executors.items() if executor.is_leased)

    @property
    def is_busy(self) -> bool:
        """Whether any beat may give a worker here a lease, or stop it."""
        return self.leases.is_holding

    def next_deadline(self, now: float) -> float:
        """When `tend_leases` or `tend_isolation` may have something to do that nothing else brings about."""
        due = self.leases.next_deadline(now)
        for at in self._alone_since.values():
            if at + ALONE_AFTER_S > now:  # after it every turn looks: who may not work alone has nothing to wait for
                due = min(due, at + ALONE_AFTER_S)
        return due

    # --- exclusive tasks ---------------------------------------------------------------------------------------------

    def hold(self, value: Allocation, next_number: int) -> None:
        """A newer value was learnt: begin or end this node's side of the task's lease.

        One without an owner begins a generation. None of the electors of before has waited for our worker, which works
        until its lease ends: they must not hear that it has stopped.
        """
        if value.owner is None:
            return
        if value.task in self.exclusive and value.owner == self.me:
            self.leases.begin(value.task, value.epoch, next_number)
        else:
            self.leases.end(value.task, next_number - 1)

    def hear(
        self,
        beat: Beat,
        accepted: Mapping[TaskId, tuple[NodeId, int]],
        todo: ToDo,
        now: float,
        *,
        is_newest: bool,
    ) -> None:
        """A beat (our own too) may grant, echo, release, or ask us to leave. A first grant waits for its echo."""
        todo.must_beat |= self.leases.on_beat(beat, accepted, now, is_newest=is_newest)

    def on_clock(
        self, event: ClockCompared, standing: Mapping[TaskId, Allocation | None], number: int, now: float
    ) -> bool:
        """Take a comparison of clocks in. Whether it began or ended a doubt.

        Only an exclusive task begins one; it ends also where none is exclusive any more.
        """
        is_in_doubt = self.clock.absorb(event, now)
        if is_in_doubt == self.leases.is_in_doubt or (is_in_doubt and not self.exclusive):
            return False
        if is_in_doubt:
            self.leases.doubt(standing)
        else:
            self.leases.trust(standing, number, now)
        return True

    def tend_leases(self, number: int, todo: ToDo, now: float) -> None:
        """Prolong our workers' leases, stop workers that must leave, and give back leases that ended.

        ``number`` is that of our newest beat.
        """
        if not self.leases.is_holding:
            return  # nobody works here
        leaving = self.leases.leaving()
        for task in self.exclusive:
            executor = self.executors[task]
            before = executor.role
            if task not in leaving and not self.leases.is_in_doubt:
                until = self.leases.until(task)
                executor.set_lease(until, todo, now)
                if executor.role is not before:
                    self.leases.on_given(task, until)
                continue
            executor.leave(todo)
            if executor.role is not before:
                self.leases.on_told_to_stop(task)
            if self.leases.is_in_doubt:
                continue  # no clock here tells when a permission is over
            # What the worker was told counts, not what has been echoed since: electors may echo on and on, and a
            # worker that has stopped already will not say so again.
            if now >= self.leases.given_until(task):
                todo.must_beat |= self.leases.on_run_out(task, number, now)

    def misses_lease(self, value: Allocation, now: float) -> bool:
        """Whether the worker of a task that this node owns rests for want of a lease, and has for too long. Each turn.

        Until nobody works without a lease any more, and while another owner waits, it rests for others' sake. A lease
        that is there now and then is missed as one that is not: absences add up (`zsched.core.values.absence`).
        """
        epoch, absences = self._absences.get(value.task, (value.epoch, Absences()))
        if epoch != value.epoch:
            absences = Absences()
        self._absences[value.task] = value.epoch, absences
        has_to_rest = not value.leased or value.task in self.leases.leaving()
        is_away = not has_to_rest and self.leases.until(value.task) <= now
        limit_s = self.in_force.timing.suspect_s + self.in_force.timing.lease_s
        return absences.look(is_away, now, limit_s) >= limit_s

    # --- isolation ---------------------------------------------------------------------------------------------------

    def tend_isolation(self, membership: Membership, todo: ToDo, now: float) -> None:
        """Work alone exactly while cut off from the owner and from a quorum."""
        local = [task.name for task in self.in_force.tasks.values() if task.on_isolation is OnIsolation.LOCAL]
        for name in [name for name in self._alone_since if name not in local]:
            del self._alone_since[name]
        if not local:
            return
        # The only robot that counts is always its own majority; whether anything can still be agreed electors tell.
        # Without a majority of the robots that count this node is cut off.
        voters = self.in_force.voters
        counted = self.leases.electors if voters == (self.me,) else voters
        heard = sum(membership.state(name) is PeerState.ALIVE for name in counted)
        is_cut_off = heard < majority(len(counted))
        for name in local:
            executor = self.executors[name]
            if executor.owner is None:
                continue
            if not is_cut_off or membership.state(executor.owner) is PeerState.ALIVE:
                self._alone_since.pop(name, None)
                executor.rejoin(todo, now)
            elif now >= self._alone_since.setdefault(name, now) + ALONE_AFTER_S:
                executor.isolate(todo, now)
