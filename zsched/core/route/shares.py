"""One application's part in the streams of its node: what it is told of the plans, and what counts of its words.

Knows: which routes of a plan an application has itself (by the keys that it names), that a slot has drained when both
the relay and the application say so, how the counters of both add up. Does not know: sockets, zenoh, how a stream is
carried. An application that goes takes what it had in flight with it: that is counted as at most lost from then on.

The answers that an application has itself come to the relay, too. They are counted once: by the application.

What it says is believed of its own routes only: it can hold up the end of a slot for the slot's drain time, and raise
counters.
"""

from __future__ import annotations

from typing import Final

from zsched.core.events import SlotDrained
from zsched.core.hop.books import add_to, added, closed, without
from zsched.core.relay_protocol import SlotLost, WorkerWatch
from zsched.core.route.keyexpr import includes
from zsched.core.values.model import TaskId
from zsched.core.values.plan import Direction, Route, RoutePlan, Slot, StreamCount
from zsched.core.values.struct import Struct, field, replace

MAX_PARTS: Final = 8
TIMES_S: Final = 3.0
"""Times that an application has told count for so long: one that stands still tells no others."""

Told = RoutePlan | WorkerWatch
Word = SlotDrained | SlotLost
_Place = tuple[TaskId, int]


def takes(route: Route, keys: tuple[str, ...]) -> bool:
    """Whether an application that names these keys has the route's stream itself."""
    if route.direction is Direction.SERVICE:
        return False
    return any(includes(route.near, key) for key in keys)


