"""What is told of sessions that are to be opened anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from random import Random

from support.fleets import fleet_of, task_of
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values.fleet import Security, electorate_hash
from zsched.link.sessions.endpoints import Endpoints
from zsched.runtime.session_watch import SESSIONS, SessionWatch

NOWHERE = Endpoints(
    control_listen=(),
    control_connect=(),
    data_listen=(),
    data_connect=(),
    worker_connect=(),
    control_by_gossip=False,
    data_by_gossip=False,
    worker_by_gossip=False,
)


def test_that_sessions_cannot_be_opened_anew_is_no_problem_any_more_once_nobody_wants_it(tmp_path: Path) -> None:
    """The file here has a fault; then the fleet is what the sessions were opened by again. It was told for good."""
    fleet = fleet_of(task_of(candidates=("edge1",)), of=("edge1", "robot1"), electors=("robot1",))
    fleet = replace(fleet, security=Security(folder=str(tmp_path)))
    electorate = electorate_hash(fleet)
    node = Node(fleet=fleet, me="edge1", durable=None, incarnation=7, electorate=electorate, rng=Random(1), now=0.0)
    node.start(0.0)
    told: list[ev.Event] = []
    watch = SessionWatch(
        fleet,
        fleet.node("edge1"),
        NOWHERE,
        certificate="",
        config=tmp_path / "fleet.yaml",
        state_dir=tmp_path,
        post=told.append,
    )
    watch.note(True, ())
    assert not any(watch.is_due(node, float(now)) for now in range(1, 400))
    for event in told:
        node.handle(event, 400.0)
    assert "cannot be opened anew" in node.problems[SESSIONS, ""]
    watch.note(False, ())
    assert not watch.is_due(node, 401.0)
    assert (SESSIONS, "") not in node.problems
