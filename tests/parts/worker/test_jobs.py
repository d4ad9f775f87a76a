"""A worker's own clock: what it counts of its jobs, how often it tells, and what its node believes."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.events import FrameDropped, WorkerJobs
from zsched.core.values.relay_protocol import WorkerTrouble
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import Keyspace
from zsched.relay.troubles import PAUSE_S, Troubles, Word
from zsched.worker import jobs as worker_jobs
from zsched.worker.inputs import Dispatcher
from zsched.worker.jobs import TELL_S, JobBook, JobTimer
from zsched.worker.keep import Debts
from zsched.worker.samples import Input, Received

KEYS = Keyspace("test")
WORD = WorkerJobs(task="t", incarnation="7", at_s=3.0, done=4)


def burn(cpu_s: float) -> None:
    end = time.thread_time() + cpu_s
    while time.thread_time() < end:
        pass


def test_a_job_s_time_holds_its_cpu_time_and_what_it_slept() -> None:
    timer = JobTimer(deadline_s=0.05)
    for pause_s in (0.0, 0.04):
        timer.begin()
        burn(0.02)
        time.sleep(pause_s)
        timer.end(came_s=time.monotonic() - 0.01 - 2 * pause_s)
    assert timer.done == 2
    assert 0.04 <= timer.cpu_s < 0.06
    assert timer.time_s >= timer.cpu_s + 0.039
    assert timer.late >= 1
    assert not timer.is_in_hand


def test_the_kernel_tells_how_long_a_job_waited_for_a_cpu() -> None:
    """Two threads of two processes cannot be made to share a CPU here; but what is told only rises, and is less."""
    timer = JobTimer()
    assert timer.waited_s() == 0.0
    timer.begin()
    burn(0.05)
    timer.end()
    waited_s = timer.waited_s()
    assert waited_s is None or 0.0 <= waited_s <= timer.time_s - timer.cpu_s + 0.02


def test_what_a_thread_has_waited_stays_behind_its_end_and_its_successor_s_is_added(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A new thread may have the identity of one that has ended, and so its timer."""
    waits, running = {1: 5.0}, [1]
    monkeypatch.setattr(worker_jobs, "_waited_s", waits.get)
    monkeypatch.setattr(threading, "get_native_id", lambda: running[0])
    timer = JobTimer()
    timer.begin()
    timer.end()
    waits[1] = 7.0
    assert timer.waited_s() == 2.0
    del waits[1]
    assert timer.waited_s() == 2.0
    running[0], waits[2] = 2, 1.0
    timer.begin()
    timer.end()
    waits[2] = 1.5
    assert timer.waited_s() == 2.5


def test_what_a_long_job_waits_for_a_cpu_counts_when_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean per job is one rate through another: a wait that comes seconds before its job has faded by then."""
    waits = {1: 5.0}
    monkeypatch.setattr(worker_jobs, "_waited_s", waits.get)
    monkeypatch.setattr(threading, "get_native_id", lambda: 1)
    timer = JobTimer()
    timer.begin()
    timer.end()
    assert timer.waited_s() == 0.0
    timer.begin()
    for told in (6.0, 7.0, 8.0):
        waits[1] = told
        assert timer.waited_s() == 0.0
    timer.end()
    del waits[1]  # and it is told of a thread that has ended, as far as it was seen
    assert timer.waited_s() == 3.0


def test_a_job_in_a_thread_that_has_ended_leaves_the_waiting_time_known() -> None:
    book = JobBook("t", "7", lambda _word: None)

    def work() -> None:
        with book.job(skipped=0, came_s=None):
            pass

    work()
    is_told = book.report().wait_s is not None  # by this kernel
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert (book.report().wait_s is not None) == is_told
    book.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"came_s": time.time}, "of time.monotonic, not time.time"),
        ({"came_s": lambda: float("nan")}, "of time.monotonic"),
        ({"skipped": lambda: -1}, "whole number"),
        ({"skipped": lambda: 0.5}, "whole number"),
    ],
)
def test_a_job_of_the_future_or_that_skipped_what_cannot_be_is_refused(
    options: dict[str, Callable[[], Any]], said: str
) -> None:
    """One of them ended all reports of the worker's life: there was no hang detection any more, and no demand."""
    book = JobBook("t", "7", lambda _word: None)
    with pytest.raises(ValueError, match=said):
        book.job(**{"skipped": 0, "came_s": None} | {name: value() for name, value in options.items()})
    assert (book.report().done, book.report().skipped) == (0, 0)
    book.close()


