"""When a silent relay is wedged: never for want of a processor, and only for time in which somebody listened."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from support.waiting import until
from zsched.runtime.relay import silence as relay_silence
from zsched.runtime.relay.silence import LOOK_S, WORK_S, Silence, is_idle, processor_s, waited_s

PATIENCE_S = 1.5


class Process:
    """What /proc says of the relay."""

    def __init__(self) -> None:
        self.had_s: float | None = 3.0
        self.waited_s = 2.0
        self.is_idle = False


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Process:
    made = Process()
    monkeypatch.setattr(relay_silence, "processor_s", lambda _pid: made.had_s)
    monkeypatch.setattr(relay_silence, "waited_s", lambda _pid: made.waited_s)
    monkeypatch.setattr(relay_silence, "is_idle", lambda _pid: made.is_idle)
    return made


def test_an_idle_one_is_wedged_once_patience_ends(process: Process) -> None:
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    assert silence.go_on(1.0, 1.0) == ""
    assert silence.go_on(0.5, 0.5) == "no sign of life for 1.5 s"


@pytest.mark.usefixtures("process")
def test_one_that_gets_no_processor_never_is() -> None:
    silence = Silence(1, PATIENCE_S)
    assert {silence.go_on(LOOK_S, LOOK_S) for _ in range(4000)} == {""}
    assert silence.silent_s == pytest.approx(1000.0)


def test_one_that_works_without_a_word_is(process: Process) -> None:
    silence = Silence(1, PATIENCE_S)
    silence.go_on(2.0, 2.0)
    process.had_s = 3.0 + WORK_S - 0.1
    assert silence.go_on(2.0, 2.0) == ""
    process.had_s = 3.0 + WORK_S + 0.1
    assert silence.go_on(2.0, 2.0) == "no sign of life for 6.0 s, 10.1 s of them on a processor"


def test_time_in_which_it_waited_for_a_processor_uses_up_no_patience(process: Process) -> None:
    """It sleeps for a moment now and then, also while it starts: that alone says nothing."""
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    for _ in range(100):
        process.waited_s += 0.9
        process.had_s = (process.had_s or 0.0) + 0.09
        assert silence.go_on(1.0, 1.0) == ""
    assert silence.left_s == pytest.approx(0.5)
    assert silence.go_on(0.6, 0.6) == "no sign of life for 100.6 s"


def test_many_threads_that_wait_buy_no_patience_for_later(process: Process) -> None:
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    process.waited_s += 30.0
    assert silence.go_on(2.0, 2.0) == ""
    assert silence.left_s == PATIENCE_S
    assert silence.go_on(PATIENCE_S, PATIENCE_S) == "no sign of life for 3.5 s"


def test_a_relay_that_has_spoken_is_looked_at_from_half_of_its_patience_on(process: Process) -> None:
    """Reading all threads' times costs more than a word does; a relay that speaks in time is spared it."""
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    silence.end()
    assert silence.left_s == PATIENCE_S / 2
    assert silence.go_on(PATIENCE_S / 2, PATIENCE_S / 2) == ""
    assert silence.left_s == PATIENCE_S / 2
    process.waited_s += 0.5
    assert silence.go_on(PATIENCE_S / 2, PATIENCE_S / 2) == ""
    assert silence.left_s == pytest.approx(0.5)


def test_a_word_begins_everything_from_the_start(process: Process) -> None:
    silence = Silence(1, PATIENCE_S)
    silence.go_on(2.0, 2.0)
    process.had_s = 3.0 + 2 * WORK_S
    silence.end()
    process.is_idle = True
    assert silence.go_on(1.0, 1.0) == ""
    assert silence.go_on(0.4, 0.4) == ""
    assert silence.go_on(0.2, 0.2)


def test_what_we_slept_through_is_no_silence(process: Process) -> None:
    """A suspended machine, a stopped daemon: we asked for a second, and came back after a minute."""
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    assert silence.go_on(1.0, 60.0) == ""
    assert silence.silent_s == pytest.approx(1.0 + LOOK_S)


def test_a_relay_that_stood_still_with_us_is_listened_to_once_more(process: Process) -> None:
    """It was silent for a second when the machine stopped; awake again, the daemon may be the first to run."""
    process.is_idle = True
    silence = Silence(1, PATIENCE_S)
    silence.go_on(1.0, 1.0)
    assert silence.go_on(silence.left_s, 12.0) == ""
    assert silence.left_s == pytest.approx(LOOK_S)
    assert silence.go_on(LOOK_S, LOOK_S)


def test_one_that_is_gone_is_not_waited_for(process: Process) -> None:
    process.had_s = None
    assert Silence(1, PATIENCE_S).go_on(2.0, 2.0)


def test_processor_time_of_a_real_process() -> None:
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        until(lambda: (processor_s(busy.pid) or 0.0) > 0.3, "it works")
    finally:
        busy.kill()
        busy.wait(60)
    assert processor_s(busy.pid) is None
    assert processor_s(os.getpid()) is not None


def test_waiting_for_a_processor_of_real_processes() -> None:
    """Two on one core: each waits for half of the time."""
    core = min(os.sched_getaffinity(0))
    spin = f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"
    pair = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(2)]
    try:
        until(lambda: all(waited_s(one.pid) > 0.5 for one in pair), "they wait for each other")
    finally:
        for one in pair:
            one.kill()
            one.wait(60)
    assert waited_s(pair[0].pid) == 0.0


def test_a_process_that_wants_the_processor_is_not_idle() -> None:
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    asleep = subprocess.Popen(["sleep", "60"])
    try:
        until(lambda: not is_idle(busy.pid), "it runs")
        until(lambda: is_idle(asleep.pid), "it sleeps")
        busy.send_signal(signal.SIGSTOP)
        until(lambda: is_idle(busy.pid), "it is stopped")
    finally:
        for process in (busy, asleep):
            process.kill()
            process.wait(60)
    assert not is_idle(busy.pid)
