"""Schedules of whole nodes whose fleet changes under faults: machines, documents, electors, disks, cuts, crashes.

``python -m zsched_lab.sim.fleets --seeds N``.

Knows: what operators and faults do in a schedule, by its seed. Does not know: the rules (`zsched.core.electorate`),
what must hold after every write (`zsched_lab.sim.chosen`, `zsched_lab.sim.checks`).

After the faults every node runs that is not lost for good. If no majority of the electors is left, one survivor is
recovered, and the others change sides. The fleet must come to rest: whoever was invited is there, and who leaves or is
dead is in no document; all nodes have learnt one settled value, and the exclusive task has one owner with a lease. A
further change must then be carried out. The last line is ``N schedules, V violations``; the exit code is 1 when there
is any.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from random import Random

from zsched.core.electorate.founding import founded_id
from zsched.core.scheduler.flags import HANDS_OVER
from zsched.core.values import events as ev
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec
from zsched.core.values.messages import ChangeFleet, CommandOutcome
from zsched.core.values.model import NodeId, NodeKind, ScoreForm, Tuning, Weights
from zsched.core.values.problems import Problem
from zsched.core.values.struct import replace
from zsched_lab.sim.checks import unsettled
from zsched_lab.sim.links import Pair
from zsched_lab.sim.members import GUESTS
from zsched_lab.sim.recoveries import Recoveries
from zsched_lab.sim.simulator import Simulator

FAULTS_S, REST_S = 25.0, 40.0
ROBOTS = ("robot1", "robot2", "robot3", "robot4")
EDGES = ("edge1", "edge2")
STEPS = ("change", "change", "change", "kill", "kill", "power", "cut", "pause", "blackout", "document", "unfit", "lose")
FLAGGED = 0.5
"""So often a step of the faults is followed by an operator's order about nodes."""
FLAG_S = (None, None, 3.0, 10.0)
FORGETS = 0.15
"""So often a step of the faults is followed by a machine that begins its next life without documents that it had."""
FORGETS_LAST = 0.5
"""So often it happens once more at rest, where no later change brings another document."""
EXCLUDES = 0.4
"""So often another document says whether the first task is exclusive, where the one before says the other."""
FETCHED_S = 8.0
DOWN_S = (0.05, 0.5, 3.0, 12.0)
COMING = 0.35
"""So often a step of the faults is followed by one of machines that come and go (`zsched_lab.sim.members`)."""
HALVES = 0.1
"""So many schedules end with two halves."""
AUTO = 0.4
"""In so many schedules electors are replaced by themselves."""
GENERATIONS = (0, 0, 0, 2)
"""As operators have counted them with the fleet's files."""
STAND_DOWN_S = 4.0
"""A node that has met a copy of its disk stands down at most so much later."""


RECOVERIES = 4
"""So often at most a schedule loses its majority after the faults."""


class ScheduleError(AssertionError):
    """What must hold does not."""


