"""The nodes of a development run as processes: started, stopped, killed, loaded, and all gone at the end.

Knows: daemons, their relays and workers, CPUs, signals, the run's token. Does not know: keys, what is printed.

Three things bind a process to the run: the kernel kills a daemon when we die (`zsched.host.workers.launch`), a
daemon's death ends its workers, and everything that is left at the end bears the run's token in its environment.
Start processes from the main thread only: the kernel watches the thread that forked.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Self

from zsched.commands.members.blank import init_state
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct
from zsched.host import paths
from zsched.host.clock import monotonic_s
from zsched.host.machine import core_speed
from zsched.host.operator_client import ask
from zsched.host.workers import launch
from zsched.link.pipe.relay_socket import relay_pid

TOKEN: Final = "ZSCHED_DEV_RUN"
HURRY_S: Final = 0.4
"""Between the two signals of an end: a daemon that is told to stop twice goes at once."""
STOP_S: Final = 6.0
POLL_S: Final = 0.02
ASK_S: Final = 1.0
LONGEST_FOLDER: Final = 60
"""Of a socket's path the kernel takes 107 characters."""
LOAD_PER_CPU: Final = 2
SPIN: Final = "while True: pass"

Json = dict[str, Any]


class Running(Struct, kw_only=True):
    """One daemon."""

    process: subprocess.Popen[bytes]
    is_stopping: bool = False


@dataclass(slots=True)
class Nodes:
    """All nodes of one fleet on loopback; a context that leaves no process and no file."""

    fleet: Fleet
    text: str
    work_folder: Path
    """Where daemons and workers run: relative paths of the fleet file hold from there."""
    cpus: Mapping[NodeId, frozenset[int]] = field(default_factory=dict)
    folder: Path = field(init=False)
    token: str = field(init=False)
    left_behind: tuple[str, ...] = ()
    _running: dict[NodeId, Running] = field(init=False, default_factory=dict)
    _load: dict[NodeId, list[subprocess.Popen[bytes]]] = field(init=False, default_factory=dict)

    def __enter__(self) -> Self:
        """Make the folder and every node's blank state."""
        base = tempfile.gettempdir()
        if len(base) > LONGEST_FOLDER - len("/zsched-dev-12345678"):
            base = "/tmp"  # noqa: S108 - mkdtemp makes a folder of our own there
        self.folder = Path(tempfile.mkdtemp(prefix="zsched-dev-", dir=base))
        self.token = secrets.token_hex(8)
        try:
            self.file.write_text(self.text, encoding="utf-8")
            speed: Path | None = None
            for node in self.names:
                init_state(self.fleet, node, self.folder / node, 0)
                if speed is None:
                    core_speed.kept_or_new(self.folder / node)
                    speed = self.folder / node / core_speed.NAME
                else:
                    shutil.copy(speed, self.folder / node / core_speed.NAME)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End everything."""
        self.close()

    @property
    def file(self) -> Path:
        """The fleet file of this run."""
        return self.folder / "fleet.yaml"

    @property
    def names(self) -> tuple[NodeId, ...]:
        """Every node, in the file's order of robots and edges."""
        return tuple(sorted((node.name for node in self.fleet.nodes), key=self._rank))

    def _rank(self, name: NodeId) -> tuple[bool, NodeId]:
        return (self.fleet.node(name).kind.value != "robot", name)

    # --- one node ----------------------------------------------------------------------------------------------------

    def start(self, node: NodeId) -> IO[bytes]:
        """Start a daemon that does not run; its log, which is the caller's to read and to close."""
        daemon = [sys.executable, "-P", "-m", "zsched.daemon", "--config", str(self.file), "--node", node]
        daemon += ["--state-dir", str(self.folder / node), "--runtime-dir", str(self.folder)]
        process = self._spawn(daemon, node, stderr=subprocess.PIPE)
        assert process.stderr is not None
        self._running[node] = Running(process=process)
        os.set_blocking(process.stderr.fileno(), False)
        return process.stderr

    def _spawn(self, command: Sequence[str], node: NodeId, stderr: int) -> subprocess.Popen[bytes]:
        """Start a process on the node's CPUs; a new process has those of the thread that makes it."""
        mine = os.sched_getaffinity(0)
        kept = {name: value for name, value in os.environ.items() if not name.startswith("ZSCHED_")}
        os.sched_setaffinity(0, self.cpus.get(node, mine))
        try:
            return subprocess.Popen(
                [sys.executable, "-I", "-S", str(launch.__file__), str(os.getpid()), *command],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**kept, TOKEN: self.token},
                cwd=self.work_folder,
                start_new_session=True,
            )
        finally:
            os.sched_setaffinity(0, mine)

    def stop(self, node: NodeId) -> None:
        """Ask a daemon to end in order: it hands over what it owns first."""
        running = self._running[node]
        running.is_stopping = True
        running.process.send_signal(signal.SIGTERM)

    def kill(self, node: NodeId) -> None:
        """End a node as a machine ends that loses its power: daemon, worker and relay at once."""
        running = self._running[node]
        running.is_stopping = True
        relay = relay_pid(paths.relay_path(self.folder, node))
        running.process.kill()
        if relay is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(relay, signal.SIGKILL)

    def is_up(self, node: NodeId) -> bool:
        """Whether its daemon runs and has not been asked to end."""
        running = self._running.get(node)
        return running is not None and not running.is_stopping and running.process.poll() is None

    def ended(self) -> dict[NodeId, tuple[int, bool]]:
        """{node: (exit code, whether we have asked for it)} of daemons that have ended; each is named once."""
        found = {}
        for node, running in tuple(self._running.items()):
            code = running.process.poll()
            if code is not None:
                found[node] = (code, running.is_stopping)
                del self._running[node]
        return found

    # --- load --------------------------------------------------------------------------------------------------------

    def is_loaded(self, node: NodeId) -> bool:
        """Whether busy processes of ours run on the node's CPUs."""
        return bool(self._load.get(node))

    def loaded(self) -> tuple[NodeId, ...]:
        """Nodes with such load."""
        return tuple(node for node, processes in self._load.items() if processes)

    def load(self, node: NodeId) -> int:
        """Start busy processes on the node's CPUs; how many."""
        count = LOAD_PER_CPU * len(self.cpus.get(node, os.sched_getaffinity(0)))
        spin = [sys.executable, "-I", "-S", "-c", SPIN]
        self._load[node] = [self._spawn(spin, node, stderr=subprocess.DEVNULL) for _ in range(count)]
        return count

    def unload(self, node: NodeId) -> None:
        """End them."""
        processes = self._load.pop(node, [])
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()

    # --- workers -----------------------------------------------------------------------------------------------------

    def worker(self, node: NodeId, task: TaskId) -> int | None:
        """The process of a node's worker of the task."""
        marks = {f"{TOKEN}={self.token}", f"ZSCHED_NODE={node}", f"ZSCHED_TASK={task}"}
        pids = (pid for pid, words in _environments() if marks <= words)
        return next((pid for pid in pids if _leads(pid)), None)

    def restart_worker(self, node: NodeId, task: TaskId) -> None:
        """Have a node's worker started again, without its failures, if the node's daemon answers."""
        with contextlib.suppress(AdapterError):
            self._ask(node, {"verb": "restart", "task": task})

    # --- looking -----------------------------------------------------------------------------------------------------

    def status(self) -> Json | None:
        """The status of the first node that answers, robots first."""
        for node in self.names:
            if self.is_up(node):
                with contextlib.suppress(AdapterError):
                    return self._ask(node, {"verb": "status"})
        return None

    def _ask(self, node: NodeId, request: Json) -> Json:
        answer = ask(paths.socket_path(self.folder, node), request, ASK_S)
        if "error" in answer:
            raise AdapterError(str(answer["error"]))
        return answer

    # --- the end -----------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """End every process, remove every file; idempotent. `left_behind` says what could not be removed."""
        for node in tuple(self._load):
            self.unload(node)
        self._stop_daemons()
        left = _end_tagged(self.token) if hasattr(self, "token") else []
        shutil.rmtree(self.folder, ignore_errors=True)
        self.left_behind = (*(f"process {pid}" for pid in left), *([str(self.folder)] if self.folder.exists() else []))

    def _stop_daemons(self) -> None:
        """SIGTERM twice, so that nobody waits for a task to move, then SIGKILL to the group."""
        processes = [running.process for running in self._running.values()]
        for wait_s in (HURRY_S, STOP_S):
            for process in processes:
                if process.poll() is None:
                    process.send_signal(signal.SIGTERM)
            _wait_all(processes, wait_s)
        for running in self._running.values():
            if running.process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(running.process.pid, signal.SIGKILL)
                running.process.wait()
            if running.process.stderr is not None:
                running.process.stderr.close()
        self._running.clear()


