"""Decides when a daemon begins again, so that its sessions go by other access rules or another certificate.

An open session of zenoh keeps the access rules, the certificate with which it listens, and the addresses that it dials,
that it was opened with. So nodes begin again in turns (`turns`).

Knows: the order of nodes, how long each of them has at most, whose lives are new. Does not know: which nodes live,
what has changed, how a daemon begins again (`zsched.daemon`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from zsched.core.executor.sparing import Sparing
from zsched.core.values.fleet import Timing
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct, field

LEAST_FIRST_S = 2.0
"""The first one waits at least this long: the daemons' own work may take longer than the round trips."""
FIRST_BALLOTS = 4
"""And at least so many times ``ballot_s``: all learn of a change within 6.5 round trips, and a phase of a
vote is over after ``ballot_s``. Who learns of it after the first has begun again waits for that one's whole turn."""
TURN_S = 10.0
"""Each has at most this long: a daemon that owns tasks gives them away (3 s), ends (2 s) and is heard again (3 s)."""
SETTLE_S = 1.0
"""Once all before it are heard in a new life, the next one waits this long: their workers start meanwhile."""
OWNER_S = 30.0
"""An owner waits this much longer for another candidate that starts: without one its task would have no owner."""
LEAST_ELECTORS = 3
"""Of so many, one may be away and the others agree: so one goes with the first turn of the others."""
LONGEST_WAIT_S = 120.0
"""An elector waits this long for the others; one that is away for good must not keep a new node out."""


