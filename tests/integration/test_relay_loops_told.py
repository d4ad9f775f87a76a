"""A robot whose relay ends again and again: every node's status says so.

The complaint ends when the first of the ends is a minute old (`tests/unit/core/profile/test_relay_ends.py`).
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

from zsched.core.profile.relay_ends import OFTEN
from zsched_lab.fleet.testbed import Testbed, echo_fleet

WAIT_S = 60.0


def test_a_relay_that_is_killed_again_and_again_is_a_problem_on_every_node(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=2, edges=1)) as bed:
        bed.init()
        bed.start()
        bed.wait_whole(WAIT_S)

        def told(node: str) -> list[str]:
            return [one for one in bed.status(node)["problems"] if one.startswith("the relay of robot2 has ended")]

        relays: list[int] = []

        def next_relay() -> int | None:
            relay = bed.relay_pid("robot2")
            return None if relay in relays else relay

        for _ in range(OFTEN):
            relay = bed.wait(next_relay, WAIT_S, "a relay")
            assert relay is not None
            assert not [one for node in bed.names for one in told(node)]
            relays.append(relay)
            os.kill(relay, signal.SIGKILL)
        bed.wait(lambda: all(told(node) for node in bed.names), 10.0, "the problem on every node")
        assert "its streams rest meanwhile: look at the log of zsched on robot2" in told("robot1")[0]
        assert bed.wait_settled(WAIT_S) == "edge1"
