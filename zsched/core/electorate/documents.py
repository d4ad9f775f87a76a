"""The fleet's documents as one node knows them: which are stored here, which are wanted, and from whom.

Knows: hashes, what the stored texts say. Does not know: bytes, disks, how a document is fetched and checked
(`zsched.runtime.library`), which fleet value is in force (`zsched.core.electorate.numbers`).

A fleet value is neither accepted nor learnt before its document is stored here. A document that is not valid here is
not asked for again: the node goes on by its last one, and says so. One that the disk refuses is asked for again, for
the disk may take it later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from zsched.core.values import instructions as do
from zsched.core.values.document import Flag, Rollout
from zsched.core.values.electorate import FleetValue
from zsched.core.values.events import DocumentRefused
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.problems import Problem
from zsched.core.values.todo import ToDo

FETCH_EVERY_S = 3.0
"""A document that no peer has sent is asked for again after this time."""
RECENT = 3
"""Documents stored last that a node knows beside those that its state names."""
MAX_WANTED = 4
"""A peer's word must not fill the memory: of more wanted or refused documents the oldest are forgotten."""


class Documents:
    """One node's documents.

    Args:
        me: this node.
        stored: {hash: what it says} of those that the state names.
        flags: {hash: its flags} of those of them that have any.
    """

    def __init__(
        self, me: NodeId, stored: Mapping[str, Fleet], flags: Mapping[str, tuple[Flag, ...]] = MappingProxyType({})
    ) -> None:
        self._me = me
        self._flags = dict(flags)
        self._fleets: dict[str, Fleet] = dict(stored)
        """The newest last."""
        self._wanted: dict[str, list[NodeId]] = {}
        """{hash: who said that it has it, the last first}."""
        self._ask_at: dict[str, float] = {}
        self._kept: tuple[str, ...] = tuple(stored)
        self._told: tuple[str, ...] = tuple(sorted(stored))
        """What the disk was told to keep: every document that is known here, or one that comes back is not on it."""
        self.refused: dict[str, tuple[Problem, str]] = {}
        """{hash: (which problem that is, why it is not valid here)}, the newest last."""
        self.unwritten: dict[str, str] = {}
        """{hash: why the disk has refused it} of those that are wanted still."""

    def holds(self, value: FleetValue) -> bool:
        """Whether the document of a fleet value is stored here; a value without one needs none."""
        return not value.document or value.document in self._fleets

    def fleet(self, document: str) -> Fleet | None:
        """What a stored document says."""
        return self._fleets.get(document)

    def flags(self, document: str) -> tuple[Flag, ...]:
        """What operators have said of nodes, by a stored document; nothing if it is not stored here."""
        return self._flags.get(document, ())

    def rollouts(self, document: str) -> tuple[Rollout, ...]:
        """The changed workers that wait for a look, by a stored document; nothing if it is not stored here."""
        fleet = self._fleets.get(document)
        return () if fleet is None else tuple(task.rollout for task in fleet.tasks if task.rollout is not None)

    def next_deadline(self) -> float:
        """When `tick` has something to do."""
        return min((self._ask_at[document] for document in self._wanted), default=math.inf)

    def want(self, value: FleetValue, peers: Iterable[NodeId], todo: ToDo, now: float) -> None:
        """Fetch the document of a fleet value from one of these peers."""
        document = value.document
        if self.holds(value) or document in self.refused:
            return
        known = self._wanted.pop(document, [])
        told = [peer for peer in peers if peer != self._me]
        self._wanted[document] = [*told, *(peer for peer in known if peer not in told)]
        for old in tuple(self._wanted)[:-MAX_WANTED]:
            self._forget(old)
        if now >= self._ask_at.get(document, -math.inf):
            self._ask(document, todo, now)

    def tick(self, todo: ToDo, now: float) -> None:
        """Ask again for what nobody has sent."""
        for document in tuple(self._wanted):
            if now >= self._ask_at[document]:
                self._ask(document, todo, now)

    def _ask(self, document: str, todo: ToDo, now: float) -> None:
        self._ask_at[document] = now + FETCH_EVERY_S
        todo.add(do.FetchDocument(document=document, peers=tuple(self._wanted[document])))

    def _forget(self, document: str) -> None:
        self._wanted.pop(document, None)
        self._ask_at.pop(document, None)
        self.unwritten.pop(document, None)

    def on_stored(self, document: str, fleet: Fleet, todo: ToDo, flags: tuple[Flag, ...] = ()) -> None:
        """A document is on disk, and valid."""
        self._forget(document)
        self.refused.pop(document, None)
        self._fleets.pop(document, None)
        self._fleets[document], self._flags[document] = fleet, flags
        self._drop_old(todo)

    def on_refused(self, event: DocumentRefused) -> None:
        """A document that a peer sent is not valid here: it is not asked for again, unless only the disk refuses it.

        One that nobody is asked for is this node's own draft, which is not agreed.
        """
        if (document := event.document) not in self._wanted:
            return
        if event.is_of_disk:
            self.unwritten[document] = event.reason
            return
        self._forget(document)
        self.refused.pop(document, None)
        self.refused[document] = Problem.TAKEN_OUT if event.is_taken_out else Problem.DOCUMENT, event.reason
        for old in tuple(self.refused)[:-MAX_WANTED]:
            del self.refused[old]

    def keep(self, documents: tuple[str, ...], todo: ToDo) -> None:
        """The node's state names these from now on; of the others those that were stored last stay."""
        if documents != self._kept:
            self._kept = documents
            self._drop_old(todo)

    def _drop_old(self, todo: ToDo) -> None:
        others = [document for document in self._fleets if document not in self._kept]
        for document in others[:-RECENT]:
            del self._fleets[document]
            self._flags.pop(document, None)
        known = tuple(sorted({*self._fleets, *self._kept}))
        if known != self._told:
            self._told = known
            todo.add(do.KeepDocuments(documents=known))
