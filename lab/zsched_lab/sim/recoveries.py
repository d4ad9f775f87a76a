"""Recoveries in a schedule of whole nodes: one survivor of a lost majority, or one of each half.

Knows: the steps of ``recover`` and ``rejoin``, that two generations show each other. Does not know: who comes and goes
(`zsched_lab.sim.members`), what must hold at the end (`zsched_lab.sim.fleets`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

from zsched.core.electorate.recovery import (
    Found,
    Recovery,
    Sides,
    choose_side,
    consider,
    generation_of,
    is_named_in,
    rejoined,
    sides_of,
)
from zsched.core.values import codec as wire
from zsched.core.values.model import NodeId
from zsched.core.values.problems import Problem
from zsched_lab.sim.checks import DisagreementError
from zsched_lab.sim.members import Members
from zsched_lab.sim.parts import Machine

SHOWN_S: Final = 8.0
"""So long after a cut a node knows that a peer is of another generation."""
LEAST_OF_TWO: Final = 4
"""So many nodes make two halves of two."""


@dataclass(slots=True)
class Recoveries(Members):
    """Who comes and goes, and what survivors begin."""

    def recover(self) -> bool:
        """`fleet recover` on one survivor, `fleet recover --rejoin` on the others; whether one has begun."""
        before = self.generation_id
        ours = [name for name in self.names() if self._generation(name) == before]
        done = self._begin_on_one_of(ours)
        if done is None:
            return False
        survivor, self.generation_id = done
        self.sim.start(survivor)
        others = [name for name in self.names() if name != survivor]
        self._check_strangers([survivor], [name for name in others if self._generation(name) != self.generation_id])
        self._bring_over(others)
        self._invite_again()
        return True

    def _invite_again(self) -> None:
        """What the survivor did not know is lost: also that a machine was written into the document."""
        held = self.said()
        named = set() if held is None else {node.name for node in held[1].nodes}
        gone = (*named, *self._invited, *self._leaving)
        self._invited += [] if held is None else [one for one in self.names() if one not in gone]

    def _generation(self, name: NodeId) -> str:
        state = self.sim.disk(name)
        return "" if state is None else generation_of(state)

    def _begin_on_one_of(self, names: list[NodeId]) -> tuple[NodeId, str] | None:
        """Recover on the first of these that may; (who, the new generation's id)."""
        known = {name: value.revision for name in names if (value := self._learnt(name)) is not None}
        for name in sorted(known, key=lambda name: (-known[name], name)):
            machine = self.sim.machines[name]
            self.sim.crash(name)
            own = machine.disk.state
            brought = [
                state
                for dead in sorted(self.dead)
                if dead in self.sim.machines and (state := self.sim.disk(dead)) is not None and self.rng.random() < 0.5
            ]
            for lost in sorted(machine.disk.named() - set(machine.disk.documents)):
                if any(lost in self.sim.machines[other].disk.documents for other in self.names()):
                    machine.disk.documents.append(lost)  # the operator copies the file
                    self.done["document brought"] += 1
            documents = {one: self.sim.documents.says[one] for one in machine.disk.documents}
            file_hash = wire.document_hash(self.sim.documents.write(machine.fleet))
            found = Found(
                fleet=machine.fleet,
                me=name,
                own=own,
                others=tuple(
                    state for state in brought if own is not None and generation_of(state) == generation_of(own)
                ),
                answers=tuple(self._snapshots(*(one for one in names if one != name))),
                documents=documents,
                file_hash=file_hash,
            )
            recovery = consider(found)
            if isinstance(recovery, Recovery):
                self._carry_out(machine, recovery, file_hash)
                self.done["recovered"] += 1
                return name, self._generation(name)
            self.sim.start(name)
        return None

    def _carry_out(self, machine: Machine, recovery: Recovery, file_hash: str) -> None:
        state = recovery.carry_out(
            generation_id=f"{self.rng.getrandbits(128):032x}",
            disk=self.sim.disk_id(),
            incarnation=self.sim.wall_count,
            hardware="",
        )
        held = state.fleet_register
        assert held is not None
        assert held.learnt is not None
        if recovery.agreed is not None:
            machine.disk.documents.append(file_hash)
        elif held.learnt.document not in machine.disk.documents:
            machine.disk.documents.append(held.learnt.document)  # it lay beside a state that was brought
        judge = self.sim.documents.judge
        assert judge is not None
        judge.begin(held.learnt, state.registers)
        begun = {(one.task, one.learnt.revision) for one in state.registers if one.learnt is not None}
        self.sim.invariants.recovered |= begun
        self._write_state(machine, state)

    def _bring_over(self, names: list[NodeId]) -> None:
        """`zsched fleet recover --rejoin` on each of these, in some order."""
        self.rng.shuffle(names)
        sides = self.sim.invariants.sides
        half = next((sides.get(one) for one in self.names() if self._generation(one) == self.generation_id), None)
        for name in names:
            if self._generation(name) == self.generation_id:
                continue
            machine = self.sim.machines[name]
            self.sim.crash(name)
            own = machine.disk.state
            answers = self._snapshots(*(one for one in self.names() if one != name))
            sides_told = sides_of(answers)
            self._bring_document(machine, sides_told)
            side = choose_side(machine.fleet, own, sides_told, self.generation_id)
            if isinstance(side, str):
                raise DisagreementError(f"{name} cannot change sides: {side}")
            machine.is_durable = False
            sides.pop(name, None)
            if half is not None:
                sides[name] = half
            state = rejoined(
                machine.fleet, name, own, side, disk=self.sim.disk_id(), incarnation=self.sim.wall_count, hardware=""
            )
            machine.disk.wipe()
            self._write_state(machine, state)
            self.sim.start(name)
            self.done["rejoined"] += 1
            self.sim.run(self.rng.choice((0.0, 0.3, 2.0)))

    def _bring_document(self, machine: Machine, told: tuple[Sides, ...], generation_id: str = "") -> None:
        """`zsched fleet recover --rejoin` asks for it where the fleet file names nobody of the generation to follow."""
        wanted = generation_id or self.generation_id
        side = next((one for one in told if one.generation_id == wanted), None)
        judge = self.sim.documents.judge
        assert judge is not None
        value = judge.newest_fleet(wanted)
        if side is not None and not is_named_in(machine.fleet, side):
            machine.fleet = self.sim.documents.says[value.document]
            self.done["document brought"] += 1

    def _check_strangers(self, one_side: list[NodeId], other_side: list[NodeId]) -> None:
        """Nodes of two generations show each other, and nothing of the other's is learnt."""
        pairs = [(a, b) for a in one_side for b in other_side]
        pairs = [pair for pair in pairs if all(self.sim.machines[name].node is not None for name in pair)]

        def show() -> bool:
            told = {name: self._strangers_of(name) for name in (*one_side, *other_side) if name in self.sim.running()}
            return all(
                there in told[here]
                for a, b in pairs
                for here, there in ((a, b), (b, a))
                if here in told and there in told
            )

        if not self.sim.run_until(show, SHOWN_S):
            raise DisagreementError(f"not all of {one_side} and {other_side} show that they are strangers")

    def _strangers_of(self, name: NodeId) -> set[NodeId]:
        """Whom a node shows as of another generation, whether or not its own document names them."""
        node, now = self.sim.node(name), self.sim.machines[name].clock.local(self.sim.now)
        told = (*node.agreement.problems, *node.knocking.problems(now))
        return {subject for kind, subject in told if kind == Problem.GENERATION}

    def halves(self) -> None:
        """The fleet is cut in two, each half is recovered that cannot agree, and the cut heals.

        Then one of them goes on, and the others change sides.
        """
        names = [name for name in self.names() if self._generation(name) == self.generation_id]
        if len(names) < LEAST_OF_TWO or self.said() is None:
            return
        self.rng.shuffle(names)
        at = self.rng.randint(2, len(names) - 2)
        halves = [sorted(names[:at]), sorted(names[at:])]
        self.sim.heal()
        self.sim.cut(*map(tuple, halves))
        self.sim.run(self.rng.choice((0.5, 4.0)))
        before, begun = self.generation_id, []
        for half in halves:
            done = self._begin_on_one_of(half)
            if done is not None:
                begun.append(done)
                side = f"side {len(begun)}"
                self.sim.invariants.sides[done[0]] = side
                self.sim.start(done[0])
                self._bring_half_over(half, done, side)
        self.sim.run(self.rng.choice((1.0, 6.0)))
        self.sim.heal()
        self.sim.cuts.clear()
        if not begun:
            return
        self.done["halves" if len(begun) > 1 else "a half"] += 1
        sides: dict[str, list[NodeId]] = {}
        for name in self.names():
            sides.setdefault(self._generation(name), []).append(name)
        told = [side for _, side in sorted(sides.items())]
        for one, other in itertools.combinations(told, 2):
            self._check_strangers(one, other)
        self.generation_id = self.rng.choice([before] if len(begun) == 1 else [one for _, one in begun])
        self._bring_over([name for name in self.names() if self._generation(name) != self.generation_id])

    def _bring_half_over(self, half: list[NodeId], done: tuple[NodeId, str], side: str) -> None:
        """The others of a half follow who was recovered in it; some stay behind."""
        survivor, generation_id = done
        for name in half:
            if name == survivor or self.rng.random() < 0.3:
                continue
            machine = self.sim.machines[name]
            self.sim.crash(name)
            own = machine.disk.state
            sides_told = sides_of(self._snapshots(survivor))
            self._bring_document(machine, sides_told, generation_id)
            chosen = choose_side(machine.fleet, own, sides_told, generation_id)
            if isinstance(chosen, str):
                raise DisagreementError(f"{name} cannot change sides: {chosen}")
            state = rejoined(
                machine.fleet, name, own, chosen, disk=self.sim.disk_id(), incarnation=self.sim.wall_count, hardware=""
            )
            machine.is_durable = False
            self.sim.invariants.sides[name] = side
            machine.disk.wipe()
            self._write_state(machine, state)
            self.sim.start(name)
            self.done["rejoined"] += 1
