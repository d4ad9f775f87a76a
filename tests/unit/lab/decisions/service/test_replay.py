"""Rules in the closed loop: the core's own scores decide, and the tables and the picture tell what came of it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from zsched.core.scheduler import scoring
from zsched.core.values.fleet import DEFAULT_BONUS, TaskSpec
from zsched.core.values.model import ScoreForm, Utility, UtilityVector, Weights
from zsched_lab.decisions import __main__ as package
from zsched_lab.decisions import entries
from zsched_lab.decisions.loads import Spikes
from zsched_lab.decisions.rules import CoreRule, PickRule
from zsched_lab.decisions.service import cast, command, picture, study, tables
from zsched_lab.decisions.service import replay as closed
from zsched_lab.decisions.service.history import MEASURED, History, build
from zsched_lab.decisions.service.replay import Player, Scene, TaskView, replay
from zsched_lab.decisions.view import START_S
from zsched_lab.decisions.world import DT_S, loaded_world
from zsched_lab.paper.schemes import PAPER_PERIOD_S, PAPER_SCHEMES, SCHEMES

HOURS = 0.03
ZSCHED = cast.players()[0]


def scene(history: History, seconds: float, owner: int | None, player: Player = ZSCHED) -> Scene:
    made = Scene(history, player)
    if owner is not None:
        for spec in made.fleet.tasks:
            made.place(spec.name, spec.candidates[owner])
    for index in range(round(seconds / DT_S)):
        made.step(index)
    return made


def test_profiles_show_the_machine_as_it_is_shared_by_then() -> None:
    calm = replace(MEASURED, cpu=0.0, memory=0.0)
    history = build(seed=3, hours=HOURS, load_s=0.0, scatter=calm)
    name = history.fleet.tasks[0].candidates[0]
    without, beside = (scene(history, 8.0, owner).gateway.fresh(name, START_S + 8.0) for owner in (None, 0))
    assert without is not None
    assert beside is not None
    assert without.cpu_used_cores is not None
    load = beside.worker("task1")
    assert load is not None
    assert load.cpu_cores == pytest.approx(history.on[0][1].cores[0, 0], rel=0.01)
    together = min(without.cpu_used_cores + history.works[0].demand(history.machines[0]), history.machines[0].cores)
    assert beside.cpu_used_cores == pytest.approx(together, rel=0.01)


def test_the_demand_that_is_learnt_is_that_of_each_machine_s_cores() -> None:
    history = next(
        one
        for one in (build(seed=seed, hours=HOURS, load_s=0.0) for seed in range(1, 60))
        if one.machines[0].speed < 0.7 and one.works[0].demand(one.machines[0]) < 0.4 * one.machines[0].cores
    )
    made = scene(history, 8.0, 0)
    made.learn(START_S + 8.0)
    spec = made.fleet.tasks[0]
    for name, machine in zip(spec.candidates, history.machines, strict=True):
        there = made.gateway.fresh(name, START_S + 8.0)
        assert there is not None
        need = max(history.works[0].demand(machine), spec.demand.cpu_cores)
        assert made.gateway.demand(spec, there).cpu_cores == pytest.approx(need, rel=0.02)


def test_a_view_is_what_the_core_scores_under_the_player_s_tuning() -> None:
    history = build(seed=3, hours=HOURS, load_s=15.0)
    seen = []
    for weights in (Weights(cpu=1.0, memory=0.0, network=0.0), Weights(cpu=0.0, memory=1.0, network=0.0)):
        made = scene(history, 8.0, None, cast.zsched("one", weights=weights))
        standing = TaskView(made, made.fleet.tasks[0]).standing(START_S + 8.0)
        (terms,) = {tuple((one.cpu, one.memory) for one in vector.utilities) for vector in standing.vectors}
        part = [cpu if weights.cpu else memory for cpu, memory in terms]
        assert list(standing.aggregates.values()) == pytest.approx(part)
        assert standing.voters_heard == 3
        seen.append(part)
    assert seen[0] != seen[1]


def test_another_score_in_the_core_is_another_rule_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The study has no score of its own: a core that prefers the last machine moves everything there."""
    history = build(seed=3, hours=0.01, load_s=0.0)
    last = history.fleet.tasks[0].candidates[-1]

    def score(*given: object, **more: object) -> UtilityVector:
        vector = scoring.score(*given, **more)  # type: ignore[arg-type]
        made = tuple(Utility(candidate=one.candidate, value=float(one.candidate == last)) for one in vector.utilities)
        return replace(vector, utilities=made)

    monkeypatch.setattr(closed, "score", score)
    (after,) = replay(history, ZSCHED, 1)
    assert [move.owner for move in after] == [last]


