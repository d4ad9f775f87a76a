"""The invariants that every event of a simulated fleet is checked against (docs/develop/testing.md lists them).

Knows: what must hold, over all nodes and all their lives. Does not know: what happens next, how a node decides.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from zsched.core.executor.handover import Phase
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.scheduler.flags import HANDS_OVER
from zsched.core.scheduler.fuse import ESCAPES_PER_MINUTE, WINDOW_S
from zsched.core.values import instructions as do
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.decision import Decision
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Accepted, Promise
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, Ballot, NodeId, Proposal, RegisterState, TaskId
from zsched.core.values.plan import Role, RoutePlan, WorkerRole
from zsched.core.values.profile import WorkerState
from zsched.core.vote.belief import GENERATION_STEP
from zsched_lab.sim.history import Checker, Learnt, Record, Routed, Started, Stored, Worked
from zsched_lab.sim.parts import Machine

FORGED = -1
"""The number of a question that a stranger asks, or in another one's name: a yes to it is a violation."""
_SAYS_NOTHING = frozenset({do.AskUtilities, do.AnswerUtilities, do.PublishProfile, do.AskLearnt, do.RecordStory})
"""Half of what leaves: it claims nothing that must be on a disk."""
DRAINED = (" is drained by ", " is leaving the fleet, by ")
"""In the reason of a move that an operator's flag has caused: no cap counts it."""
MAX_AT_ONCE = 50
"""So often in a row a node may want to be called again at once; a sound one with 41 tasks did so 7 times."""


class DisagreementError(InvariantError):
    """What a fleet did, whose electors forget nothing unseen, is impossible; each node may have kept its rules."""


