"""An exclusive task whose owner robots reach and too few electors hear: its lease has ended, and no word says so."""

from __future__ import annotations

import pytest

from zsched.core.node.status import build_snapshot
from zsched.core.values.events import HoldCommanded, MoveCommanded
from zsched.core.values.messages import Hold, HoldTask, MoveTask
from zsched.core.values.model import Asked
from zsched_lab.sim import missed_electors
from zsched_lab.sim.missed_electors import ELECTORS, ROBOTS, main, moves, play, working
from zsched_lab.sim.simulator import Simulator


def started(*, pinned: bool = False, electors: tuple[str, ...] = ELECTORS) -> Simulator:
    """A fleet whose owner is edge1, and has been for a while."""
    sim = missed_electors.started(electors=electors)
    if pinned:
        order = HoldTask(task="guard", hold=Hold.PIN, node="edge1", asked=Asked(by="ada@robot1"))
        sim.deliver(sim.machines["robot1"], HoldCommanded(request=1, command=order))
    sim.run(5.0)
    assert working(sim) == "edge1"
    return sim


@pytest.mark.parametrize("hold", ["", "pin"])
@pytest.mark.parametrize("ways", ["both", "to it", "from it"])
def test_the_task_is_left_once_a_majority_of_the_electors_and_its_owner_do_not_hear_each_other(
    hold: str, ways: str
) -> None:
    sim = started(pinned=hold == "pin")
    pairs = [("edge1", name) for name in ELECTORS[:2]]
    if ways in ("both", "from it"):
        sim.cuts.update(pairs)
    if ways in ("both", "to it"):
        sim.cuts.update((name, edge) for edge, name in pairs)
    timing = sim.fleet.timing
    assert sim.run_until(lambda: working(sim) == "edge2", timing.suspect_s + timing.confirm_s + 2.0)
    sim.run(20.0)
    assert working(sim) == "edge2", "it does not come back to where it would stand still"
    order = MoveTask(task="guard", node="edge1", asked=Asked(by="ada@robot1"))
    sim.deliver(sim.machines["robot2"], MoveCommanded(request=2, command=order))
    sim.run(1.0)
    detail = next(one.result.detail for one in sim.answers if one.request == 2)
    if hold == "":
        assert detail == "edge1 cannot have it: too few electors can give it a lease (1 of 3)"
    sim.heal()
    sim.run(10.0)
    assert sim.unsettled() == ""


def test_one_elector_that_the_owner_does_not_hear_is_not_missed() -> None:
    sim = started()
    sim.cut(("edge1",), ELECTORS[:1])
    for _ in range(100):
        sim.run(0.1)
        assert working(sim) == "edge1"


def test_a_silence_that_is_refuted_in_time_moves_nothing() -> None:
    sim = started()
    sim.cut(("edge1",), ELECTORS[:2])
    sim.run(sim.fleet.timing.suspect_s - 0.3)
    sim.heal()
    sim.run(10.0)
    assert working(sim) == "edge1"


def test_an_owner_that_is_an_elector_counts_itself() -> None:
    sim = started(electors=("edge1", "base1", "base2"))
    sim.cut(("edge1",), ("base1",))
    sim.run(10.0)
    assert working(sim) == "edge1"
    sim.cut(("edge1",), ("base1", "base2"))
    assert sim.run_until(lambda: working(sim) == "edge2", 5.0)


def test_where_nobody_else_has_a_lease_either_the_task_waits_and_goes_on() -> None:
    sim = started()
    sim.cut(("edge1", "edge2"), ELECTORS[:2])
    sim.run(10.0)
    assert working(sim) == ""
    assert sim.agreed("guard") == "edge1"
    for name in ("robot1", "base3", "edge1"):
        (told,) = (task.problems for task in build_snapshot(sim.node(name), sim.now).tasks)
        why = "it rests, for it has no lease (too few electors can give it a lease (1 of 3))"
        assert f"the worker on edge1: {why}" in told
    sim.heal()
    assert sim.run_until(lambda: working(sim) == "edge1", 5.0)
    sim.run(1.0)
    assert build_snapshot(sim.node("robot1"), sim.now).tasks[0].problems == ()


