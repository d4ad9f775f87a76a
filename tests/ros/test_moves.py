"""Real rclpy nodes on both sides of live moves: what they count themselves when the owner is moved and killed.

Between them and zsched's keys stands a bridge in the form of zenoh-bridge-ros2dds (``side/bridge.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from support.ros_fleet import EDGES, PYTHON, SIDE, Application, RosFleet
from support.verbs import move
from zsched_lab.fleet.testbed import TestbedError

TASK: dict[str, Any] = {
    "worker": {"command": [str(PYTHON), str(SIDE / "worker.py")], "ready": "matching", "start_deadline_s": 60},
    "demand": {"cpu_cores": 0.1, "memory_mb": 100},
    "ros2": {
        "bridge": "ros2dds",
        "inputs": [
            {"topic": "/chatter", "worker_topic": "/{target}/app/chatter", "class": "reliable"},
            {"topic": "/map", "worker_topic": "/{target}/app/map", "class": "latest"},
            {"topic": "/scan", "worker_topic": "/{target}/app/scan"},
            {"topic": "/image", "worker_topic": "/{target}/app/image"},
        ],
        "outputs": [
            {"topic": "/answers", "worker_topic": "/{target}/app/answers", "class": "reliable", "handover": "all"},
            {"topic": "/map_seen", "worker_topic": "/{target}/app/map_seen", "class": "latest"},
            {"topic": "/scan_seen", "worker_topic": "/{target}/app/scan_seen"},
            {"topic": "/image_seen", "worker_topic": "/{target}/app/image_seen"},
        ],
        "services": [{"service": "/now", "worker_service": "/{target}/app/now", "retry": True}],
        "actions": [{"action": "/fibonacci", "worker_action": "/{target}/app/fibonacci"}],
    },
}


MANAGED: dict[str, Any] = {
    "worker": {
        "driver": "ros2_lifecycle",
        "node": "/{target}/slam",
        "command": [str(PYTHON), str(SIDE / "managed.py")],
        "ready": "matching",
        "start_deadline_s": 60,
        "env": {"ROS_DOMAIN_ID": "7"},
    },
    "demand": TASK["demand"],
    "ros2": {
        "bridge": "ros2dds",
        "inputs": [{"topic": "/chatter", "worker_topic": "/{target}/chatter", "class": "reliable"}],
        "outputs": [{"topic": "/answers", "worker_topic": "/{target}/answers", "class": "reliable", "handover": "all"}],
    },
}
UNKNOWN, SUCCEEDED = 0, 4
"""Of `action_msgs/msg/GoalStatus`."""
KILLED = 100
"""What a killed owner may take along: two seconds of the application's words."""


@pytest.fixture
def stack(ros: Any) -> Iterator[ExitStack]:
    """Only where ROS is."""
    assert ros
    with ExitStack() as made:
        yield made


def other(owner: str) -> str:
    return next(one for one in EDGES if one != owner)


def wait(fleet: RosFleet, app: Application, condition: Callable[[], Any], what: str) -> None:
    """Until it holds; else with what the application has counted."""

    def looked() -> bool:
        fleet.assert_bridges_run()
        return bool(condition())

    try:
        fleet.bed.wait(looked, 60, what)
    except TestbedError as error:
        raise AssertionError(f"{what}: {app.summary()}") from error


def serves(fleet: RosFleet, app: Application, owner: str) -> None:
    """Every stream of the application is answered by this owner, for more than two seconds."""
    before = len(app.answers(owner))

    def is_whole() -> bool:
        told = app.told
        is_seen = all(one and one[-1][0] == owner for one in (told["maps"], told["scans"], told["images"]))
        return is_seen and told["calls"][-1:] == [owner] and len(app.answers(owner)) > before + 100

    wait(fleet, app, is_whole, f"{owner} answers all")


def goal(fleet: RosFleet, app: Application, order: int) -> dict[str, Any]:
    """Send one and wait until it is worked at; the application's account of it."""
    count = len(app.told["goals"])
    app.say(f"goal {order}")
    wait(fleet, app, lambda: len(app.told["goals"]) > count and app.told["goals"][count]["feedback"] > 3, "feedback")
    account: dict[str, Any] = app.told["goals"][count]
    return account


