"""A fleet to break: an idempotent and an exclusive task, applications that watch, and one check over all that was seen.

Knows: the fleet of the chaos tests, how to mend it, what its histories must not show. Does not know: which fault comes.

The robots and ``edge1`` are the electors, so that the four can be split evenly.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from pathlib import Path

from zsched.core.values.model import NodeId
from zsched_lab.fleet.netbed import Netbed, Received, owners_of, stop_group
from zsched_lab.fleet.testbed import TASK, Json, echo_fleet
from zsched_lab.sim.history import Admitted, History, Learnt, Worked

GUARD = "guard"
"""The exclusive task."""
TICK_GAP_S = 0.05
"""Ticks further apart are two intervals of work."""

TWO_CLASSES: Json = {
    "inputs": [
        {"from": "{robot}/in", "to": "{target}/echo/{robot}/in", "class": "latest"},
        {"from": "{robot}/order", "to": "{target}/echo/{robot}-orders/in", "class": "reliable"},
    ],
    "outputs": [
        {"from": "{target}/echo/{epoch}/{robot}/out", "to": "{robot}/out", "class": "latest"},
        {"from": "{target}/echo/{epoch}/{robot}-orders/out", "to": "{robot}/done", "class": "reliable"},
    ],
}
"""Rules of the echo task for a stream of each class that must keep something."""


def chaos_fleet(ticks: Path, *, timing: str = "wired", edges: int = 3) -> Json:
    """Three robots, some edges; ``echo`` on every edge, and ``guard``, exclusive, whose workers write to ``ticks``.

    ``echo`` has a stream of class ``latest`` (``in``, ``out``) and one of class ``reliable`` (``order``, ``done``).
    """
    tree = echo_fleet(robots=3, edges=edges, timing=timing, task=TWO_CLASSES)
    tree["electorate"] = ["robot1", "robot2", "robot3", "edge1"]
    tree["tasks"][GUARD] = {
        **{key: tree["tasks"][TASK][key] for key in ("candidates", "weights", "scheduling")},
        "exclusive": True,
        "worker": {"command": ["python", "-m", "zsched_lab.fleet.active_worker", str(ticks)]},
        "outputs": [{"from": "{target}/guard/{epoch}/tick", "to": "{robot}/tick"}],
    }
    return tree


class ChaosBed(Netbed):
    """A `chaos_fleet` that runs, with an application on ``robot1`` and one on ``robot2``, and one for orders."""

    __test__ = False

    def __init__(self, folder: Path, *, timing: str = "wired", wrapper: Path | None = None) -> None:
        self._ticks = folder / "ticks"
        self._ticks.mkdir()
        super().__init__(folder, chaos_fleet(self._ticks, timing=timing), wrapper=wrapper)

    def up(self) -> None:
        """Start everything and wait until both tasks have an owner and messages flow."""
        self.init()
        self.start()
        self.probes = {
            robot: self.probe(robot, put=f"{robot}/in", watch=[f"{robot}/out", f"{robot}/tick"])
            for robot in ("robot1", "robot2")
        }
        self.orders = self.probe("robot1", put="robot1/order", watch=["robot1/done"])
        self.calm()

    # --- looking -----------------------------------------------------------------------------------------------------

    def owner_of(self, task: str, *nodes: NodeId) -> NodeId | None:
        """The owner of a task that ``nodes`` (default: all running) agree on, streams settled; else ``None``."""
        told = [self.status(node).get("tasks") for node in nodes or self.running()]
        if None in told:
            return None  # a daemon that was too busy to answer
        blocks = [block for blocks in told for block in blocks or () if block["name"] == task]
        owners = {(block["owner"], block["epoch"]) for block in blocks}
        is_settled = all(block["phase"] in {"settled", "idle"} for block in blocks)
        return owners.pop()[0] if len(owners) == 1 and is_settled else None

    def moved_from(self, owner: NodeId, *nodes: NodeId, task: str = TASK) -> NodeId | None:
        """The new owner, once all of ``nodes`` (default: all but the old one) have settled on it."""
        now = self.owner_of(task, *(nodes or tuple(name for name in self.running() if name != owner)))
        return now if now not in (None, owner) else None

    def peer(self, observer: NodeId, node: NodeId) -> str:
        """What one node holds another for."""
        found: str = next(entry["state"] for entry in self.status(observer)["nodes"] if entry["name"] == node)
        return found

    def is_calm(self) -> bool:
        """Whether everybody is alive to everybody, both tasks have an owner, and messages flow."""
        for node in self.names:
            if any(entry["state"] != "alive" for entry in self.status(node)["nodes"]):
                return False
        owners = (self.owner_of(TASK), self.owner_of(GUARD))
        return None not in owners and all(probe.is_flowing() for probe in (*self.probes.values(), self.orders))

    # --- mending -----------------------------------------------------------------------------------------------------

    def calm(self, timeout_s: float = 60.0) -> NodeId:
        """End every fault, start the nodes that are down, wait until all is well; the owner of ``echo``."""
        self.network.heal()
        for node in self.names:
            self.network.narrow(node, None)
            self.network.link(node, is_up=True)
            if node in self.running():
                stop_group(self.pid(node), signal.SIGCONT)
        self.start()
        self.wait(self.is_calm, timeout_s, "a calm fleet")
        return self.owner_of(TASK) or ""

    # --- judging -----------------------------------------------------------------------------------------------------

    def seen(self) -> History:
        """Everything since the bed was made: the nodes' logs, the guards' ticks, what the applications were given."""
        return self._seen(self._received())

    def _received(self) -> dict[NodeId, tuple[Received, ...]]:
        return {robot: tuple(probe.received) for robot, probe in self.probes.items()}

    def _seen(self, received: Mapping[NodeId, Sequence[Received]]) -> History:
        worked = [record for file in self._ticks.glob("*.ticks") for record in _intervals(file)]
        history = self.history(electors=(), moves_per_minute={})
        for record in worked:
            history.record(record)
        for robot, samples in received.items():
            for one in samples:
                if one.epoch is not None:
                    history.record(Admitted(at=one.at, node=robot, task=GUARD, epoch=one.epoch, owner=one.node))
        return history

    def violations(self) -> list[str]:
        """What no correct fleet does; empty when all is well. The history is kept in the bed's folder.

        The fleet goes on meanwhile. So the logs are read last: a node writes down an owner before it works or is heard.
        """
        received = self._received()
        history = self._seen(received)
        history.save(self.folder / "history.jsonl")
        found = [*history.violations(), *_foreign_ticks(history), *_foreign_echoes(history, received)]
        return [*found, *self.unaccounted()]


def _foreign_ticks(history: History) -> list[str]:
    """Ticks of a node that was not the owner of the epoch they name."""
    owners = {one.epoch: one.owner for one in history.records if isinstance(one, Learnt) and one.task == GUARD}
    admitted = [one for one in history.records if isinstance(one, Admitted) and owners.get(one.epoch) != one.owner]
    return [f"{one.node} admits {one.owner} in epoch {one.epoch} of {owners.get(one.epoch)}" for one in admitted[:5]]


def _foreign_echoes(history: History, received: Mapping[NodeId, Sequence[Received]]) -> list[str]:
    """Robots whose application was given an owner's messages out of the order of the owners that they learnt."""
    found = []
    for robot, samples in received.items():
        learnt = [one for one in history.records if isinstance(one, Learnt) and (one.node, one.task) == (robot, TASK)]
        owners = [one.owner for one in sorted(learnt, key=lambda one: one.at)]
        admitted = owners_of(samples, f"{robot}/out")
        if not _is_subsequence(admitted, owners):
            found.append(f"{robot} admitted {admitted}, its owners were {owners}")
    return found


def _is_subsequence(part: list[NodeId], whole: list[NodeId | None]) -> bool:
    rest = iter(whole)
    return all(name in rest for name in part)


def _intervals(file: Path) -> list[Worked]:
    """The stretches in which one worker process ticked without a pause, one epoch each."""
    node = file.name.rpartition("-")[0]
    found: list[Worked] = []
    for line in file.read_text().splitlines():
        epoch, at = int(line.split()[0]), float(line.split()[1])
        last = found[-1] if found else None
        if last is not None and last.epoch == epoch and at - last.until < TICK_GAP_S:
            found[-1] = Worked(at=last.at, node=node, task=GUARD, epoch=epoch, until=at)
        else:
            found.append(Worked(at=at, node=node, task=GUARD, epoch=epoch, until=at))
    return found
