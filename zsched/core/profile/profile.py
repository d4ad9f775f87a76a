"""PROFILE: turns this machine's raw readings into the smoothed profile by which robots decide (Alg. 1).

Knows: outlier rules, smoothing by elapsed time, when a profile should be sent. Does not know: how a figure is read, who
receives it, what it is worth.

Smoothing happens here, at the source, and not at the receivers: samples come at 5 Hz and profiles leave at 1 Hz.
Smoothing the thinned values would alias (docs/decisions/0003).
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping

from zsched.core.profile.jobs import JobMeter
from zsched.core.profile.means import STALE_S, Ewma
from zsched.core.values.events import WorkerJobs
from zsched.core.values.fleet import Timing
from zsched.core.values.gauges import possible
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import (
    MAX_BITRATE_MBPS,
    MAX_CPU_CORES,
    MAX_MEMORY_MB,
    MAX_RUNNABLE,
    DeviceSample,
    Echo,
    Link,
    LinkSample,
    LinkSource,
    Profile,
    Renewal,
    TaskProgress,
    WorkerLoad,
    WorkerState,
)
from zsched.core.values.struct import replace
from zsched.core.values.words import Readings, Trouble

RATIO_CHANGE = 0.02
"""This change of a CPU or memory ratio sends a profile at once."""
JOB_SMOOTHING_S = 1.0
"""Least time constant for jobs: one or two in a sample are no rate."""
JOB_CHANGE = 0.2
"""This change of the share of done jobs, or this relative change of time per job, sends a profile at once."""
BLIND_S = 10.0
"""Without a measurement for so long something hangs: one comes every second or sooner."""
GAUGE_SMOOTHING_S = 2.0
"""Least time constant of a gauge: a GPU's use jumps between 0 and 1 with every job."""
RSSI_CHANGE_DB = 1.0
"""This change of a signal sends a profile at once."""
RSSI_IMPOSSIBLE_ABOVE_DBM = -10.0
"""A higher reading is dropped."""
RSSI_IMPOSSIBLE_BELOW_DBM = -100.0
"""A lower reading is dropped."""
RSSI_OUTLIER_DB = 25.0
SIGNAL_SMOOTHING_S = 0.5
"""Least time constant of a signal: readings scatter by 2.5 to 2.9 dB."""
RSSI_WINDOW = 5
"""A reading further than 25 dB from the median of the last 5 is dropped (measured on real drives)."""
NO_REASONS: Mapping[TaskId, tuple[Trouble, str]] = {}
_WELL = (Trouble.NONE, "")
NO_RENEWALS: Mapping[TaskId, Renewal] = {}


class SignalFilter:
    """Drops impossible values and outliers of one radio link, and smooths the rest in dBm."""

    __slots__ = ("_mean", "_recent", "_valid_at", "dropped")

    def __init__(self, tau_s: float) -> None:
        self._mean = Ewma(tau_s)
        self._recent: deque[float] = deque(maxlen=RSSI_WINDOW)
        self._valid_at = -math.inf
        self.dropped = 0

    def update(self, rssi_dbm: float | None, now: float) -> float | None:
        """Take one reading in; the smoothed signal in dBm, or ``None`` without a reading for `STALE_S`."""
        if rssi_dbm is not None and self._is_plausible(rssi_dbm):
            self._valid_at = now
            self._mean.update(rssi_dbm, now)
        elif rssi_dbm is not None:
            self.dropped += 1
        if now - self._valid_at > STALE_S:
            self._mean.value = None
        return self._mean.value

    def retune(self, tau_s: float) -> None:
        """Go on with another time constant."""
        self._mean.tau_s = tau_s

    def _is_plausible(self, rssi_dbm: float) -> bool:
        if not RSSI_IMPOSSIBLE_BELOW_DBM < rssi_dbm <= RSSI_IMPOSSIBLE_ABOVE_DBM:
            return False
        median = statistics.median(self._recent) if len(self._recent) == RSSI_WINDOW else rssi_dbm
        # Kept in the window even when dropped: a lasting jump moves the median and is believed after three readings.
        self._recent.append(rssi_dbm)
        return abs(rssi_dbm - median) <= RSSI_OUTLIER_DB


