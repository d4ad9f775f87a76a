"""A fleet that is founded and joined by the verbs, as an operator gives them: secured from its first minute."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.waiting import until
from zsched.adapters.host.operator_socket import ask
from zsched.errors import AdapterError
from zsched.sessions.config import client_config

LOCAL_AFTER = 3


def block_of_ports(count: int) -> int:
    """The first of ``count`` ports in a row that nobody has now."""
    for first in range(21_000, 32_000, count):
        with contextlib.ExitStack() as stack:
            try:
                for port in range(first, first + count):
                    one = stack.enter_context(socket.socket())
                    one.bind(("127.0.0.1", port))
            except OSError:
                continue
            return first
    raise AssertionError("no free ports")


class Hall:
    """Two machines, each with folders of its own below one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}

    def zsched(self, node: str, *words: str) -> str:
        """A verb on a node's machine; what it printed.

        Raises:
            AssertionError: it failed.
        """
        home = self.folder / node
        home.mkdir(exist_ok=True)
        more = {"CONFIG": home / "etc" / "fleet.yaml", "STATE_DIR": home / "state", "RUNTIME_DIR": home / "run"}
        env = {**os.environ, **{f"ZSCHED_{name}": str(path) for name, path in more.items()}, "ZSCHED_NODE": node}
        env["ZSCHED_AUTHORITY"] = str(self.folder / "stick")
        command = [sys.executable, "-m", "zsched.cli", *words]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=env, cwd=home)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def start(self, node: str) -> None:
        home = self.folder / node
        (home / "run").mkdir(exist_ok=True)
        given = [f"--config={home / 'etc' / 'fleet.yaml'}", f"--node={node}"]
        given += [f"--state-dir={home / 'state'}", f"--runtime-dir={home / 'run'}"]
        with (home / "log").open("ab") as log:
            command = [sys.executable, "-m", "zsched.daemon", *given]
            self._daemons[node] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=log)

    def stop(self, *nodes: str) -> None:
        for node in nodes or tuple(self._daemons):
            process = self._daemons.pop(node)
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def pid(self, node: str) -> int:
        process = self._daemons[node]
        assert process.poll() is None
        return process.pid

    def status(self, node: str) -> dict[str, Any]:
        """A daemon's status; empty: it does not answer yet."""
        try:
            return ask(self.folder / node / "run" / f"{node}.sock", {"verb": "status"}, 3.0)
        except AdapterError:
            return {}

    def problems(self, node: str) -> list[str]:
        return [str(one) for one in self.status(node).get("problems", ())]

    def certificate(self, node: str) -> str:
        """The one that was sent to a node, DER as text of bytes."""
        return ssl.PEM_cert_to_DER_cert((self.folder / node / "state" / "pki" / "certificate.pem").read_text()).hex()

    def presented(self, port: int) -> str:
        """With which certificate a session listens; empty: with none."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        try:
            with socket.create_connection(("127.0.0.1", port), 2.0) as plain, context.wrap_socket(plain) as link:
                return (link.getpeercert(binary_form=True) or b"").hex()
        except OSError:
            return ""

    def alive(self, node: str) -> set[str]:
        return {str(one["name"]) for one in self.status(node).get("nodes", ()) if one["state"] == "alive"}


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    one = Hall(tmp_path)
    yield one
    one.stop()


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
        zenoh.open(zenoh.Config.from_json5(client_config(connect=(f"tcp/127.0.0.1:{port}",), patience_s=0.4)))
    local = hall.status("robot1")["joins_at"]
    assert local == [f"tcp/127.0.0.1:{port + LOCAL_AFTER}"]
    with zenoh.open(zenoh.Config.from_json5(client_config(connect=tuple(local), patience_s=20.0))) as session:
        until(session.info.links, "an application at the local side")
    hall.zsched("robot1", "pki", "renew", "robot2", "--deliver")
    hall.zsched("robot1", "pki", "renew", "robot1", "--deliver")
    assert hall.certificate("robot1") not in hall.presented(port), "its open session listens with the first one"
    text = hall.zsched("robot1", "fleet", "export")
    (hall.folder / "revoked.yaml").write_text(text.replace("security: {}", "security: {revoked: [robot2]}"))
    hall.zsched("robot1", "apply", str(hall.folder / "revoked.yaml"), "--yes")
    until(lambda: hall.alive("robot1") == {"robot1"}, "the open session of a revoked key to end")
    until(lambda: any("`security: revoked`" in one for one in hall.problems("robot2")), "robot2 to say why it stays")
    assert hall.pid("robot1") == daemon
    until(lambda: hall.certificate("robot1") in hall.presented(port), "the renewed certificate to be listened with")
    assert hall.certificate("robot2"), "it is sent to who has no authority, too"

    checks = json.loads(hall.zsched("robot1", "pki", "show", "--json"))["certificates"]
    assert [(one["name"], one["state"]) for one in checks] == [("robot1", "valid"), ("robot2", "valid")]
