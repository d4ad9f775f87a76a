"""Which inputs are held back until their answers have reached the receivers, and in which order they are done then.

Knows: the answers that each input owes, the order of each source. Does not know: how far a receiver is (it asks
`zsched.core.hop.shared`), threads, what an acknowledgement says.

What is processed is told by one number per source, so an input that comes behind one that is held waits with it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from zsched.core.hop.receiver import MAX_SOURCES, SourceName
from zsched.core.values.struct import Struct, field

MAX_HELD: Final = 4096
"""Inputs of a source that are held one by one (a relay sends at most 2048 ahead); further ones share the last place."""


class Lane(Protocol):
    """Where answers go: `zsched.core.hop.shared.SharedSender`, or what guards one."""

    def settled(self, name: str, now: float, /) -> int:
        """The answers below this number have reached everybody for whom an input of receiver ``name`` waits."""
        ...


L = TypeVar("L", bound=Lane)


class Done(NamedTuple):
    """An input that is done, and all before it."""

    name: SourceName
    number: int
    size: int
    """Bytes of all that were held with it."""


class Held(Struct, Generic[L], eq=False):
    """Inputs of a source that are held; ``owed``: {lane: what lies below this number must be there}."""

    number: int = 0
    """The newest of them."""
    size: int = 0
    owed: dict[L, int] = field(default_factory=dict)
    unanswered: int = 0
    """How many of them are to be processed again: what they were answered was withheld."""

    def owe(self, owed: Mapping[L, int]) -> None:
        """It is not done without these, too."""
        for lane, number in owed.items():
            self.owed[lane] = max(number, self.owed.get(lane, 0))


class HeldInputs(Generic[L]):
    """The inputs whose answers are on their way, by source."""

    def __init__(self) -> None:
        self.lines: dict[SourceName, deque[Held[L]]] = {}

    def hold(
        self, name: SourceName, number: int, size: int, owed: Mapping[L, int], *, is_unanswered: bool = False
    ) -> Held[L] | None:
        """An input was processed and owes answers; ``None``: it is done at once.

        ``is_unanswered``: an answer was withheld, and more may be owed (`Held.owe`) when it is processed again.
        """
        line = self.lines.get(name)
        if not owed and not is_unanswered and line is None:
            return None
        held = self._place(name, line, is_own=bool(owed) or is_unanswered)
        held.number, held.size = number, held.size + size
        held.unanswered += is_unanswered
        held.owe(owed)
        return held

    def forget(self, name: SourceName) -> None:
        """Nobody waits for this source's inputs any more."""
        self.lines.pop(name, None)

    def _place(self, name: SourceName, line: deque[Held[L]] | None, *, is_own: bool) -> Held[L]:
        """A place of its own at the end of a source's line, or the last one."""
        if line is None:
            if len(self.lines) >= MAX_SOURCES:
                self.lines.pop(next(iter(self.lines)))  # its next sample tells of them
            line = self.lines[name] = deque()
        if not line or (is_own and len(line) < MAX_HELD):
            line.append(Held[L]())
        return line[-1]

    def settle(self, now: float) -> list[Done]:
        """The inputs whose answers are where they should be, in the order of each source."""
        lows: dict[tuple[L, str], int] = {}
        done: list[Done] = []
        for name, line in tuple(self.lines.items()):
            while line and _is_settled(line[0], name[1], lows, now):
                held = line.popleft()
                done.append(Done(name, held.number, held.size))
            if not line:
                del self.lines[name]
        return done


def _is_settled(held: Held[L], relay: str, lows: dict[tuple[L, str], int], now: float) -> bool:
    if held.unanswered:
        return False
    for lane, number in held.owed.items():
        low = lows.get((lane, relay))
        if low is None:
            low = lows[lane, relay] = lane.settled(relay, now)
        if low < number:
            return False
    return True