def test_helpers_in_other_threads_are_part_of_a_job() -> None:
    """hashlib lets go of Python's lock: three threads compute at the same time."""
    import hashlib

    data, timer = bytes(8 << 20), JobTimer()

    def job() -> None:
        helpers = [threading.Thread(target=lambda: hashlib.sha256(data).digest()) for _ in range(3)]
        for helper in helpers:
            helper.start()
        for helper in helpers:
            helper.join()
        burn(0.002)

    for _ in range(3):
        timer.begin()
        job()
        timer.end()
        timer.look_for_helpers()
    assert timer.is_parallel
    alone = timer.cpu_s
    timer.begin()
    job()
    timer.end()
    assert timer.cpu_s - alone > 0.008, "the helpers' time counts"


def test_jobs_of_several_threads_are_no_helpers_of_each_other() -> None:
    """Each booked the whole process: three busy threads told three times their CPU time."""
    import hashlib

    data, book = bytes(8 << 20), JobBook("t", "7", lambda _word: None)
    spent_s = []

    def work() -> None:
        for _ in range(12):
            with book.job(skipped=0, came_s=None):
                hashlib.sha256(data).digest()  # which lets go of Python's lock
        spent_s.append(time.thread_time())

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        book.report()
        time.sleep(0.01)
    report = book.report()
    book.close()
    assert report.done == 36
    assert report.cpu_s == pytest.approx(sum(spent_s), rel=0.2)


def test_the_node_is_told_while_there_is_work_and_twice_behind_it() -> None:
    told: list[tuple[float, WorkerJobs]] = []
    book = JobBook("t", "7", lambda word: told.append((time.monotonic(), word)))
    with book.job(skipped=2, came_s=None):
        until(lambda: len(told) >= 3, "a job that takes long is told of")
        assert {word.done for _, word in told} == {0}
    until(lambda: [word.is_idle for _, word in told[-2:]] == [True, True], "its end, twice: a word may be lost")
    assert [(word.done, word.skipped) for _, word in told[-2:]] == [(1, 2)] * 2
    assert [word.is_idle for _, word in told].count(True) == 2
    count = len(told)
    time.sleep(4 * TELL_S)
    assert len(told) == count, "nothing is said of nothing"
    with book.job(skipped=0, came_s=None):
        pass
    until(lambda: told[-1][1].done == 2, "it wakes up again")
    assert min(later - earlier for (earlier, _), (later, _) in itertools.pairwise(told)) > TELL_S / 2
    book.close()


def test_from_the_author_s_first_job_on_callbacks_are_none_and_sums_only_rise() -> None:
    told: list[WorkerJobs] = []
    book = JobBook("t", "7", told.append)
    callback = book.timer()
    callback.begin()
    callback.end()
    book.wake()
    until(lambda: told and told[-1].done == 1, "the callback")
    for _ in range(3):
        with book.job(skipped=0, came_s=None):
            callback.begin()
            callback.end()
    until(lambda: told[-1].done == 4, "one and three")
    book.close()