@dataclass(slots=True)
class Schedule:
    """One schedule."""

    seed: int
    sim: Simulator = field(init=False)
    rng: Random = field(init=False)
    fleet: Fleet = field(init=False)
    done: Counter[str] = field(default_factory=Counter)
    members: Recoveries = field(init=False)
    lost: int = 0
    """Disks that were lost."""
    _number: int = 0
    _says_flags: Random = field(init=False)
    _comes: Random = field(init=False)
    _forgets: Random = field(init=False)
    _excludes: Random = field(init=False)

    def __post_init__(self) -> None:
        self.rng = Random(f"fleets {self.seed}")
        self._says_flags = Random(f"flags {self.seed}")
        self._comes = Random(f"members {self.seed}")
        self._forgets = Random(f"forgotten {self.seed}")
        self._excludes = Random(f"exclusive {self.seed}")
        self.fleet = fleet_of(self.rng)
        if self._comes.random() < AUTO:
            self.fleet = replace(self.fleet, is_auto=True, replace_s=2.0, away_s=6.0)
        generation = self._comes.choice(GENERATIONS)
        self.sim = Simulator(fleet=self.fleet, seed=self.seed, generation=generation)
        self.sim.work.stop_s = (0.002, 0.02, 0.1, 0.4)
        self.sim.documents.judge_from(self.fleet, generation)
        self.members = Recoveries(
            sim=self.sim,
            rng=self._comes,
            tell=self._tell,
            done=self.done,
            generation_id=founded_id(self.fleet.name, generation),
        )

    def play(self) -> None:
        """Run it all.

        Raises:
            AssertionError, InvariantError: what must hold does not.
        """
        sim, rng = self.sim, self.rng
        sim.start()
        sim.run(rng.uniform(0.0, 5.0))
        end = sim.now + FAULTS_S
        while sim.now < end:
            getattr(self, f"_{rng.choice(STEPS)}")()
            if self._says_flags.random() < FLAGGED:
                self._flag()
            if self._forgets.random() < FORGETS:
                self._forget()
            if self._comes.random() < COMING:
                self.members.step()
            self.members.go_on()
            sim.run(rng.choice((0.01, 0.1, 0.5, 2.0, 4.0)))
        self._calm()
        if not self._comes_to_rest():
            self.done["no majority is left"] += 1
            return
        if self._comes.random() < HALVES:
            self.members.halves()
            if not self._comes_to_rest():
                raise ScheduleError("a half that was recovered cannot agree")
        # The end of a flag is a change, too: the last change would be in conflict with it.
        if not sim.run_until(lambda: not self._timed() and self._is_at_rest(), REST_S):
            raise ScheduleError(f"not at rest without the flags whose time is over, {self._timed()}: {self._why()}")
        self._change_once_more()
        if self._forgets.random() < FORGETS_LAST:
            self._forget()
            sim.run(max(DOWN_S) + FETCHED_S)
            if lacking := self._lacking(first := self._newest()):
                raise ScheduleError(f"{lacking} of {first}, {FETCHED_S:g} s after it was lost, and nothing has changed")

    def _comes_to_rest(self) -> bool:
        """Whether the fleet comes to rest; where no majority is left, one survivor is recovered first.

        Raises:
            ScheduleError: it does not, though it could.
        """
        for _ in range(RECOVERIES):
            if self.members.can_agree() and self.sim.run_until(self._is_at_rest, REST_S):
                return True
            if self.members.can_agree():
                raise ScheduleError(f"not at rest {REST_S:g} s after the faults: {self._why()}")
            if not self.members.recover():  # or a removal of before the faults' end was chosen after it
                return False
        raise ScheduleError("the fleet has lost its majority again and again")

    # --- operators ---------------------------------------------------------------------------------------------------

    def _tell(self, command: ChangeFleet, node: NodeId | None = None) -> int:
        running = [name for name in self.members.names() if self.sim.machines[name].node is not None]
        if not running:
            return 0
        self._number += 1
        asked = node or self.rng.choice(running)
        self.sim.deliver(self.sim.machines[asked], ev.FleetCommanded(request=self._number, command=command))
        return self._number

    def _outcome(self, number: int) -> CommandOutcome | None:
        return next((one.result.outcome for one in self.sim.answers if one.request == number), None)

    def _change(self) -> None:
        """An elector comes or goes, or the first document is agreed."""
        name = self.rng.choice(self.members.names())
        value = self._newest()
        if value is None or not value.document:
            self._document()
        elif value.electorate.seat(name) is None or self.rng.random() < 0.2:
            state = self.sim.disk(name)
            if state is not None and not state.lost:
                self._tell(ChangeFleet(add_elector=name, disk=state.disk))
                self.done["elector added"] += 1
        else:
            self._tell(ChangeFleet(remove_elector=name))
            self.done["elector removed"] += 1

    def _document(self) -> None:
        """Another document, with tasks that come and go, or are exclusive; now and then with other leases."""
        lease_s = self.rng.choice((self.fleet.timing.lease_s, self.fleet.timing.lease_s, 0.7, 1.6))
        value = self._newest()
        fleet = self.fleet if value is None else self.sim.documents.says.get(value.document, self.fleet)
        timing = replace(self.fleet.timing, lease_s=lease_s)
        first = fleet.tasks[0]
        if self._excludes.random() < EXCLUDES:
            first = replace(first, exclusive=not first.exclusive)
            self.done["exclusive or not"] += 1
        extra = tuple(
            replace(first, name=name, exclusive=False) for name in ("other", "third") if self.rng.random() < 0.4
        )
        tasks = (first, *extra)
        said = replace(fleet, zenoh_config=f"{self.rng.randint(1, 20)}.json5", timing=timing, tasks=tasks)
        base = None if value is None or not value.document else value.revision
        self._tell(ChangeFleet(document=self.sim.documents.write(said, self._flags()), base_revision=base))
        self.done["document"] += 1

    def _flags(self) -> tuple[Flag, ...]:
        """The flags of the newest document."""
        value = self._newest()
        content = None if value is None else self.sim.documents.contents.get(value.document)
        return () if content is None else content.flags

    def _flag(self) -> None:
        """Nodes are drained, made ineligible, or neither any more; some node may always get tasks."""
        value, rng = self._newest(), self._says_flags
        said = None if value is None else self.sim.documents.says.get(value.document)
        if value is None or said is None:
            return
        names = self.members.names()
        kind, chosen = rng.choice(list(FlagKind)), set(rng.sample(names, rng.randint(1, len(names) - 1)))
        kept = [flag for flag in self._flags() if flag.kind is not kind or flag.subject not in chosen]
        for_s, revision = rng.choice(FLAG_S), value.revision + 1
        made = [Flag(kind=kind, subject=name, for_s=for_s, revision=revision) for name in sorted(chosen)]
        flags = tuple(kept) if rng.random() < 0.4 else (*kept, *made)
        if {flag.subject for flag in flags} != set(names):
            content = self.sim.documents.write(said, flags)
            self._tell(ChangeFleet(document=content, base_revision=value.revision))
            self.done["flags"] += 1

    def _timed(self) -> tuple[Flag, ...]:
        return tuple(flag for flag in self._flags() if flag.for_s is not None)

    def _unfit(self) -> None:
        """Some document is not valid on one machine until the faults end."""
        known = list(self.sim.documents.says)
        if known and self.rng.random() < 0.3:
            self.sim.documents.unfit.add((self.rng.choice(self.members.names()), self.rng.choice(known)))
            self.done["unfit document"] += 1

    # --- faults ------------------------------------------------------------------------------------------------------

    def _kill(self) -> None:
        self._end(self.rng.choice(self.members.names()), is_power_lost=False)

    def _power(self) -> None:
        self._end(self.rng.choice(self.members.names()), is_power_lost=True)

    def _blackout(self) -> None:
        if self.rng.random() < 0.3:
            for name in self.sim.running():
                self._end(name, is_power_lost=True)

    def _end(self, name: NodeId, *, is_power_lost: bool) -> None:
        self.sim.crash(name, is_power_lost=is_power_lost)
        self.sim.later(self.rng.choice((0.05, 0.5, 3.0, 12.0)), self.members.start, name)
        self.done["crash"] += 1

    def _cut(self) -> None:
        names = sorted(self.sim.machines)
        side = tuple(self.rng.sample(names, self.rng.randint(1, len(names) - 1)))
        pairs: set[Pair] = {(one, other) for one in names for other in names if (one in side) != (other in side)}
        if self.rng.random() < 0.3:
            pairs = {pair for pair in pairs if pair[0] in side}
        self.sim.hold(pairs, until=self.sim.now + self.rng.choice((0.3, 2.0, 6.0)))
        self.done["cut"] += 1

    def _pause(self) -> None:
        self.sim.pause(self.sim.machines[self.rng.choice(self.members.names())], self.rng.choice((0.3, 1.0, 5.0)))
        self.done["pause"] += 1

    def _lose(self) -> None:
        """A disk is lost for good: the machine comes back with a blank one, as another member.

        An elector of the file is left alone, for its first seat names no disk: `zsched init` asks the fleet before it
        makes such a state again.
        """
        spared = [*self.fleet.electors, *(one for one in GUESTS if self.done["joined"])]
        name = self.rng.choice([one for one in self.members.names() if one not in spared] or [""])
        value = self._newest()
        seat = None if value is None else value.electorate.seat(name)
        if not name or (seat is not None and self.lost):
            return
        self.sim.crash(name)
        machine = self.sim.machines[name]
        self.sim.initialise(machine, incarnation=self.sim.wall_count, generation=self.sim.generation)
        machine.is_durable = False  # what it once knew is gone
        self.sim.later(1.0, self.members.start, name)
        self.lost += seat is not None
        self.done["disk lost"] += 1

    def _forget(self) -> None:
        """Files are deleted, or their folder is an older one: the next life finds some documents, or none.

        The state beside them stays. What no other machine has would be lost for good, as by a worn-out disk.
        """
        rng = self._forgets
        name = rng.choice(self.members.names())
        machine = self.sim.machines[name]
        documents = machine.disk.documents
        kept = rng.choice((0, len(documents) // 2, max(0, len(documents) - 1)))
        others = [one for one in self.members.names() if one != name]
        wanted = [one for one in documents[kept:] if one in machine.disk.named()]
        if not documents[kept:] or not all(self.sim.documents.is_on_one_of(others, one) for one in wanted):
            return
        self.sim.crash(name, is_power_lost=rng.random() < 0.5)
        machine.disk.lose_documents(kept)
        self.sim.later(rng.choice(DOWN_S), self.members.start, name)
        self.done["documents lost"] += 1

    # --- the end -----------------------------------------------------------------------------------------------------

    def _calm(self) -> None:
        sim = self.sim
        sim.documents.unfit.clear()
        sim.heal()
        self.members.calm()
        self._give_again()
        for machine in tuple(sim.machines.values()):
            sim.unpause(machine, machine.life)
            if machine.node is not None and machine.node.agreement.problems.get((Problem.DOCUMENT, "")):
                sim.crash(machine.key)  # the operator has put it right: it looks at the document again
        self.members.start_all()
        if self.done["cloned"]:
            sim.run(STAND_DOWN_S)
            self.members.settle_disputes()
            self.members.start_all()

    def _give_again(self) -> None:
        """What a state names, and nobody has whom that node asks, is brought back by the operator.

        It asks the electors and the nodes of its fleet file; of others, which have joined since, it does not know.
        """
        for name in self.members.names():
            machine = self.sim.machines[name]
            asked = {name, *(node.name for node in machine.fleet.nodes)} & set(self.members.names())
            for document in sorted(machine.disk.named()):
                if all(document not in self.sim.machines[one].disk.documents for one in asked):
                    self.sim.crash(name)
                    machine.disk.documents.append(document)
                    self.done["document given again"] += 1

    def _newest(self) -> FleetValue | None:
        return self.members.newest()

    def _is_at_rest(self) -> bool:
        return not self._why()

    def _why(self) -> str:
        self.members.go_on()
        if not self.members.is_done():
            return "somebody is on the way in or out"
        values = {name: self.sim.node(name).agreement.fleet_value for name in self.sim.running()}
        first = next(iter(values.values()))
        if first is None or any(value != first for value in values.values()):
            told = {name: (value.revision, value.number) for name, value in values.items() if value is not None}
            return f"nodes know different fleet values: {told}"
        newest = self._newest()
        if newest is not None and newest.generation_id == first.generation_id and newest.revision > first.revision:
            return f"revision {newest.revision} is chosen, and no node has learnt it yet"
        if not first.settled:
            return f"number {first.number} is not settled"
        if lacking := self._lacking(first):
            return lacking
        said = self.sim.documents.says.get(first.document, self.fleet)
        why = unsettled(said, self.sim.machines, self.sim.work.working, self.sim.now)
        return why or self._ill_flagged(said)

    def _lacking(self, value: FleetValue | None) -> str:
        """Who has no document of a fleet value that has one."""
        nodes = {name: self.sim.node(name) for name in self.sim.running()}
        names = sorted(name for name, node in nodes.items() if node.agreement.document is None)
        return f"{', '.join(names)} without the document" if names and value is not None and value.document else ""

    def _ill_flagged(self, said: Fleet) -> str:
        """A node that goes by other flags than the document's, or a drained one that has not handed over."""
        flags = self._flags()
        drained = {flag.subject for flag in flags if flag.kind in HANDS_OVER}
        for name in self.sim.running():
            node = self.sim.node(name)
            if set(node.flags.drained) != drained or set(node.flags.closed) != {flag.subject for flag in flags}:
                return f"{name} goes by {node.flags.closed}, the document says {flags}"
        owners = {task.name: self.sim.agreed(task.name) for task in said.tasks}
        kept = sorted(f"{task} on {owner}" for task, owner in owners.items() if owner in drained)
        return f"not handed over: {', '.join(kept)}" if kept else ""

    def _change_once_more(self) -> None:
        """What is at rest can be changed again."""
        outcome, until = None, self.sim.now + REST_S
        while self.sim.now < until:  # operators who take machines out, a step a second, may come first
            value = self._newest()
            assert value is not None
            said = replace(self.sim.documents.says.get(value.document, self.fleet), zenoh_config="99.json5")
            base = value.revision if value.document else None
            command = ChangeFleet(document=self.sim.documents.write(said, self._flags()), base_revision=base)
            number = self._tell(command)
            if not self.sim.run_until(lambda number=number: self._outcome(number) is not None, REST_S):  # type: ignore[misc]
                raise ScheduleError("no answer to a change at rest")
            outcome = self._outcome(number)
            if outcome in (CommandOutcome.OK, CommandOutcome.UNCHANGED):
                break
            sim = self.sim
            sim.run_until(self._is_at_rest, REST_S)
        if outcome not in (CommandOutcome.OK, CommandOutcome.UNCHANGED):
            raise ScheduleError(f"a change at rest ended as {outcome}")
        if not self.sim.run_until(self._is_at_rest, REST_S):
            raise ScheduleError(f"not at rest {REST_S:g} s after the last change: {self._why()}")


def fleet_of(rng: Random) -> Fleet:
    """Some fleet: two to four robots, one or two edges, an exclusive task and maybe another one."""
    robots, edges = ROBOTS[: rng.randint(2, 4)], EDGES[: rng.randint(1, 2)]
    names = tuple(sorted((*robots, *edges)))
    weights = Weights(cpu=0.5, memory=0.5, network=0.0)
    tuning = Tuning(weights=weights, bonus=0.1, score=ScoreForm.PAPER)
    tasks = tuple(
        TaskSpec(
            name=name,
            candidates=names,
            tuning=tuning,
            exclusive=name == "merge",
            price_s=0.1,
            worker=WorkerSpec(command=("work",)),
        )
        for name in ("merge", "other")[: rng.randint(1, 2)]
    )
    nodes = tuple(NodeSpec(name=name, kind=NodeKind.ROBOT if name in robots else NodeKind.EDGE) for name in names)
    return Fleet(name="lab", timing=Timing(), nodes=nodes, tasks=tasks, electors=robots)


def play(seed: int) -> tuple[str, Counter[str]]:
    """(what was violated or nothing, what was done) of one schedule."""
    schedule = Schedule(seed)
    try:
        schedule.play()
    except Exception as error:  # noqa: BLE001 - whatever escapes is what is looked for
        if schedule.sim.memory.beyond:  # votes that nobody remembers: docs/design/failures.md
            schedule.done["beyond what is promised"] += 1
            return "", schedule.done
        return f"{type(error).__name__}: {error}", schedule.done
    return "", schedule.done


def _played(seeds: range, jobs: int) -> Iterator[tuple[str, Counter[str]]]:
    """What came of each seed, in their order."""
    if jobs == 1:
        yield from map(play, seeds)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(play, seeds, chunksize=4)


def main(arguments: list[str] | None = None) -> int:
    """Play schedules, print what was violated, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.fleets", description=__doc__)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args(arguments)
    found, done = [], Counter[str]()
    seeds = range(given.first, given.first + given.seeds)
    for seed, (violation, did) in zip(seeds, _played(seeds, given.jobs), strict=True):
        done += did
        if violation:
            found.append(violation)
            print(f"seed {seed}: {violation[:1000]}", flush=True)
    print(", ".join(f"{what} {count}" for what, count in sorted(done.items())))
    print(f"{given.seeds} schedules, {len(found)} violations")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
