"""What a fleet costs while nothing happens: CPU, wake-ups, threads, memory and packets of all processes of its nodes.

``python -m benchmarks.idle [--nodes 3 6 12] [--seconds 20] [--rounds 3] [--other PATH [--lacks KEY...]]
[--threads] [--packets]``.
Half of the nodes are robots, half edges; the echo worker runs on every edge, one of them owns. Every node has a network
namespace and a control group of its own (root, Linux): a quota of one core makes the group the machine that its daemon
measures, so that other work is not taken for load, as on a machine of its own.

With ``--other`` (another working tree of zsched) each round measures both trees, one after the other, in turn first:
what else the machine does then meets both. Daemons, relays and workers of the other tree are its own programs,
and its fleet file is without the keys of ``scheduling:`` that it ``--lacks``.

* CPU: percent of one core, the time that the kernel gave the process's threads (``schedstat``); not wall time.
* wake-ups: voluntary context switches a second, of all threads.
* PSS: pages that processes share count in parts. A node alone on its machine shares with nobody; ``uss`` is the part
  that is its own.
* alone: what daemon and relay would take on a machine of their own: the pages that are one's own, and what they share
  with others once.
* packets, bytes: what leaves a node's interface for other nodes; between processes of one node: ``local``.

``--threads`` adds CPU and wake-ups by group of threads, ``--packets`` what the packets of one robot and one edge are.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.common import machine
from benchmarks.packets_sent import KINDS as PACKET_KINDS
from benchmarks.record import progress
from zsched.core.values.model import NodeId
from zsched_lab.fleet.limits import NodeLimits, make_limits
from zsched_lab.fleet.netbed import Netbed, descendants
from zsched_lab.fleet.netns import INTERFACE
from zsched_lab.fleet.testbed import echo_fleet

KIB_PER_MIB = 1024
REST_S = 6.0
"""After the fleet has settled: the start's own work must not count."""
CORES, MEMORY_MB = 1.0, 1024.0
"""Of each node's group."""
ROLES = {"zsched.daemon": "daemon", "zsched.relay": "relay", "zsched-guard": "guard"}
KINDS = ("daemon", "relay", "standby", "owner", "guard")
"""The processes of a node: its daemon, its relay, the worker (which owns the task or does not), and the shell that ends
what a daemon leaves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """One process of the fleet."""

    pid: int
    node: NodeId
    kind: str


@dataclass(slots=True, kw_only=True)
class Reading:
    """What the kernel has counted of one process so far."""

    cpu_ns: Counter[str] = field(default_factory=Counter)
    """{group of threads: nanoseconds on a core}."""
    wakeups: Counter[str] = field(default_factory=Counter)
    threads: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Usage:
    """One process over the whole time: percent of a core and wake-ups a second by group of threads, MiB."""

    process: Process
    cpu: dict[str, float]
    wakeups: dict[str, float]
    threads: int
    pss: float
    uss: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """What one node sent a second: to other nodes, and between its own processes; what it takes of memory, in MiB."""

    packets: float
    bytes: float
    local_packets: float
    local_bytes: float
    alone: float


class TreeBed(Netbed):
    """A fleet whose daemons, relays and workers are those of one working tree."""

    tree: Path | None = None
    limits: NodeLimits | None = None

    def start(self, *nodes: NodeId) -> None:
        """As `Netbed.start`, each daemon in its node's group."""
        for node in nodes or tuple(name for name in self.names if name not in self._processes):
            super().start(node)
            if self.limits is not None:
                self.limits.put(node, self.pid(node))

    def spawn(self, place: str, command: Sequence[str | Path], *, log: str) -> subprocess.Popen[bytes]:
        """As `Netbed.spawn`."""
        if self.tree is not None:
            command = ("env", "-C", self.tree, f"PYTHONPATH={self.tree}:{self.tree / 'lab'}", *command)
        return super().spawn(place, command, log=log)


# --- reading ---------------------------------------------------------------------------------------------------------


def group_of(comm: str, *, is_main: bool) -> str:
    """Threads of one kind count together: ``rx-0`` and ``rx-11`` are ``rx``."""
    return "main" if is_main else re.sub(r"[-_ ]?\d+$", "", comm)


def read(pid: int) -> Reading:
    """The counters of a process now."""
    found = Reading()
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            group = group_of((task / "comm").read_text().strip(), is_main=task.name == str(pid))
            cpu_ns = int((task / "schedstat").read_text().split()[0])
            status = (task / "status").read_text()
        except FileNotFoundError:  # it has ended meanwhile
            continue
        found.threads += 1
        found.cpu_ns[group] += cpu_ns
        found.wakeups[group] += int(status.partition("\nvoluntary_ctxt_switches:")[2].split()[0])
    return found


