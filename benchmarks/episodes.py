"""Random faults on a whole real fleet, with slow disks and frozen applications among them: is each lost sample counted?

``python -m benchmarks.episodes [--minutes 60] [--seed 1]``. Needs root and a C compiler: three robots and three edges,
each in a network namespace with a disk that can be slowed down, an idempotent and an exclusive task, applications on
all robots. An episode has one or two faults at once for 2 to 25 s; then all is mended, and the fleet must be well again
within `WELL_S`. Behind each episode: of the numbers of a `reliable` stream with ``handover: all``, how many never came
back, at the application that was never frozen and at the one that was, and how many the robot's counters tell of. The
exit code is 1 if a loss is in no counter, a counter does not add up, an exclusive task had two owners, or a fleet did
not get well.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from benchmarks.common import machine
from zsched.core.hop.books import given_up
from zsched.core.values.errors import AdapterError
from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched_lab.fleet.chaos import ChaosBed, chaos_fleet
from zsched_lab.fleet.netbed import Netbed, Probe, descendants_running, stop_group
from zsched_lab.fleet.slow_disk import SlowDisk
from zsched_lab.fleet.testbed import TASK, TestbedError

ROBOT: Final = "robot1"
ANSWERS: Final = "robot1/done"
WELL_S: Final = 90.0
SETTLE_S: Final = 20.0
"""How long counters may take to tell of a loss, and an application that was frozen to catch up."""
MOST_FROZEN_S: Final = 25.0
SLOW_MS: Final = (100, 200, 1000)

Fault = Callable[["Bed", random.Random], contextlib.AbstractContextManager[str]]


class Bed(ChaosBed):
    """A chaos fleet whose nodes have disks that can be slowed down, and an application that may be frozen."""

    def __init__(self, folder: Path) -> None:
        self.disks: dict[NodeId, SlowDisk] = {}
        self._ticks = folder / "ticks"
        self._ticks.mkdir()
        tree = chaos_fleet(self._ticks)
        tree["tasks"][TASK]["outputs"][1]["handover"] = "all"
        Netbed.__init__(self, folder, tree)

    def spawn(self, place: str, command: Sequence[str | Path], *, log: str) -> subprocess.Popen[bytes]:
        """As of the bed, on the place's own disk."""
        if place not in self.disks:
            home = self.folder / f"{place}-disk"
            home.mkdir(exist_ok=True)
            self.disks[place] = SlowDisk(home)
        with self.disks[place].under():
            return super().spawn(place, command, log=log)

    def up(self) -> None:
        """As of the bed, with a second application, and a publisher that waits where there is no room."""
        self.init()
        self.start()
        watched = {robot: [f"{robot}/out", f"{robot}/tick"] for robot in ("robot1", "robot2")}
        self.probes = {robot: self.probe(robot, put=f"{robot}/in", watch=keys) for robot, keys in watched.items()}
        self.orders = self.probe(ROBOT, put="robot1/order", watch=[ANSWERS], blocks=True)
        self.frozen = self.probe(ROBOT, watch=[ANSWERS])
        self.calm()
        self.wait(lambda: self.frozen.received, 60, "answers at the second application")

    def owner_now(self) -> NodeId:
        """Whom the robots hold for the owner; one that runs.

        Raises:
            LookupError: there is none now.
        """
        owner = self.owner_of(TASK, *(name for name in self.running() if name.startswith("robot")))
        if owner not in self.running():
            raise LookupError
        return str(owner)

    def told(self) -> int:
        """What the counters of the reliable stream call lost, or perhaps lost, on its way there and back."""
        streams = {f"{TASK}/in/1", f"{TASK}/out/1"}
        return sum(given_up(one) for one in self.counts(ROBOT) if one.stream in streams)

    def worker(self, node: NodeId) -> int:
        """The process of its echo worker."""
        return descendants_running(self.pid(node), "zsched.tasks.echo")[0]


def missing(probe: Probe, since: int = 0) -> int:
    """Of the numbers from ``since`` up to the newest one that came: how many did not."""
    numbers = {one.number for one in tuple(probe.received) if one.key == ANSWERS and one.number >= since}
    return max(numbers) + 1 - since - len(numbers) if numbers else 0


# --- faults: each yields what it is, and is over when it is left -----------------------------------------------------


@contextlib.contextmanager
def frozen_application(bed: Bed, _random: random.Random) -> Iterator[str]:
    """The second application stands still."""
    bed.frozen.send(signal.SIGSTOP)
    yield "application frozen"
    bed.frozen.send(signal.SIGCONT)


@contextlib.contextmanager
def slow_disk(bed: Bed, random_: random.Random) -> Iterator[str]:
    """The disks of one to three nodes take long."""
    nodes, ms = random_.sample(bed.names, random_.randint(1, 3)), random_.choice(SLOW_MS)
    for node in nodes:
        bed.disks[node].take(ms)
    yield f"fsync of {', '.join(nodes)} + {ms} ms"
    for node in nodes:
        bed.disks[node].take(0)


@contextlib.contextmanager
def killed_owner(bed: Bed, _random: random.Random) -> Iterator[str]:
    """Its daemon, relay and workers end at once."""
    owner = bed.owner_now()
    bed.power_off(owner, is_seen=True)
    yield f"{owner}, the owner, killed"


