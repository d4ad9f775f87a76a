"""Operators' orders under faults: tasks are moved, paused and pinned at random, and in the end set free.

Knows: which orders a schedule draws, how the operator takes them back. Does not know: what must hold
(`zsched_lab.sim.checks`), the faults beside them.
"""

from __future__ import annotations

from random import Random
from typing import Final

from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Hold, HoldTask, MoveTask
from zsched.core.values.model import Asked, NodeId
from zsched_lab.sim.simulator import Simulator

SHARE: Final = 0.2
"""Of the schedules."""
MOST: Final = 6
BY: Final = Asked(by="ada@sim", reason="played")
LOOK_S: Final = 0.5
"""How often the operator looks whether a task is still held, once the faults are over."""
FIRST_REQUEST: Final = 1 << 30
"""The numbers of these orders do not meet those of other commands."""


def order_faults(rng: Random, fleet: Fleet, until: float) -> list[tuple[float, NodeId, float]]:
    """(at, the node that is asked, which order) of a schedule's orders; in most schedules none."""
    if rng.random() > SHARE:
        return []
    names = [node.name for node in fleet.nodes]
    return [(rng.uniform(0.0, until), rng.choice(names), rng.random()) for _ in range(rng.randint(1, MOST))]


def order_of(size: float, fleet: Fleet, request: int) -> ev.MoveCommanded | ev.HoldCommanded:
    """The order that a number in [0, 1) stands for."""
    rng = Random(f"order {size!r}")
    task = rng.choice(fleet.tasks)
    node, for_s = rng.choice(task.candidates), rng.choice((None, 1.0, 4.0))
    hold = rng.choice((None, Hold.PAUSE, Hold.PAUSE, Hold.PIN, Hold.PIN, Hold.RESUME, Hold.UNPIN))
    if hold is None:
        return ev.MoveCommanded(request=request, command=MoveTask(task=task.name, node=node, asked=BY))
    is_hard = hold is Hold.PIN and rng.random() < 0.5
    command = HoldTask(task=task.name, hold=hold, asked=BY, node=node, is_hard=is_hard, for_s=for_s)
    return ev.HoldCommanded(request=request, command=command)


class Orders:
    """The operator of one schedule."""

    def __init__(self, sim: Simulator) -> None:
        self._sim, self._requests = sim, FIRST_REQUEST

    def give(self, node: NodeId, size: float) -> None:
        """Ask a node for an order."""
        machine = self._sim.machines[node]
        self._requests += 1
        self._sim.deliver(machine, order_of(size, self._sim.fleet, self._requests))

    def take_back(self) -> None:
        """Set every task free that is held, and look again later: an order may still be agreed."""
        sim = self._sim
        for machine in tuple(sim.machines.values()):
            registers = {} if machine.node is None else machine.node.registers
            for task, register in registers.items():
                held = (Hold.RESUME, register.value.paused), (Hold.UNPIN, register.value.pinned)
                for hold in [hold for hold, is_held in held if is_held][:1]:
                    self._requests += 1
                    command = HoldTask(task=task, hold=hold, asked=BY)
                    sim.deliver(machine, ev.HoldCommanded(request=self._requests, command=command))
        sim.later(LOOK_S, self.take_back)
