"""The address plan: every control key is built and parsed here, and nowhere else.

Knows: the shape of each key. Does not know: what travels under it.

All control keys start with a verbatim ``@`` chunk, which no wildcard (``*``, ``**``) matches: a user who subscribes to
everything never receives our ballots. The chunk after the kind is the node that *owns* the key, so that an access rule
can bind it to that node's certificate; a request carries its asker behind it. `docs/design/keyspace.md` is this file as
a table.
"""

from __future__ import annotations

from functools import lru_cache

from zsched.core.values.model import MAX_COUNTER, NodeId, TaskId
from zsched.core.values.struct import Struct
from zsched.core.values.words import NAME

ROOT = "@zsched"
KEPT_KEYS = 512
"""Keys whose parts are remembered, the newest."""
MAX_DIGITS = len(str(MAX_COUNTER))
END_CHUNK = "@zsched/end"
"""Suffix of the in-band end markers behind a stream's last sample, and the start markers: ``{to}/@zsched/end``."""
AGAIN_CHUNK = "@zsched/again"
"""Behind an output's key, with a relay's zenoh id behind it: what that relay has missed, sent once more."""


class ParsedKey(Struct, frozen=True, kw_only=True):
    """A control key taken apart: ``kind``, the ``owner`` node and what follows it."""

    fleet: str
    kind: str
    owner: NodeId
    rest: tuple[str, ...]


@lru_cache(maxsize=KEPT_KEYS)
def parse(key: str) -> ParsedKey | None:
    """Take a control key apart; ``None`` when it is not one of ours or a name in it is malformed.

    At rest the same few keys come again and again.
    """
    chunks = key.split("/")
    if len(chunks) < 4 or chunks[0] != ROOT:
        return None
    if not all(NAME.fullmatch(chunk) for chunk in chunks[1:]):
        return None
    return ParsedKey(fleet=chunks[1], kind=chunks[2], owner=chunks[3], rest=tuple(chunks[4:]))


def counter(chunk: str) -> int | None:
    """The number in a key's chunk (an incarnation, an epoch); ``None`` when it is none that any node may have.

    >>> counter("12"), counter("9" * 25), counter("-1"), counter("")
    (12, None, None, None)
    """
    if not chunk.isascii() or not chunk.isdigit() or len(chunk) > MAX_DIGITS:
        return None
    number = int(chunk)
    return number if number <= MAX_COUNTER else None


class Keyspace(Struct, frozen=True):
    """The keys of one fleet. Pass ``"*"`` for a name to get the selector over all of them."""

    fleet: str

    def _key(self, *chunks: str) -> str:
        return "/".join((ROOT, self.fleet, *chunks))

    def alive(self, node: NodeId, incarnation: int | str) -> str:
        """Liveliness token of a daemon: presence, seen to go within milliseconds of a kill."""
        return self._key("alive", node, str(incarnation))

    def beat(self, node: NodeId) -> str:
        """Put, best effort: an urgent heartbeat: receivers wake up for it."""
        return self._key("beat", node)

    def beat_in_turn(self, node: NodeId) -> str:
        """Put, best effort: the heartbeat out of the decision loop; receivers look at it when they are awake anyway."""
        return self._key("beat", node, "in", "turn")

    def profile(self, node: NodeId) -> str:
        """Put: `Profile`, for something has happened: a worker's state, draining, a link that came or went."""
        return self._key("profile", node)

    def profile_in_turn(self, node: NodeId) -> str:
        """Put: `Profile` with new figures; receivers look at it when they are awake anyway."""
        return self._key("profile", node, "in", "turn")

    def utility(self, node: NodeId, asker: NodeId) -> str:
        """Queryable of ``node``: its utility vectors for all tasks."""
        return self._key("utility", node, asker)

    def proposal(self, node: NodeId) -> str:
        """Put: `Proposal`."""
        return self._key("proposal", node)

    def register(self, elector: NodeId, proposer: NodeId) -> str:
        """Queryable of ``elector``: prepare and accept."""
        return self._key("register", elector, proposer)

    def document(self, node: NodeId, asker: NodeId) -> str:
        """Queryable of ``node``: the fleet's documents, by their hashes."""
        return self._key("document", node, asker)

    def allocation(self, node: NodeId) -> str:
        """Put: the register values that ``node`` has learnt."""
        return self._key("allocation", node)

    def learnt(self, node: NodeId, asker: NodeId) -> str:
        """Queryable of ``node``: the same values, for one asker."""
        return self._key("allocation", node, asker)

    def all_puts(self) -> str:
        """Selector over every put of every node that wakes its receivers (beat, profile, proposal, allocation)."""
        return self._key("*", "*")

    def all_in_turn(self) -> str:
        """Selector over every put of every node that wakes nobody up."""
        return self._key("*", "*", "in", "turn")

    def all_questions(self, node: NodeId) -> str:
        """Key expression of every question to ``node``: ``<kind>/<node>/<asker>``."""
        return self._key("*", node, "*")

    def worker(self, node: NodeId, task: TaskId, incarnation: int | str) -> str:
        """Liveliness token of a worker on its data session: ready."""
        return self._key("worker", node, task, str(incarnation))

    def relay(self, node: NodeId, session: str) -> str:
        """Liveliness token of a relay on its data session, with its zenoh id: this life of it is there."""
        return self._key("relay", node, session)

    def role(self, node: NodeId, task: TaskId) -> str:
        """Put and queryable, to the worker from its own node: idle, active or draining."""
        return self._key("role", node, task)

    def trouble(self, node: NodeId, task: TaskId, incarnation: int | str) -> str:
        """Put of a worker, to its own node's relay: its callbacks raise, or what jobs it has done."""
        return self._key("trouble", node, task, str(incarnation))

    def ack(self, node: NodeId, task: TaskId, incarnation: int | str, relay: str) -> str:
        """Put of a worker, to the relay with that zenoh id: how far it has processed that relay's samples."""
        return self._key("ack", node, task, str(incarnation), relay)

    def received(self, node: NodeId, relay: str, worker: str) -> str:
        """Put of ``node``'s relay (its zenoh id), to the worker with that zenoh id: how far it has its answers."""
        return self._key("received", node, relay, worker)

    def snapshot(self, node: NodeId, task: TaskId) -> str:
        """Queryable of a worker: its state, chunked."""
        return self._key("snapshot", node, task)

    def status(self, node: NodeId, asker: NodeId) -> str:
        """Queryable of ``node``: what `zsched status` shows."""
        return self._key("status", node, asker)

    def command(self, node: NodeId, operator: NodeId) -> str:
        """Queryable of ``node``: operator commands."""
        return self._key("command", node, operator)
