"""Hears what this node's workers say of themselves (jobs done, callbacks that raise) and lets the daemon know.

Knows: the keys it comes on, how much of it is handed on. Does not know: what a callback does, what follows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from zenoh import Sample, Session

from zsched.core.values.errors import WireError
from zsched.core.values.events import FrameDropped, WorkerJobs
from zsched.core.values.model import NodeId
from zsched.core.values.relay_protocol import WorkerTrouble
from zsched.host.clock import monotonic_s
from zsched.host.guard import tolerant
from zsched.link.keyspace import Keyspace, parse
from zsched.link.pipe.frames import decode_word

PAUSE_S: Final = 0.1
"""A worker says something five times a second; more than this is no worker of ours, and is left out."""
MAX_SPEAKERS: Final = 256
"""Tasks, times the kinds of words: more of them within `PAUSE_S` are no workers of ours either."""
_GARBAGE: Final = ""

Word = WorkerTrouble | WorkerJobs | FrameDropped


class Troubles:
    """One subscription. ``report`` is called in zenoh's thread and must only enqueue."""

    def __init__(self, session: Session, keyspace: Keyspace, node: NodeId, report: Callable[[Word], None]) -> None:
        self._report = report
        self._reported_at: dict[tuple[str, type[Word]], float] = {}
        """{speaker: when its newest word was handed on}, in that order."""
        self._key = keyspace.trouble(node, "*", "*")
        self.rejoin(session)

    def rejoin(self, session: Session) -> None:
        """Hear on this session."""
        self._subscriber = session.declare_subscriber(self._key, tolerant(self._hear, "trouble"))

    def _hear(self, sample: Sample) -> None:
        parsed = parse(str(sample.key_expr))
        if parsed is None:
            return
        try:
            word = decode_word(sample.payload.to_bytes())
        except WireError as error:
            self._hand_on(_GARBAGE, FrameDropped(kind="trouble", reason=error.reason))
            return
        if parsed.rest == (word.task, word.incarnation):
            self._hand_on(word.task, word)
        else:
            self._hand_on(_GARBAGE, FrameDropped(kind="trouble", reason="foreign"))

    def _hand_on(self, task: str, word: Word) -> None:
        now, speaker = monotonic_s(), (task, type(word))
        if now - self._reported_at.get(speaker, -PAUSE_S) < PAUSE_S:
            return
        if self._reported_at.pop(speaker, None) is None and len(self._reported_at) >= MAX_SPEAKERS:
            silent, since = next(iter(self._reported_at.items()))
            if now - since < PAUSE_S:
                return
            del self._reported_at[silent]
        self._reported_at[speaker] = now
        self._report(word)
