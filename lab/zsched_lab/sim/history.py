"""What a fleet did, written down, and its one checker: used by the simulator as it goes, by chaos tests afterwards.

Knows: which histories are impossible for a correct fleet. Does not know: nodes, messages, where a record came from.

Times are true seconds on one clock: virtual in the simulator, CLOCK_BOOTTIME of the one machine in tests with real
daemons. A recorder writes down what it saw, in any order between nodes; `History.violations` sorts by time.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import replace
from zsched.core.vote.belief import GENERATION_STEP

WINDOW_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Started:
    """A node's process started; without its state it may know less than before."""

    at: float
    node: NodeId
    has_state: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Learnt:
    """A node knows a committed value. ``detail`` is the rest of the value in any words (tuning); empty: not seen."""

    at: float
    node: NodeId
    task: TaskId
    revision: int
    epoch: int
    owner: NodeId | None
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stored:
    """An elector's disk holds an acceptance: ``ballot`` in any words that tell ballots apart."""

    at: float
    node: NodeId
    task: TaskId
    revision: int
    ballot: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Routed:
    """A robot's relay was given a plan whose current slot has this epoch."""

    at: float
    node: NodeId
    task: TaskId
    epoch: int
    owner: NodeId


@dataclass(frozen=True, slots=True, kw_only=True)
class Admitted:
    """A robot's gate let a message of the owner's epoch through."""

    at: float
    node: NodeId
    task: TaskId
    epoch: int
    owner: NodeId


@dataclass(frozen=True, slots=True, kw_only=True)
class Worked:
    """A task's worker worked from ``at`` on; ``until`` is when it stopped or its lease ended.

    Workers of two lives of a node are two workers: the older one may outlive its daemon until its lease ends.
    Two that work without a lease may do so at once; nobody works beside one that has a lease.
    """

    at: float
    node: NodeId
    task: TaskId
    epoch: int
    until: float
    life: int = 0
    is_leased: bool = True
    is_late: bool = False
    """By a lease from before its machine stood still, clock and all: nothing there can know that it has ended."""
    has_forgotten: bool = False
    """Without a lease, from a state that was lost or brought back: nothing there can know what was agreed since."""
    is_shared: bool = False
    """Without a lease, for the task is agreed to be exclusive no more. What an earlier life of the same node still has
    of its last lease is nobody's promise then. Others are held off all the same, by those who granted it."""


Record = Started | Learnt | Stored | Routed | Admitted | Worked
_KINDS: dict[str, type[Record]] = {
    cls.__name__.lower(): cls for cls in (Started, Learnt, Stored, Routed, Admitted, Worked)
}


