"""Trigger -> committed with 3, 6, 12, 24 and 48 nodes, and how messages and CPU grow with their number.

``python -m benchmarks.scale [--nodes 3 6 12 24 48] [--n 20] [--timing wifi] [--together] [--out FOLDER]``; with
``--out`` a size that is done is not measured again. Half of the nodes are robots (voters and
electors; of three nodes one is, and all elect), half edges; every pair has a zenoh link on loopback.

What runs: the real `Node`, `ControlBus` (a zenoh session per node, meshed by gossip), codec and state file (fsync
included), a process per node. What is left out: relays, workers (reported ready as soon as they shall start), profilers
(a fixed sample per period), the operator's socket. With ``--together`` there are only as many processes as cores: the
loops of one process then wait for one another at Python's lock. Where all nodes together need more CPU than there is,
the figures are of the cores, not of zsched: "busy" says how much of them the fleet has at rest.

A trigger is a failure of the owner's worker, told by its profile: from the first robot's proposal to the first node
that learns the newer epoch (committed), and to the last (everywhere).
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import random
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import IO, Any

from benchmarks.common import machine, mean
from benchmarks.record import Record, Row, progress, save, table
from zsched.commands.members.blank import init_state
from zsched.config.load import load_fleet
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.profile import DeviceSample, WorkerState
from zsched.host.clock import monotonic_s
from zsched.host.state_file import StateFile
from zsched.link.bus.control_bus import ControlBus
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions.endpoints import endpoints_for, free_port
from zsched_lab.fleet.testbed import TASK, echo_fleet

GOAL = "p99 50 ms at 6"
IDLE_S = 5.0
SETTLED_S = 1.0
START_S = 240.0
"""48 nodes in two processes have 1128 links to make."""
SAMPLE = DeviceSample(cpu_cores=4.0, cpu_used_cores=1.0, memory_mb=4096.0, memory_used_mb=1024.0)


class Loop:
    """One node: its loop in a thread, what it tells on ``lines``."""

    def __init__(self, fleet: Fleet, name: NodeId, folder: Path, lines: queue.SimpleQueue[dict[str, Any]]) -> None:
        self._fleet, self._name, self._lines = fleet, name, lines
        self._events: queue.SimpleQueue[ev.Event] = queue.SimpleQueue()
        self._file = StateFile(folder / name, fleet=fleet.name, node=name)
        self._file.acquire()
        durable = self._file.load().state
        incarnation = durable.incarnation if durable is not None else 1
        points = endpoints_for(fleet, fleet.node(name), free_port)
        config = zenoh_config.control_config(
            listen=points.control_listen, connect=points.control_connect, timing=fleet.timing, dials_by_gossip=False
        )
        self._bus = ControlBus(
            fleet=fleet.name,
            node=name,
            incarnation=incarnation,
            zenoh_config=config,
            post=self._events.put,
            is_voter=fleet.node(name).kind is NodeKind.ROBOT,
            hears_all_beats_at_once=False,
        )
        self._node = Node(
            fleet=fleet,
            me=name,
            durable=durable,
            incarnation=incarnation,
            electorate=electorate_hash(fleet),
            rng=random.Random(name),
            now=monotonic_s(),
        )
        self.received = self.sent = 0
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def tell(self, state: WorkerState) -> None:
        """The worker's state changes."""
        self._events.put(ev.WorkerChanged(task=TASK, state=state))

    def _run(self) -> None:
        self._bus.open()
        self._carry_out(self._node.start(monotonic_s()))
        sample_at = 0.0
        while True:
            wait = min(self._node.next_deadline(), sample_at) - monotonic_s()
            try:
                event = self._events.get(timeout=wait) if wait > 0 else self._events.get_nowait()
                self.received += 1
            except queue.Empty:
                event = ev.DeadlineReached()
            now = monotonic_s()
            if now >= self._node.next_deadline():
                for frame in self._bus.waiting():
                    self.received += 1
                    self._node.absorb(frame, now)
            now = monotonic_s()
            self._carry_out(self._node.handle(event, now))
            if now >= sample_at:
                sample_at = now + self._fleet.timing.sample_s
                self._carry_out(self._node.handle(ev.ProfileSampled(device=SAMPLE), now))

    def _carry_out(self, batch: tuple[do.Instruction, ...]) -> None:
        bus = self._bus
        for one in batch:
            self.sent += isinstance(one, do.PublishBeat | do.PublishProfile | do.PublishProposal | do.PublishLearnt)
            match one:
                case do.PersistState(state=state):
                    self._file.save(state)
                case do.PublishBeat(beat=value, is_news=is_news):
                    bus.publish("beat" if is_news else "beat_in_turn", value)
                case do.PublishProfile(profile=value, is_news=is_news):
                    bus.publish("profile" if is_news else "profile_in_turn", value)
                case do.PublishProposal(proposal=value):
                    bus.publish("proposal", value)
                case do.PublishLearnt(learnt=value):
                    bus.publish("allocation", value)
                case do.AskUtilities(gather=gather, deadline_s=deadline_s):
                    bus.ask_utilities(gather, deadline_s)
                case do.SendPrepare(prepare=question, deadline_s=deadline_s):
                    bus.ask_electors(question, deadline_s)
                case do.SendAccept(accept=question, deadline_s=deadline_s):
                    bus.ask_electors(question, deadline_s)
                case do.AskLearnt(peer=peer, deadline_s=deadline_s):
                    bus.ask_learnt(peer, deadline_s)
                case do.AnswerUtilities(request=request, utilities=answer):
                    bus.answer(request, answer)
                case do.AnswerElection(request=request, answer=answer):
                    bus.answer(request, answer)
                case do.AnswerLearnt(request=request, learnt=answer):
                    bus.answer(request, answer)
                case do.StartWorker():
                    self.tell(WorkerState.READY)
                case do.RecordStory(stage=stage, text=text):
                    self._lines.put({"at": monotonic_s(), "node": self._name, "stage": stage, "text": text})
                case _:
                    pass  # routes, roles, operators: left out


