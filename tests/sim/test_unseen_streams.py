"""An owner whose beats pass and whose streams reach no robot, for good or most of the time."""

from __future__ import annotations

import pytest

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


@pytest.mark.parametrize(("down_s", "of_s"), [(11.0, 12.0), (7.0, 8.0), (3.0, 4.0), (1000.0, 1000.0)])
def test_the_owner_is_left_and_does_not_get_the_task_back(down_s: float, of_s: float) -> None:
    """With each token its time began anew: 11 of each 12 s without a stream, for good, beside an idle machine."""
    sim = missed_electors.started(cool_down_s=60.0)
    sim.run(5.0)
    before, began_at, at_work, was_down = moves(sim), sim.now, list[str](), False
    while sim.now - began_at < 150.0:
        is_down = (sim.now - began_at) % of_s < down_s
        if is_down and not was_down:
            sim.data_cuts.update(PAIRS)
            sim.later(sim.fleet.timing.zenoh_lease_s, end_streams, sim)
        elif was_down and not is_down:
            sim.data_cuts.clear()
        was_down = is_down
        sim.run(0.1)
        at_work.append(working(sim))
    assert moves(sim) - before == 1
    assert set(at_work[450:]) == {"edge2"}, "45 s are enough"