class Profiler:
    """This node's own profile, built from samples."""

    def __init__(self, node: NodeId, incarnation: int, timing: Timing) -> None:
        self._node = node
        self._incarnation = incarnation
        self._timing = timing
        self._cpu = Ewma(timing.smoothing_s)
        self._memory = Ewma(timing.smoothing_s)
        self._pressure = Ewma(timing.smoothing_s)
        self._runnable = Ewma(timing.smoothing_s)
        self._gauges: dict[str, Ewma] = {}
        self._signals: dict[NodeId | None, SignalFilter] = {}
        self._worker_cpu: dict[TaskId, Ewma] = {}
        self._worker_memory: dict[TaskId, Ewma] = {}
        self._worker_runnable: dict[TaskId, Ewma] = {}
        self._jobs: dict[TaskId, JobMeter] = {}
        self._device: DeviceSample | None = None
        self._sampled_at = -math.inf
        self._is_new = False
        self._flags: tuple[object, ...] = ()
        self.has_news = True
        """The profile that was last sent has news other than figures."""
        self._links: tuple[Link, ...] = ()
        self._workers: tuple[WorkerLoad, ...] = ()
        self._sent: Profile | None = None
        self._sent_at = -math.inf
        self._sequence = 0

    def retune(self, timing: Timing) -> None:
        """Go by other times: every mean goes on from where it is, with the time constant that is its own now.

        None begins anew: until a worker's share had risen again, the worker would look like other programs' load.
        """
        self._timing = timing
        shares = (*self._worker_cpu.values(), *self._worker_memory.values(), *self._worker_runnable.values())
        for mean in (self._cpu, self._memory, self._pressure, self._runnable, *shares):
            mean.tau_s = timing.smoothing_s
        for mean in self._gauges.values():
            mean.tau_s = _gauge_tau_s(timing)
        for signal in self._signals.values():
            signal.retune(_signal_tau_s(timing))
        for meter in self._jobs.values():
            meter.retune(_job_tau_s(timing))

    def absorb(self, device: DeviceSample, links: tuple[LinkSample, ...], now: float) -> None:
        """Take one reading of the machine and its links in."""
        self._device, self._sampled_at, self._is_new = device, now, True
        worker_cpu = {load.task: load.cpu_cores for load in device.workers}
        worker_memory = {load.task: load.memory_mb for load in device.workers}
        _absorb_use(self._cpu, self._worker_cpu, device.cpu_used_cores, worker_cpu, MAX_CPU_CORES, now)
        _absorb_use(self._memory, self._worker_memory, device.memory_used_mb, worker_memory, MAX_MEMORY_MB, now)
        _absorb_known(self._pressure, device.cpu_pressure, 1.0, now)
        worker_runnable = {load.task: load.runnable for load in device.workers}
        if _possible(device.runnable, MAX_RUNNABLE) is None:  # nobody counts any more
            self._runnable.value = None
            self._worker_runnable.clear()
        _absorb_use(self._runnable, self._worker_runnable, device.runnable, worker_runnable, MAX_RUNNABLE, now)
        self._absorb_gauges(possible(device.gauges), now)
        self._links = tuple(self._link(sample, now) for sample in links)
        for meter in self._jobs.values():
            meter.look(now)
        self._workers = tuple(self._worker(load) for load in device.workers)

    def _absorb_gauges(self, readings: Readings, now: float) -> None:
        """Smooth each reading; a gauge without one has no mean, too."""
        self._gauges = {name: self._gauges.get(name) or Ewma(_gauge_tau_s(self._timing)) for name, _ in readings}
        for name, reading in readings:
            self._gauges[name].update(reading, now)

    def note_jobs(self, report: WorkerJobs, now: float) -> bool:
        """Take a worker's report of its jobs in; whether it is possible."""
        meter = self._jobs.setdefault(report.task, JobMeter(_job_tau_s(self._timing)))
        return meter.absorb(report, now)

    def note_end(self, task: TaskId) -> None:
        """The task's worker here has ended, or is started anew."""
        if task in self._jobs:
            self._jobs[task].end()

    def _link(self, sample: LinkSample, now: float) -> Link:
        rssi = None
        if sample.source is LinkSource.FIXED:  # the file's word, and no reading: nothing in it is an outlier
            rssi = sample.rssi_dbm
        elif sample.source is not LinkSource.WIRED:
            signal = self._signals.setdefault(sample.peer, SignalFilter(_signal_tau_s(self._timing)))
            rssi = signal.update(sample.rssi_dbm, now)
        return Link(
            source=sample.source,
            peer=sample.peer,
            rssi_dbm=rssi,
            bitrate_mbps=_possible(sample.bitrate_mbps, MAX_BITRATE_MBPS),
            retry_ratio=_possible(sample.retry_ratio, 1.0),
        )

    def _worker(self, load: WorkerLoad) -> WorkerLoad:
        cpu, memory = self._worker_cpu.get(load.task), self._worker_memory.get(load.task)
        runnable = self._worker_runnable.get(load.task)
        told = self._told(load.task, load.state)
        return replace(
            told,
            cpu_cores=told.cpu_cores if cpu is None else cpu.value,
            memory_mb=None if memory is None else memory.value,
            wanted_cores=_possible(load.wanted_cores, MAX_CPU_CORES),
            runnable=None if runnable is None else runnable.value,
        )

    def _told(self, task: TaskId, state: WorkerState) -> WorkerLoad:
        """What a worker says of its jobs: all that is known of one that somebody else started.

        Its use is that of its jobs then.
        """
        meter = self._jobs.get(task)
        if meter is None:
            return WorkerLoad(task=task, state=state)
        jobs = meter.value
        cores = None if jobs is None else min(jobs.done_hz * jobs.cpu_s, MAX_CPU_CORES)
        return WorkerLoad(
            task=task, state=state, cpu_cores=cores, jobs=jobs, unended_s=meter.unended_s(self._sampled_at)
        )

    def owe(self, now: float) -> None:
        """Somebody has come who knows nothing of this machine: the next profile is due within one beat."""
        self._sent_at = min(self._sent_at, now + self._timing.beat_s - self._timing.publish_s)

    def is_blind(self, now: float) -> bool:
        """Whether this machine was measured, and has not been for so long that profiles say nothing of its use."""
        return self._device is not None and now - self._sampled_at > BLIND_S

    def publishable(
        self,
        states: dict[TaskId, WorkerState],
        *,
        is_draining: bool,
        now: float,
        progress: tuple[TaskProgress, ...] = (),
        reasons: Mapping[TaskId, tuple[Trouble, str]] = NO_REASONS,
        echoes: tuple[Echo, ...] = (),
        relay: str = "",
        renewals: Mapping[TaskId, Renewal] = NO_RENEWALS,
        beats_now: bool = False,
    ) -> Profile | None:
        """The profile to send now, or ``None`` when nothing is due.

        Args:
            states: the workers' states as the node knows them (fresher than the sample's).
            is_draining: the operator drains this node, or it stops.
            now: monotonic seconds.
            progress: which watched tasks answer this robot.
            reasons: what is wrong with workers, and why they are not ready.
            echoes: which profiles this node has of others; they are no reason to send one.
            relay: what is wrong with this node's relay.
            renewals: which workers run by an old recipe.
            beats_now: a beat leaves at once: a profile that is nearly due goes with it, in the same packet.
        """
        early_s = self._timing.beat_s / 2 if beats_now else 0.0
        is_due = now - self._sent_at >= self._timing.publish_s - early_s
        flags = (is_draining, *states.values(), *reasons.values(), progress, bool(relay), *renewals.items())
        if not is_due and not self._is_new and flags == self._flags:
            return None  # nothing was measured since the last look
        self._is_new, self._flags = False, flags
        profile = self._current(states, reasons, renewals, is_draining=is_draining, now=now)
        if profile is None:
            return None
        if progress or relay:
            profile = replace(profile, progress=progress, relay=relay)
        if not is_due and self._sent is not None and not _differs(profile, self._sent):
            return None
        if echoes:
            profile = replace(profile, echoes=echoes)
        self._sequence += 1
        self.has_news = self._sent is None or _kinds(profile) != _kinds(self._sent)
        self._sent, self._sent_at = profile, now
        return profile

    def _current(
        self,
        states: dict[TaskId, WorkerState],
        reasons: Mapping[TaskId, tuple[Trouble, str]],
        renewals: Mapping[TaskId, Renewal],
        *,
        is_draining: bool,
        now: float,
    ) -> Profile | None:
        if self._device is None:
            return None
        is_measured = now - self._sampled_at <= STALE_S
        loads = {load.task: load for load in self._workers} if is_measured else {}
        workers = tuple(
            replace(
                loads.get(task) or (self._told(task, state) if is_measured else WorkerLoad(task=task, state=state)),
                state=state,
                trouble=reasons.get(task, _WELL)[0],
                reason=reasons.get(task, _WELL)[1],
                renewal=renewals.get(task, Renewal.NONE),
            )
            for task, state in sorted(states.items())
        )
        return Profile(
            node=self._node,
            incarnation=self._incarnation,
            sequence=self._sequence,
            cpu_cores=self._device.cpu_cores,
            cpu_used_cores=self._cpu.value if is_measured else None,
            memory_mb=self._device.memory_mb,
            memory_used_mb=self._memory.value if is_measured else None,
            links=self._links if is_measured else tuple(Link(source=one.source, peer=one.peer) for one in self._links),
            workers=workers,
            draining=is_draining,
            speed=self._device.speed,
            cpu_pressure=self._pressure.value if is_measured else None,
            runnable=self._runnable.value if is_measured else None,
            gauges=self._readings() if is_measured else (),
        )

    def _readings(self) -> Readings:
        """The means of all gauges, in as many digits as tell something."""
        means = ((name, mean.value) for name, mean in self._gauges.items())
        return tuple((name, round(value, 3)) for name, value in means if value is not None)