def child(config: Path, folder: Path, names: list[NodeId]) -> None:
    """Run some of the nodes; commands on standard input, one JSON object a line; stories on standard output."""
    fleet = load_fleet(config)
    os.environ.setdefault("ZENOH_RUNTIME", zenoh_config.daemon_pools(len(fleet.nodes)))
    lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_write, args=(lines,), daemon=True).start()
    loops = {name: Loop(fleet, name, folder, lines) for name in names}
    for text in sys.stdin:
        command = json.loads(text)
        if command["do"] == "count":
            times = os.times()
            counts = {"received": sum(loop.received for loop in loops.values())}
            counts["sent"] = sum(loop.sent for loop in loops.values())
            lines.put({"count": counts, "cpu_s": times.user + times.system, "at": monotonic_s()})
        elif command["node"] in loops:
            loops[command["node"]].tell(WorkerState(command["do"]))
    os._exit(0)


def _write(lines: queue.SimpleQueue[dict[str, Any]]) -> None:
    while True:
        print(json.dumps(lines.get()), flush=True)


class Group:
    """The processes of one fleet size."""

    def __init__(self, nodes: int, timing: str, folder: Path, *, is_together: bool) -> None:
        edges = max(nodes // 2, 2)  # with one there is nowhere to go
        tree = echo_fleet(robots=nodes - edges, edges=edges, timing=timing)
        if nodes - edges < 3:
            tree["electorate"] = sorted(tree["nodes"])
        tree["tasks"][TASK]["weights"] = {"cpu": 1.0, "memory": 0.0, "network": 0.0}
        self.file = folder / "fleet.yaml"
        self.file.write_text(json.dumps(tree))
        self.names = sorted(tree["nodes"])
        fleet = load_fleet(self.file)
        for name in self.names:
            init_state(fleet, name, folder / name, 0)
        self.stories: list[dict[str, Any]] = []
        self.counts: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._children = []
        count = min(os.cpu_count() or 1, nodes) if is_together else nodes
        for index in range(count):
            command = [sys.executable, "-m", "benchmarks.scale", "--child", str(self.file), str(folder)]
            process = subprocess.Popen(
                [*command, *self.names[index::count]],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, "RUST_LOG": "off"},  # zenoh writes to standard output, in the middle of our lines
            )
            assert process.stdout is not None
            self._children.append(process)
            threading.Thread(target=self._read, args=(process.stdout,), daemon=True).start()

    def _read(self, stdout: IO[bytes]) -> None:
        for text in stdout:
            if not text.startswith(b"{"):
                continue
            told = json.loads(text)
            self.counts.put(told) if "count" in told else self.stories.append(told)

    def tell(self, **command: str) -> None:
        """Send a command to every process."""
        for process in self._children:
            assert process.stdin is not None
            process.stdin.write(json.dumps(command).encode() + b"\n")
            process.stdin.flush()

    def told(self, since: int, *words: str) -> list[dict[str, Any]]:
        """Stories from number ``since`` on that hold all words."""
        return [one for one in self.stories[since:] if all(word in one["text"] for word in words)]

    def wait(self, since: int, count: int, *words: str, within_s: float = 120.0) -> list[dict[str, Any]]:
        """Until ``count`` nodes have told it."""
        end = time.monotonic() + within_s
        while time.monotonic() < end:
            found = self.told(since, *words)
            if len({one["node"] for one in found}) >= count:
                return found
            time.sleep(0.005)
        raise SystemExit(f"only {len(self.told(since, *words))} of {count} nodes told {words}")

    def owner(self) -> NodeId:
        """The newest learnt owner."""
        last = self.told(0, "learnt revision")[-1]["text"]
        return str(last.split("owner ")[1].split(",")[0])

    def snapshot(self) -> dict[str, float]:
        """Messages and CPU seconds of all processes so far."""
        self.tell(do="count", node="")
        found = [self.counts.get(timeout=30) for _ in self._children]
        totals = {key: float(sum(one["count"][key] for one in found)) for key in ("sent", "received")}
        return {**totals, "cpu_s": sum(one["cpu_s"] for one in found), "at": mean([one["at"] for one in found])}

    def close(self) -> None:
        """End every process."""
        for process in self._children:
            process.kill()
            process.wait(10)


