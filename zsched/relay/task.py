"""Carries out the route plans of one task: opens, warms up, flips, drains and closes its slots, in its own thread.

Knows: the newest plan, which slots are open and how far they are. Does not know: why the task moves; the executor's
table decides that and how long anything may take (a plan is obeyed even when its worker is not ready).
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from time import sleep
from typing import Final

import zenoh
from zenoh import Session, Timestamp

from zsched.core.values.events import ProblemReported, SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.model import MAX_REASON, NodeId, TaskId
from zsched.core.values.plan import (
    Direction,
    DrainingSlot,
    OnCrash,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamCount,
)
from zsched.core.values.relay_protocol import RelayReport, SlotLost
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.relay.graph import GraphMirror
from zsched.relay.open_streams import OpenStreams
from zsched.relay.orders import Ended, Finish, Leave, Orphaned, Rejoin, Unowned
from zsched.relay.services.service import Services
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.proofs import Stamps
from zsched.relay.tokens import Tokens

FLIP_WAIT_S: Final = 0.3
"""A flip waits at most this long for a worker that is not ready, or has not heard yet that it is the owner."""
GONE_GRACE_S: Final = 0.05
"""An old owner whose token went has sent its last; what is still in our queues gets this long."""
SETTLE_S: Final = 1.5
"""An old owner that has ended has acknowledged all by then, also when one acknowledgement was dropped on the way, or a
robot has just stalled that gets the same answers (`zsched.core.hop.shared.STALLED_S`)."""
REJOIN_S: Final = 5.0
"""After a new data session a worker's link has this long to come back, before what has waited goes on its way."""
SAY_AGAIN_S: Final = 1.0
"""...and a worker may learn of us this much later than we of it."""
GATHER_S: Final = 0.5
"""What a worker left that restarted in place is reported once, when each of its streams has met the new life."""
MAX_UNTAKEN: Final = 4
"""More keys than that are not told of."""
LACK_S: Final = 1.0
"""What a worker lacks that has just come is on its way; after this time it is reported."""
AGAIN_S: Final = 0.5
"""A route for which no thread was to be had is tried again after this time."""
BUSY_S, CARE_S, IDLE_S = 0.01, 0.2, 0.5
LATE_S: Final = 0.1
"""A worker that is not ready is looked at this often, for it may lack something for good..."""
FRESH_S: Final = 1.0
"""...but every `BUSY_S` for so long after the last plan, token or end marker."""

_log = logging.getLogger("zsched.relay")


class _Late(Struct, frozen=True):
    """How a route is opened that could not be for a moment."""

    is_from_start: bool
    is_as_opened: bool


class _OpenSlot(Struct, eq=False):
    slot: Slot
    tokens: frozenset[str] = frozenset()
    seen: frozenset[str] = frozenset()
    is_ready: bool = False
    lacks_since: float | None = None
    lack: SlotReady | None = None
    """What it lacks, as it was told last."""
    is_flipped: bool = False
    left_since: float | None = None
    """Since when a newer slot carries."""
    is_drained: bool = False
    gone_at: float | None = None
    ended_at: float | None = None
    left: int = 0
    """Samples that a worker left open which another life has followed, not reported yet..."""
    left_at: float | None = None
    """...and since when that is known."""


_Item = RoutePlan | Finish | Orphaned | Unowned | Leave | Rejoin | Ended | None