@dataclass(slots=True)
class Invariants:
    """Watches one simulated fleet; raises `InvariantError` as soon as something impossible happens."""

    fleet: Fleet
    checker: Checker = field(init=False)
    limits: dict[TaskId, int] = field(default_factory=dict)
    """{task: most moves within a minute, planned or not}."""
    told: dict[tuple[TaskId, int], Allocation] = field(default_factory=dict)
    """{(task, revision): the one value}."""
    newest: dict[tuple[str, TaskId], int] = field(default_factory=dict)
    """{(machine, task): the newest revision that it ever learnt}."""
    ballots: dict[tuple[tuple[TaskId, int], Ballot], tuple[str, Allocation | None]] = field(default_factory=dict)
    """{((task, creation), ballot): (whose it is, what it carries)}."""
    sides: dict[str, str] = field(default_factory=dict)
    """{machine: its half}, where two halves of the fleet were recovered apart: their values are not compared."""
    recovered: set[tuple[TaskId, int]] = field(default_factory=set)
    """(task, revision) of the values with which a recovered generation begins: nobody chose them."""
    _counted: dict[str, int] = field(default_factory=dict)
    """{machine: the revision of its newest fleet value}."""
    _floors: dict[str, dict[TaskId, Ballot]] = field(default_factory=dict)
    """{machine: {task: the highest ballot before the newest write of this batch, and of the answers since}}."""

    def __post_init__(self) -> None:
        self.checker = Checker(electors=self.fleet.electors, moves_per_minute=self.limits)
        self.allow(self.fleet)

    def expect(self, generation: int, electors: tuple[NodeId, ...]) -> None:
        """A state of this generation was written under these electors: their majority may agree in it."""
        self.checker.electorates.setdefault(generation, set()).add(electors)

    def allow(self, fleet: Fleet) -> None:
        """Another fleet file is being rolled out: until all have it, the larger of its limits and the old ones hold."""
        for task in fleet.tasks:
            limit = task.max_moves_per_minute + ESCAPES_PER_MINUTE
            self.limits[task.name] = max(self.limits.get(task.name, 0), limit)

    def take(self, record: Record) -> None:
        """Check one record of the history."""
        found = self.checker.take(record)
        if found:
            raise DisagreementError(found[0])

    # --- lives and disks ---------------------------------------------------------------------------------------------

    def on_started(self, machine: Machine, now: float, *, has_state: bool) -> None:
        """A daemon starts; one without state may know less than before."""
        self.take(Started(at=now, node=machine.key, has_state=has_state))
        machine.known.clear()
        machine.at_once = 0

    def on_synced(self, machine: Machine, state: DurableState, now: float) -> None:
        """A state reached the disk: promises only rise, and what it holds is history from now on."""
        old = machine.disk.registers
        agreed = None if state.fleet_register is None else state.fleet_register.learnt
        if agreed is not None and agreed.revision != self._counted.get(machine.key):
            self._counted[machine.key] = agreed.revision
            for creation in {state.generation, *(one.number for one in agreed.tasks)}:
                self.expect(creation, agreed.electorate.names)
        for register in state.registers:
            known = old.get(register.task)
            if known is register:
                continue
            if known is not None and known.creation != register.creation:
                known = None  # the task has left the document and come back: its register is another one
            self._floors.setdefault(machine.key, {})[register.task] = NO_BALLOT if known is None else known.promised
            if known is not None and register.promised < known.promised:
                raise InvariantError(f"{machine.key} promised {register.promised} after {known.promised}")
            accepted = register.accepted
            if accepted is not None and (known is None or known.accepted != accepted):
                ballot, revision = str(accepted), accepted.value.revision
                task = self._sided(machine, register.task)
                self.take(Stored(at=now, node=machine.key, task=task, revision=revision, ballot=ballot))
            if register.learnt is not None and (known is None or known.learnt != register.learnt):
                self.on_learnt(machine, register.learnt, now)

    def on_learnt(self, machine: Machine, value: Allocation, now: float) -> None:
        """A node knows a committed value, for good (or, without a state file, for this life)."""
        if value.revision == 0:
            return
        key, task = (machine.key, value.task), self._sided(machine, value.task)
        self.newest[key] = max(self.newest.get(key, 0), value.revision)
        is_chosen = value.revision % GENERATION_STEP and (value.task, value.revision) not in self.recovered
        if is_chosen:  # a generation's first value was made by the operator, nobody chose it
            detail = f"{value.tuning} {value.pin} {value.pause} {value.asked}"
            self.take(
                Learnt(
                    at=now,
                    node=machine.key,
                    task=task,
                    revision=value.revision,
                    epoch=value.epoch,
                    owner=value.owner,
                    detail=detail,
                )
            )
        self.told.setdefault((task, value.revision), value)
        for revision in (value.revision - 1, value.revision):
            before, after = self.told.get((task, revision)), self.told.get((task, revision + 1))
            if before is not None and after is not None:
                _check_orders(before, after)

    def _sided(self, machine: Machine, task: TaskId) -> TaskId:
        """A task's name, and the half of its machine."""
        side = self.sides.get(machine.key)
        return task if side is None else f"{task} of {side}"

    def stop_working(self, machine: Machine, task: TaskId, at: float, life: int) -> None:
        """A worker was seen to have stopped before the end that was told of it."""
        self.checker.stop_working(machine.key, self._sided(machine, task), at, life)

    # --- what a batch says -------------------------------------------------------------------------------------------

    def on_leaving(self, machine: Machine, instruction: do.Instruction, now: float) -> None:
        """What others will see, and what workers and relays do, must stand on this machine's disk."""
        if type(instruction) in _SAYS_NOTHING:
            return
        match instruction:
            case do.AnswerElection(request=request, answer=Promise() | Accepted() as answer):
                if request == FORGED:
                    raise InvariantError(f"{machine.key} said yes to a ballot that is not its asker's: {answer}")
                self._check_answer(machine, answer, now)
            case do.AnswerBallots() | do.SendBallots():
                for part in instruction.parts:
                    self.on_leaving(machine, part, now)
            case do.PublishBeat(beat=beat):
                for task, revision, _ in beat.learnt:
                    self._check_told(machine, task, revision)
            case do.PublishLearnt(learnt=learnt) | do.AnswerLearnt(learnt=learnt):
                for value in learnt.values:
                    self._check_told(machine, value.task, value.revision)
            case do.SendPrepare(prepare=prepare):
                self._check_ballot(machine, (prepare.task, prepare.creation), prepare.ballot, None)
            case do.SendAccept(accept=accept):
                name, held = (accept.task, accept.creation), accept.acceptance
                self._check_ballot(machine, name, held.ballot, held.value)
            case do.PublishProposal(proposal=proposal):
                _check_flags(machine, proposal)
                if not proposal.is_escape:
                    self._check_cap(machine, proposal)
            case do.SetRole(role=role) if role.role is WorkerRole.ACTIVE:
                self._check_epoch(machine, role.task, role.epoch)
            case _:
                pass

    @staticmethod
    def _register(machine: Machine, task: TaskId) -> RegisterState:
        return machine.disk.registers.get(task) or RegisterState(task=task)

    def _check_answer(self, machine: Machine, answer: Promise | Accepted, now: float) -> None:
        seat = None if machine.node is None else machine.node.agreement.is_elector
        if not machine.is_elector and not seat:
            raise InvariantError(f"{machine.key} is no elector and answered {answer}")
        held = self._register(machine, answer.task)
        if held.promised < answer.ballot:
            raise InvariantError(f"{machine.key} answered without its promise on disk: {answer}")
        if isinstance(answer, Accepted):
            if held.accepted is None or held.accepted.ballot < answer.ballot:
                raise InvariantError(f"{machine.key} answered without its acceptance on disk: {answer}")
            if held.accepted.ballot > answer.ballot:
                self._check_overtaken(machine, answer, now)
        floors = self._floors.get(machine.key, {})
        if answer.task in floors:
            floors[answer.task] = max(floors[answer.task], answer.ballot)
        # What it has accepted in the ballot of its promise came after the promise, both in one write.
        is_later = held.accepted is not None and held.accepted.ballot == answer.ballot
        is_last = held.promised == answer.ballot and not is_later
        if isinstance(answer, Promise) and is_last and held.accepted != answer.accepted:
            raise InvariantError(f"{machine.key} promised and told another acceptance than it has: {answer}")

    def _check_overtaken(self, machine: Machine, answer: Accepted, now: float) -> None:
        """An acceptance that is not on the disk: the same write holds a higher one that came after it."""
        floor = self._floors.get(machine.key, {}).get(answer.task)
        if floor is None or answer.ballot < floor:
            raise InvariantError(f"{machine.key} accepted below what it had promised: {answer}")
        name = answer.task, self._register(machine, answer.task).creation
        value = self.ballots.get((name, answer.ballot), ("", None))[1]
        if value is not None:
            ballot = str(Acceptance(ballot=answer.ballot, value=value))
            task = self._sided(machine, answer.task)
            stored = Stored(at=now, node=machine.key, task=task, revision=value.revision, ballot=ballot)
            self.take(stored)

    def _check_ballot(
        self, machine: Machine, task: tuple[TaskId, int], ballot: Ballot, value: Allocation | None
    ) -> None:
        """No two lives use one ballot, and it carries one value only."""
        life = f"{machine.key} life {machine.life}"
        first, carried = self.ballots.setdefault((task, ballot), (life, value))
        if first != life:
            raise InvariantError(f"{first} and {life} both use {ballot} for {task}")
        if value is not None and carried not in (None, value):
            raise InvariantError(f"{ballot} carries two values for {task}: {carried} and {value}")
        self.ballots[task, ballot] = (life, value or carried)

    def _check_cap(self, machine: Machine, proposal: Proposal) -> None:
        """A robot that has seen a minute's planned moves in this life proposes no more: counted from what it learnt.

        An operator's moves are not counted: by what a node learns, the order (`Allocation.asked`) is part of the value.
        """
        node = machine.node
        assert node is not None
        task = node.rounds.tasks[proposal.task]
        owner = node.registers[proposal.task].value.owner
        drained = {flag.subject for flag in node.agreement.flags if flag.kind in HANDS_OVER}
        if owner in (None, proposal.candidate) or owner in drained:
            return
        moves = sum(
            new.value.epoch > old.value.epoch
            and old.value.owner is not None
            and new.value.asked is None
            and task.judged_at - new.at <= WINDOW_S
            for old, new in pairwise(node.history[proposal.task])
            if not any(told in new.reason for told in DRAINED)
        )
        planned = moves - task.fuse.moves_within(WINDOW_S, task.judged_at, escapes=True)
        if planned >= task.spec.max_moves_per_minute:
            raise InvariantError(f"{machine.key} proposes move {planned + 1} of {proposal.task} within a minute")

    def _check_told(self, machine: Machine, task: TaskId, revision: int) -> None:
        if not revision % GENERATION_STEP or not _keeps_state(machine):
            return  # a generation's first value is no secret: a task that is new in the fleet file begins with it
        learnt = self._register(machine, task).learnt
        if learnt is None or learnt.revision < revision:
            raise InvariantError(f"{machine.key} told of {task} revision {revision}, which is not on its disk")

    def _check_epoch(self, machine: Machine, task: TaskId, epoch: int) -> None:
        if not _keeps_state(machine):
            return
        learnt = self._register(machine, task).learnt
        if learnt is None or learnt.epoch < epoch:
            raise InvariantError(f"{machine.key} carried out {task} epoch {epoch}, which is not on its disk")

    def on_plan(self, machine: Machine, plan: RoutePlan, now: float) -> None:
        """A relay is given a plan."""
        if plan.current is not None:
            epoch, owner = plan.current.epoch, plan.current.owner
            self._check_epoch(machine, plan.task, epoch)
            task = self._sided(machine, plan.task)
            self.take(Routed(at=now, node=machine.key, task=task, epoch=epoch, owner=owner))

    def on_worked(self, machine: Machine, role: Role, now: float, until: float) -> None:
        """A worker may work until a true time; without a lease that is infinity."""
        lease = role.lease_until_s
        work = Worked(
            at=now,
            node=machine.key,
            task=self._sided(machine, role.task),
            epoch=role.epoch,
            until=until,
            life=machine.life,
            is_leased=lease is not None,
            is_late=lease is not None and lease <= machine.late_until,
            has_forgotten=lease is None and self._has_forgotten(machine, role.task),
            is_shared=lease is None and self._is_shared(machine, role.task),
        )
        self.take(work)

    def _has_forgotten(self, machine: Machine, task: TaskId) -> bool:
        """Whether a machine knew a later revision in an earlier life than it knows now."""
        assert machine.node is not None
        return machine.node.registers[task].value.revision < self.newest.get((machine.key, task), 0)

    @staticmethod
    def _is_shared(machine: Machine, task: TaskId) -> bool:
        """Whether a machine has learnt a value of a task by which nobody needs a lease."""
        assert machine.node is not None
        value = machine.node.registers[task].value
        return value.revision > 0 and not value.leased

    # --- the loop ----------------------------------------------------------------------------------------------------

    def on_handled(self, machine: Machine, now: float, local: float) -> None:
        """An event was handled: the next deadline lies ahead, and a node without a disk has learnt for this life.

        Wakes in a short time are no sign of a loop that spins: 40 tasks have as many deadlines.
        """
        node = machine.node
        assert node is not None
        self._floors.pop(machine.key, None)
        due = node.next_deadline()
        if due < local:
            raise InvariantError(f"{machine.key}: next deadline {due:.6f} in the past of {local:.6f}")
        machine.at_once = machine.at_once + 1 if due == local else 0
        if machine.at_once > MAX_AT_ONCE:
            raise InvariantError(f"{machine.key}: wants to be called at once {machine.at_once} times: its loop spins")
        if not _keeps_state(machine):
            for register in node.registers.values():
                value = register.value
                if machine.known.get(value.task) is not value:
                    machine.known[value.task] = value
                    self.on_learnt(machine, value, now)


