"""A task that is pinned hard to a node which then leaves the fleet, or its candidates: orders about it are agreed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.plays import EDGES, FLEET, TASK, Play
from zsched.core.node.status import build_snapshot
from zsched.core.values.events import HoldCommanded
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import CommandOutcome, Hold, HoldTask
from zsched.core.values.model import Asked, NodeId


def held(play: Play, request: int, hold: Hold, node: NodeId = "") -> CommandOutcome:
    order = HoldTask(task=TASK, hold=hold, node=node, is_hard=bool(node), asked=Asked(by="ada@robot1"))
    play.sim.deliver(play.sim.machines["robot1"], HoldCommanded(request=request, command=order))
    assert play.sim.run_until(lambda: any(one.request == request for one in play.sim.answers), 10.0)
    return next(one.result for one in play.sim.answers if one.request == request).outcome


def without(owner: NodeId, *, is_forgotten: bool) -> Fleet:
    (task,) = FLEET.tasks
    (other,) = set(EDGES) - {owner}
    nodes = tuple(node for node in FLEET.nodes if node.name != owner) if is_forgotten else FLEET.nodes
    return replace(FLEET, nodes=nodes, tasks=(replace(task, candidates=(other,)),))


@pytest.mark.parametrize("is_forgotten", [True, False])
def test_a_hard_pin_to_a_node_that_has_gone_is_told_of_and_can_be_ended(is_forgotten: bool) -> None:
    """Every order was answered by "another change came first", for good, and no status named the pin."""
    play = Play()
    play.adopt()
    owner = play.sim.agreed(TASK)
    assert owner is not None
    assert held(play, 900, Hold.PIN, owner) is CommandOutcome.OK
    if is_forgotten:
        play.sim.crash(owner)
        play.sim.run(10.0)
    play.fleet = without(owner, is_forgotten=is_forgotten)
    play.agree()
    play.sim.run(5.0)
    (other,) = set(EDGES) - {owner}
    told = build_snapshot(play.sim.node("robot2"), play.sim.now).tasks[0].problems
    assert any(f"pinned to {owner}, which is no candidate any more: `zsched unpin {TASK}`" in text for text in told)
    assert held(play, 901, Hold.UNPIN) is CommandOutcome.OK
    assert play.sim.run_until(lambda: play.sim.agreed(TASK, "robot1", "robot2", "robot3") == other, 10.0)
