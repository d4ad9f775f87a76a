from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.profiles import load_of
from zsched.core.profile.means import STALE_S, Ewma
from zsched.core.profile.profile import (
    GAUGE_SMOOTHING_S,
    RATIO_CHANGE,
    RSSI_CHANGE_DB,
    RSSI_OUTLIER_DB,
    SIGNAL_SMOOTHING_S,
    Profiler,
    SignalFilter,
)
from zsched.core.values.events import WorkerJobs
from zsched.core.values.fleet import Timing
from zsched.core.values.model import RSSI_MAX_DBM, RSSI_MIN_DBM
from zsched.core.values.profile import DeviceSample, Link, LinkSample, LinkSource, Profile, WorkerLoad, WorkerState
from zsched.core.values.words import Trouble

TIMING = Timing()
READY = {"merge": WorkerState.READY}


def load(cpu: float | None, memory: float | None = None, state: WorkerState = WorkerState.READY) -> WorkerLoad:
    return load_of(state=state, cpu_cores=cpu, memory_mb=memory)


def device(cpu: float | None = 1.0, memory: float | None = 1000.0, *workers: WorkerLoad) -> DeviceSample:
    return DeviceSample(cpu_cores=4.0, cpu_used_cores=cpu, memory_mb=4000.0, memory_used_mb=memory, workers=workers)


def radio(rssi: float | None, peer: str | None = None) -> LinkSample:
    return LinkSample(source=LinkSource.NL80211, peer=peer, rssi_dbm=rssi)


def make_profiler(timing: Timing = TIMING) -> Profiler:
    return Profiler("edge1", 3, timing)


def taken(profiler: Profiler, now: float, states: dict[str, WorkerState] | None = None) -> Profile:
    """A profile that is due because of its time."""
    profile = profiler.publishable(READY if states is None else states, is_draining=False, now=now)
    assert profile is not None
    return profile


# --- smoothing by elapsed time -------------------------------------------------------------------------------------


def test_a_step_is_followed_by_63_percent_in_one_time_constant_whatever_the_rate() -> None:
    """alpha = 1 - exp(-dt / tau): samples at uneven times give the same mean as samples at even ones."""
    for times in ((3.0,), (0.5, 3.0), tuple(0.2 * i for i in range(1, 16)), (0.01, 2.9, 2.95, 3.0)):
        mean = Ewma(3.0)
        mean.update(0.0, now=0.0)
        for at in times:
            mean.update(1.0, now=at)
        assert mean.value == pytest.approx(1 - math.exp(-1.0))


def test_no_time_constant_means_no_smoothing_and_no_elapsed_time_no_weight() -> None:
    raw = Ewma(0.0)
    raw.update(1.0, now=0.0)
    assert raw.update(5.0, now=0.0) == 5.0
    smooth = Ewma(3.0)
    smooth.update(1.0, now=1.0)
    assert smooth.update(5.0, now=1.0) == 1.0
    assert smooth.update(5.0, now=0.5) == 1.0, "a clock that stands is no reason for a jump"


def test_a_worker_without_a_figure_uses_nothing_for_that_sample() -> None:
    profiler = make_profiler()
    profiler.absorb(device(2.0, 1000.0, load(1.0, 200.0)), (), 100.0)
    profiler.absorb(device(2.0, 1000.0, load(None, None)), (), 100.0 + TIMING.smoothing_s)
    (worker,) = taken(profiler, 101.0).workers
    assert worker.cpu_cores == pytest.approx(math.exp(-1.0))
    assert worker.memory_mb == pytest.approx(200.0 * math.exp(-1.0))


# --- signals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("impossible", [-2.0, -9.9, 0.0, 12.0, -100.0, -110.0, -256.0, math.nan, math.inf])
def test_impossible_signals_are_dropped(impossible: float) -> None:
    signal = SignalFilter(3.0)

    assert signal.update(impossible, now=0.0) is None
    signal.update(-60.0, now=0.2)
    assert signal.update(impossible, now=0.4) == -60.0
    assert signal.dropped == 2


def test_a_single_outlier_is_dropped_and_a_lasting_jump_believed_after_three() -> None:
    signal = SignalFilter(0.0)
    for tick in range(5):
        signal.update(-70.0, now=tick * 0.2)

    assert signal.update(-70.0 + RSSI_OUTLIER_DB + 1, now=1.0) == -70.0
    assert signal.update(-70.0, now=1.2) == -70.0
    jumps = [signal.update(-40.0, now=1.4 + tick * 0.2) for tick in range(5)]
    assert jumps[0] == -70.0
    assert jumps[-1] == -40.0
    assert signal.dropped <= 1 + 3


