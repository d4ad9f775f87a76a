from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import EndOfFile

from zsched_lab.fleet.children import ChildError
from zsched_lab.paper.bench import BenchOptions, InputsOf, claim_folder, command_of, plan_body, planned, run_bench
from zsched_lab.paper.cells import Cell, bandwidth_of, cells_of, merge_of, world_of
from zsched_lab.paper.matrix import (
    ATTEMPTS,
    DEFINITIONS,
    GIVE_UP,
    METRICS,
    Matrix,
    collect,
    invalid_reason,
    undone,
)
from zsched_lab.paper.places import robots_scenario_path, scenario_path
from zsched_lab.paper.plan import AROUND_S, leave_out, plan_text, without
from zsched_lab.paper.scenario import MATRIX, LinkLimits, MergeTask, Scenario, Sweep, load_scenario
from zsched_lab.paper.schemes import SCHEMES


@pytest.fixture
def scenario() -> Scenario:
    return load_scenario(scenario_path())


def options(out: Path, **given: Any) -> BenchOptions:
    return BenchOptions(out=out, scenario=scenario_path(), robots_scenario=robots_scenario_path(), **given)


def test_the_matrix_is_every_scheme_by_run_then_the_sweep(scenario: Scenario) -> None:
    cells = cells_of(scenario, ())
    main = [cell for cell in cells if cell.level == scenario.level and cell.block == MATRIX]

    assert len({cell.name for cell in cells}) == len(cells)
    assert {cell.scheme.name for cell in main} == {name for name, one in SCHEMES.items() if not one.moves_slam}
    assert sum(cell.scheme.name == "zsched" for cell in main) == 5
    assert sum(cell.scheme.name == "oracle" for cell in main) == 3
    assert [cell.run for cell in main] == sorted(cell.run for cell in main)
    assert cells[: len(main)] == tuple(main)
    assert {cell.level for cell in cells} == set(scenario.levels)
    swept = len(scenario.sweep.schemes) * scenario.sweep.runs * (len(scenario.levels) - 1)
    extra = sum(len(block.schemes) * block.runs for block in scenario.blocks.values())
    assert len(cells) == len(main) + swept + extra


def test_fewer_runs_and_schemes_by_option(scenario: Scenario) -> None:
    cells = cells_of(scenario, ("zsched", "random"), runs=1)

    assert {cell.scheme.name for cell in cells if cell.name.startswith("one-")} == {"zsched", "random"}
    assert {cell.scheme.name for cell in cells if not cell.name.startswith("one-")} == {"zsched"}
    assert {cell.run for cell in cells} == {0}


def test_each_run_has_a_world_of_its_own_the_same_for_every_scheme_and_level(scenario: Scenario) -> None:
    cells = cells_of(scenario, ())
    by_run: dict[int, set[str]] = {}
    for cell in cells:
        if cell.block != "turtlebot3" and not cell.block.startswith("heavy"):
            by_run.setdefault(cell.run, set()).add(world_of(scenario, cell))

    assert by_run == {run: {f"office:{scenario.seed + run}"} for run in range(scenario.runs)}
    assert {world_of(scenario, cell) for cell in cells if cell.block == "turtlebot3"} == {"turtlebot3"}
    assert all(
        world_of(scenario, c) == f"office:{scenario.seed + c.run}:14" for c in cells if c.block.startswith("heavy")
    )
    rates = {cell.block: bandwidth_of(scenario, cell) for cell in cells}
    assert {block: rate for block, rate in rates.items() if rate is not None} == {"narrow": 9.8}


def test_a_block_may_have_another_task_and_level(scenario: Scenario) -> None:
    cells = {cell.block: cell for cell in cells_of(scenario, ())}
    assert (cells["fine"].level, cells["fine_four"].level, cells["narrow"].level) == ("one", "four", "one")
    assert merge_of(scenario, cells["fine_four"]) == MergeTask(mode="known", rate_hz=20, resolution_m=0.02)
    assert merge_of(scenario, cells["narrow"]) == merge_of(scenario, cells[MATRIX]) == scenario.merge
    heavy = MergeTask(mode="track", rate_hz=20, resolution_m=0.02, min_agreeing=150)
    levels = {name: cells[name].level for name in scenario.blocks if name.startswith("heavy")}
    assert levels == {"heavy": "four", "heavy_three": "three", "heavy_two": "two", "heavy_one": "one"}
    assert {merge_of(scenario, cells[name]) for name in levels} == {heavy}
    assert "at most 20 maps/s of 2 cm cells" in plan_text(scenario, [cells["fine"]], [], 0.0, {}, None)
    assert "2 cm cells, joined at 150 wall cells" in plan_text(scenario, [cells["heavy"]], [], 0.0, {}, None)


