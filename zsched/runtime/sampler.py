"""Measures this machine, its links and its clocks again and again, and posts what it finds.

Knows: which reader there is for what, how often. Does not know: what a reading is for.
"""

from __future__ import annotations

import logging
import math
import threading
from pathlib import Path

from zsched.core.profile.sampling import Sampling
from zsched.core.values import events as ev
from zsched.core.values.fleet import NodeSpec
from zsched.core.values.struct import replace
from zsched.core.vote.clocks import is_bad
from zsched.host.clock import ClockWatch, monotonic_s
from zsched.host.guard import guarded
from zsched.host.machine import core_speed
from zsched.host.machine.device_profiler import RESTING_LOOK_S, DeviceProfiler
from zsched.host.machine.gauges import GaugeWatch
from zsched.host.paths import PID_SUFFIX, beside_session
from zsched.host.radio.network_profiler import readers_for
from zsched.runtime.inbox import Inbox
from zsched.runtime.shell import Shell

log = logging.getLogger("zsched.daemon")


class Sampler:
    """Measures the machine and its links in a thread of its own: a slow driver must not stop the beats."""

    def __init__(
        self,
        spec: NodeSpec,
        period_s: float,
        state_dir: Path,
        shell: Shell,
        inbox: Inbox,
        *,
        is_watched: bool = True,
    ) -> None:
        """``period_s``: at most so long lies between two samples while anything changes.

        ``is_watched``: the clocks must be compared as often at all times, for an exclusive task.
        """
        self._links, self._readers = spec.links, readers_for(spec)
        self._links_read = 0
        """How many there were when they were read last."""
        self._state_dir = state_dir
        self._device, self._clocks, self._gauges = DeviceProfiler(), ClockWatch(), GaugeWatch()
        self._shell, self._inbox = shell, inbox
        self._pace, self._is_watched = Sampling(period_s=period_s), is_watched
        self._wait_s = period_s
        self._stop, self._wake = threading.Event(), threading.Event()
        self._has_work = threading.Event()
        """Work has come since the workers' threads and children were last looked at for that..."""
        self._looked_at = -math.inf
        """...and when they were."""
        self._problems: dict[str, str | None] = {}
        self._thread = guarded(self._run, name="zsched-sampler")

    def start(self) -> None:
        """Begin measuring."""
        self._gauges.start()
        self._thread.start()

    def hurry(self) -> None:
        """Something happens here that a sample may show: measure often again, and closely; from any thread."""
        self._has_work.set()
        if self._wait_s > self._pace.period_s:
            self._wake.set()

    def measure(self, spec: NodeSpec, period_s: float, *, is_watched: bool = True) -> None:
        """Measure these links, at this pace, from the next time on."""
        self._pace.period_s, self._is_watched = period_s, is_watched
        if spec.links != self._links:
            self._links, self._readers = spec.links, readers_for(spec)

    def stop(self) -> None:
        """End measuring; the thread ends with its current reading."""
        self._stop.set()
        self._wake.set()
        self._gauges.stop()
        self._thread.join(timeout=0.5)

    def _run(self) -> None:
        self._device.speed = core_speed.kept_or_new(self._state_dir)
        while not self._stop.is_set():
            try:
                self._compare_clocks()
                self._look_closely(monotonic_s())
                self._sample()
            except Exception as error:
                log.exception("sample_failed")
                self._report("profile", f"cannot measure: {error}")
            else:
                self._report("profile", None)
            if self._wake.wait(self._wait_s):
                self._wake.clear()
                self._pace.hurry(monotonic_s())

    def _look_closely(self, now: float) -> None:
        """Let the next sample find a child that a worker at rest has started, for it would count as others' load.

        Not at each report of jobs: a worker that does a little speaks several times a second.
        """
        if self._has_work.is_set() and now - self._looked_at >= RESTING_LOOK_S:
            self._has_work.clear()
            self._looked_at = now
            self._device.look_closely()

    def _report(self, source: str, problem: str | None) -> None:
        """Report a problem, or its end, when it is news."""
        if self._problems.get(source) != problem:
            self._problems[source] = problem
            self._inbox.post(ev.ProblemReported(source=source, problem=problem))

    def _compare_clocks(self) -> None:
        drift = self._clocks.look()
        if drift is None:
            return
        event = ev.ClockCompared(error_ratio=drift.error_ratio, jump_s=drift.jump_s, since_s=drift.since_s)
        if is_bad(event):
            self._inbox.post(event)
        else:
            self._inbox.post_quietly(event)

    def _sample(self) -> None:
        supervisor = self._shell.crew.supervisor
        states, pids = (supervisor.states(), supervisor.pids()) if supervisor is not None else ({}, {})
        sessions = self._shell.crew.sessions
        device = self._device.sample(
            {task: (state, noted_pid(sessions.get(task), pids.get(task))) for task, state in states.items()}
        )
        device = replace(device, gauges=self._gauges.newest(monotonic_s()))
        readers = self._readers
        links = tuple(reader.read() for reader in readers)
        was_resting = self._wait_s > self._pace.period_s
        self._wait_s = self._pace.next_s(device, links, monotonic_s(), is_watched=self._is_watched)
        sampled = ev.ProfileSampled(device=device, links=links)
        if was_resting and self._wait_s <= self._pace.period_s:
            self._inbox.post(sampled)  # it shows a change: the loop may sleep for a while
        else:
            self._inbox.post_quietly(sampled)
        self._report("profile/cpu", self._device.problem)
        for index in range(max(len(readers), self._links_read)):
            # One that the fleet file does not name any more has no problem.
            self._report(f"profile/link{index}", readers[index].problem if index < len(readers) else None)
        self._links_read = len(readers)


def noted_pid(session: Path | None, driver: int | None) -> int | None:
    """The process whose load is the task's: the one that a worker's driver has noted, else the worker's own.

    Args:
        session: the worker's session file.
        driver: the process that the daemon has started.
    """
    if session is None or driver is None:
        return driver
    try:
        words = beside_session(session, PID_SUFFIX).read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError):
        return driver
    is_its = len(words) == 2 and words[1] == str(driver) and words[0].isdecimal()
    return int(words[0]) if is_its else driver
