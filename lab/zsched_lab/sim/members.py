"""Machines that come, go and lose what they knew, in a schedule of whole nodes.

Knows: the steps of ``invite``, ``join``, ``leave``, ``node remove`` and ``init``, as operators give them, and the
core's own functions for each. Does not know: recoveries (`zsched_lab.sim.recoveries`), other faults, what must hold at
the end (`zsched_lab.sim.fleets`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Final

from zsched.core.electorate.pilot import may_go
from zsched.core.electorate.recovery import (
    NEW_DISK,
    Sides,
    generation_of,
    new_member,
    rejoined,
)
from zsched.core.node.status import build_snapshot
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.messages import ChangeFleet
from zsched.core.values.model import NodeId, NodeKind, RegisterState
from zsched.core.values.quorum import majority
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import replace
from zsched.core.vote.generations import blank_state
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.simulator import Simulator

GUESTS: Final = ("robot5", "robot6", "edge3", "edge4")
STEPS: Final = ("join", "join", "leave", "die", "rollback", "clone", "lose")
LEAST_ROBOTS: Final = 2
MOST_DEAD: Final = 2
COPY: Final = "~"
"""Behind the key of a machine that was started from a copy of a disk."""
ASK_S: Final = 1.0
"""An operator gives a command again after so long."""


@dataclass(slots=True)
class Members:
    """Who comes and goes.

    Args:
        sim: the fleet.
        rng: what happens.
        tell: gives a command to a node, or to any.
        done: counts.
    """

    sim: Simulator
    rng: Random
    tell: Callable[[ChangeFleet, NodeId | None], int]
    done: Counter[str]
    generation_id: str = ""
    """Of the side that counts in the end."""
    dead: set[NodeId] = field(default_factory=set)
    """They never come back."""
    _is_calm: bool = False
    _invited: list[NodeId] = field(default_factory=list)
    _leaving: list[NodeId] = field(default_factory=list)
    _asked_at: dict[NodeId, float] = field(default_factory=dict)

    # --- what is so --------------------------------------------------------------------------------------------------

    def newest(self) -> FleetValue | None:
        """The newest chosen value."""
        judge = self.sim.documents.judge
        assert judge is not None
        return judge.newest_fleet(self.generation_id)

    def names(self) -> list[NodeId]:
        """The machines that are there for good, sorted."""
        return sorted(key for key in self.sim.machines if not key.endswith(COPY) and key not in self.dead)

    def said(self) -> tuple[FleetValue, Fleet, tuple[Flag, ...]] | None:
        """The newest value, what its document says, and its flags; ``None``: no document is agreed."""
        value = self.newest()
        content = None if value is None else self.sim.documents.contents.get(value.document)
        if value is None or content is None:
            return None
        return value, self.sim.documents.says[value.document], content.flags

    def can_agree(self) -> bool:
        """Whether a majority of the newest electors that anybody alive knows can answer."""
        known = [value for name in self.names() if (value := self._learnt(name)) is not None]
        known = [value for value in known if value.generation_id == self.generation_id]
        newest = max(known, key=lambda value: value.revision, default=None)
        judged = self.newest()
        values = [value for value in (newest, judged) if value is not None]
        return newest is not None and all(self._has_majority(value) for value in values)

    def _has_majority(self, value: FleetValue, without: NodeId = "") -> bool:
        return self._fit(value, without) >= majority(len(value.electors))

    def _fit(self, value: FleetValue, without: NodeId) -> int:
        """How many of the electors can answer, one left out."""
        fit = 0
        for seat in value.electors:
            state = self.sim.disk(seat.name) if seat.name in self.names() and seat.name != without else None
            fit += state is not None and seat.is_held_by(seat.name, state.disk) and not (state.lost or state.disputed)
        return fit

    def _learnt(self, name: NodeId) -> FleetValue | None:
        state = self.sim.disk(name)
        if state is None:
            return None
        if state.fleet_register is None or state.fleet_register.learnt is None:
            judge = self.sim.documents.judge
            assert judge is not None
            first = judge.values.get((generation_of(state), "", -1), {}).get(1)
            return first if isinstance(first, FleetValue) else None
        return state.fleet_register.learnt

    def _snapshots(self, *names: NodeId) -> list[Snapshot]:
        running = [name for name in names or self.names() if self.sim.machines[name].node is not None]
        return [
            build_snapshot(self.sim.node(name), self.sim.machines[name].clock.local(self.sim.now)) for name in running
        ]

    # --- steps -------------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Something happens."""
        getattr(self, f"_{self.rng.choice(STEPS)}")()

    def _join(self) -> None:
        """An operator invites a machine: it is written into the document."""
        free = [one for one in GUESTS if one not in self.sim.machines and one not in (*self.dead, *self._invited)]
        if self.said() is not None and free:
            self.invite(self.rng.choice(free))

    def invite(self, name: NodeId) -> None:
        """From now on an operator wants this machine in the fleet."""
        self._invited.append(name)
        self.done["invited"] += 1

    def _add(self, name: NodeId, value: FleetValue, fleet: Fleet, flags: tuple[Flag, ...]) -> None:
        """`zsched invite`: the machine is written into the document."""
        kind = NodeKind.ROBOT if name.startswith("robot") else NodeKind.EDGE
        nodes = tuple(sorted((*fleet.nodes, NodeSpec(name=name, kind=kind)), key=lambda node: node.name))
        tasks = tuple(replace(one, candidates=tuple(sorted((*one.candidates, name)))) for one in fleet.tasks)
        self._write(value, replace(fleet, nodes=nodes, tasks=tasks), flags)

    def _leave(self) -> None:
        """An operator takes a machine out that runs."""
        names = [name for name in self.names() if name not in self._leaving and self._may_miss(name)]
        if names and self.said() is not None:
            self._leaving.append(self.rng.choice(names))

    def _may_miss(self, name: NodeId) -> bool:
        left = [one for one in self.names() if one != name and one not in self._leaving]
        robots = [one for one in left if one.startswith("robot")]
        return len(robots) >= LEAST_ROBOTS and len(left) > len(robots)

    def _die(self) -> None:
        """A machine is lost for good; sometimes so many that nothing can be agreed any more."""
        names = [name for name in self.names() if self._may_miss(name) and self._spares(name)]
        if len(self.dead) < MOST_DEAD and names and self.said() is not None:
            self._bury(self.rng.choice(names))

    def _bury(self, name: NodeId) -> None:
        self.sim.crash(name, is_power_lost=self.rng.random() < 0.5)
        self.dead.add(name)
        self.done["dead"] += 1

    def _rollback(self) -> None:
        """A state folder is brought back from a backup."""
        machine = self.sim.machines[self.rng.choice(self.names())]
        if not self._spares(machine.key):
            return
        self.sim.crash(machine.key)
        if self.rng.random() < 0.5 and machine.disk.restore(self.rng):
            machine.is_durable = False
            self.done["rolled back"] += 1
        self.sim.later(self.rng.choice((0.2, 2.0)), self._start, machine)

    def _spares(self, name: NodeId) -> bool:
        """Whether a majority is left without this one's state; now and then it happens all the same."""
        value = self.newest()
        return value is None or self._has_majority(value, without=name) or self.rng.random() < 0.1

    def _lose(self) -> None:
        """A disk is lost for good, an elector's, too: `zsched init` there makes the machine another member."""
        held = self.said()
        machine = self.sim.machines[self.rng.choice(self.names())]
        if held is None or not self._spares(machine.key):
            return
        self.sim.crash(machine.key)
        machine.disk.wipe()
        machine.is_durable = False
        self.done["disk lost for init"] += 1
        self.sim.later(self.rng.choice((0.2, 2.0)), self._init, machine)

    def _init(self, machine: Machine) -> None:
        """`zsched init`, once the others answer; without a seat the machine is invited anew."""
        if machine.disk.state is not None or self.sim.machines.get(machine.key) is not machine:
            return
        answers = self._snapshots(*(name for name in self.names() if name != machine.key))
        side = new_member(machine.name, 0, answers)
        if side is not None:
            self._write_state(machine, self._blank_of(machine, side))
        elif not self._invite(machine, [one.node for one in answers]):
            self.sim.later(0.5, self._init, machine)
            return
        self._start(machine)

    def _blank_of(self, machine: Machine, side: Sides) -> DurableState:
        return rejoined(
            machine.fleet,
            machine.name,
            None,
            side,
            disk=self.sim.disk_id(),
            incarnation=self.sim.wall_count,
            hardware="",
            why=NEW_DISK,
        )

    def _clone(self) -> None:
        """A disk is copied to another machine: there its hardware differs, so it starts without a state."""
        name = self.rng.choice(self.names())
        key = f"{name}{COPY}"
        if key not in self.sim.machines and self.rng.random() < 0.4:
            self.sim.machines[key] = Machine(key=key, name=name, fleet=self.sim.machines[name].fleet)
            self.sim.start(key)
            self.sim.later(self.rng.choice((0.5, 3.0, 8.0)), self._end, key)
            self.done["cloned"] += 1

    def _end(self, key: str) -> None:
        if key in self.sim.machines:
            self.sim.crash(key)
            del self.sim.machines[key]

    def start(self, name: NodeId) -> None:
        """A machine comes back, if it is still there."""
        if name in self.sim.machines:
            self._start(self.sim.machines[name])

    def _start(self, machine: Machine) -> None:
        if machine.node is None and self.sim.machines.get(machine.key) is machine and machine.key not in self.dead:
            self.sim.start(machine.key)

    # --- what operators go on with -----------------------------------------------------------------------------------

    def go_on(self) -> None:
        """Invited machines come once they are in the document; leavers and the dead go, step by step."""
        held = self.said()
        if held is None:
            return
        value, fleet, flags = held
        stay = {node.name for node in fleet.nodes} - {*self._leaving, *self.dead}
        if stay <= {flag.subject for flag in flags} and self._is_due(""):
            self._write(value, fleet, tuple(flag for flag in flags if flag.subject not in stay))  # else nobody works
        for node in fleet.nodes:
            if node.name not in self.sim.machines and node.name not in self.dead:
                self._bring(node.name, fleet)
        named = {node.name for node in fleet.nodes}
        self._invited = [one for one in self._invited if one not in named or one not in self.sim.machines]
        for name in self._invited:
            if self._is_due(name) and name not in named:
                self._add(name, value, fleet, flags)
        for name in (*self._leaving, *sorted(self.dead)):  # a recovery may name a dead one that was taken out before it
            if (name in self.sim.machines or name in named) and self._is_due(name):
                self._take_out(name, value, fleet, flags)

    def _is_due(self, name: NodeId) -> bool:
        """Whether it is time to give the next command for a machine; a yes counts."""
        if self.sim.now - self._asked_at.get(name, -ASK_S) < ASK_S:
            return False
        self._asked_at[name] = self.sim.now
        return True

    def is_done(self) -> bool:
        """Whether nobody is on the way in or out."""
        held = self.said()
        names = set() if held is None else {node.name for node in held[1].nodes}
        return held is None or (names == set(self.sim.machines) and not self._invited)

    def _bring(self, name: NodeId, fleet: Fleet) -> None:
        """`zsched join` on the new machine; it may crash at once."""
        machine = Machine(key=name, name=name, fleet=fleet)
        doors = [one for one in self.names() if self.sim.machines[one].node is not None]
        if not self._invite(machine, doors):
            return
        self.sim.machines[name] = machine
        if name in self._invited:
            self._invited.remove(name)
        machine.is_durable = False
        first = self.rng.choice((0.0, 1.0, 5.0))
        self.sim.later(first, self._start, machine)
        self.done["joined"] += 1
        if self.rng.random() < 0.4:
            self.sim.later(first + self.rng.choice((0.05, 0.2, 1.0, 6.0)), self._stumble, machine)

    def _stumble(self, machine: Machine) -> None:
        """A machine dies while it joins: for a while, or for good."""
        if machine.node is None or self._is_calm or self.sim.machines.get(machine.key) is not machine:
            return
        self.done["died while it joined"] += 1
        if self.rng.random() < 0.3 and len(self.dead) < MOST_DEAD:
            self._bury(machine.key)
            return
        self.sim.crash(machine.key, is_power_lost=True)
        self.sim.later(self.rng.choice((0.2, 3.0)), self._start, machine)

    def _invite(self, machine: Machine, doors: list[NodeId]) -> bool:
        """Write the state of an invitation that some node gives, whose document names the machine."""
        self.rng.shuffle(doors)
        for door in doors:
            node = self.sim.node(door)
            value = node.agreement.fleet_value
            said = None if value is None else self.sim.documents.says.get(value.document)
            if value is None or said is None or all(one.name != machine.name for one in said.nodes):
                continue
            if value.electorate.seat(machine.name) is not None and not value.electorate.seat(machine.name).disk:  # type: ignore[union-attr]
                continue  # a seat of a fleet file: `zsched init` has to say that it is not this disk's
            state = blank_state(
                said,
                machine.name,
                node.agreement.generation or 0,
                None,
                incarnation=self.sim.wall_count,
                hardware="",
                disk=self.sim.disk_id(),
            )
            register = RegisterState(task=said.name, learnt=value)
            machine.fleet = said
            self._write_state(machine, replace(state, registers=(), fleet_register=register))
            machine.disk.documents.append(value.document)
            return True
        return False

    def _write_state(self, machine: Machine, state: DurableState) -> None:
        """As every command that writes a state: the operator has stopped the daemon, which locks the folder."""
        if machine.node is not None:
            self.sim.crash(machine.key)
        machine.disk.write(state)
        machine.disk.sync()

    def _write(self, value: FleetValue, fleet: Fleet, flags: tuple[Flag, ...], door: NodeId | None = None) -> None:
        content = self.sim.documents.write(fleet, flags)
        self.tell(ChangeFleet(document=content, base_revision=value.revision), door)

    def _take_out(self, name: NodeId, value: FleetValue, fleet: Fleet, flags: tuple[Flag, ...]) -> None:
        """The next step of `zsched leave`, or for a dead one of `zsched node remove`."""
        machine = self.sim.machines.get(name)
        others = [one for one in self.sim.running() if self.sim.machines[one].name != name]
        if not others:
            return
        door = self.rng.choice(others)
        is_dead = name in self.dead
        if all(node.name != name for node in fleet.nodes):
            self._end(name)
            if name in self._leaving:
                self._leaving.remove(name)
            self.done["removed" if is_dead else "left"] += 1
        elif not is_dead and all((one.kind, one.subject) != (FlagKind.LEAVE, name) for one in flags):
            made = Flag(kind=FlagKind.LEAVE, subject=name, revision=value.revision + 1)
            self._write(value, fleet, (*(one for one in flags if one.subject != name), made), door)
        elif value.electorate.seat(name) is not None:
            if (
                value.settled
                and self._can_do_without(value, name)
                and not (self._pilot_can(value, fleet) if is_dead else fleet.is_auto)
            ):
                self.tell(ChangeFleet(remove_elector=name), door)
        elif is_dead or self._has_learnt_that(machine):
            nodes = tuple(node for node in fleet.nodes if node.name != name)
            kept = tuple(
                replace(one, candidates=tuple(other for other in one.candidates if other != name))
                for one in fleet.tasks
            )
            self._write(
                value,
                replace(fleet, nodes=nodes, tasks=kept),
                tuple(one for one in flags if one.subject != name),
                door,
            )

    def _can_do_without(self, value: FleetValue, name: NodeId) -> bool:
        """Whether the other electors can agree without it; an operator who is told of a lost state waits."""
        return self._fit(value, name) >= majority(max(1, len(value.electors) - 1))

    @staticmethod
    def _pilot_can(value: FleetValue, fleet: Fleet) -> bool:
        """Whether the electors replace a dead one by themselves: three do not become two without a spare."""
        return len(value.electors) > 3 and fleet.is_auto

    @staticmethod
    def _has_learnt_that(machine: Machine | None) -> bool:
        if machine is None or machine.node is None:
            return False
        known = machine.node.agreement.fleet_value
        return known is not None and may_go(known, machine.name)

    # --- the end of faults -------------------------------------------------------------------------------------------

    def calm(self) -> None:
        """Copies go; whoever is disputed is settled by its operator."""
        self._is_calm = True
        for key in [key for key in self.sim.machines if key.endswith(COPY)]:
            self._end(key)
        self.settle_disputes()
        for name in self.names():
            machine = self.sim.machines[name]
            if machine.disk.state is None:
                self._init(machine)

    def settle_disputes(self) -> None:
        """`zsched fleet recover --settle` where another machine had the name."""
        for name in self.names():
            machine = self.sim.machines[name]
            state = machine.disk.state
            if state is not None and state.disputed:
                self.sim.crash(name)
                assert machine.disk.state is not None
                self._write_state(machine, replace(machine.disk.state, disputed=""))
                self.done["dispute settled"] += 1

    def start_all(self) -> None:
        """Whoever is there, and has a state, runs."""
        for name in self.names():
            if self.sim.machines[name].disk.state is not None:
                self._start(self.sim.machines[name])