def test_a_block_that_cannot_be_run_here_is_left_out_with_its_reason(scenario: Scenario) -> None:
    asked: list[str] = []

    def why_not() -> str:
        asked.append("x")
        return "not root"

    skipped = without(scenario, is_exploring=True, why_not=why_not)
    kept = leave_out(scenario, skipped)

    assert list(skipped) == ["narrow"]
    assert "not root" in skipped["narrow"]
    assert {cell.block for cell in cells_of(kept, ())} == {MATRIX, *scenario.blocks} - {"narrow"}
    assert without(scenario, is_exploring=False, why_not=lambda: None).keys() == {
        "turtlebot3",
        *(name for name in scenario.blocks if name.startswith("heavy")),
    }
    blocks = {name: replace(block, links=LinkLimits()) for name, block in scenario.blocks.items()}
    assert without(replace(scenario, blocks=blocks), is_exploring=True, why_not=why_not) == {}
    assert len(asked) == 1  # namespaces are tried only for who wants them


def test_a_plan_starts_nothing_and_makes_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_bench(options(tmp_path / "out", is_exploring=True, is_plan=True)) == 0
    assert not (tmp_path / "out").exists()
    assert "matrix (one)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("host", "is_valid"),
    [
        ({"pressure": 0.1, "idle_ratio": 0.0}, True),
        ({"pressure": 0.2, "idle_ratio": 0.0}, True),
        ({"pressure": 0.21, "idle_ratio": 0.9}, False),
        ({"pressure": None, "idle_ratio": 0.01}, False),
        ({"pressure": None, "idle_ratio": 0.5}, True),
    ],
)
def test_a_run_on_a_host_short_of_cpu_does_not_count(
    scenario: Scenario, host: dict[str, float | None], is_valid: bool
) -> None:
    assert (invalid_reason(replace(scenario, pressure_limit=0.2), host) is None) == is_valid


class Outcomes:
    """What became of each attempt, in order: the pressure that the host was under, or how it failed."""

    def __init__(self, *outcomes: float | BaseException) -> None:
        self.outcomes = list(outcomes)
        self.made: list[str] = []

    def make(self, cell: Cell, folder: Path) -> dict[str, Any]:
        self.made.append(cell.name)
        (folder / "half").write_text("")
        outcome = self.outcomes.pop(0)
        if isinstance(outcome, BaseException):
            raise outcome
        return {"host": {"pressure": outcome, "idle_ratio": 0.5}}


def plainly(_cell: Cell, folder: Path) -> tuple[dict[str, Any], str]:
    return {"folder": folder.name}, "fine"


def play(
    scenario: Scenario,
    out: Path,
    runs: Outcomes,
    *names: str,
    measure: Callable[[Cell, Path], tuple[dict[str, Any], str]] = plainly,
) -> list[str]:
    said: list[str] = []
    scenario = replace(scenario, pressure_limit=0.2, sweep=Sweep(), blocks={})
    cells = cells_of(scenario, names, runs=1)
    Matrix(scenario, runs.make, measure, out, said.append).run(cells)
    valid, invalid = collect(out, cells)
    return [*said, f"{len(valid)} valid, {len(invalid)} invalid"]


def test_an_invalid_run_is_repeated_and_kept_aside(scenario: Scenario, tmp_path: Path) -> None:
    runs = Outcomes(0.9, ChildError("edge1 ended"), 0.1, 0.1)
    said = play(scenario, tmp_path, runs, "zsched", "random")

    assert runs.made == ["one-zsched-1"] * 3 + ["one-random-1"]
    assert said[-1] == "2 valid, 2 invalid"
    assert any("pressure 0.90" in line for line in said)
    assert (tmp_path / "runs" / "one-zsched-1.invalid-2" / "half").exists()


