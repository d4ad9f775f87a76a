"""PROFILE, a worker's threads: which of them would use a whole core if they never had to wait?

Knows: shares of time, smoothing. Does not know: where the kernel reports them
(`zsched.host.machine.device_profiler`), needs.
"""

from __future__ import annotations

from collections.abc import Mapping

from zsched.core.profile.means import Ewma

ALWAYS = 0.9
"""A thread that runs or waits to run for this share of the time always wants to run."""
APPETITE_S = 1.5
"""Time constant of that share: a job once a second, with pauses between, must not look like such a thread."""

Thread = tuple[int, str]
"""(process, thread)."""


class Appetite:
    """The threads of one worker."""

    def __init__(self) -> None:
        self._at = 0.0
        self._times: Mapping[Thread, tuple[float, float]] = {}
        self._shares: dict[Thread, tuple[Ewma, Ewma]] = {}
        """{thread: share of the time that it ran, and that it ran or waited}."""
        self.runnable: float | None = None
        """How many of them ran or waited between the last two looks, on the mean; ``None``: there were not two."""

    def look(self, times: Mapping[Thread, tuple[float, float]], now: float) -> None:
        """Take in how long every thread has run, and has waited to run, in seconds since it began.

        The kernel reports a wait at its end, so one look may show more than the time since the last. Only the mean is
        bounded.
        """
        elapsed_s = now - self._at
        if elapsed_s <= 0.0:
            return
        shares = {}
        spent_s = 0.0
        for thread, (run_s, wait_s) in times.items():
            if thread not in self._times:
                continue
            run_before_s, wait_before_s = self._times[thread]
            known = self._shares.get(thread)
            ran, wanted = shares[thread] = known or (_from_nothing(self._at), _from_nothing(self._at))
            ran.update(max(run_s - run_before_s, 0.0) / elapsed_s, now)
            both_s = max(run_s + wait_s - run_before_s - wait_before_s, 0.0)
            wanted.update(both_s / elapsed_s, now)
            spent_s += both_s
        self.runnable = spent_s / elapsed_s if shares else None
        self._at, self._times, self._shares = now, times, shares

    def wanted_cores(self) -> float | None:
        """Cores that its threads would use; ``None`` when no thread always wants to run."""
        shares = [(ran.value or 0.0, wanted.value or 0.0) for ran, wanted in self._shares.values()]
        if all(wanted < ALWAYS for _, wanted in shares):
            return None
        return sum((min(wanted if wanted >= ALWAYS else ran, 1.0) for ran, wanted in shares), 0.0)


def _from_nothing(at: float) -> Ewma:
    mean = Ewma(APPETITE_S)
    mean.update(0.0, at)
    return mean