def test_a_change_within_25_db_is_no_outlier() -> None:
    signal = SignalFilter(0.0)
    for tick in range(5):
        signal.update(-70.0, now=tick * 0.2)

    assert signal.update(-70.0 + RSSI_OUTLIER_DB, now=1.0) == -45.0
    assert signal.dropped == 0


def test_a_radio_that_gives_nothing_is_soon_not_measured_any_more() -> None:
    signal = SignalFilter(3.0)
    signal.update(-60.0, now=0.0)

    assert signal.update(None, now=STALE_S) == -60.0
    assert signal.update(None, now=STALE_S + 0.1) is None
    assert signal.update(-50.0, now=STALE_S + 0.2) == -50.0, "the old mean is worth nothing any more"


def test_signals_are_smoothed_in_dbm_and_each_link_for_itself() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (radio(-60.0), radio(-40.0, "robot2")), now=0.0)
    profiler.absorb(device(), (radio(-70.0), radio(-40.0, "robot2")), now=SIGNAL_SMOOTHING_S)

    way, direct = taken(profiler, SIGNAL_SMOOTHING_S).links
    assert way.rssi_dbm == pytest.approx(-60.0 - 10.0 * (1 - math.exp(-1.0)))
    assert direct.peer == "robot2"
    assert direct.rssi_dbm == pytest.approx(-40.0)


@pytest.mark.parametrize("dbm", [RSSI_MIN_DBM, -100.0, -40.0, -5.0, RSSI_MAX_DBM])
def test_a_fixed_signal_is_the_figure_of_the_file_whatever_it_is(dbm: float) -> None:
    """The fleet file takes it from -120 to 0: dropped as a driver's fault it was not measured, and nobody said so."""
    profiler = make_profiler()
    for step, signal in enumerate((-60.0, dbm)):
        profiler.absorb(device(), (LinkSample(source=LinkSource.FIXED, rssi_dbm=signal),), 100.0 + step)
        (link,) = taken(profiler, 100.0 + step).links
        assert link.rssi_dbm == signal
    profiler.absorb(device(), (LinkSample(source=LinkSource.FIXED),), 102.0)
    assert taken(profiler, 102.0).links == (Link(source=LinkSource.FIXED),)


def test_a_wired_link_has_no_signal_and_says_wired() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (LinkSample(source=LinkSource.WIRED, rssi_dbm=-30.0),), now=0.0)

    (link,) = taken(profiler, 0.0).links
    assert (link.source, link.rssi_dbm) == (LinkSource.WIRED, None)


def test_what_a_driver_makes_up_is_not_measured() -> None:
    """A retry ratio above one or a negative rate must not stop the node."""
    profiler = make_profiler()
    sample = replace(radio(-60.0), bitrate_mbps=-1.0, retry_ratio=1.5)
    profiler.absorb(device(), (sample,), now=0.0)

    (link,) = taken(profiler, 0.0).links
    assert (link.rssi_dbm, link.bitrate_mbps, link.retry_ratio) == (-60.0, None, None)


# --- the machine and its workers -----------------------------------------------------------------------------------


def test_the_first_cpu_reading_is_not_measured_rather_than_zero() -> None:
    profiler = make_profiler()
    profiler.absorb(device(cpu=None), (), now=0.0)
    assert taken(profiler, 0.0).cpu_used_cores is None

    profiler.absorb(device(cpu=2.0), (), now=0.2)
    assert taken(profiler, 0.2).cpu_used_cores == 2.0, "the first real one is taken as it is"


@pytest.mark.parametrize("impossible", [-1.0, math.nan, math.inf, -math.inf, 1e12])
def test_impossible_use_is_dropped_and_poisons_nothing(impossible: float) -> None:
    profiler = make_profiler()
    profiler.absorb(device(2.0, 1000.0, load(0.5, 100.0)), (), now=0.0)
    profiler.absorb(device(impossible, impossible), (), now=0.2)
    profiler.absorb(device(2.0, 1000.0, load(0.5, 100.0)), (), now=0.4)

    profile = taken(profiler, 0.4)
    assert profile.cpu_used_cores == pytest.approx(2.0)
    assert profile.memory_used_mb == pytest.approx(1000.0)