def _check_flags(machine: Machine, proposal: Proposal) -> None:
    """Nobody proposes to give a task to a node of which its document says that it takes nothing new."""
    node = machine.node
    assert node is not None
    owner, flags = node.registers[proposal.task].value.owner, node.agreement.flags
    if proposal.candidate != owner and proposal.candidate in {flag.subject for flag in flags}:
        raise InvariantError(f"{machine.key} proposes {proposal.candidate}, which takes nothing new: {flags}")


def _check_orders(before: Allocation, after: Allocation) -> None:
    """What an operator's orders allow between two revisions that follow each other."""
    if before.owner == after.owner:
        return
    if before.paused and after.asked is None:
        raise InvariantError(f"{after.task} was paused and moved by itself from {before.owner} to {after.owner}")
    if before.is_bound and after.owner != before.home:
        raise InvariantError(f"{after.task} is pinned to {before.home} (hard) and moved to {after.owner}")
    if before.pinned and after.asked is not None and after.owner != before.home:
        raise InvariantError(f"{after.task} is pinned to {before.home} and was moved by order to {after.owner}")


def _keeps_state(machine: Machine) -> bool:
    return machine.disk.state is not None and not machine.disk.is_broken and machine.is_durable


def are_same(values: Sequence[Allocation]) -> bool:
    """Whether all are equal. It is asked after every event: comparing with the first costs less than hashing each."""
    return all(value == values[0] for value in values[1:])


