"""How long a fleet takes to change, and what it sends for it: a machine joins, leaves, is replaced; a document changes.

``python -m benchmarks.membership [--nodes 3 6 12 24] [--rounds 3] [--secured]``; root, for each machine has a network
namespace. ``--secured``: with certificates, as a fleet is without ``--insecure``; the others then begin again in turns.
Machines come by the verbs, as an operator gives them (`zsched_lab.fleet.hall`); half are robots, half edges.

* join: from the start of `zsched invite` until the new node is alive for the first machine and counts by the newest
  value itself (two verbs and the start of a daemon are in it).
* heard: from the start of that `zsched invite` until every node hears every other one (secured: until all have begun
  again).
* apply: from the start of `zsched apply` of another document until every node goes by it.
* replace: from the power cut of an elector until the electors are settled without it, with ``replace_s: 2``.
* leave: of the newest machine, until its daemon has ended; `drain`, seat, document and file are in it.

``packets`` and ``kB`` are what left all nodes' interfaces meanwhile, less what they send at rest in that time.

The last table is of what a beat and the state file cost, with and without what this fleet's changes brought into them.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.common import machine, percentile
from benchmarks.record import progress
from zsched.config.load import load_fleet
from zsched.core.electorate.founding import created
from zsched.core.values.beat import Beat
from zsched.core.values.codec import document_hash, encode, encode_state
from zsched.core.values.document import Document, Text
from zsched.core.values.electorate import Elector
from zsched.core.values.model import RegisterState
from zsched.core.vote.generations import blank_state
from zsched.host.clock import monotonic_s
from zsched_lab.fleet.hall import Hall
from zsched_lab.fleet.netns import INTERFACE, Network, run

PORT = 7457
REST_S = 3.0
WITHIN_S = 120.0
TASK = """\
tasks:
  echo:
    candidates: [m01, m02]
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in"}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out"}]
"""


@dataclass(frozen=True, slots=True)
class Change:
    """One change of one fleet."""

    what: str
    seconds: float
    packets: float
    kilobytes: float


class Fleet:
    """Machines in namespaces; it grows and shrinks by the verbs."""

    def __init__(self, folder: Path, network: Network, *, is_secured: bool) -> None:
        self.hall, self.network, self.folder = Hall(folder, network), network, folder
        self._is_secured = is_secured
        self._lives: dict[str, int] = {}
        """{node: its incarnation before the newest change}: in a secured fleet it begins again."""
        self.names: list[str] = []
        self._made = 0
        self._rate = 0.0, 0.0
        self._texts = 0

    # --- what is looked at -------------------------------------------------------------------------------------------

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until it is so.

        Raises:
            AssertionError: it is not, in time.
        """
        until = monotonic_s() + WITHIN_S
        while not condition():
            if monotonic_s() > until:
                raise AssertionError(f"not within {WITHIN_S:g} s: {what}")
            time.sleep(0.02)

    def all_at(self, revision: int) -> bool:
        """Whether every node goes by a value of this revision."""
        return all(self.hall.status(name).get("fleet_revision", -1) >= revision for name in self.names)

    def quorum(self, name: str) -> dict[str, Any]:
        """Of a node's status."""
        found: dict[str, Any] = self.hall.status(name).get("quorum", {})
        return found

    def revision(self) -> int:
        """Of the value by which the first machine goes."""
        return int(self.hall.status(self.names[0]).get("fleet_revision", 0))

    def sent(self) -> tuple[int, int]:
        """(packets, bytes) that have left all nodes so far."""
        found = [
            json.loads(run("ip", "-n", self.network.name_of(name), "-s", "-j", "link", "show", INTERFACE))[0]
            for name in self._spaces
        ]
        counts = [one["stats64"]["tx"] for one in found]
        return sum(int(one["packets"]) for one in counts), sum(int(one["bytes"]) for one in counts)

    @property
    def _spaces(self) -> list[str]:
        return [f"m{number:02d}" for number in range(1, self._made + 1)]

    # --- what is done ------------------------------------------------------------------------------------------------

    def found(self) -> None:
        """The first machine, its daemon, a task, and a quick replacement of electors."""
        name = self._next()
        self.hall.zsched(name, "fleet", "create", "hall", *self._open(), "--timing", "wired", *self._address(name))
        self.hall.start(name)
        self.names.append(name)
        self.wait(lambda: self.hall.alive(name) == {name}, "the first daemon")
        text = self.hall.zsched(name, "fleet", "export").replace("tasks: {}", f"replace_s: 2\n{TASK}")
        self.note_lives()
        self.apply(text.replace("[m01, m02]", "[m01]"))
        self.hear_all()

    def _next(self) -> str:
        self._made += 1
        name = self._spaces[-1]
        self.network.add(name)
        return name

    def _address(self, name: str) -> tuple[str, str]:
        return "--address", f"{self.network.address(name)}:{PORT}"

    def join(self) -> None:
        """One machine more."""
        name = self._next()
        kind = "edge" if self._made % 2 == 0 else "robot"
        words = ("--kind", kind, *self._address(name), "--yes", "--accept", "pause-task")
        self.note_lives()
        invitation = self.folder / f"{name}.invite"
        invitation.write_text(self.hall.zsched(self.names[0], "invite", name, *words))
        self.hall.zsched(name, "join", str(invitation))
        self.hall.start(name)
        revision = 0

        def is_ready() -> bool:
            nonlocal revision
            revision = revision or self.revision()  # the first machine may just begin again
            is_there = name in self.hall.alive(self.names[0])
            return is_there and self.hall.status(name).get("fleet_revision", -1) >= revision and self.quorum(name)["ok"]

        self.wait(is_ready, f"{name} is ready")
        self.names.append(name)

    def _open(self) -> tuple[str, ...]:
        return () if self._is_secured else ("--insecure",)

    def note_lives(self) -> None:
        """A change comes after which daemons of a secured fleet begin again."""
        if self._is_secured:
            self._lives = {name: self.incarnation(name) for name in self.names}

    def incarnation(self, name: str) -> int:
        """Of a node's daemon; 0 while it does not answer."""
        return int(self.hall.status(name).get("incarnation", 0))

    def hear_all(self) -> None:
        """Wait until every node hears every other one, and those that begin again have done so."""
        names = set(self.names)

        def do_all_hear() -> bool:
            are_new = all(self.incarnation(name) > life for name, life in self._lives.items() if name in names)
            return are_new and all(self.hall.alive(name) >= names for name in names)

        self.wait(do_all_hear, "everybody to hear everybody")
        self._lives = {}

    def apply(self, text: str | None = None) -> None:
        """Another document, until all nodes go by it."""
        self._texts += 1
        text = text or f"{self.hall.zsched(self.names[0], 'fleet', 'export')}# change {self._texts}\n"
        (self.folder / "next.yaml").write_text(text)
        before = self.revision()
        self.hall.zsched(self.names[0], "apply", str(self.folder / "next.yaml"), "--yes")
        self.wait(lambda: self.revision() > before and self.all_at(self.revision()), "all go by it")

    def replace(self) -> None:
        """An elector dies; the others settle without it."""
        dead = next(name for name in reversed(self.quorum(self.names[0])["names"]) if name != self.names[0])
        self.hall.power_off(dead)
        self.names.remove(dead)
        self.wait(lambda: dead not in self.quorum(self.names[0])["names"], f"{dead} is no elector any more")
        self.wait(lambda: bool(self.quorum(self.names[0])["ok"]), "settled")

    def leave(self) -> None:
        """The newest machine leaves."""
        name = self.names.pop()
        self.hall.zsched(name, "leave", "--yes", "--accept", "no-other-candidate")
        self.hall.ended(name, 30.0)

    def measure(self, what: str, do: Callable[[], None]) -> Change:
        """How long a change takes, and what is sent for it beyond what is sent at rest."""
        rest, began = self.sent(), monotonic_s()
        time.sleep(REST_S)
        before, start = self.sent(), monotonic_s()
        rate = [(now - then) / (start - began) for now, then in zip(before, rest, strict=True)]
        do()
        seconds = monotonic_s() - start
        time.sleep(1.0)  # what follows from it is part of it
        after, span = self.sent(), monotonic_s() - start
        packets, size = (now - then - one * span for now, then, one in zip(after, before, rate, strict=True))
        return Change(what=what, seconds=seconds, packets=packets, kilobytes=size / 1000)