def test_cpu_and_memory_are_smoothed_with_the_time_constant() -> None:
    profiler = make_profiler()
    profiler.absorb(device(1.0, 1000.0), (), now=0.0)
    profiler.absorb(device(3.0, 2000.0), (), now=TIMING.smoothing_s)

    profile = taken(profiler, TIMING.smoothing_s)
    followed = 1 - math.exp(-1.0)
    assert profile.cpu_used_cores == pytest.approx(1.0 + 2.0 * followed)
    assert profile.memory_used_mb == pytest.approx(1000.0 + 1000.0 * followed)


@pytest.mark.parametrize("already_running", [True, False])
def test_what_a_worker_starts_or_stops_to_use_never_shows_in_the_rest(*, already_running: bool) -> None:
    """Use minus the worker's share is what the owner is judged by: at every instant the smoothed rest, exactly."""
    rest_cpu, rest_memory = 1.0, 1000.0
    profiler, plain = make_profiler(), Ewma(TIMING.smoothing_s)
    for tick in range(100):
        now = tick * 0.2
        rest = rest_cpu + (tick % 7) * 0.1
        is_running = already_running or tick > 30
        is_active = 50 < tick < 80
        cpu, memory = (1.5, 600.0) if is_active else (0.1, 200.0)
        worker = load(cpu, memory) if is_running else load(None, None, WorkerState.STOPPED)
        used = (worker.cpu_cores or 0.0, worker.memory_mb or 0.0)
        profiler.absorb(device(rest + used[0], rest_memory + used[1], worker), (), now=now)
        expected = plain.update(rest, now)
        profile = profiler.publishable(READY, is_draining=False, now=now)
        if profile is None:
            continue
        own = profile.worker("merge")
        assert own is not None
        assert profile.cpu_used_cores is not None
        assert profile.memory_used_mb is not None
        assert profile.cpu_used_cores - (own.cpu_cores or 0.0) == pytest.approx(expected)
        assert profile.memory_used_mb - (own.memory_mb or 0.0) == pytest.approx(rest_memory)


def test_states_come_from_the_node_not_from_the_sample() -> None:
    profiler = make_profiler()
    profiler.absorb(device(2.0, 1000.0, load(0.5, 100.0, WorkerState.READY)), (), now=0.0)

    profile = taken(profiler, 0.0, {"merge": WorkerState.FAILED, "alpha": WorkerState.STARTING})
    assert [(worker.task, worker.state) for worker in profile.workers] == [
        ("alpha", WorkerState.STARTING),
        ("merge", WorkerState.FAILED),
    ]
    assert profile.worker("merge") == load(0.5, 100.0, WorkerState.FAILED)


# --- when it is sent -----------------------------------------------------------------------------------------------


def test_sent_every_publish_period_and_numbered() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (), now=0.0)
    sent = [
        (tick * 0.2, profile)
        for tick in range(16)
        if (profile := profiler.publishable(READY, is_draining=False, now=tick * 0.2)) is not None
    ]

    assert [at for at, _ in sent] == pytest.approx([0.0, 1.0, 2.0, 3.0])
    assert [profile.sequence for _, profile in sent] == [0, 1, 2, 3]
    assert {(profile.node, profile.incarnation) for _, profile in sent} == {("edge1", 3)}


def test_a_profile_that_is_nearly_due_goes_with_a_beat() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (), now=0.0)
    taken(profiler, 0.0)
    almost = TIMING.publish_s - 0.4 * TIMING.beat_s
    assert profiler.publishable(READY, is_draining=False, now=almost) is None
    early = TIMING.publish_s - 0.6 * TIMING.beat_s
    assert profiler.publishable(READY, is_draining=False, now=early, beats_now=True) is None
    assert profiler.publishable(READY, is_draining=False, now=almost, beats_now=True) is not None


def test_who_comes_hears_of_this_machine_within_a_beat_however_many_come() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (), now=0.0)
    taken(profiler, 0.0)
    sent = 0
    for tick in range(1, 11):
        now = tick * TIMING.beat_s / 10
        profiler.owe(now)
        sent += profiler.publishable(READY, is_draining=False, now=now) is not None
    assert sent == 0, "they share one"
    assert profiler.publishable(READY, is_draining=False, now=1.11 * TIMING.beat_s) is not None
    assert profiler.publishable(READY, is_draining=False, now=1.2 * TIMING.beat_s) is None


