"""Where things are looked for: the argument, our own variables, systemd's, then the machine's or the user's default."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from unittest.mock import patch

import pytest

from zsched.host import paths as places

Find = Callable[[Path | None, Mapping[str, str]], Path]
GIVEN = Path("/given")


def test_fleet_file_of_the_user_is_taken_only_without_the_machines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system, env = tmp_path / "etc.yaml", {"XDG_CONFIG_HOME": str(tmp_path)}
    monkeypatch.setattr(places, "SYSTEM_CONFIG", system)
    assert places.config_path(None, env) == system, "named in the error when there is none"
    own = tmp_path / "zsched" / "fleet.yaml"
    own.parent.mkdir()
    own.touch()
    assert places.config_path(None, env) == own
    system.touch()
    assert places.config_path(None, env) == system


@pytest.mark.parametrize(
    ("find", "own", "systemd"),
    [
        (places.state_folder, "ZSCHED_STATE_DIR", "STATE_DIRECTORY"),
        (places.runtime_folder, "ZSCHED_RUNTIME_DIR", "RUNTIME_DIRECTORY"),
    ],
)
def test_folders_argument_own_variable_systemd(find: Find, own: str, systemd: str) -> None:
    both: Mapping[str, str] = {own: "/own", systemd: "/unit:/other"}
    assert find(GIVEN, both) == GIVEN
    assert find(None, both) == Path("/own")
    assert find(None, {own: "", systemd: "/unit:/other"}) == Path("/unit"), "systemd may give several; empty is unset"


def test_folders_of_root_and_of_a_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    assert places.state_folder(None, {}) == Path("/var/lib/zsched")
    assert places.runtime_folder(None, {}) == Path("/run/zsched")
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    env = {"XDG_STATE_HOME": "/home/me/.local/state", "XDG_RUNTIME_DIR": "/run/user/1000"}
    assert places.state_folder(None, env) == Path("/home/me/.local/state/zsched")
    assert places.runtime_folder(None, env) == Path("/run/user/1000/zsched")
    assert places.state_folder(None, {}).is_absolute()


def test_who_asks_finds_the_service_where_no_daemon_of_theirs_runs(tmp_path: Path) -> None:
    own, system = tmp_path / "user" / "zsched", tmp_path / "run"
    env = {"XDG_RUNTIME_DIR": str(tmp_path / "user")}
    for folder in (own, system):
        folder.mkdir(parents=True)
    with patch("os.geteuid", return_value=1000):
        assert places.asked_folder(None, env, system) == own, "nobody is anywhere"
        (system / "robot1.sock").touch()
        assert places.asked_folder(None, env, system) == system
        told = {**env, "ZSCHED_RUNTIME_DIR": str(own)}
        assert places.asked_folder(None, told, system) == places.asked_folder(own, env, system) == own
        (own / "robot2.sock").touch()
        assert places.asked_folder(None, env, system) == own, "their own come first"
        (own / "robot2.sock").unlink()
        (system / "robot1.sock").unlink()
        with patch("zsched.host.paths.is_closed", return_value=True):
            assert places.asked_folder(None, env, system) == system, "nobody may look into it: a daemon may be there"


def test_the_state_of_a_service_that_a_user_asks_is_the_services(tmp_path: Path) -> None:
    own, system = tmp_path / "user" / "zsched", tmp_path / "run"
    env = {"XDG_STATE_HOME": str(tmp_path / "user")}
    with patch("os.geteuid", return_value=1000):
        assert places.asked_state_folder(None, env, system, system) == Path("/var/lib/zsched")
        assert places.asked_state_folder(None, env, own, system) == own
        assert places.asked_state_folder(GIVEN, env, system, system) == GIVEN
        told = {**env, "ZSCHED_STATE_DIR": str(own)}
        assert places.asked_state_folder(None, told, system, system) == own
