"""A node gets another address while the fleet runs: those who dial it begin again by themselves, and hear it there."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path

import pytest

from support.operators import Operator
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

MOVER = "edge1"
"""Everybody else dials the first seed."""


def hear(bed: Testbed, node: str) -> bool:
    """Whether a node hears the one that has moved."""
    return any(one["name"] == MOVER and one["state"] == "alive" for one in bed.status(node)["nodes"])


def test_a_node_that_is_dialled_is_followed_to_its_new_address(tmp_path: Path) -> None:
    tree = {
        **echo_fleet(robots=2, edges=1, timing="wired"),
        "seeds": [MOVER],
        "electorate": [MOVER, "robot1", "robot2"],
    }
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        operator, file = Operator(bed), tmp_path / "agreed.yaml"
        file.write_text(json.dumps(tree, indent=1))
        operator.done("apply", file, "--yes")
        there = deepcopy(tree)
        there["nodes"][MOVER]["listen"] = {"control": free_endpoint(), "data": free_endpoint()}
        file.write_text(json.dumps(there, indent=1))
        operator.done("apply", file, "--yes")
        revision = bed.status("robot1")["fleet_revision"]
        bed.wait(lambda: all(bed.status(one)["fleet_revision"] == revision for one in bed.names), 60, "all know")
        said = bed.wait(lambda: " ".join(bed.status("robot1")["problems"]), 60, "what is open to be told")
        assert f"begins again by itself once it does not hear {MOVER} where it was" in said
        others = [name for name in bed.names if name != MOVER]
        lives = {name: (bed.pid(name), bed.status(name)["incarnation"]) for name in others}

        bed.kill(MOVER)  # the machine is carried elsewhere, and starts by the document that it has stored
        bed.start(MOVER)
        bed.wait(lambda: all(hear(bed, name) for name in others), 90, f"{MOVER} to be heard where it is now")
        bed.wait(lambda: all(bed.status(name)["incarnation"] > lives[name][1] for name in others), 60, "new lives")
        assert {name: bed.pid(name) for name in others} == {name: lives[name][0] for name in others}, "by themselves"
        bed.wait(lambda: not any("would be dialled" in one for one in bed.status("robot1")["problems"]), 60, "all told")
        bed.wait_settled(90)
