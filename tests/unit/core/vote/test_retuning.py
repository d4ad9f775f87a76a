"""A changed fleet file and an operator's tuning of the same settings: which one counts, and who proposes it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest

from support.allocations import allocation_of
from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values.change import Retune
from zsched.core.values.fleet import Fleet, LinkLimits
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, Reach, ScoreForm, Tuning, Weights
from zsched.core.vote.retuning import AGAIN_S, RANK_S, Retuning

FILE = tuning_of(bonus=0.05)
CPU, MEMORY = Weights(cpu=1.0, memory=0.0, network=0.0), Weights(cpu=0.0, memory=1.0, network=0.0)


def take(retuning: Retuning, old: Fleet, new: Fleet, values: dict[str, Allocation], now: float) -> None:
    """Another file is in force."""
    retuning.in_force.take(new)
    retuning.want(old, values, now)


def wished(agreed: Tuning, before: dict[str, Any], after: dict[str, Any], *, me: str = "edge1") -> Tuning | None:
    """What a node wants agreed that takes over a file with another task; ``None``: nothing."""
    old, new = (fleet_of(task_of(**{"tuning": FILE, **options})) for options in (before, after))
    value = replace(allocation_of(5, "edge1"), tuning=agreed)
    retuning = Retuning(me, InForce(old))
    take(retuning, old, new, {"merge": value}, 0.0)
    due = list(retuning.due({"merge": value}, 100.0))
    assert all(retune.base_revision == 5 for _, retune in due)
    return due[0][1].tuning if due else None


def test_a_changed_setting_is_wanted_and_the_others_stay_as_they_were_tuned() -> None:
    agreed = replace(FILE, score=ScoreForm.SERVICE, price_s=0.7)
    assert wished(agreed, {}, {"tuning": replace(FILE, bonus=0.2)}) == replace(agreed, bonus=0.2)
    assert wished(agreed, {}, {"tuning": FILE}) is None


@pytest.mark.parametrize(
    ("tuned", "before", "after"),
    [
        ({"price_s": 0.7}, {"price_s": 0.3}, {"price_s": 0.4}),
        ({"reach": Reach.MAJORITY}, {}, {"reach": Reach.ALL}),
        ({"nu_dbm": -70.0}, {}, {"limits": LinkLimits(nu_dbm=-75.0)}),
        ({"rho_dbm": -30.0}, {}, {"limits": LinkLimits(rho_dbm=-45.0)}),
    ],
)
def test_a_file_that_changes_a_tuned_setting_of_its_own_ends_the_tuning_of_it_alone(
    tuned: dict[str, Any], before: dict[str, Any], after: dict[str, Any]
) -> None:
    agreed = replace(FILE, bonus=0.3, **tuned)
    wanted = wished(agreed, before, after)
    ended: dict[str, Any] = dict.fromkeys(tuned)
    assert wanted == replace(agreed, **ended)
    task = task_of(**{"tuning": FILE, **after})
    now = task.in_force(wanted)
    assert {key: getattr(now, key) for key in tuned} == {key: getattr(task.in_force(FILE), key) for key in tuned}


def test_a_file_that_changes_another_setting_leaves_the_tuned_one() -> None:
    agreed = replace(FILE, price_s=0.7)
    assert wished(agreed, {"price_s": 0.3}, {"price_s": 0.3, "reach": Reach.ALL}) is None
    spec = task_of(tuning=FILE, price_s=0.3, reach=Reach.ALL).under(agreed)
    assert (spec.price_s, spec.reach) == (0.7, Reach.ALL)


def test_a_tuning_that_comes_between_is_the_newer_word() -> None:
    old, new = fleet_of(task_of(tuning=FILE, price_s=0.3)), fleet_of(task_of(tuning=FILE, price_s=0.4))
    value = replace(allocation_of(5, "edge1"), tuning=replace(FILE, price_s=0.7))
    newer: Allocation = replace(value, revision=6, tuning=replace(FILE, price_s=0.9))
    retuning = Retuning("edge2", InForce(fleet_of(task_of(tuning=FILE))))
    take(retuning, old, new, {"merge": value}, 0.0)
    assert list(retuning.due({"merge": value}, 0.0)) == [], "the first in rank tries before this node"
    assert list(retuning.due({"merge": newer}, RANK_S)) == []
    assert retuning.is_idle


def test_a_second_changed_file_does_not_end_what_the_first_one_wants() -> None:
    """No quorum, or another node's turn: the second file differs from the first one only in what was changed last."""
    tunings = (FILE, replace(FILE, score=ScoreForm.SERVICE), replace(FILE, score=ScoreForm.SERVICE, bonus=0.2))
    first, second, third = (fleet_of(task_of(tuning=tuning)) for tuning in tunings)
    value = replace(allocation_of(5, "edge1"), tuning=FILE)
    retuning = Retuning("edge2", InForce(fleet_of(task_of(tuning=FILE))))
    take(retuning, first, second, {"merge": value}, 0.0)
    take(retuning, second, third, {"merge": value}, 0.1)
    assert [retune.tuning for _, retune in retuning.due({"merge": value}, 9.0)] == [tunings[2]]
    take(retuning, third, first, {"merge": value}, 10.0)
    assert list(retuning.due({"merge": value}, 99.0)) == [], "both are taken back"
    assert retuning.is_idle


