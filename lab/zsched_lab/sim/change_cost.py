"""What one change of the electors costs: messages, round trips and writes, counted in the simulator.

``python -m zsched_lab.sim.change_cost --tasks 10``.

Knows: which messages belong to a change, where it begins and ends. Does not know: bytes, processors, real networks
(`benchmarks.membership` has those).

Every message takes the same time here, so times are told as round trips; the guard time of exclusive tasks is in them.
Frames are counted until every node knows the settled value, and until nothing more follows from it: then nodes have
also asked each elector how often it has voted (`zsched.core.vote.witness`).
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, field

from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec
from zsched.core.values.messages import ChangeFleet
from zsched.core.values.model import NodeKind, Tuning, Weights
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.simulator import Simulator

ONE_WAY_S = 0.01
ELECTORS = ("robot1", "robot2", "robot3")
ADDED = "edge1"
NODES = (*ELECTORS, ADDED, "edge2")
WAIT_S = 30.0
CALM_S = 3.0
"""So long after the last news nothing of a change is under way any more."""
ASKED = {
    do.SendPrepare: "prepares of tasks",
    do.SendAccept: "accepts of tasks",
    do.SendBallots: "questions of several tasks",
    do.AnswerBallots: "answers of several tasks",
    do.AskElectors: "questions about the fleet",
    do.AnswerElection: "answers of tasks",
    do.AnswerFleet: "answers about the fleet",
    do.AnswerLearnt: "learnt values",
    do.AskLearnt: "questions for learnt values",
    do.PublishLearnt: "learnt values",
}


@dataclass(slots=True, kw_only=True)
class Cost:
    """What was counted, from the command to the moment when every node knows the settled value."""

    frames: Counter[str] = field(default_factory=Counter)
    """{kind: frames that went to another machine}."""
    after: int = 0
    """Frames that followed when every node knew the settled value."""
    writes: Counter[str] = field(default_factory=Counter)
    """{machine: synced writes of its state}."""
    agreed_s: float = 0.0
    """Until the operator heard that it is agreed."""
    chosen_s: float = 0.0
    """Until the first node knew the settled value."""
    settled_s: float = 0.0
    """Until every node did."""


class _Counted(Simulator):
    """Counts what leaves; `Simulator` is a dataclass with slots, so the counts are given to it."""

    __slots__ = ("cost",)

    cost: Cost | None

    def _one(self, me: Machine, instruction: do.Instruction) -> None:
        kind = ASKED.get(type(instruction))
        if kind is not None and self.cost is not None:
            self.cost.frames[kind] += self._receivers(me, instruction)
        super()._one(me, instruction)

    def _receivers(self, me: Machine, instruction: do.Instruction) -> int:
        """How many other machines a frame goes to."""
        assert me.node is not None
        if isinstance(instruction, do.AskElectors):
            return sum(name != me.name for name in instruction.to)
        if isinstance(instruction, do.SendPrepare | do.SendAccept | do.SendBallots):
            return sum(name != me.name for name in me.node.agreement.electors)
        if isinstance(instruction, do.PublishLearnt):
            return len(self.machines) - 1
        if isinstance(instruction, do.AnswerElection | do.AnswerBallots | do.AnswerFleet | do.AnswerLearnt):
            question = self._asked.get(instruction.request)
            return int(question is not None and question[1] is not me)
        return 1

    def _sync(self, machine: Machine, state: object) -> None:
        if self.cost is not None:
            self.cost.writes[machine.key] += 1
        super()._sync(machine, state)  # type: ignore[arg-type]


def fleet_of(tasks: int, *, exclusive: bool) -> Fleet:
    """Three robots that elect, two edges, so many tasks without a word to say."""
    tuning = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0), bonus=0.1)
    return Fleet(
        name="lab",
        timing=Timing(),
        nodes=tuple(
            NodeSpec(name=name, kind=NodeKind.ROBOT if name in ELECTORS else NodeKind.EDGE) for name in sorted(NODES)
        ),
        tasks=tuple(
            TaskSpec(
                name=f"task{number:02}",
                candidates=("edge1", "edge2"),
                tuning=tuning,
                worker=WorkerSpec(command=("true",)),
                exclusive=exclusive,
            )
            for number in range(tasks)
        ),
        electors=ELECTORS,
    )


def measure(tasks: int, *, exclusive: bool, seed: int = 1) -> Cost:
    """Add one elector to three, with this many tasks, and count.

    Raises:
        RuntimeError: the change did not come about.
    """
    fleet = fleet_of(tasks, exclusive=exclusive)
    sim = _Counted(fleet=fleet, seed=seed)
    sim.cost = None
    sim.documents.judge_from(fleet, 0)
    sim.delay_s = (ONE_WAY_S, ONE_WAY_S)
    sim.start()
    _wait(sim, lambda: not sim.unsettled(), "the fleet to come to rest")
    adopted = ChangeFleet(document=sim.documents.write(fleet))
    sim.deliver(sim.machines[ELECTORS[0]], ev.FleetCommanded(request=1, command=adopted))
    _wait(sim, lambda: _is_settled(sim, 2), "the first document")
    sim.run(2.0)
    state = sim.disk(ADDED)
    assert state is not None
    sim.cost, began_at = Cost(), sim.now
    command = ChangeFleet(add_elector=ADDED, disk=state.disk)
    sim.deliver(sim.machines[ELECTORS[0]], ev.FleetCommanded(request=2, command=command))
    _wait(sim, lambda: any(one.request == 2 for one in sim.answers), "the change")
    sim.cost.agreed_s = sim.now - began_at
    _wait(sim, lambda: any(_knows_settled(sim, 3)), "settled electors")
    sim.cost.chosen_s = sim.now - began_at
    _wait(sim, lambda: _is_settled(sim, 3), "the settled electors")
    cost, sim.cost = sim.cost, Cost()
    cost.settled_s = sim.now - began_at
    sim.run(CALM_S)
    cost.after = sim.cost.frames.total()
    return cost


def _knows_settled(sim: Simulator, number: int) -> list[bool]:
    values = [sim.node(name).agreement.fleet_value for name in sim.running()]
    return [value is not None and value.settled and value.number == number for value in values]


def _is_settled(sim: Simulator, number: int) -> bool:
    return all(_knows_settled(sim, number))


def _wait(sim: Simulator, condition: object, what: str) -> None:
    if not sim.run_until(condition, WAIT_S):  # type: ignore[arg-type]
        raise RuntimeError(f"waited {WAIT_S:g} s for {what}")


def told(cost: Cost, tasks: int, *, exclusive: bool) -> str:
    """The counts as a row of a table."""
    trip_s = 2 * ONE_WAY_S
    most = max(cost.writes[name] for name in (*ELECTORS, ADDED))
    trips = [f"{seconds / trip_s:.1f}" for seconds in (cost.agreed_s, cost.chosen_s, cost.settled_s)]
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(cost.frames.items()))
    return (
        f"| {tasks}{' exclusive' if exclusive else ''} | {cost.frames.total()} | {cost.after} | "
        f"{' | '.join(trips)} | {most} | {kinds} |"
    )


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m zsched_lab.sim.change_cost", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--tasks", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--exclusive", action="store_true")
    given = parser.parse_args(arguments)
    print(f"one elector is added to three; 5 nodes; a round trip is {2000 * ONE_WAY_S:g} ms")
    print(
        "| tasks | frames | frames after | round trips until agreed | until settled | until all know it "
        "| writes of an elector | frames of |"
    )
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |")
    for tasks in given.tasks:
        print(told(measure(tasks, exclusive=given.exclusive), tasks, exclusive=given.exclusive))
    return 0


if __name__ == "__main__":
    sys.exit(main())
