"""A moment in which no thread is to be had (a limit of the machine's) takes nothing from a worker for good."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from support.threads import no_threads
from support.waiting import until
from zsched.worker.jobs import JobBook
from zsched.worker.keep import Debts, Keeper
from zsched.worker.snapshot import MAX_WAITING, Offer, StateBook
from zsched.worker.troubles import Troubles

if TYPE_CHECKING:
    from zsched.core.values.events import WorkerJobs


def test_failures_are_told_of_later() -> None:
    told: list[int] = []
    troubles = Troubles(lambda count, _text: told.append(count))
    with no_threads():
        troubles.note("robot1/map", ValueError("one"))
    troubles.note("robot1/map", ValueError("two"))
    until(lambda: told == [2], "both")
    troubles.close()


def test_jobs_are_told_of_later() -> None:
    told: list[WorkerJobs] = []
    book = JobBook("t", "7", told.append)
    for number in (1, 2):
        with no_threads() if number == 1 else book.job(skipped=0, came_s=None), book.job(skipped=0, came_s=None):
            pass
    until(lambda: bool(told), "a word")
    book.close()


def test_answers_are_looked_after_by_the_next_publisher_s_thread() -> None:
    declared: list[str] = []
    session = cast("Any", SimpleNamespace(declare_subscriber=lambda *_: _Subscriber(declared)))
    stalled = cast("Any", SimpleNamespace(close=lambda: None))
    keeper = Keeper(session, "acks", Debts(cast("Any", None)), stalled)
    source = cast("Any", SimpleNamespace(eid=7))
    with no_threads(), pytest.raises(RuntimeError):
        keeper.lane("out", source, 10)
    assert (keeper._lanes, keeper._subscriber, declared) == ({}, None, ["undeclared"])
    keeper.lane("out", source, 10)
    assert keeper._subscriber is not None
    until(lambda: "zsched keeper" in {thread.name for thread in threading.enumerate()}, "the thread")
    keeper.close()


class _Subscriber:
    def __init__(self, said: list[str]) -> None:
        self._said = said

    def undeclare(self) -> None:
        self._said.append("undeclared")


class _Query:
    """A question for the state of epoch 3."""

    def __init__(self, said: list[str]) -> None:
        self.parameters = {"epoch": "3"}
        self._said = said

    def __enter__(self) -> None:
        return None

    def __exit__(self, *_: object) -> None:
        return None

    def reply_err(self, text: str, **_: object) -> None:
        self._said.append(text)


def test_questions_for_the_state_are_refused_and_the_next_one_is_heard() -> None:
    """Each took one of four places with it: then nobody could wait for the state any more."""
    said: list[str] = []
    session = cast("Any", SimpleNamespace(declare_queryable=lambda *_, **__: None))
    book = StateBook()  # it has worked in no epoch: whoever asks has to wait
    offer = Offer(session, "state", lambda: b"state", Troubles(lambda *_: None), book)
    with no_threads():
        for _ in range(MAX_WAITING + 1):
            offer._hear(cast("Any", _Query(said)))
    assert said == ["can't start new thread"] * (MAX_WAITING + 1)
    assert offer._waiting.acquire(blocking=False)