def _gauge_tau_s(timing: Timing) -> float:
    return max(timing.smoothing_s, GAUGE_SMOOTHING_S)


def _job_tau_s(timing: Timing) -> float:
    return max(timing.smoothing_s, JOB_SMOOTHING_S)


def _signal_tau_s(timing: Timing) -> float:
    """The time constant of signals; 0 or close to it, below the samples' period, switches their smoothing off, too."""
    is_smoothed = timing.smoothing_s >= timing.sample_s
    return max(timing.smoothing_s, SIGNAL_SMOOTHING_S) if is_smoothed else timing.smoothing_s


def _absorb_use(
    whole: Ewma,
    shares: dict[TaskId, Ewma],
    used: float | None,
    parts: dict[TaskId, float | None],
    high: float,
    now: float,
) -> None:
    """Smooth the machine's use, and each worker's share of it, in step.

    A share must be as slow as the whole from which it is subtracted, and see the same samples. A worker without a
    figure (stopped, just started) uses nothing in that sample. So whole minus share is the smoothed rest, and the start
    or end of a worker makes its node look neither better nor worse. Without a figure of the machine for `STALE_S` there
    is neither.
    """
    used = _possible(used, high)
    if used is None:
        for mean in (whole, *shares.values()):
            mean.look(now)
        return
    for task in {**shares, **parts}:
        part = _possible(parts.get(task), high)
        if part is not None and task not in shares:
            shares[task] = whole.share()
        if task in shares:
            shares[task].update(part or 0.0, now)
    whole.update(used, now)


