"""Who may call itself an elector: lost state, twins, foreign fleet files, on real daemons."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from zsched.commands.members.blank import init_state
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.testbed import DAEMON, Testbed, TestbedError, echo_fleet

pytestmark = pytest.mark.long


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, echo_fleet(edges=1)) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_settled()
        yield testbed


def run_init(bed: Testbed, node: str, folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    verb = ("fleet", "recover") if more else ("init",)
    command = [sys.executable, "-m", "zsched.cli", *verb, "--config", str(bed.file), "--node", node]
    command += ["--state-dir", str(folder), *more]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def init_that_says(bed: Testbed, text: str, node: str, folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """The first that says so: nodes have a second to answer, which is too little on a busy machine."""
    found: list[subprocess.CompletedProcess[str]] = []

    def says() -> bool:
        if folder != bed.folder / node:
            shutil.rmtree(folder, ignore_errors=True)
        found.append(run_init(bed, node, folder, *more))
        return text in found[-1].stderr

    bed.wait(says, 60, f"{text!r} from init")
    return found[-1]


def test_init_refuses_a_name_that_the_fleet_remembers_as_a_voter(bed: Testbed) -> None:
    """robot3's disk is lost after it has voted: a blank state is refused, a new generation is not."""
    bed.wait(lambda: "robot3" in bed.status("robot1")["quorum"]["voted"], 60, "robot1 to remember robot3's vote")
    bed.kill("robot3")
    shutil.rmtree(bed.folder / "robot3")
    lost = bed.folder / "lost"
    refused = init_that_says(bed, "knows robot3 as an elector that has voted", "robot3", lost)
    assert refused.returncode == 1
    assert not (lost / "state").exists()
    edge = init_that_says(bed, "asked 3 other nodes, 2 answered\n", "edge1", bed.folder / "edge1-again")
    assert edge.returncode == 0, edge.stderr
    whose = run_init(bed, "robot3", bed.folder / "edge1-again")
    assert whose.returncode == 1
    assert "belongs to the node 'edge1'" in whose.stderr, "before anybody is asked"
    assert "has voted" not in whose.stderr


def test_a_new_generation_is_refused_while_the_fleet_agrees(bed: Testbed) -> None:
    """robot3 is down for a moment, with a good state: it asks the others, and keeps what it has."""
    bed.stop("robot3")
    before = (bed.folder / "robot3" / "state").read_bytes()
    agrees = "the fleet lives in generation 0 and agrees"
    refused = init_that_says(bed, agrees, "robot3", bed.folder / "robot3", "--generation", "1")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert (bed.folder / "robot3" / "state").read_bytes() == before
    bed.start("robot3")
    bed.wait(lambda: bed.status("robot3")["quorum"]["this_node"] == "elector", 60, "robot3 as the elector it was")


def test_a_new_generation_is_made_node_by_node_where_too_many_states_are_lost(bed: Testbed) -> None:
    """Two of three robots have lost theirs. Only the first elector with a good state needs --force, if it is first."""
    lost = ("robot1", "robot2")
    for node in lost:
        bed.kill(node)
        shutil.rmtree(bed.folder / node)
    bed.start()
    bed.wait(lambda: any("--generation 1" in one for one in bed.status("edge1")["problems"]), 60, "the way out")
    bed.stop()
    refused = run_init(bed, "robot3", bed.folder / "robot3", "--generation", "1")
    assert "good state of generation 0 here, and no other node answered" in refused.stderr
    for node in ("robot1", "edge1", "robot3", "robot2"):
        made = partial(run_init, bed, node, bed.folder / node, "--generation", "1")
        bed.wait(lambda: made().returncode == 0, 60, "a state")  # noqa: B023 - called at once
        bed.start(node)
        bed.wait(partial(bed.status, node), 60, f"{node} to answer")
    bed.wait_settled()
    assert bed.task("robot1")["epoch"] > 2**32
    # robot2 came last: the others may have agreed without it
    elector = bed.wait(lambda: bed.status("edge1")["quorum"]["voted"], 60, "somebody who is known to have voted")[0]
    again, voted = bed.folder / "again", f"knows {elector} as an elector that has voted"
    twice = init_that_says(bed, voted, elector, again, "--generation", "1")
    assert twice.returncode == 1, "it has voted in this generation"
    init_that_says(bed, "`zsched fleet recover --generation 2 --force` on every node", elector, again)


def test_the_advice_of_init_leads_to_a_fleet_that_agrees(bed: Testbed) -> None:
    """robot3's state folder is deleted: one refusal names every step, and none of them is refused."""
    bed.wait(lambda: "robot3" in bed.status("robot1")["quorum"]["voted"], 60, "robot1 to remember robot3's vote")
    bed.kill("robot3")
    shutil.rmtree(bed.folder / "robot3")
    refused = init_that_says(bed, "knows robot3 as an elector that has voted", "robot3", bed.folder / "lost")
    advice = re.search(r"stop every daemon, run `zsched fleet recover (.+)` on every node, and start", refused.stderr)
    assert advice is not None, refused.stderr
    bed.stop()
    for node in bed.names:
        done = run_init(bed, node, bed.folder / node, *advice[1].split())
        assert done.returncode == 0, (node, done.stderr)
    bed.start()
    bed.wait_settled()

    def agrees(node: str) -> bool:
        quorum = bed.status(node)["quorum"]
        return (quorum["alive"], quorum["stateless"], quorum["apart"]) == (3, [], [])

    bed.wait(lambda: all(agrees(node) for node in bed.names), 60, "every node to count all of them")
    assert bed.task("robot1")["epoch"] > 2**32


