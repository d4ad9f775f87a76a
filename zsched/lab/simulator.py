"""A fleet of real `Node`s on a fake network, clock and disk: deterministic by seed, thousands of times real time.

Knows: delivery (delay, loss, cuts), crashes and restarts from what was persisted, a stand-in for workers and relays,
the invariants that every event is checked against. Does not know: how a node decides; it runs the production core,
the production codec and the production state format.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from random import Random

from zsched import wire
from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.fleet import Fleet, electorate_hash
from zsched.core.model import Allocation, DeviceSample, DurableState, NodeId, PeerState, TaskId, WorkerState
from zsched.core.node import Node
from zsched.core.plan import Role, RoutePhase, RoutePlan, WorkerRole
from zsched.errors import InvariantError

Load = Callable[[NodeId, float], tuple[float, float]]
"""(node, time) -> (CPU cores in use, MiB in use), the raw reading of the device profiler."""
Cut = Callable[[NodeId, tuple[do.Instruction, ...]], int | None]
"""(node, batch) -> after how many instructions the node crashes; ``None``: it carries out all of them and lives."""

CORES, MEMORY_MB = 4.0, 4000.0
TICK_S = 0.0005
"""A deadline that lies in the past is served this much later: the loop's own time."""
WORKER_START_S = 0.4
TOKEN_DELAY_S = 0.005
FLIP_S = 0.005
WORKER_STOP_S = 0.002
RESTART_S = 0.3
"""A node that crashed in the middle of a batch comes back this much later."""


def idle(_node: NodeId, _now: float) -> tuple[float, float]:
    """Every machine a quarter busy, for ever."""
    return 1.0, 1000.0


@dataclass(slots=True)
class _Machine:
    name: NodeId
    disk: bytes | None = None
    node: Node | None = None
    life: int = 0
    wake_at: float = math.inf
    workers: dict[TaskId, int] = field(default_factory=dict)
    """{task: the life of this machine in which its worker became ready}."""
    roles: dict[TaskId, Role] = field(default_factory=dict)


