"""A real fleet in network namespaces: a `Testbed` whose nodes can be cut off, slowed down and run out of disk.

Knows: daemons in namespaces, robots' applications beside them, what the daemons' logs tell. Does not know: what is
tested. Daemons die with the thread that started them; namespaces see `zsched_lab.fleet.netns`.
"""

from __future__ import annotations

import contextlib
import copy
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import IO

import psutil

from zsched.core.values.fleet import Timing
from zsched.core.values.model import NodeId, PeerState
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.host.operator_client import ask
from zsched.host.paths import socket_path
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.netns import Network
from zsched_lab.fleet.testbed import DAEMON, Json, Testbed
from zsched_lab.sim.history import History, Learnt, Started

CONTROL_PORT, DATA_PORT = 7457, 7458
PROBE = (sys.executable, "-m", "zsched_lab.fleet.probe")

_STAMP = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),(\d{3}) ")
_LEARNT = re.compile(r"task=(\S+) epoch=(\d+) learnt revision (\d+): owner (\S+), (.*?)(?:, known from [^=]*)?$")
"""The value alone: what a node knew of it before is not part of it."""
_CHANGE = re.compile(r"zsched\.membership (\S+) (\w+) -> (\w+): (.*)")
_STARTED = re.compile(r"no_state|ready node=")

_ON_TMPFS = (
    'cp -a "$1" "$1.seed" && mount -t tmpfs -o "size=$2,mode=0700" none "$1" && cp -a "$1.seed/." "$1" && '
    'rm -rf "$1.seed" && shift 2 && exec "$@"'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Received:
    """One sample at a robot's application; times are seconds of CLOCK_BOOTTIME."""

    key: str
    number: int
    sent_at: float
    at: float
    node: NodeId
    """Whose worker sent it."""
    epoch: int | None = None
    """Where the worker says so in the payload."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerChange:
    """A node changed its mind about a peer, as its log tells."""

    at: float
    observer: NodeId
    node: NodeId
    after: PeerState
    reason: str


class Probe:
    """`zsched_lab.fleet.probe` as a child: what an application in a node's namespace sends and sees."""

    def __init__(self, command: Sequence[str | Path], log: IO[bytes], name: str = "") -> None:
        """Start it; `Netbed.probe` knows the command, and the name of its log."""
        self.name = name
        self.received: list[Received] = []
        self.is_open = False
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        self._thread = guarded(self._read, name="netbed", is_lasting=False)
        self._thread.start()
        self._is_closed = False

    def ended(self) -> int | None:
        """Its exit code if it has ended by itself."""
        return None if self._is_closed else self._process.poll()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            words = line.decode().split()
            if len(words) == 6:
                self.received.append(_received(*words))
            self.is_open = True

    def first_after(self, moment: float, *, but_of: NodeId = "") -> Received | None:
        """The first sample back, not by ``but_of``, of those *sent* after ``moment`` (CLOCK_BOOTTIME), or ``None``."""
        newest = [one for one in self.received[-4000:] if one.sent_at > moment]
        found = [one for one in newest if one.epoch is None and one.node != but_of]
        return min(found, key=lambda one: one.at, default=None)

    def is_flowing(self, within_s: float = 0.5) -> bool:
        """Whether something came back that was sent at most ``within_s`` ago."""
        return self.first_after(monotonic_s() - within_s) is not None

    def owners(self, key: str) -> list[NodeId]:
        """Whose samples came under ``key``, in order, each run of one node once."""
        return owners_of(tuple(self.received), key)

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def close(self) -> None:
        """End it."""
        self._is_closed = True
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)
        self._thread.join(5)
        assert self._process.stdout is not None
        self._process.stdout.close()


def owners_of(received: Sequence[Received], key: str) -> list[NodeId]:
    """Whose samples came under ``key``, in order, each run of one node once."""
    runs: list[NodeId] = []
    for one in received:
        if one.key == key and (not runs or runs[-1] != one.node):
            runs.append(one.node)
    return runs


def _received(key: str, number: str, sent_at: str, epoch: str, at: str, node: str) -> Received:
    """One line of the probe."""
    return Received(
        key=key,
        number=int(number),
        sent_at=float(sent_at),
        at=float(at),
        node=node,
        epoch=None if epoch == "-" else int(epoch),
    )