def measure(group: Group, count: int) -> Row:
    """The idle load, then ``count`` triggers."""
    nodes = len(group.names)
    start = time.monotonic()
    group.wait(0, nodes, "learnt revision 1:", within_s=START_S)
    progress(f"{nodes} nodes: one owner after {time.monotonic() - start:.1f} s")
    time.sleep(2 * SETTLED_S)
    before = group.snapshot()
    time.sleep(IDLE_S)
    after = group.snapshot()
    seconds = after["at"] - before["at"]
    rates = {key: (after[key] - before[key]) / seconds / nodes for key in ("sent", "received", "cpu_s")}
    committed, everywhere = [], []
    for number in range(count):
        since, owner = len(group.stories), group.owner()
        group.tell(do="failed", node=owner)
        learnt = group.wait(since, nodes, "learnt revision")
        proposed = group.told(since, "propose ")
        begin = min(one["at"] for one in proposed)
        committed.append((min(one["at"] for one in learnt) - begin) * 1000)
        everywhere.append((max(one["at"] for one in learnt) - begin) * 1000)
        progress(
            f"{nodes} nodes {number + 1}/{count}: committed {committed[-1]:.0f}, everywhere {everywhere[-1]:.0f} ms"
        )
        group.tell(do="ready", node=owner)
        time.sleep(SETTLED_S)
    return {"committed": committed, "everywhere": everywhere, "idle": rates}


def report(record: Record, timing: str, folder: Path | None, name: str) -> None:
    """Print what there is, and keep it."""
    rows = sorted(record.having(timing=timing), key=lambda row: row["nodes"])
    figures = []
    for row in rows:
        figures.append((f"{row['nodes']} nodes: trigger -> committed", row["committed"], GOAL))
        figures.append((f"{row['nodes']} nodes: trigger -> known everywhere", row["everywhere"], "-"))
    print(table(figures, f"ms ({timing})"))
    print("| idle, per node | puts/s | frames/s in | % of a core | busy |", "| --- | --- | --- | --- | --- |", sep="\n")
    cores = os.cpu_count() or 1
    for row in rows:
        idle = row["idle"]
        busy = 100 * idle["cpu_s"] * row["nodes"] / cores
        rates = f"{idle['sent']:.1f} | {idle['received']:.1f} | {100 * idle['cpu_s']:.1f}"
        print(f"| {row['nodes']} nodes | {rates} | {busy:.0f} % |")
    save(folder, name, {"rows": rows})


def main() -> None:
    """Measure every size that is missing, then print the tables."""
    if "--child" in sys.argv:
        _, _, config, folder, *names = sys.argv
        child(Path(config), Path(folder), list(names))
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[3, 6, 12, 24, 48])
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--timing", default="wifi", choices=["wifi", "wired"])
    parser.add_argument("--together", action="store_true", help="as many processes as cores, not one per node")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    print(machine(), flush=True)
    name = f"scale-{given.timing}{'-together' * given.together}"
    record = Record(given.out, name)
    for nodes in given.nodes:
        if any(len(row["committed"]) >= given.n for row in record.having(nodes=nodes, timing=given.timing)):
            continue
        with tempfile.TemporaryDirectory() as folder:
            group = Group(nodes, given.timing, Path(folder), is_together=given.together)
            try:
                record.add({"nodes": nodes, "timing": given.timing} | measure(group, given.n))
            except SystemExit as error:
                progress(f"{nodes} nodes: {error}")
            finally:
                group.close()
    report(record, given.timing, given.out, name)


if __name__ == "__main__":
    main()
