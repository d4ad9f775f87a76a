from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from zsched_lab.fleet.recorder import Recorder
from zsched_lab.maps.picture import MapPicture
from zsched_lab.robots.watch import RobotWatch


def test_a_robots_records_become_rates_and_gaps(tmp_path: Path) -> None:
    watch = RobotWatch.of("robot1", tmp_path)
    watch.update()
    assert watch.view(0.0).rate_hz is None
    assert watch.mean_hz(10.0) is None
    assert watch.longest_gap_s(10.0) is None
    with Recorder(tmp_path) as recorder:
        for t_s in (10.0, 11.0, 12.0, 14.5, 15.0):
            recorder.write("robot1", {"kind": "map", "t_s": t_s})
        recorder.write("robot1", {"kind": "progress", "t_s": 15.0, "scans": 7, "scans_total": 33})
        recorder.write("robot1", {"kind": "status", "t_s": 15.0, "status": {"merges": 5}})
        picture = MapPicture(cells=np.array([[1, 2]], np.uint8), known_m2=3.0)
        recorder.write("robot1", {"kind": "picture", "t_s": 15.0, **picture.record()})
    watch.update()

    view = watch.view(16.0)

    assert (view.maps, view.scans, view.scans_total, view.age_s, view.gap_max_s) == (5, 7, 33, 1.0, 2.5)
    assert view.picture is not None
    assert view.picture.cells.tolist() == [[1, 2]]
    assert view.rate_hz == pytest.approx(3 / 5.0)
    assert watch.status == {"merges": 5}
    assert watch.mean_hz(20.0) == pytest.approx(0.4)
    assert watch.longest_gap_s() == 2.5
    assert watch.longest_gap_s(20.0) == 5.0
    assert watch.longest_gap_s(14.0) == 2.5
    assert [watch.gap_around_s(t_s) for t_s in (9.0, 10.5, 13.0, 15.0)] == [None, 1.0, 2.5, None]


def test_one_map_has_no_gap_but_the_silence_after_it(tmp_path: Path) -> None:
    watch = RobotWatch.of("robot1", tmp_path)
    watch.map_times.append(3.0)

    assert watch.longest_gap_s() is None
    assert watch.longest_gap_s(7.0) == 4.0
