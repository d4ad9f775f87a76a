"""Plays a history to one rule, in a closed loop: where the tasks are decides what the profiles show.

Knows: sampling, smoothing, publication, gathers without loss, bookings. Does not know: what a choice is worth.

On a machine that is short, a task's use is no longer its demand and readings end at the machine's size, so what is
seen depends on the owner of the task: every rule gets profilers and a gateway of its own. Every task has a rule of its
own; the tasks' rounds follow each other, and each sees the bookings of those before (`zsched.core.scheduler.turns`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Any, Final

from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import Standing, compare
from zsched.core.scheduler.usage import book
from zsched.core.values.events import WorkerJobs
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, NodeId, PeerState, TaskId, Tuning
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource, WorkerLoad, WorkerState
from zsched_lab.decisions.replay import TICKS, rounds
from zsched_lab.decisions.rules import Move, Rule
from zsched_lab.decisions.service.history import History, mask_of, rank_of
from zsched_lab.decisions.service.machines import Machine, Work
from zsched_lab.decisions.view import IDLE, START_S, Look, LostFor, Sight
from zsched_lab.decisions.world import DT_S

WIRED: Final = (LinkSample(source=LinkSource.WIRED),)


class Deadline(StrEnum):
    """What a task with a deadline is to have few of: the figures that a history counts (`Work`)."""

    MISSED = "missed"
    SLOW = "slow"


@dataclass(frozen=True, slots=True, kw_only=True)
class Player:
    """One rule in a comparison: how it looks at the fleet, what it scores by, and how it is made for a task."""

    name: str
    make: Callable[[Sight], Rule]
    tuning: Tuning
    """`zsched.core.scheduler.scoring.score` scores by it."""
    look: Look = Look()
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `TaskSpec` that it has otherwise."""
    is_told: bool = True
    """Machines tell when a worker's processes always want to run, as the kernel's run-queue delay does."""
    tells_jobs: bool = True
    """Workers tell of their jobs, as those do that use the library."""
    deadline: Deadline | None = None
    """``objective: latency``, with that one of each task's deadlines."""

    def tuning_of(self, work: Work) -> Tuning:
        """How a task is scored."""
        if self.deadline is None:
            return self.tuning
        within_s = work.deadline_s if self.deadline is Deadline.MISSED else work.slow_s
        return replace(self.tuning, deadline_ms=1e3 * within_s)


