"""One service at a time on real sessions: what a request is told, and counted as, before any owner sees it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values.plan import Direction, Route, ServiceSettings, StreamSettings
from zsched.core.values.relay_protocol import REFUSED_ENCODING, ServiceProblem
from zsched.core.values.struct import replace
from zsched.relay.services import service
from zsched.relay.services.replies import Replies
from zsched.relay.services.service import Services

SERVICE = Route(
    stream="t/srv/0",
    direction=Direction.SERVICE,
    from_expr="robot1/job",
    to_expr="edge1/t/robot1/job",
    settings=StreamSettings(),
    service=ServiceSettings(hold_s=0.0, max_pending=1),
)


class Bench:
    """A relay's services, and one who asks."""

    def __init__(self, relay: zenoh.Session, outside: zenoh.Session) -> None:
        self.services, self.outside = Services(relay), outside
        self.asker = outside.declare_querier(SERVICE.from_expr, timeout=20.0)

    def open(self, route: Route = SERVICE) -> None:
        self.services.open(1, route)
        until(lambda: matches(self.asker), "the service is there")

    def ask(self) -> list[str]:
        """The errors that one request gets; it is put again where it reached nobody (the service was just declared)."""
        errors: list[str] = until(self._ask, "an answer")
        return errors

    def _ask(self) -> list[str]:
        return [reply.err.payload.to_string() for reply in self.asker.get() if reply.err is not None]


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hub_and_neighbour() as (relay, outside):
        made = Bench(relay, outside)
        yield made
        made.services.keep(set())


