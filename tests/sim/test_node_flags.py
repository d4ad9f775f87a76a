"""Whole nodes and operators' flags: what a flagged node gets, keeps and hands over, also over restarts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.plays import FLEET, TASK, Play
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId

ADA = "ada@robot1"


def drain(node: NodeId, for_s: float | None = None) -> Flag:
    return Flag(kind=FlagKind.DRAIN, subject=node, reason="new fan", by=ADA, for_s=for_s, revision=1)


def ineligible(node: NodeId) -> Flag:
    return Flag(kind=FlagKind.INELIGIBLE, subject=node, by=ADA, revision=1)


def of(*tasks: str, exclusive: bool = False) -> Fleet:
    """Three candidates, tasks that like to stay, and hardly move by themselves."""
    first = replace(
        FLEET.tasks[0],
        candidates=("edge1", "edge2", "robot3"),
        exclusive=exclusive,
        max_moves_per_minute=1,
        tuning=replace(FLEET.tasks[0].tuning, bonus=0.3),
    )
    return replace(FLEET, tasks=tuple(replace(first, name=name) for name in tasks))


def owner(play: Play, task: str = TASK) -> NodeId:
    found = play.sim.agreed(task)
    assert found is not None
    return found


def moves_to(play: Play, task: str, *nodes: NodeId) -> bool:
    return play.sim.run_until(lambda: play.sim.agreed(task) in nodes and not play.sim.unsettled(), 5)


@pytest.mark.parametrize("exclusive", [False, True])
def test_a_drained_owner_hands_over_without_owing_anything_and_stays_out(exclusive: bool) -> None:
    play = Play(fleet=of(TASK, exclusive=exclusive))
    play.adopt()
    first = owner(play)
    others = [name for name in ("edge1", "edge2", "robot3") if name != first]
    play.set_flags(drain(first))
    assert moves_to(play, TASK, *others), "the bonus, the price and the cap of one a minute do not hold it"
    second = owner(play)
    play.set_flags(drain(first), drain(second))
    (third,) = (name for name in others if name != second)
    assert moves_to(play, TASK, third)
    story = play.sim.node("robot2").history[TASK][-1].reason
    assert story == f"{second} is drained by {ADA} (new fan)"
    play.sim.crash(first)
    play.sim.start(first)
    play.sim.run(5.0)
    assert owner(play) == third
    assert play.sim.node(first).flags.closed.keys() == {first, second}, "a restart keeps it"


def test_a_drained_owner_keeps_its_task_while_nobody_else_can_have_it() -> None:
    play = Play(fleet=of(TASK))
    play.adopt()
    play.set_flags(drain("edge1"), drain("edge2"), drain("robot3"))
    play.sim.run(5.0)
    last = owner(play)
    judgement = play.sim.node("robot1").rounds.tasks[TASK].judgement
    assert judgement is not None
    assert (
        judgement.reason
        == f"{last} is drained by {ADA} (new fan); it keeps the task, for no other candidate can have it"
    )
    (free,) = [name for name in ("edge1", "edge2") if name != last][:1]
    play.set_flags(*(drain(name) for name in ("edge1", "edge2", "robot3") if name != free))
    assert moves_to(play, TASK, free)


def test_several_nodes_are_drained_at_once_and_no_task_moves_twice() -> None:
    play = Play(fleet=of("one", "three", "two"))
    play.adopt()
    epochs = {name: play.sim.node("robot1").values()[name].epoch for name in ("one", "three", "two")}
    play.set_flags(drain("edge1"), drain("edge2"))
    assert all(moves_to(play, name, "robot3") for name in epochs)
    after = {name: play.sim.node("robot1").values()[name].epoch for name in epochs}
    assert all(after[name] - epochs[name] <= 1 for name in epochs), (epochs, after)


def test_an_ineligible_owner_keeps_its_task_and_gets_no_other() -> None:
    play = Play(fleet=of(TASK))
    play.adopt()
    first = owner(play)
    play.set_flags(ineligible(first))
    play.sim.run(5.0)
    assert owner(play) == first
    play.sim.crash(first)
    others = [name for name in ("edge1", "edge2", "robot3") if name != first]
    assert moves_to(play, TASK, *others)
    play.sim.start(first)
    play.sim.run(5.0)
    for name in others:
        play.sim.crash(name)
    play.sim.run(10.0)
    assert owner(play) in others, "nobody may take it: the only candidate that is left takes nothing new"


def test_a_flag_ends_by_itself_and_never_early() -> None:
    play = Play(fleet=of(TASK))
    play.adopt()
    first = owner(play)
    play.set_flags(drain(first, for_s=20.0), ineligible("robot3"))
    began = play.sim.now
    assert play.sim.run_until(lambda: first not in play.sim.node("robot2").flags.closed, 40)
    assert play.sim.now - began >= 15.0
    play.settle()
    assert {play.sim.node(name).flags.closed.keys() == {"robot3"} for name in play.sim.running()} == {True}