def unsettled(fleet: Fleet, machines: dict[str, Machine], works: dict[TaskId, tuple[NodeId, float]], now: float) -> str:
    """Why the fleet has not come to rest: every task must have a living, ready owner that all nodes and streams know.

    Args:
        fleet: the fleet file.
        machines: all of them; those that are down are not asked.
        works: {exclusive task: (who works, until when)}.
        now: true time.
    """
    running = [machine for machine in machines.values() if machine.node is not None]
    for task in fleet.tasks:
        values = [machine.node.registers[task.name].value for machine in running if machine.node is not None]
        if not values or not are_same(values):
            return f"{task.name}: nodes know different revisions {sorted({value.revision for value in values})}"
        value = values[0]
        owner = machines.get(value.owner or "")
        if owner is None or owner.node is None:
            return f"{task.name}: owner {value.owner} is not alive"
        if owner.node.worker_states.get(task.name) is not WorkerState.READY:
            return f"{task.name}: the worker of {value.owner} is not ready"
        for machine in running:
            executor = machine.node.executors[task.name] if machine.node is not None else None
            if executor is None or not executor.has_streams:
                continue
            if (executor.phase, executor.owner) != (Phase.SETTLED, value.owner):
                return f"{task.name}: streams of {machine.key} are {executor.phase} towards {executor.owner}"
        if task.exclusive and (works.get(task.name, ("", 0.0))[0] != value.owner or works[task.name][1] <= now):
            return f"{task.name}: {value.owner} has no lease"
    return _misjudged_electors(running)


