"""A real secured fleet: every process has its certificate and its access rules, and the streams run and move."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from support.authorities import install, make_authority
from zsched.adapters.host.operator_socket import ask
from zsched.config.load import load_fleet
from zsched.core.values.certificates import Role
from zsched.pki.authority import opened
from zsched.runtime.access_rules import Side
from zsched.runtime.tls import session_text
from zsched.sessions.config import client_config
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet


def secured(folder: Path) -> Json:
    """Two robots, and two edges of which one gives no address; an operator and a guest have a folder of their own."""
    tree = echo_fleet(robots=2, edges=2, stream_class="reliable")
    for node in tree["nodes"].values():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    del tree["nodes"]["edge2"]["host"], tree["nodes"]["edge2"]["listen"]
    tree["security"] = {"operators": ["ana"], "guests": ["screen"]}
    authority = make_authority(folder / "authority", tree["fleet"])
    for name in tree["nodes"]:
        install(authority, folder / "pki" / name, name)
    for name, role in (("ana", Role.OPERATOR), ("screen", Role.GUEST)):
        install(authority, folder / name / "pki", name, role)
        (folder / name / "fleet.yaml").write_text(json.dumps(tree))
    return tree


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Testbed]:
    folder = tmp_path_factory.mktemp("secured")
    with Testbed(folder, secured(folder)) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_settled(90)
        yield testbed


def application(bed: Testbed, node: str) -> zenoh.Session:
    """An application of the node's host, by what its operator socket tells root."""
    access = ask(bed.folder / f"{node}.sock", {"verb": "access", "node": node}, 5.0)
    return zenoh.open(zenoh.Config.from_json5(access["sides"]["fleet"]))


def zsched(bed: Testbed, node: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A verb on the machine of a node, or (a folder of its own) of a person."""
    home = bed.folder / node
    given = {"CREDENTIALS_DIRECTORY": str(bed.folder / "pki" / node), "ZSCHED_CONFIG": str(bed.file)}
    if (home / "fleet.yaml").exists():
        given = {"ZSCHED_CONFIG": str(home / "fleet.yaml")}
    env = {**os.environ, **given, "ZSCHED_NODE": node, "ZSCHED_RUNTIME_DIR": str(bed.folder)}
    command = [sys.executable, "-m", "zsched.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=env)


def test_an_operator_commands_from_elsewhere_and_a_guest_only_looks(bed: Testbed) -> None:
    endpoint = bed.fleet.node("robot1").listen_control
    for name, more, node in (("ana", [], "robot1"), ("screen", ["--node", "edge2"], "edge2")):
        seen = zsched(bed, name, "status", "--connect", endpoint, "--json", *more)
        assert seen.returncode == 0, seen.stderr
        assert json.loads(seen.stdout)["node"] == node
    assert bed.status("robot1")["security"] == "secured"
    before = bed.task("robot1")["tuning"]

    change = ["weights", TASK, "cpu=0.25", "memory=0.75", "--connect", endpoint]
    refused = zsched(bed, "screen", *change)
    assert "did not answer" in refused.stderr, refused.stderr
    assert bed.task("robot1")["tuning"] == before
    done = zsched(bed, "ana", *change)
    assert done.returncode == 0, done.stderr
    assert "command=SetWeights from=ana" in bed.log("robot1")
    assert "from=screen" not in bed.log("robot1")
    bed.wait(
        lambda: bed.task("robot2")["tuning"]["weights"]["memory"] == 0.75, 60, "the new weights at the other robot"
    )


def test_streams_run_and_move_and_tools_find_their_certificates(bed: Testbed) -> None:
    first = bed.wait_whole()
    got: list[str] = []
    with application(bed, "robot1") as session:
        session.declare_subscriber("robot1/out", lambda sample: got.append(sample.payload.to_string()))
        publisher = session.declare_publisher("robot1/in")

        def echoed(text: str) -> bool:
            publisher.put(text)
            return any(one.endswith(text) for one in got)

        bed.wait(lambda: echoed("before"), 60, "the owner's answer")
        bed.stop(first)
        second = bed.wait_settled()
        bed.wait(lambda: echoed("after"), 60, "the next owner's answer")
    assert second != first
    pinged = zsched(bed, "robot1", "ping", "robot2", "--count", "1")
    assert pinged.returncode == 0, pinged.stdout + pinged.stderr
    bed.wait(lambda: "robot2" in bed.status("robot1")["quorum"]["voted"], 60, "robot1 to remember robot2's vote")
    bed.kill("robot2")
    shutil.rmtree(bed.folder / "robot2")
    refused = zsched(bed, "robot2", "init", "--state-dir", str(bed.folder / "robot2"))
    assert "knows robot2 as an elector that has voted" in refused.stderr, refused.stderr


def test_a_link_that_belongs_to_nobody_is_counted_and_named(bed: Testbed) -> None:
    with opened(bed.folder / "authority", bed.fleet.name) as authority:
        install(authority, bed.folder / "mallory" / "pki", "mallory", Role.GUEST)
    fleet = load_fleet(bed.folder / "screen" / "fleet.yaml")
    assert fleet.security is not None
    stranger = replace(fleet, security=replace(fleet.security, folder=str(bed.folder / "mallory" / "pki")))
    endpoint = bed.fleet.node("robot1").listen_control
    config = client_config(connect=(endpoint,), operator_json5=session_text(stranger, Side.VISIT), patience_s=5.0)
    with zenoh.open(zenoh.Config.from_json5(config)):
        bed.wait(
            lambda: bed.status("robot1")["counters"].get("dropped_link_stranger"), 60, "the stranger to be counted"
        )
    assert "certificate='mallory.guest.testbed.zsched.internal'" in bed.log("robot1")