def test_the_dispatcher_times_its_callbacks_and_counts_what_waits_and_gives_way() -> None:
    told: list[WorkerJobs] = []
    book = JobBook("t", "7", told.append, deadline_s=0.05)
    dispatcher = Dispatcher(
        lambda _epoch: None, cast("Acknowledger", None), cast("Any", None), cast("Debts", None), book
    )
    dispatcher.start()
    gate, begun = threading.Event(), threading.Event()

    def hold(_sample: Received) -> None:
        begun.set()
        gate.wait(20.0)
        burn(0.005)

    every, newest = Input(on_sample=hold, keep_last=None), Input(on_sample=hold, keep_last=1)
    with hub_and_neighbour() as (hub, neighbour):
        kept = [
            hub.declare_subscriber("every", partial(dispatcher.put, every)),
            hub.declare_subscriber("newest", partial(dispatcher.put, newest)),
        ]
        publishers = {key: neighbour.declare_publisher(key) for key in ("every", "newest")}
        for publisher in publishers.values():
            until(partial(matches, publisher), "they match")
        publishers["every"].put("x")
        until(begun.is_set, "one is in hand")
        for _ in range(4):
            publishers["every"].put("x")
            publishers["newest"].put("x")
        until(lambda: newest.shed == 3, "of the newest one waits")
        until(lambda: told and told[-1].waiting == 5, "four, and one")
        assert (told[-1].done, told[-1].skipped) == (0, 3)
        gate.set()
        until(lambda: told[-1].done == 6, "all are done")
        until(lambda: told[-1].waiting == 0, "and nothing waits")
        kept.clear()
    last = told[-1]
    assert 0.03 <= last.cpu_s < 0.2
    assert last.age_s is not None
    assert last.age_s > last.time_s, "who waited is older than its job took"
    assert last.late is not None
    assert last.late >= 5
    dispatcher.close()
    book.close()


def test_the_relay_hands_on_every_worker_s_word_and_counts_garbage() -> None:
    heard: list[Word] = []
    with hub_and_neighbour() as (hub, neighbour):
        kept = [Troubles(hub, KEYS, "edge1", heard.append)]
        until(partial(matches, neighbour.declare_publisher(KEYS.trouble("edge1", "t", "7"))), "the relay listens")
        say = neighbour.put
        say(KEYS.trouble("edge1", "t", "7"), wire.encode(WORD))
        say(KEYS.trouble("edge1", "u", "9"), wire.encode(WorkerJobs(task="u", incarnation="9", at_s=1.0, done=1)))
        say(KEYS.trouble("edge1", "t", "7"), wire.encode(WorkerTrouble(task="t", incarnation="7", count=1, text="x")))
        until(lambda: len(heard) == 3, "two workers, and two words of one, within a moment")
        say(KEYS.trouble("edge1", "t", "7"), b"\x00 garbage")
        until(lambda: FrameDropped(kind="trouble", reason="garbage") in heard, "garbage is counted")
        time.sleep(PAUSE_S)
        say(KEYS.trouble("edge1", "t", "8"), wire.encode(WORD))
        until(lambda: FrameDropped(kind="trouble", reason="foreign") in heard, "and one worker's word at another's key")
        time.sleep(PAUSE_S)
        before = len(heard)
        for _ in range(500):
            say(KEYS.trouble("edge1", "t", "7"), wire.encode(WORD))
            say(KEYS.trouble("edge1", "t", "7"), b"garbage")
        time.sleep(0.5)
        assert 1 <= len(heard) - before < 50, "a flood is no work for the daemon"
        kept.clear()


@pytest.mark.parametrize("incarnation", ["7", "8"])
def test_only_the_running_worker_s_word_is_believed(incarnation: str) -> None:
    from zsched.runtime.crew import Crew

    crew = Crew(lambda _event: None)
    crew.on_started("t", 4711, 7)
    assert crew.is_ours(WorkerJobs(task="t", incarnation=incarnation, at_s=1.0, done=1)) == (incarnation == "7")
    assert crew.is_ours(WorkerJobs(task="somebody_elses", incarnation="1", at_s=1.0, done=1))
