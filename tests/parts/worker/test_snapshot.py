"""Snapshots in chunks: whole or not at all; a new owner that gets none, or a bad one, never waits long."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import SnapshotChunk
from zsched.link.pipe.frames import encode_chunk
from zsched.link.sessions.config import client_config, data_config, worker_config
from zsched.worker import snapshot as worker_snapshot
from zsched.worker.snapshot import (
    CHUNK,
    MAX_SNAPSHOT,
    MAX_WAITING,
    Assembly,
    Offer,
    Restorer,
    StateBook,
    StateLink,
    chunks,
    fetch,
)
from zsched.worker.troubles import Troubles

PATIENCE_S = 60.0
KEY = "@zsched/test/snapshot/edge1/task"
SIZES = st.sampled_from([0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK, 3 * CHUNK + 7])


def content_of(size: int, seed: int = 1) -> bytes:
    return Random(seed).randbytes(size)


@given(SIZES, st.randoms(use_true_random=False))
def test_chunks_in_any_order_and_doubled_make_the_whole(size: int, random: Random) -> None:
    content = content_of(size)
    pieces = chunks(content) * 2
    random.shuffle(pieces)
    assembly = Assembly()
    wholes = [assembly.add(*piece) for piece in pieces]
    assert content in wholes
    assert set(wholes) <= {None, content}


@given(SIZES.filter(bool), st.integers(0, 10**9))
def test_one_wrong_bit_makes_no_whole(size: int, where: int) -> None:
    pieces = chunks(content_of(size))
    index = where % len(pieces)
    chunk, part = pieces[index]
    at = where % len(part)
    pieces[index] = (chunk, part[:at] + bytes([part[at] ^ 1]) + part[at + 1 :])
    assembly = Assembly()
    results = [assembly.add(*piece) for piece in pieces]
    assert isinstance(results[-1], str)
    assert "checksum" in results[-1]


def test_chunks_of_two_workers_do_not_mix() -> None:
    one, two = chunks(content_of(2 * CHUNK, 1)), chunks(content_of(2 * CHUNK, 2))
    assembly = Assembly()
    assert assembly.add(*one[0]) is None
    assert assembly.add(*two[1]) is None
    assert assembly.add(*one[1]) == content_of(2 * CHUNK, 1)


@pytest.mark.parametrize(
    ("index", "count", "size"), [(0, 2, 10), (1, 1, 10), (0, 1, MAX_SNAPSHOT + 1), (0, 0, 0), (0, 1, CHUNK + 1)]
)
def test_an_impossible_chunk_is_refused_before_anything_is_kept(index: int, count: int, size: int) -> None:
    chunk = SnapshotChunk(index=index, count=count, size=size, checksum="00")
    assert isinstance(Assembly().add(chunk, b"x"), str)


def test_pieces_of_a_wrong_size_and_of_a_third_state_are_refused() -> None:
    """Else a stranger could fill the memory of a new owner with pieces that fit no whole."""
    assembly = Assembly()
    (chunk, _), *_ = chunks(content_of(2 * CHUNK, 1))
    for part in (b"", b"x" * (CHUNK - 1), b"x" * (8 * CHUNK)):
        assert "bytes" in str(assembly.add(chunk, part))
    contested = []
    for seed in (1, 2):
        piece = chunks(content_of(2 * CHUNK, seed))[0]
        assert assembly.add(*piece) is None
        contested.append(assembly.is_contested)
    assert contested == [False, True]
    assert assembly.add(*chunks(content_of(2 * CHUNK, 3))[0]) == "too many different states"


# --- over zenoh ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    endpoint = free_endpoint()
    one = worker_config(connect=(), listen=(endpoint,), shared_memory=False)
    two = worker_config(connect=(endpoint,), shared_memory=False)
    with zenoh.open(zenoh.Config.from_json5(one)) as first, zenoh.open(zenoh.Config.from_json5(two)) as second:
        yield first, second


def never() -> bool:
    return False


def asked(
    session: zenoh.Session,
    timeout_s: float = PATIENCE_S,
    key: str = KEY,
    is_gone: Callable[[], bool] = never,
    *,
    epoch: int = 2,
) -> tuple[bytes | str, float]:
    started = time.monotonic()
    return fetch(session, key, epoch, timeout_s, is_gone), time.monotonic() - started


def ignored(_count: int, _text: str) -> None:
    """For an offer whose failures are not what is tested."""


def offered(
    session: zenoh.Session,
    key: str,
    snapshot: Callable[[], bytes | bytearray],
    tell: Callable[[int, str], None] = ignored,
    *,
    worked: int = 1,
    book: StateBook | None = None,
) -> Offer:
    """By a worker that was told to work in the epoch ``worked``."""
    book = book or StateBook()
    book.ready()
    book.work(worked)
    return Offer(session, key, snapshot, Troubles(tell), book)


def until_offered(session: zenoh.Session, key: str = KEY) -> None:
    querier = session.declare_querier(key)
    end = time.monotonic() + PATIENCE_S
    while not getattr(querier.matching_status, "matching", False):
        assert time.monotonic() < end, "the queryable is not seen"
        time.sleep(0.005)
    querier.undeclare()


def test_a_worker_that_is_there_before_its_relay_waits_for_it() -> None:
    endpoint = free_endpoint()
    text = worker_config(connect=(endpoint,), shared_memory=False)
    relays: list[zenoh.Session] = []
    listen = data_config(listen=(endpoint,), connect=(), shared_memory=False)
    late = threading.Timer(0.3, lambda: relays.append(opened(listen)))
    with opened(text) as main:
        late.start()
        link = StateLink(main, text)
        own = link.session
        assert own.zid() != main.zid(), "its own session, though the relay came later"
        link.close()
    late.join()
    relays[0].close()


def test_a_relay_that_comes_much_later_is_found_and_the_state_offered_through_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its port was taken for a while. A neighbour that is a client of the relay hears of no offer beside it."""
    monkeypatch.setattr(worker_snapshot, "RELAY_S", 0.2)
    endpoint = free_endpoint()
    text = worker_config(connect=(endpoint,), shared_memory=False)
    with opened(text) as main:
        link = StateLink(main, text)
        assert link.session is main
        offer = offered(link.session, KEY, lambda: b"state")
        with opened(data_config(listen=(endpoint,), connect=(), shared_memory=False)):
            own = link.session
            assert own is not main
            offer.offer_by(own)
            offer.offer_by(own)
            with opened(client_config(connect=(endpoint,), shared_memory=False)) as neighbour:
                until_offered(neighbour)
                assert asked(neighbour)[0] == b"state"
            offer.undeclare()
            link.close()