def test_what_an_earlier_file_wanted_ends_with_a_tuning_that_came_between() -> None:
    tunings = (FILE, replace(FILE, weights=CPU), replace(FILE, weights=CPU, bonus=0.2))
    first, second, third = (fleet_of(task_of(tuning=tuning)) for tuning in tunings)
    value = replace(allocation_of(5, "edge1"), tuning=FILE)
    newer = replace(value, revision=6, tuning=replace(FILE, weights=MEMORY))
    retuning = Retuning("edge2", InForce(fleet_of(task_of(tuning=FILE))))
    take(retuning, first, second, {"merge": value}, 0.0)
    take(retuning, second, third, {"merge": newer}, 0.1)
    (due,) = retuning.due({"merge": newer}, 9.0)
    assert due[1].tuning == replace(newer.tuning, bonus=0.2)


def test_who_found_no_quorum_tries_again_and_ends_once_somebody_had_success() -> None:
    old, new = fleet_of(task_of(tuning=FILE, price_s=0.3)), fleet_of(task_of(tuning=FILE, price_s=0.4))
    value = replace(allocation_of(5, "edge1"), tuning=replace(FILE, price_s=0.7))
    retuning = Retuning("edge1", InForce(fleet_of(task_of(tuning=FILE))))
    take(retuning, old, new, {"merge": value}, 0.0)
    wanted = [("merge", Retune(base_revision=5, tuning=FILE))]
    assert list(retuning.due({"merge": value}, 0.0)) == wanted
    assert list(retuning.due({"merge": value}, AGAIN_S - 0.1)) == []
    assert list(retuning.due({"merge": value}, AGAIN_S)) == wanted
    done = replace(value, revision=6, tuning=FILE)
    assert list(retuning.due({"merge": done}, 2 * AGAIN_S)) == []
    assert retuning.is_idle


def test_a_second_file_wants_what_the_first_one_wanted_too() -> None:
    """Before the first wish is agreed the next file comes: neither change is lost, whichever is agreed first."""
    tunings = FILE, replace(FILE, bonus=0.2), replace(FILE, bonus=0.2, score=ScoreForm.SERVICE)
    files = [fleet_of(task_of(tuning=tuning)) for tuning in tunings]
    value = replace(allocation_of(5, "edge1"), tuning=FILE)
    retuning = Retuning("edge2", InForce(fleet_of(task_of(tuning=FILE))))
    for old, new in itertools.pairwise(files):
        take(retuning, old, new, {"merge": value}, 0.0)
    wanted = Retune(base_revision=5, tuning=tunings[2])
    assert list(retuning.due({"merge": value}, RANK_S)) == [("merge", wanted)]
    between = replace(value, revision=6, tuning=tunings[1])
    assert list(retuning.due({"merge": between}, RANK_S + AGAIN_S)) == [("merge", replace(wanted, base_revision=6))]
    assert list(retuning.due({"merge": replace(value, revision=7, tuning=tunings[2])}, RANK_S + AGAIN_S)) == []
    assert retuning.is_idle


def test_a_second_file_takes_back_what_the_first_one_wanted() -> None:
    """The first wish may be agreed behind the second file: until then all looks as it should."""
    files = [fleet_of(task_of(tuning=tuning)) for tuning in (FILE, replace(FILE, bonus=0.2), FILE)]
    value = replace(allocation_of(5, "edge1"), tuning=FILE)
    retuning = Retuning("edge1", InForce(fleet_of(task_of(tuning=FILE))))
    for old, new in itertools.pairwise(files):
        take(retuning, old, new, {"merge": value}, 0.0)
    assert list(retuning.due({"merge": value}, 0.1)) == []
    late = replace(value, revision=6, tuning=replace(FILE, bonus=0.2))
    assert list(retuning.due({"merge": late}, 0.2)) == [("merge", Retune(base_revision=6, tuning=FILE))]
    assert list(retuning.due({"merge": replace(value, revision=7)}, 0.3 + 2 * AGAIN_S)) == []
    assert retuning.is_idle


def test_a_revision_that_no_later_beat_confirms_silences_nobody() -> None:
    """A forged first beat told of a revision that never comes: nothing was proposed here for as long as it lived."""
    retuning = Retuning("edge1", InForce(fleet_of(task_of(tuning=FILE))))
    old, new = fleet_of(task_of(tuning=FILE)), fleet_of(task_of(tuning=replace(FILE, bonus=0.2)))
    values = {"merge": replace(allocation_of(5, "edge1"), tuning=FILE)}
    retuning.hear("edge2", 1 << 53, 4)
    take(retuning, old, new, values, 0.0)
    assert retuning.is_idle, "it may know better"
    retuning.hear("edge2", 5, 4)
    take(retuning, old, new, values, 0.0)
    assert retuning.is_idle, "it has one more"
    retuning.hear("edge2", 5, 5)
    take(retuning, old, new, values, 0.0)
    assert not retuning.is_idle


def test_who_has_left_the_fleet_is_not_waited_for() -> None:
    retuning = Retuning("edge1", InForce(fleet_of(task_of(tuning=FILE))))
    old, new = fleet_of(task_of(tuning=FILE)), fleet_of(task_of(tuning=replace(FILE, bonus=0.2)))
    values = {"merge": replace(allocation_of(5, "edge1"), tuning=FILE)}
    retuning.hear("stranger", 9, 4)
    take(retuning, old, new, values, 0.0)
    assert not retuning.is_idle
