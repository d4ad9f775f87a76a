"""Electors die one after another on real daemons: others follow them, and the task goes on down to two electors."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

from zsched.core.values.document import Document, Text
from zsched.core.values.messages import ChangeFleet, CommandOutcome, CommandResult
from zsched.link.bus.fleet_client import FleetClient
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long


def adopt(bed: Testbed) -> None:
    """Agree the file as the fleet's document."""
    spec = bed.fleet.node("robot1")
    endpoint = spec.control_at
    config = zenoh_config.client_config(connect=(endpoint,), timing=bed.fleet.timing)
    client = FleetClient(endpoint, config, "operator")
    try:
        answer = client.ask("robot1", ChangeFleet(document=Document(text=Text(bed.file.read_text()))))
    finally:
        client.close()
    assert isinstance(answer, CommandResult)
    assert answer.outcome is CommandOutcome.OK, answer.detail


def test_electors_die_one_after_another_and_the_task_goes_on_down_to_two(tmp_path: Path) -> None:
    tree = {**echo_fleet(edges=2), "replace_s": 1, "away_s": 2}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        adopt(bed)

        def quorum(node: str) -> dict[str, Any]:
            found: dict[str, Any] = bed.status(node)["quorum"]
            return found

        every = ["edge1", "edge2", "robot1", "robot2", "robot3"]
        bed.wait(lambda: quorum("robot3")["names"] == every, 60, "the two edges to become electors")
        assert quorum("robot3")["number"] == 4, "the document's, and one for each"

        bed.kill("robot1")
        bed.wait(lambda: quorum("robot3")["names"] == every[:2] + every[3:], 60, "robot1 to be removed")
        bed.kill("robot2")
        bed.wait(lambda: quorum("robot3")["names"] == ["edge1", "edge2", "robot3"], 60, "robot2 to be removed")
        bed.wait(lambda: quorum("robot3")["away"] == ["robot1", "robot2"], 60, "who is away")
        assert bed.owner("robot3") == owner, "the task has not moved"

        bed.kill(owner)
        other = "edge2" if owner == "edge1" else "edge1"
        bed.wait(lambda: bed.owner("robot3") == other, 60, "two electors of three, and one robot of three, to decide")
        bed.wait(lambda: "no node is fit" in quorum("robot3")["pilot"], 60, "why the dead one stays an elector")
        assert "robot1 is no elector any more" in bed.log("robot3"), "every node's log has that"
        told = "".join(bed.log(name) for name in every)
        assert "robot1 is removed as an elector: gone for " in told, "the proposer's has the reason"


def test_every_original_elector_is_replaced_while_one_of_them_sleeps(tmp_path: Path) -> None:
    tree = {**echo_fleet(edges=4), "replace_s": 1, "away_s": 2}
    edges = ["edge1", "edge2", "edge3", "edge4"]
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        adopt(bed)

        def quorum(node: str) -> dict[str, Any]:
            found: dict[str, Any] = bed.status(node)["quorum"]
            return found

        bed.wait(lambda: len(quorum("edge1")["names"]) == 5, 60, "five electors")
        number = quorum("robot3")["number"]
        bed.send("robot3", signal.SIGSTOP)
        bed.wait(lambda: "robot3" not in quorum("edge1")["names"], 60, "the sleeper to be replaced")
        for dead in ("robot1", "robot2"):
            bed.kill(dead)
            bed.wait(lambda dead=dead: dead not in quorum("edge1")["names"], 90, f"{dead} to be replaced")  # type: ignore[misc]
        bed.wait(lambda: quorum("edge1")["names"] == edges, 90, "edges alone to agree")

        bed.send("robot3", signal.SIGCONT)
        bed.wait(lambda: quorum("robot3")["number"] == quorum("edge1")["number"], 60, "the sleeper to learn all of it")
        assert quorum("robot3")["number"] >= number + 3
        bed.wait(lambda: bed.owner("robot3", "edge1"), 60, "one owner")
        bed.kill(owner)
        living = [name for name in edges if name != owner]
        bed.wait(lambda: bed.owner("robot3", *living) in living, 90, "the one robot and the new electors to decide")