def one_fleet(nodes: int, rounds: int, *, is_secured: bool) -> Iterator[Change]:
    """Every change, some times, of a fleet of so many nodes."""
    with tempfile.TemporaryDirectory() as folder, Network(()) as network:
        fleet = Fleet(Path(folder), network, is_secured=is_secured)
        with fleet.hall:
            fleet.found()
            while len(fleet.names) < nodes:
                progress(f"{nodes} nodes: {len(fleet.names)} are there")
                fleet.join()
                fleet.hear_all()
            wanted = min(5, nodes - 1 + nodes % 2)
            fleet.wait(lambda: len(fleet.quorum(fleet.names[0])["names"]) == wanted, f"{wanted} electors")
            time.sleep(REST_S)
            for number in range(rounds):
                progress(f"{nodes} nodes, round {number + 1}: join, apply, leave")
                began = monotonic_s()
                joined = fleet.measure("join", fleet.join)
                fleet.hear_all()
                yield joined
                yield Change(what="heard", seconds=monotonic_s() - began - REST_S, packets=math.nan, kilobytes=math.nan)
                yield fleet.measure("apply", fleet.apply)
                fleet.note_lives()
                yield fleet.measure("leave", fleet.leave)
                fleet.hear_all()
            if nodes > 3:  # three electors are not made two by silence
                progress(f"{nodes} nodes: replace")
                yield fleet.measure("replace", fleet.replace)


