"""What a site of many cells costs and does, and one fleet of growing size: counted in the simulator, on the real core.

``python -m zsched_lab.sim.site --robots 1000 --candidates 200 --cells 50 --jobs 2``: cells, one after another.
``python -m zsched_lab.sim.site --flat 3 6 12 24 48 96``: one fleet of each size.

A cell is a fleet of its own: no message of agreement leaves it, so a site is as many fleets as it has cells. Each has
one task, whose candidates are its edges. It is played through: the first placement, rest, an owner that freezes, an
owner that is killed, all edges but one killed at once, the last one too, and all of them back.

Knows: messages by kind, the core's processor time, virtual times of one fleet. Does not know: zenoh, packets, workers'
work, real networks (`benchmarks.scale` and `benchmarks.idle` have those).
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec
from zsched.core.values.model import NodeId, NodeKind, PeerState, Tuning, Weights
from zsched_lab.sim.links import Pair
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.simulator import Simulator

TASK = "task"
ELECTORS = 5
"""The electorate that a fleet chooses by itself."""
ONE_WAY_S = (0.001, 0.005)
STEP_S = 0.002
"""Between two looks at whether something has come about."""
SETTLE_S, REST_S = 8.0, 10.0
WAIT_S = 40.0
EDGE_SHARE = 6
"""Of a flat fleet one machine of so many is an edge."""
NEVER_S = 1e9


@dataclass(slots=True, kw_only=True)
class Played:
    """One fleet, played through; times in virtual seconds."""

    robots: int
    edges: int
    placed_s: float = 0.0
    heard: Counter[str] = field(default_factory=Counter)
    """{kind: messages that came to all nodes together, at rest}."""
    core_s: float = 0.0
    """Processor time of all nodes' cores at rest."""
    faults: dict[str, tuple[float, float]] = field(default_factory=dict)
    """{fault: (until the first node knows the next owner, until all do)}."""

    @property
    def nodes(self) -> int:
        """Machines of this fleet."""
        return self.robots + self.edges

    @property
    def heard_hz(self) -> float:
        """Messages that come to a node each second, at rest."""
        return self.heard.total() / self.nodes / REST_S

    @property
    def core_percent(self) -> float:
        """What a node's core takes of a processor of this machine at rest, without zenoh and without the loop."""
        return 100.0 * self.core_s / self.nodes / REST_S


class _Counted(Simulator):
    """Counts what arrives from other machines, and the time that nodes take to handle it."""

    __slots__ = ("core_s", "heard")

    heard: Counter[str]
    core_s: float

    def _arrive(self, pair: Pair, target: Machine, event: ev.Event) -> None:
        self.heard[type(event).__name__] += 1
        super()._arrive(pair, target, event)

    def handle(self, machine: Machine, event: ev.Event) -> None:
        node = machine.node
        assert node is not None
        self.events += 1
        began_s = time.perf_counter()
        batch = node.handle(event, self.now)
        self.core_s += time.perf_counter() - began_s
        self.invariants.on_handled(machine, self.now, self.now)
        if batch:
            self._carry_out(machine, batch, 0)
        self.arm(machine)


def fleet_of(robots: int, edges: int, timing: Timing) -> Fleet:
    """Robots that elect, and edges that may run the one task."""
    names = {f"robot{number:03}": NodeKind.ROBOT for number in range(1, robots + 1)}
    names |= {f"edge{number:03}": NodeKind.EDGE for number in range(1, edges + 1)}
    return Fleet(
        name="cell",
        timing=timing,
        nodes=tuple(NodeSpec(name=name, kind=kind) for name, kind in sorted(names.items())),
        tasks=(
            TaskSpec(
                name=TASK,
                candidates=tuple(name for name, kind in sorted(names.items()) if kind is NodeKind.EDGE),
                tuning=Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0), bonus=0.1),
                worker=WorkerSpec(command=("true",)),
            ),
        ),
        electors=tuple(name for name in sorted(names) if names[name] is NodeKind.ROBOT)[:ELECTORS],
    )


