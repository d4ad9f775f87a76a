"""A real fleet between real ROS 2 nodes: a robot and two edges, each with a DDS domain and a bridge of its own.

Knows: the testbed, the programs of ``tests/ros/side/``, DDS domains. Does not know: what a test does with them.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zenoh

from support.waiting import free_endpoint, until
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.testbed import Testbed, echo_fleet

ROOT = Path(__file__).parents[2]
SIDE = ROOT / "tests" / "ros" / "side"
VENV = ROOT / ".venv-ros"
PYTHON = VENV / "bin" / "python"
ROBOT, EDGES = "robot1", ("edge1", "edge2")
MEMORY = Path("/dev/shm")  # noqa: S108 - the kernel's name for it
DOMAINS = range(20, 100)
"""Their ports are below those that the kernel gives away (7400 + 250 for each)."""


@contextmanager
def domains(count: int) -> Iterator[list[int]]:
    """Numbers of DDS domains that no other run of tests has."""
    with ExitStack() as stack:
        mine: list[int] = []
        for number in DOMAINS:
            file = stack.enter_context((Path(tempfile.gettempdir()) / f"zsched-dds-{number}.lock").open("w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            mine.append(number)
            if len(mine) == count:
                yield mine
                return
        raise AssertionError("no DDS domain is free")


def ros_environment(folder: Path) -> dict[str, str]:
    """On this machine only."""
    return {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_LOG_DIR": str(folder / "ros"),
    }


def sweep() -> None:
    """Remove the shared memory of DDS nodes that were killed, as ``fastdds shm clean`` does: nobody holds its lock."""
    for lock in MEMORY.glob("fastdds_*_el"):
        name = lock.name.removesuffix("_el")
        with contextlib.suppress(OSError), lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for left in (lock.with_name(name), lock.with_name(f"sem.{name}_mutex"), lock):
                left.unlink(missing_ok=True)


class Application:
    """The robot's node, which counts: `told` is its newest line."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.told: dict[str, Any] = {}
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.told = json.loads(line)

    def say(self, word: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(word + "\n")
        self._process.stdin.flush()

    def summary(self) -> dict[str, Any]:
        """Lists by their length and their end."""
        return {key: (len(all_), all_[-2:]) if isinstance(all_, list) else all_ for key, all_ in self.told.items()}

    def answers(self, owner: str) -> list[int]:
        """Numbers of what one owner has answered, as they came."""
        return [int(number) for who, number in self.told["answers"] if who == owner]


class RosFleet:
    """Started fleet: robot1 with its application, edge1 and edge2 with a worker each."""

    def __init__(
        self, stack: ExitStack, folder: Path, task: Mapping[str, Any], *, rmw_domain: int | None = None
    ) -> None:
        """``task`` is the fleet file's block, without candidates, weights and the worker's environment."""
        self._stack = stack
        stack.callback(sweep)
        numbers = stack.enter_context(domains(3))
        self._domains = dict(zip((ROBOT, *EDGES), numbers, strict=True))
        self._environment = ros_environment(folder)
        tree = echo_fleet(robots=1, edges=2, task=task)
        for key in {"inputs", "outputs"} - set(task):
            del tree["tasks"]["echo"][key]
        worker = tree["tasks"]["echo"]["worker"]
        own = {f"DOMAIN_OF_{name}": str(number) for name, number in self._domains.items()}
        worker["env"] = {**self._environment, **own, **worker.get("env", {})}
        self._local = free_endpoint()
        tree["nodes"][ROBOT]["local"] = {"connect": [self._local]}
        tree["electorate"] = [ROBOT, *EDGES]
        self.bed = stack.enter_context(Testbed(folder, tree))
        self.bed.init()
        self.bed.start()
        self._rmw = () if rmw_domain is None else (str(rmw_domain),)
        self.bridges = {name: self._bridge(name) for name in (ROBOT, *EDGES)}

    def _program(self, name: str, domain: str, *words: str, **more: Any) -> subprocess.Popen[str]:
        environment = {**os.environ, **self._environment, "ROS_DOMAIN_ID": str(self._domains[domain])}
        with (self.bed.folder / f"{domain}-{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [PYTHON, SIDE / name, *words], env=environment, stderr=log, text=True, start_new_session=True, **more
            )
        self._stack.callback(end, process)
        return process

    def _bridge(self, machine: str) -> subprocess.Popen[str]:
        """The robot's is the router of its own side, an edge's a client of its machine's data endpoint."""
        file = self.bed.folder / f"{machine}-bridge.json5"
        data = self.bed.fleet.node(machine).listen_data
        connect = () if machine == ROBOT else (data,)
        text = client_config(connect=connect, timing=self.bed.fleet.timing, connect_s=30.0)
        config = zenoh.Config.from_json5(text)
        config.insert_json5("timestamping/enabled", "true")
        if machine == ROBOT:
            config.insert_json5("mode", '"router"')
            config.insert_json5("listen/endpoints", json.dumps([self._local]))
        file.write_text(str(config))
        return self._program("bridge.py", machine, str(file), *self._rmw, stdin=subprocess.DEVNULL)

    def application(self) -> Application:
        """Begin the robot's node."""
        process = self._program("robot.py", ROBOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        made = Application(process)
        until(lambda: made.told, "the application runs")
        return made

    def assert_bridges_run(self) -> None:
        """Those of machines that were not killed."""
        ended = [name for name, process in self.bridges.items() if process.poll() is not None]
        assert not ended, [(self.bed.folder / f"{name}-bridge.py.log").read_text()[-2000:] for name in ended]

    def kill(self, machine: str) -> None:
        """All of a machine at once: daemon, relay, worker, bridge."""
        self.bridges.pop(machine).kill()
        self.bed.kill(machine)


def end(process: subprocess.Popen[str]) -> None:
    """Kill and reap; an application's pipes are closed."""
    process.kill()
    process.wait(60)
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