RAW = replace(TIMING, smoothing_s=0.0)


@pytest.mark.parametrize(
    ("cpu", "memory", "rssi", "is_sent"),
    [
        (1.0, 1000.0, -60.0, False),
        (1.0 + 4.0 * RATIO_CHANGE * 0.9, 1000.0, -60.0, False),
        (1.0 + 4.0 * RATIO_CHANGE * 1.1, 1000.0, -60.0, True),
        (1.0, 1000.0 + 4000.0 * RATIO_CHANGE * 0.9, -60.0, False),
        (1.0, 1000.0 + 4000.0 * RATIO_CHANGE * 1.1, -60.0, True),
        (1.0, 1000.0, -60.0 - RSSI_CHANGE_DB * 0.9, False),
        (1.0, 1000.0, -60.0 - RSSI_CHANGE_DB * 1.1, True),
    ],
)
def test_sent_at_once_when_a_robot_might_decide_otherwise(
    cpu: float, memory: float, rssi: float, *, is_sent: bool
) -> None:
    profiler = make_profiler(RAW)
    profiler.absorb(device(), (radio(-60.0),), now=0.0)
    taken(profiler, 0.0)
    profiler.absorb(device(cpu, memory), (radio(rssi),), now=0.2)

    assert (profiler.publishable(READY, is_draining=False, now=0.2) is not None) is is_sent


def test_small_changes_add_up_until_they_are_sent() -> None:
    """Compared with what was sent, not with the previous sample: a slow drift is not hidden until the period ends."""
    profiler = make_profiler(replace(RAW, publish_s=60.0))
    sent = 0
    for tick in range(41):
        profiler.absorb(device(1.0 + 4.0 * 0.01 * tick), (), now=tick * 0.2)
        sent += profiler.publishable(READY, is_draining=False, now=tick * 0.2) is not None

    assert 1 + 13 <= sent <= 1 + 20


def test_sent_at_once_when_a_worker_changes_or_the_node_drains() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (), now=0.0)
    taken(profiler, 0.0)

    failed = {"merge": WorkerState.FAILED}
    assert profiler.publishable(failed, is_draining=False, now=0.1) is not None
    assert profiler.publishable(failed, is_draining=False, now=0.2) is None
    told = profiler.publishable(failed, is_draining=False, now=0.25, reasons={"merge": (Trouble.NONE, "no such map")})
    assert told is not None
    assert [one.reason for one in told.workers] == ["no such map"]
    same = {"merge": (Trouble.AGAIN, "no such map")}
    again = profiler.publishable(failed, is_draining=False, now=0.27, reasons=same)
    assert again is not None
    assert [(one.trouble, one.reason) for one in again.workers] == [(Trouble.AGAIN, "no such map")]
    assert profiler.publishable(failed, is_draining=False, now=0.28, reasons=same) is None
    draining = profiler.publishable(failed, is_draining=True, now=0.3, reasons=same)
    assert draining is not None
    assert draining.draining


def test_what_a_ready_worker_complains_of_goes_along_with_the_figures() -> None:
    """Its count rises with every sample: that is no reason to wake everybody up."""
    profiler = make_profiler()
    profiler.absorb(device(), (), now=0.0)
    taken(profiler, 0.0)
    raised = {"merge": (Trouble.NONE, "callback raised once")}
    first = profiler.publishable(READY, is_draining=False, now=0.1, reasons=raised)
    assert first is not None
    assert [one.reason for one in first.workers] == ["callback raised once"]
    more = {"merge": (Trouble.NONE, "raised 200 times")}
    assert profiler.publishable(READY, is_draining=False, now=0.2, reasons=more) is None
    rests = {"merge": (Trouble.RESTS, "raised 200 times")}
    assert profiler.publishable(READY, is_draining=False, now=0.3, reasons=rests) is not None, (
        "it may not work any more"
    )


def test_sent_at_once_when_a_link_falls_silent_or_is_taken_away() -> None:
    profiler = make_profiler(replace(TIMING, publish_s=60.0))
    profiler.absorb(device(), (radio(-60.0),), now=0.0)
    taken(profiler, 0.0)

    silent = 0.1 + STALE_S
    profiler.absorb(device(), (radio(None),), now=silent)
    profile = profiler.publishable(READY, is_draining=False, now=silent)
    assert profile is not None
    assert profile.links[0].rssi_dbm is None
    profiler.absorb(device(), (), now=silent + 0.2)
    profile = profiler.publishable(READY, is_draining=False, now=silent + 0.2)
    assert profile is not None
    assert profile.links == ()


