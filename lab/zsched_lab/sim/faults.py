"""Plays one schedule: carries its faults out on a simulator, lets the fleet come to rest, says what was violated.

Knows: what each kind of fault does to machines and messages, and how it ends. Does not know: which faults a seed has
(`zsched_lab.sim.swarm`), what must hold after every event (`zsched_lab.sim.checks`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import lease_terms
from zsched.core.values.messages import CommandOutcome, TuneTask
from zsched.core.values.model import NodeId, Weights
from zsched.core.values.quorum import majority
from zsched.core.values.struct import replace
from zsched_lab.sim.checks import DisagreementError
from zsched_lab.sim.clocks import slew
from zsched_lab.sim.disk_faults import DiskFaults
from zsched_lab.sim.link_faults import SMALL_DELAY_S, LinkFaults
from zsched_lab.sim.links import Pair
from zsched_lab.sim.network import Weather
from zsched_lab.sim.orders import BY, Orders
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.rest import AT_MOST_S
from zsched_lab.sim.rollout import Rollouts
from zsched_lab.sim.scene import Carry, Scene
from zsched_lab.sim.simulator import CORES, Simulator
from zsched_lab.sim.status import TOLD_S, untrue
from zsched_lab.sim.swarm import Fault, Plan

BEYOND = "beyond what is promised"
"""How a schedule is counted in which nobody agrees any more because of votes that nobody can remember."""
EVENTS_PER_S = 500.0
"""A node handles about 50 a second; ten times that, on average over a whole schedule, is a storm."""
EVENTS_PER_TASK_S = 25.0
"""Each task adds this many. A node handles about 10 a second for a task that is voted on again after each fault."""
LOST_S = 3.0
"""A fleet that cannot agree is watched for this long before the operator starts it again."""
AFTERMATH_S = 1.0
"""What was under way when the faults ended has arrived."""
STOP_S = 0.8
"""What a daemon that was told to stop waits for its tasks to move."""
FEW_TASKS = 3
TURN_S = 1.0
"""Planned moves take turns: so much more each task beyond `FEW_TASKS` may take until the fleet is at rest."""
STOP_WORK_S = (0.002, 0.02, 0.1, 0.4)
"""Exclusive workers stop at once, or are slower than a commit's stagger, or slower than a whole ballot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """How one schedule went."""

    violation: str
    """Empty: none."""
    events: int
    revisions: int
    faults: Counter[str]
    """How often each fault was carried out."""
    stories: tuple[str, ...]
    settled_s: float | None
    """How long it took to come to rest; ``None``: it did not, or more than `FEW_TASKS` tasks took turns."""


def play(plan: Plan, keep: frozenset[int] | None = None, calm_at: float | None = None) -> Result:
    """Play a schedule.

    Args:
        plan: which one.
        keep: the indices of the faults to carry out (``None``: all); shrinking leaves the others out.
        calm_at: when the faults end, seconds after the start (``None``: after half the time).
    """
    stage = Stage(plan)
    violation = ""
    settled_s: float | None = None
    try:
        settled_s = stage.play(keep, plan.seconds / 2 if calm_at is None else calm_at)
    except DisagreementError as error:
        if stage.sim.memory.beyond:
            stage.sim.stories.append(f"{stage.sim.now:9.3f} END {error}, as {stage.sim.memory.beyond}")
            stage.scene.done[BEYOND] += 1
        else:
            violation = str(error)
    except InvariantError as error:
        violation = str(error)
    sim = stage.sim
    return Result(
        violation=violation,
        events=sim.events,
        revisions=len(sim.learnt),
        faults=stage.scene.done + sim.weather.counts,
        stories=tuple(sim.stories),
        settled_s=settled_s if len(sim.fleet.tasks) <= FEW_TASKS else None,
    )