def play(robots: int, edges: int, seed: int, timing: Timing) -> Played:
    """Play one fleet through.

    Raises:
        RuntimeError: something did not come about within `WAIT_S`.
        InvariantError: a rule of the simulator is broken.
    """
    fleet = fleet_of(robots, edges, timing)
    sim = _Counted(fleet=fleet, seed=seed)
    sim.heard, sim.core_s = Counter(), 0.0
    sim.delay_s = ONE_WAY_S
    told = Played(robots=robots, edges=edges)
    candidates = list(fleet.tasks[0].candidates)
    sim.start()
    _, told.placed_s = _next_owner(sim, 0, "the first placement")
    _rest(sim)
    sim.heard, sim.core_s = Counter(), 0.0
    sim.run(REST_S)
    told.heard, told.core_s = Counter(sim.heard), sim.core_s
    for fault in ("frozen", "killed"):
        if len(candidates) < 2:
            break
        owner = _owner(sim)
        epoch = sim.node(owner).registers[TASK].value.epoch
        if fault == "frozen":
            sim.pause(sim.machines[owner], NEVER_S)
        else:
            sim.crash(owner)
        told.faults[f"owner {fault}"] = _next_owner(sim, epoch, f"an owner behind one that is {fault}", owner)
        if fault == "frozen":
            sim.crash(owner)
        sim.start(owner)
        _rest(sim)
    owner = _owner(sim)
    epoch = sim.node(owner).registers[TASK].value.epoch
    survivors = [name for name in candidates if name != owner][:1]
    fallen = [name for name in candidates if name not in survivors]
    if survivors and len(fallen) > 1:
        for name in fallen:
            sim.crash(name)
        told.faults["all edges but one killed"] = _next_owner(sim, epoch, "the last edge to own it", *fallen)
        sim.run(SETTLE_S)
    _lose_all(sim, told, candidates)
    return told


def _lose_all(sim: _Counted, told: Played, candidates: Sequence[NodeId]) -> None:
    """No candidate is left; every robot must know. Then all come back."""
    began = sim.now
    for name in candidates:
        sim.crash(name)
    left = sim.running()

    def knows(name: NodeId) -> bool:
        return all(sim.sees(name, gone) is PeerState.GONE for gone in candidates)

    first = _wait(sim, lambda: any(map(knows, left)), "one robot to miss all edges") - began
    told.faults["the last edge killed: it is known"] = (
        first,
        _wait(sim, lambda: all(map(knows, left)), "all robots to miss all edges") - began,
    )
    epoch = sim.node(left[0]).registers[TASK].value.epoch
    sim.run(SETTLE_S)
    if sim.node(left[0]).registers[TASK].value.epoch != epoch:
        raise RuntimeError("a task without a candidate has moved")
    sim.start(*candidates)
    began = sim.now
    back_s = _wait(sim, lambda: not sim.unsettled(), "the fleet to come to rest") - began
    told.faults["all edges back: the task's streams flow"] = (back_s, back_s)


def _owner(sim: _Counted) -> NodeId:
    owner = sim.agreed(TASK)
    if owner is None:
        raise RuntimeError("the fleet at rest has two owners")
    return owner


def _next_owner(sim: _Counted, epoch: int, what: str, *without: NodeId) -> tuple[float, float]:
    """(until the first node knows an owner of a later epoch, until all but ``without`` do), from now on."""
    began = sim.now

    def knows(name: NodeId) -> bool:
        value = sim.node(name).registers[TASK].value
        return value.epoch > epoch

    names = [name for name in sim.running() if name not in without]
    first = _wait(sim, lambda: any(map(knows, names)), what) - began
    return first, _wait(sim, lambda: all(map(knows, names)), what) - began