def test_a_large_snapshot_arrives_whole(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    content = content_of(8 * CHUNK + 5)
    offer = offered(sessions[0], KEY, lambda: content)
    until_offered(sessions[1])
    assert asked(sessions[1])[0] == content
    offer.undeclare()


def test_where_nobody_offers_one_the_answer_comes_at_once(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    reason, took_s = asked(sessions[1], key=f"{KEY}/nobody")
    assert reason == "nobody offers one"
    assert took_s < PATIENCE_S


@pytest.fixture
def silent(sessions: tuple[zenoh.Session, zenoh.Session]) -> Iterator[str]:
    """The key of a predecessor that is there, and never answers."""
    key = f"{KEY}/silent"
    queryable = sessions[0].declare_queryable(key, zenoh.handlers.FifoChannel(4))
    until_offered(sessions[1], key)
    yield key
    queryable.undeclare()


def test_a_silent_predecessor_is_waited_for_until_the_time_is_over(
    sessions: tuple[zenoh.Session, zenoh.Session], silent: str
) -> None:
    reason, took_s = asked(sessions[1], timeout_s=0.5, key=silent)
    assert reason == "no answer within 0.5 s"
    assert 0.5 <= took_s < PATIENCE_S


def test_a_silent_predecessor_whose_machine_is_gone_is_not_waited_for(
    sessions: tuple[zenoh.Session, zenoh.Session], silent: str
) -> None:
    gone = threading.Event()
    later = threading.Timer(0.2, gone.set)
    later.start()
    reason, took_s = asked(sessions[1], key=silent, is_gone=gone.is_set)
    assert reason == "its machine is gone"
    assert took_s < PATIENCE_S / 2
    later.join(PATIENCE_S)


def test_a_state_that_is_coming_is_taken_whatever_the_node_thinks_of_its_machine(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    """Its word is newer than the beats that are missing; if it dies, zenoh ends the query."""
    key, content, gone = f"{KEY}/long", content_of(2 * CHUNK), threading.Event()

    def snapshot() -> bytes:
        time.sleep(0.3)  # its first word is there long before
        gone.set()
        time.sleep(0.3)
        return content

    offer = offered(sessions[0], key, snapshot)
    until_offered(sessions[1], key)
    assert asked(sessions[1], key=key, is_gone=gone.is_set)[0] == content
    offer.undeclare()


def test_a_snapshot_that_does_not_follow_its_announcement_is_late(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    key = f"{KEY}/never"
    goes_on = threading.Event()
    offer = offered(sessions[0], key, lambda: bytes(goes_on.wait(PATIENCE_S)))
    until_offered(sessions[1], key)
    reason, took_s = asked(sessions[1], timeout_s=2.0, key=key)
    assert str(reason).startswith("late")
    assert took_s < PATIENCE_S
    goes_on.set()
    offer.undeclare()


def test_time_in_which_the_new_owner_does_not_run_is_no_silence() -> None:
    """Its machine stood still for a second, and all that was sent meanwhile comes right behind it."""
    sent: list[Exception | object] = [*[queue.Empty()] * 5, object()]
    got = iter(sent)

    class Replies:
        def get(self, timeout: float) -> object:
            time.sleep(timeout + 0.1)
            one = next(got)
            if isinstance(one, Exception):
                raise one
            return one

    reply = worker_snapshot._next_reply(Replies(), 0.3, time.monotonic() + PATIENCE_S, never)  # type: ignore[arg-type] # a queue of a machine that stands still
    assert reply is sent[-1]


def test_a_snapshot_that_stops_half_way_is_late(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    key = f"{KEY}/half"
    half = sessions[0].declare_queryable(key, zenoh.handlers.FifoChannel(4))
    until_offered(sessions[1], key)
    kept: list[zenoh.Query] = []

    def answer() -> None:
        query = half.handler.recv()
        chunk, part = chunks(content_of(2 * CHUNK))[0]
        query.reply(key, part, attachment=encode_chunk(chunk))
        kept.append(query)  # alive: the asker hears no end

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    reason, took_s = asked(sessions[1], timeout_s=4.0, key=key)
    assert str(reason).startswith("late")
    assert took_s < PATIENCE_S
    thread.join(PATIENCE_S)
    kept[0].drop()
    half.undeclare()


def test_a_bytearray_is_sent_as_it_is_when_it_is_given(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    key = f"{KEY}/bytearray"
    offer = offered(sessions[0], key, lambda: bytearray(content_of(CHUNK + 5)))
    until_offered(sessions[1], key)
    assert asked(sessions[1], key=key)[0] == content_of(CHUNK + 5)
    offer.undeclare()


@pytest.mark.parametrize(
    ("snapshot", "said"),
    [
        (lambda: bytes(MAX_SNAPSHOT + 1), "too large"),
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: sys.exit(3), "SystemExit"),
        (lambda: "text", "TypeError"),
        (lambda: None, "TypeError"),
        (dict, "TypeError"),
    ],
)
def test_a_snapshot_that_cannot_be_sent_is_refused_with_the_reason(
    sessions: tuple[zenoh.Session, zenoh.Session], snapshot: Callable[[], Any], said: str
) -> None:
    """A value of a wrong type was told as the worker's death, and its own node heard nothing."""
    key, told = f"{KEY}/bad", list[str]()
    offer = offered(sessions[0], key, snapshot, lambda _count, text: told.append(text))
    until_offered(sessions[1], key)
    assert said in str(asked(sessions[1], key=key)[0])
    offer.undeclare()
    if said != "too large":
        until(lambda: told, "the node hears of it")
        assert told[0].startswith(said)


def test_a_stranger_s_state_beside_the_predecessor_s_is_a_cold_start() -> None:
    """Nobody can tell which of the two is its own."""
    key = f"{KEY}-contested"
    endpoint = free_endpoint()
    with (
        zenoh.open(
            zenoh.Config.from_json5(worker_config(connect=(), listen=(endpoint,), shared_memory=False))
        ) as asker,
        zenoh.open(zenoh.Config.from_json5(worker_config(connect=(endpoint,), shared_memory=False))) as worker,
        zenoh.open(zenoh.Config.from_json5(worker_config(connect=(endpoint,), shared_memory=False))) as stranger,
    ):
        offer = offered(worker, key, lambda: content_of(50, 1))
        until_offered(asker, key)
        assert asked(asker, key=key)[0] == content_of(50, 1)
        false = offered(stranger, key, lambda: content_of(50, 2))
        until(lambda: asked(asker, key=key)[0] == "contested: two different states are offered", "both to be asked")
        for one in (offer, false):
            one.undeclare()


def test_who_waits_for_a_state_itself_answers_behind_it_and_an_older_question_at_once(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    """The owner again (epoch 3) is asked by the owner in between (epoch 2), which it asks itself."""
    (worker, asker), key, book, states = sessions, f"{KEY}/chain", StateBook(), [b"before"]
    offer = offered(worker, key, lambda: states[0], book=book)
    until_offered(asker, key)
    book.work(3)
    book.expect(3)
    later: queue.SimpleQueue[bytes | str] = queue.SimpleQueue()
    for _ in range(2):
        threading.Thread(target=lambda: later.put(asked(asker, key=key, epoch=4)[0]), daemon=True).start()
    assert asked(asker, key=key, epoch=2)[0] == b"before"
    assert later.empty()
    states[0] = b"behind"
    book.begun(3, is_cold=False)
    assert [later.get(timeout=PATIENCE_S) for _ in range(2)] == [b"behind", b"behind"]
    offer.undeclare()


def test_however_many_questions_wait_one_that_need_not_is_answered_at_once(
    sessions: tuple[zenoh.Session, zenoh.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    (worker, asker), key, book = sessions, f"{KEY}/many", StateBook()
    monkeypatch.setattr(worker_snapshot, "TOLD_S", 2.0)
    offer = offered(worker, key, lambda: b"state", worked=1, book=book)
    until_offered(asker, key)
    later: queue.SimpleQueue[bytes | str] = queue.SimpleQueue()
    for _ in range(MAX_WAITING + 2):
        threading.Thread(target=lambda: later.put(asked(asker, key=key, epoch=9)[0]), daemon=True).start()
    assert [later.get(timeout=1.0) for _ in range(2)] == ["refused: too many questions wait"] * 2
    content, took_s = asked(asker, key=key, epoch=2)
    assert content == b"state"
    assert took_s < 1.0
    refusal = "refused: its worker was not the owner of epoch 8"
    assert [later.get(timeout=PATIENCE_S) for _ in range(MAX_WAITING)] == [refusal] * MAX_WAITING
    offer.undeclare()


def book_of(worked: int, *, begun: int = 0) -> StateBook:
    """Of a worker that is ready, and began ``begun`` with a state."""
    book = StateBook()
    book.ready()
    if begun:
        book.begun(begun, is_cold=False)
    book.work(worked)
    return book


def settling(book: StateBook, epoch: int) -> queue.SimpleQueue[str]:
    """What it says to a question that waits."""
    said: queue.SimpleQueue[str] = queue.SimpleQueue()
    assert book.must_wait(epoch)
    threading.Thread(target=lambda: said.put(book.settle(epoch)), daemon=True).start()
    return said


@pytest.mark.parametrize("ends", [lambda book: book.begun(3, is_cold=True), lambda book: book.expect(5)])
def test_who_did_not_get_the_state_itself_does_not_hand_on_an_empty_one(ends: Callable[[StateBook], None]) -> None:
    book = book_of(3)
    book.expect(3)
    said = settling(book, 4)
    ends(book)
    assert said.get(timeout=PATIENCE_S) == "its worker has not got the state of epoch 3 itself"


def test_who_had_a_state_before_goes_on_with_it_and_hands_that_on() -> None:
    """A, the owner again, whom B could give nothing: what A has is the task's state."""
    book = book_of(3, begun=1)
    book.expect(3)
    said = settling(book, 4)
    book.begun(3, is_cold=True)
    assert said.get(timeout=PATIENCE_S) == ""


@pytest.mark.parametrize("begun", [0, 1])
def test_a_state_that_was_overtaken_on_its_way_is_missing_until_a_newer_epoch_begins(begun: int) -> None:
    """A -> B -> A -> B while B still waits for A's first state: what B has must not replace what A has."""
    book = book_of(2, begun=begun)
    book.expect(2)
    book.work(4)
    book.expect(4)
    assert book.settle(3) == "its worker has not got the state of epoch 2 itself"
    assert book.settle(2) == "", "of the epoch before nothing is missing"
    said = settling(book, 5)
    book.begun(4, is_cold=False)
    assert said.get(timeout=PATIENCE_S) == ""
    assert book.settle(5) == ""


def test_one_that_began_cold_hands_its_state_on_later() -> None:
    """What it has made since is the task's state."""
    book = book_of(3)
    book.expect(3)
    book.begun(3, is_cold=True)
    assert not book.must_wait(4)
    assert book.settle(4) == ""


def test_one_that_is_not_ready_has_not_said_whether_it_takes_a_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_snapshot, "TOLD_S", 0.05)
    book = StateBook()
    book.work(3)
    assert book.settle(4) == "its worker is not ready"
    monkeypatch.setattr(worker_snapshot, "TOLD_S", PATIENCE_S)
    said = settling(book, 4)
    book.ready()
    assert said.get(timeout=PATIENCE_S) == ""


def test_a_question_without_an_epoch_waits_for_whatever_comes() -> None:
    """It is an older version's."""
    book = book_of(3)
    assert not book.must_wait(None)
    assert book.settle(None) == ""
    book.expect(3)
    assert book.must_wait(None)
    book.begun(3, is_cold=False)
    assert not book.must_wait(None)


def test_garbage_is_corrupt(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    key = f"{KEY}/garbage"
    liar = sessions[0].declare_queryable(key, lambda query: query.reply(key, b"state", attachment=b"what"))
    until_offered(sessions[1], key)
    assert str(asked(sessions[1], key=key)[0]).startswith("corrupt")
    liar.undeclare()


# --- who waits, and for what -----------------------------------------------------------------------------------------


class Inputs:
    """Notes what the restorer does with the inputs."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def hold(self) -> None:
        self.said.append("hold")

    def release(self, first: object) -> None:
        assert callable(first)
        first()
        self.said.append("release")


def active(epoch: int, predecessor: str | None = "edge1") -> Role:
    return Role(task="t", role=WorkerRole.ACTIVE, epoch=epoch, predecessor=predecessor)


def restored(
    answer: bytes | str, role: Role, tell: Callable[[str], None] = lambda _text: None
) -> tuple[Restorer, Inputs, list[bytes]]:
    inputs, got = Inputs(), list[bytes]()
    done: queue.SimpleQueue[None] = queue.SimpleQueue()
    restorer = Restorer(lambda _node, _epoch, _timeout_s, _is_gone: answer, "edge2", inputs, tell, StateBook())
    restorer.register(got.append, 1.0)
    restorer.note(role)
    if restorer.begin(role, lambda: done.put(None)):
        assert restorer.is_pending
        restorer.deliver(role.epoch)  # nothing yet, or already there: either way no harm
        done.get(timeout=PATIENCE_S)
        restorer.deliver(role.epoch)
    return restorer, inputs, got


def test_the_snapshot_is_delivered_before_the_inputs_go_on() -> None:
    restorer, inputs, got = restored(b"state", active(3))
    assert (got, inputs.said, restorer.is_pending) == ([b"state"], ["hold", "release"], False)
    assert (restorer.restored, restorer.cold_starts) == (1, 0)


def test_without_one_the_inputs_go_on_and_it_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    restorer, inputs, got = restored("nobody offers one", active(3))
    assert (got, inputs.said, restorer.is_pending) == ([], ["hold", "release"], False)
    assert (restorer.restored, restorer.cold_starts) == (0, 1)
    assert "cold_start epoch=3 from=edge1 why='nobody offers one'" in caplog.text


@pytest.mark.parametrize(
    "role",
    [
        active(3, None),
        active(3, "edge2"),
        Role(task="t", role=WorkerRole.IDLE),
        Role(task="t", role=WorkerRole.DRAINING, epoch=3),
    ],
)
def test_nothing_waits_where_there_is_nobody_to_ask(role: Role) -> None:
    restorer, inputs, got = restored(b"state", role)
    assert (got, inputs.said, restorer.is_pending) == ([], [], False)


def test_one_epoch_is_restored_once() -> None:
    restorer, inputs, got = restored(b"state", active(3))
    restorer.note(active(3))
    assert restorer.begin(active(3), lambda: None) is False
    assert (len(got), inputs.said) == (1, ["hold", "release"])


def test_who_asks_again_while_the_state_is_on_its_way_waits_too() -> None:
    """A lease that is renewed is another role of the same epoch: no reason to work without the state."""
    inputs = Inputs()
    comes, then = threading.Event(), threading.Event()

    def late(_node: str, _epoch: int, _timeout_s: float, _is_gone: Callable[[], bool]) -> bytes:
        comes.wait(PATIENCE_S)
        return b"state"

    restorer = Restorer(late, "edge2", inputs, list[str]().append, StateBook())
    restorer.register(lambda _content: None, 1.0)
    restorer.note(active(3))
    assert restorer.begin(active(3), then.set)
    assert restorer.begin(active(3), then.set)
    comes.set()
    assert then.wait(PATIENCE_S)
    assert restorer.begin(active(3), then.set) is False


def test_a_role_without_the_predecessor_of_before_ends_the_wait_of_its_epoch_alone() -> None:
    asked, goes_on, then = list[Callable[[], bool]](), threading.Event(), threading.Event()

    def silent(_node: str, _epoch: int, _timeout_s: float, is_gone: Callable[[], bool]) -> str:
        asked.append(is_gone)
        goes_on.wait(PATIENCE_S)
        return "its machine is gone"

    restorer = Restorer(silent, "edge2", Inputs(), list[str]().append, StateBook())
    restorer.register(lambda _content: None, 1.0)
    restorer.note(active(3))
    assert restorer.begin(active(3), lambda: None)
    until(lambda: asked, "the question of epoch 3")
    restorer.note(active(2, None))
    restorer.note(Role(task="t", role=WorkerRole.DRAINING, epoch=3))
    assert not asked[0](), "another epoch, and another role, say nothing of it"
    restorer.note(active(3, None))
    assert asked[0]()
    restorer.note(active(4))
    assert restorer.begin(active(4), then.set)
    until(lambda: len(asked) == 2, "the question of epoch 4")
    assert not asked[1]()
    goes_on.set()
    assert then.wait(PATIENCE_S)


def test_a_state_that_has_come_waits_until_its_own_epoch_begins() -> None:
    """The wait of an epoch that is over ends just then: inputs would go on before this one has begun."""
    inputs, got = Inputs(), list[bytes]()
    goes_on, later = threading.Event(), threading.Event()

    def asked(_node: str, epoch: int, _timeout_s: float, _is_gone: Callable[[], bool]) -> bytes:
        assert epoch == 5 or goes_on.wait(PATIENCE_S)
        return f"of {epoch}".encode()

    restorer = Restorer(asked, "edge2", inputs, list[str]().append, StateBook())
    restorer.register(got.append, 1.0)
    for epoch, then in ((3, lambda: None), (5, later.set)):
        restorer.note(active(epoch))
        assert restorer.begin(active(epoch), then)
    assert later.wait(PATIENCE_S)
    goes_on.set()
    restorer.deliver(3)
    assert (got, restorer.is_pending, "release" in inputs.said) == ([], True, False)
    restorer.deliver(5)
    assert (got, restorer.is_pending) == ([b"of 5"], False)


def test_the_next_epoch_s_hold_is_not_undone_by_the_state_of_the_one_before() -> None:
    """It came between the moment in which that state was taken and the one in which the inputs went on."""
    inputs, later = Inputs(), list[threading.Thread]()
    restorer = Restorer(lambda *_: b"state", "edge2", inputs, list[str]().append, StateBook())
    restorer.register(lambda _content: None, 1.0)
    restorer.note(active(3))
    has_come = threading.Event()
    assert restorer.begin(active(3), has_come.set)
    assert has_come.wait(PATIENCE_S)
    release = inputs.release

    def released(first: object) -> None:
        later.append(threading.Thread(target=restorer.note, args=(active(5),)))
        later[0].start()
        later[0].join(0.3)
        release(first)

    inputs.release = released  # type: ignore[method-assign]
    restorer.deliver(3)
    later[0].join(PATIENCE_S)
    assert (inputs.said, restorer.is_pending) == (["hold", "release", "hold"], True)


@pytest.mark.parametrize("error", [MemoryError("32 MiB"), zenoh.ZError("closed"), RuntimeError("no thread")])
def test_a_wait_that_fails_is_a_cold_start_and_no_worker_that_stands_still(error: Exception) -> None:
    def fails(_node: str, _epoch: int, _timeout_s: float, _is_gone: Callable[[], bool]) -> bytes:
        raise error

    inputs, told, then = Inputs(), list[str](), threading.Event()
    restorer = Restorer(fails, "edge2", inputs, told.append, StateBook())
    restorer.register(lambda _content: None, 1.0)
    restorer.note(active(3))
    assert restorer.begin(active(3), then.set)
    assert then.wait(PATIENCE_S), "the worker hears of its end"
    restorer.deliver(3)
    assert (restorer.is_pending, inputs.said) == (False, ["hold", "release"])
    assert told == [f"began epoch 3 without the state of edge1: failed: {type(error).__name__}: {error}"]


def test_where_there_is_no_thread_to_wait_in_the_caller_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(_self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    inputs, got, then = Inputs(), list[bytes](), threading.Event()
    restorer = Restorer(lambda *_: b"state", "edge2", inputs, list[str]().append, StateBook())
    restorer.register(got.append, 1.0)
    restorer.note(active(3))
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", none)
        assert restorer.begin(active(3), then.set)
    assert then.is_set()
    restorer.deliver(3)
    assert (got, restorer.is_pending) == ([b"state"], False)


async def _restore_later() -> None:
    raise AssertionError("it is never run")


@pytest.mark.parametrize("why", ["nobody offers one", "its machine is gone", "late: x", "no answer within 2 s"])
def test_the_node_hears_of_every_state_that_is_lost(why: str) -> None:
    told: list[str] = []
    restored(why, active(3), told.append)
    assert told == [f"began epoch 3 without the state of edge1: {why}"]


def test_one_that_is_told_too_late_that_it_was_the_owner_restores_all_the_same() -> None:
    """It drains already: who follows it asks it for the state."""
    role = Role(task="t", role=WorkerRole.DRAINING, epoch=3, predecessor="edge1")
    restorer, inputs, got = restored(b"state", role)
    assert (got, inputs.said, restorer.is_pending) == ([b"state"], ["hold", "release"], False)


@pytest.mark.parametrize("fail", [lambda: 1 / 0, lambda: sys.exit(3), _restore_later])
def test_a_callback_that_fails_is_a_cold_start(fail: Callable[[], object]) -> None:
    inputs, told = Inputs(), list[str]()
    restorer = Restorer(lambda _node, _epoch, _timeout_s, _is_gone: b"state", "edge2", inputs, told.append, StateBook())
    restorer.register(lambda _content: fail(), 1.0)  # type: ignore[arg-type] # it fails on purpose
    restorer.note(active(3))
    restorer.begin(active(3), lambda: restorer.deliver(3))
    until(lambda: told, "the node hears of it")
    assert not restorer.is_pending
    assert restorer.cold_starts == 1
    assert told == ["began epoch 3 without the state of edge1: its own on_snapshot failed"]
