"""Two cells on loopback between which a stream crosses: hall-a gives, hall-b takes.

Knows: the two fleet files, an application at each end. Does not know: what is measured or tested.
"""

from __future__ import annotations

import threading
import time
from contextlib import AbstractContextManager
from typing import Any, Final

import zenoh

from zsched_lab.fleet.pace import at_pace
from zsched_lab.fleet.testbed import SCHEDULING, Json, Testbed, echo_fleet

GIVING, TAKING = "hall-a", "hall-b"
GIVER, TAKER = "to_hall_b", "from_hall_a"
SENT, CAME = "robot1/pose", "robot1/hall-a/robot1/pose"
COMMAND: Final = ("python", "-m", "zsched.tasks.crossing")
INPUT: Final[Json] = {"from": "{robot}/pose", "to": "{target}/to_hall_b/{robot}/pose", "class": "reliable"}
OUTPUT: Final[Json] = {
    "from": "{target}/from_hall_a/{epoch}/hall-a/**",
    "to": "{robot}/hall-a/**",
    "class": "reliable",
    "handover": "all",
}


def cell(name: str) -> Json:
    """A robot and two edges without a task; all three are electors."""
    tree = {**echo_fleet(robots=1, edges=2), "fleet": name, "tasks": {}}
    tree["electorate"] = sorted(tree["nodes"])
    return tree


def relays(tree: Json, *nodes: str) -> list[str]:
    """Where the relays of a cell's nodes (its edges) listen."""
    return [tree["nodes"][name]["listen"]["data"] for name in nodes or ("edge1", "edge2")]


def let_cross(here: Json, there: Json, *options: str, gateways: list[str] | None = None, **rule: Any) -> None:
    """Put the giver's task into one tree and the taker's into the other; ``rule``: more of the input rule."""
    give = ("give", there["fleet"], *(gateways or relays(there)), *options)
    here["tasks"][GIVER] = {**_task(*give), "inputs": [{**INPUT, **rule}]}
    there["tasks"][TAKER] = {**_task("take", here["fleet"]), "exclusive": True, "outputs": [OUTPUT]}


def _task(*words: str) -> Json:
    return {
        "candidates": {"kind": "edge"},
        "weights": {"cpu": 0.5, "memory": 0.5},
        "scheduling": dict(SCHEDULING),
        "worker": {"command": [*COMMAND, *words], "max_failures": 100},
    }


class Ends:
    """An application of hall-a that counts in its payloads, and one of hall-b that notes what comes."""

    def __init__(
        self, here: Testbed, there: Testbed, giving: zenoh.Session | None = None, taking: zenoh.Session | None = None
    ) -> None:
        """The sessions of the two applications are by default at the two robots' relays."""
        self.here, self.there = here, there
        self.samples: list[zenoh.Sample] = []
        self.sent = 0
        self._sending = threading.Lock()
        reader, writer = taking or there.app("robot1"), giving or here.app("robot1")
        self._subscriber = reader.declare_subscriber("robot1/hall-a/**", self.samples.append)
        self._publisher = writer.declare_publisher(
            SENT, congestion_control=zenoh.CongestionControl.BLOCK, encoding="text/plain"
        )

    @property
    def got(self) -> list[int]:
        """The numbers that came, in their order."""
        return [int(sample.payload.to_string()) for sample in tuple(self.samples)]

    def send(self, count: int = 1, pause_s: float = 0.0) -> None:
        """Put the next numbers."""
        for _ in range(count):
            with self._sending:
                self._publisher.put(str(self.sent), attachment=b"kept")
                self.sent += 1
            time.sleep(pause_s)

    def sending(self) -> AbstractContextManager[None]:
        """50 numbers a second meanwhile."""
        return at_pace(50.0, self.send)

    def flows(self, timeout_s: float = 60.0) -> None:
        """Wait until a number comes that is put from now on."""
        goal = self.sent
        self.send()
        self.there.wait(lambda: max(self.got, default=-1) >= goal, timeout_s, f"number {goal}")

    def settle(self, timeout_s: float = 30.0) -> None:
        """Wait until the newest number has come."""
        newest = self.sent - 1
        self.there.wait(lambda: newest in self.got, timeout_s, f"number {newest}")
