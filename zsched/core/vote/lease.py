"""Exclusive tasks: a lease excludes two active owners. A majority grants it by echoes of the owner's beats.

Knows: grants, echoes, releases and their clocks. Does not know: how a worker is stopped, ballots, bytes.

L is the lease, rho the bound on the difference of two clocks' rates. Nodes do not compare clocks: each counts on its
own.

* The owner's beats are numbered. An elector echoes a number, per task, only to the owner and epoch of the value that it
  last *accepted*; the echo is the grant.
* The owner is active only while a majority has echoed a number that it sent *after learning this epoch*. The lease ends
  L after the *sending* of the largest number that a majority has echoed or exceeded. An elector may echo a number that
  the owner has not sent yet, because of a forged beat. It then counts from an earlier moment than the owner would, so
  its echo of that number never counts. It grants the real, lower numbers again once they are believed
  (`zsched.core.values.sequence`).
* Electors grant only a task that is *leased* for everybody (`Allocation.leased`, `zsched.core.executor.sealing`).
* A node that is no elector grants nothing, even where its name has a seat (of a disk that it has lost). Nobody would
  wait for such a grant to end.
* An elector never grants to two owners, or to two lives of one, at once: to another only after the hold or a release.
* An elector that granted refuses an accept for another owner until L(1+rho)/(1-rho) after its last grant on its own
  clock, or until the owner released. An elector that has just started does so for the same time with every owner but
  that of its persisted accepted value, and echoes no owner: it may have granted to an earlier life of that owner.
  With the first value of a generation it does so for every task. One that is not exclusive any more may have been it in
  the generation before, and its owner there may still work by a lease.
* An elector that refuses stops echoing the present owner (for at most twice that time, or until it accepts or learns a
  newer revision), and its beats ask that owner to leave. The owner drains and releases all numbers up to now, which are
  never granted again. Without this a planned move would never happen.
* An echo counts only under the same terms (`lease_terms`): the electors and L of both fleet files. The majority of
  another electorate need not meet the one that granted to this owner's earlier life. A node with other terms gets no
  leased task. Nor does a node that does not hear a majority of the electors, or that they do not hear: its lease
  would end, and its worker rest for as long as that is so.
* A node whose clock is in doubt (`zsched.core.vote.clocks`) neither works nor grants, and its beats name other terms.
  Afterwards it begins like an elector, and an owner, that has just started.
* The worker's own report that it has stopped ends the owner's wait before the lease does, but only once the worker was
  told to stop, and while no earlier report of the same epoch is missing: a late one would give back a lease that the
  worker has been given since.

Source: Gray & Cheriton 1989 (leases), with the epoch as fencing token.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Final

from zsched.core.values.beat import Beat, Grant
from zsched.core.values.fleet import lease_terms
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import hold_s
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct
from zsched.core.values.veto import Filter, Veto

_IN_DOUBT: Final = ", clock in doubt"
"""Behind the terms of a node's leases, on the wire."""
IN_DOUBT: Final = Veto(Filter.LEASE, "clock in doubt")
"""Its leases are worth nothing (`zsched.core.vote.clocks`)."""
SENT_KEPT = 128
"""Newest numbers whose sending time an owner keeps; an echo of an older one gives no lease."""
LIVES_KEPT = 8
"""An elector knows what so many lives of an owner have released; who is older is dead, and its grants are over."""
HURRY_S = 0.05
"""An empty release (nothing was used) causes a beat of its own at most this often."""