def sizes(nodes: int) -> list[str]:
    """Bytes of a beat and of the state file, with and without what changes of the fleet need."""
    with tempfile.TemporaryDirectory() as folder:
        names = [f"m{number:02d}" for number in range(1, nodes + 1)]
        text = f"fleet: hall\ntiming: wired\nnodes:\n{''.join(_node(name) for name in names)}{TASK}"
        path = Path(folder) / "fleet.yaml"
        path.write_text(text)
        fleet = load_fleet(path)
    disk = "0123456789abcdef"
    beat = Beat(node="m01", incarnation=17_955_504_466, sequence=4711, loop_lag_s=0.001, fleet_file="f" * 16)
    new = replace(beat, number=9, fleet_revision=31, electorate="e" * 16, disk=disk, gone=("m02",), away=("m03",))
    plain = blank_state(fleet, "m01", 0, None, incarnation=17_955_504_466, hardware="h" * 16, disk="")
    content = Document(text=Text(text))
    value = created(fleet, "m01", disk=disk, generation_id="ab" * 16, document=document_hash(content))
    seats = tuple(Elector(name=name, disk=disk, joining=1) for name in names[:5])
    held = RegisterState(task=fleet.name, learnt=replace(value, electors=seats))
    full = replace(plain, disk=disk, fleet_register=held)
    return [
        f"| {nodes} | beat | {len(encode(beat))} | {len(encode(new))} |",
        f"| {nodes} | state file | {len(encode_state(plain))} | {len(encode_state(full))} |",
        f"| {nodes} | document | - | {len(encode(content))} |",
    ]


def _node(name: str) -> str:
    listen = 'listen: {control: "tcp/0.0.0.0:7457", data: "tcp/0.0.0.0:7458"}'
    return f"  {name}: {{kind: robot, host: 192.0.2.{int(name[1:])}, {listen}}}\n"


def main() -> None:
    """Print how long each change takes and what it sends, for every size of fleet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[3, 6, 12, 24])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--secured", action="store_true")
    given = parser.parse_args()
    print(machine(), "secured" if given.secured else "without certificates", sep="; ")
    print(
        "| nodes | change | n | s, p50 | s, max | packets, p50 | kB, p50 |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: |",
        sep="\n",
    )
    for nodes in given.nodes:
        changes = list(one_fleet(nodes, given.rounds, is_secured=given.secured))
        for what in dict.fromkeys(one.what for one in changes):
            ours = [one for one in changes if one.what == what]
            seconds, packets, size = (
                [getattr(one, name) for one in ours] for name in ("seconds", "packets", "kilobytes")
            )
            middle = f"{percentile(packets, 0.5):.0f} | {percentile(size, 0.5):.1f}"
            timed = f"{percentile(seconds, 0.5):.2f} | {max(seconds):.2f}"
            print(f"| {nodes} | {what} | {len(ours)} | {timed} | {middle} |", flush=True)
    print("\n| nodes | bytes of | without | with |", "| ---: | --- | ---: | ---: |", sep="\n")
    for nodes in given.nodes:
        print(*sizes(nodes), sep="\n")


if __name__ == "__main__":
    main()
