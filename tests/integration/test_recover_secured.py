"""A secured fleet that has lost its majority: recovered and joined again with certificates, signatures and TLS."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.authorities import install, make_authority
from zsched.core.values.exits import EXIT_OK, EXIT_WOULD_CHANGE
from zsched.core.values.model import NodeId
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

pytestmark = pytest.mark.long

DEAD: tuple[NodeId, ...] = ("robot1", "robot2", "robot3")
DANGERS = ("--accept", "old-electors-are-off", "--accept", "newest-may-be-lost")


def secured(folder: Path) -> Json:
    """Four robots that agree, and an edge; each has its certificate."""
    tree = {**echo_fleet(robots=4, edges=1, task={"candidates": ["robot1", "edge1"]}), "replace_s": 1, "away_s": 2}
    for node in tree["nodes"].values():
        node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    tree["security"] = {}
    authority = make_authority(folder / "authority", tree["fleet"])
    for name in tree["nodes"]:
        install(authority, folder / "pki" / name, name)
    return tree


def zsched(bed: Testbed, node: NodeId, *words: str) -> subprocess.CompletedProcess[str]:
    """A verb on the machine of a node, with that node's certificate and key."""
    given = {
        "CREDENTIALS_DIRECTORY": str(bed.folder / "pki" / node),
        "ZSCHED_CONFIG": str(bed.file),
        "ZSCHED_NODE": node,
        "ZSCHED_RUNTIME_DIR": str(bed.folder),
        "ZSCHED_STATE_DIR": str(bed.folder / node),
    }
    command = [sys.executable, "-m", "zsched.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=False, env={**os.environ, **given})


def done(bed: Testbed, node: NodeId, *words: str) -> str:
    result = zsched(bed, node, *words)
    assert result.returncode == EXIT_OK, (words, result.stdout, result.stderr)
    return result.stdout


def strangers(bed: Testbed, node: NodeId) -> set[str]:
    """Whom a node shows as counting by another generation."""
    told = [one for one in bed.status(node)["problems"] if one.startswith("generation/")]
    return {one.partition("/")[2].partition(":")[0] for one in told}


def refused(bed: Testbed, node: NodeId) -> dict[str, int]:
    """{counter: how many} of frames that were dropped for their seals."""
    words = ("unsigned", "signature", "signer", "certificate")
    return {name: count for name, count in bed.status(node)["counters"].items() if name.endswith(words)}


def test_a_secured_fleet_is_recovered_and_joined_again_by_word(tmp_path: Path) -> None:
    with Testbed(tmp_path, secured(tmp_path)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled(90)
        bed.wait(lambda: bed.status("robot4")["quorum"]["alive"] == 4, 60, "all four electors")
        # a document is agreed: the survivor goes on by it, and who joins again fetches it, signed
        done(bed, "robot4", "apply", str(bed.file), "--yes")
        document = bed.wait(lambda: bed.status("robot4")["document"], 60, "the document")
        done(bed, "robot4", "move", TASK, "robot1", "--yes")
        bed.wait(lambda: bed.owner() == "robot1", 60, "the task on robot1")

        for name in DEAD:
            bed.kill(name)
        bed.wait(lambda: not bed.status("robot4")["quorum"]["ok"], 60, "the quorum to be lost")
        bed.stop("robot4")
        # edge1 lives on and is asked, over TLS; without a certificate nobody would answer
        assert zsched(bed, "robot4", "fleet", "recover", "--plan").returncode == EXIT_WOULD_CHANGE
        assert "robot4 is the only elector of generation" in done(bed, "robot4", "fleet", "recover", *DANGERS, "--yes")
        bed.start("robot4")

        bed.wait(lambda: strangers(bed, "edge1") == {"robot4"}, 60, "edge1 to show who counts otherwise")
        bed.wait(lambda: strangers(bed, "robot4") == {"edge1"}, 60, "robot4 to show the stranger")
        bed.stop("edge1")
        assert "recovered by robot4 (robot4 count by it)" in done(bed, "edge1", "fleet", "recover", "--rejoin", "--yes")
        bed.start("edge1")
        bed.wait(lambda: bed.owner("robot4", "edge1") == "edge1", 90, "one elector to replace the dead owner")
        assert bed.task("robot4")["epoch"] > 2**32
        assert bed.status("edge1")["document"] == document, "it was fetched"

        # an old elector comes back with its old state, certificate and key
        bed.start("robot1")
        bed.wait(lambda: strangers(bed, "robot1") == {"robot4", "edge1"}, 60, "robot1 to show the strangers")
        bed.wait(lambda: strangers(bed, "robot4") == {"robot1"}, 60, "robot4 to show it, too")
        assert bed.owner("robot4", "edge1") == "edge1", "nothing crosses"
        bed.stop("robot1")
        done(bed, "robot1", "fleet", "recover", "--rejoin", "--yes")
        bed.start("robot1")
        three = ["edge1", "robot1", "robot4"]
        bed.wait(lambda: bed.status("robot4")["quorum"]["names"] == three, 90, "the electors to be three again")
        bed.wait(lambda: bed.status("robot1")["quorum"]["this_node"] == "elector", 60, "robot1 as an elector")
        bed.wait(lambda: bed.owner("robot1", "robot4", "edge1"), 60, "one owner")
        assert {name: refused(bed, name) for name in three} == {name: {} for name in three}, "members refuse no member"
        shown = json.loads(done(bed, "robot1", "status", "--json"))
        assert (shown["security"], shown["document"]) == ("secured", document)
