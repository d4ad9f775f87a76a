"""A small real fleet for tests and benchmarks: daemons as processes on loopback, one of which can be killed or frozen.

Knows: fleet files, daemon processes, signals, waiting for a condition. Does not know: what is tested.

Everything that was started is gone when the context ends, whatever happened inside; an end without an error checks that
the relays' counters account for every sample. Workers die with their daemons; a
relay outlives one that crashed, so `Testbed.kill` ends it, too, unless its caller says otherwise.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import psutil
import zenoh

from zsched.commands.members.blank import init_state
from zsched.config.load import load_fleet
from zsched.core.hop.books import unaccounted
from zsched.core.values.errors import AdapterError, ZschedError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.plan import StreamCount
from zsched.host import paths as places
from zsched.host.operator_client import ask
from zsched.link.pipe.relay_socket import relay_pid
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.loopback import free_endpoint, own_address

DAEMON = (sys.executable, "-m", "zsched.daemon")
ECHO = ("python", "-m", "zsched.tasks.echo")
ASLEEP = (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP, psutil.STATUS_ZOMBIE)
TASK = "echo"
SCHEDULING: Mapping[str, float | str] = {
    "score": "paper",
    "bonus": 0.1,
    "price_s": 0.8,
}
"""All nodes share one machine, and the echo needs next to nothing. By service its CPU is worth the same everywhere, and
next to nothing while the machine is busy; what is left over still tells the nodes apart."""
POLL_S = 0.01
COUNTS_S = 30.0
"""A daemon that runs may take this long to tell its counters."""

Json = dict[str, Any]
T = TypeVar("T")


class TestbedError(ZschedError):
    """A condition did not come true in time; the message holds what was seen."""

    __test__ = False


def echo_fleet(
    *,
    robots: int = 3,
    edges: int = 3,
    timing: str = "wifi",
    scheduling: Mapping[str, float | str] | None = None,
    worker: tuple[str, ...] = ECHO,
    stream_class: str = "latest",
    weights: Mapping[str, float] | None = None,
    task: Mapping[str, Any] | None = None,
) -> Json:
    """A fleet file as plain data: robots and edges on loopback, one task with the echo worker on every edge."""
    names = [f"robot{i}" for i in range(1, robots + 1)] + [f"edge{i}" for i in range(1, edges + 1)]
    nodes = {
        name: {
            "kind": name.rstrip("0123456789"),
            "host": own_address(),
            "listen": {"control": free_endpoint(), "data": free_endpoint()},
            "wired": True,
        }
        for name in names
    }
    body: Json = {
        "candidates": {"kind": "edge" if edges else "robot"},
        "weights": dict(weights or {"cpu": 0.5, "memory": 0.5, "network": 0.0}),
        "scheduling": {**SCHEDULING, **(scheduling or {})},
        "worker": {"command": list(worker)},
        "inputs": [{"from": "{robot}/in", "to": "{target}/echo/{robot}/in", "class": stream_class}],
        "outputs": [
            {"from": "{target}/echo/{epoch}/{robot}/out", "to": "{robot}/out", "class": stream_class},
        ],
        **(task or {}),
    }
    return {"fleet": "testbed", "timing": timing, "nodes": nodes, "tasks": {TASK: body}}


class Testbed:
    """The daemons of one fleet file. Use as a context manager; nothing is started until `start`."""

    __test__ = False  # not a test class, whatever pytest thinks of its name

    def __init__(self, folder: Path, tree: Mapping[str, Any]) -> None:
        self.folder = folder
        self.file = folder / "fleet.yaml"
        self.file.write_text(json.dumps(tree, indent=1))  # JSON is YAML
        self.fleet: Fleet = load_fleet(self.file)
        self.code: dict[NodeId, Path] = {}
        """Where the package is that a node runs from its next start on; by default this one."""
        self._processes: dict[NodeId, subprocess.Popen[bytes]] = {}
        self._may_end: set[NodeId] = set()
        self._sessions: list[zenoh.Session] = []

    # --- processes ---------------------------------------------------------------------------------------------------

    def init(self, *nodes: NodeId) -> None:
        """Blank durable state for ``nodes`` (default: all)."""
        for node in nodes or self.names:
            init_state(self.fleet, node, self.folder / node, 0)

    @property
    def names(self) -> tuple[NodeId, ...]:
        """Every node of the fleet file, sorted."""
        return tuple(node.name for node in self.fleet.nodes)

    def start(self, *nodes: NodeId) -> None:
        """Start daemons (default: all that do not run); their stderr goes to ``<node>.log``."""
        for node in nodes or tuple(name for name in self.names if name not in self._processes):
            self._may_end.discard(node)
            with (self.folder / f"{node}.log").open("ab") as log:
                self._processes[node] = subprocess.Popen(
                    [*DAEMON, "--config", self.file, "--node", node, *self._folders(node)],
                    stdin=subprocess.DEVNULL,
                    stderr=log,
                    env={**os.environ, "OMP_NUM_THREADS": "1", **self._credentials(node), **self._code(node)},
                    cwd=self.code.get(node),  # `python -m` looks there first
                )

    def _credentials(self, node: NodeId) -> dict[str, str]:
        """Of a secured fleet: where the node's key and certificates are, as systemd would hand them over."""
        folder = self.folder / "pki" / node
        return {"CREDENTIALS_DIRECTORY": str(folder)} if folder.is_dir() else {}

    def _code(self, node: NodeId) -> dict[str, str]:
        return {"PYTHONPATH": str(self.code[node])} if node in self.code else {}

    def running(self) -> tuple[NodeId, ...]:
        """Whose daemons have been started and not stopped."""
        return tuple(self._processes)

    def _folders(self, node: NodeId) -> list[str | Path]:
        return ["--state-dir", self.folder / node, "--runtime-dir", self.folder]

    def send(self, node: NodeId, number: signal.Signals) -> None:
        """Send a signal to one daemon (not to its relay or workers)."""
        if number not in (signal.SIGSTOP, signal.SIGCONT):
            self._may_end.add(node)
        self._processes[node].send_signal(number)

    def kill(self, node: NodeId, *, with_relay: bool = True) -> None:
        """SIGKILL one daemon and reap it; its workers die with it, and its relay unless only the daemon crashes."""
        relay = self.relay_pid(node) if with_relay else None
        self.send(node, signal.SIGKILL)
        self._processes.pop(node).wait(10)
        if relay is not None:
            self._end_relay(node, relay)

    def let_end(self, *nodes: NodeId) -> None:
        """These daemons may end although nobody here tells them to, until they are started again."""
        self._may_end.update(nodes)

    def has_ended(self, node: NodeId) -> bool:
        """Whether a daemon that was told to stop has ended; it is forgotten then."""
        if self._processes[node].poll() is None:
            return False
        del self._processes[node]
        return True

    def relay_pid(self, node: NodeId) -> int | None:
        """The process id of a node's relay, whichever daemon started it."""
        return relay_pid(places.relay_path(self.folder, node))

    def _end_relay(self, node: NodeId, pid: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        deadline = time.monotonic() + 5.0
        while self.relay_pid(node) == pid and time.monotonic() < deadline:
            time.sleep(POLL_S)

    def stop(self, *nodes: NodeId, within_s: float = 30.0) -> dict[NodeId, tuple[int, float]]:
        """SIGTERM daemons (default: all that run) and wait; {node: (exit code, seconds)}."""
        stopping = {node: self._processes.pop(node) for node in nodes or tuple(self._processes)}
        start = time.monotonic()
        for process in stopping.values():
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)
        results = {}
        for node, process in stopping.items():
            try:
                code = process.wait(max(start + within_s - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait(90)  # a process that waits for a slow disk cannot be killed
            results[node] = (code, time.monotonic() - start)
        return results

    def pid(self, node: NodeId) -> int:
        """The process id of a running daemon."""
        return self._processes[node].pid

    def log(self, node: NodeId) -> str:
        """What a daemon has written to stderr so far."""
        return (self.folder / f"{node}.log").read_text(errors="replace")

    # --- looking -----------------------------------------------------------------------------------------------------

    def status(self, node: NodeId, timeout_s: float = 3.0) -> Json:
        """One daemon's status.

        Raises:
            AdapterError: it does not answer.
        """
        answer = ask(places.socket_path(self.folder, node), {"verb": "status"}, timeout_s)
        if "error" in answer:
            raise AdapterError(str(answer["error"]))
        return answer

    def weigh(self, node: NodeId, cpu: float) -> Json:
        """Have a node change the task's weights, to ``cpu`` and the rest for memory; its answer."""
        told = self.task(node)
        weights = {"cpu": cpu, "memory": round(1.0 - cpu, 6), "network": 0.0}
        request = {"verb": "tune", "task": TASK, "by": f"test@{node}", "base_revision": told["revision"]}
        request["tuning"] = {**told["tuning"], "weights": weights}
        return ask(places.socket_path(self.folder, node), request, 5.0)

    def task(self, node: NodeId) -> Json:
        """The first task's block in one daemon's status."""
        found: Json = self.status(node)["tasks"][0]
        return found

    def counts(self, node: NodeId) -> tuple[StreamCount, ...]:
        """What one daemon's relay has counted, of all tasks."""
        streams = [stream for task in self.status(node)["tasks"] for stream in task["streams"]]
        return tuple(StreamCount(**{**stream, "drops": tuple(sorted(stream["drops"].items()))}) for stream in streams)

    def unaccounted(self) -> list[str]:
        """Input streams whose counters do not account for every sample (`zsched.core.hop.books`); none, at any time.

        Also daemons that tell no counters, although they neither have ended nor stand still.
        """
        found: list[str] = []
        for node in self.running():
            try:
                counts = self._counts_if_awake(node)
            except AdapterError as error:
                found.append(f"{node}: no counters: {error}")
            else:
                found += [f"{node}: {missing} unaccounted: {one}" for one in counts if (missing := unaccounted(one))]
        return found

    def _counts_if_awake(self, node: NodeId) -> tuple[StreamCount, ...]:
        """Its counters, once it answers; none of a daemon that has ended or stands still."""
        deadline = time.monotonic() + COUNTS_S
        while self._is_awake(node):
            try:
                return self.counts(node)
            except AdapterError:  # it may have just started, or be busy
                if time.monotonic() > deadline:
                    raise
            time.sleep(POLL_S)
        return ()

    def _is_awake(self, node: NodeId) -> bool:
        if self._processes[node].poll() is not None:
            return False
        with contextlib.suppress(psutil.Error):
            return psutil.Process(self.pid(node)).status() not in ASLEEP
        return False

    def owner(self, *nodes: NodeId) -> NodeId | None:
        """The owner that ``nodes`` (default: all running) agree on, settled on every robot; else ``None``."""
        blocks = [self.task(node) for node in nodes or tuple(self._processes)]
        owners = {(block["owner"], block["epoch"]) for block in blocks}
        is_settled = all(block["phase"] in {"settled", "idle"} for block in blocks)
        return owners.pop()[0] if len(owners) == 1 and is_settled else None

    def wait(self, condition: Callable[[], T], timeout_s: float, what: str) -> T:
        """Poll until ``condition`` is truthy and return it.

        Raises:
            TestbedError: not within ``timeout_s``, or a process that nobody asked to end has ended meanwhile; the
                message ends with the last lines of its log, or of every log.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            ended = self._ended()  # before the look at the condition: that may be the daemon's end
            try:
                if result := condition():
                    return result
            except AdapterError:
                pass  # not up yet: as good as false
            if ended:
                codes = ", ".join(f"{node} with {code}" for node, code in ended.items())
                raise TestbedError(f"waited for {what}, but processes have ended: {codes}\n{self._tails(ended)}")
            if time.monotonic() > deadline:
                raise TestbedError(f"waited {timeout_s:g} s for {what}\n{self._tails(self._processes)}")
            time.sleep(POLL_S)

    def _ended(self) -> dict[str, int]:
        """Daemons that have ended by themselves, with their exit codes; the names are those of their logs."""
        codes = {node: process.poll() for node, process in self._processes.items() if node not in self._may_end}
        return {node: code for node, code in codes.items() if code is not None}

    def _tails(self, nodes: Iterable[NodeId]) -> str:
        return "\n".join(f"--- {node}\n" + "\n".join(self.log(node).splitlines()[-12:]) for node in nodes)

    def wait_settled(self, timeout_s: float = 60.0) -> NodeId:
        """Wait until all running nodes agree on a living owner and every robot's streams are settled on it."""

        def settled() -> NodeId | None:
            owner = self.owner()
            return owner if owner in self._processes else None

        return self.wait(settled, timeout_s, "an owner on all nodes") or ""

    def wait_whole(self, timeout_s: float = 60.0) -> NodeId:
        """Start the nodes that are down, wait until all are alive to all and the streams are settled; the owner."""
        self.start()

        def whole() -> bool:
            return all(peer["state"] == "alive" for node in self.names for peer in self.status(node)["nodes"])

        self.wait(whole, timeout_s, "everybody alive to everybody")
        return self.wait_settled(timeout_s)

    def app(self, node: NodeId) -> zenoh.Session:
        """A plain zenoh application on ``node``: a client of its data endpoint; closed with the testbed.

        In a secured fleet it joins by what the node's operator socket tells root.
        """
        if self.fleet.security is not None:
            config = ask(places.socket_path(self.folder, node), {"verb": "access", "node": node}, 5.0)["sides"]["fleet"]
        else:
            endpoint = self.fleet.node(node).listen_data
            config = zenoh_config.client_config(connect=(endpoint,), timing=self.fleet.timing)
        session = zenoh.open(zenoh.Config.from_json5(config))
        self._sessions.append(session)
        return session

    # --- end ---------------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        missing = self.unaccounted() if kind is None else []
        for session in self._sessions:
            session.close()
        if self._processes:
            self.stop()
        for node in self.names:
            if (relay := self.relay_pid(node)) is not None:
                self._end_relay(node, relay)
        if missing:
            raise TestbedError("\n".join(missing))
