"""An owner whose beats pass and whose streams reach no robot, for good or most of the time."""

from __future__ import annotations

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from support.plays import EDGES, TASK, Play
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.fleet import WorkerSpec
from zsched_lab.sim import missed_electors
from zsched_lab.sim.missed_electors import ROBOTS, moves, working
from zsched_lab.sim.simulator import Simulator

PAIRS = [pair for robot in ROBOTS for pair in (("edge1", robot), (robot, "edge1"))]


def end_streams(sim: Simulator) -> None:
    """Zenoh has heard nothing over these links for a lease: the tokens behind them go, and come with the next link."""
    if not sim.data_cuts.issuperset(PAIRS):
        return
    for source, target in PAIRS:
        sim.work.lose(sim.machines[source], sim.machines[target])


def played(down_s: float, of_s: float, for_s: float) -> tuple[list[str], int]:
    """Who has worked, each 0.1 s, and the moves, where the owner's streams are cut for ``down_s`` of each ``of_s``."""
    sim = missed_electors.started()
    sim.run(5.0)
    before, began_at, at_work, was_down = moves(sim), sim.now, list[str](), False
    while sim.now - began_at < for_s:
        is_down = (sim.now - began_at) % of_s < down_s
        if is_down and not was_down:
            sim.data_cuts.update(PAIRS)
            sim.later(sim.fleet.timing.zenoh_lease_s, end_streams, sim)
        elif was_down and not is_down:
            sim.data_cuts.clear()
        was_down = is_down
        sim.run(0.1)
        at_work.append(working(sim))
    return at_work, moves(sim) - before


@pytest.mark.parametrize(
    ("down_s", "of_s", "within_s"), [(11.0, 12.0, 45.0), (7.0, 8.0, 45.0), (3.0, 4.0, 130.0), (1000.0, 1000.0, 15.0)]
)
def test_the_owner_is_left_and_does_not_get_the_task_back(down_s: float, of_s: float, within_s: float) -> None:
    """With each token its time began anew: 11 of each 12 s without a stream, for good, beside an idle machine."""
    at_work, moved = played(down_s, of_s, within_s + 60.0)
    assert moved == 1
    assert set(at_work[round(within_s / 0.1) :]) == {"edge2"}


@pytest.mark.parametrize(
    ("robots", "is_cut", "owner"),
    [(("robot1",), True, "robot1"), (("robot1",), False, "edge1"), (("robot1", "robot2"), True, "edge1")],
)
def test_the_only_robot_does_its_task_itself_where_no_stream_reaches_the_edge(
    robots: tuple[str, ...], owner: str, *, is_cut: bool
) -> None:
    """It gave the task away, and nobody did it any more. Where another robot may reach the edge it cannot tell."""
    task = task_of(
        candidates=("robot1", "edge1"),
        tuning=tuning_of(cpu=1.0, memory=0.0),
        worker=WorkerSpec(command=("work",)),
        price_s=0.15,
    )
    fleet = fleet_of(task, of=(*robots, "edge1"))
    busy = {"robot1": 2.4}
    load = lambda node, at: (busy.get(node, 0.2) if at > 130.0 else 0.2, 1000.0)  # noqa: E731
    sim = Simulator(fleet=fleet, seed=1, load=load)
    if is_cut:
        sim.data_cuts.update((("robot1", "edge1"), ("edge1", "robot1")))
    sim.start(*robots)
    sim.run(6.0)
    sim.start()
    sim.run(20.0)
    assert sim.agreed(task.name) == "robot1"
    sim.run(60.0)
    assert sim.agreed(task.name) == owner


@pytest.mark.long
@pytest.mark.parametrize(("down_s", "of_s"), [(6.0, 30.0), (11.0, 100.0)])
def test_one_that_is_there_for_most_of_the_time_is_kept(down_s: float, of_s: float) -> None:
    """With a tenth of the time between them forgiven it was left, or left for nothing just when it was back."""
    at_work, moved = played(down_s, of_s, 200.0)
    assert (set(at_work), moved) == ({"edge1"}, 0)


def test_a_drained_owner_hands_over_to_one_that_comes_and_goes_where_there_is_no_other() -> None:
    """A candidate that is held out while the owner may keep the task held up a drain for as long as it flickered."""
    play = Play()
    play.adopt()
    sim, owner = play.sim, play.sim.agreed(TASK)
    assert owner is not None
    (other,) = set(EDGES) - {owner}
    pairs = [pair for robot in ("robot1", "robot2", "robot3") for pair in ((other, robot), (robot, other))]
    for _ in range(4):
        sim.data_cuts.update(pairs)
        sim.run(1.5)
        for source, target in pairs:
            sim.work.lose(sim.machines[source], sim.machines[target])
        sim.run(8.5)
        sim.data_cuts.clear()
        sim.run(2.0)
    assert sim.node("robot1").unseen.found == {TASK: {other}}
    assert sim.agreed(TASK) == owner
    play.set_flags(Flag(kind=FlagKind.DRAIN, subject=owner, by="ada@robot1", revision=1))
    assert sim.run_until(lambda: sim.agreed(TASK) == other, 5.0)
