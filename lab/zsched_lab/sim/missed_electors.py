"""What an exclusive task gets whose owner robots reach and too few electors hear, for good or now and then.

``python -m zsched_lab.sim.missed_electors --down 1.6 5``.

Knows: the fleet, which links are down when, what is counted. Does not know: who is left for whom
(`zsched.core.vote.lease`, `zsched.core.scheduler.eligibility`).
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import Final, NamedTuple

from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec
from zsched.core.values.model import NodeId, NodeKind, Tuning, Weights
from zsched_lab.sim.simulator import CORES, Simulator

TASK: Final = "guard"
EDGES: Final = ("edge1", "edge2")
ROBOTS: Final = ("robot1", "robot2")
ELECTORS: Final = ("base1", "base2", "base3")
STARTED_S: Final = 20.0
EVERY_S: Final = 20.0
FOR_S: Final = 400.0
STEP_S: Final = 0.1
IDLE_RATIO, BUSY_RATIO, MEMORY_MB = 0.05, 0.9, 1000.0
"""Of a machine's cores, that others use."""


class Played(NamedTuple):
    """What came of a history."""

    moves: int
    at_work: float
    """The share of the time in which somebody worked (0 to 1)."""


def fleet_of(*, electors: tuple[NodeId, ...] = ELECTORS) -> Fleet:
    """Two edges that may have the task, robots that ask for it, and electors of their own."""
    tuning = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0))
    return Fleet(
        name="test",
        timing=Timing(),
        nodes=tuple(
            NodeSpec(name=name, kind=NodeKind.ROBOT if name in ROBOTS else NodeKind.EDGE)
            for name in (*EDGES, *ROBOTS, *ELECTORS)
        ),
        tasks=(
            TaskSpec(
                name=TASK,
                candidates=EDGES,
                tuning=tuning,
                price_s=0.1,
                worker=WorkerSpec(command=("true",)),
                exclusive=True,
            ),
        ),
        electors=electors,
    )


def started(
    *,
    electors: tuple[NodeId, ...] = ELECTORS,
    busy: tuple[NodeId, ...] = (),
    seed: int = 1,
) -> Simulator:
    """A fleet whose owner is edge1. On ``busy`` nodes the task would be worth little.

    Raises:
        RuntimeError: it is not.
    """

    def load(node: NodeId, _now: float) -> tuple[float, float]:
        return CORES * (BUSY_RATIO if node in busy else IDLE_RATIO), MEMORY_MB

    sim = Simulator(fleet=fleet_of(electors=electors), seed=seed, load=load)
    sim.start(*[name for name in sim.machines if name != "edge2"])
    if not sim.run_until(lambda: working(sim) == "edge1", STARTED_S):
        raise RuntimeError(f"edge1 has not got the task within {STARTED_S:g} s")
    sim.start("edge2")
    return sim


def working(sim: Simulator) -> NodeId:
    """Who works on the task under a lease; ``""``: nobody does."""
    name, until = sim.working.get(TASK, ("", -math.inf))
    return name if until > sim.now else ""


def moves(sim: Simulator) -> int:
    """The newest epoch; what it has grown by is the number of moves."""
    return max(epoch for task, epoch in sim.owners if task == TASK)


def play(down_s: float, *, is_busy: bool, for_s: float = FOR_S, seed: int = 1) -> Played:
    """Edge1 and two of three electors do not hear each other for ``down_s`` of each 20 s.

    ``is_busy``: edge2 is, so that the task comes back whenever it may; else the edges are alike.
    """
    sim = started(busy=("edge2",) if is_busy else (), seed=seed)
    sim.run(5.0)
    before, began_at, seen = moves(sim), sim.now, []
    while sim.now - began_at < for_s:
        sim.heal()
        if (sim.now - began_at) % EVERY_S < down_s:
            sim.cut(("edge1",), ELECTORS[:2])
        sim.run(STEP_S)
        seen.append(working(sim) != "")
    return Played(moves(sim) - before, sum(seen) / len(seen))


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m zsched_lab.sim.missed_electors", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--down", type=float, nargs="+", default=[1.6, 5.0], metavar="S", help="of each 20 s")
    parser.add_argument(
        "--seconds", type=float, default=FOR_S, metavar="S", help=f"of each history (default {FOR_S:g})"
    )
    given = parser.parse_args(arguments)
    print(f"edge1 misses two of three electors for a part of each {EVERY_S:g} s; {given.seconds:g} s in all")
    print("| the other edge | down, s | moves | at work |")
    print("| --- | ---: | ---: | ---: |")
    for is_busy in (False, True):
        for down_s in given.down:
            played = play(down_s, is_busy=is_busy, for_s=given.seconds)
            print(f"| {'busy' if is_busy else 'alike'} | {down_s:g} | {played.moves} | {played.at_work:.0%} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