def test_the_paper_s_score_here_is_zsched_of_the_other_study() -> None:
    made = cast.zsched("paper", score=ScoreForm.PAPER).make(
        TaskView(scene(build(seed=3, hours=HOURS, load_s=0.0), 1.0, None), spec_of(3))
    )
    world = loaded_world(seed=1, hours=HOURS)
    other = entries.core(world)(made.view) if isinstance(made, CoreRule) else None
    assert isinstance(made, CoreRule)
    assert isinstance(other, CoreRule)
    assert (made.tuning, made.price_s, made.memory_s) == (other.tuning, other.price_s, other.memory_s)
    assert ZSCHED.look == entries.ours(world)[0].look


def test_the_service_rule_is_what_a_fleet_file_gets_that_says_nothing() -> None:
    assert ZSCHED.changes == {}
    assert ZSCHED.tuning.bonus == DEFAULT_BONUS
    made = ZSCHED.make(TaskView(scene(build(seed=3, hours=HOURS, load_s=0.0), 1.0, None), spec_of(3)))
    assert isinstance(made, CoreRule)
    plain = spec_of(3)
    assert {(judge.spec.price_s, judge.spec.memory_s) for judge in made._judges} == {(plain.price_s, plain.memory_s)}


@pytest.mark.parametrize("name", [*PAPER_SCHEMES, "dyna_net"])
def test_every_scheme_of_the_paper_takes_part_with_the_weights_that_it_has_on_real_daemons(name: str) -> None:
    player = {one.name: one for one in cast.players()}[name]
    weights = player.tuning.weights

    assert (weights.cpu, weights.memory, weights.network) == SCHEMES[name].weights
    assert (player.tuning.score, player.look, player.is_told) == (ScoreForm.PAPER, entries.RAW, True)
    made = player.make(TaskView(scene(build(seed=3, hours=HOURS, load_s=0.0), 1.0, None, player), spec_of(3)))
    assert isinstance(made, PickRule)
    assert (made.cost, made.period_s) == (entries.PAPER_COST, PAPER_PERIOD_S)
    assert name in picture.STYLES


def test_the_papers_schemes_are_three_rules() -> None:
    history = build(seed=100, hours=0.05, load_s=10.0)
    players = {one.name: one for one in cast.players()}
    moves = [[(move.at_s, move.owner) for move in replay(history, players[name], 100)[0]] for name in PAPER_SCHEMES]
    assert moves[0] != moves[1] != moves[2] != moves[0]


def spec_of(seed: int) -> TaskSpec:
    return build(seed=seed, hours=HOURS, load_s=0.0).fleet.tasks[0]


def test_a_rule_may_be_described() -> None:
    player = cast.described("hasty:smoothing_s=0.5,price_s=0.4,memory_s=50,score=paper")
    assert (player.name, player.look.smoothing_s) == ("hasty", 0.5)
    assert (player.tuning.score, player.changes) == (ScoreForm.PAPER, {"price_s": 0.4, "memory_s": 50.0})
    assert cast.described("new:score=service").tuning.score is ScoreForm.SERVICE
    made = player.make(TaskView(scene(build(seed=3, hours=HOURS, load_s=0.0), 1.0, None), spec_of(3)))
    assert isinstance(made, CoreRule)
    assert {(judge.spec.price_s, judge.spec.memory_s) for judge in made._judges} == {(0.4, 50.0)}
    for wrong in (
        "x:speed=3",
        "x:price_s",
        ":price_s=1",
        "x:bonus=7",
        "x:demand=1",
        "x:exclusive=maybe",
        "x:deadline=1",
    ):
        with pytest.raises(ValueError, match=r"."):
            cast.described(wrong)