@dataclass(slots=True)
class Granter:
    """One elector's side of one exclusive task.

    Args:
        task: the task.
        lease_s: L.
        until: until when what this elector granted before it started may last (monotonic seconds).
        standing: owner of the persisted accepted value at the start (``None``: there was none).
    """

    task: TaskId
    lease_s: float
    until: float
    standing: NodeId | None
    is_for_first: bool = False
    """The task has no lease: this guards the first value of a generation from a lease of the one before."""
    _last: Grant | None = None
    _granted_at: float = -math.inf
    _hold_s: float = 0.0
    """How long the last grant forbids another owner: by the lease under which it was given."""
    _released: dict[tuple[NodeId, int], int] = field(default_factory=dict)
    """{(owner, incarnation): the largest released number}, of an owner's last `LIVES_KEPT` lives."""
    _silent_for: tuple[NodeId, int] | None = None
    """(owner, epoch) that is not echoed any more because another one waits."""
    _silent_until: float = -math.inf

    def on_beat(self, beat: Beat, accepted: tuple[NodeId, int] | None, now: float, *, is_newest: bool = True) -> bool:
        """Take a beat in and grant it if its sender is the accepted owner. Whether this begins a new grant.

        Args:
            beat: of any node.
            accepted: (owner, epoch) of the value that this elector last accepted.
            now: monotonic seconds.
            is_newest: it is no repeat and no late one. A lower number than the last is then the sender's true one.
        """
        for grant in beat.released:
            is_its_own = (grant.task, grant.owner, grant.incarnation) == (self.task, beat.node, beat.incarnation)
            if is_its_own and grant.number <= beat.sequence:  # nobody gives back what it has not sent yet
                self._release(grant)
        if accepted is None or accepted[0] != beat.node:
            return False
        epoch = next((epoch for task, _, epoch in beat.learnt if task == self.task), None)
        if epoch != accepted[1] or self._is_silenced(beat.node, epoch, now):
            return False
        if beat.sequence <= self._released.get((beat.node, beat.incarnation), -1):
            return False
        if self._is_held(beat, now):
            return False
        is_new = self._last is None or (self._last.owner, self._last.incarnation, self._last.epoch) != (
            beat.node,
            beat.incarnation,
            epoch,
        )
        if not is_new and not is_newest and self._last is not None and beat.sequence <= self._last.number:
            return False
        self._last = Grant(
            task=self.task, owner=beat.node, incarnation=beat.incarnation, epoch=epoch, number=beat.sequence
        )
        # What was granted before, maybe by a longer lease, ends when it would have ended.
        self._hold_s = max(hold_s(self.lease_s), self._granted_at + self._hold_s - now)
        self._granted_at = now
        return is_new

    def _is_held(self, beat: Beat, now: float) -> bool:
        """Whether another owner, or an earlier life of this one, may still hold our grant."""
        last = self._last
        if now < self.until:
            return True  # what this elector granted before it started is forgotten, and to whom
        if last is None or (last.owner, last.incarnation) == (beat.node, beat.incarnation):
            return False
        return now < self._granted_at + self._hold_s

    def _release(self, grant: Grant) -> None:
        key = (grant.owner, grant.incarnation)
        self._released[key] = max(self._released.pop(key, grant.number), grant.number)
        lives = [known for known in self._released if known[0] == grant.owner]
        if len(lives) > LIVES_KEPT:
            del self._released[lives[0]]
        last = self._last
        if last is not None and (last.owner, last.incarnation) == key and last.number <= grant.number:
            self._last, self._granted_at = None, -math.inf

    def longer_s(self, now: float) -> float:
        """The hold of a grant of this life under a longer lease than today's, while it may last; else zero."""
        is_over = now >= max(self.until, self._granted_at + self._hold_s)  # in doubt, when it was is forgotten
        return self._hold_s if self._hold_s > hold_s(self.lease_s) and not is_over else 0.0

    def _is_silenced(self, owner: NodeId, epoch: int, now: float) -> bool:
        return self._silent_for == (owner, epoch) and now < self._silent_until

    def restart(self, standing: Allocation | None, until: float) -> None:
        """This elector knows to whom it granted, but not when: as after a start."""
        self.standing, self.until = None if standing is None else standing.owner, until
        self._last, self._granted_at = None, -math.inf
        self.on_newer_value()

    def resume(self, standing: Allocation | None, now: float, least_s: float) -> None:
        """The clock is right again: what was granted, maybe by a longer lease than today's, is over in a hold."""
        self.restart(standing, now + max(least_s, self._hold_s))

    def may_accept(self, owner: NodeId | None, now: float) -> bool:
        """Whether a value with this owner may be accepted now; a no starts the silence towards the present owner."""
        if now < self.until and owner != self.standing:
            return False
        last = self._last
        if last is None or last.owner == owner or now >= self._granted_at + self._hold_s:
            return True
        if not self._is_silenced(last.owner, last.epoch, now):
            self._silent_for = (last.owner, last.epoch)
            self._silent_until = now + 2 * self._hold_s
        return False

    def on_newer_value(self) -> None:
        """A newer revision was accepted or learnt: no other owner waits any more."""
        self._silent_for, self._silent_until = None, -math.inf

    def echo(self, now: float) -> Grant | None:
        """This elector's echo for its beat, or ``None``."""
        last = self._last
        if last is None or self._is_silenced(last.owner, last.epoch, now) or now >= self._granted_at + self.lease_s:
            return None
        return last

    def asked_to_leave(self, now: float) -> tuple[TaskId, NodeId, int] | None:
        """(task, owner, epoch) that this elector's beats ask to leave, or ``None``."""
        if self._silent_for is None or now >= self._silent_until:
            return None
        return self.task, *self._silent_for

    def next_deadline(self, now: float) -> float:
        """When `may_accept` may change its mind; infinity when never."""
        grant = self._granted_at + self._hold_s
        return min(self.until if self.until > now else math.inf, grant if grant > now else math.inf)