@contextlib.contextmanager
def frozen_owner(bed: Bed, _random: random.Random) -> Iterator[str]:
    """The whole machine stands still."""
    owner = bed.owner_now()
    stop_group(bed.pid(owner), signal.SIGSTOP)
    yield f"{owner}, the owner, frozen"
    if owner in bed.running():
        stop_group(bed.pid(owner), signal.SIGCONT)


@contextlib.contextmanager
def frozen_worker(bed: Bed, _random: random.Random) -> Iterator[str]:
    """Its worker alone does."""
    owner = bed.owner_now()
    worker = bed.worker(owner)
    os.kill(worker, signal.SIGSTOP)
    yield f"the worker on {owner}, the owner, frozen"
    with contextlib.suppress(ProcessLookupError):
        os.kill(worker, signal.SIGCONT)


@contextlib.contextmanager
def dead_worker(bed: Bed, _random: random.Random) -> Iterator[str]:
    """It is killed."""
    owner = bed.owner_now()
    os.kill(bed.worker(owner), signal.SIGKILL)
    yield f"the worker on {owner}, the owner, killed"


@contextlib.contextmanager
def cut(bed: Bed, random_: random.Random) -> Iterator[str]:
    """Packets to it, from it, or both vanish."""
    node = random_.choice(bed.names)
    way = random_.choice(["cut", "deafen", "mute"])
    getattr(bed.network, way)(node)
    yield f"{node}: {way}"
    bed.network.heal(node)


@contextlib.contextmanager
def lossy(bed: Bed, random_: random.Random) -> Iterator[str]:
    """A tenth of its packets are lost."""
    node = random_.choice(bed.names)
    bed.network.lose(10, node)
    yield f"{node} loses 10 %"
    bed.network.heal(node)


@contextlib.contextmanager
def apart(bed: Bed, random_: random.Random) -> Iterator[str]:
    """Two nodes do not hear each other."""
    one, other = random_.sample(bed.names, 2)
    bed.network.separate([one], [other])
    yield f"{one} apart from {other}"
    bed.network.heal(one)


@contextlib.contextmanager
def dead_daemon(bed: Bed, random_: random.Random) -> Iterator[str]:
    """Any other machine than that of the applications is off."""
    node = random_.choice([one for one in bed.names if one != ROBOT])
    bed.power_off(node)
    yield f"{node} off"


FAULTS: Final[tuple[Fault, ...]] = (
    *(frozen_application, slow_disk, killed_owner, frozen_owner, frozen_worker, dead_worker),
    *(cut, lossy, apart, dead_daemon),
)


def episode(bed: Bed, random_: random.Random, number: int) -> list[str]:
    """One or two faults, then all is mended; what is wrong behind it."""
    faults = random_.sample(FAULTS, random_.choice([1, 1, 2]))
    lasts_s = random_.uniform(2.0, MOST_FROZEN_S)
    before, told_before, began = missing(bed.orders), bed.told(), monotonic_s()
    first = bed.frozen.received[-1].number + 1 if bed.frozen.received else 0
    what: list[str] = []
    with contextlib.ExitStack() as stack:
        for fault in faults:
            with contextlib.suppress(LookupError, AdapterError):  # the fault before has left no owner
                what.append(stack.enter_context(fault(bed, random_)))
                pass_s(random_.uniform(0.0, 3.0))
        pass_s(lasts_s)
    healed = monotonic_s()
    try:
        bed.calm(WELL_S)
    except TestbedError as error:
        return [f"not well after {WELL_S:g} s: {str(error).splitlines()[0]}"]
    well_s = monotonic_s() - healed
    with contextlib.suppress(TestbedError):
        bed.wait(lambda: missing(bed.orders) - before <= bed.told() - told_before, SETTLE_S, "a word of each loss")
        bed.wait(lambda: missing(bed.frozen, first) <= bed.told() - told_before, SETTLE_S, "the frozen one's")
    lost, told = missing(bed.orders) - before, bed.told() - told_before
    behind = missing(bed.frozen, first)
    print(
        f"{number:3d} {'; '.join(what)}: {lasts_s:.0f} s, well after {well_s:.1f} s; "
        f"lost {lost}, at the second application {behind}, told {told} ({monotonic_s() - began:.0f} s)",
        flush=True,
    )
    wrong = [f"{lost} lost, {told} told"] if lost > told else []
    wrong += [f"{behind} missing at the second application, {told} told"] if behind > told else []
    return wrong + bed.unaccounted()


def pass_s(seconds: float) -> None:
    """Let time pass: a fault lasts so long, and nothing is waited for."""
    time.sleep(seconds)


def main() -> int:
    """Print a line an episode, and what was wrong; 1 if anything was."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(machine())
    random_, wrong, number = random.Random(options.seed), 0, 0
    with tempfile.TemporaryDirectory() as folder, Bed(Path(folder)) as bed:
        bed.up()
        end = monotonic_s() + 60 * options.minutes
        while monotonic_s() < end:
            number += 1
            found = episode(bed, random_, number)
            wrong += bool(found)
            print("".join(f"    WRONG: {one}\n" for one in found), end="", flush=True)
        found = bed.violations()
        print("".join(f"VIOLATION: {one}\n" for one in found), end="")
        orders = [one for one in bed.orders.received if one.key == ANSWERS]
        twice = len(orders) - len({one.number for one in orders})
        print(f"{number} episodes, {len(orders)} answers, {twice} of them twice; wrong: {wrong + len(found)}")
    return 1 if wrong or found else 0


if __name__ == "__main__":
    sys.exit(main())