def test_a_sampler_that_died_leaves_nothing_measured() -> None:
    """Its last figures must not stand for ever."""
    profiler = Profiler("edge1", 1, Timing())
    link = replace(radio(-60.0, "robot1"), bitrate_mbps=50.0, retry_ratio=0.1)
    profiler.absorb(device(1.0, 1000.0, load(0.5, 100.0)), (link, LinkSample(source=LinkSource.WIRED)), 0.0)
    first = profiler.publishable(READY, is_draining=False, now=0.0)
    later = profiler.publishable(READY, is_draining=False, now=STALE_S + 0.1)
    assert first is not None
    assert later is not None
    assert (first.cpu_used_cores, later.cpu_used_cores, later.memory_used_mb) == (1.0, None, None)
    assert [one.rssi_dbm for one in first.links] == [-60.0, None]
    assert later.links == (Link(source=LinkSource.NL80211, peer="robot1"), Link(source=LinkSource.WIRED))
    assert (first.workers, later.workers) == ((load(0.5, 100.0),), (load(None, None),))


def test_what_cannot_be_read_is_soon_not_measured_though_samples_come() -> None:
    profiler, used = make_profiler(), (2.0, 1000.0)
    profiler.absorb(device(*used, load(0.5, 100.0)), (), now=0.0)

    def told(now: float) -> list[float | None]:
        profile = taken(profiler, now)
        (worker,) = profile.workers
        return [profile.cpu_used_cores, profile.memory_used_mb, worker.cpu_cores, worker.memory_mb]

    for now, is_known in ((STALE_S, True), (STALE_S + 1.0, False)):
        profiler.absorb(device(None, None, load(0.5, 100.0)), (), now=now)
        assert told(now) == ([2.0, 1000.0, 0.5, 100.0] if is_known else [None] * 4)
    profiler.absorb(device(None, 3000.0, load(0.7, 300.0)), (), now=10.0)
    assert told(10.0) == [None, 3000.0, None, 300.0], "the old mean is worth nothing any more"
    profiler.absorb(device(3.0, 3000.0, load(0.7, 300.0)), (), now=11.0)
    assert told(11.0) == [3.0, 3000.0, 0.7, 300.0]


def test_the_threads_of_a_worker_are_smoothed_in_step_with_those_of_its_machine() -> None:
    """So the rest, all others, stays what it is while the worker starts, works and ends."""
    profiler, compared = make_profiler(), 0
    for step, own in enumerate((None, None, 0.0, 2.0, 1.0, 3.0, 0.0, None, None)):
        load = load_of(runnable=own)
        sample = replace(device(), runnable=4.0 + (own or 0.0), workers=() if own is None else (load,))
        profiler.absorb(sample, (), now=0.2 * step)
        profiler.owe(0.2 * step)
        told = taken(profiler, 0.2 * step + TIMING.beat_s)
        mine = told.worker("merge")
        assert told.runnable is not None
        if mine is not None and mine.runnable is not None:
            assert told.runnable - mine.runnable == pytest.approx(4.0)
            compared += 1
    assert compared >= 5
    profiler.absorb(replace(device(), workers=(load_of(runnable=2.0),)), (), now=9.0)
    mine = taken(profiler, 9.0).worker("merge")
    assert mine is not None
    assert mine.runnable is None, "nobody counts the machine's"


def test_who_wants_to_run_is_smoothed_and_unknown_at_once_where_nobody_counts() -> None:
    profiler = make_profiler()
    for at_s, runnable in ((0.0, 2.0), (TIMING.smoothing_s, 10.0)):
        profiler.absorb(replace(device(), runnable=runnable), (), now=at_s)
    assert taken(profiler, 1.0).runnable == pytest.approx(2.0 + 8.0 * (1 - math.exp(-1.0)))
    profiler.absorb(device(), (), now=2.0)
    assert taken(profiler, 2.0).runnable is None
    profiler.absorb(replace(device(), runnable=math.nan), (), now=3.0)
    assert taken(profiler, 3.0).runnable is None


