"""The simulated radio: path loss, shadowing that keeps for metres, fading; recorded drives."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from zsched.core.scheduler.standing import Standing
from zsched.core.values.fleet import LinkLimits
from zsched.core.values.model import Allocation
from zsched_lab.decisions import drives, radio
from zsched_lab.decisions.rules import CoreRule
from zsched_lab.decisions.view import START_S, Feed, Look, LostFor, View
from zsched_lab.decisions.world import DT_S, drives_world


def test_path_loss_falls_by_28_db_for_every_ten_times_the_distance() -> None:
    near, far = radio.path_loss_dbm(np.asarray([2.0, 20.0]))
    assert near - far == pytest.approx(28.0)
    assert radio.path_loss_dbm(np.asarray([0.01])) == pytest.approx(radio.AT_1_M_DBM)


def test_shadowing_has_gudmundsons_correlation_over_distance() -> None:
    rng = np.random.default_rng(1)
    moved = np.full(60_000, 0.5)
    values = radio.shadowing(moved, rng)
    assert values.std() == pytest.approx(radio.SHADOWING_DB, rel=0.1)
    for metres in (2.5, 5.0):
        steps = round(metres / 0.5)
        correlation = float(np.corrcoef(values[:-steps], values[steps:])[0, 1])
        assert correlation == pytest.approx(np.exp(-metres / radio.DECORRELATION_M), abs=0.06)


def test_a_robot_that_stands_still_keeps_its_shadow() -> None:
    values = radio.shadowing(np.zeros(100), np.random.default_rng(1))
    assert np.ptp(values) == 0.0


def test_fading_scatters_like_the_recorded_drives() -> None:
    faded = radio.fading_db((50_000,), np.random.default_rng(1))
    assert faded.mean() == pytest.approx(0.0, abs=1e-9)
    assert 2.4 <= faded.std() <= 3.0


def test_robots_drive_at_their_speed_and_stay_in_the_hall() -> None:
    way = radio.walk(3000, 0.2, 30.0, np.random.default_rng(1))
    moved = np.hypot(*np.diff(way, axis=0).T)
    assert moved.max() <= radio.SPEED_M_S * 0.2 + 1e-9
    assert np.median(moved) == pytest.approx(radio.SPEED_M_S * 0.2)
    assert way.min() >= 0.0
    assert way.max() <= 30.0


def test_the_same_seed_gives_the_same_signals() -> None:
    one, other = (radio.hall_signals(200, 0.2, 2, 3, np.random.default_rng(5)) for _ in range(2))
    assert one.shape == (200, 2, 3)
    assert np.array_equal(one, other)


@pytest.fixture
def drive_file(tmp_path: Path) -> Path:
    rows = ["time_stamp, c_rssi, network_delay,"]
    rows += [f"{1_600_000_000_000_000_000 + index * 200_000_000}, {-50 - index}, {20 + index}," for index in range(20)]
    rows.append(f"{1_600_000_000_000_000_000 + 20 * 200_000_000}, -2, -2,")
    path = tmp_path / "drive.csv.gz"
    path.write_bytes(gzip.compress("\n".join(rows).encode()))
    return path


def test_a_recorded_drive_is_read_at_an_even_step(drive_file: Path) -> None:
    drive = radio.read_drive(drive_file)
    assert drive.name == "drive"
    assert drive.rssi_dbm[:3].tolist() == [-50.0, -51.0, -52.0]
    assert drive.delay_ms[2] in (20.0, 21.0, 22.0)
    assert len(drive.rssi_dbm) == len(drive.delay_ms)


def test_a_shifted_drive_begins_later_and_wraps(drive_file: Path) -> None:
    drive = radio.read_drive(drive_file)
    shifted = drive.shifted(1.0)
    assert shifted.rssi_dbm[0] == drive.rssi_dbm[5]
    assert shifted.rssi_dbm[-1] == drive.rssi_dbm[4]


def test_drives_that_nothing_was_chosen_by_are_played_where_the_folder_has_them(
    drive_file: Path, tmp_path: Path
) -> None:
    assert drives.apart(tmp_path) == {}
    (tmp_path / drives.APART[0]).write_bytes(drive_file.read_bytes())
    ((title, fleet),) = drives.apart(tmp_path).items()
    assert title == "robot to robot, kept apart: router-2G-trial2"
    assert [drive.name.partition("+")[2] for drive in fleet] == ["", "60s", "120s"]
    for name in drives.APART[1:]:
        (tmp_path / name).write_bytes(drive_file.read_bytes())
    every = drives.apart(tmp_path)
    assert len(every) == len(drives.APART) + 1
    assert {len(fleet) for fleet in every.values()} == {3}
    assert not set(drives.APART) & set(drives.FILES)


def test_both_rows_keep_the_margin_of_a_placed_task() -> None:
    """The owner is just reached, another is 2.5 dB above nu: a margin of 3 dB says no."""
    nu_dbm = LinkLimits().nu_dbm
    levels = (nu_dbm + 0.3, nu_dbm + 2.5)
    flat = [
        radio.Drive(name=f"flat{level:g}", dt_s=0.2, rssi_dbm=np.full(200, level), delay_ms=np.full(200, np.nan))
        for level in levels
    ]
    world = drives_world(tuple(flat), are_robots=False)
    view = View(world, feed := Feed(world, Look()))
    for index in range(100):
        feed.step(index)
    now = START_S + 100 * DT_S
    by_name = {entry.name: entry.make(view) for entry in drives.cast(world)}
    aggregates = {}
    for name in ("zsched by service", "zsched"):
        rule = by_name[name]
        assert isinstance(rule, CoreRule)
        placed = Allocation(task=world.spec.name, revision=1, epoch=1, owner="edge001", tuning=rule.tuning)
        aggregates[name] = view.standing(now, placed).aggregates
    assert {name: set(found) for name, found in aggregates.items()} == {key: {"edge001"} for key in aggregates}


def test_the_row_by_service_plays_with_its_own_allocation() -> None:
    asked: list[Allocation | None] = []

    class Spy(View):
        def standing(
            self, now: float, allocation: Allocation | None = None, lost_for: LostFor | None = None
        ) -> Standing:
            asked.append(allocation)
            return super().standing(now, allocation, lost_for)

    level = np.full(200, -60.0)
    flat = radio.Drive(name="flat", dt_s=0.2, rssi_dbm=level, delay_ms=np.full(200, np.nan))
    world = drives_world((flat, flat.shifted(1.0)), are_robots=False)
    view = Spy(world, feed := Feed(world, Look()))
    rule = {entry.name: entry for entry in drives.cast(world)}["zsched by service"].make(view)
    for index in range(100):
        feed.step(index)
        rule.round((0,), index * DT_S, START_S + index * DT_S)
    owners = [None if one is None else one.owner for one in asked]
    assert owners[-1] in {"edge001", "edge002"}, "what it scores is the task where it is"