def shares(nodes: Sequence[NodeId], available: Iterable[int]) -> dict[NodeId, frozenset[int]]:
    """The CPUs of each node, each CPU to one of them in turn; none where there are fewer CPUs than nodes need."""
    cpus = sorted(available)
    if len(cpus) < 2 or len(nodes) < 2:
        return {}
    if len(cpus) < len(nodes):
        return {node: frozenset({cpus[index % len(cpus)]}) for index, node in enumerate(nodes)}
    return {node: frozenset(cpus[index :: len(nodes)]) for index, node in enumerate(nodes)}


def _wait_all(processes: Iterable[subprocess.Popen[bytes]], wait_s: float) -> None:
    """Wait until all have ended; their logs are read meanwhile, so that none waits for us."""
    end = monotonic_s() + wait_s
    for process in processes:
        while process.poll() is None and monotonic_s() < end:
            _drain(process)
            time.sleep(POLL_S)


def _drain(process: subprocess.Popen[bytes]) -> None:
    if process.stderr is not None and not process.stderr.closed:
        with contextlib.suppress(BlockingIOError):
            while os.read(process.stderr.fileno(), 65536):
                pass


def _end_tagged(token: str) -> list[int]:
    """SIGKILL what bears the run's token; what stays in spite of that."""
    mark = f"{TOKEN}={token}"
    end = monotonic_s() + STOP_S
    while True:
        pids = [pid for pid, words in _environments() if mark in words]
        if not pids or monotonic_s() > end:
            return pids
        for pid in pids:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(POLL_S)


def _environments() -> Iterable[tuple[int, set[str]]]:
    """(process, its environment) of every process that we may look at, but ourselves."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                yield int(entry.name), set((entry / "environ").read_bytes().decode(errors="replace").split("\0"))


def _leads(pid: int) -> bool:
    """Whether a process is there and leads a session, as every worker does."""
    try:
        return os.getsid(pid) == pid
    except ProcessLookupError:
        return False