def _absorb_known(mean: Ewma, figure: float | None, high: float, now: float) -> None:
    """Smooth a figure; without a measurement the mean is absent, too."""
    known = _possible(figure, high)
    if known is None:
        mean.value = None
    else:
        mean.update(known, now)


def _possible(value: float | None, high: float) -> float | None:
    """``value`` when it is in [0, ``high``], else ``None`` (NaN included): drivers may invent figures."""
    return value if value is not None and 0.0 <= value <= high else None


def _differs(new: Profile, old: Profile) -> bool:
    """Whether ``new`` could lead a robot to another decision than ``old``."""
    if _kinds(new) != _kinds(old):
        return True
    if _moved(new.cpu_used_cores, old.cpu_used_cores, RATIO_CHANGE * new.cpu_cores):
        return True
    if _moved(new.memory_used_mb, old.memory_used_mb, RATIO_CHANGE * new.memory_mb):
        return True
    if any(_lost_or_won(new.worker(load.task), load) for load in old.workers):
        return True
    before = {link.peer: link.rssi_dbm for link in old.links}
    return any(_moved(link.rssi_dbm, before.get(link.peer), RSSI_CHANGE_DB) for link in new.links)


def _lost_or_won(new: WorkerLoad | None, old: WorkerLoad) -> bool:
    """Whether a worker's time per job, or its share of done jobs, has changed."""
    if new is None or new.jobs is None or old.jobs is None:
        return (None if new is None else new.jobs) is not old.jobs
    if _moved(new.jobs.done_ratio, old.jobs.done_ratio, JOB_CHANGE):
        return True
    return abs(new.jobs.time_s - old.jobs.time_s) >= JOB_CHANGE * max(new.jobs.time_s, old.jobs.time_s)


def _kinds(profile: Profile) -> tuple[object, ...]:
    """The parts of a profile that are no figures: every change of them counts."""
    workers = [(load.task, load.state, load.trouble, load.renewal, bool(load.reason)) for load in profile.workers]
    # what a worker that is ready complains of is a count: it goes along with the figures
    reasons = [load.reason for load in profile.workers if load.state is not WorkerState.READY]
    links = [(link.peer, link.source) for link in profile.links]
    return profile.draining, workers, reasons, profile.progress, bool(profile.relay), links


def _moved(new: float | None, old: float | None, threshold: float) -> bool:
    if new is None or old is None:
        return (new is None) != (old is None)
    return abs(new - old) >= threshold
