"""Decides when which machine is busy: injected loads, a slow background, and what a profiler reads of both.

Knows: seeded histories of true use, the scatter of readings. Does not know: owners, what use is worth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadPlan:
    """How often, how long and how hard a machine is loaded; shares of the machine, times in seconds."""

    pause_s: tuple[float, float] = (30.0, 300.0)
    """Least pause between two loads, and the mean of what is added to it."""
    length_s: tuple[float, float] = (60.0, 240.0)
    cpu: tuple[float, float] = (0.4, 1.0)
    memory: tuple[float, float] = (0.1, 0.5)
    idle_cpu: tuple[float, float] = (0.05, 0.3)
    idle_memory: tuple[float, float] = (0.2, 0.4)


LONG = LoadPlan()
SHORT = LoadPlan(pause_s=(10.0, 60.0), length_s=(3.0, 20.0))
MIXED = LoadPlan(pause_s=(15.0, 120.0), length_s=(5.0, 180.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatter:
    """What readings add to the truth, as shares of the machine (`python -m zsched_lab.decisions.scatter` measures it).

    ``uniform`` replaces the normal scatter by a uniform one of this half width.
    """

    cpu: float = 0.06
    cpu_keep: float = 0.3
    """Correlation of a CPU reading's error with the one 0.2 s before."""
    spike_hz: float = 1 / 40
    spike_s: tuple[float, float] = (0.2, 1.2)
    memory: float = 0.003
    memory_keep: float = 0.9
    uniform: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Spikes:
    """Spikes of CPU readings on a machine of which a share up to ``below`` is in use."""

    below: float
    every_s: float
    height: tuple[float, ...]
    """Quantiles at even distances, as shares of the machine; between them as likely everywhere."""
    length_s: tuple[float, ...]

    def drawn(self, steps: int, dt_s: float, rng: np.random.Generator) -> Array:
        """What they add to each of ``steps`` readings."""
        out = np.zeros(steps)
        for begin in np.flatnonzero(rng.random(steps) < dt_s / self.every_s).tolist():
            height, length_s = (
                float(np.interp(rng.random(), np.linspace(0.0, 1.0, len(one)), one))
                for one in (self.height, self.length_s)
            )
            out[begin : begin + max(1, round(length_s / dt_s))] = height
        return out


SPIKES = (
    Spikes(below=0.25, every_s=18.4, height=(0.26, 0.29, 0.32, 0.37, 0.54), length_s=(0.2, 0.2, 0.2, 0.2, 0.6)),
    Spikes(below=0.75, every_s=3.6, height=(0.25, 0.27, 0.32, 0.36, 0.47), length_s=(0.2, 0.2, 0.2, 0.6, 1.6)),
)
"""As `zsched_lab.decisions.spikes` measured them on the demo's edges; it found none on a machine that is fuller."""


def loads(steps: int, dt_s: float, plan: LoadPlan, rng: np.random.Generator) -> tuple[Array, Array]:
    """One machine's true use of CPU and memory by others than the task, as shares of the machine, [steps] each."""
    cpu = np.full(steps, rng.uniform(*plan.idle_cpu))
    memory = np.full(steps, rng.uniform(*plan.idle_memory))
    at_s = float(rng.exponential(plan.pause_s[1]))
    while at_s < steps * dt_s:
        end_s = at_s + float(rng.uniform(*plan.length_s))
        window = slice(round(at_s / dt_s), round(end_s / dt_s))
        cpu[window] += rng.uniform(*plan.cpu)
        memory[window] += rng.uniform(*plan.memory)
        at_s = end_s + plan.pause_s[0] + float(rng.exponential(plan.pause_s[1]))
    return np.minimum(cpu, 1.0), np.minimum(memory, 0.97)


def readings(true: Array, scatter: Scatter, dt_s: float, rng: np.random.Generator, *, is_cpu: bool) -> Array:
    """What the device profiler reads of a true share [steps]: scattered, with a short spike now and then (CPU)."""
    if scatter.uniform is not None:
        return np.clip(true + rng.uniform(-scatter.uniform, scatter.uniform, len(true)), 0.0, 1.0)
    if not is_cpu:
        return np.clip(true + correlated(len(true), scatter.memory, scatter.memory_keep, rng), 0.0, 1.0)
    noise = correlated(len(true), scatter.cpu, scatter.cpu_keep, rng)
    for begin in np.flatnonzero(rng.random(len(true)) < scatter.spike_hz * dt_s).tolist():
        noise[begin : begin + max(1, round(float(rng.uniform(*scatter.spike_s)) / dt_s))] += 1.0
    return np.clip(true + noise, 0.0, 1.0)


def correlated(steps: int, deviation: float, keep: float, rng: np.random.Generator) -> Array:
    """Normal noise [steps] whose neighbours correlate by ``keep`` (an AR(1) process)."""
    fresh = rng.normal(0.0, deviation * float(np.sqrt(1.0 - keep**2)), steps).tolist()
    out = np.empty(steps)
    value = 0.0
    for index, new in enumerate(fresh):
        value = keep * value + new
        out[index] = value
    return out
