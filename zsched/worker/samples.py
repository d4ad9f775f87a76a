"""What waits in a worker: its inputs, their samples, what its callbacks are given.

Knows: how many may wait, what is lost when one gives way. Does not know: threads, numbers, epochs' ends.

Class ``reliable`` is known by its start marker (`EndMarker.is_whole`): of such a source everything is wanted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Final, Literal

import zenoh

from zsched.core.hop.receiver import SourceName
from zsched.core.values.relay_protocol import EndMarker
from zsched.core.values.struct import Struct, field
from zsched.worker.backlog import Done

BY_CLASS: Final = "by_class"
"""``keep_last`` where the worker's author names none: of a source of class ``reliable`` all samples wait, of any other
one the newest."""
Line = SourceName | str
"""Whose newest samples are kept: a publisher's of a key (its relay sends what each of several put by another one), or
all of those of a key that give no numbers."""
KeepLast = int | Literal["by_class"] | None


class Received(Struct, frozen=True, kw_only=True):
    """One input sample. ``payload`` and ``attachment`` are zenoh's own bytes (``to_bytes()`` copies)."""

    key: str
    payload: zenoh.ZBytes
    attachment: zenoh.ZBytes | None = None
    encoding: str = ""
    deleted: bool = False
    replayed: bool = False
    """An owner that died may have had this sample, too, and have done it (`on_crash: replay`)."""


class Marker(Struct, frozen=True, kw_only=True):
    """An end marker and the source it ends."""

    name: SourceName
    end: EndMarker
    came_at: float


class Input(Struct, eq=False):
    """One subscription: where its samples go, how many may wait."""

    on_sample: Callable[[Received], None]
    keep_last: KeepLast = BY_CLASS
    depth: int = 4096
    waiting: dict[Line, deque[Waiting]] = field(default_factory=dict)
    """{line of which something waits: its samples, the oldest first}."""
    shed: int = 0
    """Samples that gave way to newer ones."""

    def __post_init__(self) -> None:
        is_count = not isinstance(self.keep_last, str) and (self.keep_last is None or self.keep_last >= 1)
        if self.keep_last != BY_CLASS and not is_count:
            raise ValueError(f"keep_last: {self.keep_last!r} is neither None, {BY_CLASS!r} nor 1 or more")
        if self.depth < 1:
            raise ValueError(f"depth: {self.depth!r} is not 1 or more")

    def newest(self, *, is_whole: bool) -> int | None:
        """How many samples of a key may wait, ``None``: all; ``is_whole``: their source is of class ``reliable``."""
        if isinstance(self.keep_last, str):
            return None if is_whole else 1
        return self.keep_last

    def take_out(self, one: Waiting) -> None:
        """A sample waits no more; a wildcard input hears any number of keys, so none stays of which nothing waits."""
        line = self.waiting[one.line]
        line.remove(one)
        if not line:
            del self.waiting[one.line]

    def wants(self, *, is_whole: bool) -> bool:
        """Whether a sample that gives way to a newer one is lost."""
        return is_whole or self.keep_last is None


class Waiting(Struct, eq=False):
    """A sample in the queue; ``None`` once a newer one has taken its place."""

    source: Input
    sample: zenoh.Sample | None
    line: Line = ""
    name: SourceName | None = None
    number: int = 0
    replayed: bool = False
    is_whole: bool = False
    """Its source is of class ``reliable``: given up, it is lost."""
    came_s: float = 0.0
    """When it came, by ``time.monotonic``."""
    again: Done[Input] | None = None
    """It is processed again: this is what it was the first time."""

    @property
    def is_wanted(self) -> bool:
        """Whether it is lost when it gives way to a newer one."""
        return self.source.wants(is_whole=self.is_whole)


class OpenSource(Struct):
    """A source that has sent something: its newest number, and its epoch.

    That is the one its start marker names, else the one it was first heard in (0: standby).
    """

    epoch: int
    number: int = -1
    in_turn: bool = False
    """Its publisher sends again what is missing: worth waiting for."""
