"""Stand-ins for workers and relays on simulated machines: they start, get ready, flip, drain and stop in fixed times.

Knows: what supervisor, relay and worker report back, and when an exclusive worker may be working. Does not know: who
decides that, or how streams really move.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any, Protocol

from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import Role, RoutePhase, RoutePlan, WorkerRole
from zsched.core.values.profile import WorkerState
from zsched.core.values.struct import replace
from zsched.core.values.words import Trouble
from zsched_lab.sim.checks import Invariants
from zsched_lab.sim.parts import Machine

WORKER_START_S = 0.4
COMPARED_S = 0.01
"""A supervisor has compared its processes this long after it heard of another file."""
FLIP_S = 0.005
WORKER_STOP_S = (0.002,)
LOOK_AGAIN_S = 0.05
SHOWN_S = 0.005


def _is_free(role: Role) -> bool:
    """Whether a worker of this role works without a lease."""
    return role.role is not WorkerRole.IDLE and role.lease_until_s is None


class World(Protocol):
    """What workers and relays need of the simulator."""

    now: float
    rng: Random
    machines: dict[str, Machine]
    invariants: Invariants

    def later(self, seconds: float, action: Callable[..., None], *arguments: Any) -> None:
        """Do something ``seconds`` from now."""

    def deliver(self, machine: Machine, event: ev.Event) -> None:
        """An event reaches a machine."""

    def has_streams(self, source: Machine, target: Machine) -> bool:
        """Whether the data session of one machine reaches the other's."""


