"""Records whose offices are pooled: what is held against what, and that the page has what its records say."""

from __future__ import annotations

import doctest
import re
from pathlib import Path
from typing import Any

import pytest

from zsched_lab.paper import pooled as module
from zsched_lab.paper.pooled import HINDSIGHT, PLACES, against, best_places, likeness, main, pooled
from zsched_lab.paper.schemes import FIXED_SCHEMES

EVALUATION = Path(__file__).parents[4] / "docs" / "evaluation"
HEAVY = [str(EVALUATION / f"heavy-{name}.json") for name in ("again", "oracle", "all", "calm")]


def a_run(scheme: str, seed: int, maps: float, **more: Any) -> dict[str, Any]:
    figures = {"scheme": scheme, "run": 0, "seed": seed, "level": "four", "block": "heavy"}
    return {**figures, "map_hz": maps, "throughput_mb_s": 2.0 * maps, "task_latency_s": 40.0 - maps, **more}


def a_record(seed: int, **maps: float) -> dict[str, Any]:
    runs = [a_run(scheme, seed, value) for scheme, value in maps.items()]
    return {"scenario": {"main": "heavy", "level": "four", "blocks": {"heavy": {}, "other": {}}}, "runs": runs}


def records() -> list[dict[str, Any]]:
    one = a_record(7, fixed_e1=1.0, fixed_e2=2.0, fixed_e3=3.0, dyna_both=4.0, zsched=4.0)
    return [one, a_record(8, fixed_e1=3.0, fixed_e2=2.0, fixed_e3=1.0, dyna_both=4.0, zsched=5.0)]


def test_an_office_is_known_by_its_seed_and_a_block_by_its_name() -> None:
    other = a_record(9, zsched=1.0)
    other["runs"].append({**a_run("zsched", 9, 2.0), "block": "other"})
    assert [one["run"] for one in pooled(records())] == [7] * 5 + [8] * 5
    assert [one["map_hz"] for one in pooled([other])] == [1.0]
    assert [one["map_hz"] for one in pooled([other], "other")] == [2.0]
    assert [one["map_hz"] for one in pooled([other], "unknown")] == [1.0], "its main block"


def test_the_best_place_of_each_office_is_known_afterwards() -> None:
    runs = pooled(records())
    assert best_places(runs, "map_hz") == {7: 3.0, 8: 3.0}
    assert best_places(runs, "task_latency_s") == {7: 37.0, 8: 37.0}, "less is better"
    assert best_places([one for one in runs if one["scheme"] != "fixed_e1"], "map_hz") == {}


def test_a_scheme_is_held_against_places_and_each_scheme_that_moves() -> None:
    found = against(pooled(records()), "zsched")
    maps = {name: (one["map_hz"].mine, one["map_hz"].theirs, one["map_hz"].runs) for name, one in found.items()}
    mean, large = PLACES
    assert maps == {mean: (4.5, 2.0, 2), large: (4.5, 2.0, 2), HINDSIGHT: (4.5, 3.0, 2), "dyna_both": (4.5, 4.0, 2)}
    assert PLACES[large] == FIXED_SCHEMES[1:]
    assert likeness(pooled(records())) == pytest.approx(1.0)
    assert doctest.testmod(module).failed == 0


def test_one_office_of_two_records_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([HEAVY[0], HEAVY[0]])
    assert "have the same office" in capsys.readouterr().err


def test_the_page_has_what_its_records_say(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The intervals beside `dyna_both`, and those of maps over a fixed place."""
    assert main([*HEAVY, "--png", str(tmp_path / "gains.png")]) == 0
    assert (tmp_path / "gains.png").stat().st_size > 10_000
    out = capsys.readouterr().out
    page = (EVALUATION / "README.md").read_text(encoding="utf-8")
    parts = dict(part.split("\n", 1) for part in out.replace("zsched against ", "\0").split("\0")[1:])
    for name in ("maps/s", "MB/s", "task s", "covered on the way"):
        (told,) = re.findall(rf"^  {name} .*?([-+][\d.]+)% \[(\S+), (\S+)\]", parts["dyna_both"], re.MULTILINE)
        assert "{} % [{}, {}]".format(*told) in page, name
    for name, within in (("maps/s", "for maps"), ("MB/s", "for throughput"), ("covered on the way", "for coverage")):
        (margin,) = re.findall(rf"^  {name} .*within ([\d.]+)%$", parts["dyna_both"], re.MULTILINE)
        assert f"{margin} % {within}" in page
    for name in (*PLACES, HINDSIGHT):
        (mean, low, high) = re.findall(r"^  maps/s .*?([-+][\d.]+)% \[(\S+), (\S+)\]", parts[name], re.MULTILINE)[0]
        assert "{:+.0f} % [{:+.0f}, {:+.0f}]".format(*map(float, (mean, low, high))) in page.replace("**", ""), name
    (alike,) = re.findall(r"of 132 runs: r = ([\d.]+)$", out, re.MULTILINE)
    assert f"*r* = {alike}" in page