def _misjudged_electors(running: list[Machine]) -> str:
    """What a node believes of an elector's state though that one's beats say otherwise; empty when all are right."""
    lives = Counter(machine.name for machine in running)
    for elector in running:
        if elector.node is None or lives[elector.name] != 1 or elector.name not in elector.node.fleet.electors:
            continue  # of twins the last beat counts
        has_lost = not elector.node.agreement.is_elector
        for machine in running:
            told = machine.node.stateless if machine.node is not None and machine is not elector else None
            if told is not None and (elector.name in told) != has_lost:
                return f"{machine.key} takes {elector.name}'s state for {'there' if has_lost else 'lost'}"
            if machine.node is None or has_lost or not machine.node.has_state:
                continue
            is_apart = elector.node.agreement.electorate != machine.node.agreement.electorate
            if (elector.name in machine.node.agreement.apart) != is_apart:
                return (
                    f"{machine.key} counts {elector.name} {'in' if is_apart else 'out'}; its electorate says otherwise"
                )
    return ""


def check_replayed(who: str, decision: Decision) -> None:
    """Raise `InvariantError` unless a judgement that was written down as JSON is made again, bit for bit."""
    written = from_plain(json.loads(json.dumps(as_plain(decision))), Decision)
    again = verdict_of(decide_again(written.figures).judgement)
    if again != decision.verdict:
        raise InvariantError(f"{who} judged {decision.verdict}, and by the same figures again {again}")
