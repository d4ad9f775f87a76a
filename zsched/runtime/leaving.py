"""When a daemon that was told to stop goes: once what it owns has moved, or when it has waited for long enough.

Knows: how long each wait is, that a second signal means now, and that who was told to stop does not begin anew. Does
not know: signals, clocks, what moves a task.
"""

from __future__ import annotations

from collections.abc import Collection

from zsched.core.values.model import TaskId
from zsched.core.values.struct import Struct

HAND_OVER_S = 3.0
"""How long a stopping owner waits for tasks that another node could take. With what follows (`LEAVE_S`, workers, relay,
session: 3.7 s at most) it fits into the unit's TimeoutStopSec=8."""
ANEW_S = 10.0
"""...where it begins anew in its process: nobody counts its seconds, and a busy fleet needs some for a move."""
NOBODY_S = 0.8
"""...and for those that nobody else can: their answers are still to come."""
LEAVE_S = 1.5
"""...and how long it stays when they are moved: the next owner's worker asks ours for its state, which a full machine
is long about, and what ours has in hand is still to come."""
FINISH_S = 10.0
"""...and where it begins anew: at most this long, until its workers say that they have finished."""
TWICE_S = 0.3
"""Two signals so close together are one: a terminal and a wrapper may both pass on the same Ctrl-C."""


class Told(Struct, eq=False):
    """What a process was told of its end: by a signal, which may come between any two steps, or by an operator.

    What the process itself has in mind (`begin_anew`) never takes that back, whichever of both came first.
    """

    _is_told: bool = False
    _keeps_relay: bool = False
    _wants_anew: bool = False

    def stop(self, *, keeps_relay: bool = False) -> None:
        """Somebody tells it to end. ``keeps_relay``: its service starts again at once."""
        self._keeps_relay = keeps_relay
        self._is_told = True

    def begin_anew(self) -> None:
        """It is to become another daemon, in place."""
        self._wants_anew = True

    @property
    def begins_anew(self) -> bool:
        """Whether it becomes another daemon: nobody has told it to end."""
        return self._wants_anew and not self._is_told

    @property
    def keeps_relay(self) -> bool:
        """Whether its relay stays for the daemon that follows."""
        return self._keeps_relay or self.begins_anew


class Leaving(Struct):
    """One daemon's way out."""

    asked_at: float | None = None
    _moved_at: float | None = None
    _is_hurried: bool = False
    _begins_anew: bool = False

    def ask(self, owned: Collection[TaskId], now: float, *, begins_anew: bool = False) -> bool:
        """Somebody asks to stop; whether that is the first time. The second time means: at once.

        ``begins_anew``: the process goes on, so a move and its worker have more time. Who is told to stop meanwhile is
        told so for the first time.
        """
        if self._begins_anew and not begins_anew:
            self.asked_at, self._begins_anew = now, False
            return True
        if self.asked_at is None:
            self.asked_at, self._begins_anew = now, begins_anew
            if not owned:
                self._is_hurried = True  # nothing is to be handed over
            return True
        self._is_hurried |= now - self.asked_at >= TWICE_S
        return False

    def is_over(
        self, owned: Collection[TaskId], movable: Collection[TaskId], now: float, *, finishing: Collection[TaskId] = ()
    ) -> bool:
        """Whether to go now.

        Args:
            owned: what this node owns.
            movable: what of it another node could take.
            now: monotonic seconds.
            finishing: what has moved while the worker here still has some of it in work.
        """
        if self.asked_at is None:
            return False
        if self._is_hurried:
            return True
        if not owned:
            self._moved_at = now if self._moved_at is None else self._moved_at
            return now >= self._moved_at + (FINISH_S if finishing and self._begins_anew else LEAVE_S)
        self._moved_at = None
        hand_over_s = ANEW_S if self._begins_anew else HAND_OVER_S
        return now >= self.asked_at + (hand_over_s if movable else NOBODY_S)

    def last_words(self, owned: Collection[TaskId], now: float) -> str:
        """What is left behind, for the log; empty: nothing."""
        if not owned or self.asked_at is None:
            return ""
        tasks = f"{len(owned)} task{'s'[: len(owned) != 1]}"
        why = "told to stop twice" if self._is_hurried else "nobody has taken over"
        return (
            f"leaves {tasks} behind after {now - self.asked_at:.1f} s ({', '.join(sorted(owned))}): {why}; "
            "the robots move what they can once they miss this node"
        )
