"""A moment in which no thread is to be had (a limit of the machine's) takes nothing from a relay for good."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from support.threads import no_threads
from support.waiting import until
from zsched.core.values.plan import Direction, RosGraph, Route, StreamSettings
from zsched.core.values.relay_protocol import WorkerMatched, WorkerWatch
from zsched.link.sessions.stalled_links import StalledLinks
from zsched.relay.graph import GraphMirror
from zsched.relay.matching import Matching
from zsched.relay.streams.history import MAX_ASKERS, HeldValues

ROS = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="0/chatter/**",
    to_expr="0/edge1/chatter/**",
    settings=StreamSettings(graph=RosGraph.RMW_ZENOH),
)


def test_workers_are_watched_later() -> None:
    told: list[WorkerMatched] = []
    matching = Matching(cast("Any", None), told.append)
    with no_threads(), pytest.raises(RuntimeError):
        matching.watch(WorkerWatch(task="t"))
    matching.watch(WorkerWatch(task="t"))
    until(lambda: bool(told), "what is seen")


def test_stalled_links_are_watched_later_and_a_put_goes_on_meanwhile() -> None:
    stalled = StalledLinks(cast("Any", SimpleNamespace(info=SimpleNamespace(links=tuple))), 1.5)
    seen = []
    with no_threads(), stalled:
        seen.append(stalled.is_resting)
    with stalled:
        seen.append(stalled.is_resting)
    stalled.close()
    assert seen == [True, False]


def test_the_graph_is_mirrored_later() -> None:
    taken: list[object] = []

    class Mirror(GraphMirror):
        def _take(self, item: Any) -> None:
            taken.append(item[0])

    session = cast("Any", SimpleNamespace(zid=lambda: "a1"))
    mirror = Mirror(session, None, "robot1")
    with no_threads(), pytest.raises(RuntimeError):
        mirror.set_routes("t", (ROS,))
    mirror.set_routes("t", (ROS,))
    until(lambda: taken == ["t"], "the routes")


def test_caches_are_asked_later() -> None:
    """Each thread that did not start counted as one that asks, of which there are four."""
    asked: list[str] = []

    def get(selector: str, **_: object) -> tuple[()]:
        asked.append(selector)
        return ()

    session = cast("Any", SimpleNamespace(zid=lambda: "a1", get=get))
    values = HeldValues(session, "robot1/map", 1, lambda _: None)
    for _ in range(MAX_ASKERS):
        with no_threads(), pytest.raises(RuntimeError):
            values.start()
    with values._asking:
        values._have_asked()
    until(lambda: bool(asked), "the question")
    values.close()
