"""The owner fails in four ways -> detected -> committed -> first message through the new owner; and a cut that heals.

``python -m benchmarks.detection [--timing wired wifi] [--case killed worker frozen cut heal] [--n N] [--kills N]
[--rest S] [--loss P] [--out FOLDER] [--table]``. Needs root: six daemons in network namespaces with echo workers and a
price of 0, an application on robot1 that publishes at 200 Hz on its own key. Several timings run side by side, each
with a fleet of its own. With ``--rest 6`` each fault meets a fleet at rest, whose beats are slow; with ``--loss 20``
one whose links lose that many of 100 packets. With ``--out`` every cycle is on disk at once: the same command goes on
where it was interrupted, ``--table`` only prints what is there.

* detected: the first robot holds the owner for gone (``worker``: its daemon sees the process end);
* committed: the first node learns a newer epoch (``worker``: no move, the worker restarts in place);
* first message: the first echo, by another owner (``worker``: by any), of a message that was sent after the fault;
* heal: one robot and the owner cut off for 20 s; from the end of the cut until all nodes agree on one revision, and
  until everybody is alive to everybody again.

Detection and commit are read from the daemons' logs (one host, one clock, whole milliseconds).
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.common import machine
from benchmarks.record import Record, progress, save, summary, table, together
from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import Netbed, Probe, descendants_running, stamped, stop_group
from zsched_lab.fleet.testbed import TASK, TestbedError, echo_fleet

GOALS = {
    ("killed", "wifi"): "p99 300 ms",
    ("killed", "wired"): "p99 300 ms",
    ("frozen", "wifi"): "p90 2000 ms",
    ("cut", "wifi"): "p90 2000 ms",
    ("frozen", "wired"): "p90 900 ms",
    ("cut", "wired"): "p90 900 ms",
}
CUT_S = 20.0
RECOVERY_S = 3.0
"""After a cut, TCP's own timers hold a link's streams back for up to so long; the next fault waits for it."""
CYCLE_S = 1.2
"""No more than 50 faults a minute: escapes are bounded at 60 (`zsched.core.scheduler.fuse`), not measured here."""
CASES = ("killed", "worker", "frozen", "cut", "heal")
MAX_FAILURES = 5
CALM_S = 90.0


class Cycle:
    """What the logs say since one fault."""

    def __init__(self, bed: Netbed) -> None:
        self._bed = bed
        self._sizes = {node: (bed.folder / f"{node}.log").stat().st_size for node in bed.names}
        self.at = monotonic_s()

    def first_ms(self, nodes: tuple[NodeId, ...], *words: str) -> float | None:
        """When one of ``nodes`` first wrote a line with all ``words``: milliseconds after the fault."""
        found = []
        for node in nodes:
            with (self._bed.folder / f"{node}.log").open("rb") as file:
                file.seek(self._sizes[node])
                text = file.read().decode(errors="replace")
            found += [at for at, one in stamped(text) if all(word in one for word in words)]
        return (min(found) - self.at) * 1000 if found else None


class Cases:
    """One fleet and the faults it goes through."""

    def __init__(self, bed: Netbed, probe: Probe, rest_s: float, loss: int) -> None:
        self.bed, self.probe, self.rest_s, self.loss = bed, probe, rest_s, loss
        self._heal()
        self.next_at = 0.0

    def _heal(self) -> None:
        """End every cut; what links lose, they lose on."""
        self.bed.network.heal()
        if self.loss:
            self.bed.network.lose(self.loss, *self.bed.names)

    def is_ready(self) -> bool:
        """Whether everybody is alive, every worker ready, and messages flow."""
        nodes = self.bed.status("robot1")["nodes"]
        is_up = all(
            node["state"] == "alive"
            and (node["age_s"] or 0.0) < 1.5
            and all(load["state"] == "ready" for load in node["workers"])
            for node in nodes
        )
        return is_up and self.bed.owner() is not None and self.probe.is_flowing()

    def kill(self, owner: NodeId) -> Callable[[], None]:
        """SIGKILL the daemon; its relay and workers die with it."""
        self.bed.kill(owner)
        return lambda: self.bed.start(owner)

    def freeze(self, owner: NodeId) -> Callable[[], None]:
        """SIGSTOP everything of the owner: the machine stands still."""
        stop_group(self.bed.pid(owner), signal.SIGSTOP)
        return lambda: stop_group(self.bed.pid(owner), signal.SIGCONT)

    def cut(self, owner: NodeId) -> Callable[[], None]:
        """No packet in or out any more."""
        self.bed.network.cut(owner)
        return self._heal

    def kill_worker(self, owner: NodeId) -> Callable[[], None]:
        """SIGKILL the worker process; its daemon starts another."""
        for pid in descendants_running(self.bed.pid(owner), "zsched.tasks.echo"):
            os.kill(pid, signal.SIGKILL)
        return lambda: None

    def run(self, name: str, fault: Callable[[NodeId], Callable[[], None]]) -> dict[str, float]:
        """One cycle; {step: milliseconds} of the steps that were seen."""
        self.bed.wait(self.is_ready, CALM_S, "a calm fleet")
        self.next_at = max(self.next_at, monotonic_s() + self.rest_s)
        self.bed.wait(lambda: monotonic_s() > self.next_at, CYCLE_S + self.rest_s + 1, "the next cycle")
        self.next_at = monotonic_s() + CYCLE_S
        owner = self.bed.owner() or ""
        others = tuple(node for node in self.bed.names if node != owner)
        epoch = self.bed.task("robot1")["epoch"]
        cycle = Cycle(self.bed)
        mend = fault(owner)
        if name in {"frozen", "cut"}:
            cycle.at = monotonic_s()  # until now the fault was being made, and messages still came through
        first = self.bed.wait(
            lambda: self.probe.first_after(cycle.at, but_of="" if name == "worker" else owner), 30, "an echo"
        )
        if name == "worker":
            steps = {"detected": cycle.first_ms((owner,), "worker stopped")}
        else:
            self.bed.wait(lambda: self.bed.owner(*others) not in (None, owner), 30, "a new owner")
            steps = {
                "detected": cycle.first_ms(self.bed.fleet.voters, f"membership {owner} ", "-> gone"),
                "committed": cycle.first_ms(others, f"task={TASK} epoch={epoch + 1} learnt"),
            }
        mend()
        if name in {"frozen", "cut"}:
            mended = monotonic_s()
            self.bed.wait(lambda: monotonic_s() > mended + RECOVERY_S, RECOVERY_S + 5, "TCP's timers")
        steps["first message"] = (first.at - cycle.at) * 1000 if first is not None else None
        return {step: value for step, value in steps.items() if value is not None}

    def heal(self) -> dict[str, float]:
        """Cut robot3 and the owner off together, heal, and wait."""
        self.bed.wait(self.is_ready, CALM_S, "a calm fleet")
        owner = self.bed.owner() or ""
        ours = {"robot3", owner}
        theirs = tuple(node for node in self.bed.names if node not in ours)
        self.bed.network.separate(ours, theirs)
        start = monotonic_s()
        self.bed.wait(lambda: monotonic_s() > start + CUT_S, CUT_S + 5, "the cut")
        self._heal()
        healed = monotonic_s()
        self.bed.wait(lambda: self._revisions() == 1, 30, "one revision")
        agreed = (monotonic_s() - healed) * 1000
        self.bed.wait(self._is_whole, 60, "everybody alive to everybody")
        return {"one revision": agreed, "all alive": (monotonic_s() - healed) * 1000}

    def _revisions(self) -> int:
        return len({self.bed.task(node)["revision"] for node in self.bed.names})

    def _is_whole(self) -> bool:
        return all(peer["state"] == "alive" for node in self.bed.names for peer in self.bed.status(node)["nodes"])


def measure(cases: Cases, record: Record, name: str, count: int, timing: str) -> None:
    """Run what is missing of ``count`` cycles of one case."""
    faults = {"killed": cases.kill, "worker": cases.kill_worker, "frozen": cases.freeze, "cut": cases.cut}
    for number in range(len(record.having(case=name, timing=timing)), count):
        start = time.monotonic()
        found = cases.heal() if name == "heal" else cases.run(name, faults[name])
        took_s = time.monotonic() - start
        record.add({"case": name, "timing": timing, "steps": found, "cycle_s": round(took_s, 2)})
        steps = ", ".join(f"{step} {value:.0f}" for step, value in found.items())
        progress(f"{timing} {name} {number + 1}/{count}: {steps} ms (cycle {took_s:.1f} s)")


def run(record: Record, given: argparse.Namespace, timing: str) -> None:
    """One timing profile: every case with a fresh fleet, as often as it takes."""
    counts = {"killed": given.kills, "heal": given.heals}
    for name in given.case:
        count = counts.get(name, given.n)
        failures = 0
        while len(record.having(case=name, timing=timing)) < count:
            try:
                with_fleet(timing, given.rest, given.loss, lambda cases: measure(cases, record, name, count, timing))  # noqa: B023 - called at once
            except TestbedError as error:
                failures += 1
                record.add({"case": f"{name}, failed", "timing": timing, "why": str(error)[:4000]})
                progress(f"{timing} {name}: a cycle failed, a fresh fleet goes on: {str(error).splitlines()[0]}")
                if failures >= MAX_FAILURES:
                    raise


def with_fleet(timing: str, rest_s: float, loss: int, use: Callable[[Cases], None]) -> None:
    """A fleet and an application for some cycles, each of which begins after ``rest_s`` of calm."""
    tree = echo_fleet(timing=timing)
    tree["tasks"][TASK]["worker"] |= {"max_failures": 100, "failure_window_s": 1}  # many deaths on purpose
    with tempfile.TemporaryDirectory() as folder, Netbed(Path(folder), tree) as bed:
        bed.init()
        bed.start()
        use(Cases(bed, bed.probe("robot1", put="robot1/in", hz=200, watch=["robot1/out"]), rest_s, loss))


def report(records: dict[str, Record], folder: Path | None) -> None:
    """Print the distributions and keep them."""
    rows: list[tuple[str, list[float], str]] = []
    for timing, record in records.items():
        for name in CASES:
            found = [row["steps"] for row in record.having(case=name, timing=timing)]
            for step in dict.fromkeys(step for steps in found for step in steps):
                values = [steps[step] for steps in found if step in steps]
                goal = GOALS.get((name, timing), "-") if step == "first message" else "-"
                rows.append((f"{timing}: {name} -> {step}", values, goal))
            if failed := record.having(case=f"{name}, failed", timing=timing):
                print(f"{timing}: {name}: {len(failed)} cycles failed (see the rows)")
    print(table(rows, "ms after the fault"))
    save(folder, "detection", {"ms": {name: summary(values) for name, values, _ in rows if values}})


def main() -> int:
    """Print the distributions; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--timing", nargs="+", default=["wired", "wifi"], choices=["wifi", "wired"])
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--n", type=int, default=40)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--heals", type=int, default=5)
    parser.add_argument("--rest", type=float, default=0.0, help="seconds of calm before each fault")
    parser.add_argument("--loss", type=int, default=0, help="packets of 100 that are lost on their way in")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    reason = netns.why_not()
    if reason is not None and not given.table:
        print(f"no network namespaces here: {reason}", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.out or Path(scratch)
        if given.child:
            run(Record(folder, f"detection-{given.timing[0]}"), given, given.timing[0])
            return 0
        code = 0
        if not given.table:
            print(machine(), flush=True)
            numbers = ["--n", given.n, "--kills", given.kills, "--heals", given.heals, "--out", folder, "--child"]
            numbers += ["--rest", given.rest, "--loss", given.loss]
            shared = [*map(str, numbers), "--case", *given.case]
            code = together("benchmarks.detection", [["--timing", timing] for timing in given.timing], shared)
        report({timing: Record(folder, f"detection-{timing}") for timing in given.timing}, given.out)
    return code


if __name__ == "__main__":
    sys.exit(main())
