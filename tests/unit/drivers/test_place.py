"""A worker's place: what a driver is told, and the files by which it tells."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from zsched.core.values.errors import ConfigError
from zsched.drivers.place import Place
from zsched.runtime.sampler import noted_pid


def variables(folder: Path) -> dict[str, str]:
    return {
        "ZSCHED_FLEET": "f",
        "ZSCHED_NODE": "edge1",
        "ZSCHED_TASK": "shout",
        "ZSCHED_INCARNATION": "7",
        "ZSCHED_ZENOH_CONFIG": str(folder / "edge1-shout.zenoh.json5"),
        "PATH": "/bin",
        "GREETING": "hello",
    }


def test_a_worker_is_told_its_own_variables_and_nothing_of_the_daemons(tmp_path: Path) -> None:
    place = Place.from_env(variables(tmp_path), ("GREETING", "ABSENT"))
    assert [name for name, _ in place.variables][-2:] == ["ZSCHED_ZENOH_CONFIG", "GREETING"]
    assert place.environment_file == tmp_path / "edge1-shout.env"
    place.write_environment(["A=b"])
    assert place.environment_file.read_text() == "A=b\n"
    assert place.environment_file.stat().st_mode & 0o777 == 0o600


def test_a_driver_without_a_daemon_says_what_it_lacks() -> None:
    with pytest.raises(ConfigError, match="no ZSCHED_FLEET, ZSCHED_NODE"):
        Place.from_env({})


def test_the_noted_process_is_measured_while_its_driver_lives(tmp_path: Path) -> None:
    place, me = Place.from_env(variables(tmp_path)), os.getpid()
    assert noted_pid(place.session, me) == me
    place.note(4711)
    assert noted_pid(place.session, me) == 4711
    assert noted_pid(place.session, me + 1) == me + 1, "the note of another driver says nothing"
    assert noted_pid(place.session, None) is None
    assert noted_pid(None, me) == me
    place.pid_file.write_text("not a number")
    assert noted_pid(place.session, me) == me
    place.forget()
    assert list(tmp_path.iterdir()) == []


def test_a_link_planted_in_place_of_the_file_is_not_followed(tmp_path: Path) -> None:
    place = Place.from_env(variables(tmp_path))
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / "edge1-shout.env.part").symlink_to(victim)
    with pytest.raises(OSError, match="symbolic links"):
        place.write_environment(["A=b"])
    assert victim.read_text() == "mine"