def in_namespaces(tree: Json, network: Network, hidden: Collection[NodeId] = (), options: str = "") -> Json:
    """The fleet file ``tree`` with every node but ``hidden`` at its namespace's address and zsched's usual ports."""
    tree = copy.deepcopy(tree)
    for name, node in tree["nodes"].items():
        if name in hidden:
            del node["host"], node["listen"]
            continue
        host = network.address(name)
        node["host"] = host
        ports = {"control": CONTROL_PORT, "data": DATA_PORT}
        node["listen"] = {kind: f"tcp/0.0.0.0:{port}{options}" for kind, port in ports.items()}
    return tree


class Netbed(Testbed):
    """The daemons of one fleet file, each in a namespace of its own.

    Args:
        folder: for files, sockets, state and logs.
        tree: a fleet file as plain data (`zsched_lab.fleet.testbed.echo_fleet`); hosts and ports are filled in.
        network: has a namespace per node; `None`: one is made. Closed with the bed either way.
        tmpfs: {node: size, e.g. ``64k``}: whose state folder is a small file system of its own.
        hidden: nodes whose address the fleet file does not give.
        wrapper: run instead of the daemon's module (a script that takes the same arguments).
        options: of every listener, such as ``#iface=eth0``.
    """

    __test__ = False

    def __init__(
        self,
        folder: Path,
        tree: Json,
        *,
        network: Network | None = None,
        tmpfs: Mapping[NodeId, str] | None = None,
        wrapper: Path | None = None,
        hidden: Collection[NodeId] = (),
        options: str = "",
    ) -> None:
        self.network = Network(tree["nodes"]) if network is None else network
        self.tmpfs = dict(tmpfs or {})
        self._daemon: tuple[str | Path, ...] = DAEMON if wrapper is None else (sys.executable, wrapper)
        self._probes: list[Probe] = []
        try:
            super().__init__(folder, in_namespaces(tree, self.network, hidden, options))
        except BaseException:
            self.network.close()
            raise

    # --- processes ---------------------------------------------------------------------------------------------------

    def start(self, *nodes: NodeId) -> None:
        """Start daemons (default: all that do not run), each in its namespace."""
        for node in nodes or tuple(name for name in self.names if name not in self._processes):
            self._may_end.discard(node)
            self._processes[node] = self.spawn(
                node, [*self._daemon, "--config", self.file, "--node", node, *self._folders(node)], log=f"{node}.log"
            )

    def spawn(self, place: str, command: Sequence[str | Path], *, log: str) -> subprocess.Popen[bytes]:
        """Any process in the namespace ``place``; its stderr goes to ``log`` in the bed's folder."""
        size = self.tmpfs.get(place)
        if size is not None:
            own_disk = ("unshare", "--mount", "--propagation", "private", "sh", "-c", _ON_TMPFS, "sh")
            command = [*own_disk, self.folder / place, size, *command]
        with (self.folder / log).open("ab") as file:
            return subprocess.Popen(
                self.network.wrap(place, command),
                stdin=subprocess.DEVNULL,
                stderr=file,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )

    def probe(
        self,
        node: NodeId,
        *,
        put: str = "",
        hz: float = 50.0,
        size: int = 0,
        burst: int = 1,
        has_one_stamp: bool = False,
        blocks: bool = False,
        watch: Sequence[str] = (),
        timing: Timing | None = None,
    ) -> Probe:
        """An application on ``node``: a client of its data endpoint; ended with the bed.

        It puts ``hz`` messages a second, ``burst`` of them at once, and ``has_one_stamp``: those under one timestamp.
        ``blocks``: it waits where there is no room, and drops nothing.
        """
        endpoints = (self._data_endpoint(node),)
        config = zenoh_config.client_config(connect=endpoints, timing=timing or self.fleet.timing)
        watched = [word for key in watch for word in ("--watch", key)]
        command = [*PROBE, config, "--put", put, "--hz", str(hz), "--size", str(size), *watched]
        command += ["--burst", str(burst), *(["--block"] if blocks else [])]
        command += ["--one-stamp"] if has_one_stamp else []
        name = f"probe-{node}"
        with (self.folder / f"{name}.log").open("ab") as log:
            probe = Probe(self.network.wrap(node, command), log, name)
        self._probes.append(probe)
        return probe

    def _ended(self) -> dict[str, int]:
        """Applications, too: nobody waits for answers at one that is no more."""
        codes = {probe.name: code for probe in self._probes if (code := probe.ended()) is not None}
        return super()._ended() | codes

    def _data_endpoint(self, node: NodeId) -> str:
        if self.fleet.node(node).listen_data:
            return f"tcp/{self.network.address(node)}:{DATA_PORT}"
        self.wait(lambda: self.status(node), 20, f"{node} to answer")  # a hidden node's port is its own choice
        endpoints: list[str] = ask(socket_path(self.folder, node), {"verb": "access"}, 3.0)["endpoints"]
        return endpoints[0]

    def told_lost(self, node: NodeId) -> int:
        """Samples that a robot's relay tells of as lost, or as lost at most."""
        return sum(one.lost + one.at_most_lost + sum(count for _, count in one.drops) for one in self.counts(node))

    def power_off(self, node: NodeId, *, is_seen: bool = False) -> None:
        """The machine is gone at once: nobody sees its sockets close, unless ``is_seen``: only its processes die."""
        if not is_seen:
            self.network.link(node, is_up=False)
        stop_group(self.pid(node), signal.SIGKILL)
        self._processes.pop(node).wait(10)

    # --- what the logs tell ------------------------------------------------------------------------------------------

    def history(self, **arguments: object) -> History:
        """Starts and learnt values of all nodes since the bed was made, from their logs."""
        history = History(**arguments)  # type: ignore[arg-type] # passed on as given
        for node in self.names:
            if not (self.folder / f"{node}.log").exists():
                continue
            for at, text in stamped(self.log(node)):
                if _STARTED.search(text):
                    history.record(Started(at=at, node=node, has_state="no_state" not in text))
                found = _LEARNT.search(text)
                if found is not None:
                    task, epoch, revision, owner, detail = found.groups()
                    history.record(
                        Learnt(
                            at=at,
                            node=node,
                            task=task,
                            revision=int(revision),
                            epoch=int(epoch),
                            owner=None if owner == "None" else owner,
                            detail=detail,
                        )
                    )
        return history

    def changes(self, *, since: float = 0.0) -> list[PeerChange]:
        """Every node's changes of mind about its peers since ``since`` (CLOCK_BOOTTIME), sorted by time."""
        found = []
        for node in self.names:
            for at, text in stamped(self.log(node)):
                change = _CHANGE.search(text)
                if change is not None and at >= since:
                    name, _, after, reason = change.groups()
                    found.append(PeerChange(at=at, observer=node, node=name, after=PeerState(after), reason=reason))
        return sorted(found, key=lambda one: one.at)

    # --- end ---------------------------------------------------------------------------------------------------------

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            for probe in self._probes:
                probe.close()
            super().__exit__(kind, error, trace)
        finally:
            self.network.close()


