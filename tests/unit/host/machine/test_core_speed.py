"""How fast a core is: measured twice it is the same, and kept for the processor that it was measured on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from zsched.host.machine import core_speed


def test_a_core_that_takes_twice_the_time_has_half_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]

    def work(took_s: float) -> Callable[[], None]:
        def run() -> None:
            now[0] += 2.0 * took_s

        return run

    works = {name: work(took_s) for name, took_s in core_speed.REFERENCE_S.items()}
    monkeypatch.setattr(core_speed, "kernels", lambda: works)
    monkeypatch.setattr(core_speed, "thread_time", lambda: now[0])
    assert core_speed.measure() == pytest.approx(0.5)


def test_what_was_measured_is_kept_and_measured_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = core_speed.kept_or_new(tmp_path)
    assert core_speed.kept(tmp_path) == made
    monkeypatch.setattr(core_speed, "measure", lambda: pytest.fail("it is there"))
    assert core_speed.kept_or_new(tmp_path) == made
    assert [path.name for path in tmp_path.iterdir()] == [core_speed.NAME]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1]",
        "null",
        "{}",
        '{"schema": "zsched.speed/1", "speed": "fast", "processor": "P"}',
        '{"schema": "zsched.speed/1", "speed": 0, "processor": "P"}',
        '{"schema": "zsched.speed/1", "speed": NaN, "processor": "P"}',
        '{"schema": "zsched.speed/2", "speed": 1, "processor": "P"}',
        '{"schema": "zsched.speed/1", "speed": 1, "processor": "another"}',
        "x" * 10_000,
    ],
)
def test_a_file_of_another_machine_or_kind_is_measured_anew(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core_speed, "processor", lambda: "P")
    monkeypatch.setattr(core_speed, "measure", lambda: 2.0)
    (tmp_path / core_speed.NAME).write_text(text)
    assert core_speed.kept(tmp_path) is None
    assert core_speed.kept_or_new(tmp_path) == core_speed.kept(tmp_path) == 2.0
    assert json.loads((tmp_path / core_speed.NAME).read_text())["processor"] == "P"


def test_a_link_in_the_folder_does_not_choose_what_root_writes(tmp_path: Path) -> None:
    """The folder is the service's, and `init` writes there as root."""
    folder, other = tmp_path / "state", tmp_path / "passwd"
    folder.mkdir()
    other.write_text("root")
    for name in (core_speed.NAME, f"{core_speed.NAME}.new"):
        (folder / name).symlink_to(other)
    speed = core_speed.keep(folder)
    assert other.read_text() == "root"
    assert (core_speed.kept(folder), (folder / core_speed.NAME).is_symlink()) == (speed, False)
    assert (folder / core_speed.NAME).stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("processor : 0\nmodel name\t: Xeon 1\nmodel name\t: Xeon 2\n", "Xeon 1"),
        ("processor\t: 0\nCPU part\t: 0xd0b\n\nHardware\t: BCM2711\nModel\t\t: Pi 4\n", "Pi 4"),
        ("nothing\n", ""),
    ],
)
def test_processors_have_names_on_x86_and_on_arm(text: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text(text)
    assert core_speed.processor(tmp_path / "cpuinfo") == name
    assert not core_speed.processor(tmp_path / "none")
