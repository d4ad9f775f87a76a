from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import profile_of
from zsched.commands.base.common import SCHEMAS
from zsched.core.values import gauges
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.errors import WireError
from zsched.core.values.fleet import Demand, fleet_hash
from zsched.core.values.gauges import BY_NAME, GAUGES
from zsched.core.values.model import Tuning, Weights
from zsched.core.values.profile import Profile

READERS = Path(gauges.__file__).parents[2] / "host" / "machine" / "gauges"


def test_the_worked_examples_in_the_docstrings_hold() -> None:
    result = doctest.testmod(gauges)
    assert result.attempted > 0
    assert result.failed == 0


def test_a_gauge_is_one_row_and_one_file() -> None:
    """And the one schema that cannot take any name names them all."""
    files = {file.stem for file in READERS.glob("*.py")} - {"__init__"}
    assert files == set(BY_NAME)
    for name in BY_NAME:
        assert importlib.import_module(f"zsched.host.machine.gauges.{name}").Reader
    assert f"^({'|'.join(BY_NAME)})$" in (SCHEMAS / "zsched.tuning.1.json").read_text()


@pytest.mark.parametrize("gauge", GAUGES, ids=lambda gauge: gauge.name)
def test_worth_falls_from_the_best_reading_to_the_worst(gauge: gauges.Gauge) -> None:
    assert gauge.term(gauge.best) == 1.0
    assert gauge.term(gauge.worst) == 0.0
    assert gauge.term((gauge.best + gauge.worst) / 2) == pytest.approx(0.5)
    assert gauge.term(gauge.low) in (0.0, 1.0)
    assert gauge.term(gauge.high) in (0.0, 1.0)


@pytest.mark.parametrize(
    ("name", "limit", "out", "at", "inside"),
    [("battery", 0.2, 0.19, 0.2, 0.25), ("temperature_c", 85.0, 85.1, 85.0, 80.0), ("gpu", 0.9, 0.91, 0.9, 0.8)],
)
def test_an_owner_is_left_beyond_the_limit_and_others_wait_for_the_margin(
    name: str, limit: float, out: float, at: float, inside: float
) -> None:
    gauge = BY_NAME[name]
    assert gauge.fault(out, limit, has_margin=False)
    assert gauge.fault(at, limit, has_margin=False) == ""
    assert "back from" in gauge.fault(at, limit, has_margin=True)
    assert gauge.fault(inside, limit, has_margin=True) == ""


@pytest.mark.parametrize(("name", "limit"), [("gpu", 1.0), ("battery", 0.0)])
def test_a_limit_that_no_reading_is_beyond_only_asks_for_the_gauge(name: str, limit: float) -> None:
    """Nor is it missed by the margin, or by what a task would add: three GPUs at 95 % are three candidates."""
    gauge = BY_NAME[name]
    for reading in (limit, limit + 0.03 * (1 if gauge.is_floor else -1)):
        assert gauge.fault(reading, limit, has_margin=True) == gauge.fault(reading, limit, has_margin=False) == ""
    assert BY_NAME["gpu"].fault(1.3, 1.0, has_margin=True, is_reckoned=True) == ""
    assert BY_NAME["gpu"].fault(None, 1.0, has_margin=True) == "gpu is not measured"


def test_only_a_machine_without_a_gpu_is_refused_for_what_is_not_measured() -> None:
    told = {gauge.name: gauge.fault(None, gauge.best, has_margin=True) for gauge in GAUGES}
    assert told == {"gpu": "gpu is not measured", "battery": "", "temperature_c": ""}


def test_weights_hold_gauges_and_their_sum_counts_all() -> None:
    weights = Weights.of({"cpu": 0.5, "gpu": 0.3, "battery": 0.2})
    assert weights.shares == (("cpu", 0.5), ("memory", 0.0), ("network", 0.0), ("battery", 0.2), ("gpu", 0.3))
    with pytest.raises(ValueError, match=r"the sum is 0\.8"):
        Weights.of({"cpu": 0.5, "gpu": 0.3})
    with pytest.raises(ValueError, match=r"weights\.gpu"):
        Weights.of({"cpu": 1.0, "battery": 0.5, "gpu": -0.5})


def test_limits_of_unknown_gauges_and_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="no gauge 'wind'"):
        task_of(gauge_limits=(("wind", 3.0),))
    with pytest.raises(ValueError, match=r"limits\.battery"):
        task_of(gauge_limits=(("battery", 20.0),))


# --- old and new programs together -----------------------------------------------------------------------------------


def test_a_profile_of_an_older_program_measures_no_gauge_and_a_newer_ones_is_read() -> None:
    body = as_plain(profile_of(gauges=(("battery", 0.5),)))
    newer = from_plain({**body, "gauges": [["battery", 0.5], ["wind", 4.0]]}, Profile)
    assert newer.gauges == (("battery", 0.5), ("wind", 4.0))
    assert gauges.possible(newer.gauges) == (("battery", 0.5),)
    del body["gauges"]
    assert from_plain(body, Profile).gauges == ()


def test_without_gauges_no_frame_and_no_hash_differs_from_an_older_programs() -> None:
    assert "gauges" not in as_plain(tuning_of())["weights"]
    assert "gauges" not in as_plain(profile_of())
    plain = fleet_of(task_of())
    assert fleet_hash(plain) == "988caaa855473d84"
    for other in (
        task_of(gauge_limits=(("battery", 0.2),)),
        task_of(demand=Demand(gpu=0.5)),
        task_of(tuning=Tuning(weights=Weights.of({"cpu": 0.5, "memory": 0.4, "gpu": 0.1}))),
    ):
        assert fleet_hash(fleet_of(other)) != fleet_hash(plain)


def test_an_older_program_drops_weights_with_gauges_instead_of_agreeing_others() -> None:
    body = as_plain(Weights.of({"cpu": 0.7, "gpu": 0.3}))
    del body["gauges"]  # as it reads them
    with pytest.raises(WireError, match="the sum is"):
        from_plain(body, Weights)


@pytest.mark.parametrize("bad", [[["battery", float("nan")]], [["Battery!", 0.5]], [["battery"]], [["a", 1.0]] * 17])
def test_hostile_readings_are_refused(bad: object) -> None:
    with pytest.raises(WireError):
        from_plain({**as_plain(profile_of()), "gauges": bad}, Profile)


@pytest.mark.parametrize("name", [gauge.name for gauge in GAUGES])
def test_no_limit_keeps_out_the_best_machine_there_can_be(name: str) -> None:
    """A battery of 0.97 wanted 1.02 of others."""
    gauge = BY_NAME[name]
    steps = (gauge.low + (gauge.high - gauge.low) * step / 100 for step in range(101))
    best = gauge.high if gauge.is_floor else gauge.low
    assert {gauge.fault(best, limit, has_margin=True) for limit in steps} == {""}
