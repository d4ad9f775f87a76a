"""The parts of a simulated machine: a clock that may run wrong, a disk that may lose or damage what was written.

Knows: what a machine keeps and forgets. Does not know: the network, when anything happens, what a node decides.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from random import Random

from zsched.core.node.node import Node
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import WireError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import Allocation, NodeId, RegisterState, TaskId
from zsched.core.values.plan import Role
from zsched.core.values.problems import Problem

PAST_KEPT = 64


@dataclass(slots=True)
class Clock:
    """A machine's CLOCK_BOOTTIME against true time; it may run fast, slow, jump ahead or stand still, never go back."""

    rate: float = 1.0
    is_true: bool = True
    """Whether both are the same number (so that nothing is rounded)."""
    _true: float = 0.0
    _local: float = 0.0

    def local(self, true: float) -> float:
        """What the machine reads at a true time."""
        return true if self.is_true else self._local + (true - self._true) * self.rate

    def true(self, local: float) -> float:
        """When the machine reads ``local``, as things are now."""
        if self.is_true or local == math.inf:
            return local
        return self._true + (local - self._local) / self.rate

    def change(self, true: float, *, rate: float | None = None, jump_s: float = 0.0) -> None:
        """From now on run at another rate, or a little later at once (``jump_s`` >= 0)."""
        self._local, self._true = self.local(true) + jump_s, true
        self.rate = self.rate if rate is None else rate
        self.is_true = self.rate == 1.0 and self._true == self._local


@dataclass(slots=True)
class Disk:
    """One state file: a write is a whole new file, on disk only once it is synced."""

    state: DurableState | None = None
    """What is on disk, decoded (``None``: no valid file)."""
    content: bytes | None = None
    registers: dict[TaskId, RegisterState] = field(default_factory=dict)
    """What ``state`` holds, by task."""
    is_broken: bool = False
    """Full or read-only: it refuses every write."""
    documents: list[str] = field(default_factory=list)
    """Hashes of the fleet's documents that are stored beside the state, the newest last."""
    lost: set[str] = field(default_factory=set)
    """Those of them that were there, and have gone by themselves: the state may name them all the same."""
    past: deque[bytes] = field(default_factory=lambda: deque(maxlen=PAST_KEPT))
    """What the file held before: what a backup may bring back."""
    _unsynced: DurableState | None = None
    _in_cache: int | None = None
    """How many of the newest contents only the cache of a lying disk holds; ``None``: it does not lie."""

    def write(self, state: DurableState) -> None:
        """The new file is written and renamed, but not synced yet."""
        self._unsynced = state

    def sync(self) -> None:
        """What was written survives a power cut from now on."""
        if self._unsynced is not None:
            if self.content is not None:
                self.past.append(self.content)
                self._in_cache = None if self._in_cache is None else self._in_cache + 1
            self.state, self._unsynced = self._unsynced, None
            self.content = wire.encode_state(self.state)
            self._index()

    def lose_power(self, rng: Random) -> None:
        """What was not synced is there or not: the old file or the new one, each whole."""
        if rng.random() < 0.5:
            self._unsynced = None
        self.sync()

    def begin_to_lie(self) -> None:
        """From now on a sync returns before the platter has anything."""
        self._in_cache = 0

    def forget(self, rng: Random) -> bool:
        """The power of a lying disk went: some of the newest writes are lost. Whether any is; it lies no more."""
        lost, self._in_cache = rng.randint(0, self._in_cache or 0), None
        return self._go_back(lost)

    def restore(self, rng: Random) -> bool:
        """A backup is brought back, of any moment of this generation. Whether it is older than what was there."""
        return self._go_back(rng.randint(0, len(self.past)))

    def _go_back(self, writes: int) -> bool:
        """To what the file held this many writes ago."""
        self._unsynced = None
        if not 0 < writes <= len(self.past):
            return False
        self.content = self.past[-writes]
        for _ in range(writes):
            self.past.pop()
        self.state = self.read()
        self._index()
        self.lost |= self.named() - set(self.documents)
        return True

    def named(self) -> set[str]:
        """The documents that the state names."""
        register = None if self.state is None else self.state.fleet_register
        if register is None:
            return set()
        values = (register.learnt, None if register.accepted is None else register.accepted.value)
        return {value.document for value in values if value is not None and value.document}

    def damage(self, rng: Random) -> None:
        """The card is worn out: the file is cut short, or one of its bits is another one."""
        self._unsynced = None
        if not self.content:
            return
        if rng.random() < 0.5:
            content = self.content[: rng.randrange(len(self.content))]
        else:
            at, bit = rng.randrange(len(self.content)), 1 << rng.randrange(8)
            content = self.content[:at] + bytes([self.content[at] ^ bit]) + self.content[at + 1 :]
        self.content = content
        self.state = self.read()
        self._index()

    def lose_documents(self, kept: int) -> tuple[str, ...]:
        """Of the documents only the oldest are there any more, the state beside them stays; answers what has gone."""
        gone = tuple(self.documents[kept:])
        del self.documents[kept:]
        self.lost |= set(gone)
        return gone

    def wipe(self) -> None:
        """The disk is new."""
        self.state = self.content = self._unsynced = self._in_cache = None
        self.past.clear()
        self.documents.clear()
        self.lost.clear()
        self._index()

    def _index(self) -> None:
        self.registers = {} if self.state is None else {one.task: one for one in self.state.registers}

    def read(self) -> DurableState | None:
        """What a starting daemon finds, through the production format."""
        if self.content is None:
            return None
        try:
            return wire.decode_state(self.content)
        except WireError:
            return None


