"""The streams of one task that an application has itself: the relay's own code, without what lies between.

Knows: where the application's samples enter and its answers leave. Does not know: slots, moves, numbers
(`zsched.relay.task` and below), who tells the plans.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from zenoh import Session

from zsched.clock import monotonic_s
from zsched.core.relay_protocol import RelayReport
from zsched.core.route.keyexpr import includes
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import Direction, Route, RoutePlan
from zsched.relay.graph import GraphMirror
from zsched.relay.open_streams import OpenStreams
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.outputs import OutputStream
from zsched.relay.task import TaskRelay
from zsched.relay.tokens import Tokens
from zsched.stream.hand import Hand
from zsched.stream.samples import Received

LOOK_S: Final = 0.005


class NoGraph(GraphMirror):
    """The ROS graph is the relay's to mirror: what an application announces itself is there already."""

    def set_routes(self, task: TaskId, routes: tuple[Route, ...]) -> None:
        """Nothing."""


class OwnStreams(OpenStreams):
    """Streams that begin and end in this process."""

    def __init__(self, session: Session, deliver: Callable[[Received], None]) -> None:
        """``deliver`` gets every answer, in a thread for each output."""
        super().__init__(session, frozenset({str(session.zid())}))
        self._deliver = deliver
        self._hands: dict[str, Hand] = {}

    def has_handed(self) -> bool:
        """Whether the callbacks have returned for every answer that has come."""
        return all(hand.is_empty for hand in tuple(self._hands.values()))

    def give_up(self) -> dict[str, int]:
        """Hand no answer over any more; {output stream: how many still waited for its callback}."""
        return {stream: left for stream, hand in tuple(self._hands.items()) if (left := hand.give_up())}

    def _end(self, streams: dict[str, InputStream] | dict[str, OutputStream], stream: str) -> None:
        super()._end(streams, stream)
        if streams is self.outputs:
            self._hands.pop(stream, None)  # nobody waits for what it will never hand over

    def _take_input(self, route: Route) -> InputStream:
        kept = self._kept(route)
        return InputStream(self._session, route, self._own_ids, None, self._times, is_ours=True, kept=kept)

    def _take_output(self, route: Route) -> OutputStream:
        way = self._hands[route.stream] = Hand(route, self._deliver)
        return OutputStream(self._session, route, self._own_ids, self.wake, None, self._times, way)


class OwnTask(TaskRelay):
    """One task's streams in this process."""

    def __init__(
        self,
        session: Session,
        node: NodeId,
        task: TaskId,
        tokens: Tokens,
        acks: Acks,
        report: Callable[[RelayReport], None],
        deliver: Callable[[Received], None],
    ) -> None:
        """``deliver`` gets every answer, in a thread for each output."""
        self._has_owner = False
        self._told: tuple[Route, ...] = ()
        """What is to be open, by the newest word."""
        self._own = OwnStreams(session, deliver)
        self._ends: list[threading.Event] = []
        super().__init__(session, task, tokens, acks, report, NoGraph(session, None, node), self._own)

    def input(self, stream: str) -> InputStream | None:
        """An input by its stream's name, as it is now."""
        return self._own.inputs.get(stream)

    def inputs(self) -> tuple[InputStream, ...]:
        """All inputs, as they are now."""
        return tuple(self._own.inputs.values())

    def wait_fed(self, key: str, until: float) -> None:
        """Wait until what is put under a key goes to the owner, where the task takes the key and has one."""
        while monotonic_s() < until and not self._feeds(key):
            time.sleep(LOOK_S)

    def _feeds(self, key: str) -> bool:
        """Whether every input that is to take a key is there, and fed."""
        names = {one.stream for one in self._told if one.direction is Direction.INPUT and includes(one.from_expr, key)}
        return all((one := self.input(name)) is not None and (one.has_way or not self.is_owned) for name in names)

    @property
    def is_owned(self) -> bool:
        """Whether the newest plan names an owner, as far as it is told (`apply`)."""
        return self._has_owner

    def apply(self, plan: RoutePlan) -> None:
        """Take the newest plan."""
        self._has_owner = plan.current is not None
        if plan.current is not None:
            self._told = plan.current.routes
        super().apply(plan)

    def listen(self, routes: tuple[Route, ...]) -> None:
        """Take these inputs from now on."""
        self._told = routes
        super().listen(routes)

    def under_way(self) -> int:
        """How many samples have been taken and not processed, as far as is known."""
        return self._own.under_way

    def has_handed(self) -> bool:
        """Whether the callbacks have returned for every answer that has come."""
        return self._own.has_handed()

    def give_up_answers(self) -> dict[str, int]:
        """Hand no answer over any more; {output stream: how many still waited for its callback}, which are counted."""
        return self._own.give_up()

    def end_inputs(self) -> None:
        """Nothing more will be put."""
        self._ends = [source.end() for source in tuple(self._own.inputs.values())]

    def has_ended(self) -> bool:
        """Whether the ends of all inputs have been put: a worker that misses one waits for it at the next move."""
        return all(end.is_set() for end in self._ends)