@pytest.mark.parametrize(("smoothing_s", "signal_s"), [(0.2, SIGNAL_SMOOTHING_S), (2.0, 2.0), (0.05, 0.05)])
def test_a_radio_is_smoothed_over_half_a_second_at_least(smoothing_s: float, signal_s: float) -> None:
    profiler = make_profiler(replace(TIMING, smoothing_s=smoothing_s))
    for at_s, rssi in ((0.0, -60.0), (0.2, -70.0)):
        profiler.absorb(device(), (radio(rssi),), now=at_s)
    (link,) = taken(profiler, 0.2).links
    assert link.rssi_dbm == pytest.approx(-60.0 - 10.0 * (1 - math.exp(-0.2 / signal_s)))


# --- the workers' word ---------------------------------------------------------------------------------------------


def test_a_job_that_takes_another_time_is_worth_a_profile_before_its_time() -> None:
    """Nothing else has changed: the task waits in a queue for the CPU, and the machine is as full as it was."""
    profiler = make_profiler(replace(TIMING, publish_s=60.0))
    now, done, time_s = 0.0, 0, 0.0

    def goes_on(job_s: float, count: int) -> list[Profile]:
        nonlocal now, done, time_s
        sent = []
        for _ in range(count):
            now, done, time_s = now + 0.2, done + 2, time_s + 2 * job_s
            word = WorkerJobs(task="merge", incarnation="1", at_s=now, done=done, time_s=time_s, cpu_s=0.03 * done)
            assert profiler.note_jobs(word, now)
            profiler.absorb(device(4.0, 1000.0, load(0.3, 100.0)), (), now)
            sent.append(profiler.publishable(READY, is_draining=False, now=now))
        return [one for one in sent if one is not None]

    goes_on(0.035, 40)
    assert goes_on(0.035, 40) == []
    sent = goes_on(0.22, 2)
    assert sent, "within 0.4 s"
    assert sent[0].workers[0].jobs is not None
    assert sent[0].workers[0].jobs.time_s > 0.042


@pytest.mark.parametrize("pressure", [0.0, 0.7, 1.0])
def test_every_share_of_time_is_a_pressure(pressure: float) -> None:
    profiler = make_profiler()
    profiler.absorb(replace(device(), cpu_pressure=pressure), (), now=0.0)
    assert taken(profiler, 0.0).cpu_pressure == pressure


# --- gauges ----------------------------------------------------------------------------------------------------------


def gauges_of(profiler: Profiler, now: float, *readings: tuple[str, float]) -> dict[str, float]:
    profiler.absorb(replace(device(), gauges=readings), (), now)
    return dict(taken(profiler, now).gauges)


def test_gauges_are_smoothed_by_two_seconds_and_absent_ones_are_absent_at_once() -> None:
    profiler = make_profiler()
    assert gauges_of(profiler, 100.0, ("gpu", 0.0), ("battery", 0.8)) == {"gpu": 0.0, "battery": 0.8}
    shown = gauges_of(profiler, 100.0 + GAUGE_SMOOTHING_S, ("gpu", 1.0))
    assert shown == {"gpu": pytest.approx(1 - math.exp(-1.0), abs=1e-3)}
    assert gauges_of(profiler, 105.0) == {}


@pytest.mark.parametrize("smoothing_s", [TIMING.smoothing_s, 4.0])
def test_a_mean_goes_on_by_another_time_constant_from_where_it_is(smoothing_s: float) -> None:
    profiler = make_profiler()
    timing = replace(TIMING, smoothing_s=smoothing_s, sample_s=0.5)
    gauges_of(profiler, 100.0, ("gpu", 0.0))
    profiler.retune(timing)
    found = gauges_of(profiler, 100.0 + GAUGE_SMOOTHING_S, ("gpu", 1.0))
    lag = GAUGE_SMOOTHING_S / max(smoothing_s, GAUGE_SMOOTHING_S)
    assert found["gpu"] == pytest.approx(1 - math.exp(-lag), abs=1e-3)


