"""A fleet of real `Node`s on a fake network, clock and disk: deterministic by seed, hundreds of times real time.

Knows: delivery, the loop of each machine (pauses, slow events and disks included), lives, a stand-in for workers and
relays. Does not know: how a node decides (it runs the production core, codec and state format), which faults a
schedule has (`zsched_lab.sim.faults`), what must hold (`zsched_lab.sim.checks`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from random import Random
from typing import Any, TypeVar

from zsched.core.node.node import Node
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import InvariantError, WireError
from zsched.core.values.fleet import Fleet, electorate_hash, fleet_hash
from zsched.core.values.messages import FleetQuestion, Refused, fleet_question
from zsched.core.values.model import Allocation, NodeId, PeerState, TaskId
from zsched.core.values.plan import RoutePlan
from zsched.core.values.profile import DeviceSample, WorkerLoad
from zsched.core.values.struct import replace
from zsched.core.values.words import Readings
from zsched.core.vote.generations import blank_state
from zsched.host.clock import NAP_S
from zsched_lab.sim.checks import Invariants, are_same, check_replayed, unsettled
from zsched_lab.sim.clocks import LOOK_S, awake
from zsched_lab.sim.documents import Documents
from zsched_lab.sim.links import Links
from zsched_lab.sim.loops import TICK_S
from zsched_lab.sim.memory import Memory
from zsched_lab.sim.network import Message
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.work import Work

Load = Callable[[NodeId, float], tuple[float, float]]
"""(node, time) -> (CPU cores in use, MiB in use), the raw reading of the device profiler."""
Gauges = Callable[[NodeId, float], Readings]
"""(node, time) -> the raw readings of its gauges."""
Loads = Callable[[NodeId, float], tuple[WorkerLoad, ...]]
"""(node, time) -> the raw readings of its workers' use."""
Cut = Callable[[NodeId, tuple[do.Instruction, ...]], int | None]
"""(node, batch) -> after how many instructions the node crashes; ``None``: it carries out all of them and lives."""
Make = Callable[[Any], ev.Event]
T = TypeVar("T")

CORES, MEMORY_MB = 4.0, 4000.0
TOKEN_DELAY_S = 0.005
RESTART_S = 0.3
"""A node that crashed in the middle of a batch comes back this much later."""
WALL_MS = 1_700_000_000_000
"""The wall clock when a simulation begins, in milliseconds since 1970 (plus the simulation's own)."""
STARTS = 4
"""Numbers for each millisecond: two for a machine that is started just behind `zsched init`, two for its twin."""
QUESTIONS_KEPT = 4000


def idle(_node: NodeId, _now: float) -> tuple[float, float]:
    """Every machine a quarter busy, all the time."""
    return 1.0, 1000.0


def unmeasured(_node: NodeId, _now: float) -> tuple[WorkerLoad, ...]:
    """No machine measures its workers."""
    return ()


def without_gauges(_node: NodeId, _now: float) -> Readings:
    """No machine measures any."""
    return ()