def _wait(sim: _Counted, condition: Callable[[], bool], what: str) -> float:
    """The virtual time at which it came about, within `STEP_S`."""
    end = sim.now + WAIT_S
    while not condition():
        if sim.now >= end:
            raise RuntimeError(f"waited {WAIT_S:g} s for {what}")
        sim.run(STEP_S)
    return sim.now


def _rest(sim: _Counted) -> None:
    _wait(sim, lambda: not sim.unsettled(), "the fleet to come to rest")
    sim.run(SETTLE_S)


# --- the command -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Job:
    robots: int
    edges: int
    seed: int
    timing: Timing

    def play(self) -> Played:
        return play(self.robots, self.edges, self.seed, self.timing)


def _play(job: _Job) -> Played:
    return job.play()


def shares(total: int, parts: int) -> list[int]:
    """``total`` in ``parts`` that differ by at most one, the greater ones first."""
    return [total // parts + (number < total % parts) for number in range(parts)]


def spread(values: Iterable[float]) -> str:
    """p50, p99 and most, in milliseconds; of one value that one alone."""
    ordered = sorted(value * 1000 for value in values)
    if len(ordered) == 1:
        return f"{ordered[0]:.0f}"
    ranks = (ordered[len(ordered) // 2], ordered[min(len(ordered) - 1, int(len(ordered) * 0.99))], ordered[-1])
    return " / ".join(f"{value:.0f}" for value in ranks)


def table(groups: dict[str, list[Played]]) -> str:
    """A row for each group of fleets."""
    head = ["fleet", "messages heard, a node and second", "the core's time, % of a processor", "placed everywhere, ms"]
    faults = list(dict.fromkeys(name for cells in groups.values() for cell in cells for name in cell.faults))
    lines = ["| " + " | ".join(head + [f"{name}, ms: first; all" for name in faults]) + " |"]
    lines.append("| --- |" + " ---: |" * (len(head) - 1 + len(faults)))
    for name, cells in groups.items():
        heard = sum(cell.heard_hz for cell in cells) / len(cells)
        core = sum(cell.core_percent for cell in cells) / len(cells)
        row = [name, f"{heard:.1f}", f"{core:.2f}", spread(cell.placed_s for cell in cells)]
        for fault in faults:
            told = [cell.faults[fault] for cell in cells if fault in cell.faults]
            row.append(f"{spread(one[0] for one in told)}; {spread(one[1] for one in told)}" if told else "")
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.sim.site", description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--candidates", type=int, default=200)
    parser.add_argument("--cells", type=int, default=50)
    parser.add_argument(
        "--flat", type=int, nargs="+", default=[], metavar="NODES", help="fleets of these sizes instead"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args(arguments)
    timing = Timing()
    if given.flat:
        jobs = [
            _Job(size - edges, edges, given.seed, timing)
            for size in given.flat
            for edges in (max(2, size // EDGE_SHARE),)
        ]
    else:
        robots, edges = shares(given.robots, given.cells), shares(given.candidates, given.cells)
        if min(robots) < 1 or min(edges) < 1:
            parser.error(f"{given.cells} cells: each needs a robot and a candidate")
        jobs = [_Job(*one, seed, timing) for seed, one in enumerate(zip(robots, edges, strict=True), start=given.seed)]
    played: list[Played] = []
    with multiprocessing.get_context("spawn").Pool(given.jobs) as pool:
        for one in pool.imap(_play, jobs):
            played.append(one)
            print(f"\r{len(played)} of {len(jobs)} fleets", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    if given.flat:
        print(table({f"{one.robots} robots, {one.edges} edges": [one] for one in played}))
    else:
        print(table({f"{given.cells} cells, {given.robots} robots, {given.candidates} candidates": played}))
        print("Of more than one fleet: p50 / p99 / most.")
    print("Messages at rest, a node and second:")
    for kind, count in sum((one.heard for one in played), Counter[str]()).most_common():
        print(f"  {kind} {count / REST_S / sum(one.nodes for one in played):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