@pytest.mark.parametrize("smoothing_s", [0.0, 0.1, TIMING.smoothing_s, 4.0])
def test_a_worker_does_not_look_like_other_load_after_another_time_constant(smoothing_s: float) -> None:
    """Its share began anew, from nothing, and the machine's mean did not: a task left its owner because of itself."""
    profiler = make_profiler()
    for step in range(50):
        profiler.absorb(device(2.0, 1000.0, load(1.5, 400.0)), (), 100.0 + 0.2 * step)
    profiler.retune(replace(TIMING, smoothing_s=smoothing_s))
    profiler.absorb(device(2.0, 1000.0, load(1.5, 400.0)), (), 110.0)
    profile = taken(profiler, 110.0)
    (worker,) = profile.workers
    assert (profile.cpu_used_cores, worker.cpu_cores) == pytest.approx((2.0, 1.5))
    assert (profile.memory_used_mb, worker.memory_mb) == pytest.approx((1000.0, 400.0))


def test_what_a_worker_tells_of_its_jobs_stands_with_another_time_constant() -> None:
    profiler = make_profiler()
    for step in range(60):
        if step == 50:
            profiler.retune(replace(TIMING, smoothing_s=4.0))
        now, done = 0.2 * step, step
        word = WorkerJobs(task="merge", incarnation="1", at_s=now, done=done, time_s=0.05 * done)
        assert profiler.note_jobs(word, now)
        profiler.absorb(device(1.0, 1000.0, load(0.1)), (), now)
    (worker,) = taken(profiler, 12.0).workers
    assert worker.jobs is not None
    assert worker.jobs.done_hz == pytest.approx(5.0, rel=0.01)
    assert worker.jobs.time_s == pytest.approx(0.05)


def test_of_somebody_else_s_worker_its_jobs_are_told_and_their_use() -> None:
    """The machine's samples have workers of ours only, and no figures before the second one."""
    profiler = make_profiler()
    for step in range(60):
        word = WorkerJobs(
            task="merge", incarnation="1", at_s=0.2 * step, done=step, time_s=0.05 * step, cpu_s=0.04 * step
        )
        assert profiler.note_jobs(word, 0.2 * step)
        profiler.absorb(device(1.0, 1000.0), (), 0.2 * step)
    (worker,) = taken(profiler, 12.0).workers
    assert worker.jobs is not None
    assert worker.jobs.done_hz == pytest.approx(5.0, rel=0.01)
    assert worker.cpu_cores == pytest.approx(0.2, rel=0.01)
    assert (worker.memory_mb, worker.runnable) == (None, None)
    assert taken(profiler, 100.0).workers == (WorkerLoad(task="merge", state=WorkerState.READY),), "nobody measures"


def test_the_signal_of_a_link_goes_on_by_another_time_constant() -> None:
    profiler = make_profiler()
    profiler.absorb(device(), (radio(-60.0),), 100.0)
    profiler.retune(replace(TIMING, smoothing_s=4.0))
    profiler.absorb(device(), (radio(-70.0),), 101.0)
    (link,) = taken(profiler, 101.0).links
    assert link.rssi_dbm == pytest.approx(-60.0 - 10.0 * (1 - math.exp(-1.0 / 4.0)))


def test_impossible_and_unknown_readings_are_no_readings_and_old_ones_neither() -> None:
    profiler = make_profiler()
    assert gauges_of(profiler, 100.0, ("battery", 1.2), ("temperature_c", math.nan), ("wind", 3.0)) == {}
    assert gauges_of(profiler, 101.0, ("battery", 0.5)) == {"battery": 0.5}
    assert taken(profiler, 101.0 + STALE_S + 0.1).gauges == ()


@pytest.mark.parametrize("rate_hz", [5.0, 5.3, 5.6, 6.0, 6.4, 6.8, 7.2])
@pytest.mark.parametrize("sample_s", [0.2, 1.0])
def test_a_hung_worker_is_told_of_however_seldom_its_machine_is_measured(rate_hz: float, sample_s: float) -> None:
    """By its smoothed rate it was not, where one look in a second stepped over what counted as a hang: 3 of 10 did."""
    profiler, told = make_profiler(), None
    for step in range(200):
        now = 0.2 * step
        done = int(min(now, 8.0) * rate_hz)
        word = WorkerJobs(task="merge", incarnation="1", at_s=now, done=done, time_s=0.01 * done, waiting=int(now > 8))
        assert profiler.note_jobs(word, now)
        if step % round(5 * sample_s) == 0:
            profiler.absorb(device(1.0, 1000.0, load(0.1)), (), now)
            sent = profiler.publishable(READY, is_draining=False, now=now)
            told = told if sent is None else sent.worker("merge")
    assert told is not None
    assert told.unended_s == pytest.approx(39.8 - 8.0, abs=1.5)
