"""Decides what a simulated fleet is: its machines, one task, the true state at every step and what is read of it.

Knows: true use and true signals, readings, the utility of the true state. Does not know: rules, decisions.

Time goes in steps of 0.2 s, the profilers' period. A candidate's use is that of everything but the task: what the
task's worker uses itself is subtracted by the core (`zsched.core.scheduler.utility.predicted_use`), so it cancels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from zsched.core.values.fleet import Demand, Fleet, LinkLimits, NodeSpec, TaskSpec, Timing
from zsched.core.values.model import NodeId, NodeKind, Tuning, Weights
from zsched.core.values.quorum import majority
from zsched_lab.decisions import loads, radio
from zsched_lab.decisions.loads import Array, LoadPlan, Scatter

DT_S: Final = 0.2
TASK: Final = "task"
EVEN: Final = Weights(cpu=0.5, memory=0.5, network=0.0)
WITH_RADIO: Final = Weights(cpu=0.3, memory=0.2, network=0.5)
RADIO_ONLY: Final = Weights(cpu=0.0, memory=0.0, network=1.0)
MEMORY_MB: Final = 4000.0
DEMAND: Final = Demand(cpu_cores=0.4, memory_mb=250.0)
BAD_DBM: Final = -75.0
"""Below it, for a majority of the robots, the owner counts as bad: the recorded delay has tripled by then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """One seeded history of one fleet.

    Shapes: T steps, R robots, C candidates. ``cpu`` and ``memory`` [T, C] are shares of the machine, ``signal`` is
    dBm: [T, R, C] from each robot to each candidate, or [T, R] from each robot to the access point when the candidates
    are the robots, or ``None`` (cables).
    """

    name: str
    fleet: Fleet
    cores: Array
    cpu: Array
    memory: Array
    cpu_read: Array
    memory_read: Array
    signal: Array | None = None
    signal_read: Array | None = None
    step_at_s: float | None = None
    """When the first candidate gets 30 % worse, if that is what the history is about."""

    @property
    def spec(self) -> TaskSpec:
        """The one task."""
        return self.fleet.tasks[0]

    @property
    def candidates(self) -> tuple[NodeId, ...]:
        """The task's candidates; the columns of the arrays are in this order."""
        return self.spec.candidates

    @property
    def steps(self) -> int:
        """How many steps the history has."""
        return len(self.cpu)

    def between(self) -> Array | None:
        """True signals [T, R, C] between robots and candidates.

        Through one access point the delays of both ways add up. The robots' own ways are part of that whichever node
        has the task; what is decided about is the candidate's way, so that is what counts.
        """
        if self.signal is None or self.signal.ndim == 3:
            return self.signal
        return np.repeat(self.signal[:, None, :], self.signal.shape[1], axis=1)


def true_utility(world: World) -> Array:
    """Eq. 1-6 on the true state, [T, C]: what `score` and `compare` would say without scatter, delay or smoothing.

    A candidate that a majority does not reach is worth 0.
    """
    spec, weights = world.spec, world.spec.tuning.weights
    cpu = np.clip(1.0 - world.cpu - spec.demand.cpu_cores / world.cores, 0.0, 1.0)
    memory = np.clip(1.0 - world.memory - spec.demand.memory_mb / MEMORY_MB, 0.0, 1.0)
    signal = world.between()
    if signal is None:  # cables count 1
        return weights.cpu * cpu + weights.memory * memory + weights.network
    nu, rho = spec.limits.nu_dbm, spec.limits.rho_dbm
    reached = np.isfinite(signal) & (signal >= nu)
    network = np.where(reached, np.clip((signal - nu) / (rho - nu), 0.0, 1.0), 0.0)
    own = weights.cpu * cpu + weights.memory * memory
    each = np.where(reached, own[:, None, :] + weights.network * network, 0.0)
    joint: Array = np.where(reached.sum(axis=1) >= majority(signal.shape[1]), each.mean(axis=1), 0.0)
    return joint


def bad(world: World) -> npt.NDArray[np.bool_]:
    """Whether [T, C] the task lacks CPU or memory there, or a majority of the robots hardly reaches it."""
    spec = world.spec
    short = world.cpu + spec.demand.cpu_cores / world.cores > 1.0
    short |= world.memory + spec.demand.memory_mb / MEMORY_MB > 0.95
    signal = world.between()
    if signal is not None:
        weak = ~(np.nan_to_num(signal, nan=-200.0) >= BAD_DBM)
        short |= weak.sum(axis=1) >= majority(signal.shape[1])
    return np.asarray(short)


def build_fleet(robots: int, edges: int, weights: Weights, timing: Timing, *, are_robots_candidates: bool) -> Fleet:
    """Robots and edges, and one task without a worker command (its readiness is nobody's business here)."""
    names = [f"robot{index + 1:03d}" for index in range(robots)]
    stations = [f"edge{index + 1:03d}" for index in range(edges)]
    spec = TaskSpec(
        name=TASK,
        candidates=tuple(names if are_robots_candidates else stations),
        tuning=Tuning(weights=weights),
        demand=DEMAND,
        limits=LinkLimits(),
    )
    nodes = [NodeSpec(name=name, kind=NodeKind.EDGE) for name in stations]
    nodes += [NodeSpec(name=name, kind=NodeKind.ROBOT) for name in names]
    return Fleet(name="lab", timing=timing, nodes=tuple(nodes), tasks=(spec,), electors=tuple(names))


