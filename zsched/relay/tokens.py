"""Watches the workers' liveliness tokens on the data network: which are ready, and in which epoch they work.

Knows: token keys, their coming and going. Does not know: slots, routes, what readiness leads to.

The watch runs on the relay's data session on purpose: a worker declares its token there behind its subscribers, so who
sees the token has also learnt of the subscriptions. (Zenoh's "matching" alone is true as soon as a recorder listens.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

from zenoh import Sample, SampleKind, Session

from zsched.core.values.events import RoleEnded
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.relay_protocol import WorkerSeen
from zsched.host.guard import tolerant
from zsched.link.keyspace import Keyspace, counter, parse

MAX_TOKENS = 16_384
"""Tokens that are remembered: a fleet has one or two per worker."""
MAX_OF_NODE = 1024
"""...and of one node: its flood must not take the place of other nodes' workers."""
WORKER = "worker"
ROLE = "role"


class Tokens:
    """The tokens that are there now. ``on_worker`` hears of every worker's, ``on_role_ended`` of epochs left."""

    def __init__(
        self,
        session: Session,
        keyspace: Keyspace,
        on_worker: Callable[[WorkerSeen], None],
        on_role_ended: Callable[[NodeId, RoleEnded], None],
        wake: Callable[[], None],
    ) -> None:
        self._keyspace = keyspace
        self._on_worker = on_worker
        self._on_role_ended = on_role_ended
        self._wake = wake
        self._present: frozenset[str] = frozenset()  # replaced whole: readers need no lock
        self._of_node: Counter[NodeId] = Counter()
        self._sessions = 0
        """How many we have had, so that what an earlier one still says is told apart."""
        self.rejoin(session)

    def leave(self) -> None:
        """The session is about to close: what goes with it has not gone."""
        self._sessions += 1
        self._present, self._of_node = frozenset(), Counter()

    def rejoin(self, session: Session) -> None:
        """Watch on this session, with no token to begin with."""
        self.leave()
        hear = partial(self._hear, self._sessions)
        selector = self._keyspace.worker("*", "*", "*").replace(f"/{WORKER}/", "/*/")
        # a callback: its thread sleeps until a token comes, one that waits at a handler wakes up ten times a second
        self._watch = session.liveliness().declare_subscriber(selector, tolerant(hear, "tokens"), history=True)

    def workers(self, node: NodeId, task: TaskId) -> frozenset[str]:
        """The tokens of the node's workers for the task: one, or two while one restarts."""
        prefix = self._keyspace.worker(node, task, "")
        return frozenset(key for key in self._present if key.startswith(prefix))

    def has_worker(self, node: NodeId, task: TaskId, incarnation: str) -> bool:
        """Whether this life of a node's worker is there."""
        return self._keyspace.worker(node, task, incarnation) in self._present

    def is_active(self, node: NodeId, task: TaskId, epoch: int) -> bool:
        """True when the node's worker says that it works in that epoch."""
        return f"{self._keyspace.role(node, task)}/{epoch}" in self._present

    def seen(self) -> tuple[WorkerSeen, ...]:
        """Every worker that is there now."""
        found = (_worker(key, is_present=True) for key in sorted(self._present))
        return tuple(worker for worker in found if worker is not None)

    def _hear(self, of: int, sample: Sample) -> None:
        if of == self._sessions:
            self._note(str(sample.key_expr), is_present=sample.kind == SampleKind.PUT)

    def _note(self, key: str, *, is_present: bool) -> None:
        parsed = parse(key)
        node = "" if parsed is None else parsed.owner
        if is_present and (len(self._present) >= MAX_TOKENS or self._of_node[node] >= MAX_OF_NODE):
            return
        if (key in self._present) != is_present:
            self._of_node[node] += 1 if is_present else -1
            if not self._of_node[node]:
                del self._of_node[node]  # a stranger's tokens may have any name
        self._present = self._present | {key} if is_present else self._present - {key}
        if (worker := _worker(key, is_present=is_present)) is not None:
            self._on_worker(worker)
        if parsed is not None and parsed.kind == ROLE and len(parsed.rest) == 2 and not is_present:
            task, epoch = parsed.rest
            number = counter(epoch)
            if number is not None:
                self._on_role_ended(parsed.owner, RoleEnded(task=task, epoch=number))
        self._wake()


def _worker(key: str, *, is_present: bool) -> WorkerSeen | None:
    """What a token says of a worker; ``None``: it is a role's."""
    parsed = parse(key)
    if parsed is None or parsed.kind != WORKER or len(parsed.rest) != 2:
        return None
    task, incarnation = parsed.rest
    return WorkerSeen(node=parsed.owner, task=task, incarnation=incarnation, is_present=is_present)
