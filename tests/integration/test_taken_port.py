"""A node whose data port another program has: its daemon names it, and goes on by itself once the port is free."""

from __future__ import annotations

import socket
from pathlib import Path

from zsched_lab.fleet.testbed import Testbed, echo_fleet

WAIT_S = 40.0


def test_a_taken_data_port_is_named_in_log_and_status_and_used_once_it_is_free(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        endpoint = bed.fleet.node("robot1").listen_data
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        with socket.socket() as other:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            other.bind((host, int(port)))
            other.listen()
            bed.init()
            bed.start()

            def named() -> str:
                told = (one for one in bed.status("robot1")["problems"] if one.startswith("relay: "))
                return next((one for one in told if endpoint in one), "")

            problem = bed.wait(named, WAIT_S, "the port among the problems")
            assert "another program has that port" in problem
            assert f"sport = :{port}" in problem
            bed.wait(lambda: f"cannot listen on {endpoint}" in bed.log("robot1"), WAIT_S, "the same in the log")
            assert "reset by peer" not in bed.log("robot1")
        assert bed.wait_settled(WAIT_S) == "robot1"
        assert not [one for one in bed.status("robot1")["problems"] if one.startswith("relay: ")]
