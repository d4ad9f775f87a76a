"""Plays electors by themselves, in time, by seed: ``python -m zsched_lab.sim.pilot --seed 0 --runs 200``.

Knows: the faults of a schedule, what must be so when they are over. Does not know: how machines work
(`zsched_lab.sim.piloted`), what must hold all the time (`zsched_lab.sim.chosen`, and that no two work at once).

A schedule has faults for a while: links that are deaf, machines that are cut off, pause, churn, crash, die, lose their
disk, are copied, leave. Then it is calm: if a majority of the electors is there, the fleet must settle, have as many
electors as it can, all of them alive, and move its tasks.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Final

from zsched.core.electorate.changes import AddElector, FleetChange, RemoveElector, SetAway
from zsched.core.electorate.pilot import STEADY, TARGET
from zsched.core.values.electorate import FleetValue
from zsched.core.values.model import NodeId
from zsched.core.values.quorum import majority
from zsched_lab.sim.chosen import ChosenError
from zsched_lab.sim.electors import Machine
from zsched_lab.sim.piloted import SILENCE_S, Piloted
from zsched_lab.sim.seeds import Played, play_seeds

ROBOTS: Final = ("r1", "r2", "r3", "r4")
EDGES: Final = ("e1", "e2", "e3", "e4")
FAULTS_S: Final = (10.0, 20.0, 40.0)
CALM_S: Final = 40.0
LOOK_S: Final = 0.5
TRIES: Final = 12


class Schedule:
    """One schedule."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = Random(seed)
        names = [*ROBOTS[: rng.randint(1, 4)], *EDGES[: rng.randint(0, 4)]]
        rng.shuffle(names)
        tasks = [("t1", True), ("t2", False)][: rng.randint(1, 2)]
        self.world = Piloted(names, electors=min(rng.randint(1, 5), len(names)), tasks=tasks, seed=seed)
        self.names, self.tasks = names, [task for task, _ in tasks]
        self.world.cut = self._is_cut
        self.counts = self.world.counts
        self.deaf: set[tuple[NodeId, NodeId]] = set()
        self.until: dict[tuple[str, str], float] = {}
        """{(fault, node): when it is over}."""
        self.churning: dict[NodeId, float] = {}
        """{machine: since when it is away 3 s in 6}."""
        self.faults: tuple[Callable[[Machine], None], ...] = tuple(
            rng.sample([self.deafen, self.cut_off, self.pause, self.churn, self.crash, self.die, self.lose, self.copy,
                        self.leave], rng.randint(1, 4))
        )  # fmt: skip
        self.deaths = rng.randint(0, 3)

    def _is_cut(self, sender: NodeId, to: NodeId) -> bool:
        now = self.world.time
        if (sender, to) in self.deaf or ("cut", sender) in self.until or ("cut", to) in self.until:
            return True
        away = [one for one in (sender, to) if one in self.churning]
        return any((now - self.churning[one]) % 6.0 < 3.0 for one in away)

    def run(self) -> Played:
        """Faults, then calm."""
        played = Played(counts=self.counts)
        try:
            ends_at = self.rng.choice(FAULTS_S)
            while self.world.time < ends_at:
                up = [one for one in self.world.machines if one.is_up]
                if up and self.rng.random() < 0.2:
                    self.rng.choice(self.faults)(self.rng.choice(up))
                self._move()
                self.world.pass_time(LOOK_S)
                self._end_faults()
            self._calm()
        except ChosenError as error:
            played.violation = str(error)
        for change in self.world.changes():
            self.counts[type(change).__name__] += 1
        return played

    def _move(self) -> None:
        machine = self.rng.choice(self.world.machines)
        if machine.is_up and machine.registers and self.rng.random() < 0.3:
            self.world.move_to(machine, self.rng.choice(sorted(machine.registers)), self.rng.choice(self.names))

    def _end_faults(self, *, is_all: bool = False) -> None:
        for (kind, name), at in tuple(self.until.items()):
            if is_all or self.world.time >= at:
                del self.until[kind, name]
                if kind == "pause":
                    for machine in self.world.machines:
                        if str(id(machine)) == name:
                            self.world.wake(machine)

    # --- faults ------------------------------------------------------------------------------------------------------

    def deafen(self, machine: Machine) -> None:
        """A machine does not hear one other, or nobody hears it, or it hears nobody."""
        self.counts["deaf"] += 1
        others = [name for name in self.names if name != machine.name]
        kind = self.rng.randrange(3)
        for other in others if kind else others[:1]:
            self.deaf.add((other, machine.name) if kind < 2 else (machine.name, other))
        if self.rng.random() < 0.5:
            self.deaf.clear()

    def cut_off(self, machine: Machine) -> None:
        """A machine has no network for a while."""
        self.counts["cut off"] += 1
        self.until["cut", machine.name] = self.world.time + self.rng.choice((0.5, 2.0, 8.0))

    def pause(self, machine: Machine) -> None:
        """A machine, or all of them, stand still for a while."""
        self.counts["paused"] += 1
        for one in self.world.machines if self.rng.random() < 0.3 else [machine]:
            self.world.pause(one)
            self.until["pause", str(id(one))] = self.world.time + self.rng.choice((0.5, 2.0, 5.0))

    def churn(self, machine: Machine) -> None:
        """A machine is away 3 s in 6, or is not any more."""
        self.counts["churn"] += 1
        if self.churning.pop(machine.name, None) is None:
            self.churning[machine.name] = self.world.time

    def crash(self, machine: Machine) -> None:
        """A machine crashes and is back."""
        self.counts["crashed"] += 1
        self.world.restart(machine)

    def die(self, machine: Machine) -> None:
        """A machine never comes back."""
        if self.deaths and sum(one.is_up for one in self.world.machines) > 1:
            self.deaths -= 1
            self.counts["died"] += 1
            self.world.stop(machine)

    def lose(self, machine: Machine) -> None:
        """A machine loses its disk; one at a time, for two lost at once may be a majority."""
        if machine.roll is not None and self._spares(machine):
            self.counts["lost disks"] += 1
            self.world.lose_disk(machine)

    def copy(self, machine: Machine) -> None:
        """A second machine starts with a copy of the disk and the same name."""
        if len(self.world.machines) == len(self.names) and machine.roll is not None:
            self.counts["copied"] += 1
            self.world.clone(machine)

    def leave(self, machine: Machine) -> None:
        """An operator takes a machine out."""
        if len(self.world.leaving) < 2 and len(self.names) > 3:
            self.counts["leaving"] += 1
            self.world.leaving.add(machine.name)

    def _spares(self, machine: Machine) -> bool:
        """Whether a majority of the newest electors is there without this one."""
        newest = self._newest()
        there = [one for one in self._able(newest) if one is not machine]
        return len(there) >= majority(len(newest.electors)) and newest.settled

    # --- calm --------------------------------------------------------------------------------------------------------

    def _newest(self) -> FleetValue:
        return self.world.chosen.newest_fleet(self.world.first.generation_id)

    def _able(self, value: FleetValue) -> list[Machine]:
        up = [one for one in self.world.machines if one.is_up]
        return [one for one in up if any(seat.is_held_by(one.name, one.disk.id) for seat in value.electors)]

    def _calm(self) -> None:
        self.deaf.clear()
        self.churning.clear()
        self._end_faults(is_all=True)
        world, newest = self.world, self._newest()
        able = self._able(newest)
        knowing = [one for one in world.machines if one.roll is not None and one.roll.value.revision == newest.revision]
        if len(able) < majority(len(newest.electors)) or not knowing:
            self.counts["beyond"] += 1
            world.pass_time(5.0)
            return
        self.counts["live"] += 1
        world.pass_time(CALM_S)
        before = self._newest()
        world.pass_time(3 * STEADY * SILENCE_S)
        value = self._newest()
        if value != before and len({one.name for one in world.machines}) == len(world.machines):
            raise ChosenError(f"electors still change in the calm: {before.electorate.names}, {value.electorate.names}")
        self._check_electors(value)
        for task in self.tasks:
            if not any(self._moves(task) for _ in range(TRIES)):
                raise ChosenError(f"{task} cannot be moved long after the faults")

    def _check_electors(self, value: FleetValue) -> None:
        if not value.settled:
            raise ChosenError(f"number {value.number} is not settled long after the faults")
        able = [one.name for one in self._able(value)]
        twins = Counter(one.name for one in self.world.machines if one.is_up)
        fit = [name for name, count in twins.items() if count == 1 and name not in self.world.leaving]
        fit = [name for name in fit if value.electorate.seat(name) is None]
        dead = [name for name in value.electorate.names if name not in able]
        most = min(TARGET, len(able) + len(fit) - 1 + (len(able) + len(fit)) % 2)
        has_room = len(able) >= majority(len(value.electors) + 1) or (len(value.electors) == 1 and len(fit) > 1)
        if has_room and able and len(able) < most:
            raise ChosenError(f"electors {value.electorate.names}, alive {able}, and {fit} are to spare")
        if dead and len(value.electors) > 3:
            raise ChosenError(f"{dead} are dead and still electors of {value.electorate.names}")
        left = [name for name in value.electorate.names if name in self.world.leaving]
        if left and len(value.electors) > 1:
            raise ChosenError(f"{left} leave and are still electors of {value.electorate.names}")

    def _moves(self, task: str) -> bool:
        world = self.world
        up = [one for one in world.machines if one.is_up and one.roll is not None and task in one.registers]
        machine, owner = self.rng.choice(up), self.rng.choice(up).name
        world.move_to(machine, task, owner)
        world.pass_time(4.0)
        return machine.registers[task].value.owner == owner


def summary(changes: list[FleetChange]) -> str:
    """Changes of the electors and of the robots that are away, in short: ``-b +c``."""
    words = []
    for change in changes:
        if isinstance(change, AddElector):
            words.append(f"+{change.name}")
        elif isinstance(change, RemoveElector):
            words.append(f"-{change.name}")
        elif isinstance(change, SetAway):
            words.append(f"away({','.join(change.away)})")
    return " ".join(words)


def play(seed: int) -> Played:
    """Play one seed."""
    return Schedule(seed).run()


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    return play_seeds("zsched_lab.sim.pilot", __doc__, play, arguments, runs=200)


if __name__ == "__main__":
    sys.exit(main())
