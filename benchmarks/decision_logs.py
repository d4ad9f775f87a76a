"""A fleet that decides for an hour, and then decides all of it again: are the judgements equal, bit for bit?

``python -m benchmarks.decision_logs [--minutes 60] [--robots 3] [--edges 2] [--timing wifi] [--seed 1] [--out DIR]``.
Robots and edges on loopback, each edge with a share of the CPU of its own, and two tasks: one by the paper's score, one
by service.
Every 5 to 25 s something happens, at random: a busy process in an edge's share, a daemon that is killed or stopped and
started again, one that stands still for seconds, or an operator's order by the real command (move, pin, pause, tune,
drain, and what ends them). Meanwhile every line of every node's decision log is copied before its
file is replaced. At the end ``zsched explain --replay`` judges each copy again, in a process of its own.

The exit code is 1 when one judgement comes out differently, or when a log has fewer lines than were read.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.common import machine
from zsched.core.values.model import NodeId
from zsched.host.decision_log import read_page
from zsched_lab.fleet.limits import NodeLimits, make_limits
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

SERVICE: Final = "service"
"""The second task."""
TASKS: Final = (TASK, SERVICE)
SHARE_CORES, SHARE_MB = 0.3, 600.0
SETTLED_S: Final = 600.0
"""How long a first owner may take on a machine that is busy with other work."""
PAUSES_S: Final = (5.0, 25.0)
COPY_S: Final = 20.0
CLI: Final = (sys.executable, "-m", "zsched.cli")
SPIN: Final = "while True: pass"
ORDER_S: Final = 60.0


def fleet(robots: int, edges: int, timing: str) -> Json:
    """The fleet file: the lab's, and a second task with everything as zsched has it by itself."""
    tree = echo_fleet(robots=robots, edges=edges, timing=timing)
    first = tree["tasks"][TASK]
    tree["tasks"][SERVICE] = {
        "candidates": first["candidates"],
        "weights": first["weights"],
        "demand": {"cpu_cores": 0.2},
        "worker": first["worker"],
        "inputs": [{"from": "{robot}/in2", "to": "{target}/service/{robot}/in"}],
        "outputs": [{"from": "{target}/service/{epoch}/{robot}/out", "to": "{robot}/out2"}],
    }
    return tree


@dataclass(slots=True)
class Copies:
    """The lines of every node's log, as far as they have been read."""

    state: Path
    """The folder with the nodes' state folders."""
    out: Path
    cursors: dict[NodeId, str] = field(default_factory=dict)

    def take(self, nodes: tuple[NodeId, ...]) -> None:
        """Copy what has come since the last time."""
        for node in nodes:
            with self.file(node).open("ab") as copy:
                has_more = True
                while has_more:
                    lines, cursor, has_more = read_page(self.state / node, self.cursors.get(node, ""))
                    self.cursors[node] = cursor
                    copy.writelines(line + b"\n" for line in lines)

    def file(self, node: NodeId) -> Path:
        """The copy of a node's log."""
        return self.out / f"{node}.ndjson"