@dataclass(slots=True, kw_only=True)
class Simulator(Links):
    """One fleet in one schedule. `run` until a time or a condition; faults in between."""

    fleet: Fleet
    seed: int
    generation: int = 0
    """The generation that the fleet begins with."""
    load: Load = idle
    gauges: Gauges = without_gauges
    loads: Loads = unmeasured
    cut_batch: Cut | None = None
    broken_disks: set[NodeId] = field(default_factory=set)
    """Nodes that cannot write their state."""
    stories: list[str] = field(default_factory=list)
    invariants: Invariants = field(init=False)
    memory: Memory = field(init=False)
    work: Work = field(init=False)
    documents: Documents = field(init=False)
    events: int = 0
    most_events: float = math.inf
    """More than this is a storm: nodes that answer each other without end."""
    answers: list[do.AnswerCommand] = field(default_factory=list)
    """What operators were told."""
    _asked: dict[int, tuple[Machine, Machine, Make, float]] = field(default_factory=dict)
    _frames: dict[tuple[str, type[Any]], tuple[object, bytes, Any]] = field(default_factory=dict)
    """{(sender, class): (the newest value of this class, its frame, what is read in it)}."""
    _disks: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    _requests: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def __post_init__(self) -> None:
        self.rng = Random(self.seed)
        self.invariants = Invariants(self.fleet)
        self.memory, self.work = Memory(self), Work(self)
        self.documents = Documents(self, self.rng.choice)
        for spec in self.fleet.nodes:
            machine = self.machines[spec.name] = Machine(key=spec.name, name=spec.name, fleet=self.fleet)
            self.initialise(machine, generation=self.generation)

    def initialise(self, machine: Machine, *, incarnation: int = 0, generation: int = 0) -> None:
        """`zsched init`: a blank durable state, which says that this name has never voted."""
        before = machine.disk.state
        disk = self.disk_id()
        blank = blank_state(
            machine.fleet, machine.name, generation, before, incarnation=incarnation, hardware="", disk=disk
        )
        machine.disk.wipe()
        self.invariants.expect(generation, machine.fleet.electors)
        machine.disk.write(blank)
        machine.disk.sync()

    def disk_id(self) -> str:
        """The id of another disk."""
        return f"{next(self._disks):04x}"

    # --- what a test does --------------------------------------------------------------------------------------------

    @property
    def wall_count(self) -> int:
        """The incarnation that a blank state or none begins with (`zsched.host.clock.wall_tenths`).

        Finer than a tenth of a second: these machines can be wiped and started more often than any real one.
        """
        return (WALL_MS + int(self.now * 1000)) * STARTS

    @property
    def learnt(self) -> dict[tuple[TaskId, int], Allocation]:
        """{(task, revision): the one value}."""
        return self.invariants.told

    @property
    def owners(self) -> dict[tuple[TaskId, int], NodeId]:
        """{(task, epoch): the one owner}."""
        return {key: first.owner for key, first in self.invariants.checker.epochs.items() if first.owner is not None}

    @property
    def plans(self) -> dict[tuple[NodeId, TaskId], RoutePlan]:
        """{(node, task): the newest plan}."""
        return self.work.plans

    @property
    def working(self) -> dict[TaskId, tuple[NodeId, float]]:
        """{exclusive task: (who works, until when at most)}."""
        return self.work.working

    def start(self, *names: NodeId) -> None:
        """Start nodes (default: all) from what their disks hold."""
        for name in names or tuple(self.machines):
            if self.machines[name].node is None:
                self._start(self.machines[name])

    def crash(self, name: NodeId, *, is_power_lost: bool = False) -> None:
        """A node's process and its worker end at once.

        Its token goes at the others a little later; when the power is lost, only with their links' lease, and what was
        written and not synced may be lost.
        """
        machine = self.machines[name]
        if machine.node is None:
            return
        incarnation = machine.node.incarnation
        delay_s = self.fleet.timing.control_lease_s if is_power_lost else TOKEN_DELAY_S
        for other in self.machines.values():
            if other is not machine and (machine.key, other.key) not in self.cuts:
                self.work.lose(machine, other, delay_s)
        self.work.end(machine)
        machine.end()
        machine.disk.lose_power(self.rng)
        self._tell_token(machine, ev.TokenLost(node=machine.name, incarnation=incarnation), delay_s)

    def node(self, name: NodeId) -> Node:
        """A running node. Raises `KeyError` when it is down."""
        node = self.machines[name].node
        if node is None:
            raise KeyError(name)
        return node

    def running(self) -> tuple[NodeId, ...]:
        """The nodes that are up, sorted."""
        return tuple(key for key, machine in sorted(self.machines.items()) if machine.node is not None)

    def fit_electors(self) -> tuple[NodeId, ...]:
        """The electors that are up and have their state."""
        running = self.running()
        return tuple(name for name in self.fleet.electors if name in running and self.node(name).agreement.is_elector)

    def agreed(self, task: TaskId, *names: NodeId) -> NodeId | None:
        """The owner that ``names`` (default: all running) have learnt, when it is one and the same; else ``None``."""
        values = [self.node(name).registers[task].value for name in names or self.running()]
        return values[0].owner if values and are_same(values) else None

    def disk(self, name: NodeId) -> DurableState | None:
        """What a node would find if it started now."""
        return self.machines[name].disk.state

    def sees(self, observer: NodeId, target: NodeId) -> PeerState:
        """How one running node sees another."""
        return self.node(observer).membership.state(target)

    def unsettled(self) -> str:
        """Why the fleet is not at rest, empty when it is (see `zsched_lab.sim.checks.unsettled`)."""
        return unsettled(self.fleet, self.machines, self.work.working, self.now)

    # --- lives -------------------------------------------------------------------------------------------------------

    def _start(self, machine: Machine) -> None:
        """As the daemon starts: read the state, check it, count the life, persist that, build the node."""
        electorate = electorate_hash(machine.fleet)
        kept, local = machine.is_durable, machine.clock.local(self.now)
        is_first = machine.life == 0
        state = machine.disk.read()
        is_agreed = state is not None and _has_changed(state)
        if state is not None and ((state.electorate != electorate and not is_agreed) or self._is_refused(machine)):
            state = None
        fleet, stored, flags = self.documents.at_start(machine, state)
        # No two machines' clocks agree to the millisecond, not even where power comes back to all of them at once.
        wall_count = self.wall_count + (0 if machine.key == machine.name else STARTS // 2)
        if state is not None:
            state = replace(state, incarnation=max(state.incarnation + 1, wall_count))
            machine.disk.write(state)
            machine.disk.sync()
        machine.life += 1
        machine.is_durable = state is not None
        machine.is_elector = state is not None and machine.name in fleet.electors
        self.invariants.on_started(machine, self.now, has_state=state is not None and (kept or is_first))
        machine.node = Node(
            fleet=fleet,
            me=machine.name,
            durable=state,
            incarnation=state.incarnation if state is not None else wall_count,
            electorate=electorate,
            rng=Random(self.rng.random()),
            now=local,
            stored=stored,
            flags=flags,
        )
        machine.node.by_file = fleet_hash(machine.fleet)
        self.memory.on_started(machine, state)
        self._tell_token(machine, ev.TokenSeen(node=machine.name, incarnation=machine.node.incarnation), TOKEN_DELAY_S)
        self._carry_out(machine, machine.node.start(local), 0)
        self.work.greet(machine)
        self.work.meet(machine)
        self.later(self.rng.uniform(0, machine.fleet.timing.sample_s), self._sample, machine, machine.life)
        self.arm(machine)

    def _is_refused(self, machine: Machine) -> bool:
        return machine.disk.is_broken or machine.key in self.broken_disks

    def _tell_token(self, machine: Machine, event: ev.Event, delay_s: float) -> None:
        for other in self.machines.values():
            if other is not machine and (machine.key, other.key) not in self.cuts:
                self.later(delay_s, self.deliver, other, event)

    def _sample(self, machine: Machine, life: int) -> None:
        if machine.life != life or machine.node is None:
            return
        cpu, memory = self.load(machine.name, self.now)
        sample = DeviceSample(
            cpu_cores=CORES,
            cpu_used_cores=cpu,
            memory_mb=MEMORY_MB,
            memory_used_mb=memory,
            gauges=self.gauges(machine.name, self.now),
            workers=self.loads(machine.name, self.now),
        )
        self.later(self.fleet.timing.sample_s, self._sample, machine, life)
        self.deliver(machine, ev.ProfileSampled(device=sample))

    def reload(self, machine: Machine) -> None:
        """A running node is given its machine's fleet file, and its workers' commands are compared with it."""
        self.deliver(machine, ev.FleetChanged(fleet=machine.fleet))

    def frozen(self, machine: Machine) -> None:
        """Its workers stand still with it."""
        self.work.freeze(machine)

    def thawed(self, machine: Machine) -> None:
        """Its workers go on by a clock that stood still."""
        self.work.thaw(machine, self.fleet.timing.lease_s)

    def woken_up(self, machine: Machine, slept_s: float) -> None:
        """Its workers go on; its watch looks at the clocks a little later, as often as the daemon's does.

        The node hears of the sleep before the next event, as the daemon's loop tells it.
        """
        life = machine.life
        counted_s = slept_s + max(machine.sleep_error_s, -slept_s)
        machine.untold_sleep_s += counted_s if counted_s > NAP_S else 0.0
        self.work.thaw(machine, max(-machine.sleep_error_s, 0.0))

        def tell(event: ev.Event) -> None:
            if machine.life == life:
                self.deliver(machine, event)

        def is_believed() -> bool:
            return machine.life != life or machine.believes_its_clock

        self.later(LOOK_S, lambda: awake(counted_s, tell=tell, later=self.later, is_believed=is_believed))

    # --- events ------------------------------------------------------------------------------------------------------

    def handle(self, machine: Machine, event: ev.Event) -> None:
        """Let a machine handle one event now, and carry out what it asks for."""
        assert machine.node is not None
        local, batch = self._enter(machine, event, machine.node.handle)
        self.invariants.on_handled(machine, self.now, local)
        if machine.event_s:
            machine.busy_until = self.now + machine.event_s
        if batch:
            self._carry_out(machine, batch, 0)
        self.arm(machine)

    def absorb(self, machine: Machine, event: ev.Event) -> None:
        """Let a machine take one event in, and judge nothing until the next one is handled."""
        assert machine.node is not None
        self._enter(machine, event, machine.node.absorb)

    def _enter(self, machine: Machine, event: ev.Event, door: Callable[[ev.Event, float], T]) -> tuple[float, T]:
        """(the machine's time, what its node's ``door`` answers to an event)."""
        assert machine.node is not None
        self.events += 1
        if self.events > self.most_events:
            raise InvariantError(f"{self.events} events until {self.now:.3f}: the fleet storms")
        local = self.now if machine.clock.is_true else machine.clock.local(self.now)
        try:
            if machine.untold_sleep_s:
                slept_s, machine.untold_sleep_s = machine.untold_sleep_s, 0.0
                machine.node.absorb(ev.ClockCompared(error_ratio=0.0, jump_s=slept_s), local)
            return local, door(event, local)
        except Exception as error:
            raise InvariantError(f"{machine.key} raised {error!r} on {event}") from error

    # --- instructions ------------------------------------------------------------------------------------------------

    def _carry_out(self, machine: Machine, batch: tuple[do.Instruction, ...], first: int) -> None:
        end = None if self.cut_batch is None else self.cut_batch(machine.name, batch)
        self._do(machine, machine.life, batch, first, end)

    def _do(self, machine: Machine, life: int, batch: tuple[do.Instruction, ...], first: int, end: int | None) -> None:
        """Carry out ``batch[first:end]``; a slow disk holds the rest of it up, a refused write ends it."""
        if machine.life != life:
            return
        for index in range(first, len(batch) if end is None else min(end, len(batch))):
            instruction = batch[index]
            if isinstance(instruction, do.PersistState):
                if self._is_refused(machine):
                    machine.is_durable = False
                    self.handle(machine, ev.PersistFailed(reason="no space left on device"))
                    break
                machine.disk.write(instruction.state)
                if machine.disk_s[1] > 0.0:
                    took_s = self.rng.uniform(*machine.disk_s)
                    machine.busy_until = self.now + took_s
                    self.later(took_s, self._synced, machine, life, batch, index, end, took_s)
                    return
                self._sync(machine, instruction.state)
                continue
            self.documents.on_sent(instruction)
            self.invariants.on_leaving(machine, instruction, self.now)
            self._one(machine, instruction)
        if end is not None:
            self.crash(machine.key)
            self.later(RESTART_S, self._restart, machine)

    def _restart(self, machine: Machine) -> None:
        if machine.node is None and machine.key in self.machines:
            self._start(machine)

    def _sync(self, machine: Machine, state: DurableState) -> None:
        self.documents.on_synced(machine, state)
        self.invariants.on_synced(machine, state, self.now)
        machine.disk.sync()

    def _synced(
        self, machine: Machine, life: int, batch: tuple[do.Instruction, ...], index: int, end: int | None, took_s: float
    ) -> None:
        if machine.life != life:
            return
        persist = batch[index]
        assert isinstance(persist, do.PersistState)
        if machine.is_paused:  # the write is done, the process is not there to go on
            self.later(TICK_S, self._synced, machine, life, batch, index, end, took_s)
            machine.busy_until = self.now + TICK_S
            return
        self._sync(machine, persist.state)
        machine.busy_until = self.now
        self._do(machine, life, batch, index + 1, end)
        if machine.life == life:
            self.absorb(machine, ev.StateSaved(took_s=took_s))
        self.pump_later(machine)
        self.arm(machine)

    def _one(self, me: Machine, instruction: do.Instruction) -> None:
        match instruction:
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
            case do.SendPrepare(prepare=prepare, deadline_s=deadline_s):
                self._elect(
                    me, prepare, deadline_s, lambda n, value: ev.PrepareAsked(request=n, asker=me.name, prepare=value)
                )
            case do.SendAccept(accept=accept, deadline_s=deadline_s):
                self._elect(
                    me, accept, deadline_s, lambda n, value: ev.AcceptAsked(request=n, asker=me.name, accept=value)
                )
            case do.SendBallots(ballots=ballots, deadline_s=deadline_s):
                self._elect(
                    me,
                    ballots,
                    deadline_s,
                    lambda n, value: ev.BallotsAsked(request=n, asker=me.name, ballots=value),
                    lambda answer: ev.VotesReceived(votes=answer),
                )
            case do.AskElectors(to=to, question=fleet_asked):
                self._ask_fleet(me, to, fleet_question(fleet_asked))
            case do.AnswerFleet(request=request, answer=fleet_vote):
                if fleet_vote.refused is None:
                    self.memory.on_vote(me)
                self._answer(request, fleet_vote)
            case do.StoreDocument() | do.AmendDocument() | do.FetchDocument() | do.KeepDocuments():
                self.documents.do(me, instruction)
            case do.AnswerDocument(request=request, document=document):
                content = self.documents.content(me, document)
                if content is not None:
                    self._answer(request, content)
            case do.AskLearnt(peer=peer):
                for other in self.named(peer):
                    number = self.ask(other, me, lambda value: ev.LearntReceived(learnt=value, is_answer=True))
                    self.send(me, other, Message(ev.LearntAsked(request=number)))
            case do.AnswerUtilities(request=request, utilities=value):
                self._answer(request, value)
            case do.AnswerElection(request=request, answer=vote):
                if not isinstance(vote, Refused):
                    self.memory.on_vote(me)
                self._answer(request, vote)
            case do.AnswerBallots(request=request, votes=votes):
                has_promised = votes.ahead is not None and votes.ahead.refused is None
                for _ in range(len(votes.promises) + len(votes.accepted) + has_promised):
                    self.memory.on_vote(me)
                self._answer(request, votes)
            case do.AnswerLearnt(request=request, learnt=learnt):
                self._answer(request, learnt)
            case do.AnswerCommand(result=result):
                wire.encode(result)
                self.answers.append(instruction)
            case do.AnswerStatus(snapshot=snapshot):
                wire.encode(snapshot)
            case do.AnswerExplanation(explanation=explanation):
                wire.encode(explanation)
            case do.RecordStory():
                if instruction.decision is not None:
                    check_replayed(me.key, instruction.decision)
                where = f"{instruction.task}#{instruction.epoch} " if instruction.task else ""
                self.stories.append(f"{self.now:9.3f} {me.key} {instruction.stage} {where}{instruction.text}")
            case do.StandDown():
                self.stories.append(f"{self.now:9.3f} {me.key} stands down: {instruction.reason}")
                self.crash(me.key)
            case _:
                self.work.do(me, instruction)

    # --- the network -------------------------------------------------------------------------------------------------

    def _framed(self, me: Machine, value: object) -> tuple[bytes, Any]:
        """(the frame of a value, what a receiver reads in it); the same value again is the same frame."""
        key = (me.key, type(value))
        known = self._frames.get(key)
        if known is None or known[0] is not value:
            try:
                frame = wire.encode(value)
            except WireError as error:
                raise InvariantError(f"{me.key} cannot send what it says: {error}") from error
            known = self._frames[key] = (value, frame, wire.decode(frame, type(value)))
        return known[1], known[2]

    def _put(self, me: Machine, value: object, make: Make) -> None:
        frame, read = self._framed(me, value)
        self.spread(me, Message(make(read), frame, type(value)))

    def _ask_fleet(self, me: Machine, to: tuple[NodeId, ...], question: FleetQuestion) -> None:
        frame, read = self._framed(me, question)
        for elector in to:
            for other in self.named(elector):
                number = self.ask(other, me, lambda answer: ev.FleetAnswered(answer=answer))
                asked = ev.FleetAsked(request=number, asker=me.name, question=read)
                self.send(me, other, Message(asked, frame, FleetQuestion))

    def ask(self, asked: Machine, asker: Machine, make: Make, within_s: float = math.inf) -> int:
        """A request number whose answers travel back from ``asked`` to ``asker`` (a repeated question's, too).

        What is answered later than ``within_s`` is heard by nobody: the query is over.
        """
        number = next(self._requests)
        self._asked[number] = (asked, asker, make, self.now + within_s)
        if len(self._asked) > QUESTIONS_KEPT:
            del self._asked[next(iter(self._asked))]
        return number

    def _answer(self, request: int, value: object) -> None:
        question = self._asked.get(request)
        if question is None:
            return
        asked, asker, make, until = question
        if self.now > until:
            return
        frame, read = self._framed(asked, value)
        self.send(asked, asker, Message(make(read), frame, type(value)))

    def _gather(self, me: Machine, gather: int) -> None:
        def make(value: Any) -> ev.Event:
            return ev.UtilityReceived(gather=gather, utilities=value)

        assert me.node is not None
        come = [name for name in me.node.fleet.voters if name not in self.fleet.voters]
        for name in (*self.fleet.voters, *come):
            for other in self.named(name) if name != me.name else ():
                number = self.ask(other, me, make)
                self.send(me, other, Message(ev.UtilityAsked(request=number, asker=me.name)))

    def _elect(
        self,
        me: Machine,
        question: object,
        deadline_s: float,
        make: Callable[[int, Any], ev.Event],
        answered: Make = lambda answer: ev.ElectorAnswered(answer=answer),
    ) -> None:
        (frame, value), kind = self._framed(me, question), type(question)
        assert me.node is not None
        for elector in me.node.agreement.electors:
            for other in self.named(elector):
                number = self.ask(other, me, answered, deadline_s)
                self.send(me, other, Message(make(number, value), frame, kind))


def _has_changed(state: DurableState) -> bool:
    """Whether a learnt fleet value names the electors, and no longer the file."""
    learnt = None if state.fleet_register is None else state.fleet_register.learnt
    return learnt is not None and not learnt.electorate.is_founding