class TaskRelay:
    """One task's streams on this node. Every method may be called from any thread; none blocks."""

    def __init__(
        self,
        session: Session,
        task: TaskId,
        tokens: Tokens,
        acks: Acks,
        report: Callable[[RelayReport], None],
        graph: GraphMirror,
        streams: OpenStreams,
        local: Session | None = None,
    ) -> None:
        """``session`` is the fleet's, ``local`` the one of the host's own side, if it has one.

        ``streams`` are opened here by both.
        """
        self._graph = graph
        self._task = task
        self._tokens = tokens
        self._acks = acks
        self._report = report
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._is_woken = False
        """A wake waits in the queue, which nobody has looked at yet."""
        self._plan: RoutePlan | None = None
        self._slots: dict[int, _OpenSlot] = {}
        self._streams = streams
        streams.wake = self.wake
        self._services = Services(session, local)
        self._stamps = Stamps()
        self._flip_by: float | None = None
        self._leaving: Leave | None = None
        self._is_away = False
        """Between two data sessions: what comes waits."""
        self._resume_by: float | None = None
        """What has waited goes out when the owner's worker is there again, at the latest then."""
        self._say_again_at: float | None = None
        self._is_inherited = False
        """What we carry is the work of a daemon that is gone; the next one may not know of an older slot."""
        self._broken: set[tuple[int, str]] = set()
        """(epoch, stream) of what could not be opened."""
        self._late: dict[tuple[int, str], _Late] = {}
        """Those of them that are tried again: for a moment no thread was to be had..."""
        self._unheard: tuple[Route, ...] = ()
        """...and inputs of a task without an owner."""
        self._try_at = 0.0
        self._heard_at = 0.0
        """When a plan came last, or something woke us."""
        self._has_problem = False
        """One was told, and not that it is over."""
        guarded(self._run, name=f"task {task}").start()

    def apply(self, plan: RoutePlan) -> None:
        """Take the newest plan."""
        self._queue.put(plan)

    def listen(self, routes: tuple[Route, ...]) -> None:
        """Take these inputs from now on, so that what comes before the first owner is counted, or kept for it.

        While there is none, no others: a rule may have gone.
        """
        self._queue.put(Unowned(routes))

    def wake(self) -> None:
        """Something that readiness or draining hangs on has changed."""
        if not self._is_woken:  # one look behind all of them is enough
            self._is_woken = True
            self._queue.put(None)

    def lose_daemon(self) -> None:
        """Nobody would tell us of another owner from now on, until the next plan."""
        self._queue.put(Orphaned())

    def leave(self, patience_s: float, at_most_s: float) -> threading.Event:
        """Let what is under way arrive, and close all that is on the data session; answers what is set then.

        Samples and requests that come wait. When nothing has arrived for ``patience_s``, and after ``at_most_s``, what
        is under way is given up, counted.
        """
        has_left = threading.Event()
        leave = Leave(has_left=has_left, began_at=monotonic_s(), patience_s=patience_s, at_most_s=at_most_s)
        self._queue.put(leave)
        return has_left

    def rejoin(self, session: Session, own_ids: frozenset[str]) -> None:
        """Carry on by another data session; ``own_ids`` are those of all sessions of this process."""
        self._queue.put(Rejoin(session, own_ids))

    def finish(self, until: float) -> threading.Event:
        """This relay is about to end: take nothing more, let what is under way arrive until then, and close all.

        The event is set when the counters are the last ones.
        """
        is_done = threading.Event()
        self._queue.put(Finish(is_done, until))
        return is_done

    def end(self) -> None:
        """The task left the fleet file: close everything, and end."""
        self._queue.put(Ended())

    @property
    def missed(self) -> NodeId | None:
        """Whose worker streams are meant to go to that is not ready, or cannot be reached; ``None``: nobody's."""
        current = self._current()
        return None if current is None or current.is_ready else current.slot.owner

    def counts(self) -> tuple[StreamCount, ...]:
        """The counters of every stream, by name."""
        return tuple(sorted((*self._streams.counts(), *self._services.counts()), key=lambda count: count.stream))

    # --- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            try:
                plan = self._queue.get(timeout=self._wait_s())
                if plan is None:
                    self._is_woken = False
                self._heard_at = monotonic_s()
            except queue.Empty:
                plan = None
            try:
                if isinstance(plan, Ended):
                    self._close_all()
                    self._end_problem()
                    return
                if isinstance(plan, Finish):
                    self._finish(plan)
                    return
                if isinstance(plan, Orphaned):
                    self._is_inherited = True
                elif isinstance(plan, Unowned):
                    self._listen(plan.routes)
                elif isinstance(plan, Leave):
                    self._leaving = plan
                elif isinstance(plan, Rejoin):
                    self._rejoin(plan.session, plan.own_ids)
                elif plan is not None:
                    self._take(plan)
                self._step()
            except Exception as error:  # noqa: BLE001 - a bad plan must not end the task's thread
                _log.exception("task %s", self._task)
                self._problem(f"{type(error).__name__}: {error}")

    def _wait_s(self) -> float:
        current = self._current()
        if self._leaving is not None or self._resume_by is not None:
            return BUSY_S
        if current is None or self._is_away:
            return IDLE_S
        if self._flip_by is not None or self._draining() is not None:
            return BUSY_S
        if not current.is_ready:
            return BUSY_S if monotonic_s() - self._heard_at < FRESH_S else LATE_S
        return CARE_S if self._streams.is_counted else IDLE_S

    def _step(self) -> None:
        if self._is_away:
            return
        if (self._late or self._unheard) and monotonic_s() >= self._try_at:
            self._try_again()
        for state in tuple(self._slots.values()):
            self._refresh(state)
            self._tell_left(state)
        self._flip_when_due()
        self._drain()
        for source in self._streams.inputs.values():
            source.look_after()
        for sink in self._streams.outputs.values():
            sink.look_after()
        self._services.look_after()
        stalled = self._acks.stalled
        stalled.buffers.look(is_still=stalled.is_resting and self._is_still())
        if self._leaving is not None:
            self._leave_when_still(self._leaving)
        elif self._resume_by is not None:
            self._resume_when_ready(self._resume_by)
        elif self._say_again_at is not None and monotonic_s() >= self._say_again_at:
            self._say_again_at = None
            self._say_again()

    def _problem(self, text: str) -> None:
        self._has_problem = True
        self._report(ProblemReported(source=f"relay/{self._task}", problem=text[:MAX_REASON]))

    def _end_problem(self) -> None:
        """A plan was taken to its end: what was told is over, unless a stream of one of its slots is not open."""
        self._broken &= self._all_routes()
        if self._has_problem and not self._broken and not self._unheard:
            self._has_problem = False
            self._report(ProblemReported(source=f"relay/{self._task}", problem=None))

    def _all_routes(self) -> set[tuple[int, str]]:
        return {(epoch, route.stream) for epoch, state in self._slots.items() for route in state.slot.routes}

    # --- another data session ----------------------------------------------------------------------------------------

    def _leave_when_still(self, leaving: Leave) -> None:
        under_way = self._streams.under_way
        is_over = leaving.is_over(under_way, monotonic_s())
        if not is_over and (self._flip_by is not None or self._draining() is not None):
            return  # a handover first
        for source in self._streams.inputs.values():
            source.hold()
        self._services.hold()
        under_way = self._streams.under_way
        if not is_over and (under_way or not all(self._services.has_ended(epoch) for epoch in self._slots)):
            return
        self._leaving, self._is_away = None, True
        lost, carrier = sum(source.leave() for source in self._streams.inputs.values()), self._carrier()
        if carrier is not None:
            self._tell_lost(carrier.slot, lost)
        for sink in self._streams.outputs.values():
            sink.leave()
        leaving.has_left.set()

    def _rejoin(self, session: Session, own_ids: frozenset[str]) -> None:
        self._is_away, self._resume_by = False, monotonic_s() + REJOIN_S
        for state in self._slots.values():
            state.is_ready, state.seen, state.gone_at = False, frozenset(), None
            state.lacks_since = state.lack = None
        for problem in self._streams.rejoin(session, own_ids):
            self._problem(problem)
            self._broken |= self._all_routes()  # only the next slot opens it again
        for epoch, state in self._slots.items():
            if state.slot.ready_when is ReadyWhen.TOKEN:
                for source in self._streams.inputs.values():
                    source.part(epoch, is_parted=True)  # until its token is seen by this session
        self._services.rejoin(session, self._slots)
        for state in self._slots.values():
            for route in state.slot.routes:
                if route.direction is Direction.SERVICE:
                    self._try_route(state.slot, route, is_from_start=False)
        carrier = self._carrier()
        if carrier is not None:
            self._services.flip(carrier.slot.epoch)

    def _resume_when_ready(self, until: float) -> None:
        carrier, now = self._carrier(), monotonic_s()
        if carrier is not None and not carrier.is_ready and now < until:
            return
        self._resume_by, self._say_again_at = None, now + SAY_AGAIN_S
        for source in self._streams.inputs.values():
            source.resume()
        self._say_again()

    def _say_again(self) -> None:
        for sink in self._streams.outputs.values():
            sink.say_again()

    # --- plans -------------------------------------------------------------------------------------------------------

    def _close_all(self) -> None:
        for epoch in sorted(self._slots):
            self._close(epoch)
        self._streams.keep(())
        self._services.keep(set())
        self._graph.set_routes(self._task, ())

    def _finish(self, finish: Finish) -> None:
        try:
            self._services.stop()
            for source in self._streams.inputs.values():
                source.finish()
            while (self._streams.under_way or self._services.is_asked) and monotonic_s() < finish.until:
                for source in self._streams.inputs.values():
                    source.look_after()
                sleep(BUSY_S)
            self._streams.close()
            self._services.finish()
        finally:
            finish.is_done.set()

    def _listen(self, routes: tuple[Route, ...]) -> None:
        self._unheard = ()
        for route in routes:
            if self._slots and route.stream in self._streams.inputs:
                continue  # the plans say what it takes
            self._listen_to(route)
        if not self._slots:  # else the plans say that, too
            self._streams.keep_inputs({route.stream for route in routes})

    def _listen_to(self, route: Route) -> None:
        try:
            self._streams.input_of(route)
        except (ValueError, zenoh.ZError, RuntimeError) as error:
            self._problem(f"{route.stream}: {route.from_expr}: {error}")
            if isinstance(error, RuntimeError):  # no thread is to be had: that may be over in a moment
                self._unheard, self._try_at = (*self._unheard, route), monotonic_s() + AGAIN_S

    def _take(self, plan: RoutePlan) -> None:
        self._plan = plan
        self._flip_by = None
        keeps_old = plan.phase is not RoutePhase.CLOSE
        olds = (plan.predecessors or self._inherited(plan)) if keeps_old else ()
        self._is_inherited &= keeps_old
        wanted = {slot.epoch: slot for slot in (*olds, plan.current) if slot is not None}
        if plan.phase is RoutePhase.CLOSE and plan.current is not None:
            self._open(plan.current)
            self._flip(self._slots[plan.current.epoch])
        for epoch, state in sorted(self._slots.items()):
            slot = wanted.get(epoch)
            if slot is None or (slot.owner, slot.ready_when) != (state.slot.owner, state.slot.ready_when):
                self._close(epoch)
            elif slot != state.slot:
                self._change(state, slot)
        for old in olds:
            if old.epoch not in self._slots:  # we were not there when it opened: it carries, or did
                self._open(old)
                self._flip(self._slots[old.epoch], is_reported=False)
        if plan.current is not None:
            self._open(plan.current, is_from_start=plan.phase is RoutePhase.PREPARE)
        self._carry_on()
        current = self._current()
        if current is not None:
            self._follow(plan.phase, current)
        self._forget_streams()
        self._graph.set_routes(
            self._task, tuple(route for state in self._slots.values() for route in state.slot.routes)
        )
        self._end_problem()

    def _follow(self, phase: RoutePhase, current: _OpenSlot) -> None:
        """Do for the plan's own slot what its phase asks; what was said of it before is said again."""
        if phase is RoutePhase.CLOSE:
            self._flip(current)  # it was opened anew: its owner counts as ready by another rule
        elif phase is RoutePhase.PREPARE and current.is_ready:
            self._report(SlotReady(task=self._task, epoch=current.slot.epoch))
        current.lack = None
        if phase is RoutePhase.FLIP:
            self._flip_by = monotonic_s() + FLIP_WAIT_S
            if current.is_flipped:
                self._report_flip(current.slot.epoch, 0)  # for another daemon

    def _inherited(self, plan: RoutePlan) -> tuple[Slot, ...]:
        """The slot that carries since another daemon's time, while the new owner is not ready, and what drains."""
        if not self._is_inherited or plan.current is None:
            return ()
        olds = self._before(plan.current.epoch)
        return tuple(old.slot for old in olds if old.is_flipped and not old.is_drained)

    def _open(self, slot: Slot, *, is_from_start: bool = False) -> None:
        if slot.epoch in self._slots:
            return
        self._slots[slot.epoch] = _OpenSlot(slot=slot)
        for route in slot.routes:
            self._try_route(slot, route, is_from_start=is_from_start)

    def _change(self, state: _OpenSlot, slot: Slot) -> None:
        """The fleet file has changed within an epoch: close and open the streams that differ, touch no other one."""
        epoch, before = slot.epoch, {route.stream: route for route in state.slot.routes}
        wanted = {route.stream: route for route in slot.routes}
        lost = sum(self._close_stream(epoch, route) for stream, route in before.items() if wanted.get(stream) != route)
        self._tell_lost(slot, lost)
        state.slot = slot
        for stream, route in wanted.items():
            if before.get(stream) != route:
                self._try_route(slot, route, is_from_start=False)
        if state is self._carrier():  # a slot that was left drains, and gets nothing new
            self._flip_anew(epoch)

    def _carry_on(self) -> None:
        """A stream that is another one now, by a changed fleet file, has lost the slot that carries: it goes on there.

        That slot stays as it was opened, until the flip.
        """
        carrier = self._carrier()
        if carrier is None or carrier is self._current():
            return
        epoch = carrier.slot.epoch
        lost = [route for route in carrier.slot.routes if not self._has(epoch, route)]
        for route in lost:
            self._try_route(carrier.slot, route, is_from_start=False, is_as_opened=True)
        if lost:
            self._flip_anew(epoch)

    def _flip_anew(self, epoch: int) -> None:
        """Streams that were opened anew go to the slot that carries; those that ran on are there already."""
        for sink in self._streams.outputs.values():
            sink.flip(epoch, drops_held=False)
        for source in self._streams.inputs.values():
            source.flip(epoch, has_answer=self._has_answer)
        self._services.flip(epoch)

    def _has(self, epoch: int, route: Route) -> bool:
        """Whether a route's stream has the slot, or is none any more that could have it."""
        if route.direction is Direction.SERVICE:
            return self._services.has_slot(epoch, route)
        streams = self._streams.inputs if route.direction is Direction.INPUT else self._streams.outputs
        one = streams.get(route.stream)
        return one is None or one.route.near != route.near or one.has_slot(epoch)

    def _close_stream(self, epoch: int, route: Route) -> int:
        """Close one stream's part of a slot; how many of its samples the worker had not acknowledged."""
        if route.direction is Direction.SERVICE:
            self._services.close_stream(epoch, route.stream)
            return 0
        if route.stream in self._streams.outputs:
            self._streams.outputs[route.stream].close_slot(epoch)
        source = self._streams.inputs.get(route.stream)
        return 0 if source is None else source.take_left(epoch) + source.close_slot(epoch, has_answer=self._has_answer)

    def _try_route(self, slot: Slot, route: Route, *, is_from_start: bool, is_as_opened: bool = False) -> None:
        """``is_as_opened``: in the stream of its name that there is, though that goes by another file now."""
        place = slot.epoch, route.stream
        self._broken.discard(place)
        self._late.pop(place, None)
        try:
            self._open_route(slot, route, is_from_start=is_from_start, is_as_opened=is_as_opened)
        except (ValueError, zenoh.ZError, RuntimeError) as error:
            self._broken.add(place)
            self._problem(f"{route.stream}: {route.from_expr} -> {route.to_expr}: {error}")
            if isinstance(error, RuntimeError):  # no thread is to be had: that may be over in a moment
                self._late[place] = _Late(is_from_start=is_from_start, is_as_opened=is_as_opened)
                self._try_at = monotonic_s() + AGAIN_S

    def _try_again(self) -> None:
        """Open what could not be for want of a thread, as it was to be opened."""
        unheard, self._unheard = self._unheard, ()
        for route in unheard if not self._slots else ():
            self._listen_to(route)
        late, self._late = self._late, {}
        for state in self._slots.values():
            for route in state.slot.routes:
                how = late.get((state.slot.epoch, route.stream))
                if how is None or (how.is_as_opened and self._has(state.slot.epoch, route)):
                    continue
                self._try_route(state.slot, route, is_from_start=how.is_from_start, is_as_opened=how.is_as_opened)
        carrier = self._carrier()
        if late and carrier is not None:
            self._flip_anew(carrier.slot.epoch)
        self._end_problem()

    def _open_route(self, slot: Slot, route: Route, *, is_from_start: bool, is_as_opened: bool) -> None:
        epoch = slot.epoch
        is_counted = slot.ready_when is ReadyWhen.TOKEN  # a foreign worker counts nothing
        acks = self._acks.of(slot.owner, self._task) if is_counted else None
        if route.direction is Direction.SERVICE:
            (self._services.open_beside if is_as_opened else self._services.open)(epoch, route)
            return
        if route.direction is Direction.INPUT:
            source = self._streams.inputs[route.stream] if is_as_opened else self._streams.input_of(route)
            source.open(epoch, route, acks, self._stamps if _replays(slot) else None)
            if is_counted and not self._tokens.workers(slot.owner, self._task):
                source.part(epoch, is_parted=True)  # nobody else who subscribes, a recorder, is taken for the worker
            return
        sink = self._streams.outputs[route.stream] if is_as_opened else self._streams.output_of(route)
        sink.know(route.from_expr, notes_stamps=_replays(slot))
        sink.open(epoch, route, acks, is_from_start=is_from_start)

    def _close(self, epoch: int) -> None:
        state = self._slots.pop(epoch, None)
        lost = (0 if state is None else state.left) + sum(
            source.take_left(epoch) + source.close_slot(epoch, has_answer=self._has_answer)
            for source in self._streams.inputs.values()
        )
        if state is not None:
            self._tell_lost(state.slot, lost)
        for sink in self._streams.outputs.values():
            sink.close_slot(epoch)
        self._services.close_slot(epoch)

    def _tell_left(self, state: _OpenSlot) -> None:
        """Report, once for each death, what a worker has left open that restarted in place."""
        now = monotonic_s()
        left = sum(source.take_left(state.slot.epoch) for source in self._streams.inputs.values())
        if left:
            state.left, state.left_at = state.left + left, state.left_at or now
        if state.left_at is None or now - state.left_at < GATHER_S:
            return
        lost, state.left, state.left_at = state.left, 0, None
        self._tell_lost(state.slot, lost)

    def _tell_lost(self, slot: Slot, samples: int) -> None:
        """Report how many samples that were with the owner of a slot it has not acknowledged, if any."""
        if samples:
            self._report(SlotLost(task=self._task, epoch=slot.epoch, owner=slot.owner, samples=samples))

    def _forget_streams(self) -> None:
        """Close streams that no slot names any more; without any slot they stay, and with them the kept values."""
        if not self._slots:
            return
        names = {route.stream for state in self._slots.values() for route in state.slot.routes}
        self._streams.keep(names)
        self._services.keep(names)

    # --- readiness and warm-up ---------------------------------------------------------------------------------------

    def _refresh(self, state: _OpenSlot) -> None:
        slot = state.slot
        needs_token = slot.ready_when is ReadyWhen.TOKEN
        tokens = self._tokens.workers(slot.owner, self._task) if needs_token else frozenset()
        is_rejoining = self._resume_by is not None
        state.gone_at = None if tokens or not needs_token or is_rejoining else state.gone_at or monotonic_s()
        # a worker with a token has declared its services before it; of a foreign one only the match tells
        has_services = needs_token or self._services.is_matching(slot.epoch)
        is_ready = (bool(tokens) or not needs_token) and has_services and self._is_matching(slot)
        returned = [source.take_returned(slot.epoch) for source in self._streams.inputs.values()]
        is_new = is_ready and (
            (not state.is_ready and not is_rejoining) or bool(tokens - state.tokens) or any(returned)
        )
        if needs_token and tokens != state.seen:
            state.seen = tokens
            for source in self._streams.inputs.values():
                source.part(slot.epoch, is_parted=not tokens)
        has_changed = is_ready != state.is_ready
        state.is_ready = is_ready
        if is_ready:
            state.tokens = tokens
        is_current = state is self._current()
        if is_new and (is_current or state is self._carrier()):
            self._warm_up(slot.epoch)
        if has_changed and is_current:
            self._report(SlotReady(task=self._task, epoch=slot.epoch, is_ready=is_ready))
        if is_ready:
            state.lacks_since = state.lack = None
        elif is_current:
            self._tell_lack(state, has_token=bool(tokens) if needs_token else None)

    def _tell_lack(self, state: _OpenSlot, *, has_token: bool | None) -> None:
        """Say what a worker lacks that is not ready for a while, whenever that changes."""
        now = monotonic_s()
        state.lacks_since = state.lacks_since or now
        if now - state.lacks_since < LACK_S:
            return
        untaken = self._untaken(state.slot)
        lack = SlotReady(
            task=self._task, epoch=state.slot.epoch, is_ready=False, has_token=has_token, untaken=untaken[:MAX_UNTAKEN]
        )
        if lack != state.lack:
            state.lack = lack
            self._report(lack)

    def _is_matching(self, slot: Slot) -> bool:
        return not self._untaken(slot)

    def _untaken(self, slot: Slot) -> tuple[str, ...]:
        """The inputs' keys that nobody subscribes to."""
        return tuple(
            route.to_expr
            for route in slot.routes
            if route.direction is Direction.INPUT
            and route.stream in self._streams.inputs
            and not self._streams.inputs[route.stream].is_matching(slot.epoch)
        )

    def _warm_up(self, epoch: int) -> None:
        for source in self._streams.inputs.values():
            source.warm_up(epoch)

    # --- flip and drain ----------------------------------------------------------------------------------------------

    def _flip_when_due(self) -> None:
        current = self._current()
        if self._flip_by is None or current is None:
            return
        if not current.is_flipped and monotonic_s() < self._flip_by and not self._can_flip(current):
            return
        self._flip_by = None
        self._flip(current)

    def _can_flip(self, state: _OpenSlot) -> bool:
        slot = state.slot
        is_told = slot.ready_when is not ReadyWhen.TOKEN or self._tokens.is_active(slot.owner, self._task, slot.epoch)
        return state.is_ready and is_told

    def _flip(self, state: _OpenSlot, *, is_reported: bool = True) -> None:
        if state.is_flipped:
            return
        epoch = state.slot.epoch
        is_behind = any(source.is_behind(epoch) for source in self._streams.inputs.values())
        for sink in self._streams.outputs.values():
            sink.flip(epoch, drops_held=is_behind)
        olds = self._before(epoch)
        carrier = self._carrier()
        is_old_dead = carrier is not None and carrier.gone_at is not None
        replayed = sum(
            source.flip(epoch, is_old_dead=is_old_dead, has_answer=self._has_answer)
            for source in self._streams.inputs.values()
        )
        self._services.flip(epoch)
        state.is_flipped = True
        for old in olds:
            old.left_since = old.left_since or monotonic_s()
        if not is_reported:
            return
        self._report_flip(epoch, replayed)
        if olds:  # a stalled old owner may hold these up for a lease: not in this thread
            epochs = [old.slot.epoch for old in olds]
            try:
                guarded(self._send_ends, epochs, name="ends", is_lasting=False).start()
            except RuntimeError:  # no thread is to be had: without their ends nobody would know when they are done
                self._send_ends(epochs)

    def _report_flip(self, epoch: int, replayed: int) -> None:
        now = monotonic_s()
        draining = tuple(
            DrainingSlot(epoch=old.slot.epoch, owner=old.slot.owner, since_s=now - (old.left_since or now))
            for old in self._before(epoch)
            if old.is_flipped and not old.is_drained
        )
        self._report(SlotFlipped(task=self._task, epoch=epoch, replayed=replayed, draining=draining))

    def _has_answer(self, stamp: Timestamp) -> bool:
        """Whether the one input with this timestamp has an answer that has passed, on every output that counts.

        Those are the ones of class ``reliable``, as for the worker's acknowledgements; where there are none, all. They
        are in order key by key only, so what has passed on an output of many keys says nothing of an earlier input.
        """
        sinks = tuple(self._streams.outputs.values())
        counted = [one for one in sinks if one.route.settings.stream_class is StreamClass.RELIABLE] or sinks
        is_proof = bool(counted) and not any("*" in sink.route.from_expr for sink in counted)
        return is_proof and self._stamps.is_alone(stamp) and all(sink.has_passed(stamp) for sink in counted)

    def _send_ends(self, epochs: list[int]) -> None:
        for epoch in epochs:
            for source in tuple(self._streams.inputs.values()):
                try:
                    source.send_end(epoch)
                except (zenoh.ZError, RuntimeError) as error:  # the slot was closed meanwhile
                    _log.info("%s: no end marker for epoch %d (%s)", source.route.stream, epoch, error)

    def _drain(self) -> None:
        state = self._draining()
        if state is None:
            return
        epoch = state.slot.epoch
        is_gone = state.gone_at is not None and monotonic_s() - state.gone_at > GONE_GRACE_S
        ended = [is_gone or sink.has_ended(epoch) for sink in self._streams.outputs.values()]
        for sink, has_ended in zip(tuple(self._streams.outputs.values()), ended, strict=True):
            if has_ended:
                sink.close_slot(epoch)
        if all(ended) and (is_gone or (self._services.has_ended(epoch) and self._has_settled(state))):
            state.is_drained = True
            for source in self._streams.inputs.values():
                source.end_slot(epoch, has_answer=self._has_answer)
            self._report(SlotDrained(task=self._task, epoch=epoch))

    def _has_settled(self, state: _OpenSlot) -> bool:
        """The ends may overtake the acknowledgements of what came before them, for which it waits a while."""
        now = monotonic_s()
        state.ended_at = state.ended_at or now
        is_over = now - state.ended_at > SETTLE_S
        return is_over or all(source.has_settled(state.slot.epoch) for source in self._streams.inputs.values())

    def _draining(self) -> _OpenSlot | None:
        """The oldest slot that is left and has not drained: with `HandoverRule.ALL` the later ones wait for it."""
        carrier = self._carrier()
        olds = () if carrier is None else self._before(carrier.slot.epoch)
        return next((old for old in olds if not old.is_drained), None)

    # --- small questions ---------------------------------------------------------------------------------------------

    def _current(self) -> _OpenSlot | None:
        if self._plan is None or self._plan.current is None:
            return None
        return self._slots.get(self._plan.current.epoch)

    def _carrier(self) -> _OpenSlot | None:
        """The slot that the inputs go to: the newest that was flipped to."""
        flipped = (state for state in self._slots.values() if state.is_flipped)
        return max(flipped, key=lambda state: state.slot.epoch, default=None)

    def _before(self, epoch: int) -> list[_OpenSlot]:
        """The open slots of older epochs, the oldest first."""
        return [self._slots[old] for old in sorted(self._slots) if old < epoch]

    def _is_still(self) -> bool:
        """Whether no stream has carried anything for a while."""
        return self._streams.is_still and self._services.is_still


def _replays(slot: Slot) -> bool:
    """Whether the next owner gets what this one leaves open of some input."""
    return any(route.settings.on_crash is OnCrash.REPLAY for route in slot.routes)
