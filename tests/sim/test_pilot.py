"""Electors by themselves, in time: what becomes of each situation, and that the play finds what would break it."""

from __future__ import annotations

import pytest

from zsched.core.electorate.changes import SetAway
from zsched.core.electorate.pilot import may_go
from zsched_lab.sim.pilot import main, play, summary
from zsched_lab.sim.piloted import AWAY_S, SILENCE_S, Piloted

FIVE = ("e1", "e2", "e3", "r1", "r2")
CALM_S = 12.0


def fleet(*names: str, electors: int, seed: int = 3, is_auto: bool = True) -> Piloted:
    """A fleet that has run for long enough to know who is steady; the first names elect."""
    world = Piloted(names, electors=electors, seed=seed, is_auto=is_auto)
    world.pass_time(8.0)
    return world


def changes(world: Piloted) -> str:
    """Of the electors."""
    return summary([change for change in world.changes() if not isinstance(change, SetAway)])


def moves(world: Piloted, by: str, to: str) -> bool:
    """Whether the exclusive task can be moved."""
    for _ in range(6):
        world.move_to(world.machine(by), "t1", to)
        world.pass_time(3.0)
        if world.working("t1") == [to]:
            return True
    return False


def test_one_deaf_link_throws_nobody_out() -> None:
    world = fleet("r1", "r2", "r3", "e1", "e2", electors=5)
    world.cut = lambda sender, to: (sender, to) == ("r1", "r2")
    world.pass_time(10 * SILENCE_S)
    assert changes(world) == ""


def test_a_node_that_is_deaf_to_all_throws_nobody_out() -> None:
    world = fleet("r1", "r2", "r3", "e1", "e2", electors=5)
    world.cut = lambda _, to: to == "r2"
    world.pass_time(10 * SILENCE_S)
    assert changes(world) == ""


@pytest.mark.parametrize("seed", range(6))
def test_after_a_common_sleep_nobody_is_thrown_out(seed: int) -> None:
    """A pause of all virtual machines: each wakes with nothing but old beats."""
    world = fleet("r1", "r2", "r3", "e1", "e2", electors=3, seed=seed)
    before = changes(world)
    for machine in world.machines:
        world.pause(machine)
    world.pass_time(5.0)
    for machine in world.machines:
        world.wake(machine)
        world.pass_time(0.1)
    world.pass_time(CALM_S)
    assert changes(world) == before


def test_five_electors_two_spares_three_deaths_one_by_one() -> None:
    world = fleet("e1", "r1", "r2", "e2", "r3", "e3", "r4", electors=5)
    for name in ("e1", "r1", "r2"):
        world.stop(world.machine(name))
        world.pass_time(CALM_S)
    assert changes(world) == "-e1 +e3 -r1 +r4 -r2"
    assert world.value("e2").electorate.names == ("e2", "e3", "r3", "r4")
    assert moves(world, "r4", "e3")


def test_a_lost_disk_is_another_member_and_comes_back() -> None:
    world = fleet("r1", "r2", "r3", electors=3)
    world.lose_disk(world.machine("r2"))
    world.pass_time(CALM_S + CALM_S)
    assert changes(world) == "-r2 +r2"
    assert moves(world, "r2", "r2")


def test_a_leaver_is_removed_first_and_may_go_when_it_has_learnt_that() -> None:
    world = fleet("r1", "r2", "r3", "e1", electors=3)
    world.leaving.add("r2")
    seen = []
    for _ in range(100):
        world.pass_time(0.1)
        seen.append(may_go(world.value("r2"), "r2"))
        if world.value("r2").electorate.seat("r2") is not None:
            assert not seen[-1], "it is an elector still"
    assert seen[-1]
    assert changes(world) == "-r2 +e1"


def test_a_node_that_comes_and_goes_is_no_candidate() -> None:
    world = fleet("r1", "r2", "r3", "e1", "e2", electors=3)
    before = changes(world)
    began_at = world.time
    world.cut = lambda sender, to: "e1" in (sender, to) and (world.time - began_at) % 6.0 < 3.0
    world.pass_time(36.0)
    after = changes(world).removeprefix(before).split()
    assert len(after) <= 2, "it goes once, and does not come back while it comes and goes"


def test_two_machines_of_one_name_change_nothing() -> None:
    """The one with the elector's disk is alive; the other one is no reason to remove it, and no candidate."""
    world = fleet("r1", "r2", "r3", electors=3)
    world.clone(world.machine("r2"))
    world.pass_time(30.0)
    assert changes(world) == ""


def test_a_name_that_two_spares_share_is_not_added() -> None:
    world = Piloted(("r1", "r2", "r3", "e1", "e2"), electors=3, seed=3)
    world.clone(world.machine("e1"))
    world.pass_time(20.0)
    assert changes(world) == "", "with e2 alone there would be four"