class OnboardBed(Netbed):
    """Applications are on their robot, and stay linked to its relay whatever its address is."""

    def _data_endpoint(self, node: NodeId) -> str:
        sides = self.fleet.node(node).local
        return sides.listen[0] if sides else f"tcp/127.0.0.1:{DATA_PORT}"


def stamped(log: str) -> list[tuple[float, str]]:
    """(seconds of CLOCK_BOOTTIME, line) of the lines of a daemon's log that have a time (within a millisecond)."""
    shift = monotonic_s() - time.time()
    found = []
    for line in log.splitlines():
        stamp = _STAMP.match(line)
        if stamp is not None:
            moment = datetime.strptime(stamp[1], "%Y-%m-%d %H:%M:%S").timestamp() + int(stamp[2]) / 1000  # noqa: DTZ007 - logging stamps local time
            found.append((moment + shift, line[stamp.end() :]))
    return found


def stop_group(pid: int, number: signal.Signals) -> None:
    """Send a signal to a daemon and to every descendant of it: the machine stands still, or goes on."""
    for one in (pid, *descendants(pid)):
        with contextlib.suppress(OSError):
            os.kill(one, number)


def descendants(pid: int) -> list[int]:
    """Every living process below ``pid``."""
    with contextlib.suppress(psutil.Error):
        return [one.pid for one in psutil.Process(pid).children(recursive=True)]
    return []


def descendants_running(pid: int, word: str) -> list[int]:
    """Every living process below ``pid`` with ``word`` (whole) on its command line."""
    return [below for below in descendants(pid) if word in _words(below)]


def _words(pid: int) -> list[str]:
    """A process's command line; none when it has ended meanwhile."""
    with contextlib.suppress(psutil.Error):
        return list(psutil.Process(pid).cmdline())
    return []