class Shares(Struct, eq=False):
    """What one relay knows of its node's plans and of the application beside it, which comes and goes."""

    keys: tuple[str, ...] = ()
    """What the application names; empty: there is none."""
    plans: dict[TaskId, RoutePlan] = field(default_factory=dict)
    unowned: dict[TaskId, tuple[Route, ...]] = field(default_factory=dict)
    told: set[TaskId] = field(default_factory=set)
    """The tasks of which the application knows."""
    parts: dict[TaskId, tuple[int, ...]] = field(default_factory=dict)
    """{task: the newest epochs of slots with a part of the application's}; its last word of one follows its end."""
    drained: set[_Place] = field(default_factory=set)
    """The slots that it has drained..."""
    held: dict[_Place, SlotDrained] = field(default_factory=dict)
    """...and the relay's words of others, which wait for its own."""
    past: dict[str, StreamCount] = field(default_factory=dict)
    """What applications that have gone have counted, by stream."""
    counted: dict[str, StreamCount] = field(default_factory=dict)
    """What the one that is there has counted..."""
    counted_at: float = 0.0
    """...and when it last told that (monotonic seconds)."""
    newest: dict[str, float] = field(default_factory=dict)
    """When applications that have gone last had a sample of a stream (monotonic seconds)."""
    relays: dict[str, StreamCount] = field(default_factory=dict)
    """What the relay itself has counted..."""
    began: dict[str, StreamCount] = field(default_factory=dict)
    """...when the application took an output..."""
    copies: dict[str, StreamCount] = field(default_factory=dict)
    """...and of outputs while applications that have gone had them."""

    # --- plans -------------------------------------------------------------------------------------------------------

    def note_plan(self, plan: RoutePlan) -> tuple[Told, ...]:
        """The newest plan of a task; answers what the application is told."""
        self.plans[plan.task] = plan
        self._begin_outputs()
        slots = {slot.epoch for slot in (plan.current, *plan.predecessors) if slot is not None}
        self.drained = {place for place in self.drained if place[0] != plan.task or place[1] in slots}
        self.held = {place: word for place, word in self.held.items() if place[0] != plan.task or place[1] in slots}
        return self._of_plan(plan)

    def note_unowned(self, task: TaskId, routes: tuple[Route, ...]) -> tuple[Told, ...]:
        """The inputs that a task has before it has an owner."""
        self.unowned[task] = routes
        return self._of_unowned(task)

    def end(self, task: TaskId) -> bool:
        """The task has left the fleet; answers whether the application knows of it."""
        self.plans.pop(task, None)
        self.unowned.pop(task, None)
        self.held = {place: word for place, word in self.held.items() if place[0] != task}
        is_known = task in self.told
        self.told.discard(task)
        self.parts.pop(task, None)
        for table in (self.past, self.counted, self.newest, self.relays, self.began, self.copies):
            for stream in [stream for stream in table if stream.startswith(f"{task}/")]:
                del table[stream]
        return is_known

    def name(self, keys: tuple[str, ...]) -> tuple[Told, ...]:
        """The application names its keys, all of them; answers what it is told."""
        self.keys = keys
        self._begin_outputs()
        found = [one for task in sorted(self.unowned) for one in self._of_unowned(task)]
        return (*found, *(one for task in sorted(self.plans) for one in self._of_plan(self.plans[task])))

    def taken(self) -> tuple[str, ...]:
        """The named keys that are a stream's, by the plans of now."""
        routes = self._routes()
        return tuple(key for key in self.keys if any(takes(route, (key,)) for route in routes))

    def _of_unowned(self, task: TaskId) -> tuple[Told, ...]:
        routes = self._own(self.unowned[task])
        if not routes and task not in self.told:
            return ()
        self.told.add(task)
        return (WorkerWatch(task=task, unowned=routes),)

    def _of_plan(self, plan: RoutePlan) -> tuple[Told, ...]:
        if not self.keys:
            return ()
        share = replace(
            plan,
            current=None if plan.current is None else self._part(plan.current),
            predecessors=tuple(self._part(slot) for slot in plan.predecessors),
        )
        if plan.task not in self.told and not any(slot.routes for slot in _slots(share)):
            return ()
        self.told.add(plan.task)
        for slot in _slots(share):
            epochs = self.parts.get(plan.task, ())
            if slot.routes and slot.epoch not in epochs:
                self.parts[plan.task] = (*epochs, slot.epoch)[-MAX_PARTS:]
        return (share,)

    def _part(self, slot: Slot) -> Slot:
        return replace(slot, routes=self._own(slot.routes))

    def _routes(self) -> tuple[Route, ...]:
        """Of all tasks, by the plans of now."""
        of_plans = (slot.routes for plan in self.plans.values() for slot in _slots(plan))
        return tuple(route for routes in (*self.unowned.values(), *of_plans) for route in routes)

    def _own(self, routes: tuple[Route, ...]) -> tuple[Route, ...]:
        return tuple(route for route in routes if takes(route, self.keys))

    # --- what is said ------------------------------------------------------------------------------------------------

    def relay_drained(self, word: SlotDrained) -> SlotDrained | None:
        """The relay has drained a slot; ``None``: the application has not, and its own word is awaited."""
        place = word.task, word.epoch
        if not self._has_part(place) or place in self.drained:
            return word
        self.held[place] = word
        return None

    def heard(self, word: Word) -> tuple[Word, ...]:
        """The application says something of a slot; answers what the daemon hears by that."""
        place = word.task, word.epoch
        if word.epoch not in self.parts.get(word.task, ()):
            return ()
        if isinstance(word, SlotLost):
            return (word,)
        self.drained.add(place)
        held = self.held.pop(place, None)
        return () if held is None else (held,)

    def _has_part(self, place: _Place) -> bool:
        plan = self.plans.get(place[0])
        slots = () if plan is None else _slots(plan)
        return any(slot.epoch == place[1] and self._own(slot.routes) for slot in slots)

    def go(self, now: float) -> tuple[Word, ...]:
        """The application has gone; answers what the daemon hears: what was in flight, and what waited for its word.

        ``now``: monotonic seconds.
        """
        words: list[Word] = []
        for task, plan in sorted(self.plans.items()):
            slot = plan.current
            own = () if slot is None else self._own(slot.routes)
            lost = sum(self.counted[one.stream].in_flight or 0 for one in own if one.stream in self.counted)
            if slot is not None and lost:
                words.append(SlotLost(task=task, epoch=slot.epoch, owner=slot.owner, samples=lost))
        words += self.held.values()
        for stream, count in self.counted.items():
            if count.last_seen_s is not None:
                self.newest[stream] = now - count.last_seen_s
            add_to(self.past, closed(count))
        for stream, first in self.began.items():
            if stream in self.relays:
                add_to(self.copies, closed(without(self.relays[stream], first)))
        self.keys = ()
        self.told, self.parts, self.drained, self.held = set(), {}, set(), {}
        self.counted, self.began = {}, {}
        return tuple(words)

    # --- counters ----------------------------------------------------------------------------------------------------

    def note_counts(self, counts: tuple[StreamCount, ...], now: float) -> None:
        """What the application has counted by ``now``; of streams that are not its own nothing is taken."""
        self.counted_at = now
        own = {route.stream for route in self._own(self._routes())} | set(self.counted)
        for count in counts:
            if count.stream in own:
                self.counted[count.stream] = count

    def apart(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """The relay's own counters, without answers that an application has had itself."""
        self.relays = {count.stream: count for count in counts}
        return tuple(self._apart(count) for count in counts)

    def settled(self, counts: tuple[StreamCount, ...]) -> tuple[StreamCount, ...]:
        """The relay's counters with those of applications that have gone; the one that is there keeps its own."""
        return added(counts, self.past)

    def added(self, counts: tuple[StreamCount, ...], now: float) -> tuple[StreamCount, ...]:
        """The relay's counters with those of applications; ``now``: monotonic seconds."""
        own = self.counted
        if now - self.counted_at > TIMES_S:
            own = {stream: replace(count, answer_s=None, paired_hz=None) for stream, count in own.items()}
        total = added(self.settled(counts), own)
        return tuple(self._seen(count, now) for count in total)

    def _seen(self, count: StreamCount, now: float) -> StreamCount:
        at = self.newest.get(count.stream)
        if at is None:
            return count
        age_s = round(max(0.0, now - at), 3)
        return replace(count, last_seen_s=age_s if count.last_seen_s is None else min(age_s, count.last_seen_s))

    def _apart(self, count: StreamCount) -> StreamCount:
        stream = count.stream
        if stream in self.began:
            count = without(count, without(count, self.began[stream]))
        return without(count, self.copies[stream]) if stream in self.copies else count

    def _begin_outputs(self) -> None:
        """Note what the relay has counted of outputs that are the application's from now on."""
        for route in self._own(self._routes()):
            if route.direction is Direction.OUTPUT:
                none = StreamCount(stream=route.stream)
                self.began.setdefault(route.stream, self.relays.get(route.stream, none))


def _slots(plan: RoutePlan) -> tuple[Slot, ...]:
    return tuple(slot for slot in (*plan.predecessors, plan.current) if slot is not None)
