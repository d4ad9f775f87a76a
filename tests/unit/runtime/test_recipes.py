"""What workers are made with: their session files, also where one cannot be written."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from support.fleets import fleet_of, task_of
from zsched.config.drivers import starter_for
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Security, WorkerLink, WorkerSpec
from zsched.host.workers.hired import FOLDER
from zsched.runtime import recipes as recipes_module
from zsched.runtime.recipes import Recipes
from zsched.runtime.sessions import SessionsRead

HERE, THERE = ("tcp/127.0.0.1:7458",), ("tcp/127.0.0.1:7458", "tcp/192.0.2.1:7458")
MERGE, PLAN = (task_of(name, worker=WorkerSpec(command=("work",))) for name in ("merge", "plan"))


@dataclass
class Disk:
    """Files are written until it is full: then an open one takes half of what it is to hold, as a real disk's may."""

    is_full: bool = False

    def write(self, path: Path, content: bytes) -> None:
        path.write_bytes(content[: len(content) // 2] if self.is_full else content)
        if self.is_full:
            path.unlink()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    made = Disk()
    monkeypatch.setattr(recipes_module, "write_regular", made.write)
    return made


@pytest.fixture
def recipes(tmp_path: Path) -> Iterator[Recipes]:
    made = Recipes(
        "edge1",
        tmp_path,
        SessionsRead(tmp_path / "state"),
        shared_memory=False,
        operator_json5=dict.fromkeys(WorkerLink, ""),
        pools=None,
    )
    yield made
    made.close()
    assert list(tmp_path.iterdir()) == []


def test_a_session_in_use_stays_whole_when_the_next_one_cannot_be_written(recipes: Recipes, disk: Disk) -> None:
    recipes.make(fleet_of(MERGE), HERE, dials_by_gossip=False)
    path, before = recipes.paths["merge"], recipes.session("merge")
    disk.is_full = True
    with pytest.raises(AdapterError, match=r"cannot write \S+edge1-merge.zenoh.json5: No space left on device"):
        recipes.make(fleet_of(MERGE, PLAN), THERE, dials_by_gossip=False)
    assert (path.read_text(), recipes.session("merge"), set(recipes.specs)) == (before, before, {"merge"})
    disk.is_full = False
    recipes.make(fleet_of(MERGE, PLAN), THERE, dials_by_gossip=False)
    for task in ("merge", "plan"):
        assert "192.0.2.1" in recipes.session(task)
        assert recipes.paths[task].read_text() == recipes.session(task)


def test_a_change_that_is_taken_back_after_half_of_its_sessions_were_written_takes_those_back(
    recipes: Recipes, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = fleet_of(MERGE, PLAN)
    recipes.make(fleet, HERE, dials_by_gossip=False)
    before = recipes.session("merge")

    def full_after_one(path: Path, content: bytes) -> None:
        disk.write(path, content)
        disk.is_full = True

    monkeypatch.setattr(recipes_module, "write_regular", full_after_one)
    with pytest.raises(AdapterError):
        recipes.make(fleet, THERE, dials_by_gossip=False)
    assert "192.0.2.1" in recipes.paths["merge"].read_text(), "the first one was written"
    monkeypatch.undo()
    recipes.make(fleet, HERE, dials_by_gossip=False)
    assert recipes.paths["merge"].read_text() == before


def test_a_program_that_knows_zenohs_own_variable_joins_the_data_network(
    recipes: Recipes, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipes.make(fleet_of(MERGE), HERE, dials_by_gossip=False)
    environment = recipes.environment("merge")
    assert environment["ZENOH_CONFIG"] == environment["ZENOH_SESSION_CONFIG_URI"] == str(recipes.paths["merge"])
    monkeypatch.setenv("ZENOH_CONFIG", environment["ZENOH_CONFIG"])
    assert HERE[0] in zenoh.Config.from_env().get_json("connect/endpoints")


def test_a_worker_whose_session_may_need_a_key_is_the_daemons_unless_its_task_names_a_user(tmp_path: Path) -> None:
    """TLS by hand names files that only the daemon's user reads."""
    (tmp_path / "zsched-worker.sock").touch()
    env, plain, secured = {FOLDER: str(tmp_path)}, fleet_of(MERGE), fleet_of(MERGE, security=Security(folder="pki"))
    by_hand, ros = fleet_of(MERGE, zenoh_config="tls.json5"), WorkerSpec(command=("work",), user="ros")
    unit = WorkerSpec(command=("python", "-m", "zsched.drivers.systemd", "--unit", "merge.service"))
    assert starter_for(MERGE.worker, plain, env) == tmp_path / "zsched-worker.sock"
    assert [starter_for(MERGE.worker, fleet, env) for fleet in (secured, by_hand)] == [None, None]
    assert [starter_for(ros, fleet, env) for fleet in (secured, by_hand)] == [tmp_path / "ros.sock"] * 2
    assert starter_for(unit, plain, env) is None
    assert starter_for(MERGE.worker, plain, {}) is None


def test_a_worker_without_the_key_dials_its_own_relay_only(tmp_path: Path) -> None:
    keyed = dict.fromkeys(WorkerLink, '{transport: {link: {tls: {connect_private_key: "/k"}}}}')
    made = Recipes(
        "edge1",
        tmp_path,
        SessionsRead(tmp_path / "state"),
        shared_memory=False,
        operator_json5=keyed,
        pools=None,
        by_socket=(("unixsock-stream//run/r.sock",), "{}"),
    )
    task = task_of("merge", worker=WorkerSpec(command=("work",), user="ros"))
    made.make(fleet_of(task, PLAN, security=Security(folder="pki")), THERE, dials_by_gossip=False)
    assert "/k" in made.session("plan")
    assert "/k" not in made.session("merge")
    settings = zenoh.Config.from_json5(made.session("merge"))
    assert (settings.get_json("mode"), settings.get_json("connect/endpoints")) == (
        '"client"',
        '["unixsock-stream//run/r.sock"]',
    )
    made.close()
