"""What floods do to a secured fleet: state changed, false deaths, memory, CPU.

``python -m benchmarks.floods [--count 100000] [--tokens 20000] [--connections 3000] [--only WORD]``. Two robots and
an edge on one machine. Who floods has the certificate of a third robot, which is in the fleet file and does not run,
or a certificate for nobody in the file; its own session goes by no rules. A flood that is not over after 30 s is
ended then. Each flood goes to all three daemons. Memory is what a daemon has more of 2 s after the flood, in
proportional shares (PSS). CPU is a daemon's, of one core, while the flood lasts. Floods of the data network go to the
relays, and to the worker that takes the samples; a stream of robot1 runs beside them.
"""

from __future__ import annotations

import argparse
import itertools
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from benchmarks.common import cpu_s, machine
from zsched.core.values import codec as wire
from zsched.core.values.beat import Beat
from zsched.core.values.messages import Prepare
from zsched.core.values.model import Ballot, Proposal
from zsched.core.values.relay_protocol import StreamAck, StreamAcks
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.access_rules import Side
from zsched_lab.fleet.floods import connections
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.openings import Stream
from zsched_lab.fleet.secured import secured, without_rules
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

IDLE, STRANGER = "robot3", "mallory"
KEYS = Keyspace("testbed")
LONGEST_S = 30.0
STREAM_HZ = 100.0


def certified(folder: Path, signatures: str = "required", **options: int | str) -> Json:
    """The echo fleet with certificates for every node, and for a stranger."""
    tree = echo_fleet(**options)  # type: ignore[arg-type]
    return secured(tree, folder, security={"signatures": signatures}, strangers=(STRANGER,))


def with_local_side(tree: Json) -> Json:
    """The fleet with a local side on robot1, as `zsched fleet create` gives one to each robot."""
    tree["nodes"]["robot1"]["local"] = {"mode": "peer", "listen": [free_endpoint().partition("#")[0]]}
    return tree