class Scene:
    """The fleet under one rule: the readings of its machines, the profiles, and the owner of each task."""

    def __init__(self, history: History, player: Player) -> None:
        timing = replace(history.fleet.timing, smoothing_s=max(player.look.smoothing_s, 1e-9))
        specs = tuple(
            replace(spec, tuning=player.tuning_of(work), **player.changes)
            for spec, work in zip(history.fleet.tasks, history.works, strict=True)
        )
        self.fleet = replace(history.fleet, timing=timing, tasks=specs)
        self.gateway = Gateway(InForce(self.fleet))
        self.values = {
            spec.name: Allocation(task=spec.name, revision=0, epoch=0, owner=None, tuning=spec.tuning) for spec in specs
        }
        self.states = dict.fromkeys((node.name for node in self.fleet.nodes), PeerState.ALIVE)
        self._history, self._is_told = history, player.is_told
        self._books = [_Book() for _ in specs] if player.tells_jobs else []
        self._column = {name: index for index, name in enumerate(specs[0].candidates)}
        self._placed: tuple[int | None, ...] = (None,) * len(specs)
        self._profilers = {node.name: Profiler(node.name, 1, timing) for node in self.fleet.nodes}
        self._ready = dict.fromkeys(self.values, WorkerState.READY)
        self._stretch = history.stretch.tolist()
        self._errors = tuple(
            error.tolist() for error in (history.cpu_error, history.memory_error, history.running_error)
        )
        self._spikes = [(below, values.tolist()) for below, values in history.spikes]
        self._shown = [
            [
                tuple(
                    getattr(there, name).tolist()
                    for name in ("cores_wanted", "memory_wanted", "cores", "memory", "service")
                )
                for there in by_mask
            ]
            for by_mask in history.on
        ]
        self._robots_every = round(timing.publish_s / DT_S)

    def step(self, index: int) -> None:
        """Every machine takes its reading of step ``index``; profiles that are due reach every robot."""
        now = START_S + index * DT_S
        for name, profiler in self._profilers.items():
            column = self._column.get(name)
            if column is None and index % self._robots_every:
                continue  # nothing ever changes at a robot
            if column is not None and self._books:
                self._tell_jobs(profiler, column, index, now)
            profiler.absorb(IDLE if column is None else self._device(column, index), WIRED, now)
            states = {} if column is None else self._ready
            profile = profiler.publishable(states, is_draining=False, now=now)
            if profile is not None:
                self.gateway.absorb(profile, now)

    def _device(self, column: int, index: int) -> DeviceSample:
        """What the device profiler reads: never more than there is."""
        machine, stretch = self._history.machines[column], self._stretch[index]
        cores_wanted, memory_wanted, cores, memory, _ = self._shown[column][mask_of(self._placed, column)]
        spike = self._spike(cores_wanted[stretch] / machine.cores, index, column)
        used = cores_wanted[stretch] + (self._errors[0][index][column] + spike) * machine.cores
        runs = self._errors[2][index][column] + spike * machine.cores
        used_mb = memory_wanted[stretch] + self._errors[1][index][column] * machine.memory_mb
        workers = []
        for task, name in enumerate(self.values):
            is_here = self._placed[task] == column
            rank = rank_of(self._placed, task) if is_here else 0
            mine = (cores[stretch][rank], memory[stretch][rank]) if is_here else (0.0, 0.0)
            work = self._history.works[task]
            needed = work.demand(machine) * self._history.activity[stretch, task]
            is_short = is_here and self._is_told and mine[0] < 0.99 * min(needed, work.processes)
            wanted = float(work.processes) if is_short else None
            workers.append(
                WorkerLoad(
                    task=name, state=WorkerState.READY, cpu_cores=mine[0], memory_mb=mine[1], wanted_cores=wanted
                )
            )
        return DeviceSample(
            cpu_cores=machine.cores,
            cpu_used_cores=min(max(used, 0.0), machine.cores),
            memory_mb=machine.memory_mb,
            memory_used_mb=min(max(used_mb, 0.0), machine.memory_mb),
            workers=tuple(workers),
            speed=machine.speed,
            runnable=max(cores_wanted[stretch] + runs, 0.0) if self._is_told else None,
        )

    def _spike(self, share: float, index: int, column: int) -> float:
        """What spikes add to a reading of a machine of which ``share`` is wanted."""
        return next((values[index][column] for below, values in self._spikes if share < below), 0.0)

    def _tell_jobs(self, profiler: Profiler, column: int, index: int, now: float) -> None:
        """What the workers here say of their jobs, as `zsched.worker` does."""
        machine, stretch = self._history.machines[column], self._stretch[index]
        _, _, cores, _, service = self._shown[column][mask_of(self._placed, column)]
        for task, (name, kept) in enumerate(zip(self.values, self._books, strict=True)):
            if self._placed[task] == column:
                rank, work = rank_of(self._placed, task), self._history.works[task]
                comes = float(self._history.activity[stretch, task])
                kept.work(work, machine, cores[stretch][rank], service[stretch][rank], comes)
                profiler.note_jobs(kept.report(name, self.values[name].epoch, now), now)

    def learn(self, now: float) -> None:
        """The robots note what the tasks use where they run."""
        for name, value in self.values.items():
            self.gateway.learn_demand(name, value.owner, now)

    def place(self, task: TaskId, owner: NodeId) -> None:
        """``task`` is at ``owner`` from the next step on."""
        value = self.values[task]
        self.values[task] = replace(value, owner=owner, epoch=value.epoch + 1)
        self._placed = tuple(
            None if value.owner is None else self._column[value.owner] for value in self.values.values()
        )


