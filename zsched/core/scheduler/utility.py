"""The paper's equations 1 to 4, by the readings of docs/decisions/0001, and a form of them without a blind spot.

Knows: arithmetic. Does not know: nodes, tasks, time.

The equations as printed contradict the text in places (Eq. 1 with beta "available" would pick the busiest node); here
beta and mu are what is *in use*, predicted as if the candidate had the task, and every term is clamped to [0, 1].

That clamp makes all machines alike that have less left than the task needs, idle or starved, and in a sum spare memory
hides a starved CPU. `ScoreForm.SERVICE` says which share of its work a task would get done, which is never 0 before
nothing is left, and multiplies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Set as AbstractSet

from zsched.core.values.model import ScoreForm, Weights


def clamp(value: float) -> float:
    """``value`` cut to [0, 1].

    >>> clamp(1.2), clamp(-3.0)
    (1.0, 0.0)
    """
    return value if 0.0 <= value <= 1.0 else min(max(value, 0.0), 1.0)


def predicted_use(use: float, own_worker: float, demand: float) -> float:
    """What would be in use if the candidate had the task: one formula for every candidate, owner or not.

    Without it the owner always looks worse by the load of the task itself, and the task oscillates.

    Args:
        use: in use now (cores or MiB, >= 0).
        own_worker: of that, by this task's worker there (idle standby or active).
        demand: what the task will use where it runs.

    >>> predicted_use(use=1.0, own_worker=0.4, demand=0.5)
    1.1
    """
    return max(use - own_worker, 0.0) + demand


def cpu_utility(gamma: float, beta: float) -> float:
    """Eq. 1, ``eta = (gamma - beta) / gamma``: the free fraction of the CPU.

    Args:
        gamma: cores that may be used, > 0.
        beta: cores predicted to be in use, >= 0.

    >>> cpu_utility(gamma=4.0, beta=1.0)
    0.75
    """
    return clamp((gamma - beta) / gamma)


def memory_utility(delta: float, theta: float, mu: float) -> float:
    """Eq. 2, ``sigma = (delta - theta - mu) / delta``: the free fraction of the memory once the task is there.

    Args:
        delta: memory in all, MiB, > 0.
        theta: the task's demand, MiB, >= 0.
        mu: in use without this task, MiB, >= 0.

    >>> memory_utility(delta=4000.0, theta=400.0, mu=1600.0)
    0.5
    """
    return clamp((delta - theta - mu) / delta)


LEAST_NEED_RATIO = 0.05
"""Of what is free a task counts as needing at least this share of a machine: also of a small one more is better."""
SPARE = 0.02
"""The part of a term that is the machine's free share: enough to place tasks apart, and less than the default bonus in
CPU and memory together, so a task that lacks nothing does not move for more room."""


def service_utility(free: float, demand: float, capacity: float, *, least: float = 0.0, share: float = 1.0) -> float:
    """The share of its work that a task would get done, ``min(free / demand, 1)``, and a little for what is left free.

    Args:
        free: not in use by others, in cores or MiB; below 0 counts as 0. Of an owner with nothing to spare it is what
            the task gets there.
        demand: of the task, in the same unit, >= 0.
        capacity: of the machine, in the same unit, > 0.
        least: what the task gets there if it needs it, however little is free, in the same unit, >= 0.
        share: what counts of that share of its work, in [0, 1]: less where it got less than was foreseen, or gets it
            too late (`on_time`).

    >>> round(service_utility(free=1.0, demand=2.0, capacity=4.0), 4)
    0.495
    >>> round(service_utility(free=4.0, demand=2.0, capacity=4.0), 4)
    1.0
    >>> round(service_utility(free=0.0, demand=0.1, capacity=16.0, least=0.9), 4)
    0.9801
    """
    room = clamp(free / max(demand, LEAST_NEED_RATIO * capacity))
    if room < 1.0 and demand > 0.0:
        # By the need itself: a small task that gets all that it needs lacks as little on a large machine.
        room, free = clamp(max(room, least / demand)), max(free, min(least, demand))
    return (1.0 - SPARE) * share * room + SPARE * clamp(free / capacity)


STEEPNESS = 4.0
"""Of the share of jobs within the deadline over their median time: how little the times of one task's jobs spread."""