class Work:
    """All workers and relays of one simulated fleet."""

    def __init__(self, sim: World) -> None:
        self._sim = sim
        self.plans: dict[tuple[NodeId, TaskId], RoutePlan] = {}
        self.working: dict[TaskId, tuple[NodeId, float]] = {}
        """{exclusive task: (who works, until when at most)}."""
        self._free: set[tuple[str, TaskId]] = set()
        """(machine, task) of the workers that work without a lease, or have not stopped yet."""
        self._begun: Counter[tuple[str, TaskId]] = Counter()
        """{(machine, task): how often its worker was made active}: one that is again before it has stopped works on."""
        self._absent: Counter[str] = Counter()
        """{machine: how many reasons the workers that somebody else runs there have to be away}."""
        self._showing: set[tuple[str, int, TaskId]] = set()
        """(machine, its life, task) of the workers that are ready, whether or not a daemon's loop has heard it yet."""
        self._made_by: dict[tuple[str, TaskId], tuple[str, ...]] = {}
        """{(machine, task): the command of its worker's process}."""
        self.stop_s: tuple[float, ...] = WORKER_STOP_S
        """What an exclusive worker may take to stop, one of these each time."""

    def do(self, machine: Machine, instruction: do.Instruction) -> None:
        """Carry out what concerns workers and relays; anything else is nobody's."""
        match instruction:
            case do.StartWorker(task=task):
                self._start(machine, task)
            case do.StopWorker(task=task):
                self._stop(machine, task)
            case do.RenewWorker(task=task):
                self._renew(machine, task)
            case do.AdoptFleet(fleet=fleet):
                self._compare(machine, fleet)
                self._look_again(machine)
                self.meet(machine)
            case do.EndTask(task=task):
                self.plans.pop((machine.name, task), None)
            case do.ApplyRoutes(plan=plan):
                self._apply(machine, plan)
            case do.SetRole(role=role):
                self._set_role(machine, role)
            case _:
                pass

    # --- workers -----------------------------------------------------------------------------------------------------

    def _start(self, machine: Machine, task: TaskId) -> None:
        if task not in machine.workers:
            machine.workers[task] = machine.life
            self._made_by[machine.key, task] = self._command(machine.fleet, task)
            self._sim.later(WORKER_START_S, self._ready, machine, task, machine.life)

    def _ready(self, machine: Machine, task: TaskId, life: int) -> None:
        if machine.life == life and task in machine.workers:
            self._showing.add((machine.key, life, task))
            self._sim.deliver(machine, ev.WorkerChanged(task=task, state=WorkerState.READY))
            for other in tuple(self._sim.machines.values()):
                self._show_later(machine, task, other)

    @staticmethod
    def _command(fleet: Fleet, task: TaskId) -> tuple[str, ...]:
        return next((one.worker.command for one in fleet.tasks if one.name == task), ())

    def _compare(self, machine: Machine, fleet: Fleet) -> None:
        """The supervisor compares its processes with a changed file; a thread's word comes a little later."""
        for task in machine.workers:
            is_old = self._made_by.get((machine.key, task)) != self._command(fleet, task)
            if is_old and self._command(fleet, task):
                told = ev.RecipeCompared(task=task, is_old=True)
                self._sim.later(COMPARED_S, self._sim.deliver, machine, told)

    def _renew(self, machine: Machine, task: TaskId) -> None:
        """A worker is stopped and started again."""
        if task in machine.workers:
            self._stop(machine, task)
            self._start(machine, task)
            self._sim.deliver(machine, ev.WorkerChanged(task=task, state=WorkerState.STARTING))
            self._sim.deliver(machine, ev.RecipeCompared(task=task, is_old=False))

    def meet(self, machine: Machine) -> None:
        """A daemon has started beside workers that somebody else runs, or its file has got tasks with such workers."""
        states = {} if machine.node is None else machine.node.worker_states
        for task in machine.fleet.tasks if not self._absent[machine.key] else ():
            if not task.worker.command and task.name in states:
                self._start(machine, task.name)

    def _look_again(self, machine: Machine) -> None:
        """A relay that is told to watch for a worker tells what it sees: one that ran on while nobody asked is there.

        The node has forgotten it with the task, or with its own place among the candidates (`zsched.relay.matching`).
        """
        states = {} if machine.node is None else machine.node.worker_states
        for task in machine.fleet.tasks:
            is_there = (machine.key, machine.life, task.name) in self._showing
            if not task.worker.command and is_there and states.get(task.name) is WorkerState.STOPPED:
                self._sim.deliver(machine, ev.WorkerChanged(task=task.name, state=WorkerState.READY))

    def leave(self, machine: Machine) -> None:
        """The workers that somebody else runs on a machine end, also those of tasks that its file names no more."""
        self._absent[machine.key] += 1
        for task in tuple(machine.workers):
            if not self._made_by[machine.key, task] and not self._command(machine.fleet, task):
                self._stop(machine, task)

    def come(self, machine: Machine) -> None:
        """They are back, unless there is another reason for them to be away."""
        self._absent[machine.key] -= 1
        self.meet(machine)

    def all_come(self) -> None:
        """There is no reason for any of them to be away any more."""
        for machine in tuple(self._sim.machines.values()):
            if self._absent.pop(machine.key, 0):
                self.meet(machine)

    # --- tokens ------------------------------------------------------------------------------------------------------

    def greet(self, machine: Machine) -> None:
        """A relay has started: it sees the tokens of all workers that it reaches."""
        for other in tuple(self._sim.machines.values()):
            for task in other.workers:
                if (other.key, other.life, task) in self._showing:
                    self._show_later(other, task, machine)

    def lose(self, source: Machine, target: Machine, delay_s: float = 0.0) -> None:
        """A link has ended, or the machine at its other end: the tokens behind it go, and come with the next link."""
        for task in source.workers if self._is_watching(target) else ():
            gone = ev.WorkerShown(
                node=source.name, task=task, incarnation=self._incarnation(source, source.life), is_present=False
            )
            self._sim.later(delay_s + SHOWN_S, self._sim.deliver, target, gone)
            self._show_later(source, task, target)

    @staticmethod
    def _incarnation(machine: Machine, life: int) -> str:
        """Of its workers. Of two machines of one name each shows tokens of its own: the end of one ends no other's."""
        return f"{life}-{machine.key}"

    @staticmethod
    def _is_watching(machine: Machine) -> bool:
        return machine.node is not None and machine.node.rounds.is_voter

    def _show_later(self, machine: Machine, task: TaskId, target: Machine) -> None:
        if machine is not target and self._is_watching(target):
            self._sim.later(SHOWN_S * 2, self._show, machine, machine.life, task, target, target.life)

    def _show(self, machine: Machine, life: int, task: TaskId, target: Machine, target_life: int) -> None:
        if (machine.life, target.life) != (life, target_life) or machine.node is None or task not in machine.workers:
            return
        if not self._sim.has_streams(machine, target):
            self._sim.later(LOOK_AGAIN_S, self._show, machine, life, task, target, target_life)
            return
        self._sim.deliver(
            target, ev.WorkerShown(node=machine.name, task=task, incarnation=self._incarnation(machine, life))
        )

    # --- ends --------------------------------------------------------------------------------------------------------

    def _stop(self, machine: Machine, task: TaskId) -> None:
        self._showing.discard((machine.key, machine.life, task))
        if machine.workers.pop(task, None) is not None:
            self._sim.deliver(machine, ev.WorkerChanged(task=task, state=WorkerState.STOPPED))

    def fail(self, machine: Machine, task: TaskId, *, is_final: bool) -> None:
        """A worker exits: started again by its supervisor, or (``is_final``) given up."""
        if machine.node is None or task not in machine.workers:
            return
        told = ev.WorkerChanged(task=task, state=WorkerState.FAILED, reason="exit code 1")
        if not is_final:
            told = replace(told, state=WorkerState.STARTING, trouble=Trouble.AGAIN, reason="restarting: exit code 1")
        self._sim.deliver(machine, told)
        if not is_final:
            self._sim.later(WORKER_START_S, self._ready, machine, task, machine.life)

    def mend(self, machine: Machine, task: TaskId, life: int) -> None:
        """The operator has put a worker right that was given up."""
        self._ready(machine, task, life)

    def _set_role(self, machine: Machine, role: Role) -> None:
        """The worker follows its role; an exclusive one works only under its lease, and says when it has stopped."""
        before = machine.roles.get(role.task)
        machine.roles[role.task] = role
        was_active = before is not None and before.role is WorkerRole.ACTIVE
        ends = was_active and role.role is not WorkerRole.ACTIVE
        is_freed = before is not None and _is_free(before) and not _is_free(role)
        # one time for both: it says that it has stopped when it has
        stop_s = self._sim.rng.choice(self.stop_s) if ends or is_freed else 0.0
        self._note_unleased(machine, before, role, stop_s)
        self._note_leased(machine, role)
        if role.role is WorkerRole.ACTIVE and not was_active:
            self._begun[machine.key, role.task] += 1
        if before is None or not ends:
            return
        begun = self._begun[machine.key, role.task]
        self._sim.later(stop_s, self._stopped, machine, machine.life, before, begun)

    def _note_leased(self, machine: Machine, role: Role) -> None:
        """A worker works until its lease ends, by its machine's clock."""
        until = 0.0 if role.lease_until_s is None else machine.clock.true(role.lease_until_s)
        if until > self._sim.now:
            self._sim.invariants.on_worked(machine, role, self._sim.now, until)
            self.working[role.task] = (machine.key, until)

    def _note_unleased(self, machine: Machine, before: Role | None, role: Role, stop_s: float = 0.0) -> None:
        """A worker that needs no lease works until it has heard that it is idle, or needs one."""
        sim = self._sim
        if _is_free(role):
            if before is None or not _is_free(before) or before.epoch != role.epoch:
                sim.invariants.on_worked(machine, role, sim.now, math.inf)
                self._free.add((machine.key, role.task))
        elif before is not None and _is_free(before):
            sim.later(stop_s, self._stopped_free, machine, machine.life, role.task)

    def _stopped_free(self, machine: Machine, life: int, task: TaskId) -> None:
        if machine.life == life and not _is_free(machine.roles[task]):
            self._free.discard((machine.key, task))
            self._sim.invariants.stop_working(machine, task, self._sim.now, life)

    def freeze(self, machine: Machine) -> None:
        """The machine stands still, and its workers with it."""
        for task in machine.roles:
            self._sim.invariants.stop_working(machine, task, self._sim.now, machine.life)

    def thaw(self, machine: Machine, lease_s: float) -> None:
        """It goes on: what is left of a lease by its own clock lies later in true time."""
        machine.late_until = machine.clock.local(self._sim.now) + lease_s
        for role in machine.roles.values():
            self._note_unleased(machine, None, role)
            self._note_leased(machine, role)

    def end(self, machine: Machine) -> None:
        """A daemon ends, and its workers with it; of one with a lease others cannot know."""
        for task in machine.roles:
            if (machine.key, task) in self._free:
                self._free.discard((machine.key, task))
                self._sim.invariants.stop_working(machine, task, self._sim.now, machine.life)

    def _stopped(self, machine: Machine, life: int, role: Role, begun: int) -> None:
        if machine.life != life:
            return
        if role.lease_until_s is not None and begun == self._begun[machine.key, role.task]:
            self._sim.invariants.stop_working(machine, role.task, self._sim.now, life)
            working = self.working.get(role.task)
            if working is not None and working[0] == machine.key:
                self.working[role.task] = (machine.key, min(working[1], self._sim.now))
        self._sim.deliver(machine, ev.RoleEnded(task=role.task, epoch=role.epoch))

    # --- relays ------------------------------------------------------------------------------------------------------

    def _apply(self, machine: Machine, plan: RoutePlan) -> None:
        self._sim.invariants.on_plan(machine, plan, self._sim.now)
        self.plans[machine.key, plan.task] = plan
        if plan.phase is RoutePhase.PREPARE:
            self._watch_ready(machine, plan, machine.life)
        elif plan.phase is RoutePhase.FLIP:
            self._sim.later(FLIP_S, self._flipped, machine, plan, machine.life)

    def _watch_ready(self, machine: Machine, plan: RoutePlan, life: int) -> None:
        """Report readiness once the owner's worker is up and reachable; ask again as long as the plan stands."""
        if machine.life != life or self.plans.get((machine.key, plan.task)) != plan or plan.current is None:
            return
        owner = self._sim.machines.get(plan.current.owner)
        node = None if owner is None else owner.node
        is_ready = node is not None and node.worker_states.get(plan.task) is WorkerState.READY
        if is_ready and owner is not None and self._sim.has_streams(owner, machine):
            self._sim.deliver(machine, ev.SlotReady(task=plan.task, epoch=plan.current.epoch))
            return
        self._sim.later(LOOK_AGAIN_S, self._watch_ready, machine, plan, life)

    def _flipped(self, machine: Machine, plan: RoutePlan, life: int) -> None:
        if machine.life != life or plan.current is None:
            return
        self._sim.deliver(machine, ev.SlotFlipped(task=plan.task, epoch=plan.current.epoch))
        for slot in plan.predecessors:
            owner = self._sim.machines.get(slot.owner)
            if owner is not None and owner.node is not None:
                self._sim.deliver(machine, ev.SlotDrained(task=plan.task, epoch=slot.epoch))