@dataclass(slots=True)
class Holder:
    """One owner's side of one exclusive task in one epoch.

    Args:
        task: the task.
        epoch: the epoch in which this node is the owner.
        me: this node.
        incarnation: of this daemon.
        electors: the configured electors.
        lease_s: L.
        first_number: the first beat that will be sent after this epoch was learnt.
    """

    task: TaskId
    epoch: int
    me: NodeId
    incarnation: int
    electors: tuple[NodeId, ...]
    lease_s: float
    first_number: int
    is_leaving: bool = False
    released: int = -1
    """The largest number that was given back."""
    given_until: float = -math.inf
    """The end of the worker's permission to work; minus infinity once it has stopped."""
    awaits_report: bool = False
    """The worker was told to stop and has not said yet that it has."""
    expects_late_report: bool = False
    """A report of an earlier stop in this epoch may still come: from now on only the permission's end counts."""
    hurried_at: float = -math.inf
    """When an empty release last had a beat of its own."""
    _kept_until: float = -math.inf
    """The end of the lease that other electors, of a number before, have granted."""
    _sent: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=SENT_KEPT))
    _echoed: dict[NodeId, int] = field(default_factory=dict)
    _ahead: dict[NodeId, list[int]] = field(default_factory=dict)
    """{elector: the numbers that it echoed before we sent them, lowest first}: from forged beats."""

    def on_sent(self, number: int, now: float) -> None:
        """A beat leaves."""
        self._sent.append((number, now))

    def on_echo(self, elector: NodeId, grant: Grant) -> None:
        """An elector echoed one of our numbers; another life or epoch, or a stranger's echo, does not count."""
        if elector not in self.electors or (grant.task, grant.owner) != (self.task, self.me):
            return
        if (grant.incarnation, grant.epoch) != (self.incarnation, self.epoch):
            return
        if not self._sent or grant.number > self._sent[-1][0]:  # somebody else beats in our name
            self._note_ahead(elector, grant.number)
        elif grant.number < self.first_number or grant.number <= self.released:
            return
        elif grant.number not in self._ahead.get(elector, ()):
            self._echoed[elector] = max(self._echoed.get(elector, -1), grant.number)

    def _note_ahead(self, elector: NodeId, number: int) -> None:
        """Keep the lowest of these numbers: those `SENT_KEPT` behind were echoed long before we could send them."""
        known = {*self._ahead.get(elector, ()), number}
        echoed = self._echoed.get(elector, -1)
        self._ahead[elector] = sorted(one for one in known if one > echoed)[:SENT_KEPT]

    def lease_until(self) -> float:
        """When the lease ends (monotonic seconds on this machine); minus infinity when there is none."""
        needed = majority(len(self.electors))
        numbers = sorted((number for number in self._echoed.values() if number > self.released), reverse=True)
        if len(numbers) < needed:
            return self._kept_until
        number = numbers[needed - 1]
        at = next((at for sent, at in self._sent if sent == number), None)
        return self._kept_until if at is None else max(self._kept_until, at + self.lease_s)

    def count_with(self, electors: tuple[NodeId, ...], lease_s: float) -> None:
        """Count echoes of other electors from now on; what is held by the old ones runs to its end.

        Only of beats that are sent from now on: a grant of an earlier beat is guarded with the length of before, though
        its elector may echo it under the new terms.
        """
        self._kept_until = self.lease_until()
        if self._sent:
            self.first_number = max(self.first_number, self._sent[-1][0] + 1)
        self.electors, self.lease_s = electors, lease_s
        self._echoed.clear()

    def ask(self) -> None:
        """Another owner waits. Electors may have granted more than they echo, so every number sent so far is meant."""
        if self._sent and self._sent[-1][0] > self.released:
            self.is_leaving = True

    def release(self, number: int) -> Grant:
        """Give back every number up to ``number``: the worker has stopped."""
        self.released = max(self.released, number)
        self.is_leaving, self.given_until, self._kept_until = False, -math.inf, -math.inf
        return Grant(
            task=self.task, owner=self.me, incarnation=self.incarnation, epoch=self.epoch, number=self.released
        )


