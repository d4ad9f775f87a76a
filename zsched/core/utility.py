"""The paper's equations 1 to 4, by the readings of docs/decisions/0001, and a form of them without a blind spot.

Knows: arithmetic. Does not know: nodes, tasks, time.

The equations as printed contradict the text in places (Eq. 1 with beta "available" would pick the busiest node); here
beta and mu are what is *in use*, predicted as if the candidate had the task, and every term is clamped to [0, 1].

That clamp makes all machines alike that have less left than the task needs, idle or starved, and in a sum spare memory
hides a starved CPU. `ScoreForm.DIMINISHING` compares what is there for the task with what it needs, which is never 0
before nothing is left, and multiplies. The offline study compares both; a fleet file cannot choose it yet.
"""

from __future__ import annotations

from zsched.core.model import ScoreForm, Weights


def clamp(value: float) -> float:
    """``value`` cut to [0, 1].

    >>> clamp(1.2), clamp(-3.0)
    (1.0, 0.0)
    """
    return min(max(value, 0.0), 1.0)


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


ROOM_FOR = 2.0
"""A machine is worth 1/2 when it has so many times what the task needs."""
LEAST_NEED_RATIO = 0.05
"""A task counts as needing at least this share of a machine: also of a small one more room is better."""


def room_utility(free: float, demand: float, capacity: float) -> float:
    """``free / (free + 2 demand)``: what there is for the task, against what it needs; diminishing, never clamped.

    Args:
        free: not in use by others, in cores or MiB; below 0 counts as 0.
        demand: of the task, in the same unit, >= 0.
        capacity: of the machine, in the same unit, > 0.

    >>> room_utility(free=4.0, demand=2.0, capacity=4.0), room_utility(free=0.4, demand=4.0, capacity=4.0)
    (0.5, 0.047619047619047616)
    """
    room = max(free, 0.0)
    return room / (room + ROOM_FOR * max(demand, LEAST_NEED_RATIO * capacity))


KNEE_UTILITY = 0.8
"""What a link is worth at its knee."""


def network_utility(signal_dbm: float, nu_dbm: float, rho_dbm: float, knee_dbm: float | None = None) -> float:
    """Eq. 3, ``kappa = (lambda - nu) / (rho - nu)``: the link's share of what is achievable.

    With a knee it is piecewise linear through (nu, 0), (knee, `KNEE_UTILITY`) and (rho, 1): delays are flat above some
    signal and rise steeply below it.

    Args:
        signal_dbm: the link's smoothed signal.
        nu_dbm: least usable signal.
        rho_dbm: best achievable signal, > nu.
        knee_dbm: between the two, or ``None``: linear, as printed.

    >>> network_utility(signal_dbm=-60.0, nu_dbm=-80.0, rho_dbm=-40.0)
    0.5
    >>> network_utility(signal_dbm=-70.0, nu_dbm=-80.0, rho_dbm=-40.0, knee_dbm=-60.0)
    0.4
    """
    if knee_dbm is None:
        return clamp((signal_dbm - nu_dbm) / (rho_dbm - nu_dbm))
    if signal_dbm < knee_dbm:
        return KNEE_UTILITY * clamp((signal_dbm - nu_dbm) / (knee_dbm - nu_dbm))
    return KNEE_UTILITY + (1.0 - KNEE_UTILITY) * clamp((signal_dbm - knee_dbm) / (rho_dbm - knee_dbm))


def total_utility(
    weights: Weights,
    *,
    cpu: float | None,
    memory: float | None,
    network: float | None,
    measured: frozenset[str],
    form: ScoreForm = ScoreForm.PAPER,
) -> float | None:
    """Eq. 4, the weighted sum; weights of metrics that nobody measured are dropped and the rest renormalised.

    `ScoreForm.DIMINISHING`: the weighted geometric mean instead. A weight says by how many percent the utility falls
    when that term falls by one percent, whatever the others are.

    Args:
        weights: omega, sum 1.
        cpu: eta, in [0, 1], or ``None`` when not measured here.
        memory: sigma, likewise.
        network: kappa, likewise.
        measured: which of ``cpu``, ``memory``, ``network`` any candidate has.
        form: sum or geometric mean.

    Returns:
        The utility in [0, 1]; ``None`` when a weighted metric that others have is missing here, or nothing is left.

    >>> w = Weights(cpu=0.5, memory=0.25, network=0.25)
    >>> total_utility(w, cpu=0.8, memory=0.4, network=None, measured=frozenset({"cpu", "memory"}))
    0.6666666666666666
    """
    is_sum = form is ScoreForm.PAPER
    share, total = 0.0, 0.0 if is_sum else 1.0
    for name, weight, term in (
        ("cpu", weights.cpu, cpu),
        ("memory", weights.memory, memory),
        ("network", weights.network, network),
    ):
        if weight <= 0.0 or name not in measured:
            continue
        if term is None:
            return None
        share += weight
        total = total + weight * term if is_sum else total * term**weight
    if share <= 0.0:
        return None
    return clamp(total / share) if is_sum else clamp(total ** (1.0 / share))
