"""A worker's own failures: all are counted, few are logged, and the node is told once a second at most."""

from __future__ import annotations

import asyncio
import json
import logging
from functools import partial
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.events import FrameDropped
from zsched.core.values.model import MAX_REASON
from zsched.core.values.relay_protocol import WorkerTrouble
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import Keyspace
from zsched.relay.troubles import MAX_SPEAKERS, PAUSE_S, Word
from zsched.relay.troubles import Troubles as Heard
from zsched.worker.inputs import Dispatcher
from zsched.worker.jobs import JobBook
from zsched.worker.keep import Debts
from zsched.worker.samples import Input, Received
from zsched.worker.troubles import MAX_KINDS, Troubles

KEYS = Keyspace("test")


def fail(error: Exception) -> None:
    raise error


def raised(troubles: Troubles, error: Exception, times: int = 1) -> None:
    for _ in range(times):
        try:
            fail(error)
        except Exception as caught:  # noqa: BLE001 - as the callers do
            troubles.note("robot1/map", caught)


def test_every_failure_is_counted_and_the_last_count_is_told_though_nothing_fails_any_more() -> None:
    told: list[tuple[int, str]] = []
    troubles = Troubles(lambda count, text: told.append((count, text)))
    raised(troubles, ValueError("no such map\nin this office"))
    until(lambda: told, "the first one is told at once")
    raised(troubles, KeyError("frame"), times=2000)
    until(lambda: told[-1][0] == 2001, "the last count")
    where = f"(test_troubles.py:{fail.__code__.co_firstlineno + 1}; traceback in the worker's log)"
    assert told[0] == (1, f"ValueError: no such map {where}")
    assert told[-1][1] == f"KeyError: 'frame' {where}"
    assert len(told) <= 3, "not one message a failure"
    troubles.close()


def test_a_callback_that_raises_every_time_writes_one_line_per_kind_of_error(caplog: pytest.LogCaptureFixture) -> None:
    troubles = Troubles(lambda _count, _text: None)
    with caplog.at_level(logging.ERROR, "zsched.worker"):
        raised(troubles, ValueError("no such map"), times=500)
        raised(troubles, KeyError("frame"), times=500)
    assert [record.message for record in caplog.records] == [
        "robot1/map: the worker's callback failed",
        "robot1/map: the worker's callback failed, 501 times in all; at most one line in 10 s",
    ]
    kinds = [type(f"Error{number}", (Exception,), {}) for number in range(3 * MAX_KINDS)]
    caplog.clear()
    for kind in kinds * 2:
        raised(troubles, kind())
    assert len(caplog.records) < 2 * MAX_KINDS, "nor are kinds of errors without end"
    troubles.close()


def test_the_place_is_the_author_s_innermost_frame_and_not_a_library_s() -> None:
    told: list[str] = []
    troubles = Troubles(lambda _count, text: told.append(text))
    try:
        json.loads("{")  # raises in the standard library
    except ValueError as caught:
        line = caught.__traceback__.tb_lineno if caught.__traceback__ else 0
        troubles.note("robot1/map", caught)
    until(lambda: told, "it is told")
    assert f"(test_troubles.py:{line}; traceback in the worker's log)" in told[0]
    troubles.close()


def test_an_error_of_any_length_fits_what_is_carried() -> None:
    told: list[str] = []
    troubles = Troubles(lambda _count, text: told.append(text))
    raised(troubles, ValueError("x" * 10_000))
    until(lambda: told, "it is told")
    WorkerTrouble(task="t", incarnation="1", count=1, text=told[0])
    assert len(told[0]) < MAX_REASON
    troubles.close()


@pytest.mark.parametrize("kind", [ValueError, SystemExit, asyncio.CancelledError])
def test_the_dispatch_goes_on_behind_a_callback_that_raises(kind: type[BaseException]) -> None:
    told: list[int] = []
    troubles = Troubles(lambda count, _text: told.append(count))
    jobs = JobBook("t", "1", lambda _jobs: None)
    dispatcher = Dispatcher(lambda _epoch: None, cast("Acknowledger", None), troubles, cast("Debts", None), jobs)
    dispatcher.start()

    def refuse(sample: Received) -> None:
        raise kind(sample.key)

    source = Input(on_sample=refuse, keep_last=None)
    with hub_and_neighbour() as (hub, neighbour):
        subscriber = hub.declare_subscriber("in", lambda sample: dispatcher.put(source, sample))
        publisher = neighbour.declare_publisher("in")
        until(partial(matches, publisher), "they match")
        for _ in range(20):
            publisher.put("x")
        until(lambda: told and told[-1] == 20, "all have failed, and are told")
        subscriber.undeclare()
    dispatcher.close()
    troubles.close()


def test_the_relay_hands_on_what_its_own_node_s_workers_say_and_no_flood() -> None:
    heard: list[Word] = []
    trouble = WorkerTrouble(task="t", incarnation="7", count=3, text="ValueError")
    with hub_and_neighbour() as (hub, neighbour):
        kept = [Heard(hub, KEYS, "edge1", heard.append)]
        until(partial(matches, neighbour.declare_publisher(KEYS.trouble("edge1", "t", "7"))), "the relay listens")

        def say(node: str, value: bytes, incarnation: str = "7") -> None:
            neighbour.put(KEYS.trouble(node, "t", incarnation), value, congestion_control=zenoh.CongestionControl.BLOCK)

        say("edge1", b"\x00 garbage")
        say("edge1", wire.encode(trouble), incarnation="8")
        say("edge2", wire.encode(trouble))
        for _ in range(200):
            say("edge1", wire.encode(trouble))
        until(lambda: trouble in heard, "the word of the worker here")
        assert {one for one in heard if not isinstance(one, FrameDropped)} == {trouble}
        assert len(heard) < 100
        kept.clear()


def test_tasks_that_came_and_went_take_no_later_one_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    now, heard = [100.0], list[Word]()
    monkeypatch.setattr("zsched.relay.troubles.monotonic_s", lambda: now[0])
    session = SimpleNamespace(declare_subscriber=lambda *_: None)
    relay = Heard(cast("zenoh.Session", session), KEYS, "edge1", heard.append)

    def said(task: str) -> bool:
        """Whether a word of this task was handed on."""
        heard.clear()
        relay._hand_on(task, WorkerTrouble(task=task, incarnation="7", count=3, text="ValueError"))
        return bool(heard)

    for number in range(MAX_SPEAKERS):
        assert said(f"t{number}")
    assert not said("one-too-many"), "so many at a time are no workers of ours"
    now[0] += 2 * PAUSE_S
    assert said("t0")
    assert said("another")
    assert not said("t0"), "it spoke a moment ago, and is remembered"
    assert said("t1")
    assert len(relay._reported_at) == MAX_SPEAKERS