def test_an_elector_whose_state_is_lost_counts_for_nobody() -> None:
    sim = started()
    sim.crash("base3")
    sim.machines["base3"].disk.wipe()
    sim.start("base3")
    sim.run(3.0)
    assert working(sim) == "edge1"
    sim.cut(("edge1",), ("base1",))
    assert sim.run_until(lambda: working(sim) == "edge2", 6.0)


# --- what robots cannot see, and the owner says ----------------------------------------------------------------------


def unseen_by_robots(*edges: str) -> Simulator:
    """What these edges send reaches neither base1 nor base2, and the robots do not hear base1."""
    sim = started()
    sim.cuts.update((edge, name) for edge in edges for name in ELECTORS[:2])
    sim.cuts.update(("base1", robot) for robot in ROBOTS)
    return sim


def test_an_owner_that_says_that_it_rests_is_left_for_one_that_has_not() -> None:
    sim = unseen_by_robots("edge1")
    before = moves(sim)
    assert sim.run_until(lambda: working(sim) == "edge2", 8.0)
    sim.run(50.0)
    assert working(sim) == "edge2"
    assert moves(sim) - before == 1


def test_a_pinned_task_is_not_kept_where_it_rests() -> None:
    sim = started(pinned=True)
    sim.cuts.update(("edge1", name) for name in ELECTORS[:2])
    sim.cuts.update(("base1", robot) for robot in ROBOTS)
    before = moves(sim)
    assert sim.run_until(lambda: working(sim) == "edge2", 8.0)
    sim.run(45.0)
    assert working(sim) == "edge2"
    assert moves(sim) - before == 1


@pytest.mark.parametrize(("down_s", "of_s", "within_s"), [(6.0, 6.2, 40.0), (5.0, 6.0, 40.0), (2.0, 3.0, 75.0)])
def test_so_is_one_that_rests_again_and_again_and_never_for_long(down_s: float, of_s: float, within_s: float) -> None:
    """Each lease took all back that had been said of it: 16, 30 and 60 % of the time were worked, for good."""
    sim = started()
    before, began_at, at_work = moves(sim), sim.now, list[str]()
    while sim.now - began_at < within_s + 40.0:
        sim.heal()
        sim.cuts.update(("base1", robot) for robot in ROBOTS)
        if (sim.now - began_at) % of_s < down_s:
            sim.cuts.update(("edge1", name) for name in ELECTORS[:2])
        sim.run(0.1)
        at_work.append(working(sim))
    assert moves(sim) - before == 1
    assert set(at_work[round(within_s / 0.1) :]) == {"edge2"}


@pytest.mark.long
def test_where_every_candidate_rests_the_task_is_tried_elsewhere_ever_more_seldom() -> None:
    sim = unseen_by_robots("edge1", "edge2")
    counts = [moves(sim)]
    for _ in range(4):
        sim.run(75.0)
        counts.append(moves(sim))
    early, late = counts[1] - counts[0], counts[4] - counts[3]
    assert early <= 20
    assert late <= early // 2
    sim.heal()
    assert sim.run_until(lambda: working(sim) != "", 5.0)


@pytest.mark.long
@pytest.mark.parametrize(("is_busy", "down_s", "most_moves"), [(False, 5.0, 1), (True, 1.6, 20), (True, 5.0, 20)])
def test_a_link_that_is_down_now_and_then_costs_the_task_little(is_busy: bool, down_s: float, most_moves: int) -> None:
    """Without a word about electors it stood still for a quarter of the time where the link is down that long."""
    played = play(down_s, is_busy=is_busy, for_s=200.0)
    assert played.at_work > (0.94 if is_busy else 0.99)
    assert 1 <= played.moves <= most_moves


def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--down", "0", "--seconds", "20"]) == 0
    assert capsys.readouterr().out.splitlines()[3:] == ["| alike | 0 | 0 | 100% |", "| busy | 0 | 0 | 100% |"]
