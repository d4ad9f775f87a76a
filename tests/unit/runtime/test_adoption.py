"""A running daemon's adapters follow another fleet file as far as they can at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from support.fleets import fleet_of, task_of
from zsched.core.values import instructions as do
from zsched.core.values.certificates import Holder
from zsched.core.values.fleet import Fleet, Security, StreamRule, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.plan import Direction, ReadyWhen
from zsched.core.values.relay_protocol import TaskEnded, WorkerWatch
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.limits import limit_for
from zsched.link.pipe.protocol import RelayHello
from zsched.link.pipe.relay_socket import PROTOCOL
from zsched.link.sessions.endpoints import endpoints_for
from zsched.runtime.adoption import Adoption
from zsched.runtime.inbox import Inbox
from zsched.runtime.relay.streams import RelayHandle
from zsched.runtime.shell import Shell

SECURITY = Security(folder="pki")
RULE = StreamRule(direction=Direction.INPUT, from_template="scan", to_template="{target}/scan")
FLEET = fleet_of(of=("robot1", "robot2"), tasks=(), security=SECURITY)


def adoption_of(fleet: Fleet, **parts: Any) -> Adoption:
    others = ("recipes", "crew", "supervisor", "relay", "bus", "post", "sampler", "compare_sessions")
    return Adoption(
        me="robot1",
        here=InForce(fleet),
        started_with=fleet,
        points=endpoints_for(fleet, fleet.node("robot1"), lambda: 7458, protocol="tls"),
        protocol="tls",
        **{name: parts.get(name, Mock()) for name in others},
    )


@pytest.mark.parametrize(
    ("new", "then"),
    [
        (replace(FLEET, security=replace(SECURITY, revoked=("robot2",))), ["robot1", "robot2.k2"]),
        (fleet_of(of=("robot1",), tasks=(), security=SECURITY), ["robot1"]),
    ],
    ids=["a revoked key", "a node that is gone"],
)
def test_orders_count_by_the_fleet_in_force_before_sessions_are_opened_anew(new: Fleet, then: list[str]) -> None:
    bus, compared = Mock(), Mock()
    adoption = adoption_of(FLEET, bus=bus, compare_sessions=compared)
    adoption.follow(new)
    (holders,) = bus.take_orders_of.call_args.args
    assert sorted(one.label for one in holders) == then
    assert Holder(name="robot1") in holders
    compared.assert_called_once_with(True, ())  # it begins anew in its turn


def test_what_a_peer_may_send_follows_the_tasks_that_come() -> None:
    """A fleet begins without a task: with the room for none, a vote about fifty would be taken for a flood."""
    inbox = Inbox()
    bus = ControlBus(
        fleet="test",
        node="robot1",
        incarnation=1,
        zenoh_config="{}",
        post=inbox.post,
        limit=limit_for(FLEET.timing, 0),
        names=("robot1", "robot2"),
    )
    tasks = tuple(task_of(f"t{number}", ("robot1",)) for number in range(50))
    adoption_of(FLEET, bus=bus).follow(replace(FLEET, tasks=tasks))
    assert bus._buckets is not None
    wanted = limit_for(FLEET.timing, 50)
    for buckets in bus._buckets.values():
        assert sum(buckets.take("robot2", 0.0) for _ in range(2000)) == int(wanted.burst)


@pytest.mark.parametrize("is_another_file", [False, True], ids=["the same file", "another file"])
def test_a_task_that_was_removed_and_added_again_is_watched_again(is_another_file: bool) -> None:
    """The relay forgets the watch with the task of before; without it no worker is seen to be ready by matching."""
    task = task_of(worker=WorkerSpec(ready_when=ReadyWhen.MATCHING), candidates=("robot1",), rules=(RULE,))
    fleet = fleet_of(task, of=("robot1", "robot2"))
    relay = RelayHandle(
        hello=RelayHello(protocol=PROTOCOL, fleet="hall", node="robot1", threads=6),
        path=Path("relay"),
        zenoh_config="{}",
        on_report=Mock(),
    )
    adoption = adoption_of(fleet, relay=relay)
    shell = Shell(node="robot1", inbox=Inbox(), bus=Mock(), state_file=Mock(), desk=Mock())
    shell.relay, shell.follow, shell.end = relay, adoption.follow, adoption.end
    adoption.begin()
    told = [frame for frame in relay._outbox.items.values() if isinstance(frame, WorkerWatch)]
    assert [one.task for one in told] == ["merge"]
    more = (do.AdoptFleet(fleet=replace(fleet, zenoh_config="z.json5")),) if is_another_file else ()
    shell.carry_out((*more, do.EndTask(task="merge")))
    assert list(relay._outbox.items.values())[-1] == told[0], "behind the end of the task"
    shell.carry_out((do.AdoptFleet(fleet=fleet_of(of=("robot1", "robot2"), tasks=())), do.EndTask(task="merge")))
    assert list(relay._outbox.items.values())[-1] == TaskEnded(task="merge"), "a task that is gone is watched no more"
