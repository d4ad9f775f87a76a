"""Membership's rules on a whole node: only a beat is proof of life, and a token's end is no proof of death."""

from __future__ import annotations

from zsched.core.values import events as ev
from zsched.core.values.model import PeerState
from zsched_lab.sim.simulator import Simulator
from zsched_lab.sim.swarm import plan


def test_a_token_accuses_and_never_clears() -> None:
    """A wedged daemon's session may come back with its token; its loop has still said nothing."""
    sim = Simulator(fleet=plan(0, nodes=5).fleet, seed=1)
    sim.start()
    sim.run(3.0)
    observer, other = sim.running()[:2]
    incarnation = sim.node(other).incarnation
    sim.pause(sim.machines[other], 60.0)
    assert sim.run_until(lambda: sim.sees(observer, other) is PeerState.GONE, 15.0)
    machine = sim.machines[observer]
    for event in (ev.TokenLost, ev.TokenSeen):
        sim.deliver(machine, event(node=other, incarnation=incarnation))
        assert sim.sees(observer, other) is PeerState.GONE


def test_a_living_node_whose_token_goes_is_suspect_at_once_and_cleared_by_its_next_beats() -> None:
    sim = Simulator(fleet=plan(0, nodes=5).fleet, seed=1)
    sim.start()
    sim.run(3.0)
    observer, other = sim.running()[:2]
    sim.deliver(sim.machines[observer], ev.TokenLost(node=other, incarnation=sim.node(other).incarnation))
    assert sim.sees(observer, other) is PeerState.SUSPECT
    assert sim.run_until(lambda: sim.sees(observer, other) is PeerState.ALIVE, 1.5)