@pytest.mark.parametrize("error", [EndOfFile(), ValueError("no footer"), OSError("short read")])
def test_a_run_whose_records_are_damaged_is_made_again(scenario: Scenario, tmp_path: Path, error: Exception) -> None:
    """Its recorder was killed, say; the whole bench ended with a traceback."""
    measured: list[str] = []

    def measure(cell: Cell, folder: Path) -> tuple[dict[str, Any], str]:
        measured.append(cell.name)
        if len(measured) == 1:
            raise error
        return plainly(cell, folder)

    runs = Outcomes(0.1, 0.1, 0.1)
    said = play(scenario, tmp_path, runs, "zsched", "random", measure=measure)
    assert runs.made == ["one-zsched-1"] * 2 + ["one-random-1"]
    assert said[-1] == "2 valid, 1 invalid"
    assert any("cannot be measured" in line for line in said)


def test_what_stays_invalid_does_not_stop_the_rest(scenario: Scenario, tmp_path: Path) -> None:
    said = play(scenario, tmp_path, Outcomes(0.9, 0.9, 0.9, 0.1), "zsched", "random")

    assert said[-1] == "1 valid, 3 invalid"


def test_a_machine_that_never_gives_a_valid_run_ends_the_bench(scenario: Scenario, tmp_path: Path) -> None:
    runs = Outcomes(*[0.9] * 99)

    with pytest.raises(ChildError, match="in a row"):
        play(scenario, tmp_path, runs, "zsched", "random", "argmax", "oracle")

    assert len(runs.made) == GIVE_UP * ATTEMPTS