def result(fleet: RosFleet, app: Application, number: int) -> tuple[int, list[int]]:
    """(status, sequence) of the goal with this number."""
    wait(fleet, app, lambda: app.told["goals"][number]["status"] is not None, f"the result of goal {number}")
    account = app.told["goals"][number]
    return account["status"], account["result"]


def all_answered(fleet: RosFleet, app: Application) -> list[int]:
    """The application falls silent and has heard what will come: all numbers, as they came."""
    app.say("quiet")
    app.say("silent")
    wait(
        fleet,
        app,
        lambda: app.told["answers"][-1][1] == str(app.told["sent"]) and len(app.told["calls"]) == app.told["asked"],
        "the last answers",
    )
    return [int(number) for _, number in app.told["answers"]]


def test_an_application_goes_on_when_its_worker_is_moved_and_killed(stack: ExitStack, tmp_path: Path) -> None:
    fleet = RosFleet(stack, tmp_path, TASK)
    app = fleet.application()
    first = fleet.bed.wait(fleet.bed.owner, 60, "an owner") or ""
    second = other(first)
    wait(fleet, app, lambda: all(app.told["ready"].values()), "the service and the action are in the graph")
    for word in ("talk", "look", "ask"):
        app.say(word)
    goal(fleet, app, 5)
    serves(fleet, app, first)
    assert result(fleet, app, 0) == (SUCCEEDED, [0, 1, 1, 2, 3, 5, 8])

    move(fleet.bed, second)
    serves(fleet, app, second)
    heard = [int(number) for _, number in app.told["answers"]]
    assert heard == list(range(1, len(heard) + 1)), "a move by order loses and doubles nothing"

    goal(fleet, app, 50)
    fleet.kill(second)
    assert result(fleet, app, 1)[0] == UNKNOWN, "the next owner does not know the goal"
    serves(fleet, app, first)
    goal(fleet, app, 3)
    assert result(fleet, app, 2) == (SUCCEEDED, [0, 1, 1, 2, 3])

    heard = all_answered(fleet, app)
    assert heard == sorted(set(heard)), "in order, and none twice"
    lost = app.told["sent"] - len(heard)
    assert lost <= KILLED, lost
    assert "lost" not in app.told["calls"], "each call was answered: the rule says retry"
    assert [who for who, *_ in app.told["maps"]] == [first, second, first], "the latched map, published once"
    assert {tuple(seen) for _, *seen in app.told["maps"]} == {("3", "21")}
    assert {(int(size), int(crc)) for _, _, size, crc in app.told["images"]} == {(app.told["size"], app.told["crc"])}
    assert {size for *_, size in app.told["scans"]} == {"360"}


def test_a_managed_node_of_rclpy_is_active_at_the_owner_only(stack: ExitStack, tmp_path: Path) -> None:
    """The bridge gives `change_state` and `get_state` rmw_zenoh's keys, by which zsched leads a managed node."""
    fleet = RosFleet(stack, tmp_path, MANAGED, rmw_domain=7)
    app = fleet.application()
    first = fleet.bed.wait(fleet.bed.owner, 60, "an owner") or ""
    second = other(first)

    def states(edge: str) -> list[str]:
        """As the node on that machine has told them."""
        return [line.rsplit("state ", 1)[1] for line in fleet.bed.log(edge).splitlines() if f"{edge}: state " in line]

    app.say("talk")
    wait(fleet, app, lambda: len(app.answers(first)) > 50, "the owner's node is active and answers")
    wait(fleet, app, lambda: states(second) == ["inactive"], "the standby is configured, no more")
    move(fleet.bed, second)
    wait(fleet, app, lambda: len(app.answers(second)) > 50, "the new owner answers")
    wait(fleet, app, lambda: states(first) == ["inactive", "active", "inactive"], "the old owner is inactive again")
    assert states(second) == ["inactive", "active"]
    fleet.kill(second)
    had = len(app.answers(first))
    wait(fleet, app, lambda: len(app.answers(first)) > had + 50, "the first node is active again")
    heard = all_answered(fleet, app)
    assert heard == sorted(set(heard))
    assert app.told["sent"] - len(heard) <= 2 * KILLED, "a managed node hears nothing before it is active"