def turns(
    nodes: Collection[NodeId],
    electors: Collection[NodeId],
    robots: Collection[NodeId] = (),
    tasks: Collection[Collection[NodeId]] = (),
) -> tuple[tuple[NodeId, ...], ...]:
    """The nodes in the turns in which they begin again: electors one at a time, the others several at once.

    A new node counts as soon as it hears a majority of the electors. So only one turn of others comes before them, one
    elector goes with it, and the new node waits for at most as many turns as a majority of the electors has, in a fleet
    of any size. In one turn are fewer robots than would be missed in a vote, and never all candidates of a task. Each
    elector comes before the same others in every node's order, whomever that one hears.

    Args:
        nodes: that live.
        electors: of the fleet.
        robots: whose votes count; those without one that begins again have to be a majority.
        tasks: the candidates of each task.

    >>> electors = ("edge1", "robot1", "robot2")
    >>> turns((*electors, "edge2", "edge3"), electors, tasks=[("edge2", "edge3")])
    (('robot2', 'edge2'), ('edge1',), ('robot1',), ('edge3',))
    """
    most = max((len(robots) - 1) // 2, 1)
    singly, others = sorted(set(nodes).intersection(electors)), sorted(set(nodes).difference(electors))
    # The last of all, not of those that live: nodes that hear others must not take two of them for the first.
    # The last one, since operators often command the machine that founded the fleet.
    last = max(electors) if len(electors) >= LEAST_ELECTORS else None
    waves = [[singly.pop()]] if last in singly else []
    for name in others:
        fitting = (wave for wave in waves if _fits(name, wave, nodes, tasks))
        wave = next((one for one in fitting if name not in robots or len(set(robots) & {*one, name}) <= most), None)
        if wave is None:
            waves.append(wave := [])
        wave.append(name)
    first, *later = map(tuple, waves or [[]])
    return (*((first,) if first else ()), *((name,) for name in singly), *later)


def _fits(
    name: NodeId, wave: Collection[NodeId], nodes: Collection[NodeId], tasks: Collection[Collection[NodeId]]
) -> bool:
    """Whether each task that the node may have has another candidate that lives and stays meanwhile."""
    living = ({one for one in task if one in nodes} for task in tasks if name in task)
    return all(task == {name} or task - {name, *wave} for task in living)


class Reopening(Struct):
    """One node's turn: when all before it have begun again, at the latest when the time of all of them is over."""

    me: NodeId
    due_at: float | None = None
    """The latest of its turn (monotonic seconds); ``None``: nothing is to be opened again."""
    _first_at: float = 0.0
    _before: Mapping[NodeId, int | None] = field(default_factory=dict)
    """{node of an earlier turn: its incarnation when something changed}."""
    _anew_at: float | None = None
    """Since when all of them are heard in a new life."""

    def want(
        self,
        order: Sequence[Collection[NodeId]],
        lives: Mapping[NodeId, int | None],
        now: float,
        *,
        first_s: float,
    ) -> None:
        """Something has changed for all of ``order``, this node among them; a turn that is set stays.

        Args:
            order: the nodes of each turn (`turns`).
            lives: {node: its incarnation, as far as it was heard}.
            now: monotonic seconds.
            first_s: the first one waits this long, seconds (`first_wait_s`).
        """
        if self.due_at is None:
            count = next(number for number, names in enumerate(order) if self.me in names)
            self._first_at, self.due_at = now + first_s, now + first_s + TURN_S * count
            self._before = {name: lives.get(name) for names in order[:count] for name in names}
            self._anew_at = None

    def forget(self) -> None:
        """The sessions are right as they are."""
        self.due_at = None

    def put_off(self, now: float) -> None:
        """It cannot be now."""
        self.due_at = self._first_at = now + LONGEST_WAIT_S

    def is_due(
        self,
        electors: Collection[NodeId],
        lives: Mapping[NodeId, int | None],
        now: float,
        *,
        lack: Collection[Sparing] = (),
    ) -> bool:
        """Whether to begin again now.

        Args:
            electors: of the fleet.
            lives: {other node that lives: its incarnation}.
            now: monotonic seconds.
            lack: of each task that would have no owner: it waits for the latest of its turn, and for `OWNER_S` more
                where somebody starts who could have the task.
        """
        if self.due_at is None or now < self._first_at:
            return False
        if now < self.due_at and (lack or not self._is_next(lives, now)):
            return False
        if now < self.due_at + OWNER_S and Sparing.STARTING in lack:
            return False
        missing = {name for name in electors if name not in lives} - {self.me}
        return self.me not in electors or not missing or now >= self.due_at + LONGEST_WAIT_S

    def _is_next(self, lives: Mapping[NodeId, int | None], now: float) -> bool:
        """Whether all before it have begun again, and have had time to start their workers."""
        if not all(_is_newer(lives.get(name), before) for name, before in self._before.items()):
            self._anew_at = None
            return False
        if self._anew_at is None:
            self._anew_at = now
        return not self._before or now >= self._anew_at + SETTLE_S


def first_wait_s(timing: Timing) -> float:
    """How long the first one waits, seconds: by then the others have learnt of the change."""
    return max(LEAST_FIRST_S, FIRST_BALLOTS * timing.ballot_s)


def _is_newer(life: int | None, before: int | None) -> bool:
    return life is not None and before is not None and life > before


class Moved(Struct):
    """The nodes that open sessions dial where they are no more, by the fleet in force."""

    _lives: dict[NodeId, int | None] = field(default_factory=dict)
    """{node: its incarnation when it was first looked at}."""
    _names: tuple[NodeId, ...] = ()

    @property
    def is_any(self) -> bool:
        """Whether there is one at all."""
        return bool(self._names)

    def take(self, names: tuple[NodeId, ...]) -> None:
        """Another fleet is in force: these nodes have other addresses by it."""
        self._names = names
        self._lives = {name: life for name, life in self._lives.items() if name in names}

    def left(self, lives: Mapping[NodeId, int | None]) -> frozenset[NodeId]:
        """Those of them that have left their former address: they are not heard, or in another life only.

        ``lives``: {other node that lives: its incarnation}. Who is still heard is dialled where it is.
        """
        for name in self._names:
            self._lives.setdefault(name, lives.get(name))
        return frozenset(name for name, life in self._lives.items() if life is None or lives.get(name) != life)
