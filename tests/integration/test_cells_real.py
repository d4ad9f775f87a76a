"""Two cells of three real daemons each: the verbs of one ask and command the other, also with a gateway killed."""

from __future__ import annotations

import getpass
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from support.authorities import install, make_authority
from support.waiting import until
from zsched.core.values.certificates import Role
from zsched.core.values.endpoint import Endpoint
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.timeout(180)
VERB_S = 30.0
A, B = "hall-a", "hall-b"
Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One fleet, and the verbs as an operator runs them on one of its machines."""

    bed: Testbed

    def zsched(self, *words: str, node: str = "robot1") -> subprocess.CompletedProcess[str]:
        """A verb on a machine of this cell, to its end."""
        place = {"ZSCHED_CONFIG": self.bed.file, "ZSCHED_NODE": node, "ZSCHED_RUNTIME_DIR": self.bed.folder}
        environment = {**os.environ, **{name: str(value) for name, value in place.items()}}
        command = [sys.executable, "-m", "zsched.cli", *words]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=VERB_S, check=False)

    def json(self, *words: str, node: str = "robot1") -> Json:
        """The JSON of a verb that ends well, or with 4."""
        done = self.zsched(*words, "--json", node=node)
        assert done.returncode in (0, 4), done.stderr
        body: Json = json.loads(done.stdout)
        return body


def gateways(tree: Json) -> list[str]:
    """Where a cell is asked: two of its nodes."""
    nodes: Json = tree["nodes"]
    return [Endpoint.of(nodes[name]["listen"]["control"]).dialled(nodes[name]["host"]) for name in ("edge1", "edge2")]


@pytest.fixture
def site(tmp_path: Path) -> Iterator[dict[str, Cell]]:
    """Two cells of a robot and two edges, in which all nodes are electors, each with an owner of its own task."""
    trees = {name: {**echo_fleet(robots=1, edges=2), "fleet": name} for name in (A, B)}
    ends = {name: gateways(tree) for name, tree in trees.items()}
    with ExitStack() as stack:
        cells = {}
        for name, other in ((A, B), (B, A)):
            tree = trees[name]
            tree["electorate"] = sorted(tree["nodes"])
            tree["site"] = {other: {"gateways": ends[other]}}
            folder = tmp_path / name
            folder.mkdir()
            bed = stack.enter_context(Testbed(folder, tree))
            bed.init()
            bed.start()
            cells[name] = Cell(bed=bed)
        for cell in cells.values():
            cell.bed.wait_whole()
        yield cells


@pytest.mark.long
def test_a_node_of_one_cell_asks_and_commands_the_other_while_its_gateways_die(site: dict[str, Cell]) -> None:
    here, there = site[A], site[B]
    for node in ("robot1", "edge1", "edge2"):
        status = here.json("status", "--node", f"{B}/{node}")
        assert (status["fleet"], status["node"]) == (B, node)
    assert here.json("status", "--node", f"{A}/edge2")["fleet"] == A
    assert here.json("explain", TASK, "--node", f"{B}/robot1")["node"] == "robot1"
    listed = here.json("status", "--site")
    assert [(cell["name"], cell["alive"], cell["nodes"]) for cell in listed["cells"]] == [(A, 3, 3), (B, 3, 3)]

    done = here.zsched("pause", TASK, "--node", f"{B}/robot1", "-m", "lens", "--yes")
    assert done.returncode == 0, done.stderr
    paused = there.json("status")["tasks"][0]["pause"]
    assert (paused["by"], paused["reason"]) == (f"{getpass.getuser()}@{A}/robot1", "lens")
    assert here.json("status")["tasks"][0]["pause"] is None  # nothing was agreed here

    for node in (f"{B}/robot1", f"{B}/edge2"):  # a robot's log, and an edge's
        moves = here.json("history", "--node", node)["moves"]
        assert moves[-1]["to"] == there.bed.owner()
    merged = here.json("history", "--site")
    assert [(cell["name"], cell["error"]) for cell in merged["cells"]] == [(A, None), (B, None)]
    assert {move["cell"] for move in merged["moves"]} == {A, B}
    ages = [move["age_s"] for move in merged["moves"]]
    assert ages == sorted(ages, reverse=True)
    assert here.json("history", "--node", "edge2")["node"] == "edge2"  # and of the own fleet

    there.bed.kill("edge1")  # its first gateway
    status = here.json("status", "--node", f"{B}/robot1")
    assert (status["fleet"], status["node"]) == (B, "robot1")
    done = here.zsched("resume", TASK, "--node", f"{B}/robot1", "--yes")
    assert done.returncode == 0, done.stderr
    assert there.json("status")["tasks"][0]["pause"] is None

    there.bed.send("edge2", signal.SIGSTOP)  # and its second one, which still takes connections
    refused = here.zsched("status", "--node", f"{B}/robot1")
    assert refused.returncode == 3
    assert f"{B}/robot1 cannot be asked" in refused.stderr
    assert all(f"by {gateway}" in refused.stderr for gateway in here.bed.fleet.cells[0].gateways)
    listed = here.json("status", "--site")["cells"]
    assert [(cell["name"], cell["error"] is None) for cell in listed] == [(A, True), (B, False)]
    done = here.zsched("history", "--site")
    assert done.returncode == 0, done.stderr
    assert f"{A}  " in done.stdout
    assert f"PROBLEMS\n  {B}: cell {B} cannot be asked" in done.stdout
    there.bed.send("edge2", signal.SIGCONT)


@pytest.mark.long
def test_a_secured_cell_is_asked_with_a_certificate_of_its_own_authority(tmp_path: Path) -> None:
    tree = {**echo_fleet(robots=1, edges=2), "fleet": B, "security": {"operators": ["ana"]}}
    tree["electorate"] = sorted(tree["nodes"])
    for node in tree["nodes"].values():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    authority = make_authority(tmp_path / "authority", B)
    for name in tree["nodes"]:
        install(authority, tmp_path / "pki" / name, name)
    desk = tmp_path / "desk"  # of a machine of the other cell, which runs no daemon
    install(authority, desk / "pki-b", "ana", Role.OPERATOR)
    (desk / "hall-b.yaml").write_text(json.dumps({**tree, "security": {"operators": ["ana"], "folder": "pki-b"}}))
    own = {**echo_fleet(robots=1, edges=0), "fleet": A}
    own["site"] = {B: {"gateways": gateways(tree), "file": "hall-b.yaml"}}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled(90)
        here = Cell(bed=Testbed(desk, own))
        status = here.json("status", "--node", f"{B}/robot1")
        assert (status["fleet"], status["node"]) == (B, "robot1")
        done = here.zsched("history", "--node", f"{B}/edge1")
        assert (done.returncode, TASK in done.stdout) == (0, True), done.stderr
        done = here.zsched("pause", TASK, "--node", f"{B}/edge1", "--yes")
        assert done.returncode == 0, done.stderr
        paused = until(lambda: bed.task("robot1")["pause"], "robot1 has learnt the pause")
        assert paused["by"] == "ana.operator"
        passed_on = here.zsched("resume", TASK, "--node", f"{B}/robot1", "--yes")
        assert passed_on.returncode == 1  # nodes of a secured fleet pass on no commands
        assert "robot1 is none of the gateways of hall-b that answer (edge1, edge2)" in passed_on.stderr
        done = here.zsched("resume", TASK, "--node", f"{B}/edge2", "--yes")
        assert done.returncode == 0, done.stderr  # the second gateway, while the first is up