@dataclass(slots=True)
class Simulator:
    """One fleet in one schedule. `run` until a time or a condition; faults in between."""

    fleet: Fleet
    seed: int
    load: Load = idle
    loss: float = 0.0
    delay_s: tuple[float, float] = (0.0005, 0.003)
    now: float = 100.0
    cuts: set[tuple[NodeId, NodeId]] = field(default_factory=set)
    """(from, to) pairs that deliver nothing."""
    cut_batch: Cut | None = None
    broken_disks: set[NodeId] = field(default_factory=set)
    """Nodes that cannot write their state."""
    learnt: dict[tuple[TaskId, int], Allocation] = field(default_factory=dict)
    """{(task, revision): the one value}."""
    owners: dict[tuple[TaskId, int], NodeId] = field(default_factory=dict)
    """{(task, epoch): the one owner}."""
    plans: dict[tuple[NodeId, TaskId], RoutePlan] = field(default_factory=dict)
    working: dict[TaskId, tuple[NodeId, float]] = field(default_factory=dict)
    """{exclusive task: (who works, until when at most)}."""
    stories: list[str] = field(default_factory=list)
    _rng: Random = field(init=False)
    _queue: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _order: Iterator[int] = field(default_factory=itertools.count)
    _machines: dict[NodeId, _Machine] = field(default_factory=dict)
    _asked: dict[int, Callable[[object], None]] = field(default_factory=dict)
    _requests: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def __post_init__(self) -> None:
        self._rng = Random(self.seed)
        for spec in self.fleet.nodes:
            blank = DurableState(
                fleet=self.fleet.name,
                node=spec.name,
                incarnation=0,
                generation=0,
                hardware="",
                electorate=electorate_hash(self.fleet),
            )
            self._machines[spec.name] = _Machine(name=spec.name, disk=wire.encode_state(blank))

    # --- what a test does --------------------------------------------------------------------------------------------

    def start(self, *names: NodeId) -> None:
        """Start nodes (default: all) from what their disks hold."""
        for name in names or tuple(self._machines):
            self._start(self._machines[name])

    def crash(self, name: NodeId) -> None:
        """A node's process and its worker end at once; its token goes at the others a little later."""
        machine = self._machines[name]
        if machine.node is None:
            return
        incarnation, machine.node = machine.node.incarnation, None
        machine.life += 1
        machine.workers.clear()
        machine.roles.clear()
        for other in self._others(name):
            event = ev.TokenLost(node=name, incarnation=incarnation)
            self._later(TOKEN_DELAY_S, lambda o=other, e=event: self._deliver(o, e))  # type: ignore[misc]

    def cut(self, *sides: tuple[NodeId, ...]) -> None:
        """Nothing passes between the groups any more, in either direction; groups inside stay connected."""
        for one, other in itertools.permutations(sides, 2):
            self.cuts.update(itertools.product(one, other))

    def heal(self) -> None:
        """Everything passes again."""
        self.cuts.clear()

    def run(self, seconds: float) -> None:
        """Let virtual time pass."""
        self.run_until(lambda: False, seconds)

    def run_until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Let time pass until ``condition``, at most ``seconds``; whether it came true."""
        end = self.now + seconds
        while self._queue and self._queue[0][0] <= end:
            self.now, _, action = heapq.heappop(self._queue)
            action()
            if condition():
                return True
        self.now = end
        return condition()

    def node(self, name: NodeId) -> Node:
        """A running node. Raises `KeyError` when it is down."""
        node = self._machines[name].node
        if node is None:
            raise KeyError(name)
        return node

    def running(self) -> tuple[NodeId, ...]:
        """The nodes that are up, sorted."""
        return tuple(name for name, machine in sorted(self._machines.items()) if machine.node is not None)

    def agreed(self, task: TaskId, *names: NodeId) -> NodeId | None:
        """The owner that ``names`` (default: all running) have learnt, when it is one and the same; else ``None``."""
        values = {self.node(name).registers[task].value for name in names or self.running()}
        return values.pop().owner if len(values) == 1 else None

    def disk(self, name: NodeId) -> DurableState | None:
        """What a node would find if it started now."""
        content = self._machines[name].disk
        return None if content is None else wire.decode_state(content)

    # --- machines ----------------------------------------------------------------------------------------------------

    def _start(self, machine: _Machine) -> None:
        state = None if machine.disk is None else wire.decode_state(machine.disk)
        if state is not None:
            state = replace(state, incarnation=state.incarnation + 1)
            machine.disk = wire.encode_state(state)
        machine.life += 1
        machine.node = Node(
            fleet=self.fleet,
            me=machine.name,
            durable=state,
            incarnation=state.incarnation if state is not None else machine.life,
            electorate=electorate_hash(self.fleet),
            rng=Random(self._rng.random()),
            now=self.now,
        )
        self._carry_out(machine, machine.node.start(self.now))
        life = machine.life
        self._later(self._rng.uniform(0, self.fleet.timing.sample_s), lambda: self._sample(machine, life))
        machine.wake_at = math.inf
        self._arm(machine)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (self.now + seconds, next(self._order), action))

    def _sample(self, machine: _Machine, life: int) -> None:
        if machine.life != life or machine.node is None:
            return
        cpu, memory = self.load(machine.name, self.now)
        sample = DeviceSample(cpu_cores=CORES, cpu_used_cores=cpu, memory_mb=MEMORY_MB, memory_used_mb=memory)
        self._later(self.fleet.timing.sample_s, lambda: self._sample(machine, life))
        self._deliver(machine.name, ev.ProfileSampled(device=sample))

    def _arm(self, machine: _Machine) -> None:
        """Make sure that the node is woken at its next deadline."""
        node, life = machine.node, machine.life
        if node is None:
            return
        due = max(node.next_deadline(), self.now + TICK_S)
        if due < machine.wake_at:
            machine.wake_at = due
            self._later(due - self.now, lambda: self._wake(machine, life))

    def _wake(self, machine: _Machine, life: int) -> None:
        if machine.life != life:
            return
        machine.wake_at = math.inf
        node = machine.node
        if node is not None and node.next_deadline() <= self.now:
            self._deliver(machine.name, ev.DeadlineReached())
        self._arm(machine)

    def _deliver(self, name: NodeId, event: ev.Event) -> None:
        machine = self._machines[name]
        if machine.node is not None:
            self._carry_out(machine, machine.node.handle(event, self.now))
            self._arm(machine)

    def _others(self, name: NodeId) -> list[NodeId]:
        return [other for other in self._machines if other != name]

    # --- instructions ------------------------------------------------------------------------------------------------

    def _carry_out(self, machine: _Machine, batch: tuple[do.Instruction, ...]) -> None:
        end = None if self.cut_batch is None else self.cut_batch(machine.name, batch)
        for instruction in batch[:end]:
            if isinstance(instruction, do.PersistState) and machine.name in self.broken_disks:
                self._deliver(machine.name, ev.PersistFailed(reason="no space left on device"))
                break
            self._one(machine, instruction)
        self._check(machine)
        if end is not None:
            self.crash(machine.name)
            self._later(RESTART_S, lambda: self._start(machine) if machine.node is None else None)

    def _one(self, machine: _Machine, instruction: do.Instruction) -> None:
        me = machine.name
        match instruction:
            case do.PersistState(state=state):
                machine.disk = wire.encode_state(state)
            case do.PublishBeat(beat=beat):
                self._put(me, beat, lambda value: ev.BeatReceived(beat=value))
            case do.PublishProfile(profile=profile):
                self._put(me, profile, lambda value: ev.ProfileReceived(profile=value))
            case do.PublishProposal(proposal=proposal):
                self._put(me, proposal, lambda value: ev.ProposalReceived(proposal=value))
            case do.PublishLearnt(learnt=learnt):
                self._put(me, learnt, lambda value: ev.LearntReceived(learnt=value))
            case do.AskUtilities(gather=gather):
                self._gather(me, gather)
            case do.SendPrepare(prepare=prepare):
                self._elect(
                    me, prepare, lambda request, value: ev.PrepareAsked(request=request, asker=me, prepare=value)
                )
            case do.SendAccept(accept=accept):
                self._elect(me, accept, lambda request, value: ev.AcceptAsked(request=request, asker=me, accept=value))
            case do.AskLearnt(peer=peer):
                request = self._question(peer, me, lambda value: ev.LearntReceived(learnt=value))
                self._send(me, peer, lambda: ev.LearntAsked(request=request))
            case do.AnswerUtilities(request=request, utilities=answer):
                self._answer(request, answer)
            case do.AnswerElection(request=request, answer=vote):
                self._answer(request, vote)
            case do.AnswerLearnt(request=request, learnt=learnt):
                self._answer(request, learnt)
            case do.StartWorker(task=task):
                self._start_worker(machine, task)
            case do.ApplyRoutes(plan=plan):
                self._apply(machine, plan)
            case do.SetRole(role=role):
                self._set_role(machine, role)
            case do.RecordStory():
                where = f"{instruction.task}#{instruction.epoch} " if instruction.task else ""
                self.stories.append(f"{self.now:9.3f} {me} {instruction.stage} {where}{instruction.text}")
            case _:
                pass  # status and commands go to whoever called; roles and stops concern real workers only

    def _send(self, source: NodeId, target: NodeId, make: Callable[[], ev.Event]) -> None:
        """One message on its way: maybe lost, cut or late, never changed."""
        if source != target and ((source, target) in self.cuts or self._rng.random() < self.loss):
            return
        delay = 0.0001 if source == target else self._rng.uniform(*self.delay_s)
        self._later(delay, lambda: None if (source, target) in self.cuts else self._deliver(target, make()))

    def _put(self, me: NodeId, value: object, make: Callable[..., ev.Event]) -> None:
        frame, kind = wire.encode(value), type(value)
        for other in self._others(me):
            self._send(me, other, lambda: make(wire.decode(frame, kind)))

    def _question(self, asked: NodeId, asker: NodeId, make: Callable[..., ev.Event]) -> int:
        """A request number whose answer travels back from ``asked`` to ``asker``."""
        number = next(self._requests)

        def answer(value: object) -> None:
            frame, kind = wire.encode(value), type(value)
            self._send(asked, asker, lambda: make(wire.decode(frame, kind)))

        self._asked[number] = answer
        return number

    def _answer(self, request: int, value: object) -> None:
        answer = self._asked.pop(request, None)
        if answer is not None:
            answer(value)

    def _gather(self, me: NodeId, gather: int) -> None:
        for other in self.fleet.voters:
            if other != me:
                number = self._question(other, me, lambda value: ev.UtilityReceived(gather=gather, utilities=value))
                self._send(me, other, lambda n=number: ev.UtilityAsked(request=n, asker=me))  # type: ignore[misc]

    def _elect(self, me: NodeId, question: object, make: Callable[..., ev.Event]) -> None:
        frame, kind = wire.encode(question), type(question)
        for elector in self.fleet.electors:
            number = self._question(elector, me, lambda value: ev.ElectorAnswered(answer=value))
            self._send(me, elector, lambda n=number: make(n, wire.decode(frame, kind)))  # type: ignore[misc]

    # --- stand-ins for workers and relays ----------------------------------------------------------------------------

    def _start_worker(self, machine: _Machine, task: TaskId) -> None:
        if task in machine.workers:
            return
        life = machine.workers[task] = machine.life

        def ready() -> None:
            if machine.life == life:
                self._deliver(machine.name, ev.WorkerChanged(task=task, state=WorkerState.READY))

        self._later(WORKER_START_S, ready)

    def _set_role(self, machine: _Machine, role: Role) -> None:
        """The worker follows its role; an exclusive one works only under its lease, and says when it has stopped."""
        before = machine.roles.get(role.task)
        machine.roles[role.task] = role
        if role.lease_until_s is not None and role.lease_until_s > self.now:
            self._check_exclusive(machine, role, role.lease_until_s)
        if before is None or before.role is not WorkerRole.ACTIVE or role.role is WorkerRole.ACTIVE:
            return
        life = machine.life

        def stopped() -> None:
            working = self.working.get(role.task)
            if working is not None and working[0] == machine.name and machine.life == life:
                self.working[role.task] = (machine.name, self.now)
            if machine.life == life:
                self._deliver(machine.name, ev.RoleEnded(task=role.task, epoch=before.epoch))

        self._later(WORKER_STOP_S, stopped)

    def _check_exclusive(self, machine: _Machine, role: Role, until: float) -> None:
        """Nobody else may still be working: a crashed owner's worker counts until its lease ends."""
        other = self.working.get(role.task)
        if other is not None and other[0] != machine.name and other[1] > self.now:
            raise InvariantError(
                f"seed {self.seed}: {other[0]} and {machine.name} both work on {role.task} at {self.now:.3f}"
            )
        self.working[role.task] = (machine.name, until)

    def _apply(self, machine: _Machine, plan: RoutePlan) -> None:
        before = self.plans.get((machine.name, plan.task))
        newest = plan.current.epoch if plan.current is not None else 0
        if before is not None and before.current is not None and newest < before.current.epoch:
            raise InvariantError(f"{machine.name}: an older token moves a route: {before.current.epoch} -> {newest}")
        self.plans[machine.name, plan.task] = plan
        life = machine.life
        if plan.phase is RoutePhase.PREPARE:
            self._watch_ready(machine, plan, life)
        elif plan.phase is RoutePhase.FLIP:
            self._later(FLIP_S, lambda: self._flipped(machine, plan, life))

    def _watch_ready(self, machine: _Machine, plan: RoutePlan, life: int) -> None:
        """Report readiness once the owner's worker is up and reachable; ask again as long as the plan stands."""
        if machine.life != life or self.plans.get((machine.name, plan.task)) != plan or plan.current is None:
            return
        owner = self._machines[plan.current.owner]
        is_up = owner.node is not None and owner.node.worker_states.get(plan.task) is WorkerState.READY
        if is_up and (owner.name, machine.name) not in self.cuts:
            self._deliver(machine.name, ev.SlotReady(task=plan.task, epoch=plan.current.epoch))
            return
        self._later(0.05, lambda: self._watch_ready(machine, plan, life))

    def _flipped(self, machine: _Machine, plan: RoutePlan, life: int) -> None:
        if machine.life != life or plan.current is None:
            return
        self._deliver(machine.name, ev.SlotFlipped(task=plan.task, epoch=plan.current.epoch))
        if plan.predecessor is not None and self._machines[plan.predecessor.owner].node is not None:
            self._deliver(machine.name, ev.SlotDrained(task=plan.task, epoch=plan.predecessor.epoch))

    # --- invariants --------------------------------------------------------------------------------------------------

    def _check(self, machine: _Machine) -> None:
        """One value per revision, one owner per epoch, over all nodes and lives."""
        if machine.node is None:
            return
        for task, register in machine.node.registers.items():
            value = register.value
            if value.revision == 0:
                continue
            known = self.learnt.setdefault((task, value.revision), value)
            if known != value:
                raise InvariantError(f"seed {self.seed}: two values for {task} revision {value.revision}")
            if value.owner is None:
                continue
            owner = self.owners.setdefault((task, value.epoch), value.owner)
            if owner != value.owner:
                raise InvariantError(f"seed {self.seed}: two owners for {task} epoch {value.epoch}")

    def sees(self, observer: NodeId, target: NodeId) -> PeerState:
        """How one running node sees another."""
        return self.node(observer).membership.state(target)
