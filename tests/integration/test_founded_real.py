"""A fleet that is founded and joined by the verbs, as an operator gives them: secured from its first minute."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from support.waiting import until
from zsched.core.values.exits import EXIT_LEFT
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports

LOCAL_AFTER = 3


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    with Hall(tmp_path) as one:
        yield one


def test_two_machines_are_a_secured_fleet_by_four_commands_and_nobody_restarts_a_daemon(hall: Hall) -> None:
    port = block_of_ports(20)
    hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}")
    hall.start("robot1")
    until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
    hall.zsched("robot2", "join", "--request", "robot2")
    request = hall.folder / "robot2" / "robot2.csr"
    words = ("--address", f"127.0.0.1:{port + 10}", "--csr", str(request), "--yes")
    (hall.folder / "robot2.invite").write_text(hall.zsched("robot1", "invite", "robot2", *words))
    daemon = hall.pid("robot1")
    hall.zsched("robot2", "join", str(hall.folder / "robot2.invite"))
    hall.start("robot2")
    for node in ("robot1", "robot2"):
        until(lambda node=node: hall.alive(node) == {"robot1", "robot2"}, f"both at {node}")  # type: ignore[misc]
        assert hall.status(node)["security"] == "secured"
    assert hall.pid("robot1") == daemon, "the same process has begun anew, to let the new node in"
    assert "sessions node=robot1 are opened anew" in (hall.folder / "robot1" / "log").read_text()

    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh.Config.from_json5(client_config(connect=(f"tcp/127.0.0.1:{port}",), connect_s=0.4)))
    local = hall.status("robot1")["joins_at"]
    assert local == [f"tcp/127.0.0.1:{port + LOCAL_AFTER}"]
    with zenoh.open(zenoh.Config.from_json5(client_config(connect=tuple(local), connect_s=20.0))) as session:
        until(session.info.links, "an application at the local side")
    hall.zsched("robot1", "pki", "renew", "robot2", "--deliver")
    assert hall.certificate("robot2"), "it is sent to who has no authority, too"
    first = hall.presented(port)
    hall.zsched("robot1", "pki", "renew", "robot1", "--deliver")
    assert hall.certificate("robot1") != first, "it is another one, and its session still listens with the first"
    until(lambda: hall.certificate("robot1") == hall.presented(port), "the renewed certificate to be listened with")
    until(lambda: hall.alive("robot1") == {"robot1", "robot2"}, "both, begun anew")
    text = hall.zsched("robot1", "fleet", "export")
    (hall.folder / "revoked.yaml").write_text(text.replace("security: {}", "security: {revoked: [robot2]}"))
    hall.zsched("robot1", "apply", str(hall.folder / "revoked.yaml"), "--yes")
    until(lambda: hall.alive("robot1") == {"robot1"}, "the open session of a revoked key to end")
    until(lambda: any("`security: revoked`" in one for one in hall.problems("robot2")), "robot2 to say why it stays")
    assert hall.pid("robot1") == daemon

    checks = json.loads(hall.zsched("robot1", "pki", "show", "--json"))["certificates"]
    assert [(one["name"], one["state"]) for one in checks] == [("robot1", "valid"), ("robot2", "valid")]


@pytest.mark.long
def test_a_machine_whose_invitation_was_lost_and_that_leaves_later_comes_in_by_the_next_one(hall: Hall) -> None:
    port = block_of_ports(20)
    hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}")
    hall.start("robot1")
    until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
    address = ("--address", f"127.0.0.1:{port + 10}")
    invited = ("invite", "robot2", "--yes")
    file = hall.folder / "robot2.invite"
    file.write_text(hall.zsched("robot1", *invited, *address))
    for more in ((), address):
        file.write_text(hall.zsched("robot1", *invited, *more))
        hall.zsched("robot2", "join", str(file))
        hall.start("robot2")
        for node in ("robot1", "robot2"):
            until(lambda node=node: hall.alive(node) == {"robot1", "robot2"}, f"both at {node}")  # type: ignore[misc]
        if more != address:
            hall.zsched("robot2", "leave", "--yes")
            assert hall.ended("robot2", 20) == EXIT_LEFT
            until(lambda: hall.alive("robot1") == {"robot1"}, "robot1 alone")
    assert "revoked: [robot2, robot2.k2]" in hall.zsched("robot1", "fleet", "export")
