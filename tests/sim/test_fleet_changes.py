"""Whole nodes change their fleet: the first document, electors that come and go, under faults."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from support.plays import FLEET, ROBOTS, TASK, Play
from support.slices import slices
from zsched.config.timing import WAN
from zsched.core.electorate.documents import Documents
from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import ChangeFleet, CommandOutcome, TuneTask
from zsched.core.values.model import Asked, ScoreForm
from zsched.core.values.words import CREATION_STEP
from zsched_lab.sim import fleets


def test_the_first_document_is_agreed_and_every_node_goes_by_it() -> None:
    play = Play()
    owner = play.sim.agreed(TASK)
    result = play.told("robot1", ChangeFleet(document=play.document(FLEET)))
    assert (result.outcome, result.revision) == (CommandOutcome.OK, 2)
    assert "number 2 is being settled" in result.detail
    play.settle()
    values = {play.sim.node(name).agreement.fleet_value for name in play.sim.running()}
    assert [(one.number, one.revision, one.settled) for one in values if one is not None] == [(2, 3, True)]
    assert {len(machine.disk.documents) for machine in play.sim.machines.values()} == {1}
    assert play.sim.agreed(TASK) == owner


def test_an_elector_is_removed_and_another_added_and_the_task_never_stops() -> None:
    play = Play()
    play.adopt()
    result = play.told("robot2", ChangeFleet(remove_elector="robot1"))
    assert result.outcome is CommandOutcome.OK
    early = play.told("robot2", ChangeFleet(add_elector="edge1", disk=play.disk("edge1")))
    assert (early.outcome, early.detail) == (
        CommandOutcome.INVALID,
        "number 3 is not settled: a majority of its electors must answer first",
    )
    play.settle()
    result = play.told("robot3", ChangeFleet(add_elector="edge1", disk=play.disk("edge1")))
    assert result.outcome is CommandOutcome.OK
    play.settle()
    assert {play.electors(name) for name in play.sim.running()} == {("edge1", "robot2", "robot3")}
    play.sim.crash("robot3")
    owner = play.sim.agreed(TASK)
    assert owner is not None
    play.sim.crash(owner)
    play.sim.start(owner)
    play.settle(20)


def test_who_was_away_during_changes_starts_by_the_old_value_and_learns() -> None:
    play = Play()
    play.adopt()
    play.sim.crash("robot3")
    assert play.told("robot1", ChangeFleet(add_elector="edge1", disk=play.disk("edge1"))).outcome is CommandOutcome.OK
    play.settle(20)
    assert play.told("robot1", ChangeFleet(remove_elector="robot3")).outcome is CommandOutcome.OK
    play.settle(20)
    play.sim.start("robot3")
    play.settle(20)
    assert play.electors("robot3") == ("edge1", "robot1", "robot2")
    assert not play.sim.node("robot3").agreement.is_elector


@pytest.mark.parametrize("zenoh_config", ["", "z.json5"])
def test_a_task_that_is_added_again_is_another_one_for_who_was_away(zenoh_config: str) -> None:
    """Its streams do not go on to the owner of the task before, also when the document is the same one again."""
    play = Play()
    play.adopt()
    both = replace(FLEET, tasks=(*FLEET.tasks, replace(FLEET.tasks[0], name="other", exclusive=False)))
    assert play.told("robot1", ChangeFleet(document=play.document(both))).outcome is CommandOutcome.OK
    play.settle(20)
    assert play.sim.run_until(lambda: play.sim.agreed("other") is not None, 20)
    play.sim.crash("robot3")
    for said in (FLEET, replace(both, zenoh_config=zenoh_config)):
        assert play.told("robot1", ChangeFleet(document=play.document(said))).outcome is CommandOutcome.OK
        tasks = said.tasks
        assert play.sim.run_until(lambda: play.sim.node("robot2").fleet.tasks == tasks, 20)  # noqa: B023 - at once
    play.sim.start("robot3")
    back = play.sim.node("robot3")
    epoch, newest = back.registers["other"].value.epoch, play.sim.node("robot1").agreement.fleet_revision
    assert epoch // CREATION_STEP == 1
    assert play.sim.run_until(lambda: play.sim.node("robot3").agreement.fleet_revision == newest, 5)
    assert play.sim.node("robot3").executors["other"].epoch // CREATION_STEP in (0, 2)
    play.settle(20)
    assert play.sim.run_until(lambda: play.sim.agreed("other") is not None, 20)


def test_a_node_starts_by_its_document_and_shows_that_its_file_differs() -> None:
    play = Play()
    play.adopt()
    other = replace(FLEET, zenoh_config="z.json5")
    play.sim.machines["robot1"].fleet = other
    play.sim.crash("robot1")
    play.sim.start("robot1")
    assert play.sim.node("robot1").fleet.zenoh_config == FLEET.zenoh_config
    assert "zsched apply" in play.sim.node("robot1").problems["fleet/file", ""]
    play.settle(20)
    assert ("fleet/file", "") not in play.sim.node("robot2").problems


@pytest.mark.parametrize("kept", [0, 1], ids=["all files are gone", "an older folder"])
def test_a_node_whose_document_is_gone_starts_with_what_it_knows_and_fetches_it(kept: int) -> None:
    """Its file lists a task that the fleet has not any more, and lacks one that it has."""
    play = Play()
    play.adopt()
    more = tuple(replace(FLEET.tasks[0], name=name, exclusive=False) for name in ("other", "third"))
    play.sim.machines["robot1"].fleet = replace(FLEET, tasks=(*FLEET.tasks, more[0]))
    agreed = replace(FLEET, tasks=(*FLEET.tasks, more[1]))
    assert play.told("robot2", ChangeFleet(document=play.document(agreed))).outcome is CommandOutcome.OK
    assert play.sim.run_until(lambda: play.sim.node("robot1").fleet.tasks == agreed.tasks, 20)
    play.settle(20)
    play.sim.crash("robot1")
    assert play.sim.machines["robot1"].disk.lose_documents(kept)
    play.sim.start("robot1")
    robot = play.sim.node("robot1")
    assert [task.name for task in robot.fleet.tasks] == [TASK]
    assert "is not on this disk" in robot.agreement.problems["fleet/document", ""]
    assert play.sim.run_until(lambda: play.sim.node("robot1").fleet.tasks == agreed.tasks, 5)
    assert ("fleet/document", "") not in play.sim.node("robot1").agreement.problems
    play.settle(20)


def test_a_document_that_is_not_valid_here_is_shown_and_the_node_goes_on_by_its_last_one() -> None:
    play = Play()
    play.adopt()
    document = play.document(replace(FLEET, zenoh_config="z.json5"))
    play.sim.documents.unfit.add(("robot3", next(reversed(play.sim.documents.says))))
    assert play.told("robot1", ChangeFleet(document=document)).outcome is CommandOutcome.OK
    assert play.sim.run_until(lambda: ("fleet/document", "") in play.sim.node("robot3").agreement.problems, 5)
    assert play.sim.node("robot3").fleet.zenoh_config == FLEET.zenoh_config
    assert play.sim.run_until(lambda: play.sim.node("robot2").fleet.zenoh_config == "z.json5", 5)
    assert play.sim.node("robot3").agreement.counters["document_refused"] == 1


def test_a_task_that_an_agreed_document_makes_exclusive_works_on_by_leases() -> None:
    """By a document leases hang on its number, and on nothing in a file: all nodes were taken for others for ever."""
    shared, exclusive = (replace(FLEET, tasks=(replace(*FLEET.tasks, exclusive=is_one),)) for is_one in (False, True))
    play = Play(fleet=shared)
    play.adopt()
    owner = play.sim.agreed(TASK) or ""
    assert play.sim.machines[owner].roles[TASK].lease_until_s is None
    assert play.told("robot1", ChangeFleet(document=play.document(exclusive))).outcome is CommandOutcome.OK
    assert play.sim.run_until(lambda: play.sim.node(owner).values()[TASK].leased, 5)
    assert play.sim.run_until(lambda: play.sim.working.get(TASK, ("", 0.0))[0] == owner, 5), "by a lease"
    play.settle()


def tuned(fleet: Fleet, **settings: Any) -> Fleet:
    task = fleet.tasks[0]
    return replace(fleet, tasks=(replace(task, tuning=replace(task.tuning, **settings)),))


def bonuses(play: Play) -> set[float]:
    return {play.sim.node(name).values()[TASK].tuning.bonus for name in play.sim.running()}


def test_two_changes_of_settings_one_after_the_other_are_both_agreed() -> None:
    """Nodes propose a changed setting by rank: while the first two are away, the next change comes before that."""
    play = Play()
    play.adopt()
    for name in ("edge1", "edge2"):
        play.sim.crash(name)
    play.sim.run_until(lambda: False, 5)
    one = tuned(FLEET, bonus=0.2)
    for said in (one, tuned(one, score=ScoreForm.SERVICE)):
        assert play.told("robot1", ChangeFleet(document=play.document(said))).outcome is CommandOutcome.OK
    play.sim.run_until(lambda: False, 10)
    tunings = [play.sim.node(name).values()[TASK].tuning for name in play.sim.running()]
    assert {(one.bonus, one.score) for one in tunings} == {(0.2, ScoreForm.SERVICE)}


def test_a_fleet_that_gets_the_clocks_of_slow_links_is_changed_over_slow_links() -> None:
    """Rounds about the fleet itself go by the changed clocks, as rounds about tasks do."""
    play = Play()
    play.adopt()
    slow = replace(FLEET, timing=WAN)
    assert play.told("robot1", ChangeFleet(document=play.document(slow))).outcome is CommandOutcome.OK
    play.settle(20)
    play.sim.delay_s = (0.93, 0.95)  # an answer comes after a whole round by the clocks of before
    other = play.document(replace(slow, zenoh_config="z.json5"))
    result = play.told("robot1", ChangeFleet(document=other), WAN.order_s)
    assert result.outcome is CommandOutcome.OK
    assert play.sim.run_until(lambda: play.sim.node("robot3").fleet.zenoh_config == "z.json5", 10)


@pytest.mark.parametrize("is_cut_off", [False, True], ids=["off", "cut off"])
def test_who_was_away_when_a_setting_changed_does_not_undo_what_was_tuned_since(is_cut_off: bool) -> None:
    """It takes the document over long after the others: what it changes there is older than an operator's word."""
    play = Play()
    play.adopt()
    others = [name for name in (*ROBOTS, "edge1", "edge2") if name != "robot3"]
    if is_cut_off:
        play.sim.cut(("robot3",), tuple(others))
    else:
        play.sim.crash("robot3")
    play.sim.run_until(lambda: False, 5)
    document = play.document(tuned(FLEET, bonus=0.2))
    assert play.told("robot1", ChangeFleet(document=document)).outcome is CommandOutcome.OK
    assert play.sim.run_until(lambda: play.sim.node("robot1").values()[TASK].tuning.bonus == 0.2, 10)
    value = play.sim.node("robot1").values()[TASK]
    wanted, ada = replace(value.tuning, bonus=0.4), Asked(by="ada@robot1")
    order = TuneTask(task=TASK, tuning=wanted, base_revision=value.revision, asked=ada)
    play.sim.deliver(play.sim.machines["robot1"], ev.commanded(99, order))
    assert play.sim.run_until(lambda: play.sim.node("robot1").values()[TASK].tuning == wanted, 10)
    if is_cut_off:
        play.sim.heal()
    else:
        play.sim.start("robot3")
    assert play.sim.run_until(lambda: play.sim.node("robot3").fleet.tasks[0].tuning.bonus == 0.2, 20)
    play.sim.run_until(lambda: False, 10)
    assert bonuses(play) == {0.4}