@dataclass(slots=True)
class Machine:
    """One simulated computer with its daemon."""

    key: str
    """Unique; a twin (a second machine that calls itself the same) has a key of its own."""
    name: NodeId
    fleet: Fleet
    """As this machine's fleet file says."""
    disk: Disk = field(default_factory=Disk)
    clock: Clock = field(default_factory=Clock)
    node: Node | None = None
    life: int = 0
    is_elector: bool = False
    """Whether this life started as an elector, with a valid state of this electorate."""
    is_durable: bool = False
    """Whether this life keeps a state (and its disk has not refused yet)."""
    wake_at: float = math.inf
    workers: dict[TaskId, int] = field(default_factory=dict)
    """{task: the life of this machine in which its worker became ready}."""
    roles: dict[TaskId, Role] = field(default_factory=dict)
    inbox: deque[ev.Event] = field(default_factory=deque)
    busy_until: float = -math.inf
    is_paused: bool = False
    frozen_at: float | None = None
    """Since when the whole machine stands still, its clock too; ``None``: it does not."""
    asleep_since: float | None = None
    """Since when the machine sleeps, its clock going on; ``None``: it does not."""
    sleep_error_s: float = 0.0
    untold_sleep_s: float = 0.0
    """How long it has slept by its own clock, until its node hears of that."""
    """By how much it then misjudges how long that was."""
    late_until: float = -math.inf
    """By its own clock: leases until then were begun before it last stood still."""
    is_pumping: bool = False
    event_s: float = 0.0
    """What handling one event costs."""
    disk_s: tuple[float, float] = (0.0, 0.0)
    """How long a synced write takes, from and to."""
    known: dict[TaskId, Allocation] = field(default_factory=dict)
    """Without a disk: the values of this life that were checked already."""
    at_once: int = 0
    """How often in a row the node has wanted to be called again at once."""

    @property
    def believes_its_clock(self) -> bool:
        """Whether its node has heard all that the watch has told, and is in no doubt; true of one that does not run."""
        is_behind = self.is_paused or bool(self.inbox)
        return self.node is None or not (is_behind or (Problem.CLOCK, "") in self.node.problems)

    def end(self) -> None:
        """The process is gone, and what it held in memory; its worker with it."""
        self.node = None
        self.life += 1
        self.workers.clear()
        self.roles.clear()
        self.inbox.clear()
        self.busy_until, self.is_paused, self.wake_at = -math.inf, False, math.inf
        self.frozen_at = self.asleep_since = None
        self.untold_sleep_s = 0.0