@pytest.mark.parametrize(("word", "name"), [("missed", "deadline_s"), ("slow", "slow_s")])
def test_a_rule_with_a_deadline_scores_each_task_by_its_own(word: str, name: str) -> None:
    history = build(seed=9, hours=0.01, load_s=0.0, tasks=3)
    made = Scene(history, cast.described(f"late:deadline={word}"))
    wanted = [1e3 * getattr(work, name) for work in history.works]
    assert len(set(wanted)) == 3
    assert [spec.tuning.deadline_ms for spec in made.fleet.tasks] == wanted
    assert [value.tuning.deadline_ms for value in made.values.values()] == wanted
    plain = Scene(history, ZSCHED)
    assert {value.tuning.deadline_ms for value in plain.values.values()} == {None}


def test_what_has_just_come_to_a_machine_is_booked_there_before_it_shows() -> None:
    made = scene(build(seed=9, hours=0.01, load_s=0.0, tasks=3), 8.0, None)
    first, second = made.fleet.tasks[:2]
    view, machine = TaskView(made, second), first.candidates[0]
    before = view.standing(START_S + 8.0).aggregates
    made.place(first.name, machine)
    after = view.standing(START_S + 8.0).aggregates
    assert after[machine] < before[machine]
    assert {name for name in before if after[name] != before[name]} == {machine}


def test_several_tasks_are_placed_apart() -> None:
    history = build(seed=9, hours=0.01, load_s=60.0, tasks=3)
    moves = replay(history, ZSCHED, 1)
    assert len(moves) == 3
    assert all(mine[0].left is None for mine in moves), "everybody is placed"
    assert len({mine[0].owner for mine in moves}) > 1, "bookings keep them apart"
    assert moves == replay(history, ZSCHED, 1), "a seed fixes everything"


def test_seeds_for_choosing_and_for_checking_are_different() -> None:
    assert not set(study.TRAIN) & set(study.TEST)


def test_a_resumed_run_plays_what_is_missing_only() -> None:
    asked = ([5], HOURS, (0.0, 15.0), [1], (0.3,))
    rules = ("oracle", "dyna_both")
    known = [row for case in study.cases(*asked, rules, []) for row in study.play(case)]
    assert len(known) == 4
    assert study.cases(*asked, rules, known) == []
    (one, two) = study.cases(*asked, (*rules, "new:price_s=0.3"), known)
    assert one.rules == two.rules == ("new:price_s=0.3",)
    dearer = study.cases([5], HOURS, (15.0,), [1], (0.3, 1.0), rules, known)
    assert [(case.rules, case.prices_s) for case in dearer] == [(rules, (1.0,))], "no row comes twice"


def test_tables_and_picture_say_what_the_rows_say(tmp_path: Path) -> None:
    rules = (*study.YARDSTICKS, "dyna_both", "new:price_s=0.3")
    made = study.cases([105, 106], HOURS, (0.0, 15.0), [1], (0.3, 1.0), rules, [])
    rows = [row for case in made for row in study.play(case)]
    text = tables.report(rows)
    assert "## one task: 2 seeds (105 to 106), 0.1 h a rule" in text
    lost = [100 * row["lost"] for row in tables.where(rows, rule="dyna_both", price_s=1.0)]
    by_load = [sum(lost[index::2]) / 2 for index in (0, 1)]
    after = text[text.index("1 s a move: lost service") :]
    line = next(one for one in after.splitlines() if one.startswith("| dyna_both "))
    assert [cell.partition(" ±")[0].strip() for cell in line.split("|")[2:4]] == [f"{one:.2f}" for one in by_load]
    names = [one.split("|")[1].strip() for one in after.splitlines()[4:10]]
    assert names == ["oracle", "new", "dyna_both", "present", "fixed, best", "fixed, mean"]
    both = [tables.where(rows, rule=rule, price_s=1.0) for rule in ("dyna_both", "new")]
    more = [sum(row["lost"] for row in mine) / 4 for mine in both]
    assert tables.beside(*both).startswith(f"{100 * (more[0] - more[1]):+.2f} ± ")
    same = [{"seed": seed, "lost": 0.1 * seed, "load_s": load_s} for seed in (1, 3) for load_s in (5.0, 60.0)]
    assert tables.percent(same, "lost") == "20.00 ± 19.60", "two seeds, however many loads each"
    picture.draw(rows, tmp_path / "service.png")
    assert (tmp_path / "service.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_keeps_seeds_and_results_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["--seeds", "90-110"], ["--tasks", "2"], ["--rule", "x:speed=3"]):
        with pytest.raises(SystemExit) as ended:
            command.parse(wrong)
        assert ended.value.code == 2
    assert "there are 1, 3" in capsys.readouterr().err
    assert command.parse(["--seeds", "train"]).seeds[0] in study.TRAIN
    quick = ["--out", str(tmp_path), "--loads", "0", "--tasks", "1", "--prices", "0.3", "--hours", "0.01"]
    quick += ["--rule", "new:price_s=0.3", "--only", "new;fixed, mean"]
    command.main([*quick, "--seeds", "107"])
    assert "| new |" in capsys.readouterr().out
    assert (tmp_path / "service-test.png").exists()
    with pytest.raises(SystemExit, match="--resume"):
        command.main([*quick, "--seeds", "107"])
    other = [one.replace("0.3", "0.2") if one.startswith("new:") else one for one in quick]
    with pytest.raises(SystemExit, match="another name"):
        command.main([*other, "--seeds", "107", "--resume"])


def test_the_package_s_command_knows_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", ["decisions", "service", "--hours", "0", "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="holds no results"):
        package.main()


