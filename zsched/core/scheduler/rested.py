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

from zsched.core.absence import Absences
from zsched.core.doubt import Doubt
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import HAS_RESTED, RESTS

SURE_S: Final = 3.0
"""An owner's word counts after so long, in all: a lease that electors grant again is told of in less."""
FORGIVEN_RATIO: Final = 0.1
"""An owner at work makes up so much of the time in which it has said that it rests: it says so late (`Tenure`)."""
_NOBODY: Final[Mapping[NodeId, str]] = {}


class Rested(Struct):
    """What one node has heard of owners that rest."""

    _doubts: dict[tuple[TaskId, NodeId], Doubt] = field(default_factory=dict)
    _absences: dict[tuple[TaskId, NodeId], Absences] = field(default_factory=dict)
    """Of owners at work, by their own word, that beats do not explain."""

    def hear(self, task: TaskId, owner: Profile, now: float, *, is_explained: bool) -> None:
        """The owner's newest profile; ``is_explained``: beats say why it rests, if it does."""
        load, key = owner.worker(task), (task, owner.node)
        word = None if load is None or load.state is not WorkerState.READY or is_explained else load.reason
        rests = word is not None and word.startswith(RESTS)
        for (name, node), others in self._absences.items():
            if name == task and node != owner.node:  # it is not asked to work
                others.look(is_away=False, now=now, limit_s=SURE_S)
        if rests and key not in self._absences:
            self._absences[key] = Absences(forgiven_ratio=FORGIVEN_RATIO)
        for_s = self._absences[key].look(rests, now, SURE_S) if key in self._absences else 0.0
        if for_s >= SURE_S:
            self._doubts.setdefault(key, Doubt(seen_at=now)).see(now)
        elif word is not None and not rests and key in self._doubts:
            self._doubts[key].keep(now)

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
        self._absences = {key: one for key, one in self._absences.items() if key[0] in tasks and key[1] in nodes}
