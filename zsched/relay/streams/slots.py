"""What an output stream knows of each of its slots: the subscription, the keys, the samples that wait, the ends.

Knows: end markers, how long what is missing before one may take. Does not know: gates, who feeds a slot.

Anybody can put an end marker. One that says less than its publisher has put is none, nor is one of a publisher that is
not heard while another one is; and one ends nothing any more when something comes from behind it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Final

from zenoh import Sample

from zsched.core.hop.receiver import Jump, SourceName
from zsched.core.hop.serial import number_near, serial_of
from zsched.core.relay_protocol import EndMarker
from zsched.core.route import keyexpr
from zsched.relay.streams.answers import Answers
from zsched.relay.streams.receive import Receiver

END_GRACE_S: Final = 0.1
"""A marker travels behind its data on one link; so long after it, what is still missing was dropped on the way."""
QUIET_S: Final = 1.0
"""Who has put nothing here may end what others put when nothing has come for so long: a worker that was restarted."""


@dataclass(slots=True)
class KeyState:
    """What came on one concrete key of a slot, and what its end marker said."""

    received: int = 0
    heard_at: float = 0.0
    end: EndMarker | None = None
    end_at: float = 0.0
    end_of: tuple[str, int] | None = None
    """The publisher whose end it is."""
    ender: SourceName | None = None
    """The publisher whose end it is, where it keeps what we have not acknowledged."""
    last_number: int = -1
    numbers: dict[tuple[str, int], int] = field(default_factory=dict)
    """{publisher: its newest number}; a worker that restarted in place is another publisher."""
    jumps: dict[tuple[str, int], Jump] = field(default_factory=dict)
    """{publisher: the newest jump in its numbers}."""

    def take_end(self, marker: EndMarker, publisher: tuple[str, int], now: float) -> bool:
        """An end marker of a publisher came; ``False``: it is none."""
        if self.numbers and publisher not in self.numbers and now - self.heard_at < QUIET_S:
            return False
        count = number_near(serial_of(marker.count), self.last_number + 1)
        jump = self.jumps.get(publisher)
        newest = self.numbers.get(publisher, -1)
        if jump is not None and jump.to == newest:  # nothing has followed it: it may be a stranger's
            newest = jump.at - 1
        if count <= newest:
            return False
        if self.end is None or (self.end.count, self.end_of) != (count, publisher):
            self.end, self.end_at, self.end_of = replace(marker, count=count), now, publisher
        return True

    def is_past_end(self, publisher: tuple[str, int]) -> bool:
        """Whether the newest sample, ``publisher``'s, came from behind its end."""
        return self.end is not None and self.end_of == publisher and self.last_number >= self.end.count

    def reopen(self) -> None:
        """What came as its end was none."""
        self.end = self.end_of = self.ender = None

    def is_ended(self, now: float, answers: Answers | None) -> bool:
        """True when everything up to the end marker has come, or will not come any more."""
        if self.end is None:
            return False
        is_known = self.end_of in self.numbers or not self.numbers or not self.end.count
        has_come = self.received >= self.end.count or self.last_number + 1 >= self.end.count
        is_complete = is_known and has_come
        if is_complete or now - self.end_at <= END_GRACE_S:
            return is_complete
        return answers is None or self.ender is None or not answers.ask_for(self.ender, self.end.count)

    def missing(self, answers: Answers | None) -> int:
        """How many samples before the end marker have not come."""
        if self.end is None:
            return 0
        if answers is not None and self.ender is not None:
            return answers.missing(self.ender, self.end.count)
        return max(0, self.end.count - self.last_number - 1) if self.last_number >= 0 else 0


@dataclass(slots=True, eq=False)
class Feed:
    """A subscription to an owner's output and the slot it feeds."""

    slot: OutputSlot
    receiver: Receiver | None = None
    again: Receiver | None = None
    """What our relay alone is sent once more."""

    def close(self) -> None:
        """Unsubscribe."""
        for receiver in (self.receiver, self.again):
            if receiver is not None:
                receiver.close()


@dataclass(slots=True, eq=False)
class OutputSlot:
    """One owner's epoch: what feeds it, what waits in it, how far its handover is."""

    epoch: int
    expr: str
    answers: Answers | None = None
    """``None``: its worker keeps nothing for us (a foreign one)."""
    feed: Feed | None = None
    """``None`` while an older slot of the same owner and key has the subscription."""
    keys: dict[str, KeyState] = field(default_factory=dict)
    held: deque[Sample] = field(default_factory=deque)
    held_bytes: int = 0
    is_flipped: bool = False
    is_closed: bool = False

    def missing(self) -> int:
        """How many samples its owner has put out that did not come (as far as it has said how many there are)."""
        return sum(key.missing(self.answers) for key in self.keys.values())

    def key(self, name: str) -> KeyState | None:
        """What has come on a concrete key; ``None`` when it is none of this slot's."""
        state = self.keys.get(name)
        if state is None and keyexpr.intersects(self.expr, name):
            state = self.keys[name] = KeyState()
        return state
