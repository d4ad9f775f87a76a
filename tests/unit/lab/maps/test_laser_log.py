"""Laser logs: the shipped one, CARMEN lines, and faults named by file and line."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from zsched.core.values.errors import ConfigError
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.maps.laser_log import LaserLog, load_log, malaga_path, split_log


def _flaser(beams: int, *, t_s: float = 1.0, reading: float = 2.0, pose: str = "1 2 0.5") -> str:
    return f"FLASER {beams} {' '.join([str(reading)] * beams)} {pose} 9 9 9 {t_s} host {t_s}\n"


def _carmen(folder: Path, text: str, name: str = "drive.log") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def malaga() -> LaserLog:
    return load_log(malaga_path())


def test_shipped_log_is_whole(malaga: LaserLog) -> None:
    assert (malaga.name, len(malaga.scans)) == ("malaga", 99)
    assert malaga.duration_s == pytest.approx(58.8, abs=0.1)
    first = malaga.scans[0]
    assert first.pose == Pose2(x=0.78)
    assert first.angles[0] == pytest.approx(-math.pi / 2)
    assert first.ranges[0] == pytest.approx(1.68)
    assert all((scan.ranges > 0).all() and (scan.ranges < 30.0).all() for scan in malaga.scans)
    assert all(len(scan.ranges) == len(scan.angles) <= 361 for scan in malaga.scans)


@pytest.mark.parametrize(("beams", "degrees"), [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5)])
def test_carmen_beam_step_by_number(tmp_path: Path, beams: int, degrees: float) -> None:
    (scan,) = load_log(_carmen(tmp_path, _flaser(beams))).scans
    assert np.degrees(np.diff(scan.angles)) == pytest.approx(degrees)
    assert scan.angles[0] == pytest.approx(-math.pi / 2)
    assert scan.pose == Pose2(x=1.0, y=2.0, yaw=0.5)


def test_carmen_skips_other_lines_and_counts_time_from_the_first_scan(tmp_path: Path) -> None:
    text = (
        "# comment\nPARAM a b\nSYNC x\nNEFF 3\n\nODOM 0 0 0 0 0 0 1 h 1\n" + _flaser(4, t_s=5.0) + _flaser(4, t_s=7.5)
    )
    assert [scan.t_s for scan in load_log(_carmen(tmp_path, text)).scans] == [0.0, 2.5]


@pytest.mark.parametrize(("reading", "echoes"), [(19.99, 4), (20.0, 0), (81.9, 0), (0.0, 0), (-1.0, 0)])
def test_carmen_reading_at_the_limit_is_no_echo(tmp_path: Path, reading: float, echoes: int) -> None:
    (scan,) = load_log(_carmen(tmp_path, _flaser(4, reading=reading))).scans
    assert len(scan.ranges) == echoes


def test_gzip_is_read_and_names_are_short(tmp_path: Path) -> None:
    path = tmp_path / "intel-corrected.log.gz"
    path.write_bytes(gzip.compress(_flaser(4).encode()))
    assert load_log(path).name == "intel"


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("FLASER", "number of beams"),
        ("FLASER x 1 2", "number of beams"),
        ("FLASER 3 1 2 3 0 0 0", "fields"),
        (_flaser(4).replace("2.0", "two", 1), "not a number"),
        (_flaser(4).replace("2.0", "nan", 1), "finite"),
        ("WHAT 1 2", "unknown CARMEN message 'WHAT'; known are FLASER, and as skipped MARKER, NEFF, ODOM, PARAM"),
    ],
)
def test_malformed_line_is_named(tmp_path: Path, line: str, why: str) -> None:
    path = _carmen(tmp_path, _flaser(4) + line + "\n")
    with pytest.raises(ConfigError, match=rf"drive\.log:2: .*{why}"):
        load_log(path)


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.log"):
        load_log(tmp_path / "absent.log")
    with pytest.raises(ConfigError, match="no laser scan"):
        load_log(_carmen(tmp_path, "# nothing\n"))
    for content in (b"not gzip", gzip.compress(_flaser(4).encode())[:-9], gzip.compress(b"\xff\xfe")):
        path = tmp_path / "broken.log.gz"
        path.write_bytes(content)
        with pytest.raises(ConfigError, match=r"broken\.log\.gz"):
            load_log(path)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 99])
def test_split_gives_consecutive_parts_of_equal_size(malaga: LaserLog, n: int) -> None:
    parts = split_log(malaga, n)
    assert sum((part.scans for part in parts), ()) == malaga.scans
    sizes = [len(part.scans) for part in parts]
    assert max(sizes) - min(sizes) <= 1
