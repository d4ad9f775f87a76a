"""Tells whether somebody takes what goes to this node's workers: how a worker is seen that shows no token.

Knows: what zenoh matches with the keys under this node's slots. Does not know: processes, what follows from it.

It is this node's own relay that looks, under the keys of every robot: robots only ever publish there, so a subscriber
that takes something is the worker, and a node that owns nothing yet is seen to be ready, too. What zenoh does not tell
is who matches. A subscription that would take any other node's inputs as well (a recorder of ``**``) hides the worker:
so each rule has a stranger's key beside its own, and as long as somebody subscribes to that as well nothing is certain.
"""

from __future__ import annotations

import itertools
import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, Final

import zenoh
from zenoh import Locality, Session

from zsched.core.values.model import TaskId
from zsched.core.values.relay_protocol import WorkerMatched, WorkerWatch
from zsched.core.values.struct import Struct, field
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, tolerant
from zsched.link.sessions.matching import is_matched
from zsched.relay.streams.receive import Declared, undeclare

SETTLE_S: Final = 1.5
"""A relay that has just started has no links yet: for this long it does not say that nobody is there."""

_log = logging.getLogger("zsched.relay")


class _Watched(Struct, eq=False):
    """One task's probes. ``inputs`` are publishers, ``strangers`` too, ``services`` queriers of one rule each."""

    watch: WorkerWatch
    settled_at: float
    inputs: list[zenoh.Publisher] = field(default_factory=list)
    strangers: list[zenoh.Publisher] = field(default_factory=list)
    services: list[list[zenoh.Querier]] = field(default_factory=list)
    told: WorkerMatched | None = None

    def look(self) -> WorkerMatched:
        """What zenoh says now."""
        untaken = next((str(probe.key_expr) for probe in self.inputs if not is_matched(probe)), "")
        unserved = next((str(one[0].key_expr) for one in self.services if not any(map(is_matched, one))), "")
        return WorkerMatched(
            task=self.watch.task,
            is_matched=not untaken and not unserved,
            is_certain=bool(self.inputs or self.services) and not any(map(is_matched, self.strangers)),
            missing=f"nobody subscribes to {untaken}" if untaken else unserved and f"nobody answers {unserved}",
        )

    def close(self) -> None:
        """Take every probe back."""
        probes: list[Declared] = [*self.inputs, *self.strangers, *itertools.chain(*self.services)]
        for probe in probes:
            undeclare(probe)


class Matching:
    """The workers of one node that are watched. Every method may be called from any thread; none blocks."""

    def __init__(self, session: Session, report: Callable[[WorkerMatched], None]) -> None:
        """Nothing is declared, and no thread runs, before the first `watch`."""
        self._session = session
        self._report = report
        self._queue: queue.SimpleQueue[WorkerWatch | TaskId | Session | None] = queue.SimpleQueue()
        self._watched: dict[TaskId, _Watched] = {}
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def watch(self, watch: WorkerWatch) -> None:
        """Watch a task's worker from now on; asked again, say again what is seen."""
        with self._lock:
            if self._thread is None:
                thread = guarded(self._run, name="matching")
                thread.start()
                self._thread = thread
        self._queue.put(watch)

    def forget(self, task: TaskId) -> None:
        """Watch a task's worker no more."""
        with self._lock:
            if self._thread is not None:
                self._queue.put(task)

    def rejoin(self, session: Session) -> None:
        """Watch on another session, by the watches that come from now on; the one before is closed."""
        with self._lock:
            if self._thread is None:
                self._session = session
            else:
                self._queue.put(session)

    def _wake(self, _status: Any) -> None:
        """Something matches, or does not any more (zenoh's thread: it must only enqueue)."""
        self._queue.put(None)

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            try:
                watch = self._queue.get(timeout=self._wait_s())
            except queue.Empty:
                watch = None
            try:
                if isinstance(watch, Session):
                    self._session = watch
                    self._watched.clear()
                elif isinstance(watch, WorkerWatch):
                    self._take(watch)
                elif watch is not None and (known := self._watched.pop(watch, None)) is not None:
                    known.close()
                self._look()
            except Exception:  # noqa: BLE001 - a probe that zenoh refuses must not end the watch
                _log.exception("workers cannot be watched")

    def _wait_s(self) -> float | None:
        """Until the next one has settled; without end once all have: zenoh wakes us."""
        now = monotonic_s()
        waiting = [one.settled_at - now for one in self._watched.values() if one.told is None]
        return max(min(waiting), 0.0) if waiting else None

    def _take(self, watch: WorkerWatch) -> None:
        known = self._watched.get(watch.task)
        if known is not None and known.watch == watch:
            known.told = None
            return
        if known is not None:
            del self._watched[watch.task]
            known.close()
        made = _Watched(watch=watch, settled_at=monotonic_s() + SETTLE_S)
        made.inputs += [self._probe(key) for key in watch.inputs]
        made.strangers += [self._probe(key) for key in watch.strangers]
        made.services += [[self._asker(key) for key in keys] for keys in watch.services]
        self._watched[watch.task] = made

    def _probe(self, key: str) -> zenoh.Publisher:
        probe = self._session.declare_publisher(key, allowed_destination=Locality.REMOTE)
        probe.declare_matching_listener(tolerant(self._wake, "matching"))
        return probe

    def _asker(self, key: str) -> zenoh.Querier:
        asker = self._session.declare_querier(key, allowed_destination=Locality.REMOTE)
        asker.declare_matching_listener(tolerant(self._wake, "matching"))
        return asker

    def _look(self) -> None:
        now = monotonic_s()
        for one in self._watched.values():
            seen = one.look()
            if seen == one.told or (one.told is None and not seen.is_matched and now < one.settled_at):
                continue
            one.told = seen
            self._report(seen)