@contextmanager
def flood(
    bed: Testbed, kind: str, key: str, payload: bytes, count: int, holder: str = IDLE, side: Side = Side.CONTROL
) -> Iterator[str]:
    """One attacker's process; what it says when it has sent everything."""
    listen = () if side is Side.CONTROL else (bed.fleet.node(holder).listen_data,)  # workers dial it there
    config = without_rules(bed, holder, side, listen=listen)
    command = [sys.executable, "-m", "zsched_lab.fleet.floods", kind, "--config", config]
    command += ["--key", key, "--payload", payload.hex(), "--count", str(count)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if select.select([process.stdout], [], [], LONGEST_S)[0]:
            yield process.stdout.readline().strip()
            process.communicate("")
        else:
            process.kill()
            yield "not over"


def memory_mb(bed: Testbed) -> dict[str, float]:
    """{node: its daemon's proportional share}."""
    return {node: pss_mb(bed.pid(node)) for node in bed.running()}


def pss_mb(pid: int) -> float:
    """The proportional share of a process, in MiB."""
    return float(psutil.Process(pid).memory_full_info().pss) / 2**20


def daemons_cpu_s(bed: Testbed) -> float:
    """Seconds of a core that the daemons have used."""
    return sum(cpu_s(bed.pid(node)) for node in bed.running())


def deaths(bed: Testbed) -> int:
    """How often a daemon that runs was taken for suspect or gone."""
    words = [f"{node} alive -> suspect" for node in bed.running()]
    return sum(bed.log(node).count(word) for node in bed.running() for word in words)


def attack(bed: Testbed, name: str, run: Callable[[], str]) -> None:
    """One line about one flood."""
    task = bed.task("robot1")
    before, used, died, start = memory_mb(bed), daemons_cpu_s(bed), deaths(bed), time.monotonic()
    told = run()
    lasted = time.monotonic() - start
    used = daemons_cpu_s(bed) - used
    time.sleep(2.0)
    after = memory_mb(bed)
    more = max(after[node] - before[node] for node in after)
    now = bed.task("robot1")
    changed = sum(now[key] != task[key] for key in ("owner", "epoch", "revision"))
    drops = {name: count for name, count in bed.status("robot1")["counters"].items() if name.startswith("dropped_")}
    print(
        f"{name:<22} {told:<24} state changed {changed}, false deaths {deaths(bed) - died}, memory at most {more:+.1f} "
        f"MiB a daemon, CPU {100 * used / lasted / len(after):.0f} % of a core a daemon for {lasted:.1f} s; {drops}",
        flush=True,
    )


def relay_used(bed: Testbed) -> tuple[float, float]:
    """(MiB of the largest relay, seconds of a core that all relays have used)."""
    relays = [pid for node in bed.running() if (pid := bed.relay_pid(node)) is not None]
    return max(map(pss_mb, relays)), sum(map(cpu_s, relays))


def attack_data(bed: Testbed, name: str, run: Callable[[], str]) -> None:
    """One line about one flood of the data network, beside a stream of robot1 of `STREAM_HZ`."""
    local = bed.fleet.node("robot1").local
    assert local is not None
    stream = Stream(local.listen[0], "robot1", STREAM_HZ)
    stream.start()
    try:
        bed.wait(lambda: len(stream.answers) > STREAM_HZ, 60.0, "the stream")
        (memory, cpu), died, first, start = relay_used(bed), deaths(bed), stream.sent, time.monotonic()
        told = run()
        lasted, last = time.monotonic() - start, stream.sent
        used = relay_used(bed)[1] - cpu
        time.sleep(5.0)  # what was on its way comes, and so does what was late
        more = relay_used(bed)[0] - memory
    finally:
        stream.close()
    came = dict(stream.answers)
    times = sorted(at for number, at in stream.answers if number >= first - 1)
    pause = max((after - before for before, after in itertools.pairwise(times)), default=0.0)
    print(
        f"{name:<22} {told:<24} false deaths {deaths(bed) - died}, memory at most {more:+.1f} MiB a relay, relays' CPU "
        f"{100 * used / lasted:.0f} % of a core for {lasted:.1f} s; stream: sent {last - first}, without an answer "
        f"{sum(number not in came for number in range(first, last))}, longest pause {1000 * pause:.0f} ms",
        flush=True,
    )


def rest() -> str:
    """No flood."""
    time.sleep(3.0)
    return ""


def main() -> None:
    """Print one line for each flood."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--tokens", type=int, default=20_000)
    parser.add_argument("--connections", type=int, default=3000)
    parser.add_argument("--only", default="", help="floods with this word in their names")
    given = parser.parse_args()
    print(machine())
    beat = wire.encode(Beat(node=IDLE, incarnation=1, sequence=1, loop_lag_s=0.0))
    proposal = wire.encode(Proposal(voter=IDLE, task=TASK, base_revision=1, candidate="edge1", aggregate=0.5))
    prepare = Prepare(task=TASK, ballot=Ballot(counter=1, node=IDLE, incarnation=1), electorate="e")
    floods = {
        "periodic beats": ("frames", KEYS.beat_in_turn(IDLE), beat, given.count),
        "urgent beats": ("frames", KEYS.beat(IDLE), beat, given.count),
        "proposals": ("frames", KEYS.proposal(IDLE), proposal, given.count),
        "garbage": ("frames", KEYS.profile(IDLE), b"\xc1" * 64, given.count),
        "prepares": ("questions", KEYS.register("*", IDLE), wire.encode(prepare), given.count // 10),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tree = with_local_side(certified(folder, robots=3, edges=1, stream_class="reliable"))
        tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
        with Testbed(folder, tree) as bed:
            bed.init()
            bed.start("robot1", "robot2", "edge1")
            bed.wait_settled()
            attack(bed, "nothing", rest)
            for what, (kind, key, payload, count) in floods.items():
                if given.only not in what:
                    continue

                def run(kind: str = kind, key: str = key, payload: bytes = payload, count: int = count) -> str:
                    with flood(bed, kind, key, payload, count) as told:
                        return told

                attack(bed, what, run)
            for what, holder, shown in (
                ("tokens of a stranger", STRANGER, STRANGER),
                ("tokens of a member", IDLE, IDLE),
                ("tokens of another node", IDLE, "edge1"),
            ):
                if given.only not in what:
                    continue

                def show(holder: str = holder, shown: str = shown) -> str:
                    with flood(bed, "tokens", f"@zsched/testbed/alive/{shown}", b"", given.tokens, holder) as told:
                        return told

                attack(bed, what, show)
            acks = StreamAcks(acks=tuple(StreamAck(eid=eid, first=0, arrived=9, processed=9) for eid in range(4)))
            for what, key, payload in (
                ("acknowledgements", KEYS.ack(IDLE, TASK, 1, "*"), wire.encode(acks)),
                ("samples of a stream", f"edge1/echo/{IDLE}/in", b"x" * 64),
            ):
                if given.only not in what:
                    continue

                def pour(key: str = key, payload: bytes = payload) -> str:
                    with flood(bed, "frames", key, payload, given.count, side=Side.DATA) as told:
                        return told

                attack_data(bed, what, pour)
            if given.only in "no flood of data":
                attack_data(bed, "no flood of data", rest)
            ends = bed.fleet.node("robot1").listen_control

            def connect() -> str:
                with connections(ends, given.connections) as made:
                    time.sleep(1.0)
                    return f"made={made}"

            if given.only in "connections":
                attack(bed, "connections", connect)


if __name__ == "__main__":
    main()