def test_an_interrupted_matrix_goes_on_behind_what_is_done(scenario: Scenario, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        play(scenario, tmp_path, Outcomes(0.1, KeyboardInterrupt()), "zsched", "random")
    assert (tmp_path / "runs" / "one-zsched-1" / METRICS).exists()

    runs = Outcomes(0.1)
    said = play(scenario, tmp_path, runs, "zsched", "random")

    assert runs.made == ["one-random-1"]
    assert said[0] == "1 of 2 runs are done already"
    assert (tmp_path / "runs" / "one-random-1.interrupted-1").exists()


def test_figures_by_older_definitions_are_made_again_without_a_run(scenario: Scenario, tmp_path: Path) -> None:
    play(scenario, tmp_path, Outcomes(0.1, 0.1), "zsched", "random")
    path = tmp_path / "runs" / "one-zsched-1" / METRICS
    path.write_text(json.dumps({"folder": "older", "definitions": DEFINITIONS - 1}))

    runs = Outcomes()
    said = play(scenario, tmp_path, runs, "zsched", "random")

    assert runs.made == []
    assert json.loads(path.read_text()) == {"folder": "one-zsched-1", "definitions": DEFINITIONS}
    assert [line for line in said if "definitions" in line] == [
        "[1/1] one-zsched-1: figures by the present definitions"
    ]


# --- the bench's own ------------------------------------------------------------------------------------------------


def test_quick_is_the_fixed_schemes_one_of_the_paper_and_ours(tmp_path: Path) -> None:
    scenario, cells, _ = planned(options(tmp_path, is_quick=True))

    assert [cell.scheme.name for cell in cells] == ["fixed_e1", "fixed_e2", "fixed_e3", "dyna_both", "zsched"]
    assert (scenario.duration_s + AROUND_S) * len(cells) < 6 * 60


def test_exploring_robots_have_their_own_target_and_time(tmp_path: Path, scenario: Scenario) -> None:
    explored, _, _ = planned(options(tmp_path, is_exploring=True))
    quick, cells, _ = planned(options(tmp_path, is_exploring=True, is_quick=True, duration_s=30.0))

    loop = scenario.explore
    assert (explored.duration_s, explored.target_coverage) == (loop.duration_s, loop.target_coverage)
    assert (quick.duration_s, len(cells)) == (30.0, 5)
    assert loop.duration_s + AROUND_S <= 60
    assert sorted(loop.slam_on.values()) == sorted(scenario.nodes)


def test_a_folder_goes_on_only_with_the_same_bench(tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = options(out, is_quick=True)
    scenario, cells, _ = planned(given)
    inputs = InputsOf(given, scenario)
    body = plan_body(scenario, inputs, cells)

    assert claim_folder(given, body) is None
    assert json.loads((out / "plan.json").read_text()) == body
    assert "not empty" in (claim_folder(given, body) or "")
    resumed = replace(given, is_resumed=True)
    assert claim_folder(resumed, body) is None
    other = plan_body(replace(scenario, seed=1), inputs, cells)
    assert "another scenario" in (claim_folder(resumed, other) or "")
    (out / "plan.json").unlink()
    (out / "x").write_text("")
    assert "none of" in (claim_folder(resumed, body) or "")


def test_a_bench_goes_on_behind_a_results_json_alone(tmp_path: Path) -> None:
    first, later = tmp_path / "first", tmp_path / "later"
    given = options(first, is_exploring=True, schemes=("zsched",), drives=tmp_path / "drives")
    scenario, cells, _ = planned(given)
    body = plan_body(scenario, InputsOf(given, scenario), cells)
    claim_folder(given, body)
    done = {"scheme": "zsched", "run": 0, "level": scenario.level, "block": MATRIX, "map_hz": 3.5, "nodes": {}}
    done |= {"host": {"pressure": 0.05, "idle_ratio": None}, "links": "recorded", "definitions": DEFINITIONS}
    failed = {"cell": cells[1].name, "attempt": 1, "reason": "pressure"}
    for name, file, told in ((cells[0].name, METRICS, done), (f"{cells[1].name}.invalid-1", "invalid.json", failed)):
        (first / "runs" / name).mkdir(parents=True)
        (first / "runs" / name / file).write_text(json.dumps(told))
    assert run_bench(replace(given, is_report=True)) == 0
    told = json.loads((first / "results.json").read_text())
    later.mkdir()
    resumed = replace(given, out=later, is_resumed=True)

    for damaged, word in (
        ({**told, "drives": None}, "another scenario"),
        ({**told, "runs": [{**done, "definitions": DEFINITIONS - 1}]}, f"{cells[0].name} has figures by older"),
        ({**told, "runs": [{}]}, "is no results.json"),
        ([], "is no results.json"),
    ):
        (later / "results.json").write_text(json.dumps(damaged))
        assert word in (claim_folder(resumed, body) or "")
        assert [path.name for path in later.iterdir()] == ["results.json"]

    (later / "results.json").write_text(json.dumps(told))
    assert claim_folder(resumed, body) is None
    assert undone(later, cells) == list(cells[1:])
    assert collect(later, cells) == ([done], [failed])
    assert claim_folder(resumed, body) is None


def test_a_report_of_what_is_done_so_far_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    given = options(out, is_exploring=True, schemes=("zsched",))
    scenario, cells, _ = planned(given)
    assert run_bench(replace(given, is_report=True)) == 2
    assert "neither runs of" in capsys.readouterr().err
    assert not out.exists()

    claim_folder(given, plan_body(scenario, InputsOf(given, scenario), cells))
    (out / "runs" / cells[0].name).mkdir(parents=True)
    host = {"pressure": 0.05, "idle_ratio": None}
    done = {
        "scheme": "zsched",
        "run": 0,
        "level": "one",
        "host": host,
        "links": "simulated",
        "nodes": {},
        "map_hz": 3.5,
    }
    (out / "runs" / cells[0].name / "metrics.json").write_text(json.dumps(done))
    before = sorted(path.name for path in (out / "runs").iterdir())

    assert run_bench(replace(given, is_report=True)) == 0

    assert sorted(path.name for path in (out / "runs").iterdir()) == before
    text = (out / "report.md").read_text()
    assert f"No valid run of {len(cells) - 1} cells" in text
    assert "1 runs that count" in text


def test_the_command_in_the_report_names_no_place_of_this_machine(tmp_path: Path) -> None:
    given = options(
        tmp_path, runs=2, schemes=("a", "b"), log=tmp_path / "x.log", drives=tmp_path / "drives", duration_s=30.0
    )

    assert (
        command_of(given)
        == "zsched bench paper --input log --runs 2 --schemes a,b --duration 30 --log x.log --drives drives"
    )
    assert str(tmp_path) not in command_of(given)
