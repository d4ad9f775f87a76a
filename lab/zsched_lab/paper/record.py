"""Writes down what the figures need: streams as MCAP, the nodes' own accounting, and whether the host was short of CPU.

Knows: cgroup accounting, pressure (PSI), the robots' keys, MCAP. Does not know: schemes, what a figure means.

**Streams.** Run as a program it is one more application at every robot: it hears what the robot's applications send and
receive and writes it to one MCAP file (ROS 2 schemas and CDR payloads, readable by any MCAP tool). A map's publish time
is its header's stamp, the log time that of its arrival.

**Pressure.** /proc/pressure/cpu also counts processes that stand still because of their own quota: one loop under a
quota of 0.2 cores shows 0.8 on an idle machine. So everything outside the nodes' quotas is put into a control group of
the unified hierarchy, and that group's own pressure counts: the share of time in which some of it waited for a CPU.
It stands for other machines, which no edge slows down: where the nodes want a CPU, too, it goes first, at once by the
nodes' class (`zsched_lab.fleet.groups.LimitedGroup.give_way`), and by weight where the kernel has none.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import queue
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import zenoh
from mcap.writer import Writer

from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched.host.machine.cgroup import CgroupTree, CpuQuota, MemoryQuota
from zsched.tasks.map_merge.cdr import CdrError, decode_grid
from zsched.tools.watch.tracks import GRID, ROS_DEFINITIONS
from zsched_lab.fleet.application import connect
from zsched_lab.fleet.signals import StopFlag

PRECEDENCE = 10
"""How much more of a contended CPU goes to what has no quota than to a node."""
STREAMS = ("map", "global_map", "map_merge/status")


# --- accounting ------------------------------------------------------------------------------------------------------


@dataclass(slots=True, kw_only=True)
class NodeMeter:
    """One node's CPU and memory by its group's own accounting: every process of the node counts."""

    cpu: CpuQuota | None
    memory: MemoryQuota | None
    _last: tuple[float, float] | None = None

    @classmethod
    def of(cls, pid: int) -> NodeMeter:
        """The meter of the node whose daemon is ``pid`` (already in its share)."""
        tree = CgroupTree(pid=str(pid))
        return cls(cpu=tree.cpu_quota(), memory=tree.memory_quota())

    def read(self, now: float) -> dict[str, float | None]:
        """``cpu_ratio`` of the quota since the last reading, ``memory_ratio`` of the limit now; ``None``: no limit."""
        return {"cpu_ratio": self._cpu_ratio(now), "memory_ratio": self._memory_ratio()}

    def _cpu_ratio(self, now: float) -> float | None:
        used = None if self.cpu is None else self.cpu.used_s()
        before, self._last = self._last, None if used is None else (now, used)
        if self.cpu is None or used is None or before is None or now <= before[0]:
            return None
        return (used - before[1]) / (now - before[0]) / self.cpu.cores

    def _memory_ratio(self) -> float | None:
        used = None if self.memory is None else self.memory.used_mb()
        return None if self.memory is None or used is None else used / self.memory.limit_mb


@dataclass(slots=True)
class HostGauge:
    """The pressure on everything that has no quota, and how idle the machine was."""

    folder: Path | None
    """The group whose pressure is read."""
    first: Path | None = None
    """The group that goes first, where CPUs are shared out in another hierarchy."""
    _start_us: int | None = None
    _start_s: float = 0.0
    _start_ticks: tuple[int, int] = field(default=(0, 0))

    @classmethod
    def create(cls, name: str) -> HostGauge:
        """A group for what has no quota; without one (no unified hierarchy, not allowed) there is no pressure."""
        tree = CgroupTree()
        folders, cpu_folders = tree.folders(""), () if tree.is_v2("cpu") else tree.folders("cpu")
        folder = made_group(folders, name, "cpu.pressure")
        first = made_group(cpu_folders, name, "cpu.shares")
        for group, file, value in ((folder, "cpu.weight", 100 * PRECEDENCE), (first, "cpu.shares", 1024 * PRECEDENCE)):
            with contextlib.suppress(OSError):
                if group is not None and (group / file).exists():
                    (group / file).write_text(str(value), encoding="ascii")
        return cls(folder, first)

    def add(self, pid: int) -> None:
        """Count this process, with what it starts later; one that has ended does not count."""
        for group in (self.folder, self.first):
            with contextlib.suppress(OSError):
                if group is not None:
                    (group / "cgroup.procs").write_text(str(pid), encoding="ascii")

    def remove(self) -> None:
        """Remove the groups, once nothing is inside (in a run the janitor does it)."""
        for group in (self.folder, self.first):
            if group is not None:
                group.rmdir()

    def start(self) -> None:
        """From now on."""
        self._start_us, self._start_s, self._start_ticks = self._waited_us(), time.monotonic(), idle_ticks()

    def result(self) -> dict[str, float | None]:
        """``pressure`` (``None``: not measured) and ``idle_ratio`` of all CPUs since `start`, both in [0, 1]."""
        waited, elapsed_s = self._waited_us(), time.monotonic() - self._start_s
        idle, total = (now - then for now, then in zip(idle_ticks(), self._start_ticks, strict=True))
        pressure = None
        if waited is not None and self._start_us is not None and elapsed_s > 0:
            pressure = (waited - self._start_us) / 1e6 / elapsed_s
        return {"pressure": pressure, "idle_ratio": idle / total if total else None}

    def _waited_us(self) -> int | None:
        if self.folder is None:
            return None
        try:
            return parse_pressure((self.folder / "cpu.pressure").read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None


def made_group(parents: Sequence[Path], name: str, file: str) -> Path | None:
    """A new group below the first of ``parents``; ``None`` where it may not be made, or has no such file."""
    if not parents:
        return None
    folder = parents[0] / name
    with contextlib.suppress(OSError):
        folder.mkdir()
        if (folder / file).exists():
            return folder
        folder.rmdir()
    return None


def parse_pressure(text: str) -> int:
    """Microseconds in which some process waited, out of a PSI file. Raises `ValueError` when it has no such line."""
    for line in text.splitlines():
        kind, *pairs = line.split()
        if kind == "some":
            return int(dict(pair.split("=", 1) for pair in pairs)["total"])
    raise ValueError("no line 'some'")


def idle_ticks() -> tuple[int, int]:
    """(idle, all) ticks of all CPUs since boot; time stolen from this machine is not idle (proc(5))."""
    fields = [int(word) for word in Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()[1:9]]
    return fields[3] + fields[4], sum(fields)


# --- streams ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Heard:
    """One message as it arrived, ``at_ns`` on the wall clock."""

    topic: str
    payload: bytes
    at_ns: int


class StreamFile:
    """An MCAP file of maps and JSON messages. A context: leaving it finishes the file."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._writer = Writer(stream)
        self._writer.start(profile="ros2", library="zsched")
        self._grid = self._writer.register_schema(GRID, "ros2msg", ROS_DEFINITIONS[GRID].encode())
        self._json = self._writer.register_schema("zsched/Status", "jsonschema", b'{"type": "object"}')
        self._channels: dict[str, tuple[int, int]] = {}

    def write(self, heard: Heard) -> None:
        """Append one message."""
        is_map = not heard.topic.endswith("status")
        if heard.topic not in self._channels:
            schema, encoding = (self._grid, "cdr") if is_map else (self._json, "json")
            channel = self._writer.register_channel(heard.topic, encoding, schema)
            self._channels[heard.topic] = (channel, 0)
        channel, number = self._channels[heard.topic]
        self._channels[heard.topic] = (channel, number + 1)
        sent_ns = stamp_ns(heard.payload) if is_map else heard.at_ns
        self._writer.add_message(
            channel, log_time=heard.at_ns, data=heard.payload, publish_time=sent_ns or heard.at_ns, sequence=number
        )

    def close(self) -> None:
        """Write the index; the file is whole from then on."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types


def stamp_ns(payload: bytes) -> int:
    """The header's stamp of a map; 0 when it is none."""
    try:
        return decode_grid(payload).stamp_ns
    except CdrError:
        return 0


