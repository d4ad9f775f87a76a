"""A large map over a thin radio while a second target of the robot stands still: does every map arrive, and control?

``python -m benchmarks.thin_link [--minutes 2] [--mbit 20] [--class latest] [--size 4194304] [--every 4]``. Needs root:
real daemons in network namespaces; what leaves robot1 passes a token bucket of ``--mbit`` with a queue of 100 ms. Its
application puts a map every 4 s. One task takes it to edge1, whose echo worker answers; a second task takes the same
map to edge2, whose worker is frozen in the second half. Control: 200 B at 20 Hz from robot1 to edge1 over a session of
their own that is set up like the daemons' control session; one-way latency (the namespaces share one clock).

Printed: maps put and come back, how long each took, control latency with no map, with maps, and with the frozen target;
who suspected whom meanwhile (goal: nobody alive).
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from pathlib import Path

from benchmarks.common import line, machine
from zsched.core.values.model import PeerState
from zsched.host.clock import monotonic_s
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import PROBE, Netbed, Probe, descendants_running
from zsched_lab.fleet.testbed import Json, echo_fleet

PING_PORT = 7990
WORKER = "zsched.tasks.echo"
FROZEN_FOR_S = 3600.0
"""A worker that is not ready for so long is restarted: the frozen one must stay as it is."""


def main() -> None:
    """Print the figures of one run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--mbit", type=float, default=20.0)
    parser.add_argument("--size", type=int, default=4 << 20)
    parser.add_argument("--class", dest="stream_class", choices=("latest", "reliable"), default="latest")
    parser.add_argument("--every", type=float, default=4.0, help="seconds between two maps")
    options = parser.parse_args()
    reason = netns.why_not()
    if reason is not None:
        raise SystemExit(f"no network namespaces here: {reason}")
    print(machine())
    with tempfile.TemporaryDirectory() as folder, Netbed(Path(folder), _fleet(options.stream_class)) as bed:
        bed.init()
        bed.start()
        bed.wait(lambda: all(_is_ready(bed, task) for task in ("echo", "second")), 60.0, "both tasks have their owners")
        _run(bed, options)


def _fleet(stream_class: str) -> Json:
    """One robot, two edges, and a task for each edge that takes the robot's map."""
    tree = echo_fleet(robots=1, edges=2)
    body = tree["tasks"]["echo"]
    rules = {"class": stream_class}
    for task, edge in (("echo", "edge1"), ("second", "edge2")):
        tree["tasks"][task] = {
            **body,
            "worker": {**body["worker"], "start_deadline_s": FROZEN_FOR_S},
            "candidates": [edge],
            "inputs": [{"from": "{robot}/map", "to": f"{{target}}/{task}/{{robot}}/in", **rules}],
            "outputs": [{"from": f"{{target}}/{task}/{{epoch}}/{{robot}}/out", "to": f"{{robot}}/{task}", **rules}],
        }
    return tree


def _is_ready(bed: Netbed, task: str) -> bool:
    """Whether the robot's streams of a task have reached their owner."""
    tasks = {one["name"]: one for one in bed.status("robot1")["tasks"]}
    found = tasks.get(task, {})
    return bool(found.get("owner")) and found.get("phase") == "settled"


def _run(bed: Netbed, options: argparse.Namespace) -> None:
    listens = zenoh_config.control_config(listen=(f"tcp/0.0.0.0:{PING_PORT}",), connect=())
    there = f"tcp/{bed.network.address('edge1')}:{PING_PORT}"
    dials = zenoh_config.control_config(listen=("tcp/127.0.0.1:0",), connect=(there,))
    ears = _probe(bed, "edge1", listens, "--watch", "ping")
    mouth = _probe(bed, "robot1", dials, "--put", "ping", "--hz", "20", "--size", "200")
    try:
        bed.wait(lambda: len(ears.received) > 20, 20.0, "control messages")
        bed.network.narrow("robot1", options.mbit)
        seconds = options.minutes * 60
        began = monotonic_s()
        time.sleep(min(20.0, seconds / 4))
        quiet_until = monotonic_s()
        maps = bed.probe("robot1", put="robot1/map", hz=1 / options.every, size=options.size, watch=("robot1/echo",))
        time.sleep(seconds / 2)
        frozen_at = monotonic_s()
        for pid in _worker_pids(bed, "edge2"):
            os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds / 2)
        ended = monotonic_s()
        time.sleep(options.every * 1.5)  # the last map's way
        spans = (("no map", began, quiet_until), ("maps", quiet_until, frozen_at), ("frozen", frozen_at, ended))
        _report(bed, maps, ears, spans, options)
    finally:
        for pid in _worker_pids(bed, "edge2"):
            os.kill(pid, signal.SIGCONT)
        mouth.close()
        ears.close()


def _probe(bed: Netbed, node: str, config: str, *arguments: str) -> Probe:
    with (bed.folder / f"ping-{node}.log").open("ab") as log:
        return Probe(bed.network.wrap(node, [*PROBE, config, *arguments]), log)


def _worker_pids(bed: Netbed, node: str) -> list[int]:
    return descendants_running(bed.pid(node), WORKER)


def _report(
    bed: Netbed,
    maps: Probe,
    ears: Probe,
    spans: tuple[tuple[str, float, float], ...],
    options: argparse.Namespace,
) -> None:
    for name, start, end in spans:
        delays = [(one.at - one.sent_at) * 1000 for one in ears.received if start < one.sent_at < end]
        if delays:
            print(line(f"control one way, {name}", delays, "ms", "-"))
        due = round((end - start) * 20)
        print(f"  received {len(delays)} of about {due}")
    for name, start, end in spans[1:]:
        back = {one.number: one for one in maps.received if start < one.sent_at < end - options.every}
        numbers = sorted(back)
        missing = (numbers[-1] - numbers[0] + 1 - len(numbers)) if numbers else 0
        print(f"maps, {name}: {len(numbers)} came back, {missing} missing between them")
        took = [(one.at - one.sent_at) * 1000 for one in back.values()]
        if took:
            print(line(f"  a map of {options.size} B there and back", took, "ms", "every one"))
    streams = [one for task in bed.status("robot1")["tasks"] for one in task.get("streams", [])]
    again = {one["stream"]: one.get("replayed", 0) for one in streams if one["stream"].endswith("in/0")}
    print(f"samples that were put once more: {again}")
    bad = [one for one in bed.changes(since=spans[0][1]) if one.after is not PeerState.ALIVE]
    print(f"held for suspect or gone meanwhile: {len(bad)} {[(one.observer, one.node, one.reason) for one in bad[:5]]}")


if __name__ == "__main__":
    main()
