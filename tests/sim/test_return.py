"""A node that was gone and is back gets no task before the robots' relays have proof of its streams."""

from __future__ import annotations

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.scheduler.probation import LEASE_MARGIN_S
from zsched.core.values.fleet import Timing, WorkerSpec
from zsched.core.values.model import PeerState
from zsched_lab.sim.simulator import CORES, Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")
TIMING = Timing()


def settled_on_edge1() -> Simulator:
    """A fleet at rest whose task would go to edge1 whenever it may."""
    task = task_of(
        candidates=EDGES,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.0,
        worker=WorkerSpec(command=("true",)),
    )
    fleet = fleet_of(task, of=EDGES + ROBOTS)
    sim = Simulator(fleet=fleet, seed=5, load=lambda node, _: (CORES * (0.05 if node == "edge1" else 0.9), 1000.0))
    sim.start()
    assert sim.run_until(lambda: sim.agreed("merge") == "edge1" and not sim.unsettled(), 20), sim.unsettled()
    sim.run(5)
    return sim


def vetoes(sim: Simulator) -> list[str]:
    """Why each robot does not give edge1 the task."""
    standings = [sim.node(robot).rounds.tasks["merge"].standing for robot in ROBOTS]
    return [str(standing.vetoed.get("edge1", "")) for standing in standings if standing is not None]


def test_a_node_whose_cut_has_healed_waits_until_a_dead_link_s_lease_would_have_ended() -> None:
    sim = settled_on_edge1()
    rest = tuple(name for name in sim.running() if name != "edge1")
    sim.cut(("edge1",), rest)
    assert sim.run_until(lambda: sim.agreed("merge", *rest) not in (None, "edge1"), 10)
    sim.heal()
    assert sim.run_until(lambda: all(sim.sees(robot, "edge1") is PeerState.ALIVE for robot in ROBOTS), 2)
    at = sim.now
    assert sim.run_until(
        lambda: len(vetoes(sim)) == len(ROBOTS) and all(veto.startswith("back for ") for veto in vetoes(sim)), 1.5
    ), vetoes(sim)
    assert sim.run_until(lambda: sim.agreed("merge") == "edge1", 10), "\n".join(sim.stories[-20:])
    proven_s = TIMING.zenoh_lease_s + LEASE_MARGIN_S
    assert proven_s - TIMING.beat_s < sim.now - at < proven_s + 1.5


def test_a_node_that_is_started_again_gets_its_task_as_soon_as_its_worker_s_new_token_is_seen() -> None:
    sim = settled_on_edge1()
    sim.crash("edge1")
    assert sim.run_until(lambda: sim.agreed("merge") not in (None, "edge1"), 10)
    sim.run(3)
    sim.start("edge1")
    at = sim.now
    assert sim.run_until(lambda: sim.agreed("merge") == "edge1", 10), "\n".join(sim.stories[-20:])
    assert sim.now - at < TIMING.zenoh_lease_s + LEASE_MARGIN_S


def test_an_owner_that_is_back_before_anybody_has_moved_its_task_keeps_it() -> None:
    """No majority of the robots hears it or each other for a while: afterwards nothing has to be proven to stay."""
    sim = settled_on_edge1()
    epochs = len(sim.owners)
    sim.cut(*((name,) for name in sim.running()))
    sim.run(5)
    assert all(sim.sees(robot, "edge1") is PeerState.GONE for robot in ROBOTS)
    sim.heal()
    sim.run(15)
    assert sim.agreed("merge") == "edge1"
    assert len(sim.owners) == epochs, "\n".join(sim.stories[-20:])
