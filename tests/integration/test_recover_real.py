"""Three of four electors are lost for good: one survivor begins anew, others change sides by word, electors return."""

from __future__ import annotations

import itertools
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.messages import CommandOutcome, CommandResult, MoveTask
from zsched.core.values.model import Asked, NodeId
from zsched.link.bus.fleet_client import FleetClient
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

DEAD: tuple[NodeId, ...] = ("robot1", "robot2", "robot3")
DANGERS = ("--accept", "old-electors-are-off", "--accept", "newest-may-be-lost")


def run(bed: Testbed, node: NodeId, *more: str) -> subprocess.CompletedProcess[str]:
    """Run the verb on a node whose daemon is stopped."""
    command = [sys.executable, "-m", "zsched.cli", "fleet", "recover", *more, "--config", str(bed.file), "--node", node]
    command += ["--state-dir", str(bed.folder / node)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def move(bed: Testbed, owner: NodeId) -> None:
    """Give the task to a node."""
    spec = bed.fleet.node("robot4")
    endpoint = spec.control_at
    client = FleetClient(endpoint, zenoh_config.client_config(connect=(endpoint,), timing=bed.fleet.timing), "operator")
    try:
        answer = client.ask("robot4", MoveTask(task=TASK, node=owner, asked=Asked(by="operator")))
    finally:
        client.close()
    assert isinstance(answer, CommandResult)
    assert answer.outcome in (CommandOutcome.OK, CommandOutcome.UNCHANGED), answer.detail


def problem_of(bed: Testbed, node: NodeId, other: NodeId) -> str:
    """What a node says of one that counts by another generation; empty: nothing."""
    told = [one for one in bed.status(node)["problems"] if one.startswith(f"generation/{other}: ")]
    return told[0] if told else ""


def says(bed: Testbed, node: NodeId, other: NodeId, words: tuple[str, ...]) -> bool:
    """Whether a node says all of that about one that counts by another generation."""
    return all(word in problem_of(bed, node, other) for word in words)


def test_a_survivor_recovers_the_fleet_and_an_old_elector_that_comes_back_changes_sides_by_word(tmp_path: Path) -> None:
    tree = {**echo_fleet(robots=4, edges=1, task={"candidates": ["robot1", "edge1"]}), "replace_s": 1, "away_s": 2}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        bed.wait(lambda: bed.status("robot4")["quorum"]["alive"] == 4, 60, "all four electors")
        move(bed, "robot1")
        bed.wait(lambda: bed.owner() == "robot1", 60, "the task on robot1")

        for name in DEAD:
            bed.kill(name)
        bed.wait(lambda: not bed.status("robot4")["quorum"]["ok"], 60, "the quorum to be lost")
        running = run(bed, "robot4")
        assert running.returncode == EXIT_FAILED
        assert "stop that daemon first" in running.stderr

        bed.stop("robot4")
        refused = run(bed, "robot4")
        assert refused.returncode == EXIT_FAILED
        assert "old-electors-are-off: robot1, robot2, robot3 decide no more" in refused.stderr
        assert run(bed, "robot4", "--plan").returncode == EXIT_WOULD_CHANGE
        assert run(bed, "robot4", *DANGERS).returncode == EXIT_USAGE, "off a terminal it takes --yes"
        done = run(bed, "robot4", *DANGERS, "--yes")
        assert done.returncode == EXIT_OK, done.stderr
        assert "robot4 is the only elector of generation" in done.stdout
        bed.start("robot4")

        # edge1 lives on, and stays on its side until its operator says otherwise
        bed.wait(lambda: "(recovered by robot4)" in problem_of(bed, "edge1", "robot4"), 60, "edge1 to say who")
        bed.wait(lambda: problem_of(bed, "robot4", "edge1"), 60, "robot4 to show the stranger")
        bed.stop("edge1")
        joined = run(bed, "edge1", "--rejoin", "--yes")
        assert joined.returncode == EXIT_OK, joined.stderr
        bed.start("edge1")
        bed.wait(lambda: bed.owner("robot4", "edge1") == "edge1", 60, "one elector to replace the dead owner")
        assert bed.task("robot4")["epoch"] > 2**32

        # an old elector comes back with its old state
        bed.start("robot1")
        bed.wait(lambda: problem_of(bed, "robot1", "robot4"), 60, "robot1 to show the stranger")
        bed.wait(lambda: problem_of(bed, "robot4", "robot1"), 60, "robot4 to show it, too")
        assert bed.owner("robot4", "edge1") == "edge1"
        assert bed.task("robot1")["owner"] == "robot1", "nothing crosses"
        bed.stop("robot1")
        joined = run(bed, "robot1", "--rejoin", "--yes")
        assert joined.returncode == EXIT_OK, joined.stderr
        bed.start("robot1")
        three = ["edge1", "robot1", "robot4"]
        bed.wait(lambda: bed.status("robot4")["quorum"]["names"] == three, 60, "the electors to be three again")
        bed.wait(lambda: bed.status("robot1")["quorum"]["this_node"] == "elector", 60, "robot1 as an elector")
        assert not problem_of(bed, "robot4", "robot1")
        bed.wait(lambda: bed.owner("robot1", "robot4", "edge1"), 60, "one owner")


def test_two_halves_that_were_both_recovered_show_each_other_and_stay_apart(tmp_path: Path) -> None:
    tree = {**echo_fleet(robots=4, edges=0, task={"candidates": ["robot1", "robot3"]}), "replace_s": 1, "away_s": 2}
    halves: tuple[tuple[NodeId, NodeId], ...] = (("robot1", "robot2"), ("robot3", "robot4"))
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        bed.stop()
        for survivor, other in halves:
            done = run(bed, survivor, *DANGERS, "--yes")
            assert done.returncode == EXIT_OK, done.stderr
            bed.start(survivor, other)
            bed.wait(partial(problem_of, bed, other, survivor), 60, f"{other} to see what {survivor} has recovered")
            bed.stop(other)
            joined = run(bed, other, "--rejoin", "--yes")
            assert joined.returncode == EXIT_OK, joined.stderr
            bed.start(other)
            bed.wait(lambda: bed.owner(survivor, other) == survivor, 60, f"the task on {survivor}")  # noqa: B023 - called here
            bed.stop(survivor, other)

        bed.start()
        for (here, beside), (there, behind) in (halves, halves[::-1]):
            for name, far in itertools.product((here, beside), (there, behind)):
                both = (f"(recovered by {there})", f"(recovered by {here})")
                bed.wait(partial(says, bed, name, far, both), 60, f"{name} to say who has recovered what of {far}")
        generations = [{bed.status(name)["quorum"]["generation_id"] for name in half} for half in halves]
        assert [len(one) for one in generations] == [1, 1]
        assert generations[0] != generations[1]
        for survivor, other in halves:
            bed.wait(lambda: bed.owner(survivor, other) == survivor, 60, f"{survivor} to do its half's task")  # noqa: B023 - called here