class Disturbance:
    """What happens to the fleet; each kind at random, and every one ends by itself or is ended by a later one."""

    def __init__(self, bed: Testbed, limits: NodeLimits, random_: random.Random) -> None:
        self._bed, self._limits, self._random = bed, limits, random_
        self._loads: list[tuple[float, subprocess.Popen[bytes]]] = []
        self._down: dict[NodeId, float] = {}
        self._frozen: dict[NodeId, float] = {}
        self.counts: collections.Counter[str] = collections.Counter()
        self.refused = 0

    def start(self, *nodes: NodeId) -> None:
        """Start daemons, the edges in their shares."""
        for node in nodes:
            self._bed.start(node)
            self._limits.put(node, self._bed.pid(node))

    def tick(self, now: float) -> None:
        """End what is over."""
        for until, process in [one for one in self._loads if one[0] <= now]:
            _end(process)
            self._loads.remove((until, process))
        for node in [node for node, until in self._frozen.items() if until <= now]:
            self._bed.send(node, signal.SIGCONT)
            del self._frozen[node]
        for node in [node for node, until in self._down.items() if until <= now]:
            self.start(node)
            del self._down[node]

    def strike(self, now: float) -> None:
        """Do one thing; a daemon is hurt only while all others are well, so that a quorum is left."""
        kinds = ["load", "load", "load", "order", "order", "order", "order"]
        if not self._down and not self._frozen:
            kinds += ["kill", "crash", "stop", "freeze"]
        kind = self._random.choice(kinds)
        if kind == "load":
            self._load(now)
        elif kind == "order":
            kind = self._order()
        else:
            self._hurt(kind, now)
        self.counts[kind] += 1

    def end(self) -> None:
        """Nothing hurts any more, and every daemon runs."""
        self.tick(float("inf"))

    def _edge(self) -> NodeId:
        return self._random.choice([name for name in self._bed.names if name.startswith("edge")])

    def _load(self, now: float) -> None:
        process = subprocess.Popen([sys.executable, "-I", "-S", "-c", SPIN], preexec_fn=lambda: os.nice(19))  # noqa: PLW1509 - no threads here
        self._limits.put(self._edge(), process.pid)
        self._loads.append((now + self._random.uniform(5, 60), process))

    def _hurt(self, kind: str, now: float) -> None:
        node = self._edge() if self._random.random() < 0.7 else self._random.choice(self._bed.names)
        if kind == "freeze":
            self._bed.send(node, signal.SIGSTOP)
            self._frozen[node] = now + self._random.uniform(1, 8)
            return
        if kind == "stop":
            self._bed.stop(node)
        else:
            self._bed.kill(node, with_relay=kind == "kill")
        self._down[node] = now + self._random.uniform(0.5, 15)

    def _order(self) -> str:
        """Give one order; its name."""
        task, edge, choice = self._random.choice(TASKS), self._edge(), self._random
        cpu = choice.choice([0.2, 0.5, 0.8])
        words = choice.choice(
            [
                ("move", task, edge, "--detach"),
                ("move", task, edge, "--detach"),
                ("pin", task, edge, "--for", f"{choice.randint(5, 40)}s"),
                ("unpin", task),
                ("pause", task, "--for", f"{choice.randint(5, 30)}s"),
                ("resume", task),
                ("tune", task, f"bonus={choice.choice([0.02, 0.1, 0.3])}"),
                ("tune", task, f"price_s={choice.choice(['null', '0.05', '0.3'])}"),
                ("tune", task, f"cpu={cpu}", f"memory={1 - cpu:.1f}", "network=0"),
                ("drain", edge, "--detach", "--for", f"{choice.randint(10, 60)}s"),
                ("undrain", edge),
                ("drain", edge, "--only", "new", "--for", f"{choice.randint(10, 60)}s"),
            ]
        )
        self.refused += self.zsched(*words, "--yes") != 0
        return words[0]

    def zsched(self, *words: str) -> int:
        """The real command, at a robot that runs; its exit code."""
        robots = [name for name in self._bed.running() if name.startswith("robot") and name not in self._frozen]
        where = ("--runtime-dir", str(self._bed.folder), "--node", robots[0])
        command = [*CLI, *words, *where]
        try:
            done = subprocess.run(command, capture_output=True, timeout=ORDER_S, check=False)
        except subprocess.TimeoutExpired:
            return -1
        return done.returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def run(bed: Testbed, copies: Copies, seconds: float, seed: int) -> Disturbance:
    """Let the fleet decide for so long, and copy its logs."""
    random_ = random.Random(seed)
    edges = {name: SHARE_CORES for name in bed.names if name.startswith("edge")}
    limits = make_limits(f"decision-logs-{os.getpid()}", edges, SHARE_MB)
    print(f"# {limits.says}", flush=True)
    disturbance = Disturbance(bed, limits, random_)
    try:
        bed.init()
        disturbance.start(*bed.names)
        bed.wait_settled(SETTLED_S)
        agreed = bed.folder / "agreed.yaml"
        agreed.write_text(bed.file.read_text())
        if disturbance.zsched("apply", str(agreed), "--yes") != 0:
            raise SystemExit("the fleet's document is not agreed")
        start = time.monotonic()
        next_strike = next_copy = start
        while (now := time.monotonic()) < start + seconds:
            disturbance.tick(now)
            if now >= next_strike:
                disturbance.strike(now)
                next_strike = time.monotonic() + random_.uniform(*PAUSES_S)
            if now >= next_copy:
                copies.take(bed.names)
                next_copy = now + COPY_S
            time.sleep(0.2)
    finally:
        disturbance.end()
        bed.stop()
        copies.take(bed.names)
        limits.remove()
    return disturbance


def replay(file: Path) -> Json:
    """What ``zsched explain --replay --json`` says of one log."""
    done = subprocess.run([*CLI, "explain", "--replay", str(file), "--json"], capture_output=True, check=False)
    if not done.stdout:
        return {"judged": 0, "equal": False, "said": done.stderr.decode(errors="replace").strip()}
    said: Json = json.loads(done.stdout)
    return said


def told(file: Path) -> dict[str, Any]:
    """How much a log tells of: lines, lives, judgements, of them by outcome, moves."""
    entries = [json.loads(line) for line in file.read_bytes().splitlines()]
    decisions = [entry["decision"] for entry in entries if entry.get("decision") is not None]
    return {
        "lines": len(entries),
        "kB": file.stat().st_size // 1000,
        "lives": len({entry["life"] for entry in entries}),
        "judgements": len(decisions),
        "outcomes": collections.Counter(one["verdict"]["outcome"] for one in decisions),
        "moves": sum(1 for entry in entries if entry.get("move") is not None),
    }


def main() -> int:
    """Print a line for each node and the sums; 1 when a judgement is not equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--edges", type=int, default=2)
    parser.add_argument("--timing", default="wifi", choices=["wired", "wifi", "wan"])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="keep the copies of the logs here")
    options = parser.parse_args()
    print(machine(), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        out: Path = options.out or Path(scratch) / "logs"
        out.mkdir(parents=True)
        tree = fleet(options.robots, options.edges, options.timing)
        with tempfile.TemporaryDirectory() as folder, Testbed(Path(folder), tree) as bed:
            copies = Copies(state=Path(folder), out=out)
            disturbance = run(bed, copies, options.minutes * 60, options.seed)
            nodes = bed.names
        print(f"what happened: {dict(sorted(disturbance.counts.items()))}; orders refused: {disturbance.refused}")
        return report(copies, nodes)


def report(copies: Copies, nodes: tuple[NodeId, ...]) -> int:
    """Replay each copy and print what it holds; 1 when one is not equal."""
    unequal = judged = 0
    outcomes: collections.Counter[str] = collections.Counter()
    for node in nodes:
        held, again = told(copies.file(node)), replay(copies.file(node))
        is_equal = again["equal"] and again["judged"] == held["judgements"]
        unequal += not is_equal
        judged += held["judgements"]
        outcomes += held["outcomes"]
        counts = " ".join(f"{name} {held[name]}" for name in ("lines", "kB", "lives", "judgements", "moves"))
        print(f"{node:<8} {counts}  {'equal' if is_equal else f'NOT EQUAL: {again}'}", flush=True)
    print(f"{judged} judgements made again ({dict(sorted(outcomes.items()))}); logs with a difference: {unequal}")
    return 1 if unequal else 0


if __name__ == "__main__":
    sys.exit(main())