def moved(seed: int, rule: str, tasks: int = 1, *, hours: float) -> tuple[History, int]:
    history = build(seed=seed, hours=hours, load_s=0.0, tasks=tasks, is_equal=True)
    return history, sum(len(mine) - 1 for mine in replay(history, cast.described(rule), seed))


@pytest.mark.parametrize("seed", [1, 2, 5, 7, 9, 13])
def test_a_task_that_fits_stays_on_one_of_several_equal_machines(seed: int) -> None:
    """An hour and more over all seeds."""
    history, moves = moved(seed, "service", hours=0.2)
    assert len(set(history.machines)) == 1
    assert len(history.machines) == 3
    assert history.service().min() == 1.0, "it fits"
    assert history.cpu_error.std() > 0.05, "the readings scatter"
    assert moves == 0


def test_without_what_holds_a_task_noise_moves_it_between_equal_machines() -> None:
    _, moves = moved(1, "loose:bonus=0,price_s=0", hours=0.03)
    assert moves > 5


def test_three_tasks_stay_on_equal_machines() -> None:
    assert moved(1, "service", tasks=3, hours=0.05)[1] == 0


def row(rule: str, seed: int, **more: float) -> study.Row:
    given = {"lost": 0.03, "missed": 0.04, "outputs_hz": 1.0, "slow": 0.0, "moves": 4, "wasted": 1, "felt": 0}
    common = {"tasks": 1, "load_s": 5.0, "price_s": 0.3, "hours": 0.5, "size": 0.4, "reactions_s": []}
    return {**common, **given, "rule": rule, "as": rule, "seed": seed, **more}


def cells(text: str, first: str) -> list[str]:
    return [cell.strip() for cell in next(one for one in text.splitlines() if one.startswith(first)).split("|")[1:-1]]


def test_a_reading_has_the_spikes_of_its_machine_s_use() -> None:
    kinds = (
        Spikes(below=0.5, every_s=2.0, height=(0.3, 0.5), length_s=(0.2, 0.4)),
        Spikes(below=0.9, every_s=1.0, height=(0.2, 0.2), length_s=(0.2, 0.2)),
    )
    plain, spiky = (build(seed=3, hours=HOURS, load_s=0.0, spikes=one) for one in ((), kinds))
    assert np.array_equal(plain.cpu_error, spiky.cpu_error), "all else is the same"
    one, other = scene(plain, 1.0, None), scene(spiky, 1.0, None)
    step = int(np.flatnonzero(spiky.spikes[0][1][:, 0])[0])
    read = [made._device(0, step) for made in (one, other)]
    more = spiky.spikes[0][1][step, 0] * spiky.machines[0].cores
    assert read[1].cpu_used_cores - read[0].cpu_used_cores == pytest.approx(more)  # type: ignore[operator]
    assert other._spike(0.95, step, 0) == 0.0, "a loaded machine has none"