def loaded_world(
    *,
    seed: int,
    hours: float,
    edges: int = 3,
    plan: LoadPlan = loads.LONG,
    scatter: Scatter | None = None,
    with_radio: bool = False,
    robots: int = 3,
) -> World:
    """Edges under injected loads; with ``with_radio`` also robots that drive among them."""
    rng = np.random.default_rng(seed)
    steps = round(hours * 3600 / DT_S)
    scatter = scatter or Scatter()
    columns = [loads.loads(steps, DT_S, plan, rng) for _ in range(edges)]
    cpu, memory = (np.stack([column[part] for column in columns], axis=1) for part in (0, 1))
    signal = radio.hall_signals(steps, DT_S, robots, edges, rng) if with_radio else None
    kind = "radio" if with_radio else {loads.LONG: "long", loads.SHORT: "short", loads.MIXED: "mixed"}.get(plan, "own")
    weights = WITH_RADIO if with_radio else EVEN
    return World(
        name=f"{kind}-{edges}",
        fleet=build_fleet(robots, edges, weights, Timing(), are_robots_candidates=False),
        cores=np.asarray([2.0 if edge == 0 else 4.0 for edge in range(edges)]),
        cpu=cpu,
        memory=memory,
        cpu_read=_read(cpu, scatter, rng, is_cpu=True),
        memory_read=_read(memory, scatter, rng, is_cpu=False),
        signal=signal,
        signal_read=None if signal is None else signal + radio.fading_db(signal.shape, rng),
    )


def _read(true: Array, scatter: Scatter, rng: np.random.Generator, *, is_cpu: bool) -> Array:
    columns = [loads.readings(true[:, index], scatter, DT_S, rng, is_cpu=is_cpu) for index in range(true.shape[1])]
    return np.stack(columns, axis=1)


def equal_world(*, seed: int, hours: float, half_width: float = 0.15, step_at_s: float | None = None) -> World:
    """Two equal edges with uniform noise on every reading; from ``step_at_s`` on the first one is 30 % worse.

    With a step, the second edge is as much worse for the first 10 s, so that every rule begins on the first one.
    """
    rng = np.random.default_rng(seed)
    steps = round(hours * 3600 / DT_S)
    use = np.full((steps, 2), 0.4)
    if step_at_s is not None:
        use[: round(10.0 / DT_S), 1] += 0.3
        use[round(step_at_s / DT_S) :, 0] += 0.3
    scatter = Scatter(uniform=half_width)
    return World(
        name="step" if step_at_s is not None else "equal",
        fleet=build_fleet(3, 2, EVEN, Timing(), are_robots_candidates=False),
        cores=np.full(2, 4.0),
        cpu=use,
        memory=use.copy(),
        cpu_read=_read(use, scatter, rng, is_cpu=True),
        memory_read=_read(use, scatter, rng, is_cpu=True),
        step_at_s=step_at_s,
    )


def robots_world(*, seed: int, hours: float, robots: int = 3) -> World:
    """Robots that drive through a hall with one access point in it, and have the task among themselves."""
    rng = np.random.default_rng(seed)
    steps = round(hours * 3600 / DT_S)
    signal = radio.hall_signals(steps, DT_S, robots, 1, rng)[:, :, 0]
    quiet = np.full((steps, robots), 0.2)
    return World(
        name="robots",
        fleet=build_fleet(robots, 0, RADIO_ONLY, Timing(), are_robots_candidates=True),
        cores=np.full(robots, 4.0),
        cpu=quiet,
        memory=quiet,
        cpu_read=quiet,
        memory_read=quiet,
        signal=signal,
        signal_read=signal + radio.fading_db(signal.shape, rng),
    )


def drives_world(drives: tuple[radio.Drive, ...], *, are_robots: bool) -> World:
    """A history in which every candidate's link follows one recorded drive.

    With ``are_robots`` the candidates are the robots, each of which reaches the others through one access point by its
    own link (the paper's Sec. VII-C). Otherwise they are edges on wheels, and the robots stand still beside the access
    point, so that a candidate's drive is all that counts.
    The true signal is the drive's mean over 11 s about each moment: what single readings scatter about.
    """
    steps = min(len(drive.rssi_dbm) for drive in drives)
    read = np.stack([drive.rssi_dbm[:steps] for drive in drives], axis=1)
    true = np.stack([_smooth(read[:, index]) for index in range(len(drives))], axis=1)
    quiet = np.full((steps, len(drives)), 0.2)
    if not are_robots:
        read, true = (np.repeat(values[:, None, :], 3, axis=1) for values in (read, true))
    fleet = build_fleet(len(drives), 0, RADIO_ONLY, Timing(), are_robots_candidates=True)
    if not are_robots:
        fleet = build_fleet(3, len(drives), RADIO_ONLY, Timing(), are_robots_candidates=False)
    return World(
        name="robots" if are_robots else "drives",
        fleet=fleet,
        cores=np.full(len(drives), 4.0),
        cpu=quiet,
        memory=quiet,
        cpu_read=quiet,
        memory_read=quiet,
        signal=true,
        signal_read=read,
    )


def _smooth(values: Array, window_s: float = 11.0) -> Array:
    """The mean over a window centred on each step, gaps left out."""
    window = np.ones(round(window_s / DT_S))
    held = np.isfinite(values)
    total = np.convolve(np.where(held, values, 0.0), window, mode="same")
    count = np.convolve(held.astype(float), window, mode="same")
    return np.where(count > 0, total / np.maximum(count, 1.0), np.nan)


def weighing(world: World, weights: Weights | None) -> World:
    """The same history under other weights; ``None``: under the task's own."""
    spec = world.spec
    tuning = spec.tuning if weights is None else replace(spec.tuning, weights=weights)
    return replace(world, fleet=replace(world.fleet, tasks=(replace(spec, tuning=tuning),)))