def on_time(job_s: float, deadline_s: float) -> float:
    """The share of jobs expected within the deadline, where they take ``job_s`` (0 or more) in the middle.

    Times of jobs are skewed to the right; they are taken for log-logistic (Fisk 1961), ``1 / (1 + (t / d)^4)``: the
    middle half lies within a factor of 1.7. So there is no edge at which a machine is worth nothing, or no better than
    another one, and what is judged is what counts: deadlines missed, not milliseconds.

    >>> [round(on_time(job_s, 0.1), 3) for job_s in (0.0, 0.05, 0.1, 0.2)]
    [1.0, 0.941, 0.5, 0.059]
    """
    ratio = min(job_s / deadline_s, 1e6)
    return 1.0 / (1.0 + math.pow(ratio, STEEPNESS))


LATE_WORTH = 0.1
"""A job that comes too late is worth this part of one in time."""


def timely_worth(on_time_ratio: float) -> float:
    """What a task's jobs are worth of which this share comes in time, in [`LATE_WORTH`, 1].

    A late job keeps a little worth. Else machines would be alike where none can keep the deadline, and a task stay on
    one that does a tenth of its jobs.

    >>> [round(timely_worth(ratio), 2) for ratio in (0.0, 0.5, 1.0)]
    [0.1, 0.55, 1.0]
    """
    return LATE_WORTH + (1.0 - LATE_WORTH) * on_time_ratio


def network_utility(signal_dbm: float, nu_dbm: float, rho_dbm: float) -> float:
    """Eq. 3, ``kappa = (lambda - nu) / (rho - nu)``: the link's share of what is achievable.

    Args:
        signal_dbm: the link's smoothed signal.
        nu_dbm: least usable signal.
        rho_dbm: best achievable signal, > nu.

    >>> network_utility(signal_dbm=-60.0, nu_dbm=-80.0, rho_dbm=-40.0)
    0.5
    """
    return clamp((signal_dbm - nu_dbm) / (rho_dbm - nu_dbm))


class Total:
    """Eq. 4, the weighted sum; weights of metrics that nobody measured are dropped and the rest renormalised.

    `ScoreForm.SERVICE`: a product instead, each term to the power of its weight over the largest one. The metric that
    weighs most counts as it is, one of half its weight as its square root: a weight says by how many percent of it the
    utility falls when that term falls by one percent, whatever the others are.

    >>> total = Total(Weights(cpu=0.5, memory=0.25, network=0.25), {"cpu", "memory"})
    >>> total.of({"cpu": 0.8, "memory": 0.4})
    0.6666666666666666
    """

    def __init__(self, weights: Weights, measured: AbstractSet[str], form: ScoreForm = ScoreForm.PAPER) -> None:
        """``measured``: which of cpu, memory, network and the gauges any candidate has."""
        self._shares = [(name, weight) for name, weight in weights.shares if weight > 0.0 and name in measured]
        self._is_sum = form is ScoreForm.PAPER
        weighed = [weight for _, weight in self._shares]
        self._whole = sum(weighed, 0.0) if self._is_sum else max(weighed, default=1.0)

    def of(self, terms: Mapping[str, float | None]) -> float | None:
        """The utility in [0, 1]; ``None`` when a weighted metric that others have is missing, or nothing is left.

        ``terms``: {metric: eta, sigma, kappa or a gauge's term, each in [0, 1]}, of those that are measured here.
        """
        total, product = 0.0, 1.0
        for name, weight in self._shares:
            term = terms.get(name)
            if term is None:
                return None
            if self._is_sum:
                total += weight * term
            else:
                product *= term ** (weight / self._whole)
        if not self._shares:
            return None
        return clamp(total / self._whole if self._is_sum else product)
