"""`zsched doctor` on a real fleet: nothing is wrong with one in order, and three faults at once are found."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from zsched.core.values.errors import AdapterError
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

WAIT_S = 40.0
VERB_S = 60.0
BUSY = ("daemon.lag", "fleet.lag", "state.fsync")
"""What may fail on a machine that other tests keep busy."""


def zsched(bed: Testbed, node: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A verb on one machine of the fleet."""
    words = {"CONFIG": bed.file, "NODE": node, "STATE_DIR": bed.folder / node, "RUNTIME_DIR": bed.folder}
    done = subprocess.run(
        [sys.executable, "-m", "zsched.cli", *arguments],
        env={**os.environ, **{f"ZSCHED_{name}": str(value) for name, value in words.items()}},
        capture_output=True,
        text=True,
        timeout=VERB_S,
        check=False,
    )
    assert done.stdout, done.stderr
    return done


def doctor(bed: Testbed, node: str, *arguments: str) -> tuple[int, dict[str, Any]]:
    """(exit code, {check: its result}) of the doctor."""
    done = zsched(bed, node, "doctor", "--json", *arguments)
    assert done.returncode == int('"FAIL"' in done.stdout), done.stderr
    return done.returncode, {check["id"]: check for check in json.loads(done.stdout)["checks"]}


def failed(found: dict[str, Any]) -> dict[str, str]:
    return {
        name: " ".join(check["evidence"])
        for name, check in found.items()
        if check["verdict"] == "FAIL" and name not in BUSY
    }


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, echo_fleet(robots=3, edges=2)) as made:
        yield made


def test_a_fleet_in_order_passes_and_three_faults_at_once_are_found(bed: Testbed) -> None:
    bed.init()
    bed.start()
    bed.wait_settled(WAIT_S)
    _, found = doctor(bed, "robot1", "--fleet")
    assert failed(found) == {}
    assert [found[name]["verdict"] for name in ("fleet.pairs", "fleet.registers", "net.ports")] == ["PASS"] * 3
    assert found["fleet.pairs"]["evidence"] == ["20 directions between 5 nodes, all heard"]
    _, found = doctor(bed, "edge1")
    assert failed(found) == {}
    assert [found[name]["verdict"] for name in ("worker.imports", "worker.state")] == ["PASS"] * 2

    bed.stop("robot2", "robot3", "edge2")
    (bed.folder / "robot3" / "state").unlink()
    good = bed.file.read_text()
    bed.file.write_text(good.replace('"bonus": 0.1', '"bonus": 0.2'))
    bed.start("robot2")
    bed.wait(lambda: heard(bed, "robot2", "robot1") == "alive", WAIT_S, "robot2 hears robot1")
    bed.file.write_text(good)
    bed.start("robot3")

    bed.wait(lambda: heard(bed, "robot1", "robot2") == "alive", WAIT_S, "robot1 hears robot2")
    bed.wait(lambda: heard(bed, "robot1", "robot3") == "alive", WAIT_S, "robot1 hears robot3")
    code, found = doctor(bed, "robot1", "--fleet")
    faults = failed(found)
    assert code == 1
    assert "robot2 goes by hash" in faults["fleet.files"]
    assert "robot3 is an elector without a valid state (lost_state)" in faults["fleet.electors"]
    assert found["fleet.answers"]["evidence"] == ["1 of 5 nodes do not answer: edge2"]
    assert "edge2" not in faults.get("fleet.addresses", "")

    code, found = doctor(bed, "robot3")
    assert "does not exist" in failed(found)["state.valid"]
    code, found = doctor(bed, "laptop", "--fleet", "--runtime-dir", str(bed.folder / "none"))
    assert set(failed(found)) == {"fleet.files", "fleet.electors"}
    assert "state.valid" not in found


def test_ping_and_bugreport_of_a_real_fleet(bed: Testbed) -> None:
    bed.init("robot1", "edge1")
    bed.start("robot1", "edge1")
    bed.wait(lambda: heard(bed, "robot1", "edge1") == "alive", WAIT_S, "robot1 hears edge1")
    bed.wait(lambda: heard(bed, "edge1", "robot1") == "alive", WAIT_S, "edge1 hears robot1")

    # daemons hear each other by their control sessions; the relay, which has the data session, may still be starting
    bed.wait(lambda: listens(bed.fleet.node("edge1").listen_data), WAIT_S, "edge1's relay listens")

    def ping(node: str) -> tuple[int, dict[str, Any]]:
        done = zsched(bed, "robot1", "ping", node, "--json", "--count", "2", "--timeout", "5")
        return done.returncode, json.loads(done.stdout)

    code, body = ping("edge1")
    # control, data, data with 64 KiB and with 1 MiB, through the daemon
    assert (code, [way["answered"] for way in body["ways"]]) == (0, [2, 2, 1, 1, 2])
    assert body["heard"] == {"robot1": {"edge1": "alive"}, "edge1": {"robot1": "alive"}}
    assert ping("edge2")[0] == 3

    body = json.loads(zsched(bed, "robot1", "bugreport", str(bed.folder / "report.tar.gz"), "--json").stdout)
    assert {"status/robot1.json", "status/edge1.json", "doctor.txt", "fleet.yaml"} <= set(body["members"])
    assert body["missing"]["status/edge2.json"] == "edge2 does not answer"


def listens(endpoint: str) -> bool:
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=1.0).close()
    except OSError:
        return False
    return True


def heard(bed: Testbed, listener: str, speaker: str) -> str:
    try:
        nodes = bed.status(listener)["nodes"]
    except AdapterError:
        return "not up yet"
    return next(str(node["state"]) for node in nodes if node["name"] == speaker)
