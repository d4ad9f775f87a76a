"""What becomes of a worker's word: means and rates, what is left undone, what is not believed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsched.core.profile.jobs import MAX_AT_ONCE, QUEUE_S, UNENDED_S, JobMeter
from zsched.core.profile.means import STALE_S
from zsched.core.values.events import WorkerJobs
from zsched.core.values.profile import Jobs

LOOK_S = 0.2


class Teller:
    """A worker that does so many jobs a second, each of so long, and tells five times a second."""

    def __init__(self, meter: JobMeter) -> None:
        self.meter = meter
        self.now = 100.0
        self.done = self.skipped = 0.0
        self.word = WorkerJobs(task="merge", incarnation="1", at_s=0.0, done=0, wait_s=0.0, age_s=0.0, late=0)

    def works(
        self,
        for_s: float,
        *,
        done_hz: float,
        skipped_hz: float = 0.0,
        time_s: float = 0.1,
        cpu_s: float = 0.08,
        wait_s: float = 0.01,
        waiting: int = 0,
        lost_words: int = 0,
        is_idle: bool = False,
    ) -> Jobs | None:
        for number in range(round(for_s / LOOK_S)):
            self.now += LOOK_S
            self.done += done_hz * LOOK_S
            self.skipped += skipped_hz * LOOK_S
            jobs = int(self.done + 1e-9) - self.word.done
            assert self.word.wait_s is not None
            assert self.word.age_s is not None
            assert self.word.late is not None
            self.word = replace(
                self.word,
                at_s=self.word.at_s + LOOK_S,
                done=self.word.done + jobs,
                skipped=int(self.skipped + 1e-9),
                waiting=waiting,
                is_idle=is_idle,
                time_s=self.word.time_s + jobs * time_s,
                cpu_s=self.word.cpu_s + jobs * cpu_s,
                wait_s=self.word.wait_s + jobs * wait_s,
                age_s=self.word.age_s + jobs * 2 * time_s,
                late=self.word.late + jobs * (time_s > 0.2),
            )
            if number % (lost_words + 1) == lost_words:
                assert self.meter.absorb(self.word, self.now)
            self.meter.look(self.now)
        return self.meter.value


def told(meter: JobMeter | None = None) -> Teller:
    return Teller(meter or JobMeter(1.0))


def test_means_are_per_job_and_rates_per_second() -> None:
    jobs = told().works(20.0, done_hz=5.0, skipped_hz=2.5)
    assert jobs is not None
    assert jobs.time_s == pytest.approx(0.1)
    assert jobs.cpu_s == pytest.approx(0.08)
    assert jobs.wait_s == pytest.approx(0.01)
    assert jobs.age_s == pytest.approx(0.2)
    assert jobs.late_ratio == 0.0
    assert jobs.done_hz == pytest.approx(5.0, rel=0.05)
    assert jobs.wanted_hz == pytest.approx(7.5, rel=0.1)
    assert jobs.done_ratio == pytest.approx(2 / 3, rel=0.1)


def test_a_job_that_takes_longer_shows_with_the_first_word_of_it() -> None:
    """35 ms become 220: the mean is above the old one at once, and there within three time constants."""
    teller = told()
    before = teller.works(20.0, done_hz=5.0, time_s=0.035)
    after = teller.works(LOOK_S, done_hz=5.0, time_s=0.22)
    assert before is not None
    assert after is not None
    assert after.time_s > 1.5 * before.time_s
    later = teller.works(3.0, done_hz=5.0, time_s=0.22)
    assert later is not None
    assert later.time_s > 0.21
    assert later.late_ratio is not None
    assert later.late_ratio > 0.9


def test_a_word_that_is_lost_costs_nothing() -> None:
    whole, thinned = told().works(21.0, done_hz=5.0), told().works(21.0, done_hz=5.0, lost_words=4)
    assert whole is not None
    assert thinned is not None
    assert thinned.cpu_s == pytest.approx(whole.cpu_s)
    assert thinned.done_ratio == whole.done_ratio == 1.0


def test_samples_that_come_at_once_and_are_done_one_by_one_are_not_left_undone() -> None:
    teller = told()
    ratios = []
    for _ in range(20):
        for waiting in (2, 1, 0, 0, 0):
            jobs = teller.works(LOOK_S, done_hz=3.0, waiting=waiting)
            ratios.append(1.0 if jobs is None else jobs.done_ratio)
    assert set(ratios) == {1.0}


def test_a_queue_that_only_grows_is_work_left_undone() -> None:
    """Of class reliable nothing is skipped: 9 come a second, 4 are done, five more wait."""
    teller = told()
    for waiting in range(100):
        jobs = teller.works(LOOK_S, done_hz=4.0, waiting=waiting)
    assert jobs is not None
    assert jobs.wanted_hz == pytest.approx(9.0, rel=0.1)
    assert jobs.backlog == 99
    for waiting in range(100, 0, -1):  # it catches up: what it does beyond what comes is not wanted for long
        jobs = teller.works(LOOK_S, done_hz=14.0, waiting=waiting)
    assert jobs is not None
    assert jobs.wanted_hz == pytest.approx(9.0, rel=0.1)
    assert jobs.done_ratio == 1.0


def test_a_queue_counts_when_it_has_been_there_for_a_while() -> None:
    teller = told()
    teller.works(5.0, done_hz=4.0)
    assert (jobs := teller.works(QUEUE_S - 2 * LOOK_S, done_hz=4.0, waiting=9)) is not None
    assert jobs.done_ratio == 1.0
    assert (jobs := teller.works(1.0, done_hz=4.0, waiting=9)) is not None
    assert jobs.done_ratio is not None
    assert jobs.done_ratio < 0.8


def test_a_worker_that_has_nothing_to_do_says_nothing_and_is_not_measured() -> None:
    teller = told()
    teller.works(10.0, done_hz=5.0)
    for _ in range(round(STALE_S / LOOK_S) - 1):
        teller.now += LOOK_S
        teller.meter.look(teller.now)
    assert (jobs := teller.meter.value) is not None
    assert jobs.done_hz < 0.1
    assert jobs.cpu_s == pytest.approx(0.08), "what a job takes is not forgotten while nothing comes"
    teller.meter.look(teller.now + 2 * LOOK_S)
    assert teller.meter.value is None


def test_a_worker_that_has_nothing_more_to_do_lacks_nothing_at_once() -> None:
    meter = JobMeter(1.0)
    teller = Teller(meter)
    busy = teller.works(10.0, done_hz=3.0, skipped_hz=7.0)
    assert busy is not None
    assert busy.wanted_hz == pytest.approx(10.0, rel=0.1)
    teller.now += LOOK_S
    meter.absorb(replace(teller.word, at_s=teller.word.at_s + LOOK_S, is_idle=True), teller.now)
    meter.look(teller.now)
    assert meter.value is not None
    assert meter.value.wanted_hz == meter.value.done_hz > 1.0


def test_a_moment_without_work_is_no_end_while_samples_are_skipped() -> None:
    meter = JobMeter(1.0)
    teller = Teller(meter)
    teller.works(10.0, done_hz=3.0, skipped_hz=7.0)
    teller.now += LOOK_S
    word = replace(teller.word, at_s=teller.word.at_s + LOOK_S, skipped=teller.word.skipped + 1, is_idle=True)
    meter.absorb(word, teller.now)
    meter.look(teller.now)
    assert meter.value is not None
    assert meter.value.wanted_hz > 2 * meter.value.done_hz


def test_another_life_of_the_worker_begins_anew() -> None:
    teller = told()
    teller.works(10.0, done_hz=5.0)
    teller.word = replace(teller.word, incarnation="2", done=0, skipped=0, time_s=0.0, cpu_s=0.0)
    teller.done = 0.0
    jobs = teller.works(10.0, done_hz=5.0, cpu_s=0.03)
    assert jobs is not None
    assert jobs.cpu_s == pytest.approx(0.03)


def test_a_daemon_that_comes_later_does_not_take_what_was_done_before_for_a_rate() -> None:
    teller = told()
    teller.word = replace(teller.word, at_s=1000.0, done=100_000, time_s=900.0, cpu_s=800.0)
    teller.done = 100_000.0
    jobs = teller.works(10.0, done_hz=5.0)
    assert jobs is not None
    assert jobs.done_hz == pytest.approx(5.0, rel=0.1)


def test_means_that_are_not_told_any_more_are_none() -> None:
    teller = told()
    teller.works(5.0, done_hz=5.0)
    teller.meter.absorb(replace(teller.word, done=teller.word.done + 1, wait_s=None, late=None), teller.now)
    teller.meter.look(teller.now + LOOK_S)
    assert teller.meter.value is not None
    assert (teller.meter.value.wait_s, teller.meter.value.late_ratio) == (None, None)


@pytest.mark.parametrize(
    "lie",
    [
        {"done": 1},
        {"skipped": 0},
        {"at_s": 0.1},
        {"time_s": 0.5},
        {"cpu_s": 0.5},
        {"wait_s": 0.0},
        {"age_s": 0.0},
        {"late": 0},
        {"time_s": MAX_AT_ONCE * 12.0 + 1.0},
        {"cpu_s": 1e9},
        {"wait_s": 1e9},
        {"done": 2**52},
    ],
)
def test_what_no_worker_can_have_done_is_not_believed(lie: dict[str, Any]) -> None:
    teller = told()
    jobs = teller.works(10.0, done_hz=5.0, skipped_hz=1.0, time_s=0.3)
    assert not teller.meter.absorb(replace(teller.word, **lie), teller.now)
    assert teller.meter.value == jobs
    assert teller.meter.absorb(teller.word, teller.now), "and does not stop what is true"


@settings(derandomize=True, database=None, deadline=None, max_examples=200)
@given(
    words=st.lists(
        st.tuples(*(st.integers(0, 2**53) for _ in range(4)), *(st.floats(0.0, 2.0**53) for _ in range(5))), max_size=8
    ),
    gap_s=st.floats(0.0, 20.0),
)
def test_whatever_comes_is_refused_or_becomes_figures_in_their_ranges(
    words: list[tuple[float, ...]], gap_s: float
) -> None:
    meter, now = JobMeter(1.0), 0.0
    for done, skipped, waiting, late, at_s, time_s, cpu_s, wait_s, age_s in words:
        now += gap_s
        word = WorkerJobs(
            task="merge",
            incarnation=str(int(done) % 2),
            at_s=at_s,
            done=int(done),
            skipped=int(skipped),
            waiting=int(waiting),
            time_s=time_s,
            cpu_s=cpu_s,
            wait_s=wait_s,
            age_s=age_s,
            late=int(late),
        )
        meter.absorb(word, now)
        meter.look(now)  # `Jobs` checks its own ranges


def test_a_rate_rises_from_nothing_as_what_the_processes_use_does() -> None:
    """The first words of a worker that comes are no whole second."""
    jobs = told().works(2 * LOOK_S, done_hz=5.0)
    assert jobs is not None
    assert 0.0 < jobs.done_hz < 2.5, "of five a second, with a time constant of 1 s"


def test_more_late_jobs_than_jobs_are_all_of_them() -> None:
    teller = told()
    for _ in range(25):
        teller.works(LOOK_S, done_hz=5.0, time_s=0.3)
        late = teller.word.late
        assert late is not None
        teller.word = replace(teller.word, late=late + 1)
    assert teller.meter.value is not None
    assert teller.meter.value.late_ratio == 1.0


def test_a_word_says_nothing_of_what_it_leaves_out() -> None:
    word = WorkerJobs(task="merge", incarnation="1", at_s=0.0, done=0)
    assert (word.time_s, word.cpu_s, word.skipped, word.waiting) == (0.0, 0.0, 0, 0)
    assert (word.wait_s, word.age_s, word.late) == (None, None, None)


def test_a_worker_that_has_work_and_ends_no_job_is_told_of_after_a_while() -> None:
    """From its first job on, and however long it was idle before."""
    teller = told()
    teller.works(UNENDED_S / 2, done_hz=0.0)
    assert teller.meter.unended_s(teller.now) is None
    teller.works(4.0, done_hz=0.0)
    assert teller.meter.unended_s(teller.now) == pytest.approx(UNENDED_S / 2 + 4.0, abs=2 * LOOK_S)
    teller.works(1.0, done_hz=5.0)
    assert teller.meter.unended_s(teller.now) is None
    teller.works(LOOK_S, done_hz=0.0, is_idle=True)
    for pause_s in (3.0, 60.0):
        teller.now += pause_s
        teller.works(UNENDED_S / 2, done_hz=0.0, waiting=3)
        assert teller.meter.unended_s(teller.now) is None, "since there has been work"
        teller.works(2.0, done_hz=0.0, waiting=3)
        assert teller.meter.unended_s(teller.now) == pytest.approx(UNENDED_S / 2 + 2.0, abs=2 * LOOK_S)
        teller.works(1.0, done_hz=5.0)  # its word that it is idle is lost


def test_one_that_falls_silent_with_work_in_hand_is_said_to_end_no_job() -> None:
    """A callback that keeps Python's lock silences the thread that reports."""
    teller = told()
    teller.works(2.0, done_hz=0.0)
    silent_s = UNENDED_S + STALE_S
    assert teller.meter.unended_s(teller.now + silent_s) == pytest.approx(silent_s + 2.0, abs=2 * LOOK_S)
    teller.now += silent_s
    teller.works(LOOK_S, done_hz=0.0)
    assert teller.meter.unended_s(teller.now) is None, "it speaks again, and may have been idle"


def test_one_that_was_idle_when_it_fell_silent_or_lives_anew_is_not_said_to_end_no_job() -> None:
    teller = told()
    teller.works(UNENDED_S + 2.0, done_hz=0.0)
    teller.works(LOOK_S, done_hz=0.0, is_idle=True)
    assert teller.meter.unended_s(teller.now) is None
    assert teller.meter.unended_s(teller.now + UNENDED_S + STALE_S) is None
    teller.works(UNENDED_S + 2.0, done_hz=0.0)
    assert teller.meter.unended_s(teller.now) is not None
    teller.word = replace(teller.word, incarnation="2", at_s=0.0)
    teller.works(LOOK_S, done_hz=0.0)
    assert teller.meter.unended_s(teller.now) is None
