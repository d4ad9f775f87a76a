"""VOTE, when one node asks another for what it has learnt, and when it tells everybody its own.

Knows: what was asked, heard and said, and when. Does not know: messages, registers, what a value means. What a beat
tells is anybody's word: no number in it may keep this node from learning, nor make it ask without end.
"""

from __future__ import annotations

import math

from zsched.core.values.model import NodeId, TaskId

ASK_LEARNT_EVERY_S = 0.3
ASK_AT_ONCE_S = 0.05
"""A peer whose beats, or word of a new value, tell of news is asked at most this often."""
VOTES_WAIT_S = 1.0
"""While the electors change, how often they have voted is asked for this much later."""
READ_EVERY_S = 2.0
"""A value that one node's word does not prove is read from a majority at most this often."""


class Questions:
    """One node's questions about learnt values. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._asked_at: dict[tuple[NodeId, bool], float] = {}
        """{(peer, whether for a newer revision): when}: news of votes must not delay a question about revisions."""
        self._awaited = 0, -math.inf
        """(highest fleet revision that a peer was asked for, until when no other peer is asked for it)."""
        self._said = 0, -math.inf
        """(newest fleet revision that everybody was told, when)."""
        self._changing = 0, -math.inf
        """(highest number that was heard while electors were not settled, since when)."""
        self._read_at: dict[TaskId, float] = {}

    def is_unasked(self, revision: int, learnt: int, now: float) -> bool:
        """Whether a fleet revision is newer than the learnt one, and no peer was asked for it just now.

        That holds others up once for each revision, and for none that is lower than one asked for before: a beat is
        anybody's word, and must not keep a node from learning.
        """
        asked, until = self._awaited
        return revision > learnt and (revision != asked or now >= until)

    def take(self, peer: NodeId, now: float, *, every_s: float, is_behind: bool, revision: int, learnt: int) -> bool:
        """Whether a peer may be asked now; it counts as asked then.

        Args:
            peer: whom.
            now: monotonic seconds.
            every_s: not twice within this time.
            is_behind: it has learnt a newer revision of a task.
            revision: of the fleet value that it has learnt.
            learnt: of this node's own.
        """
        if now - self._asked_at.get((peer, is_behind), -math.inf) < every_s:
            return False
        self._asked_at[peer, is_behind] = now
        if revision > max(learnt, self._awaited[0]):
            self._awaited = revision, now + ASK_LEARNT_EVERY_S
        return True

    def may_wait(self, number: int, now: float) -> bool:
        """Whether a question about votes may wait while the electors change to ``number``: `VOTES_WAIT_S` at most.

        Once a higher number was heard it may not: a beat is anybody's word, and numbers by turns must not begin the
        time again.
        """
        if number > self._changing[0]:
            self._changing = number, now
        return number == self._changing[0] and now < self._changing[1] + VOTES_WAIT_S

    def take_word(self, revision: int, now: float) -> bool:
        """Whether everybody is to be told the learnt fleet revision now; ``False``: it was said just now."""
        said, at = self._said
        if revision == said and now < at + ASK_LEARNT_EVERY_S:
            return False
        self._said = revision, now
        return True

    def take_read(self, task: TaskId, now: float) -> bool:
        """Whether a task's value may be read from a majority now."""
        if now - self._read_at.get(task, -math.inf) < READ_EVERY_S:
            return False
        self._read_at[task] = now
        return True