def memory(pid: int) -> tuple[float, float]:
    """(PSS, USS) of a process in MiB."""
    rollup = dict(line.split(":") for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    parts = {name: int(text.split()[0]) / KIB_PER_MIB for name, text in rollup.items()}
    return parts["Pss"], parts["Private_Clean"] + parts["Private_Dirty"]


def alone(pids: Sequence[int]) -> float:
    """MiB of processes as on a machine of their own: pages of one's own, and of each shared mapping the larger part."""
    own, shared = 0, Counter[tuple[str, ...]]()
    for pid in pids:
        mapping = ("", "")
        for words in map(str.split, Path(f"/proc/{pid}/smaps").read_text().splitlines()):
            if not words[0].endswith(":"):
                mapping = words[2], words[-1]  # its offset in the file
            elif words[0].startswith("Private_") and words[-1] == "kB":
                own += int(words[1])
            elif words[0] in ("Shared_Clean:", "Shared_Dirty:"):
                part = (*mapping, words[0])
                shared[part] = max(shared[part], int(words[1]))
    return (own + shared.total()) / KIB_PER_MIB


def sent(bed: Netbed, node: NodeId) -> tuple[int, int, int, int]:
    """(packets, bytes, local packets, local bytes) that a node has sent."""
    text = bed.network.run(node, "cat", "/proc/net/dev")
    lines = {name.strip(): words.split() for name, _, words in (line.partition(":") for line in text.splitlines())}
    (outside, local) = lines[INTERFACE], lines["lo"]
    return int(outside[9]), int(outside[8]), int(local[9]), int(local[8])


def processes(bed: Netbed, owner: NodeId) -> Iterator[Process]:
    """All processes of the fleet's nodes."""
    for node in bed.names:
        daemon = bed.pid(node)
        yield Process(pid=daemon, node=node, kind="daemon")
        for pid in descendants(daemon):
            words = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            kind = next((ROLES[word] for word in words if word in ROLES), "owner" if node == owner else "standby")
            yield Process(pid=pid, node=node, kind=kind)


# --- measuring -------------------------------------------------------------------------------------------------------


def packet_kinds(bed: Netbed, seconds: float) -> list[dict[str, float]]:
    """What the packets of one edge and one robot are: {kind: packets a second} of each (`benchmarks.packets_sent`)."""
    watches = []
    for name in (bed.names[0], bed.names[-1]):
        command = bed.network.wrap(name, (sys.executable, "-m", "benchmarks.packets_sent", str(seconds)))
        watches.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    try:
        return [json.loads(watch.communicate(timeout=seconds + 30)[0]) for watch in watches]
    finally:
        for watch in watches:
            watch.kill()
            watch.wait(10)


def measure(bed: Netbed, owner: NodeId, seconds: float) -> tuple[list[Usage], list[Traffic]]:
    """Every process's use over ``seconds``, and every node's traffic."""
    found = list(processes(bed, owner))
    sent_before = {node: sent(bed, node) for node in bed.names}
    before, began = {one.pid: read(one.pid) for one in found}, time.monotonic()
    time.sleep(seconds)
    after, took = {one.pid: read(one.pid) for one in found}, time.monotonic() - began
    sent_after = {node: sent(bed, node) for node in bed.names}
    usages = []
    for one in found:
        old, new = before[one.pid], after[one.pid]
        pss, uss = memory(one.pid)
        usages.append(
            Usage(
                process=one,
                cpu={name: (new.cpu_ns[name] - old.cpu_ns[name]) / took / 1e7 for name in new.cpu_ns},
                wakeups={name: (new.wakeups[name] - old.wakeups[name]) / took for name in new.wakeups},
                threads=new.threads,
                pss=pss,
                uss=uss,
            )
        )
    traffic = []
    for node in bed.names:
        rates = [(new - old) / took for new, old in zip(sent_after[node], sent_before[node], strict=True)]
        own = alone([one.pid for one in found if one.node == node and one.kind in {"daemon", "relay"}])
        traffic.append(
            Traffic(packets=rates[0], bytes=rates[1], local_packets=rates[2], local_bytes=rates[3], alone=own)
        )
    return usages, traffic


def one_fleet(
    nodes: int, tree: Path | None, seconds: float, *, lacks: Sequence[str], by_kind: bool
) -> tuple[list[Usage], list[Traffic], list[dict[str, float]]]:
    """Start a fleet of so many nodes, let it come to rest, measure it, and the kinds of its packets after that.

    ``lacks``: keys of ``scheduling:`` that ``tree`` does not know.
    """
    edges = nodes // 2
    fleet = echo_fleet(robots=nodes - edges, edges=edges)
    for task in fleet["tasks"].values():
        for key in lacks:
            del task["scheduling"][key]
    with tempfile.TemporaryDirectory() as folder, TreeBed(Path(folder), fleet) as bed:
        bed.tree = tree
        bed.limits = make_limits(f"zsched-idle-{os.getpid()}", dict.fromkeys(bed.names, CORES), MEMORY_MB)
        try:
            bed.init()
            owner = bed.wait_whole(120.0)
            time.sleep(REST_S)
            usages, traffic = measure(bed, owner, seconds)
            return usages, traffic, packet_kinds(bed, seconds) if by_kind else []
        finally:
            bed.stop()
            bed.limits.remove()


# --- telling ---------------------------------------------------------------------------------------------------------


def mean(values: Sequence[float]) -> float:
    """Arithmetic mean; 0 of none."""
    return statistics.fmean(values) if values else 0.0


def rows(nodes: int, name: str, usages: list[Usage], traffic: list[Traffic]) -> list[str]:
    """The table's rows of one tree: one per kind of process, and the node."""
    lines = []
    node = Counter[str]()
    for kind in KINDS:
        ours = [usage for usage in usages if usage.process.kind == kind]
        if not ours:
            continue
        figures = {
            "cpu": mean([sum(usage.cpu.values()) for usage in ours]),
            "wakeups": mean([sum(usage.wakeups.values()) for usage in ours]),
            "threads": mean([usage.threads for usage in ours]),
            "pss": mean([usage.pss for usage in ours]),
            "uss": mean([usage.uss for usage in ours]),
        }
        if kind in {"daemon", "relay"}:
            node.update({name: round(1000 * value) for name, value in figures.items()})
        lines.append(_row(nodes, name, kind, figures) + " | | | |")
    packets, size = mean([one.packets for one in traffic]), mean([one.bytes for one in traffic])
    local = mean([one.local_packets for one in traffic])
    lines.append(
        _row(nodes, name, "daemon + relay", {name: value / 1000 for name, value in node.items()})
        + f" {packets:.0f} | {size / 1000:.1f} | {local:.0f} | {mean([one.alone for one in traffic]):.1f} |"
    )
    return lines


def _row(nodes: int, name: str, kind: str, of: dict[str, float]) -> str:
    figures = f"{of['cpu']:.2f} | {of['wakeups']:.0f} | {of['threads']:.0f} | {of['pss']:.1f} | {of['uss']:.1f} |"
    return f"| {nodes} | {name} | {kind} | {figures}"


def thread_rows(nodes: int, name: str, usages: list[Usage]) -> list[str]:
    """CPU and wake-ups by kind of process and group of threads, the dearest first."""
    lines = []
    for kind in KINDS:
        ours = [usage for usage in usages if usage.process.kind == kind]
        groups = sorted({group for usage in ours for group in usage.cpu})
        found = [
            (
                mean([usage.cpu.get(group, 0.0) for usage in ours]),
                mean([usage.wakeups.get(group, 0.0) for usage in ours]),
                group,
            )
            for group in groups
        ]
        lines += [
            f"| {nodes} | {name} | {kind} | {group} | {cpu:.3f} | {wakeups:.1f} |"
            for cpu, wakeups, group in sorted(found, reverse=True)
        ]
    return lines


def main() -> None:
    """Print a table per process and node, for every size of fleet and each tree."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[6])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--other", type=Path)
    parser.add_argument("--lacks", nargs="*", default=[], metavar="KEY")
    parser.add_argument("--threads", action="store_true")
    parser.add_argument("--packets", action="store_true")
    given = parser.parse_args()
    trees: dict[str, Path | None] = {"this": None}
    if given.other is not None:
        trees["other"] = given.other.resolve()
    print(machine())
    tables, threads, packets = [], [], []
    for nodes in given.nodes:
        found: dict[str, tuple[list[Usage], list[Traffic]]] = {name: ([], []) for name in trees}
        kinds: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
        for number in range(given.rounds):
            for name in sorted(trees, reverse=bool(number % 2)):
                progress(f"{nodes} nodes, round {number + 1}, {name}")
                tree, lacks = trees[name], given.lacks if trees[name] else ()
                usages, traffic, of_kind = one_fleet(nodes, tree, given.seconds, lacks=lacks, by_kind=given.packets)
                found[name][0].extend(usages)
                found[name][1].extend(traffic)
                kinds[name].extend(of_kind)
        for name in trees:
            tables += rows(nodes, name, *found[name])
            threads += thread_rows(nodes, name, found[name][0])
            packets.append(
                f"| {nodes} | {name} | "
                + " | ".join(f"{mean([of[kind] for of in kinds[name]]):.1f}" for kind in PACKET_KINDS)
                + " |"
            )
    print(
        "| nodes | tree | process | CPU % | wake-ups/s | threads | PSS | USS | packets/s | kB/s | local | alone |",
        "| ---: | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        *tables,
        sep="\n",
    )
    if given.threads:
        print(
            "\n| nodes | tree | process | threads | CPU % | wake-ups/s |",
            "| ---: | --- | --- | --- | ---: | ---: |",
            sep="\n",
        )
        print(*threads, sep="\n")
    if given.packets:
        print(
            f"\n| nodes | tree | {' | '.join(PACKET_KINDS)} |",
            "| --- | --- |" + " ---: |" * len(PACKET_KINDS),
            sep="\n",
        )
        print(*packets, sep="\n")


if __name__ == "__main__":
    main()