def record(endpoints: Mapping[NodeId, str], out: Path, stop: StopFlag) -> int:
    """Hear every robot's streams until stopped; returns the number of messages.

    Raises:
        zenoh.ZError: a robot's data endpoint does not answer.
    """
    heard: queue.SimpleQueue[Heard] = queue.SimpleQueue()
    count, subscribers = 0, []
    with contextlib.ExitStack() as stack, out.open("wb") as stream:
        for robot, endpoint in endpoints.items():
            session = connect(endpoint, stop)
            if session is None:
                return 0
            stack.enter_context(session)
            for name in STREAMS:
                topic = f"{robot}/{name}"
                subscribers.append(session.declare_subscriber(topic, _into(heard, topic)))
        file = StreamFile(stream)
        try:
            while not stop.is_set or not heard.empty():
                with contextlib.suppress(queue.Empty):
                    file.write(heard.get(timeout=0.1))
                    count += 1
        finally:
            file.close()
    return count


def _into(heard: queue.SimpleQueue[Heard], topic: str) -> Callable[[zenoh.Sample], None]:
    # In the callback only the copy: work there stalls every stream of the process.
    return lambda sample: heard.put(Heard(topic, bytes(sample.payload), time.time_ns()))


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 after a stop signal, 1 when a robot does not answer."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.paper.record")
    parser.add_argument("--robot", action="append", required=True, metavar="NAME=ENDPOINT")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    stop = StopFlag()
    stop.install()
    os.nice(5)  # recording must not be the load
    started = monotonic_s()
    try:
        count = record(dict(pair.split("=", 1) for pair in given.robot), given.out, stop)
    except zenoh.ZError as error:
        sys.stderr.write(f"record: a robot does not answer: {error}\n")
        return 1
    sys.stderr.write(f"record: {count} messages in {monotonic_s() - started:.1f} s\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
