"""EXECUTOR: carries a committed allocation out: the worker's role here, and the handover of this robot's streams.

Knows: the handover's table, its deadlines, who is predecessor. Does not know: how streams or workers work, and why the
task moves.

Handover on a robot, make before break. A legal step is a line of this table; every prefix leaves the streams whole:

===========  =======================================  ============================================  ===========
in           when                                     do                                            then
===========  =======================================  ============================================  ===========
any          a newer epoch is learnt                  plan PREPARE: the new slot opens, the old     PREPARING
                                                      one still carries
PREPARING    the new owner's worker is ready          plan FLIP: kept values, switch, end markers   FLIPPING
FLIPPING     the relay flipped, an old slot is left   (the old slots drain)                         DRAINING
FLIPPING     the relay flipped, none is left          plan CLOSE                                    SETTLED
FLIPPING     the first flip since this daemon began:  (that slot drains)                            DRAINING
             the relay still has a slot of before
DRAINING     the last old slot drained, or its drain  plan CLOSE: every old slot is dropped         SETTLED
             time is over
any          an old slot drained                      (the next plan does not name it)              as before
any          an old slot's drain time is over, or     the same plan without that slot               as before
             its owner is gone
any          isolated (`on_isolation: local`)         the worker here is active; plan PREPARE of    PREPARING
                                                      a slot to this robot itself, the other
                                                      one is closed
PREPARING..  the owner is back (`rejoin`)             the worker here is idle; plan PREPARE of the  PREPARING
(local)                                               owner's slot, the local one is closed
===========  =======================================  ============================================  ===========

An abort is never local: while the new owner does not get ready the old slot stays open, and giving up on it is a new
proposal. The old slots are called predecessors. When the task moves again before a slot has drained, there are several:
the newest carries until the next flip, and the others go on to drain, each within its own drain time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

from zsched.core.route.route import plan_for, slot_for
from zsched.core.values.fleet import OnIsolation, Standby, TaskSpec, runs_worker
from zsched.core.values.instructions import ApplyRoutes, EndTask, RecordStory, SetRole, StartWorker, StopWorker
from zsched.core.values.model import Allocation, NodeId, NodeKind
from zsched.core.values.plan import DrainingSlot, Role, Route, RoutePhase, RoutePlan, Slot, WorkerRole
from zsched.core.values.struct import Struct, replace
from zsched.core.values.todo import ToDo
from zsched.core.values.words import shown

ROLE_DRAIN_MARGIN_S = 1.0
"""The old owner's worker goes idle this much after the robots' drain time (a cold standby's start comes on top).

A cold one is stopped then, also where it had to go idle at once: until then it is asked for its state.
"""
MAX_OLD = 3
"""Predecessors that are kept: a plan has to fit into a frame (`zsched.core.values.codec`)."""
LEAVES_S = 1.0
"""A worker that has drained, or that is ready only now, learns within this time that it is idle."""
HEARS_S = 5.0
"""A worker that another relay sees has heard from it within this time that it is idle; a busy one hears it late."""
BEGUN_S = 10.0
"""A worker that is ready has begun with its epoch so long after it was chosen: it waits 2 s for a state by default."""


class Phase(StrEnum):
    """How far this node's handover is."""

    IDLE = "idle"  # no owner yet, or this node has no streams of the task
    PREPARING = "preparing"
    FLIPPING = "flipping"
    DRAINING = "draining"
    SETTLED = "settled"


class _Old(Struct, frozen=True):
    """A slot that another one follows, or will: a predecessor."""

    slot: Slot
    until: float = math.inf
    """When its drain time is over; infinity while it carries."""

    @property
    def is_left(self) -> bool:
        """Whether the relay has flipped to a newer slot."""
        return self.until < math.inf


@dataclass(slots=True)
class Executor:
    """One task's handover and role on one node."""

    spec: TaskSpec
    me: NodeId
    has_streams: bool
    """Robots have; edges only have workers."""
    phase: Phase = Phase.IDLE
    epoch: int = 0
    owner: NodeId | None = None
    role: Role = field(init=False)
    is_leased: bool = False
    """The worker here may work only under a lease: the task is exclusive by this node's file, or for everybody."""
    is_local: bool = False
    """This robot is cut off from owner and quorum and works alone; its output is degraded."""
    _unleased_epoch: int | None = None
    """The epoch in which the worker here worked without a lease; ``None`` once it has confirmed its end."""
    _leaves_until: float = -math.inf
    """Until when a worker learns that it is idle that has drained, and so has left its epoch, or is ready only now."""
    _may_have_said: bool = False
    """Another relay sees the worker since it was told to leave: the end of its role may be lost with the one before."""
    _has_told: bool = False
    """The worker here has been told a role."""
    _is_owner_gone: bool = False
    """The owner went during its epoch and is not back: nobody asks for its worker's snapshot."""
    _predecessor: NodeId | None = None
    """Whose worker is asked for the state that this node's epoch begins with, also by one that stops meanwhile."""
    _current: Slot | None = None
    _old: tuple[_Old, ...] = ()
    """The predecessors, the oldest first."""
    _may_inherit: bool = True
    """Until the first flip: the relay may carry what a former life of this daemon has opened, and this one not seen."""
    _role_deadline: float = math.inf
    started_at: float = 0.0
    """When the newest slot began to be prepared: a move's, this robot's own when it works alone, or the one back."""
    _is_move: bool = False
    """That slot is a move's."""
    switched_s: float | None = None
    """How long the newest move took here, from learning of it to the flip; ``None``: not flipped yet."""

    def __post_init__(self) -> None:
        self.role = Role(task=self.spec.name, role=WorkerRole.IDLE)
        self.is_leased = self.spec.exclusive

    @property
    def runs_worker(self) -> bool:
        """Whether this node keeps a worker of the task: by the file, or because its work here is not over."""
        return self._keeps_worker or self.role.role is not WorkerRole.IDLE

    @property
    def _keeps_worker(self) -> bool:
        return runs_worker(self.spec, self.me, NodeKind.ROBOT if self.has_streams else NodeKind.EDGE)

    @property
    def _is_cold(self) -> bool:
        """Whether the worker here runs only while it is needed."""
        return self.spec.worker.standby is Standby.COLD

    @property
    def served_by(self) -> NodeId | None:
        """Whose worker serves this robot's streams, or will: the owner's; its own while it works alone."""
        return self.me if self.is_local else self.owner

    @property
    def predecessors(self) -> tuple[NodeId, ...]:
        """The owners of the old slots while a handover runs, the oldest first."""
        return tuple(dict.fromkeys(old.slot.owner for old in self._old))

    @property
    def routes(self) -> tuple[Route, ...]:
        """The streams of the newest slot."""
        return () if self._current is None else self._current.routes

    def next_deadline(self) -> float:
        """When `tick` may have something to do; infinity when never."""
        if not self._old:
            return self._role_deadline
        return min((self._role_deadline, *(old.until for old in self._old)))

    def start(self, todo: ToDo) -> None:
        """The node starts: warm candidates start their worker."""
        if self.runs_worker and self.spec.worker.command and self.spec.worker.standby is Standby.WARM:
            todo.add(StartWorker(task=self.spec.name))

    # --- a changed fleet file ------------------------------------------------------------------------------------

    def on_spec(self, spec: TaskSpec, todo: ToDo, now: float, *, is_agreed_leased: bool) -> None:
        """Go by another version of the task's file: worker, right to work and streams follow it at once.

        The slots of predecessors stay as they were opened. ``is_agreed_leased``: the task is exclusive for everybody.
        """
        before, kept_worker = self.spec, self._keeps_worker
        was_leased = self.is_leased
        self.spec, self.is_leased = spec, spec.exclusive or is_agreed_leased
        if spec == before and self.is_leased is was_leased:
            return
        if spec.on_isolation is not OnIsolation.LOCAL:
            self.rejoin(todo, now)
        self._adopt_worker(before, todo, had_worker=kept_worker)
        if self.is_leased is not was_leased:
            self._change_terms(todo, now)
        self._adopt_routes(todo)

    def _adopt_worker(self, before: TaskSpec, todo: ToDo, *, had_worker: bool) -> None:
        worker, known = self.spec.worker, before.worker
        if self._keeps_worker and self.owner == self.me and self.role.role is WorkerRole.IDLE and not had_worker:
            self._take_up(None, todo)  # it was chosen by nodes that had this file before
        if (self._keeps_worker, worker.command, worker.standby) == (had_worker, known.command, known.standby):
            return
        if not self.runs_worker:
            todo.add(StopWorker(task=self.spec.name))
        elif worker.command and (worker.standby is Standby.WARM or self.role.role is not WorkerRole.IDLE):
            todo.add(StartWorker(task=self.spec.name))
        elif worker.command or known.command:
            todo.add(StopWorker(task=self.spec.name))

    def _adopt_routes(self, todo: ToDo) -> None:
        if self._current is None:
            return
        slot = slot_for(self.spec, self.me, self._current.owner, self._current.epoch)
        if slot == self._current:
            return
        self._current = slot
        todo.add(ApplyRoutes(plan=self._plan(slot, self._plan_phase)))
        text = "goes by the changed fleet file: streams that it does not touch run on"
        todo.add(RecordStory(stage="executor", text=text, task=self.spec.name, epoch=self.epoch))

    @property
    def _plan_phase(self) -> RoutePhase:
        """The phase of the newest plan."""
        phases = {Phase.PREPARING: RoutePhase.PREPARE, Phase.SETTLED: RoutePhase.CLOSE}
        return phases.get(self.phase, RoutePhase.FLIP)

    def end(self, todo: ToDo) -> None:
        """The task left the fleet file: its worker here stops, and its streams end."""
        if self.runs_worker:
            todo.add(SetRole(role=Role(task=self.spec.name, role=WorkerRole.IDLE)), StopWorker(task=self.spec.name))
        todo.add(EndTask(task=self.spec.name))
        story = "the fleet file does not name the task any more: its worker stops, its streams end"
        todo.add(RecordStory(stage="executor", text=story, task=self.spec.name, epoch=self.epoch))

    # --- learnt values -------------------------------------------------------------------------------------------

    def execute(self, allocation: Allocation, todo: ToDo, now: float) -> None:
        """Carry out a learnt allocation if its epoch is newer than the present one."""
        if allocation.owner is None or allocation.epoch < self.epoch:
            return
        was_leased, self.is_leased = self.is_leased, self.spec.exclusive or allocation.leased
        if allocation.epoch == self.epoch:
            if self.is_leased is not was_leased:
                self._change_terms(todo, now)
            return
        self._end_local(todo, now)  # the local slot closes before a committed owner's opens
        before = None if self._is_owner_gone else self.owner
        self.epoch, self.owner, self.started_at, self._is_owner_gone = allocation.epoch, allocation.owner, now, False
        self._is_move, self.switched_s = True, None
        self._change_role(allocation, before, todo, now)
        self._prepare(allocation.owner, todo)

    def _change_role(self, allocation: Allocation, before: NodeId | None, todo: ToDo, now: float) -> None:
        if not self.runs_worker:
            return
        if allocation.owner == self.me:
            self._take_up(before, todo)
        elif self.role.role is WorkerRole.ACTIVE and self.is_leased:
            # The new owner may be working already: nothing of the old epoch may leave any more.
            self._role_deadline = self._over_at(now) if self._is_cold else now
            self.leave(todo)
        elif self._is_cold and before == self.me and self.role.role is WorkerRole.IDLE:
            self._role_deadline = self._over_at(now)  # it left before the commit, as the electors asked
        elif self.role.role is WorkerRole.ACTIVE:
            self._role_deadline = self._over_at(now)
            # One that hears of its epoch only now begins it with its predecessor's state all the same.
            self._become(replace(self.role, role=WorkerRole.DRAINING, lease_until_s=None), todo)
        elif not self._has_told:
            self._become(self.role, todo)  # a standby that hears nothing asks again and again

    def _over_at(self, now: float) -> float:
        """When a worker here that loses the task now has no part in the move any more."""
        # A cold new owner only starts its worker now: until it is ready the robots stay here, and then it asks for the
        # state.
        starts_s = self.spec.worker.start_deadline_s if self._is_cold else 0.0
        return now + starts_s + self.spec.drain_s + ROLE_DRAIN_MARGIN_S

    def _take_up(self, before: NodeId | None, todo: ToDo) -> None:
        """The worker here is the owner's from now on; ``before``: whose was, ``None`` where nobody is to be asked."""
        self._role_deadline = math.inf
        self._predecessor = None if before == self.me else before
        role = Role(
            task=self.spec.name,
            role=WorkerRole.ACTIVE,
            epoch=self.epoch,
            # An exclusive task's worker may run at once, but works only from its first lease on.
            lease_until_s=0.0 if self.is_leased else None,
            predecessor=self._predecessor,
        )
        self._wake_worker(role, todo)
        self._become(role, todo)

    def _become(self, role: Role, todo: ToDo) -> None:
        """Change the role; remember a role without a lease until the worker has stopped."""
        self.role, self._has_told = role, True
        if role.role is WorkerRole.ACTIVE:
            self._may_have_said = False
        if role.role is WorkerRole.ACTIVE and role.lease_until_s is None:
            self._unleased_epoch = role.epoch
        todo.add(SetRole(role=role))
        if role.role is WorkerRole.IDLE and not self._keeps_worker:
            todo.add(StopWorker(task=self.spec.name))  # it stayed for this work only

    def _change_terms(self, todo: ToDo, now: float) -> None:
        """The owner stays, but its worker needs a lease from now on, or no longer needs one."""
        if self.is_local:
            self.rejoin(todo, now)  # whoever works alone needed no lease until now
        elif self.owner == self.me and self.runs_worker:
            if self.is_leased:
                self.leave(todo)  # it works again with its first lease
            else:
                came_from = self._predecessor
                role = Role(task=self.spec.name, role=WorkerRole.ACTIVE, epoch=self.epoch, predecessor=came_from)
                self._wake_worker(role, todo)
                self._become(role, todo)

    def on_role_ended(self, epoch: int, todo: ToDo) -> None:
        """The worker says that it has left ``epoch``; this counts only after the order to leave.

        Without one, a worker has ended that worked in it, so it had its predecessor's state. The next one must not have
        it again: it is older than what was done since.
        """
        if epoch == self._unleased_epoch:
            self._confirm()
        self._forget_predecessor(epoch, todo)

    def _forget_predecessor(self, epoch: int, todo: ToDo) -> None:
        if epoch == self.epoch:
            self._predecessor = None
        if epoch == self.role.epoch and self.role.predecessor is not None:
            self._become(replace(self.role, predecessor=None), todo)

    def on_worker_ended(self, todo: ToDo, now: float, *, was_ready: bool = False) -> None:
        """The worker's process has ended, and its former role with it.

        ``was_ready``: until now. While no relay runs nobody tells that it worked in its epoch, as one does that is
        ready for so long.
        """
        self._confirm()
        if was_ready and now - self.started_at >= BEGUN_S:
            self._forget_predecessor(self.epoch, todo)

    def on_worker_ready(self, now: float) -> None:
        """The worker is ready only now: until then it shows no epoch, so it does not say that it has left one.

        It may have begun by what it was told before.
        """
        before = self._unleased_epoch
        self._confirm()
        if self._unleased_epoch != before:
            self._leaves_until = now + LEAVES_S

    def on_worker_seen(self, now: float) -> None:
        """Another relay sees the worker, which was ready all the time; it is told its role by that.

        What it has said of its role's end may be lost with the relay before, and is not said again.
        """
        self._may_have_said = self.role.role is not WorkerRole.ACTIVE
        self._confirm_unsaid(now)

    def _confirm_unsaid(self, now: float) -> None:
        if self._may_have_said and self.role.role is WorkerRole.IDLE and self._unleased_epoch is not None:
            self._confirm()
            self._leaves_until = max(self._leaves_until, now + HEARS_S)

    def _confirm(self) -> None:
        """Nobody works in the epoch without a lease any more, unless the worker here may: it was told nothing since."""
        if self.role.role is not WorkerRole.ACTIVE or self.role.epoch != self._unleased_epoch:
            self._unleased_epoch = None

    def may_work_unleased(self, now: float) -> bool:
        """Whether the worker here may be working without a lease: it may, or it has not confirmed its stop."""
        is_let = self.role.role is not WorkerRole.IDLE and self.role.lease_until_s is None
        return is_let or self._unleased_epoch is not None or now < self._leaves_until

    @property
    def is_finishing(self) -> bool:
        """Whether the worker here may still do what it had in work for its last epoch."""
        return self.role.role is WorkerRole.DRAINING and self._unleased_epoch is not None

    def isolate(self, todo: ToDo, now: float) -> None:
        """Owner and quorum are out of reach: this robot's own worker serves its streams."""
        may_work = self.spec.on_isolation is OnIsolation.LOCAL and not self.is_leased
        can = self.has_streams and may_work and self.epoch > 0
        if self.is_local or not can or self.owner == self.me:
            return
        self.is_local, self._old, self._role_deadline = True, (), math.inf
        self.started_at, self._is_move = now, False
        role = Role(task=self.spec.name, role=WorkerRole.ACTIVE, epoch=self.epoch)
        self._wake_worker(role, todo)
        self._become(role, todo)
        self._current = slot_for(self.spec, self.me, self.me, self.epoch)
        self._go(Phase.PREPARING, RoutePhase.PREPARE, f"cut off from {self.owner}: works alone (degraded)", todo)

    def rejoin(self, todo: ToDo, now: float) -> None:
        """The committed owner is heard again: go back to its slot."""
        if not self.is_local or self.owner is None:
            return
        self._end_local(todo, now)
        self.started_at, self._is_move = now, False
        self._current = slot_for(self.spec, self.me, self.owner, self.epoch)
        self._go(Phase.PREPARING, RoutePhase.PREPARE, f"back to {self.owner}", todo)

    def _end_local(self, todo: ToDo, now: float) -> None:
        if not self.is_local:
            return
        if self._is_cold:
            self._role_deadline = now  # nobody asks for its state: it is stopped, unless it is the owner's from now on
        self.is_local, self._current, self.phase = False, None, Phase.IDLE
        self._become(Role(task=self.spec.name, role=WorkerRole.IDLE), todo)

    def set_lease(self, until_s: float, todo: ToDo, now: float) -> None:
        """Exclusive tasks: this node's worker may work until ``until_s`` (again, after it had to stop)."""
        if self.owner != self.me or until_s <= now or until_s == self.role.lease_until_s:
            return
        role = Role(
            task=self.spec.name,
            role=WorkerRole.ACTIVE,
            epoch=self.epoch,
            lease_until_s=until_s,
            predecessor=self._predecessor,
        )
        self._become(role, todo)

    def leave(self, todo: ToDo) -> None:
        """Exclusive tasks: another owner waits, so the worker stops now, before the commit."""
        if self.role.role is WorkerRole.IDLE:
            return
        self._become(Role(task=self.spec.name, role=WorkerRole.IDLE), todo)
        todo.add(RecordStory(stage="executor", text="the worker stops", task=self.spec.name, epoch=self.epoch))

    def _wake_worker(self, role: Role, todo: ToDo) -> None:
        """An owner's worker must run, also a cold standby."""
        if role.role is WorkerRole.ACTIVE and self.spec.worker.command:
            todo.add(StartWorker(task=self.spec.name))

    def _prepare(self, owner: NodeId, todo: ToDo) -> None:
        if not self.has_streams:
            return
        if self._current is not None and self.phase in (Phase.FLIPPING, Phase.DRAINING, Phase.SETTLED):
            self._old = (*self._old, _Old(self._current))[-MAX_OLD:]
        self._current = slot_for(self.spec, self.me, owner, self.epoch)
        self._go(Phase.PREPARING, RoutePhase.PREPARE, f"prepares {owner}", todo)

    def _go(self, phase: Phase, plan: RoutePhase | None, text: str, todo: ToDo, took_s: float | None = None) -> None:
        self.phase = phase
        if plan is not None and self._current is not None:
            todo.add(ApplyRoutes(plan=self._plan(self._current, plan)))
        story = RecordStory(stage="executor", text=text, task=self.spec.name, epoch=self.epoch, took_s=took_s)
        todo.add(story)

    def _plan(self, current: Slot, phase: RoutePhase) -> RoutePlan:
        return plan_for(self.spec, phase, current, tuple(old.slot for old in self._old))

    def on_ready(self, epoch: int, todo: ToDo) -> None:
        """The relay sees the new owner's worker ready for the slot of ``epoch``."""
        if epoch == self.epoch and self.phase is Phase.PREPARING:
            self._go(Phase.FLIPPING, RoutePhase.FLIP, f"flips to {self.served_by}", todo)

    def on_flipped(
        self, epoch: int, replayed: int, todo: ToDo, now: float, draining: tuple[DrainingSlot, ...] = ()
    ) -> None:
        """The relay switched every stream to the slot of ``epoch``, and has those that are ``draining`` still."""
        if epoch != self.epoch or self.phase is not Phase.FLIPPING:
            return
        self._inherit(draining, now)
        lasted_s = now - self.started_at
        took_s = lasted_s if self._is_move else None
        if self._is_move:
            self.switched_s = took_s
        done = f"flipped to {self.served_by} in {lasted_s * 1000:.0f} ms, {replayed} kept values replayed"
        if not self._old:
            self._go(Phase.SETTLED, RoutePhase.CLOSE, done, todo, took_s)
            return
        drained_by = now + self.spec.drain_s
        self._old = tuple(old if old.is_left else replace(old, until=drained_by) for old in self._old)
        self._go(Phase.DRAINING, None, f"{done}; {', '.join(self.predecessors)} drains", todo, took_s)

    def _inherit(self, draining: tuple[DrainingSlot, ...], now: float) -> None:
        """Take over the slots that a former life of this daemon has left, or was about to leave; they drain as ever.

        Only at the first flip: later this daemon has opened each slot itself, and dropped some.
        """
        may_inherit, self._may_inherit = self._may_inherit, False
        if not may_inherit or self.is_local:
            return
        known = {old.slot.epoch for old in self._old}
        before = (one for one in draining if one.epoch < self.epoch and one.epoch not in known)
        inherited = tuple(
            _Old(
                slot_for(self.spec, self.me, one.owner, one.epoch),
                until=now + max(0.0, self.spec.drain_s - one.since_s),
            )
            for one in before
        )
        self._old = tuple(sorted((*inherited, *self._old), key=lambda old: old.slot.epoch))[-MAX_OLD:]

    def on_drained(self, epoch: int, todo: ToDo) -> None:
        """The old slot of ``epoch`` has given back everything."""
        drained = tuple(old for old in self._old if old.slot.epoch == epoch and old.is_left)
        if not drained:
            return
        text = f"{drained[0].slot.owner} drained"
        if self._forget(drained):
            self._close(text, todo)
        else:
            self._go(self.phase, None, text, todo)

    def on_gone(self, node: NodeId, todo: ToDo) -> None:
        """A peer is gone: nothing more comes from its slots, and the worker here waits no longer for its state."""
        self._is_owner_gone = self._is_owner_gone or node == self.owner
        if self._predecessor == node:
            self._predecessor = None
        if self.role.predecessor == node:
            self._become(replace(self.role, predecessor=None), todo)
        self._drop(tuple(old for old in self._old if old.slot.owner == node), f"{node} is gone", todo)

    def on_back(self, node: NodeId) -> None:
        """A peer is heard again: the owner's worker can be asked for its state, of a new life of that node, too.

        What a worker has that its daemon has started again is the task's state since then.
        """
        if node == self.owner:
            self._is_owner_gone = False

    def _drop(self, dropped: tuple[_Old, ...], why: str, todo: ToDo) -> None:
        if not dropped:
            return
        if self._forget(dropped):
            self._close(why, todo)
            return
        plan = RoutePhase.PREPARE if self.phase is Phase.PREPARING else RoutePhase.FLIP
        epochs = ", ".join(str(shown(old.slot.epoch)) for old in dropped)
        self._go(self.phase, plan, f"drops the slot of epoch {epochs}: {why}", todo)

    def _forget(self, gone: tuple[_Old, ...]) -> bool:
        """Drop predecessors; whether the handover then waits for nothing more."""
        self._old = tuple(old for old in self._old if old not in gone)
        return self.phase is Phase.DRAINING and not self._old

    def _close(self, text: str, todo: ToDo) -> None:
        self._go(Phase.SETTLED, RoutePhase.CLOSE, f"settled on {self.owner}: {text}", todo)

    def tick(self, todo: ToDo, now: float) -> None:
        """Time has passed."""
        late = tuple(old for old in self._old if now >= old.until)
        self._drop(late, f"drain time of {self.spec.drain_s:g} s over", todo)
        if now >= self._role_deadline:
            self._role_deadline = math.inf
            if self.role.role is WorkerRole.DRAINING:
                self._leaves_until = now + LEAVES_S
            self._become(Role(task=self.spec.name, role=WorkerRole.IDLE), todo)
            self._confirm_unsaid(now)
            if self._is_cold:
                todo.add(StopWorker(task=self.spec.name))