class _Book:
    """What a worker counts of its jobs: whole ones."""

    def __init__(self) -> None:
        self._done = self._undone = self._time_s = self._cpu_s = self._wait_s = 0.0
        self._is_serial = False

    def work(self, work: Work, machine: Machine, cores: float, service: float, comes: float) -> None:
        """One step with this many cores: of all jobs the share ``comes`` comes, and ``service`` of that is done."""
        cpu_s, served = work.cpu_s / machine.speed, min(service, 1.0)
        before = int(self._done)
        rate_hz = comes * work.rate_hz
        self._done += served * rate_hz * DT_S
        self._undone += (1.0 - served) * rate_hz * DT_S
        # A worker that does not do all of them is always at work.
        is_behind = served < 0.999
        time_s = 1.0 / max(served * rate_hz, 1e-3) if is_behind else cpu_s / work.processes
        is_starved = cores < 0.99 * min(comes * work.demand(machine), work.processes)
        self._is_serial = work.processes == 1
        done = int(self._done) - before
        self._time_s += done * time_s
        self._cpu_s += done * cpu_s
        self._wait_s += done * (max(time_s - cpu_s, 0.0) if is_starved else 0.0)

    def report(self, task: TaskId, life: int, now: float) -> WorkerJobs:
        """Of several processes nobody tells what they wait for. Jobs come evenly, so none waits for its turn."""
        return WorkerJobs(
            task=task,
            incarnation=str(life),
            at_s=now,
            done=int(self._done),
            skipped=int(self._undone),
            time_s=self._time_s,
            cpu_s=self._cpu_s,
            wait_s=self._wait_s if self._is_serial else None,
            age_s=self._time_s,
        )


class TaskView:
    """What the robots make of a scene for one task, by the core's scores."""

    def __init__(self, scene: Scene, spec: TaskSpec) -> None:
        self.fleet, self.gateway, self.spec = scene.fleet, scene.gateway, spec
        self._scene = scene
        self._seen: tuple[int, tuple[NodeId | None, ...]] | None = None
        self._standing: Standing | None = None

    def standing(self, now: float, allocation: Allocation | None = None, lost_for: LostFor | None = None) -> Standing:
        """The joint view of a gather now; computed again only when a profile has come or a task has moved."""
        del allocation, lost_for  # the scene has it; on cables everybody is reached
        seen = self.gateway.version, tuple(value.owner for value in self._scene.values.values())
        if self._standing is None or seen != self._seen:
            self._seen, self._standing = seen, self._compare(now)
        return self._standing

    def _compare(self, now: float) -> Standing:
        allocation = self._scene.values[self.spec.name]
        bookings = book(self.fleet.tasks, self._scene.values)
        voters = self.fleet.voters
        # All robots are on cables: what one of them makes of the profiles is what each of them makes of them.
        vector = score(self.spec, allocation, voters[0], self.gateway, self._scene.states, now, bookings)
        return compare(self.spec, allocation, {voter: replace(vector, voter=voter) for voter in voters})


def replay(history: History, player: Player, seed: int) -> list[list[Move]]:
    """The moves of every task under ``player``, in the order of ``history.works``."""
    scene = Scene(history, player)
    rules = {spec.name: player.make(TaskView(scene, spec)) for spec in scene.fleet.tasks}
    due = rounds(history.fleet, history.steps, seed)
    for tick in range(history.steps * TICKS):
        if tick % TICKS == 0:
            scene.step(tick // TICKS)
        at_s = tick * DT_S / TICKS
        now = START_S + at_s
        if due[tick]:
            scene.learn(now)
        for name, rule in rules.items():
            known = len(rule.moves)
            rule.round(due[tick], at_s, now)
            if len(rule.moves) > known:
                scene.place(name, rule.moves[-1].owner)
    return [rule.moves for rule in rules.values()]


def is_of_task(name: str) -> bool:
    """Whether `TaskSpec` has a field of that name that a player may change."""
    return name in {one.name for one in fields(TaskSpec)} - {"name", "candidates", "tuning", "rules", "worker"}
