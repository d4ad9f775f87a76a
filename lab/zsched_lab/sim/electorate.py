"""Plays electors that change, by seed: ``python -m zsched_lab.sim.electorate --seed 0 --runs 1000``.

Knows: the faults of a schedule, how it ends, what is counted. Does not know: how machines work
(`zsched_lab.sim.electors`), what must hold all the time (`zsched_lab.sim.chosen`).

Nothing here is timed: a message may arrive at any later moment, in any order, twice or never, and a machine's time may
come at any moment. When the faults are over, machines that can agree must do so: the newest change is settled, and a
task's owner can be moved.
"""

from __future__ import annotations

import sys
from collections import Counter
from random import Random
from typing import Final

from zsched.core.electorate.changes import AddElector, RemoveElector, SetDocument, SetLease
from zsched.core.values.change import RoundOutcome
from zsched.core.values.electorate import FleetValue
from zsched.core.values.quorum import majority
from zsched_lab.sim.chosen import ChosenError
from zsched_lab.sim.electors import Machine, Machines
from zsched_lab.sim.seeds import Played, play_seeds

NAMES: Final = tuple("abcdefgh")
TASKS: Final = ("t1", "t2", "t3", "t4")
CALM_S: Final = 12.0
LOOKS: Final = 4


class Swarm:
    """One schedule."""

    def __init__(self, seed: int, *, clones: bool = True, recoveries: bool = True) -> None:
        self.rng = rng = Random(seed)
        names = NAMES[: rng.randint(2, len(NAMES))]
        tasks = [(task, rng.random() < 0.3) for task in TASKS[: rng.randint(1, 3)]]
        self.world = Machines(names, electors=min(rng.randint(1, 5), len(names)), tasks=tasks, seed=seed)
        self.steps = rng.choice((120, 300, 700))
        self.counts: Counter[str] = Counter()
        self.has_recovered = False
        rate = rng.choice((0.0, 0.003, 0.02))
        self.world.is_cut = lambda: self.is_faulty and rng.random() < rate
        self.is_faulty = True
        self.deaths = rng.choice((0, 0, 1, 2, 4))
        self.lost = rng.choice((0, 0, 1, 2))
        self.clones = rng.choice((0, 0, 1)) if clones else 0
        self.recoveries = rng.choice((0, 0, 0, 0, 1, 2)) if recoveries else 0
        self.sleepers = frozenset(rng.sample(names, rng.choice((0, 0, 1, 1, 2)) if len(names) > 2 else 0))
        """Machines that hear hardly anything, and try again and again with what they know."""
        stir, fault = rng.choice((0.04, 0.1)), rng.choice((0.003, 0.01, 0.03))
        weights = {
            self.deliver: 1.0,
            self.tick: rng.choice((0.1, 0.3)),
            self.drop: rng.choice((0.0, 0.05, 0.2)),
            self.double: rng.choice((0.0, 0.05)),
            self.move: stir,
            self.change: rng.choice((0.02, 0.05, 0.1)),
            self.look: 0.03,
            self.tell: rng.choice((0.03, 0.1)),
            self.crash: fault,
            self.lose: fault,
            self.die: fault,
            self.clone: fault,
            self.recover: fault,
        }
        self.actions, self.weights = tuple(weights), tuple(weights.values())

    def run(self) -> Played:
        """Faults, then calm."""
        played = Played(counts=self.counts)
        try:
            for _ in range(self.steps):
                self.rng.choices(self.actions, self.weights)[0]()
            self.is_faulty = False
            self._calm()
        except ChosenError as error:
            played.violation = str(error)
        for change, outcome in self.world.ended:
            if outcome is RoundOutcome.COMMITTED:
                self.counts[type(change).__name__] += 1
        return played

    # --- what may happen ---------------------------------------------------------------------------------------------

    def _one(self) -> Machine | None:
        up = [machine for machine in self.world.machines if machine.is_up]
        return self.rng.choice(up) if up else None

    def deliver(self) -> None:
        """Some message arrives, at every machine of its name or at one."""
        pool = self.world.pool
        if not pool:
            self.tick()
            return
        index = 0 if self.rng.random() < 0.3 else self.rng.randrange(len(pool))
        message = pool.pop(index)
        if message.to in self.sleepers and self.rng.random() < 0.9:
            return
        machines = [machine for machine in self.world.machines if machine.name == message.to]
        for machine in machines if self.rng.random() < 0.5 else [self.rng.choice(machines)]:
            self.world.deliver(message, machine)

    def tick(self) -> None:
        """Some machine's time has come."""
        machine = self._one()
        if machine is not None:
            self.world.tick(machine)

    def drop(self) -> None:
        """Some message is lost, or all that one machine has sent."""
        pool = self.world.pool
        if pool and self.rng.random() < 0.9:
            pool.pop(self.rng.randrange(len(pool)))
        elif pool:
            sender = self.rng.choice(pool).sender
            pool[:] = [message for message in pool if message.sender != sender]

    def double(self) -> None:
        """Some message is under way twice."""
        pool = self.world.pool
        if pool:
            pool.append(self.rng.choice(pool))

    def move(self) -> None:
        """Some machine proposes another owner of some task."""
        machine = self._one()
        if machine is not None and machine.registers:
            self.world.move(machine, self.rng.choice(sorted(machine.registers)))

    def change(self) -> None:
        """Some machine proposes a change of the fleet."""
        machine = self._one()
        if machine is None or machine.roll is None:
            return
        value = machine.roll.value
        kind, base = self.rng.random(), value.revision
        others = [one for one in self.world.machines if value.electorate.seat(one.name) is None]
        if kind < 0.45 and others and len(value.electors) < 5:
            other = self.rng.choice(others)
            self.world.change(machine, AddElector(base_revision=base, name=other.name, disk=other.disk.id))
        elif kind < 0.8:
            name = self.rng.choice(value.electors).name
            self.world.change(machine, RemoveElector(base_revision=base, name=name))
        elif kind < 0.95:
            tasks = tuple((task, self.rng.random() < 0.3) for task in TASKS if self.rng.random() < 0.6)
            document = f"{self.rng.getrandbits(32):08x}"
            self.world.change(machine, SetDocument(base_revision=base, document=document, tasks=tasks))
        else:
            self.world.change(machine, SetLease(base_revision=base, lease_s=self.rng.choice((0.5, 1.0, 2.0))))

    def look(self) -> None:
        """Some machine runs an identity round, of the fleet register or of a task's."""
        machine = self._one()
        if machine is not None:
            self.world.look(machine)

    def tell(self) -> None:
        """Some machine tells another what it has learnt."""
        machine, other = self._one(), self._one()
        if machine is not None and other is not None and machine.name != other.name:
            self.world.tell(machine, other.name)

    def crash(self) -> None:
        """Some machine crashes and is back."""
        machine = self._one()
        if machine is not None:
            self.world.restart(machine)

    def lose(self) -> None:
        """Some machine loses its disk."""
        machine = self._one()
        if machine is not None and self.lost:
            self.lost -= 1
            self.counts["lost disks"] += 1
            self.world.lose_disk(machine)

    def die(self) -> None:
        """Some machine never comes back."""
        machine = self._one()
        if machine is not None and self.deaths:
            self.deaths -= 1
            self.counts["deaths"] += 1
            self.world.stop(machine)

    def clone(self) -> None:
        """Some machine's disk is copied to another one."""
        machine = self._one()
        if machine is not None and machine.roll is not None and self.clones:
            self.clones -= 1
            self.counts["clones"] += 1
            self.world.clone(machine)

    def recover(self) -> None:
        """Some machine is made the only elector of a new generation."""
        machine = self._one()
        if machine is not None and machine.roll is not None and self.recoveries:
            self.recoveries -= 1
            self.has_recovered = True
            self.counts["recoveries"] += 1
            self.world.recover(machine)

    # --- how it ends -------------------------------------------------------------------------------------------------

    def _calm(self) -> None:
        """No more faults: who can agree does so."""
        for _ in range(LOOKS):
            self.world.share()
            for machine in self.world.machines:
                if machine.is_up:
                    self.world.look(machine)
            self.world.run(for_s=CALM_S)
        self.world.share()
        if self.has_recovered or self.clones_are_there():
            return
        newest = self.world.chosen.newest_fleet(self.world.first.generation_id)
        able = self._able(newest)
        if not able:
            self.counts["beyond"] += 1
            return
        self.counts["live"] += 1
        if not newest.settled:
            raise ChosenError(f"not settled long after the faults: number {newest.number}")
        for creation in newest.tasks:
            if not any(self._moves(able[0], creation.task) for _ in range(LOOKS)):
                raise ChosenError(f"{creation.task} cannot be moved long after the faults")

    def _moves(self, machine: Machine, task: str) -> bool:
        """Whether a move is committed; one that finds an older change of somebody else's is not."""
        owner = self.world.move(machine, task)
        self.world.run(for_s=CALM_S)
        return machine.registers[task].value.owner == owner

    def clones_are_there(self) -> bool:
        """Whether two machines have one name."""
        return len({machine.name for machine in self.world.machines}) < len(self.world.machines)

    def _able(self, newest: FleetValue) -> list[Machine]:
        """The electors that are up, when they are a majority; none, when too many are lost or nobody has learnt it."""
        up = [one for one in self.world.machines if one.is_up]
        electors = [one for one in up if any(seat.is_held_by(one.name, one.disk.id) for seat in newest.electors)]
        is_known = any(one.roll is not None and one.roll.value.revision == newest.revision for one in up)
        return electors if is_known and len(electors) >= majority(len(newest.electors)) else []


def play(seed: int) -> Played:
    """Play one seed."""
    return Swarm(seed).run()


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    return play_seeds("zsched_lab.sim.electorate", __doc__, play, arguments, runs=1000)


if __name__ == "__main__":
    sys.exit(main())
