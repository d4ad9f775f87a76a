"""A site of cells in the simulator: each cell alone is played through."""

from __future__ import annotations

import pytest

from zsched.core.values.fleet import Timing
from zsched_lab.sim.site import ELECTORS, Played, fleet_of, play, shares


@pytest.fixture(scope="module")
def cell() -> Played:
    return play(4, 3, 1, Timing())


def test_a_cell_survives_each_of_its_faults_in_time(cell: Played) -> None:
    frozen, killed, many = (
        cell.faults[f"{what}"] for what in ("owner frozen", "owner killed", "all edges but one killed")
    )
    timing = Timing()
    assert timing.suspect_s - timing.beat_s < frozen[0] <= frozen[1] < timing.suspect_s + 2 * timing.confirm_s
    assert 0 < killed[0] <= killed[1] < 0.2
    assert 0 < many[0] <= many[1] < 0.3
    known = cell.faults["the last edge killed: it is known"]
    assert 0 < known[0] <= known[1] < 0.1
    assert 0 < cell.faults["all edges back: the task's streams flow"][0] < 2


def test_what_a_node_hears_at_rest_is_what_the_others_say(cell: Played) -> None:
    beats = cell.heard["BeatReceived"] / cell.nodes / 10.0
    assert beats == pytest.approx((cell.nodes - 1) / Timing().rest_beat_s, rel=0.05)
    assert cell.heard_hz > beats
    assert cell.core_percent > 0


def test_a_larger_fleet_has_five_electors_and_its_edges_are_the_candidates() -> None:
    fleet = fleet_of(20, 4, Timing())
    assert len(fleet.electors) == ELECTORS
    assert fleet.tasks[0].candidates == ("edge001", "edge002", "edge003", "edge004")


def test_machines_are_shared_out_evenly() -> None:
    assert shares(10, 3) == [4, 3, 3]
    assert sum(shares(1000, 50)) == 1000