@dataclass(slots=True, kw_only=True)
class Checker:
    """Takes records in the order of time and names what is impossible; cheap per record.

    Args:
        electors: the configured electors; with them (and `Stored` records) a first `Learnt` needs a majority on disk.
        moves_per_minute: {task: most epochs begun within any 60 s}; a task that is not named is not bounded.
        slack_s: how far two `Worked` intervals may overlap (0 where times are exact).
    """

    electors: tuple[NodeId, ...] = ()
    moves_per_minute: Mapping[TaskId, int] = field(default_factory=dict)
    slack_s: float = 0.0
    electorates: dict[int, set[tuple[NodeId, ...]]] = field(default_factory=dict)
    """{generation: the electorates of its states}; one that is not named has the configured electors."""
    values: dict[tuple[TaskId, int], Learnt] = field(default_factory=dict)
    """{(task, revision): who learnt it first}."""
    epochs: dict[tuple[TaskId, int], Learnt] = field(default_factory=dict)
    """{(task, epoch): who learnt it first}."""
    _known: dict[tuple[NodeId, TaskId], Learnt] = field(default_factory=dict)
    _routed: dict[tuple[NodeId, TaskId], int] = field(default_factory=dict)
    _admitted: dict[tuple[NodeId, TaskId], int] = field(default_factory=dict)
    _stored: dict[tuple[TaskId, int], dict[str, set[NodeId]]] = field(default_factory=dict)
    _worked: dict[TaskId, dict[tuple[NodeId, int], Worked]] = field(default_factory=dict)
    _moves: dict[TaskId, deque[float]] = field(default_factory=dict)

    def take(self, record: Record) -> list[str]:
        """Take the next record in; what is wrong with it, empty when nothing is."""
        match record:
            case Learnt():
                return self._on_learnt(record)
            case Stored():
                ballots = self._stored.setdefault((record.task, record.revision), {})
                ballots.setdefault(record.ballot, set()).add(record.node)
                return []
            case Routed():
                return self._on_rising(self._routed, record, "an older epoch moves a route")
            case Admitted():
                return self._on_rising(self._admitted, record, "a gate admits an older epoch")
            case Worked():
                return self._on_worked(record)
            case Started():
                self._on_started(record)
                return []

    def _on_started(self, record: Started) -> None:
        for kept in (self._routed, self._admitted) if not record.has_state else ():
            for key in [key for key in kept if key[0] == record.node]:
                del kept[key]
        for key in [key for key in self._known if key[0] == record.node and not record.has_state]:
            del self._known[key]

    def _on_learnt(self, new: Learnt) -> list[str]:
        key = (new.node, new.task)
        before = self._known.get(key)
        if before is not None and before.revision == new.revision and _same(before, new):
            return []
        found = []
        if before is not None and (new.revision < before.revision or new.epoch < before.epoch):
            found.append(
                f"{new.node} unlearnt {new.task}: revision {before.revision} epoch {before.epoch} at {before.at:.3f}, "
                f"revision {new.revision} epoch {new.epoch} at {new.at:.3f}"
            )
        self._known[key] = new
        if new.revision == 0:
            return found
        first = self.values.get((new.task, new.revision))
        if first is None:
            self.values[new.task, new.revision] = new
            found += self._on_first(new)
        elif not _same(first, new):
            found.append(
                f"two values for {new.task} revision {new.revision}: {_told(first)} at {first.node}, "
                f"{_told(new)} at {new.node}"
            )
        return found

    def _on_first(self, new: Learnt) -> list[str]:
        """Nobody knew this revision before."""
        found = []
        stored = self._stored.get((new.task, new.revision), {})
        electorates = self.electorates.get(new.revision // GENERATION_STEP, {self.electors})
        if self.electors and not any(_has_majority(stored.values(), electors) for electors in electorates):
            on_disk = {ballot: sorted(who) for ballot, who in stored.items()}
            found.append(f"{new.task} revision {new.revision} was learnt by {new.node} with only {on_disk} on disk")
        if new.owner is None:
            return found
        first = self.epochs.setdefault((new.task, new.epoch), new)
        if first.owner != new.owner:
            found.append(f"two owners for {new.task} epoch {new.epoch}: {first.owner} and {new.owner}")
        if first is new:
            found += self._on_same_owner(new) + self._on_move(new)
        return found

    def _on_same_owner(self, new: Learnt) -> list[str]:
        """A higher epoch means another owner; a generation begins at an epoch that nobody owns."""
        return [
            f"{new.task} epoch {max(epoch, new.epoch)} has the owner of the epoch before: {new.owner}"
            for epoch in (new.epoch - 1, new.epoch + 1)
            if (new.task, epoch) in self.epochs and self.epochs[new.task, epoch].owner == new.owner
        ]

    def _on_move(self, new: Learnt) -> list[str]:
        limit = self.moves_per_minute.get(new.task)
        if limit is None:
            return []
        moves = self._moves.setdefault(new.task, deque())
        moves.append(new.at)
        while new.at - moves[0] > WINDOW_S:
            moves.popleft()
        return [f"{new.task} moved {len(moves)} times within a minute, at most {limit}"] if len(moves) > limit else []

    @staticmethod
    def _on_rising(kept: dict[tuple[NodeId, TaskId], int], new: Routed | Admitted, what: str) -> list[str]:
        key = (new.node, new.task)
        before = kept.get(key, 0)
        kept[key] = max(before, new.epoch)
        return [f"{what}: {new.task} at {new.node}, {before} -> {new.epoch}"] if new.epoch < before else []

    def _on_worked(self, new: Worked) -> list[str]:
        mine = self._worked.setdefault(new.task, {})
        found = [
            f"{other.node} (epoch {other.epoch}, until {other.until:.4f}) and {new.node} (epoch {new.epoch}, from "
            f"{new.at:.4f}) both work on {new.task}"
            for (node, life), other in mine.items()
            if (node, life) != (new.node, new.life)
            and (other.is_leased or new.is_leased)
            and min(other.until, new.until) - max(other.at, new.at) > self.slack_s
            and not any(work.is_late or work.has_forgotten for work in (other, new))
            and not (node == new.node and new.is_shared)
        ]
        mine[new.node, new.life] = new
        return found

    def stop_working(self, node: NodeId, task: TaskId, at: float, life: int = 0) -> None:
        """The worker of ``node`` was seen to have stopped before the end that its last `Worked` gave."""
        last = self._worked.get(task, {}).get((node, life))
        if last is not None and at < last.until:
            self._worked[task][node, life] = replace(last, until=at)


def _has_majority(stored: Iterable[set[NodeId]], electors: tuple[NodeId, ...]) -> bool:
    """Whether one ballot lies on the disks of a majority."""
    needed = len(electors) // 2 + 1  # by our own count: the core's may be what is wrong
    return any(len(who & set(electors)) >= needed for who in stored)


def _same(one: Learnt, other: Learnt) -> bool:
    if (one.epoch, one.owner) != (other.epoch, other.owner):
        return False
    return one.detail == other.detail or not one.detail or not other.detail


def _told(value: Learnt) -> str:
    return f"owner {value.owner} epoch {value.epoch} {value.detail}".rstrip()


@dataclass(slots=True, kw_only=True)
class History:
    """Everything that was seen of one fleet; see `Checker` for the arguments.

    >>> history = History()
    >>> history.record(Learnt(at=1.0, node="r1", task="merge", revision=1, epoch=1, owner="e1"))
    >>> history.record(Learnt(at=1.1, node="r2", task="merge", revision=1, epoch=1, owner="e2"))
    >>> history.violations()
    ['two values for merge revision 1: owner e1 epoch 1 at r1, owner e2 epoch 1 at r2']
    """

    electors: tuple[NodeId, ...] = ()
    moves_per_minute: Mapping[TaskId, int] = field(default_factory=dict)
    slack_s: float = 0.0
    records: list[Record] = field(default_factory=list)

    def record(self, record: Record) -> None:
        """Write down what was seen; the order between nodes does not matter, ``at`` does."""
        self.records.append(record)

    def violations(self) -> list[str]:
        """What no correct fleet does, in the order of time; empty when all is well."""
        checker = Checker(electors=self.electors, moves_per_minute=self.moves_per_minute, slack_s=self.slack_s)
        found = []
        for record in sorted(self.records, key=lambda one: one.at):
            found += checker.take(record)
        return found

    def save(self, path: Path) -> None:
        """One JSON object a line, sorted by time: to be read after a failure."""
        lines = [
            json.dumps({"kind": type(one).__name__.lower(), **asdict(one)})
            for one in sorted(self.records, key=lambda one: one.at)
        ]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def load(self, path: Path) -> None:
        """Add the records of a saved history.

        Raises:
            ValueError: a line is no record.
        """
        for line in path.read_text(encoding="utf-8").splitlines():
            body = json.loads(line)
            try:
                self.record(_KINDS[body.pop("kind")](**body))
            except (KeyError, TypeError) as error:
                raise ValueError(f"{path}: not a record: {line[:120]}") from error