@dataclass(slots=True)
class Stage:
    """One schedule on its simulator."""

    plan: Plan
    sim: Simulator = field(init=False)
    scene: Scene = field(init=False)
    _links: LinkFaults = field(init=False)
    _rollouts: Rollouts = field(init=False)
    _orders: Orders = field(init=False)
    _carriers: dict[str, Carry] = field(init=False)
    _busy: dict[NodeId, float] = field(default_factory=dict)
    _rng: Random = field(init=False)
    _prefix: float = 0.0
    _requests: dict[int, TuneTask] = field(default_factory=dict)

    def __post_init__(self) -> None:
        plan = self.plan
        self.sim = Simulator(
            fleet=plan.fleet,
            seed=plan.seed,
            generation=plan.generation,
            load=self._load,
            delay_s=SMALL_DELAY_S,
            weather=Weather(),
        )
        self.sim.work.stop_s = STOP_WORK_S
        each_s = EVENTS_PER_S + EVENTS_PER_TASK_S * len(plan.fleet.tasks)
        self.sim.most_events = each_s * len(plan.fleet.nodes) * plan.seconds
        self._rng = Random(f"stage {plan.seed}")
        self.scene = Scene(plan=plan, sim=self.sim, rng=self._rng, fleet=plan.fleet, generation=plan.generation)
        self._links, self._rollouts = LinkFaults(self.scene), Rollouts(self.scene)
        tables = (self._links.table(), DiskFaults(self.scene).table(), self._rollouts.table(), self._table())
        self._orders = Orders(self.sim)
        self._carriers = {kind: carry for table in tables for kind, carry in table.items()}

    def play(self, keep: frozenset[int] | None, calm_at: float) -> float:
        """Run it all; how long the fleet took to come to rest."""
        sim = self.sim
        sim.start()
        for index, fault in enumerate(self.plan.faults):
            if keep is None or index in keep:
                sim.later(fault.at, self._begin, fault)
        sim.run(calm_at)
        self.calm()
        at = sim.now
        if self.scene.is_memory_false:
            sim.run(sim.behind_s + AFTERMATH_S)  # a node that has lost some of its state hears so
        if not self.can_agree():
            sim.run(LOST_S)  # nothing may be agreed meanwhile that a majority does not remember
            self._start_generation()
            at = sim.now
        most_s = AT_MOST_S[sim.fleet.timing.name] + TURN_S * max(len(sim.fleet.tasks) - FEW_TASKS, 0)
        is_at_rest = _every(50, lambda: not sim.unsettled())
        if not sim.run_until(is_at_rest, most_s) and not self.can_agree():  # a name was disputed once all were heard
            self._start_generation()
            at = sim.now
            sim.run_until(is_at_rest, most_s)
        if sim.unsettled():
            raise DisagreementError(f"not at rest {most_s:g} s after the faults: {sim.unsettled()}")
        settled_s = sim.now - at
        sim.run(max(self.plan.seconds / 2 - settled_s, 0.0))
        self._check_answers()
        self._check_words()
        return settled_s

    def calm(self) -> None:
        """Faults end: the air clears, twins go, everybody runs, by the right fleet file, on a disk that works."""
        sim, scene = self.sim, self.scene
        scene.is_over, sim.fleet = True, scene.fleet
        self._links.calm()
        sim.work.all_come()
        sim.cut_batch = None
        missing = self._one_too_few()
        for key in [key for key, machine in sim.machines.items() if key != machine.name]:
            self._remove(key)
        for machine in tuple(sim.machines.values()):
            machine.event_s, machine.disk_s = 0.0, (0.0, 0.0)
            sim.unpause(machine, machine.life)
            is_wrong = machine.fleet != scene.fleet or machine.key in sim.broken_disks or self._is_stopping(machine)
            is_wrong |= self._needs_restart(machine)
            machine.fleet = scene.fleet
            sim.broken_disks.discard(machine.key)
            if is_wrong or machine.key == missing:
                sim.crash(machine.key)
            self._rollouts.complete(machine)
            if machine.key != missing:
                sim.start(machine.key)
        sim.later(AFTERMATH_S, self._start_again, missing)
        if scene.done["order"]:
            self._orders.take_back()

    def _start_again(self, missing: NodeId | None) -> None:
        """A twin's last beat may still have made the node stand down whose name it had: the operator starts it."""
        self.sim.start(*(key for key in sorted(self.sim.machines) if key != missing))

    def _one_too_few(self) -> NodeId | None:
        """In every second schedule one node that the others can do without never comes back."""
        fleet = self.sim.fleet
        name = self._rng.choice(fleet.nodes).name
        electors = [other for other in fleet.electors if other != name and self.sim.disk(other) is not None]
        voters = [other for other in fleet.voters if other != name]
        is_missed = len(electors) < majority(len(fleet.electors)) or len(voters) < majority(len(fleet.voters))
        # Who may still work by an older file is waited for until it is heard (docs/decisions/0026).
        is_waited_for = self.scene.done["rollout of exclusive"] > 0
        is_missed |= any(set(task.candidates) <= {name} or is_waited_for for task in fleet.tasks)
        return None if is_missed or self._rng.random() < 0.5 else name

    @staticmethod
    def _needs_restart(machine: Machine) -> bool:
        """Whether it runs with other electors, or by another length of leases, than its file says.

        A reload changes neither. The daemon asks for the restart (`zsched.link.sessions.restarts`): until then an
        owner and electors of two lengths grant each other nothing.
        """
        return machine.node is not None and lease_terms(machine.node.fleet) != lease_terms(machine.fleet)

    @staticmethod
    def _is_stopping(machine: Machine) -> bool:
        return machine.node is not None and machine.node.is_draining

    def can_agree(self) -> bool:
        """Whether a majority of the electors has kept its state."""
        return len(self.sim.fit_electors()) >= majority(len(self.sim.fleet.electors))

    def _start_generation(self) -> None:
        """Too many states are lost: the operator stops every daemon and starts a new generation everywhere."""
        self.scene.done["new generation"] += 1
        running = self.sim.running()
        for name in running:
            self.sim.crash(name)
        self.scene.begin_generation()
        for machine in self.sim.machines.values():
            self.scene.bring(machine, self.scene.generation)
        self.sim.start(*running)

    def _check_words(self) -> None:
        """Every node's status says what is so."""
        if not self.sim.run_until(_every(50, lambda: not untrue(self.sim)), TOLD_S) and (found := untrue(self.sim)):
            raise DisagreementError(f"status is wrong {TOLD_S:g} s after the fleet has come to rest: {found[:4]}")

    def _check_answers(self) -> None:
        """An operator who was told "committed" finds the weights in that revision."""
        for answer in self.sim.answers:
            command = self._requests.get(answer.request)
            if command is None or answer.result.outcome is not CommandOutcome.OK:
                continue
            values = [value for (task, _), value in self.sim.learnt.items() if task == command.task]
            if not any(value.tuning.weights == command.tuning.weights for value in values):
                raise InvariantError(f"{command} was answered {answer.result}, and no revision holds it")

    # --- faults ------------------------------------------------------------------------------------------------------

    def _load(self, node: NodeId, _now: float) -> tuple[float, float]:
        return CORES * self._busy.get(node, 0.25), 1000.0

    def _begin(self, fault: Fault) -> None:
        if self.scene.is_over:
            return  # they were ended early, to make the schedule smaller
        self.scene.done[fault.kind] += 1
        self.sim.stories.append(f"{self.sim.now:9.3f} FAULT {fault}")
        self._carriers[fault.kind](fault)

    def _pause(self, fault: Fault) -> None:
        self.sim.pause(self.scene.machine(fault), fault.seconds)

    def _freeze(self, fault: Fault) -> None:
        """The whole machine stands still, its clock and its workers too (a VM that is not scheduled)."""
        self.sim.freeze(self.scene.machine(fault), fault.seconds)

    def _suspend(self, fault: Fault) -> None:
        """The machine sleeps: loop and workers stand still, the clock goes on, and its watch sees a jump."""
        self.sim.suspend(self.scene.machine(fault), fault.seconds, fault.size)

    def _kill(self, fault: Fault) -> None:
        self.sim.crash(fault.nodes[0], is_power_lost=fault.kind == "power")
        self.scene.start_later(fault)

    def _blackout(self, fault: Fault) -> None:
        for name in self.sim.running():
            self.sim.crash(name, is_power_lost=True)
            self.scene.then(self._rng.uniform(0.0, fault.seconds), lambda name=name: self._start_if_there(name))  # type: ignore[misc]

    def _start_if_there(self, name: NodeId) -> None:
        if name in self.sim.machines:
            self.sim.start(name)

    def _storm(self, fault: Fault) -> None:
        """One node dies and comes back again and again."""
        at = 0.0
        while at < fault.seconds:
            self.scene.then(at, lambda: self.sim.crash(fault.nodes[0]))
            self.scene.then(at + self._rng.uniform(0.01, 0.3), lambda: self.sim.start(fault.nodes[0]))
            at += self._rng.uniform(0.3, 0.8)

    def _prefix_crashes(self, fault: Fault) -> None:
        """Nodes crash after some prefix of a batch, mostly of one that was to be written."""
        self._prefix, self.sim.cut_batch = fault.size, self._cut_batch
        self.scene.then(fault.seconds, lambda: setattr(self.sim, "cut_batch", None))

    def _cut_batch(self, _name: NodeId, batch: tuple[do.Instruction, ...]) -> int | None:
        is_dirty = bool(batch) and isinstance(batch[0], do.PersistState)
        if not batch or self._rng.random() > (self._prefix if is_dirty else self._prefix / 50):
            return None
        self.scene.done["cut batch"] += 1
        return self._rng.randint(0, len(batch))

    def _slow(self, fault: Fault) -> None:
        machine = self.scene.machine(fault)
        machine.event_s = fault.size
        self.scene.then(fault.seconds, lambda: setattr(machine, "event_s", 0.0))

    def _clock(self, fault: Fault) -> None:
        machine = self.scene.machine(fault)
        if fault.kind == "clock_rate":
            machine.clock.change(self.sim.now, rate=fault.size)
        else:
            machine.clock.change(self.sim.now, jump_s=fault.size)
        self.sim.rearm(machine)

    def _slew(self, fault: Fault) -> None:
        """A time service slews a machine's clock, and its watch says so."""
        name = fault.nodes[0]

        def tell(event: ev.Event) -> None:
            if name in self.sim.machines:
                self.sim.deliver(self.sim.machines[name], event)

        def is_believed() -> bool:
            return name not in self.sim.machines or self.sim.machines[name].believes_its_clock

        slew(
            fault.size,
            fault.seconds,
            tell=tell,
            later=self.sim.later,
            is_over=lambda: self.scene.is_over,
            is_believed=is_believed,
        )

    def _twin(self, fault: Fault) -> None:
        """Somebody copied a disk to another machine: its hardware differs, so it starts without a state.

        The two hear each other; or they do not; or each hears one half of the fleet.
        """
        sim, name = self.sim, fault.nodes[0]
        key = f"{name}~"
        if key in sim.machines:
            return
        sim.machines[key] = Machine(key=key, name=name, fleet=sim.machines[name].fleet)
        others = [other for other in sorted(sim.machines) if other not in (name, key)]
        apart: set[Pair] = {(name, key), (key, name)} if fault.size > 0.0 else set()
        if fault.size > 1.0:
            ends = {*itertools.product((name,), others[::2]), *itertools.product((key,), others[1::2])}
            apart |= ends | {(b, a) for a, b in ends}
        sim.cuts |= apart
        sim.start(key)
        self.scene.then(fault.seconds, lambda: self._remove(key))
        self.scene.then(fault.seconds, lambda: sim.cuts.difference_update(apart))

    def _remove(self, key: str) -> None:
        if key in self.sim.machines:
            self.sim.crash(key)
            del self.sim.machines[key]

    def _worker(self, fault: Fault) -> None:
        machine, is_final = self.scene.machine(fault), fault.size > 0.0
        for task in tuple(machine.workers):
            self.sim.work.fail(machine, task, is_final=is_final)
            if is_final:
                self.sim.later(fault.seconds, self.sim.work.mend, machine, task, machine.life)

    def _absence(self, fault: Fault) -> None:
        """The workers that somebody else runs beside a node end, and are back later."""
        machine, work = self.scene.machine(fault), self.sim.work
        work.leave(machine)
        self.scene.then(fault.seconds, lambda: work.come(machine))

    def _retune(self, fault: Fault) -> None:
        """An operator changes weights, and looks at the status."""
        machine, task = self.scene.machine(fault), self._rng.choice(self.sim.fleet.tasks)
        number = len(self._requests) + 1
        cpu = fault.size + number / 1024  # every command has weights of its own
        register = None if machine.node is None else machine.node.registers.get(task.name)
        if register is not None:
            tuning = replace(register.value.tuning, weights=Weights(cpu=cpu, memory=1.0 - cpu, network=0.0))
            base = register.value.revision
            command = TuneTask(task=task.name, tuning=tuning, base_revision=base, asked=BY)
            self._requests[number] = command
            self.sim.deliver(machine, ev.TuneCommanded(request=number, command=command))
        self.sim.deliver(machine, ev.StatusAsked(request=number))

    def _set_load(self, fault: Fault) -> None:
        self._busy[fault.nodes[0]] = fault.size

    def _drain(self, fault: Fault) -> None:
        """The daemon is told to stop, hands over for a moment, leaves, and comes back later."""
        machine = self.scene.machine(fault)
        self.sim.deliver(machine, ev.StopRequested())
        self.scene.then(STOP_S, lambda: self.sim.crash(machine.key))
        self.scene.then(STOP_S + fault.seconds, lambda: self.sim.start(machine.key))

    def _table(self) -> dict[str, Carry]:
        return {
            **dict.fromkeys(("kill", "power"), self._kill),
            **dict.fromkeys(("clock_rate", "clock_jump"), self._clock),
            "pause": self._pause,
            "blackout": self._blackout,
            "storm": self._storm,
            "prefix": self._prefix_crashes,
            "slow": self._slow,
            "slew": self._slew,
            **dict.fromkeys(("twin", "apart"), self._twin),
            "freeze": self._freeze,
            "suspend": self._suspend,
            "worker": self._worker,
            "absence": self._absence,
            "retune": self._retune,
            "order": lambda fault: self._orders.give(fault.nodes[0], fault.size),
            "load": self._set_load,
            "drain": self._drain,
        }


def _every(count: int, condition: Callable[[], bool]) -> Callable[[], bool]:
    """``condition``, looked at only every ``count`` times it is asked for."""
    calls = itertools.count(1)
    return lambda: next(calls) % count == 0 and condition()
