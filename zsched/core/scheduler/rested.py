"""SCHEDULER, exclusive tasks: owners that say that they rest for want of a lease, and for how long they are avoided.

Knows: the owner's own word. Does not know: leases, who hears whom (`zsched.core.vote.lease`).

Robots see by beats whether a majority of the electors and a candidate hear each other. Of an elector that they do not
hear themselves they see nothing, and count it as granting. The owner knows better, and says so. It says nothing of the
others: where nobody could have a lease the task would go round. So whoever has rested is avoided for a minute, and
twice as long each time (`zsched.core.doubt`), while somebody else has not.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from typing import Final

from zsched.core.doubt import Doubt
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import HAS_RESTED, RESTS

SURE_S: Final = 3.0
"""An owner's word counts after so long: a lease that electors grant again is told of in less."""
_NOBODY: Final[Mapping[NodeId, str]] = {}


class Rested(Struct):
    """What one node has heard of owners that rest."""

    _doubts: dict[tuple[TaskId, NodeId], Doubt] = field(default_factory=dict)
    _since: dict[TaskId, tuple[NodeId, float]] = field(default_factory=dict)
    """{task: (its owner, since when that has said that it rests)}."""

    def hear(self, task: TaskId, owner: Profile, now: float, *, is_explained: bool) -> None:
        """The owner's newest profile; ``is_explained``: beats say why it rests, if it does."""
        load, key = owner.worker(task), (task, owner.node)
        if load is None or load.state is not WorkerState.READY or is_explained:
            self._since.pop(task, None)
            return
        if not load.reason.startswith(RESTS):
            self._since.pop(task, None)
            if key in self._doubts:
                self._doubts[key].keep(now)
            return
        node, since = self._since.get(task, (owner.node, now))
        self._since[task] = (node, since) if node == owner.node else (owner.node, now)
        if now >= self._since[task][1] + SURE_S:
            self._doubts.setdefault(key, Doubt(seen_at=now)).see(now)

    def reasons(self, task: TaskId, candidates: Iterable[NodeId], now: float) -> Mapping[NodeId, str]:
        """{candidate that has rested: why it may not have the task}; nobody where all of ``candidates`` have.

        Args:
            task: which one.
            candidates: those that nothing else is known against.
            now: monotonic seconds.
        """
        if not self._doubts:
            return _NOBODY
        names = tuple(candidates)
        held = [name for name in names if (task, name) in self._doubts and not self._doubts[task, name].is_over(now)]
        return dict.fromkeys(held, HAS_RESTED) if len(held) < len(names) else _NOBODY

    def keep(self, tasks: Container[TaskId], nodes: Container[NodeId]) -> None:
        """Know nothing of others."""
        self._doubts = {key: one for key, one in self._doubts.items() if key[0] in tasks and key[1] in nodes}
        self._since = {task: one for task, one in self._since.items() if task in tasks}