class BeatParts(Struct, frozen=True, kw_only=True):
    """The parts of this node's beat about leases."""

    echoes: tuple[Grant, ...]
    released: tuple[Grant, ...]
    asked_to_leave: tuple[tuple[TaskId, NodeId, int], ...]


def _is_first(value: Allocation | None) -> bool:
    """Whether nobody has agreed on an owner yet in this value's generation."""
    return value is not None and value.owner is None and value.revision > 0


@dataclass(slots=True)
class Leases:
    """Both sides of every exclusive task at one node.

    Args:
        in_force: the fleet.
        me: this node.
        incarnation: of this daemon.
        standing: {task: the newest persisted value, or ``None``}; empty when this node is no elector.
        now: monotonic seconds.
        granted_s: how long a lease may last from this node's life before (0: as long as today's).
    """

    in_force: InForce
    me: NodeId
    incarnation: int
    standing: Mapping[TaskId, Allocation | None]
    now: float
    granted_s: float = 0.0
    terms: str = field(init=False)
    number: int = 0
    """Of the fleet value by which this node counts; 0: of its file."""
    guard_lease_s: float = 0.0
    """The longest lease that may still run, by that value: of a task that comes, its name may have one."""
    electors: tuple[NodeId, ...] = field(init=False)
    lease_s: float = field(init=False)
    is_in_doubt: bool = False
    """This node's clock is in doubt: it holds and grants nothing."""
    _grants: bool = field(init=False)
    """Whether this node is an elector: its name alone may have a seat, that of another disk."""
    _others: dict[NodeId, str] = field(default_factory=dict)
    """{node: its terms} of the nodes whose terms differ from ours."""
    _granters: dict[TaskId, Granter] = field(init=False)
    _holders: dict[TaskId, Holder] = field(init=False)
    _releases: dict[TaskId, Grant] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Nothing is released where a task goes: its worker may still be at work.
        self._holders = self.in_force.by_task()
        fleet = self.in_force.fleet
        self.terms = lease_terms(fleet)
        self.electors, self.lease_s = fleet.electors, fleet.timing.lease_s
        self._granters, self._grants = {}, bool(self.standing)
        for task in fleet.tasks:
            value = self.standing.get(task.name)
            is_leased = task.exclusive or (value is not None and value.leased)
            if (is_leased or _is_first(value)) and task.name in self.standing:
                owner = None if value is None else value.owner
                self._watch(task.name, owner, self.over_at, is_for_first=not is_leased)

    def _watch(self, task: TaskId, standing: NodeId | None, until: float, *, is_for_first: bool = False) -> None:
        self._granters[task] = Granter(
            task=task, lease_s=self.lease_s, until=until, standing=standing, is_for_first=is_for_first
        )

    def _counts_like_us(self, beat: Beat) -> bool:
        """Whether a beat's sender counts by our number of our generation; by a fleet file there is neither."""
        if beat.number != self.number:
            return False
        return not self.number or beat.lease_terms.partition(",")[0] == self.terms  # behind it a clock is in doubt

    @property
    def over_at(self) -> float:
        """When every grant to, or by, an earlier life of this node is over."""
        return self.now + hold_s(max(self.in_force.timing.lease_s, self.granted_s))

    @property
    def terms_told(self) -> str:
        """The terms of this node's leases for its beats; in doubt, terms that no other node has."""
        return f"{self.terms}{_IN_DOUBT}" if self.is_in_doubt and self.terms else self.terms

    def doubt(self, standing: Mapping[TaskId, Allocation | None]) -> None:
        """The clock is in doubt: hold and grant nothing from now on."""
        self.is_in_doubt = True
        for task, granter in self._granters.items():
            granter.restart(standing[task], math.inf)

    def trust(self, standing: Mapping[TaskId, Allocation | None], number: int, now: float) -> None:
        """The clock is right again: begin anew, with beats after ``number``."""
        self.is_in_doubt = False
        for task, granter in self._granters.items():
            granter.resume(standing[task], now, hold_s(max(self.lease_s, self.granted_s)))
        for task in tuple(self._holders):
            holder = self._holders.pop(task)
            self.begin(task, holder.epoch, number + 1)
            # The worker was told to stop: its word may still come, and until then it may be at work.
            self._holders[task].expects_late_report, self._holders[task].given_until = True, holder.given_until

    def count_with(
        self,
        electors: tuple[NodeId, ...],
        *,
        terms: str,
        number: int,
        lease_s: float,
        standing: Mapping[TaskId, Allocation | None],
        guard_lease_s: float = 0.0,
    ) -> None:
        """A newer fleet value is learnt: grant and count by its number. Grants and leases of before run to their end.

        Args:
            electors: of that value.
            terms: what its leases hang on.
            number: of that value.
            lease_s: of that value.
            standing: {task: its newest value here}; empty when this node is no elector.
            guard_lease_s: the longest lease that may still run, by that value; it changes within a number, too.
        """
        self.guard_lease_s = guard_lease_s
        if (terms, number) == (self.terms, self.number):
            return
        self.terms, self.number, self.electors, self.lease_s = terms, number, electors, lease_s
        self._others.clear()
        for granter in self._granters.values():
            granter.lease_s = lease_s  # a grant of before is remembered with its own length
        for holder in self._holders.values():
            holder.count_with(electors, lease_s)
        self._grants = bool(standing)  # what was granted before stays remembered
        if standing:
            self.standing = standing
        for task, value in standing.items():
            if task not in self._granters and value is not None and value.leased:
                self._watch(task, value.owner, math.inf if self.is_in_doubt else self.over_at)

    def on_tasks(self, standing: Mapping[TaskId, Allocation | None], now: float) -> None:
        """Another fleet is in force: grant leases of its exclusive tasks. Electors and the lease's length are the same.

        Args:
            standing: as at the start, by the tasks of the fleet.
            now: monotonic seconds. What an earlier time here may have granted of a task that comes is over in a lease,
                the longest that may still run. By today's length two owners could meet: a lease is granted, made
                shorter for the fleet, and its task removed and created again, all before that lease has ended.
        """
        self.standing, self._grants = standing, bool(standing)
        leased = {task.name for task in self.in_force.fleet.tasks if task.exclusive}
        leased |= {task for task, value in standing.items() if value is not None and value.leased}
        until = math.inf if self.is_in_doubt else now + hold_s(max(self.lease_s, self.granted_s, self.guard_lease_s))
        kept = leased | {task for task, value in standing.items() if _is_first(value)}  # it waits for the one before
        for task in [task for task in self._granters if task not in kept or task not in standing]:
            del self._granters[task]
        for task, value in standing.items():
            if task in leased and task not in self._granters:
                self._watch(task, None if value is None else value.owner, until)
            elif task in leased:
                self._granters[task].is_for_first = False
        # Who asks for a task that has gone has let its granter go, too: each release would be in all beats for ever.
        self._releases = {task: release for task, release in self._releases.items() if task in leased}

    # --- electors ----------------------------------------------------------------------------------------------------

    def may_accept(self, task: TaskId, owner: NodeId | None, now: float) -> bool:
        """Whether this elector may accept a value with ``owner`` now (always, for tasks that are not exclusive)."""
        granter = self._granters.get(task)
        return granter is None or granter.may_accept(owner, now)

    def on_newer_value(self, value: Allocation) -> None:
        """A newer revision was accepted or learnt."""
        granter = self._granters.get(value.task)
        if granter is not None and granter.is_for_first and value.owner is not None and not value.leased:
            # A majority has waited: the generation before has no lease any more, and this task never had one.
            del self._granters[value.task]
        elif granter is not None:
            granter.is_for_first = granter.is_for_first and not value.leased
            granter.on_newer_value()
        elif value.leased and value.task in self.standing:
            # Not leased until now: nothing was granted.
            self._watch(value.task, None, math.inf if self.is_in_doubt else -math.inf)

    def is_news(self, remembered_s: float) -> bool:
        """Whether this elector's grants may be longer than its state file says: the file must be written first."""
        return bool(self._granters) and remembered_s < self.lease_s

    def to_remember_s(self, now: float) -> float:
        """The longest lease of a grant of this elector, or of its life before, for its next life."""
        own_s = max((self.lease_s, *(granter.longer_s(now) for granter in self._granters.values())))
        return own_s if now >= self.now + hold_s(self.granted_s) else max(own_s, self.granted_s)

    def stop_granting(self) -> None:
        """This node is no elector any more: its grants run out."""
        self._granters.clear()
        self.standing = {}

    # --- owners ------------------------------------------------------------------------------------------------------

    def begin(self, task: TaskId, epoch: int, first_number: int) -> None:
        """This node learnt that it owns the task in ``epoch``; ``first_number`` is its next beat's."""
        if task in self._holders and self._holders[task].epoch == epoch:
            return
        self._holders[task] = Holder(
            task=task,
            epoch=epoch,
            me=self.me,
            incarnation=self.incarnation,
            electors=self.electors,
            lease_s=self.lease_s,
            first_number=first_number,
        )
        self._releases.pop(task, None)

    def end(self, task: TaskId, number: int) -> None:
        """Another owner was learnt: give back everything that this node still holds."""
        holder = self._holders.pop(task, None)
        if holder is not None:
            self._releases[task] = holder.release(number)

    def until(self, task: TaskId) -> float:
        """When this node's lease of the task ends; minus infinity without one."""
        holder = self._holders.get(task)
        return -math.inf if holder is None or self.is_in_doubt else holder.lease_until()

    @property
    def is_holding(self) -> bool:
        """Whether this node owns an exclusive task."""
        return bool(self._holders)

    def leaving(self) -> tuple[TaskId, ...]:
        """Tasks whose worker here must stop and has not yet."""
        return tuple(task for task, holder in self._holders.items() if holder.is_leaving)

    def on_given(self, task: TaskId, until: float) -> None:
        """The worker of a task that this node holds is told that it may work until ``until``."""
        self._holders[task].given_until = until

    def given_until(self, task: TaskId) -> float:
        """The end of the worker's permission to work; minus infinity without one."""
        holder = self._holders.get(task)
        return -math.inf if holder is None else holder.given_until

    def on_told_to_stop(self, task: TaskId) -> None:
        """The worker of a task is told to stop; where this node holds the task, it will report its stop."""
        if task in self._holders:
            self._holders[task].awaits_report = True

    def on_worker_lost(self, task: TaskId) -> None:
        """The worker's process has ended; the next one may get leases before that end is reported."""
        if task in self._holders:
            self._holders[task].expects_late_report = True

    def on_stopped(self, task: TaskId, epoch: int, number: int) -> bool:
        """The worker reports that it has stopped: give everything back; false when no electors asked for it.

        False, too, when this may be the late report of an earlier stop in this epoch, or of a dead process, or was made
        before the worker was told to stop. The worker may be working again, so `on_run_out` decides.
        """
        holder = self._holders.get(task)
        if holder is None or holder.epoch != epoch or not holder.is_leaving or holder.expects_late_report:
            return False
        if holder.given_until > -math.inf and not holder.awaits_report:
            return False  # it waited behind the beat that asks us to leave, so no stop was ordered between the two
        holder.awaits_report = False
        self._releases[task] = holder.release(number)
        return True

    def on_run_out(self, task: TaskId, number: int, now: float) -> bool:
        """A leaving worker's last permission is over: give everything back. Whether that needs a beat at once.

        It does when the worker was given something since the last time; otherwise only now and then. Two owners, each
        an elector that asks the other one to leave, would otherwise answer every beat with a beat.
        """
        holder = self._holders.get(task)
        if holder is None or not holder.is_leaving:
            return False
        was_given = holder.given_until > -math.inf or holder.awaits_report
        holder.expects_late_report |= holder.awaits_report
        holder.awaits_report = False  # when it comes, it is of a stop that is over
        self._releases[task] = holder.release(number)
        if was_given:
            return True
        if now - holder.hurried_at < HURRY_S:
            return False
        holder.hurried_at = now
        return True

    # --- beats -------------------------------------------------------------------------------------------------------

    def on_sent(self, number: int, now: float) -> BeatParts:
        """This node's beat ``number`` leaves: its parts about leases."""
        for holder in self._holders.values():
            holder.on_sent(number, now)
        echoes = [granter.echo(now) for granter in self._granters.values()] if self._grants else []
        asked = [granter.asked_to_leave(now) for granter in self._granters.values()]
        return BeatParts(
            echoes=tuple(echo for echo in echoes if echo is not None),
            released=tuple(self._releases.values()),
            asked_to_leave=tuple(ask for ask in asked if ask is not None),
        )

    def on_beat(
        self, beat: Beat, accepted: Mapping[TaskId, tuple[NodeId, int]], now: float, *, is_newest: bool = True
    ) -> bool:
        """A beat came, or our own left: grant, count echoes, note who must leave. Whether to beat at once."""
        is_new = False
        for task, granter in self._granters.items():
            owned = accepted.get(task) if self._grants and self._counts_like_us(beat) else None
            is_new |= granter.on_beat(beat, owned, now, is_newest=is_newest)
        if beat.lease_terms == self.terms:
            self._others.pop(beat.node, None)
        else:
            self._others[beat.node] = beat.lease_terms
        is_counted = beat.lease_terms == self.terms and self._counts_like_us(beat)
        for grant in beat.echoes if is_counted else ():
            if grant.task in self._holders:
                self._holders[grant.task].on_echo(beat.node, grant)
        for task, owner, epoch in beat.asked_to_leave:
            holder = self._holders.get(task)
            if holder is not None and owner == self.me and epoch == holder.epoch:
                holder.ask()
        return is_new

    def unfit(
        self,
        candidates: Iterable[NodeId] = (),
        without_state: AbstractSet[NodeId] = frozenset(),
        are_apart: Callable[[NodeId, NodeId], bool] = lambda _node, _elector: False,
    ) -> dict[NodeId, Veto]:
        """{node: why it could never hold a valid lease}.

        Args:
            candidates: those of them are told, too, that too few electors can grant anything.
            without_state: electors that grant nothing.
            are_apart: whether a candidate and an elector do not hear each other, as far as is known here.
        """
        granting = [name for name in self.electors if name not in self._others and name not in without_state]
        if not self._grants or self.is_in_doubt:
            granting = [name for name in granting if name != self.me]
        needed, few = majority(len(self.electors)), {}
        for node in candidates:
            count = sum(not are_apart(node, elector) for elector in granting)
            if count < needed:
                why = f"too few electors can give it a lease ({count} of {len(self.electors)})"
                few[node] = Veto(Filter.LEASE, why)
        return few | {
            node: IN_DOUBT
            if terms.endswith(_IN_DOUBT)
            else Veto(Filter.TERMS, f"goes by other leases ({terms or 'it does not say'}, here {self.terms})")
            for node, terms in self._others.items()
        }

    def next_deadline(self, now: float) -> float:
        """When an elector may accept a refused value, or a leaving owner's lease ends."""
        due = math.inf
        for granter in self._granters.values():
            due = min(due, granter.next_deadline(now))
        for holder in self._holders.values():
            if holder.is_leaving and holder.given_until > now:
                due = min(due, holder.given_until)
        return due
