"""Runs a `Merger` on messages: takes map bytes, merges at a bounded rate, hands out map, transforms and status.

Knows: the three outputs and their bytes, counters, ages. Does not know: zenoh or processes; bytes come in and go out
through plain calls, so that the whole service runs in a test.

Threads: `receive` and `snapshot` may be called from any thread, `step` from one only. `receive` decodes and keeps the
newest map per robot; merging is in `step`, so a slow merge never delays an input, and a bad message costs nothing but a
counter. A search runs in a thread of its own, one at a time, so that merged maps keep coming.
"""

from __future__ import annotations

import contextlib
import json
import logging
import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import Any, Protocol

from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import NAME
from zsched.host.clock import wall_ns
from zsched.host.guard import guarded
from zsched.tasks.map_merge.cdr import (
    MAX_STAMP_NS,
    CdrError,
    StampedTransform,
    decode_grid,
    encode_grid,
    encode_transforms,
)
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import MAX_ROBOTS, Merger, MergeResult, MergerSettings, RobotStatus
from zsched.tasks.map_merge.pairs import SearchJob
from zsched.tasks.map_merge.search import Estimate

STATUS_SCHEMA = "zsched.map_merge.status/1"
REFERENCE_GRACE_S = 0.3
"""How long the first merge waits for more maps when it has to choose the reference robot.

A new owner gets all kept maps within milliseconds; the one that happens to be first must not decide the world frame.
"""
FRESH_GRACE_S = 0.3
"""How long an owner that comes back waits for a map of every robot it knew.

It holds maps of its former tenure; merged with the first new ones they would show the robots the past for a moment.
"""
STATUS_PERIOD_S = 1.0
"""Status at least this often while active: the ages in it go on."""
_LOG = logging.getLogger("zsched.tasks.map_merge")


class Output(StrEnum):
    """What the task publishes; the value is the key's last chunk."""

    GLOBAL_MAP = "global_map"
    TF = "tf"
    STATUS = "status"


def _in_thread(work: Callable[[], None]) -> None:
    guarded(work, name="map search", is_lasting=False).start()  # daemon: it must not delay the exit


def _outcome(job: SearchJob) -> Estimate | None:
    try:
        return job.run()
    except Exception:  # noqa: BLE001 - a pair of maps that trips a bug is a pair that is not aligned
        _LOG.exception("search_failed pair=%s", job.pair)
        return None


def _untold(_skipped: int) -> AbstractContextManager[object]:
    return contextlib.nullcontext()


class Publish(Protocol):
    """Sends one message of an output; whether it went out (an idle worker's does not)."""

    def __call__(self, output: Output, payload: bytes, attachment: bytes | None = None) -> bool:
        """Send ``payload``."""


class _Input(Struct):
    """What came in for one robot."""

    maps: int = 0
    bad: int = 0
    last_error: str | None = None
    """Why the newest of its messages, or its map, was not taken."""
    received_s: float | None = None
    """When the newest map came."""
    taken_s: float | None = None
    """When the map came that is merged."""


