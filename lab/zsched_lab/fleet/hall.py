"""Machines of a fleet that is founded, joined and left by the verbs, as an operator gives them; each has its folders.

Knows: the verbs' environment, daemons as processes, their statuses. Does not know: what a test or a benchmark expects.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import ssl
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zsched.core.values.errors import AdapterError
from zsched.host.operator_client import ask
from zsched_lab.fleet.netbed import stop_group
from zsched_lab.fleet.netns import Network

LOG_LINES = 15
"""Of each daemon, where a verb has failed."""
FIRST_PORT, LAST_PORT, BLOCK = 21_000, 31_800, 40


def block_of_ports(count: int) -> int:
    """The first of ``count`` ports (at most `BLOCK`) in a row that nobody has now.

    Processes that look at the same time begin at different places, or they would find the same ones.

    Raises:
        AssertionError: there are none.
    """
    blocks = tuple(range(FIRST_PORT, LAST_PORT, BLOCK))
    begin = os.getpid() % len(blocks)
    for first in (*blocks[begin:], *blocks[:begin]):
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
    """Machines with folders of their own below one, on loopback or in ``network``; use as a context manager."""

    def __init__(self, folder: Path, network: Network | None = None) -> None:
        """Name the folder; nothing is started."""
        self.folder, self._network = folder, network
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def zsched(self, node: str, *words: str) -> str:
        """A verb on a node's machine; what it printed.

        Raises:
            AssertionError: it failed.
        """
        done = self.run(node, *words)
        if done.returncode != 0:
            told = f"zsched {' '.join(words)} on {node}: {done.stdout}{done.stderr}"
            raise AssertionError("\n".join((told, *(self._said(one) for one in self._daemons))))
        return done.stdout

    def _said(self, node: str) -> str:
        """What a node with a daemon says of the fleet, and the end of its log."""
        status = self.status(node)
        tasks = [(one["name"], one["owner"], one["revision"], one["phase"]) for one in status.get("tasks", ())]
        workers = [(one["name"], one["state"], one["workers"]) for one in status.get("nodes", ())]
        log = "\n".join(self.log(node).splitlines()[-LOG_LINES:])
        return f"{node}: {tasks}, {workers}, {status.get('quorum')}, {self.problems(node)}\n{log}"

    def run(self, node: str, *words: str) -> subprocess.CompletedProcess[str]:
        """A verb on a node's machine, whatever comes of it."""
        home = self.folder / node
        home.mkdir(exist_ok=True)
        more = {"CONFIG": home / "etc" / "fleet.yaml", "STATE_DIR": home / "state", "RUNTIME_DIR": home / "run"}
        env = {**os.environ, **{f"ZSCHED_{name}": str(path) for name, path in more.items()}, "ZSCHED_NODE": node}
        if words[0] != "leave":  # the stick is in whichever machine it is needed at, and none takes it away
            env["ZSCHED_AUTHORITY"] = str(self.folder / "stick")
        command = self._on(node, [sys.executable, "-m", "zsched.cli", *words])
        return subprocess.run(command, capture_output=True, text=True, timeout=90, check=False, env=env, cwd=home)

    def start(self, node: str) -> None:
        """Start a node's daemon."""
        home = self.folder / node
        (home / "run").mkdir(exist_ok=True)
        given = [f"--config={home / 'etc' / 'fleet.yaml'}", f"--node={node}"]
        given += [f"--state-dir={home / 'state'}", f"--runtime-dir={home / 'run'}"]
        with (home / "log").open("ab") as log:
            command = self._on(node, [sys.executable, "-m", "zsched.daemon", *given])
            self._daemons[node] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=log)

    def _on(self, node: str, command: list[str | Path]) -> list[str | Path]:
        return command if self._network is None else self._network.wrap(node, command)

    def power_off(self, node: str) -> None:
        """The machine is gone at once: in a network nobody sees its sockets close."""
        if self._network is not None:
            self._network.link(node, is_up=False)
        stop_group(self.pid(node), signal.SIGKILL)
        self._daemons.pop(node).wait(10)

    def stop(self, *nodes: str) -> None:
        """Stop daemons (default: all)."""
        for node in nodes or tuple(self._daemons):
            process = self._daemons.pop(node)
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def pid(self, node: str) -> int:
        """Of a daemon that runs.

        Raises:
            AssertionError: it has ended.
        """
        process = self._daemons[node]
        if process.poll() is not None:
            raise AssertionError(f"{node}: its daemon has ended with {process.returncode}: {self.log(node)}")
        return process.pid

    def ended(self, node: str, within_s: float) -> int:
        """The exit code of a daemon that ends by itself."""
        return self._daemons.pop(node).wait(within_s)

    def log(self, node: str) -> str:
        """What a node's daemons have written to stderr."""
        return (self.folder / node / "log").read_text(errors="replace")

    def status(self, node: str) -> dict[str, Any]:
        """A daemon's status; empty: it does not answer yet."""
        try:
            found: dict[str, Any] = ask(self.folder / node / "run" / f"{node}.sock", {"verb": "status"}, 3.0)
        except AdapterError:
            return {}
        return found

    def problems(self, node: str) -> list[str]:
        """The problems in a node's status."""
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
        """The nodes that a node takes for alive; empty: it does not answer yet."""
        return {str(one["name"]) for one in self.status(node).get("nodes", ()) if one["state"] == "alive"}