def test_without_a_majority_nothing_changes_and_the_operator_is_told() -> None:
    play = Play()
    play.adopt()
    for name in ("robot2", "robot3"):
        play.sim.crash(name)
    result = play.told("robot1", ChangeFleet(remove_elector="robot3"))
    assert result.outcome is CommandOutcome.NO_QUORUM
    play.sim.start()
    play.settle(20)
    assert play.electors("edge1") == ROBOTS


@pytest.mark.parametrize("base_revision", [1, 99])
def test_a_command_on_another_revision_conflicts(base_revision: int) -> None:
    play = Play()
    play.adopt()
    result = play.told("robot1", ChangeFleet(remove_elector="robot3", base_revision=base_revision))
    assert result.outcome is CommandOutcome.CONFLICT


def test_an_elector_without_the_document_accepts_nothing_until_it_has_fetched_it() -> None:
    """Robot1 stores it first; the others have to fetch it before they accept (the judge looks at each disk)."""
    play = Play(seed=5)
    for machine in play.sim.machines.values():
        assert machine.disk.documents == []
    play.adopt()
    for machine in play.sim.machines.values():
        assert len(machine.disk.documents) == 1


# --- schedules -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("block", slices(3))
def test_no_schedule_of_changes_under_faults_breaks_what_must_hold(block: int) -> None:
    assert [found for seed in range(5 * block, 5 * block + 5) if (found := fleets.play(seed)[0])] == []


def test_the_command_plays_and_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert fleets.main(["--seeds", "1", "--first", "3"]) == 0
    assert "1 schedules, 0 violations" in capsys.readouterr().out


def test_a_schedule_finds_an_elector_that_answers_without_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Documents, "holds", lambda _self, _value: True)
    assert fleets.play(0)[0]
