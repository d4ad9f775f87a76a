"""Workers in containers on real daemons: started, moved, killed, failed over and left behind.

About 12 s with podman or docker; skipped without.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.verbs import move
from support.waiting import until
from zsched_lab.fleet.containers import Host, NoEngineError, container_host
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

FLEET = "testbed"
pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def host() -> Iterator[Host]:
    try:
        found = container_host()
    except NoEngineError as error:
        pytest.skip(str(error))
    yield found
    found.ask("rmi", "--force", found.image)


@pytest.fixture
def bed(tmp_path: Path, host: Host) -> Iterator[Testbed]:
    worker: dict[str, Any] = {
        "driver": "container",
        "engine": host.engine,
        "image": host.image,
        "args": [sys.executable, "-m", "zsched.tasks.echo"],
        "mounts": list(host.mounts),
        "options": list(host.options),
        "env": {"GREETING": 'a "b" $HOME'},
        "max_failures": 5,
    }
    with Testbed(tmp_path, echo_fleet(robots=1, edges=2, task={"worker": worker})) as made:
        made.init()
        made.start()
        yield made
    until(lambda: not host.containers(FLEET), "every container has gone with its daemon")


def load(bed: Testbed, node: str) -> dict[str, Any]:
    found = next(one for one in bed.status(node)["nodes"] if one["name"] == node)
    worker: dict[str, Any] = next(iter(found["workers"]), {})
    return worker


def name_of(host: Host, node: str) -> str:
    (name,) = (name for name in host.containers(FLEET) if name.startswith(f"zsched-{FLEET}-{node}-{TASK}-"))
    return name


def test_a_task_moves_between_containers_and_outlives_each_kind_of_end(bed: Testbed, host: Host) -> None:
    first = bed.wait_whole()
    other = "edge2" if first == "edge1" else "edge1"
    bed.wait(lambda: all(load(bed, edge)["state"] == "ready" for edge in (first, other)), 60, "both are ready")
    assert len(host.containers(FLEET)) == 2
    assert "GREETING=a" in host.ask("inspect", "--format", "{{.Config.Env}}", name_of(host, first))

    seen = bed.wait(lambda: load(bed, first) if load(bed, first).get("cpu_cores") is not None else None, 30, "its load")
    assert seen is not None
    noted = int((bed.folder / f"{first}-{TASK}.pid").read_text().split()[0])
    assert str(noted) == host.ask("inspect", "--format", "{{.State.Pid}}", name_of(host, first))

    move(bed, other)

    host.ask("kill", "--signal=KILL", name_of(host, other))
    bed.wait(lambda: "killed by signal 9" in load(bed, other).get("reason", ""), 30, "the reason in status")
    bed.wait(lambda: load(bed, other)["state"] == "ready", 60, "a container anew")

    owner = bed.wait_settled()
    heir = first if owner == other else other
    os.kill(bed.pid(owner), signal.SIGKILL)
    bed.kill(owner)
    bed.wait(lambda: bed.owner() == heir, 60, "the other takes over")
    bed.wait(lambda: host.containers(FLEET) == [name_of(host, heir)], 30, "a killed daemon leaves no container")


def test_an_image_that_is_not_there_is_refused_with_the_command(tmp_path: Path, host: Host) -> None:
    worker = {"driver": "container", "engine": host.engine, "image": "localhost/zsched-none:1"}
    with Testbed(tmp_path, echo_fleet(robots=1, edges=1, task={"worker": worker})) as bed:
        bed.init()
        bed.start()
        bed.wait(lambda: load(bed, "edge1").get("state") == "failed", 30, "it is failed at once")
        reason = load(bed, "edge1")["reason"]
        assert "the image localhost/zsched-none:1 is not on this machine" in reason
        assert f"{host.engine} pull localhost/zsched-none:1" in reason