def test_an_elector_of_another_generation_is_not_counted_and_comes_back_by_what_status_says(bed: Testbed) -> None:
    """The operator has stopped half-way: robot3 alone is of the new generation."""
    bed.stop("robot3")
    made = run_init(bed, "robot3", bed.folder / "robot3", "--generation", "1", "--force")
    assert made.returncode == 0, made.stderr
    bed.start("robot3")
    bed.wait(lambda: bed.status("robot1")["quorum"]["apart"] == ["robot3"], 60, "robot1 to leave robot3 out")
    assert bed.status("robot1")["quorum"]["alive"] == 2
    assert not bed.wait(lambda: bed.status("robot3"), 60, "robot3")["quorum"]["ok"], "it is alone"

    def told() -> re.Match[str] | None:
        said = "\n".join(bed.status("robot1")["problems"])
        return re.search(r"stop this daemon, `zsched fleet recover (.+)` here, start it", said)

    advice = bed.wait(told, 90, "the advice, once it has been so for a minute")
    assert advice is not None
    for node in ("robot1", "robot2", "edge1"):
        bed.stop(node)
        done = partial(run_init, bed, node, bed.folder / node, *advice[1].split())
        bed.wait(lambda: done().returncode == 0, 60, "a state")  # noqa: B023 - called at once
        bed.start(node)
    bed.wait(lambda: bed.status("robot1")["quorum"]["alive"] == 3, 60, "three electors of one generation")
    bed.wait_settled()


def test_init_without_a_reachable_node_goes_on(tmp_path: Path) -> None:
    """A fleet's first machine has nobody to ask, and does not wait long."""
    bed = Testbed(tmp_path, echo_fleet())
    done = run_init(bed, "robot1", tmp_path / "robot1")
    assert done.returncode == 0
    assert "asked 5 other nodes: none answered" in done.stderr


def words_of_twin(bed: Testbed, node: str, file: Path, timeout: float) -> str:
    """What a second daemon of a name says until it leaves with 75."""
    folders = ("--state-dir", str(bed.folder / "twin"), "--runtime-dir", str(bed.folder / "twin-run"))
    command = [*DAEMON, "--config", str(file), "--node", node, *folders]
    twin = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert twin.returncode == 75, twin.stderr[-2000:]
    return twin.stderr


def test_second_machine_of_a_name_leaves_again_with_75(tmp_path: Path) -> None:
    """A daemon that finds its own name alive elsewhere exits 75; the one that was there stays an elector.

    Neither gives an address, so they meet by gossip, as everybody without one does. Twins of an address: chaos tests.
    """
    tree = echo_fleet(edges=1)
    for node in ("robot2", "edge1"):
        del tree["nodes"][node]["listen"], tree["nodes"][node]["host"]
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        init_state(bed.fleet, "robot2", bed.folder / "twin", 0)  # an operator who does not ask the fleet
        assert "another daemon calls itself 'robot2'" in words_of_twin(bed, "robot2", bed.file, 30)
        with suppress(TestbedError):
            bed.wait(lambda: bed.status("robot2")["quorum"]["this_node"] == "elector", 60, "robot2 as an elector")
        status = bed.status("robot2")
        assert status["quorum"]["this_node"] == "elector", status["problems"]


def test_another_fleet_file_is_shown(bed: Testbed) -> None:
    """One machine was forgotten when the file was changed: the others say so."""
    tree = json.loads(bed.file.read_text())
    tree["tasks"]["echo"]["scheduling"]["bonus"] = 0.2
    bed.stop("edge1")
    bed.file.write_text(json.dumps(tree))
    bed.start("edge1")

    def told() -> bool:
        problems = bed.status("robot1")["problems"]
        return any("another fleet file" in one and f" of {bed.file.absolute()})" in one for one in problems)

    bed.wait(told, 60, "robot1 to notice")


def test_second_machine_that_only_the_others_hear_leaves_again_and_everybody_names_both(tmp_path: Path) -> None:
    """Its own file gives it another address, so no file has a way from one twin to the other."""
    tree = echo_fleet(edges=1)
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        tree["nodes"]["edge1"]["listen"] = {"control": free_endpoint(), "data": free_endpoint()}
        file = bed.folder / "twin.yaml"
        file.write_text(json.dumps(tree))
        assert "another daemon calls itself 'edge1': robot" in words_of_twin(bed, "edge1", file, 60)
        said = [one for one in bed.status("robot1")["problems"] if "2 daemons call themselves 'edge1'" in one]
        assert said, bed.status("robot1")["problems"]
        assert said[0].count("tcp/") == 2, said
        assert bed.task("robot1")["owner"] == "edge1"