def test_seven_to_two_by_deaths_and_to_one_by_a_leave() -> None:
    names = ("e1", "e2", "e3", "r1", "r2", "r3", "r4")
    world = fleet(*names, electors=7)
    for dead in names[:4]:
        world.stop(world.machine(dead))
        world.pass_time(CALM_S)
        assert moves(world, "r2", "r3"), f"without {dead}"
        assert moves(world, "r2", "r2"), f"without {dead}"
    assert world.value("r4").electorate.names == ("r2", "r3", "r4")
    world.stop(world.machine("r2"))
    world.pass_time(CALM_S)
    assert world.value("r4").electorate.names == ("r2", "r3", "r4"), "two are no better than three with one gone"
    assert moves(world, "r4", "r3")
    world.leaving.add("r2")
    world.pass_time(CALM_S)
    assert world.value("r4").electorate.names == ("r3", "r4")
    world.leaving.add("r3")
    world.pass_time(CALM_S)
    assert world.value("r4").electorate.names == ("r4",)
    assert may_go(world.value("r3"), "r3")
    world.stop(world.machine("r3"))
    assert moves(world, "r4", "r4")
    world.leaving.add("r4")
    world.pass_time(CALM_S)
    assert world.value("r4").electorate.names == ("r4",), "the last one stays"


def test_all_are_replaced_while_one_sleeps() -> None:
    world = fleet("r1", "r2", "r3", "e1", "e2", "e3", "e4", electors=3)
    world.pause(world.machine("e4"))
    for name in ("r1", "r2", "r3"):
        world.stop(world.machine(name))
        world.pass_time(CALM_S)
    assert world.value("e1").electorate.names == ("e1", "e2", "e3")
    world.wake(world.machine("e4"))
    world.pass_time(2.0)
    assert world.value("e4") == world.value("e1")
    assert moves(world, "e4", "e4")


def test_from_three_to_two_only_with_a_spare_and_the_third_is_an_elector_when_it_is_back() -> None:
    world = fleet("r1", "r2", "r3", electors=3)
    world.pause(world.machine("r2"))
    world.pass_time(CALM_S)
    assert changes(world) == ""
    assert "no node is fit to follow it" in world.lives[id(world.machine("r1"))].pilot.advice.reason
    world.wake(world.machine("r2"))
    world.pass_time(CALM_S)
    assert changes(world) == ""


def test_two_electors_wait_for_each_other() -> None:
    world = fleet("r1", "r2", electors=2)
    world.stop(world.machine("r2"))
    world.pass_time(CALM_S)
    assert changes(world) == ""


def test_one_elector_stays_alone_with_one_spare_and_becomes_three_with_two() -> None:
    world = fleet("r1", "r2", electors=1)
    world.pass_time(CALM_S)
    assert changes(world) == ""
    world = fleet("r1", "r2", "e1", electors=1)
    world.pass_time(CALM_S)
    assert changes(world) in ("+e1 +r2", "+r1 +r2"), "the first elector is the one whose name comes first"
    assert moves(world, "e1", "r2")


def test_a_spare_that_dies_while_it_is_added_stops_nothing() -> None:
    """With room for one that never answers, a dead one is removed again."""
    world = Piloted(FIVE, electors=3, seed=3)
    while world.chosen.newest_fleet(world.first.generation_id).electorate.seat("r1") is None:
        world.pass_time(0.02)
    world.stop(world.machine("r1"))
    world.pass_time(CALM_S)
    assert changes(world) == "+r1 -r1"
    assert moves(world, "e1", "e2")


def test_electors_that_the_operator_names_stay() -> None:
    world = fleet(*FIVE, electors=3, is_auto=False)
    world.stop(world.machine("e1"))
    world.lose_disk(world.machine("e2"))
    world.pass_time(CALM_S)
    assert changes(world) == ""
    assert world.value("e3").electorate.names == ("e1", "e2", "e3")


def test_robots_that_are_away_for_long_are_marked_and_are_back_at_once() -> None:
    world = fleet("e1", "e2", "e3", "r1", "r2", "r3", "r4", "r5", electors=3, is_auto=False)
    for name in ("r1", "r2", "r3"):
        world.pause(world.machine(name))
    world.pass_time(AWAY_S + 3.0)
    assert world.value("e1").away == ("r1", "r2", "r3")
    world.wake(world.machine("r2"))
    world.pass_time(2.0)
    assert world.value("r2").away == ("r1", "r3")
    assert world.value("e1").number == 1, "who is away changes no number"


def test_an_elector_that_starts_does_not_call_back_whoever_is_away() -> None:
    world = fleet("e1", "e2", "e3", "r1", "r2", electors=3, is_auto=False)
    world.stop(world.machine("r1"))
    world.pass_time(AWAY_S + 3.0)
    for name in ("e1", "e2", "e3"):
        world.restart(world.machine(name))
    world.pass_time(AWAY_S)
    assert summary(world.changes()) == "away(r1)"


def test_one_elector_that_does_not_hear_a_robot_does_not_mark_it() -> None:
    world = fleet("e1", "e2", "e3", "r1", electors=3, is_auto=False)
    world.cut = lambda sender, to: (sender, to) == ("r1", "e1")
    world.pass_time(3 * AWAY_S)
    assert summary(world.changes()) == ""


@pytest.mark.parametrize("block", range(2))
def test_faults_by_seed_leave_a_fleet_that_settles_and_moves_its_tasks(block: int) -> None:
    assert [played.violation for seed in range(4 * block, 4 * block + 4) if (played := play(seed)).violation] == []


def test_the_command_counts_and_says_which_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--runs", "1"]) == 0
    assert "1 schedules" in capsys.readouterr().out
