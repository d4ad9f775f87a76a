"""Plays one schedule: carries its faults out on a simulator, lets the fleet come to rest, says what was violated.

Knows: what each kind of fault does to machines and messages, and how it ends. Does not know: which faults a seed has
(`zsched.lab.sim_swarm`), what must hold after every event (`zsched.lab.sim_checks`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random

from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.messages import CommandOutcome, SetWeights
from zsched.core.model import NodeId
from zsched.core.scoring import majority
from zsched.errors import InvariantError
from zsched.lab.sim_clocks import slew
from zsched.lab.sim_links import SELF_DELAY_S
from zsched.lab.sim_network import Weather
from zsched.lab.sim_parts import Machine
from zsched.lab.sim_swarm import Fault, Plan
from zsched.lab.simulator import CORES, Simulator

SETTLE_S = 15.0
"""Once faults have stopped and everybody is up, every task has a living owner that all know within this time."""
EVENTS_PER_S = 500.0
"""A node handles about 50 a second; ten times that, on average over a whole schedule, is a storm."""
LOST_S = 3.0
"""So long a fleet that cannot agree is watched before the operator starts it anew."""
AFTERMATH_S = 1.0
"""What was under way when the faults ended has arrived."""
STOP_S = 0.8
"""What a daemon that was told to stop waits for its tasks to move."""
SMALL_DELAY_S = (0.0005, 0.003)
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
    """How long it took to come to rest; ``None``: it did not."""


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
    except InvariantError as error:
        violation = str(error)
    sim = stage.sim
    return Result(
        violation=violation,
        events=sim.events,
        revisions=len(sim.learnt),
        faults=stage.done + sim.weather.counts,
        stories=tuple(sim.stories),
        settled_s=settled_s,
    )


@dataclass(slots=True)
class Stage:
    """One schedule on its simulator."""

    plan: Plan
    sim: Simulator = field(init=False)
    done: Counter[str] = field(default_factory=Counter)
    _busy: dict[NodeId, float] = field(default_factory=dict)
    _rng: Random = field(init=False)
    _prefix: float = 0.0
    _requests: dict[int, SetWeights] = field(default_factory=dict)
    _is_over: bool = False

    def __post_init__(self) -> None:
        self.sim = Simulator(
            fleet=self.plan.fleet, seed=self.plan.seed, load=self._load, delay_s=SMALL_DELAY_S, weather=Weather()
        )
        self.sim.work.stop_s = STOP_WORK_S
        self.sim.most_events = EVENTS_PER_S * len(self.plan.fleet.nodes) * self.plan.seconds
        self._rng = Random(f"stage {self.plan.seed}")

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
        if not self.can_agree():
            sim.run(LOST_S)  # nothing may be agreed meanwhile that a majority does not remember
            self._start_generation()
            at = sim.now
        if not sim.run_until(_every(50, lambda: not sim.unsettled()), SETTLE_S) and sim.unsettled():
            raise InvariantError(f"not at rest {SETTLE_S:g} s after the faults: {sim.unsettled()}")
        settled_s = sim.now - at
        sim.run(max(self.plan.seconds / 2 - settled_s, 0.0))
        self._check_answers()
        return settled_s

    def calm(self) -> None:
        """Faults end: the air clears, twins go, everybody runs, by the right fleet file, on a disk that works."""
        sim = self.sim
        self._is_over = True
        sim.heal()
        sim.weather.calm()
        sim.loss, sim.delay_s, sim.cut_batch = 0.0, SMALL_DELAY_S, None
        missing = self._one_too_few()
        for key in [key for key, machine in sim.machines.items() if key != machine.name]:
            self._remove(key)
        for machine in tuple(sim.machines.values()):
            machine.event_s, machine.disk_s = 0.0, (0.0, 0.0)
            sim.unpause(machine, machine.life)
            is_wrong = machine.fleet is not sim.fleet or machine.key in sim.broken_disks or self._is_stopping(machine)
            machine.fleet = sim.fleet
            sim.broken_disks.discard(machine.key)
            if is_wrong or machine.key == missing:
                sim.crash(machine.key)
            if machine.key != missing:
                sim.start(machine.key)
        sim.later(AFTERMATH_S, self._start_again, missing)

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
        is_missed |= any(set(task.candidates) <= {name} for task in fleet.tasks)
        return None if is_missed or self._rng.random() < 0.5 else name

    @staticmethod
    def _is_stopping(machine: Machine) -> bool:
        return machine.node is not None and machine.node.is_draining

    def can_agree(self) -> bool:
        """Whether a majority of the electors has kept its state."""
        sim = self.sim
        running = sim.running()
        fit = [name for name in sim.fleet.electors if name in running and sim.node(name).agreement.is_elector]
        return len(fit) >= majority(len(sim.fleet.electors))

    def _start_generation(self) -> None:
        """Too many states are lost: the operator stops every daemon and starts a new generation everywhere."""
        sim = self.sim
        self.done["new generation"] += 1
        running = sim.running()
        for machine in sim.machines.values():
            sim.crash(machine.key)
            sim.initialise(machine, incarnation=sim.wall_count, generation=1)
        sim.start(*running)

    def _check_answers(self) -> None:
        """An operator who was told "committed" finds the weights in that revision."""
        for answer in self.sim.answers:
            command = self._requests.get(answer.request)
            if command is None or answer.result.outcome is not CommandOutcome.OK:
                continue
            values = [value for (task, _), value in self.sim.learnt.items() if task == command.task]
            if not any(value.tuning.weights.cpu == command.cpu for value in values):
                raise InvariantError(f"{command} was answered {answer.result}, and no revision holds it")

    # --- faults ------------------------------------------------------------------------------------------------------

    def _load(self, node: NodeId, _now: float) -> tuple[float, float]:
        return CORES * self._busy.get(node, 0.25), 1000.0

    def _begin(self, fault: Fault) -> None:
        self.done[fault.kind] += 1
        self.sim.stories.append(f"{self.sim.now:9.3f} FAULT {fault}")
        self._table()[fault.kind](fault)

    def _then(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something later, unless the faults are over by then."""
        self.sim.later(seconds, lambda: None if self._is_over else action())

    def _air(self, fault: Fault) -> None:
        """A chance per message."""
        values = {"spike": 0.02}
        weather, name = self.sim.weather, fault.kind
        if name == "spike":
            weather.spike_s = fault.size
        setattr(weather, name, values.get(name, fault.size))
        self._then(fault.seconds, lambda: setattr(weather, name, 0.0))

    def _loss(self, fault: Fault) -> None:
        self.sim.loss = fault.size
        self._then(fault.seconds, lambda: setattr(self.sim, "loss", 0.0))

    def _delay(self, fault: Fault) -> None:
        self.sim.delay_s = (SMALL_DELAY_S[0], fault.size)
        self._then(fault.seconds, lambda: setattr(self.sim, "delay_s", SMALL_DELAY_S))

    def _cut(self, fault: Fault) -> None:
        """Between some nodes and the rest, one way or both; or only between two."""
        here = set(fault.nodes)
        rest = [node.name for node in self.sim.fleet.nodes if node.name not in here]
        if fault.kind == "partial":
            pairs = set(itertools.permutations(fault.nodes, 2))
        else:
            pairs = set(itertools.product(fault.nodes, rest))
            back = {(b, a) for a, b in pairs}
            if fault.kind == "cut":
                pairs |= back
            elif fault.size < 0.5:
                pairs = back
        self.sim.cuts |= pairs
        self._then(self.sim.fleet.timing.zenoh_lease_s, lambda: self._links_end(pairs))
        self._then(fault.seconds, lambda: self.sim.cuts.difference_update(pairs))

    def _links_end(self, pairs: set[tuple[NodeId, NodeId]]) -> None:
        """Links that are still cut end with zenoh's lease: whoever hears nothing loses the other's token."""
        for source, target in sorted(pairs & self.sim.cuts):
            node = self.sim.machines[source].node
            if node is not None and target in self.sim.machines:
                event = ev.TokenLost(node=source, incarnation=node.incarnation)
                self.sim.later(SELF_DELAY_S, self.sim.deliver, self.sim.machines[target], event)
                self.sim.work.lose(self.sim.machines[source], self.sim.machines[target])

    def _version(self, fault: Fault) -> None:
        names = set(fault.nodes)
        self.sim.weather.foreign_version |= names
        self._then(fault.seconds, lambda: self.sim.weather.foreign_version.difference_update(names))

    def _machine(self, fault: Fault) -> Machine:
        return self.sim.machines[fault.nodes[0]]

    def _pause(self, fault: Fault) -> None:
        self.sim.pause(self._machine(fault), fault.seconds)

    def _kill(self, fault: Fault) -> None:
        self.sim.crash(fault.nodes[0], is_power_lost=fault.kind == "power")
        self._start_later(fault)

    def _start_later(self, fault: Fault) -> None:
        self._then(fault.seconds, lambda: self.sim.start(*fault.nodes))

    def _blackout(self, fault: Fault) -> None:
        for name in self.sim.running():
            self.sim.crash(name, is_power_lost=True)
            self._then(self._rng.uniform(0.0, fault.seconds), lambda name=name: self._start_if_there(name))  # type: ignore[misc]

    def _start_if_there(self, name: NodeId) -> None:
        if name in self.sim.machines:
            self.sim.start(name)

    def _lose_state(self, fault: Fault) -> None:
        """The state is damaged or gone. `zsched init` is refused to an elector that may have voted."""
        machine = self._machine(fault)
        self.sim.crash(machine.key, is_power_lost=True)
        machine.is_durable = False
        if fault.kind == "damage":
            machine.disk.damage(self._rng)
        else:
            machine.disk.wipe()
            if machine.name not in self.sim.fleet.electors:
                self.sim.initialise(machine, incarnation=self.sim.wall_count)
        self._start_later(fault)

    def _storm(self, fault: Fault) -> None:
        """One node dies and comes back again and again."""
        at = 0.0
        while at < fault.seconds:
            self._then(at, lambda: self.sim.crash(fault.nodes[0]))
            self._then(at + self._rng.uniform(0.01, 0.3), lambda: self.sim.start(fault.nodes[0]))
            at += self._rng.uniform(0.3, 0.8)

    def _prefix_crashes(self, fault: Fault) -> None:
        """Nodes crash after some prefix of a batch, mostly of one that was to be written."""
        self._prefix, self.sim.cut_batch = fault.size, self._cut_batch
        self._then(fault.seconds, lambda: setattr(self.sim, "cut_batch", None))

    def _cut_batch(self, _name: NodeId, batch: tuple[do.Instruction, ...]) -> int | None:
        is_dirty = bool(batch) and isinstance(batch[0], do.PersistState)
        if not batch or self._rng.random() > (self._prefix if is_dirty else self._prefix / 50):
            return None
        self.done["cut batch"] += 1
        return self._rng.randint(0, len(batch))

    def _slow(self, fault: Fault) -> None:
        machine = self._machine(fault)
        machine.event_s = fault.size
        self._then(fault.seconds, lambda: setattr(machine, "event_s", 0.0))

    def _slow_disk(self, fault: Fault) -> None:
        machine = self._machine(fault)
        machine.disk_s = (0.001, fault.size)
        self._then(fault.seconds, lambda: setattr(machine, "disk_s", (0.0, 0.0)))

    def _full_disk(self, fault: Fault) -> None:
        """It refuses writes; afterwards the operator makes room and restarts the daemon."""
        name = fault.nodes[0]
        self.sim.broken_disks.add(name)
        self._then(fault.seconds, lambda: self._mend(name))

    def _mend(self, name: NodeId) -> None:
        self.sim.broken_disks.discard(name)
        self.sim.crash(name)
        self.sim.start(name)

    def _clock(self, fault: Fault) -> None:
        machine = self._machine(fault)
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

        slew(fault.size, fault.seconds, tell=tell, later=self.sim.later, is_over=lambda: self._is_over)

    def _twin(self, fault: Fault) -> None:
        """Somebody copied a disk to another machine: its hardware differs, so it starts without a state."""
        key = f"{fault.nodes[0]}~"
        if key in self.sim.machines:
            return
        self.sim.machines[key] = Machine(key=key, name=fault.nodes[0], fleet=self.sim.fleet)
        self.sim.start(key)
        self._then(fault.seconds, lambda: self._remove(key))

    def _remove(self, key: str) -> None:
        if key in self.sim.machines:
            self.sim.crash(key)
            del self.sim.machines[key]

    def _electorate(self, fault: Fault) -> None:
        """A node is restarted with a fleet file that names other electors, and later with the right one."""
        machine = self._machine(fault)
        names = tuple(node.name for node in self.sim.fleet.nodes)
        count = self._rng.randint(1, len(names))
        others = tuple(sorted(self._rng.sample(names, count)))
        self._restart_with(machine, others if others != self.sim.fleet.electors else names[:1])
        self._then(fault.seconds, lambda: self._restart_with(machine, self.sim.fleet.electors))

    def _restart_with(self, machine: Machine, electors: tuple[NodeId, ...]) -> None:
        self.sim.crash(machine.key)
        fleet = self.sim.fleet
        machine.fleet = fleet if electors == fleet.electors else replace(fleet, electors=electors)
        self.sim.start(machine.key)

    def _worker(self, fault: Fault) -> None:
        machine, is_final = self._machine(fault), fault.size > 0.0
        for task in tuple(machine.workers):
            self.sim.work.fail(machine, task, is_final=is_final)
            if is_final:
                self.sim.later(fault.seconds, self.sim.work.mend, machine, task, machine.life)

    def _retune(self, fault: Fault) -> None:
        """An operator changes weights, and looks at the status."""
        machine, task = self._machine(fault), self._rng.choice(self.sim.fleet.tasks)
        number = len(self._requests) + 1
        cpu = fault.size + number / 1024  # every command has weights of its own
        command = SetWeights(task=task.name, cpu=cpu, memory=1.0 - cpu, network=0.0)
        self._requests[number] = command
        self.sim.deliver(machine, ev.WeightsCommanded(request=number, command=command))
        self.sim.deliver(machine, ev.StatusAsked(request=number))

    def _set_load(self, fault: Fault) -> None:
        self._busy[fault.nodes[0]] = fault.size

    def _drain(self, fault: Fault) -> None:
        """The daemon is told to stop, hands over for a moment, leaves, and comes back later."""
        machine = self._machine(fault)
        self.sim.deliver(machine, ev.StopRequested())
        self._then(STOP_S, lambda: self.sim.crash(machine.key))
        self._then(STOP_S + fault.seconds, lambda: self.sim.start(machine.key))

    def _table(self) -> dict[str, Callable[[Fault], None]]:
        return {
            **dict.fromkeys(("duplicate", "spike", "mutate", "forge", "replay"), self._air),
            **dict.fromkeys(("cut", "one_way", "partial"), self._cut),
            **dict.fromkeys(("kill", "power"), self._kill),
            **dict.fromkeys(("damage", "wipe"), self._lose_state),
            **dict.fromkeys(("clock_rate", "clock_jump"), self._clock),
            "loss": self._loss,
            "delay": self._delay,
            "version": self._version,
            "pause": self._pause,
            "blackout": self._blackout,
            "storm": self._storm,
            "prefix": self._prefix_crashes,
            "slow": self._slow,
            "slow_disk": self._slow_disk,
            "full_disk": self._full_disk,
            "slew": self._slew,
            "twin": self._twin,
            "electorate": self._electorate,
            "worker": self._worker,
            "retune": self._retune,
            "load": self._set_load,
            "drain": self._drain,
        }


def _every(count: int, condition: Callable[[], bool]) -> Callable[[], bool]:
    """``condition``, looked at only every ``count`` times it is asked for."""
    calls = itertools.count(1)
    return lambda: next(calls) % count == 0 and condition()