def test_a_request_for_which_no_thread_begins_is_answered_and_takes_nobodys_place(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refused(threading.Thread):
        def start(self) -> None:
            raise RuntimeError("can't start new thread")

    bench.open()
    with monkeypatch.context() as patched:
        patched.setattr(service, "guarded", lambda *_args, **_named: Refused())
        for _ in range(2):
            assert bench.ask() == ["busy: can't start new thread: it was not done"]
    assert bench.ask() == ["no owner: nobody serves robot1/job: it was not done"]


def test_a_request_whose_session_is_closed_beneath_it_goes_out_by_the_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had its owner before the data session was opened anew, and was not counted as under way yet."""
    send, refused = Replies.send, [zenoh.ZError("session closed")]

    def send_then(replies: Replies, *words: Any, **request: Any) -> None:
        if refused:
            raise refused.pop()
        send(replies, *words, **request)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(SERVICE.to_expr, "done")

    monkeypatch.setattr(Replies, "send", send_then)
    bench.open(replace(SERVICE, service=ServiceSettings(hold_s=10.0)))
    owner = bench.outside.declare_queryable(SERVICE.to_expr, answer)
    bench.services.flip(1)
    replies: list[zenoh.Reply] = until(lambda: list(bench.asker.get()), "a reply")
    assert [reply.ok.payload.to_string() for reply in replies if reply.ok is not None] == ["done"]
    assert dict(bench.services.counts()[0].drops) == {"retried": 1}
    owner.undeclare()


def asked(bench: Bench) -> tuple[threading.Thread, list[str]]:
    """A request that waits, and what it gets."""
    heard: list[str] = []

    def ask() -> None:
        heard.extend(bench.ask())

    before = sum(count.messages for count in bench.services.counts())
    thread = threading.Thread(target=ask)
    thread.start()
    until(lambda: sum(count.messages for count in bench.services.counts()) > before, "the relay has it")
    return thread, heard


def test_an_asker_that_takes_no_refusal_holds_up_nobody_else(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was refused in zenoh's thread: with its link full, all requests behind it waited."""
    fail, go_on = service.ServiceStream._fail, threading.Event()

    def refuse(stream: service.ServiceStream, query: zenoh.Query, problem: ServiceProblem, text: str) -> None:
        if problem is ServiceProblem.BUSY:
            go_on.wait(60)
        fail(stream, query, problem, text)

    monkeypatch.setattr(service.ServiceStream, "_fail", refuse)
    bench.open(replace(SERVICE, service=ServiceSettings(hold_s=5.0, max_pending=1)))
    try:
        first, stalled, behind = (asked(bench) for _ in range(3))
    finally:
        go_on.set()
    for thread, _ in (first, stalled, behind):
        thread.join(30.0)
    assert [heard[0].partition(":")[0] for _, heard in (first, stalled, behind)] == ["no owner", "busy", "busy"]


def test_a_request_for_which_nobody_is_there_any_more_is_told_so_and_counted_with_its_service(bench: Bench) -> None:
    """It waited on for an owner that a service that is closed cannot get, and was counted where nobody looks."""
    bench.open(replace(SERVICE, service=ServiceSettings(hold_s=5.0)))
    thread, heard = asked(bench)
    bench.open()
    (count,) = bench.services.counts()
    assert (count.messages, dict(count.drops)) == (1, {"no_owner": 1})
    thread.join(2.0)
    assert heard == ["no owner: nobody serves robot1/job: it was not done"]


@pytest.mark.parametrize("retry", [False, True])
def test_a_request_at_an_owner_may_have_been_done_whoever_is_asked_next(bench: Bench, *, retry: bool) -> None:
    """The next owner never came: it was said that nobody had it, and it was not done."""
    held: list[zenoh.Query] = []
    bench.open(replace(SERVICE, service=ServiceSettings(retry=retry, timeout_s=1.0)))
    owner = bench.outside.declare_queryable(SERVICE.to_expr, held.append)
    bench.services.flip(1)
    thread, heard = asked(bench)
    until(lambda: bool(held), "the owner has it")
    bench.services.close_slot(1)
    thread.join(10.0)
    assert heard == ["moved: the task has left edge1/t/robot1/job, which had not answered; it may have been done"]
    owner.undeclare()
    for query in held:
        query.drop()


def test_a_request_that_an_owner_had_may_have_been_done_though_the_next_ones_refuse_it(bench: Bench) -> None:
    """Refused until its time was over, it was said that it was not done."""
    held: list[zenoh.Query] = []
    rule = replace(SERVICE, service=ServiceSettings(retry=True, timeout_s=1.0))
    bench.open(rule)
    owner = bench.outside.declare_queryable(SERVICE.to_expr, held.append)
    bench.services.flip(1)
    thread, heard = asked(bench)
    until(lambda: bool(held), "the owner has it")
    refuses = bench.outside.declare_queryable(
        "edge2/t/robot1/job", lambda query: query.reply_err("not now", encoding=REFUSED_ENCODING)
    )
    bench.services.open(2, replace(rule, to_expr="edge2/t/robot1/job"))
    bench.services.flip(2)
    bench.services.close_slot(1)
    thread.join(10.0)
    assert [text.partition(":")[0] for text in heard] == ["moved"]
    assert heard[0].endswith("it may have been done")
    owner.undeclare()
    refuses.undeclare()
    for query in held:
        query.drop()


def test_the_counters_of_a_service_go_on_when_its_rule_changes(bench: Bench) -> None:
    for number, hold_s in enumerate((0.0, 0.01, 0.0), start=1):
        bench.open(replace(SERVICE, service=ServiceSettings(hold_s=hold_s)))
        bench.ask()
        (count,) = bench.services.counts()
        assert (count.messages, dict(count.drops)) == (number, {"no_owner": number})
    bench.services.keep(set())
    assert bench.services.counts() == ()
    bench.open()
    assert bench.services.counts()[0].messages == 3


@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        ("robot1/a/job", ["robot1/a/job"]),
        ("robot1/*/job", ["robot1/a/job", "robot1/b/job"]),
        ("robot1/**", ["robot1/a/job", "robot1/b/job"]),
    ],
)
def test_who_asks_for_several_keys_gets_the_answer_of_each(bench: Bench, asked: str, answered: list[str]) -> None:
    """Under keys of their own: of two answers under one key zenoh hands the asker the last."""

    def answer(key: str, query: zenoh.Query) -> None:
        with query:
            query.reply(key, key)

    route = replace(SERVICE, from_expr="robot1/*/job", to_expr="edge1/t/*/job", service=ServiceSettings())
    keys = [f"edge1/t/{name}/job" for name in ("a", "b")]
    owner = [bench.outside.declare_queryable(key, partial(answer, key)) for key in keys]
    bench.services.open(1, route)
    bench.services.flip(1)

    def ask() -> list[tuple[str, str]]:
        replies = [reply.ok for reply in bench.outside.get(asked, timeout=20.0)]
        return sorted((str(ok.key_expr), ok.payload.to_string()) for ok in replies if ok is not None)

    found: list[tuple[str, str]] = until(ask, "answers")
    assert found == [(key, key.replace("robot1", "edge1/t")) for key in answered]
    for one in owner:
        one.undeclare()


def test_an_answer_whose_key_cannot_be_brought_back_is_given_under_the_key_that_was_asked_for(bench: Bench) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("edge1/t/job", "done")

    route = replace(SERVICE, from_expr="robot1/*/job", to_expr="edge1/t/job", service=ServiceSettings())
    owner = bench.outside.declare_queryable("edge1/t/job", answer)
    bench.services.open(1, route)
    bench.services.flip(1)
    replies: list[zenoh.Reply] = until(lambda: list(bench.outside.get("robot1/*/job", timeout=20.0)), "an answer")
    assert [str(reply.ok.key_expr) for reply in replies if reply.ok is not None] == ["robot1/*/job"]
    owner.undeclare()
