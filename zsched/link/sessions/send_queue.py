"""A bounded queue and a thread in front of a put that may block: only its own receiver's slowness is felt here.

Knows: order, bounds, which sample gives way to a newer one. Does not know: zenoh, keys, what a sample is.

Every stream that may wait for its receiver (classes ``latest`` and ``reliable``) has one per place it goes to. With
``sheds`` the oldest samples of a lane give way: beyond ``depth``, or, once a put has blocked for `STALL_S`, beyond
``keep_last``. Without it a full queue refuses the newest; a caller may `wait_for_room` before, as long as the
receiver takes something now and then. What gave way was never numbered, so receivers see no gap.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, Final

from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

MAX_BYTES: Final = 64 << 20
STALL_S: Final = 0.1
"""A put that takes this long means a stalled receiver or a slow radio: from then on only the newest samples wait."""
NO_ROOM_S: Final = 0.25
"""A receiver that takes nothing for this long is stalled, not slow: nobody waits for it."""
POLL_S: Final = 0.05
JOIN_S: Final = 0.3
MAX_DEAD: Final = 1024
"""So many entries that gave way keep their place in the queue; when more than half are such, they are taken out."""

_log = logging.getLogger("zsched.streams")

Action = Callable[[], None]


class _Waiting(Struct, eq=False):
    """One entry; ``action`` is ``None`` once a newer one has taken its place."""

    lane: Hashable
    action: Action | None
    size: int
    value: Any = None


class SendQueue:
    """Runs actions one after the other in a thread of its own; every method may be called from any thread."""

    def __init__(
        self,
        name: str,
        *,
        depth: int,
        sheds: bool,
        keep_last: int = 1,
        is_open: Callable[[], bool] | None = None,
        at_kick: Action | None = None,
    ) -> None:
        """Start the thread.

        ``is_open`` is asked before each sample: while it answers false, samples wait (markers too, they keep their
        place). ``at_kick`` runs in the thread after a `kick`.
        """
        self._depth = depth
        self._sheds = sheds
        self._keep_last = max(1, keep_last)
        self._is_open = is_open or _always
        self._at_kick = at_kick
        self._lock = threading.Lock()
        self._room = threading.Condition(self._lock)
        # A bell of its own: a condition wakes its waiter while the lock is still held, to wait once more for that.
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._wants_item = False
        self._wants_kick = False
        self._items: deque[_Waiting] = deque()
        self._dead = 0
        """Of `_items`, those that gave way."""
        self._lines: dict[Hashable, deque[_Waiting]] = {}
        self._count = 0
        self._bytes = 0
        self._has_shed = False
        self._left_at = 0.0
        self._is_kicked = False
        self._is_closed = False
        self._at_end: Action | None = None
        self._busy_since: float | None = None
        self._in_hand: Any = None
        self._is_taken = False
        """An action is being done, or about to be."""
        self._thread = guarded(self._run, name=name, kind="queue")
        self._thread.start()

    @property
    def is_stalled(self) -> bool:
        """True while a put has been blocked for `STALL_S`."""
        since = self._busy_since
        return since is not None and monotonic_s() - since > STALL_S

    @property
    def is_busy(self) -> bool:
        """True while a put is under way."""
        return self._busy_since is not None

    @property
    def is_empty(self) -> bool:
        """True when nothing waits and nothing is being done."""
        with self._lock:
            return not self._items and not self._is_taken

    @property
    def in_hand(self) -> Any:
        """The value of the sample whose action is about to begin, or has not ended."""
        return self._in_hand

    @property
    def is_pressed(self) -> bool:
        """True while samples are about to be dropped, or (``sheds``) have been since the queue was last empty."""
        if self._sheds:
            return self._has_shed
        return self._count > self._depth // 8 or self._bytes > MAX_BYTES // 2

    def send(self, lane: Hashable, action: Action, size: int, value: Any = None) -> int:
        """Queue a sample of ``size`` bytes; answers how many samples were dropped for it (itself: 1).

        ``value`` is what `take_back` gives back while ``action`` has not begun.
        """
        with self._lock:
            if self._is_closed:
                return 1
            if not self._sheds and self._is_full(size):
                return 1
            if not self._items:
                self._left_at = monotonic_s()  # it is only now asked to take something
            waiting = _Waiting(lane, action, size, value)
            self._items.append(waiting)
            self._count += 1
            self._bytes += size
            dropped = self._shed(waiting) if self._sheds else 0
            is_awaited, self._wants_item = self._wants_item, False
        if is_awaited:
            self._bell.put(None)
        return dropped

    def has_room(self, size: int) -> bool:
        """True when a sample of ``size`` bytes would be taken now."""
        return not self._is_full(size)

    def wait_for_room(self, size: int) -> bool:
        """Wait until a sample of ``size`` bytes would be taken; ``False`` as soon as the receiver is stalled."""
        with self._room:
            while self._is_full(size) and not self._is_closed:
                rest = NO_ROOM_S - (monotonic_s() - self._left_at)
                if rest <= 0:
                    return False
                self._room.wait(rest)
        return True

    def then(self, action: Action) -> None:
        """Run ``action`` behind everything that waits now; it is never dropped but by `close`."""
        with self._lock:
            self._items.append(_Waiting(None, action, 0))
        self._ring()

    def take_back(self) -> list[Any]:
        """The values of the samples that have not gone out, in order; they will not any more. Markers stay."""
        with self._lock:
            taken = [waiting for waiting in self._items if waiting.lane is not None and waiting.action is not None]
            self._items = deque(waiting for waiting in self._items if waiting.lane is None)
            self._dead = 0
            self._lines.clear()
            for waiting in taken:
                self._forget(waiting)
            self._room.notify_all()
            return [waiting.value for waiting in taken]

    def kick(self) -> None:
        """Run ``at_kick``, and look at ``is_open`` again."""
        self._is_kicked = True
        self._ring()

    def close(self, at_end: Action | None = None) -> int:
        """End the thread behind what it has in hand, ``at_end`` last; answers how many samples still waited."""
        with self._lock:
            self._is_closed = True
            self._at_end = at_end
            self._room.notify_all()
            left = self._count
        self._ring()
        return left

    def join(self, timeout_s: float = JOIN_S) -> None:
        """Wait at most this long for the thread's end."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)

    # --- the thread --------------------------------------------------------------------------------------------------

    def _shed(self, newest: _Waiting) -> int:
        line = self._lines.setdefault(newest.lane, deque())
        line.append(newest)
        limit = self._keep_last if self.is_stalled else max(self._depth, self._keep_last)
        dropped = 0
        while len(line) > limit or (self._bytes > MAX_BYTES and len(line) > 1):
            old = line.popleft()
            old.action = old.value = None
            self._forget(old)
            dropped += 1
        self._dead += dropped
        if self._dead > max(MAX_DEAD, len(self._items) // 2):
            self._items = deque(waiting for waiting in self._items if waiting.action is not None)
            self._dead = 0
        self._has_shed |= dropped > 0
        return dropped

    def _is_full(self, size: int) -> bool:
        """A sample that is larger than `MAX_BYTES` goes alone."""
        return self._count >= self._depth or (self._count > 0 and self._bytes + size > MAX_BYTES)

    def _forget(self, waiting: _Waiting) -> None:
        self._count -= 1
        self._bytes -= waiting.size

    def _run(self) -> None:
        while True:
            action = self._next()
            if action is None:
                break
            self._do(action)
            self._in_hand = None
            self._is_taken = False
        if self._at_end is not None:
            self._do(self._at_end)

    def _next(self) -> Action | None:
        """The next action, waiting for one; ``None`` once closed."""
        while not self._is_closed:
            if self._is_kicked:
                self._kicked()
            is_shut = bool(self._items) and not self._is_open()
            if self._items and not is_shut:
                action = self._take()
                if action is not None:
                    return action
            else:
                self._sleep(is_shut=is_shut)
        return None

    def _kicked(self) -> None:
        with self._lock:
            self._is_kicked = False
            self._is_taken = True
        if self._at_kick is not None:
            self._do(self._at_kick)
        self._is_taken = False

    def _sleep(self, *, is_shut: bool) -> None:
        """Until something comes (`POLL_S` at most while shut), a kick or the end."""
        with self._lock:
            if self._is_closed or self._is_kicked or (self._items and not is_shut):
                return
            self._wants_item, self._wants_kick = not is_shut, True
        with contextlib.suppress(queue.Empty):
            self._bell.get(timeout=POLL_S if is_shut else None)
        self._wants_item = self._wants_kick = False

    def _ring(self) -> None:
        with self._lock:
            is_awaited = self._wants_item or self._wants_kick
            self._wants_item = self._wants_kick = False
        if is_awaited:
            self._bell.put(None)

    def _take(self) -> Action | None:
        with self._lock:
            if self._is_closed or not self._items:  # taken back
                return None
            waiting = self._items.popleft()
            self._is_taken = waiting.action is not None
            if waiting.action is None:
                self._dead -= 1
            if waiting.action is None or waiting.lane is None:
                return waiting.action
            self._forget(waiting)
            self._in_hand, self._left_at = waiting.value, monotonic_s()
            self._room.notify()
            if self._sheds:
                line = self._lines[waiting.lane]
                line.popleft()
                if not line:
                    del self._lines[waiting.lane]  # lanes may be any number of keys
                self._has_shed &= self._count > 0
            return waiting.action

    def _do(self, action: Action) -> None:
        self._busy_since = monotonic_s()
        try:
            action()
        except BaseException as error:  # one bad sample must not end its stream
            is_ours = threading.current_thread() is self._thread
            if not is_ours and not isinstance(error, Exception):
                raise  # it ends a program's own thread, as Ctrl-C does
            _log.warning("%s: %s", self._thread.name, error)
        finally:
            self._busy_since = None


def _always() -> bool:
    return True