class MapMergeService:
    """The task without its transport. ``rate_hz`` bounds merges; ``clock`` gives monotonic seconds.

    Every merge is a ``job``, told how many could have been made since it was due.
    """

    def __init__(
        self,
        settings: MergerSettings,
        publish: Publish,
        *,
        clock: Callable[[], float],
        rate_hz: float = 4.0,
        job: Callable[[int], AbstractContextManager[object]] = _untold,
        spawn: Callable[[Callable[[], None]], None] = _in_thread,
        wall_clock: Callable[[], int] = wall_ns,
    ) -> None:
        self._settings = settings
        self._publish = publish
        self._clock = clock
        self._period_s = 1.0 / rate_hz
        self._job = job
        self._spawn = spawn
        self._wall_clock = wall_clock
        self._merger = Merger(settings, searches_itself=False)
        self._found: queue.SimpleQueue[tuple[SearchJob, Estimate | None]] = queue.SimpleQueue()
        self._is_searching = False
        self._first_map_s: float | None = None
        self._lock = threading.Lock()
        self._pending: dict[str, Grid | None] = {}
        self._inputs: dict[str, _Input] = {}
        self._snapshot = self._merger.snapshot()
        self._strangers = 0
        self._is_due = False
        self._was_active = False
        self._active_s = float("-inf")
        self._stale: set[str] = set()
        self._result: MergeResult | None = None
        self._merges = 0
        self._merge_ms: float | None = None
        self._next_merge_s = float("-inf")
        self._due_s = float("-inf")
        """Since when something waits to be merged."""
        self._next_status_s = float("-inf")

    # --- any thread ---------------------------------------------------------------------------------------------------

    def receive(self, robot: str, payload: bytes, *, is_deleted: bool = False) -> None:
        """Take one map message of a robot, or the word that its stream was deleted. Never raises for bad bytes."""
        with self._lock:
            if robot not in self._inputs and (NAME.fullmatch(robot) is None or len(self._inputs) >= MAX_ROBOTS):
                self._strangers += 1
                return
            book = self._inputs.setdefault(robot, _Input())
        if is_deleted:
            self._keep(robot, None)
            return
        try:
            grid = decode_grid(payload)
        except CdrError as error:
            with self._lock:
                book.bad += 1
                book.last_error = str(error)
                self._next_status_s = float("-inf")
            return
        with self._lock:
            book.maps += 1
            book.received_s = self._clock()
            if self._first_map_s is None:
                self._first_map_s = book.received_s
        self._keep(robot, grid)

    @property
    def is_searching(self) -> bool:
        """Whether a search runs, or its outcome waits to be taken in."""
        return self._is_searching

    def snapshot(self) -> bytes:
        """The transforms as of the newest merge, for the next owner."""
        return self._snapshot

    def merge_now(self) -> bytes:
        """Merge as soon as may be, whether anything has changed or not; answers with the status as of now."""
        with self._lock:
            self._make_due()
            self._next_merge_s = float("-inf")
        return json.dumps(self.status()).encode()

    def _make_due(self) -> None:
        if not self._is_due:
            self._is_due, self._due_s = True, self._clock()

    def _keep(self, robot: str, grid: Grid | None) -> None:
        with self._lock:
            self._pending[robot] = grid
            self._stale.discard(robot)
            self._make_due()

    # --- one thread ---------------------------------------------------------------------------------------------------

    def restore(self, snapshot: bytes) -> None:
        """Take over the transforms of the previous owner; one that does not fit is logged and left."""
        refusal = self._merger.restore(snapshot)
        if refusal:
            _LOG.warning("snapshot_refused reason=%r", refusal)
            return
        self._snapshot = self._merger.snapshot()
        _LOG.info("snapshot_restored bytes=%d", len(snapshot))

    def step(self, *, is_active: bool) -> bool:
        """Merge and publish if something changed and the rate allows it; returns whether it merged.

        While idle, maps are only kept; the first step as owner merges what there is, at once.
        """
        now = self._clock()
        if is_active and not self._was_active:
            self._make_due()
            self._active_s = now
            self._next_merge_s = self._next_status_s = float("-inf")
        elif self._was_active and not is_active:
            with self._lock:
                self._stale = set(self._inputs)
        self._was_active = is_active
        if not is_active:
            return False
        self._take_found()
        awaits = self._awaits_reference(now) or self._awaits_fresh_maps(now)
        if self._is_due and now >= self._next_merge_s and not awaits:
            skipped = int(max(now - max(self._next_merge_s, self._due_s, self._active_s), 0.0) / self._period_s)
            self._next_merge_s = now + self._period_s
            with self._job(skipped):
                self._merge()
            return True
        if now >= self._next_status_s:
            self._publish_status()
        return False

    def _awaits_reference(self, now: float) -> bool:
        first_s = self._first_map_s
        return self._merger.needs_reference and first_s is not None and now < first_s + REFERENCE_GRACE_S

    def _awaits_fresh_maps(self, now: float) -> bool:
        with self._lock:
            if now >= self._active_s + FRESH_GRACE_S:
                self._stale.clear()  # a robot that has sent nothing since then is merged as it was last seen
            return bool(self._stale)

    def _merge(self) -> None:
        with self._lock:
            pending, self._pending, self._is_due = self._pending, {}, False
        started_s = self._clock()
        try:
            result = self._merged(pending)
        except Exception:  # noqa: BLE001 - a map that trips a bug must not stop the others' merge on owner after owner
            _LOG.exception("merge_failed left_out=%s", sorted(pending))
            self._leave_out(pending)
            return
        self._merge_ms = 1e3 * (self._clock() - started_s)
        self._merges += 1
        self._log_changes(result)
        if result.grid is not None:
            result = replace(result, grid=replace(result.grid, stamp_ns=self._stamp_ns(result.inputs)))
        self._result, self._snapshot = result, self._merger.snapshot()
        self._publish_result(result)
        self._search()

    def _stamp_ns(self, inputs: Mapping[str, int]) -> int:
        """When the newest map was made: the middle one of what the robots' clocks say, which no wrong one moves.

        Each clock is read by its robot's own map and how long that has been here. Of an even number of clocks the
        middle is found with this machine's.
        """
        taken = {robot: self._inputs[robot].taken_s or 0.0 for robot in inputs}
        newest_s = max(taken.values())
        told = [stamp_ns + round((newest_s - taken[robot]) * 1e9) for robot, stamp_ns in inputs.items()]
        if len(told) % 2 == 0:
            told.append(self._wall_clock())
        return min(sorted(told)[len(told) // 2], MAX_STAMP_NS)

    def _merged(self, pending: Mapping[str, Grid | None]) -> MergeResult:
        for robot, grid in pending.items():
            if grid is None:
                self._merger.remove(robot)
            else:
                book = self._inputs[robot]
                book.last_error = self._merger.update(robot, grid) or None
                book.taken_s = book.taken_s if book.last_error else book.received_s
        return self._merger.merge()

    def _leave_out(self, pending: Mapping[str, Grid | None]) -> None:
        with self._lock:
            for robot in pending:
                self._merger.remove(robot)
                self._inputs[robot].bad += 1
                self._inputs[robot].last_error = "a merge failed with its map (see the worker's log)"
            if pending:
                self._make_due()

    def _search(self) -> None:
        """Start the search that is due, unless one runs: a search takes up to a second, and maps go on meanwhile."""
        job = None if self._is_searching else self._merger.next_search()
        if job is None:
            return
        self._is_searching = True
        self._spawn(lambda: self._found.put((job, _outcome(job))))

    def _take_found(self) -> None:
        while not self._found.empty():
            self._merger.finish_search(*self._found.get())
            self._is_searching = False
            with self._lock:
                self._make_due()

    def _publish_result(self, result: MergeResult) -> None:
        attachment = json.dumps({"merge": self._merges, "inputs": dict(result.inputs)}).encode()
        if result.grid is not None:
            self._publish(Output.GLOBAL_MAP, encode_grid(result.grid), attachment)
            self._publish(Output.TF, encode_transforms(_transforms(result, self._settings.world_frame)), attachment)
        self._publish_status()

    def _publish_status(self) -> None:
        self._next_status_s = self._clock() + STATUS_PERIOD_S
        self._publish(Output.STATUS, json.dumps(self.status()).encode())

    def status(self) -> dict[str, Any]:
        """What the status stream carries (docs/guide/map_merge.md lists the fields)."""
        result = self._result
        statuses = {} if result is None else {status.robot: status for status in result.statuses}
        grid = None if result is None else result.grid
        now = self._clock()
        with self._lock:
            robots = {
                robot: _robot_fields(statuses.get(robot), self._inputs.get(robot, _Input()), result, now)
                for robot in sorted({*statuses, *self._inputs})
            }
        return {
            "schema": STATUS_SCHEMA,
            "mode": self._settings.mode.value,
            "merges": self._merges,
            "revision": 0 if result is None else result.revision,
            "reference": None if result is None else result.reference,
            "is_searching": self._is_searching,
            "merge_ms": None if self._merge_ms is None else round(self._merge_ms, 2),
            "map": None if grid is None else _map_fields(grid),
            "strangers": self._strangers,
            "robots": robots,
        }

    def _log_changes(self, result: MergeResult) -> None:
        before = {} if self._result is None else {status.robot: status.state for status in self._result.statuses}
        for status in result.statuses:
            if before.get(status.robot) is not status.state:
                _LOG.info(
                    "robot_%s robot=%s score=%s agreeing=%s overlap=%s margin=%s reason=%r",
                    status.state.value,
                    status.robot,
                    _rounded(status.score),
                    status.agreeing,
                    _rounded(status.overlap),
                    _rounded(status.margin),
                    status.reason,
                )


def _transforms(result: MergeResult, world_frame: str) -> tuple[StampedTransform, ...]:
    return tuple(
        StampedTransform(parent=world_frame, child=result.frames[robot], pose=pose, stamp_ns=result.inputs[robot])
        for robot, pose in result.transforms.items()
    )


def _robot_fields(status: RobotStatus | None, book: _Input, result: MergeResult | None, now: float) -> dict[str, Any]:
    pose = None if result is None or status is None else result.transforms.get(status.robot)
    return {
        "state": "waiting" if status is None else status.state.value,
        "reason": "not merged yet" if status is None else status.reason,
        "with": None if status is None else status.partner,
        "score": None if status is None else _rounded(status.score),
        "agreeing": None if status is None else status.agreeing,
        "overlap": None if status is None else _rounded(status.overlap),
        "margin": None if status is None else _rounded(status.margin),
        "pose": None if pose is None else _pose_fields(pose),
        "frame": None if result is None or status is None else result.frames.get(status.robot),
        "map_age_s": None if book.taken_s is None else round(now - book.taken_s, 3),
        "maps": book.maps,
        "bad": book.bad,
        "last_error": book.last_error,
    }


def _map_fields(grid: Grid) -> Mapping[str, Any]:
    return {"width": grid.width, "height": grid.height, "resolution": grid.resolution, "stamp_ns": grid.stamp_ns}


def _pose_fields(pose: Pose2) -> Mapping[str, float]:
    return {"x": round(pose.x, 4), "y": round(pose.y, 4), "yaw": round(pose.yaw, 5)}


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
