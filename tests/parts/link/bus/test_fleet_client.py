"""A client of one node's control endpoint, over real zenoh: questions are asked again, orders are given once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from support.snapshots import SNAPSHOT
from support.waiting import free_endpoint, until
from zsched.core.values import events as ev
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Timing
from zsched.core.values.messages import CommandOutcome, CommandResult, MoveTask, RestartTask
from zsched.core.values.model import Asked
from zsched.core.values.struct import replace
from zsched.link.bus import fleet_client
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.fleet_client import FleetClient
from zsched.link.sessions.config import client_config, control_config

MOVE = MoveTask(task="merge", node="edge1", asked=Asked(by="ada@laptop"), base_revision=3)
DONE = CommandResult(outcome=CommandOutcome.OK, detail="done", revision=4)


class There:
    """The bus of node ``b``: it tells its status at once, and answers orders when it is told to."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.orders: list[ev.MoveCommanded] = []
        self.status = SNAPSHOT
        self.asked = 0
        self.is_deaf = False
        """To questions for its status."""
        config = control_config(listen=(self.endpoint,), connect=(), timing=Timing())
        self.bus = ControlBus(fleet="f", node="b", incarnation=1, zenoh_config=config, post=self._post)

    def _post(self, event: ev.Event) -> None:
        if isinstance(event, ev.StatusAsked):
            self.asked += 1
            if not self.is_deaf:
                self.bus.answer(event.request, self.status)
        elif isinstance(event, ev.MoveCommanded):
            self.orders.append(event)


@pytest.fixture
def there() -> Iterator[There]:
    made = There()
    made.bus.open()
    try:
        yield made
    finally:
        made.bus.close()


@pytest.fixture
def client(there: There) -> Iterator[FleetClient]:
    made = FleetClient(there.endpoint, client_config(connect=(there.endpoint,), timing=Timing()), "laptop")
    try:
        yield made
    finally:
        made.close()


def test_an_order_whose_end_takes_long_is_given_once(
    there: There, client: FleetClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second copy would carry the old revision: a conflict, though the first was agreed."""
    monkeypatch.setattr(fleet_client, "ROUND_S", 0.3)
    answers: list[Any] = []
    asking = threading.Thread(target=lambda: answers.append(client.ask("b", MOVE)))
    asking.start()
    until(lambda: there.orders, "the order")
    asking.join(4 * fleet_client.ROUND_S)
    assert asking.is_alive(), "it waits for the end of its order"
    there.bus.answer(there.orders[0].request, DONE)
    asking.join(60)
    assert (answers, len(there.orders)) == ([DONE], 1)


def test_an_order_that_nobody_tells_the_end_of_may_have_been_carried_out(
    there: There, client: FleetClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_client, "ANSWER_S", 1.0)
    monkeypatch.setattr(fleet_client, "ROUND_S", 0.3)
    with pytest.raises(AdapterError, match=r"^b did not answer within 1 s$") as silent:
        client.ask("b", MOVE)
    assert isinstance(silent.value.__cause__, TimeoutError)
    assert len(there.orders) == 1


def test_an_order_that_is_agreed_is_waited_for_as_long_as_its_node_waits(
    there: There, client: FleetClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_client, "ANSWER_S", 1.0)
    monkeypatch.setattr(fleet_client, "ROUND_S", 0.3)
    there.status = replace(SNAPSHOT, order_s=2.0)
    with pytest.raises(AdapterError, match=r"^b did not answer within 2 s$"):
        client.ask("b", MOVE)
    with pytest.raises(AdapterError, match=r"^b did not answer within 1 s$"):
        client.ask("b", RestartTask(task="merge"))  # a node knows at once what becomes of it


def test_a_node_that_is_silent_is_given_no_order_and_its_status_is_asked_for_again(
    there: There, client: FleetClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_client, "ANSWER_S", 1.0)
    monkeypatch.setattr(fleet_client, "ROUND_S", 0.3)
    there.is_deaf = True
    with pytest.raises(AdapterError, match=r"^b did not answer within 1 s; is that a node's") as silent:
        client.ask("b", MOVE)
    assert silent.value.__cause__ is None
    assert (there.orders, there.asked > 1) == ([], True)
