"""How soon a fleet must be at rest once its faults are over: bounds by timing profile, each from what was measured.

Knows: the bounds, and how a batch of schedules is held against them. Does not know: what rest is, who plays schedules.

One schedule has a bound of its own, which leaves room for the rarest: every detection, vote, lease and first placement
of the profile one after the other. A batch is held to its quantiles, at about twice what was measured
(docs/develop/testing.md): a regression to three times as long fails, though no single schedule may break its own bound.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

AT_MOST_S: Mapping[str, float] = {"wired": 10.0, "wifi": 12.0, "wan": 15.0}
"""{timing profile: bound of a single schedule}."""
QUANTILES_S: Mapping[str, Mapping[int, float]] = {
    "wired": {90: 2.6, 99: 8.0},
    "wifi": {90: 3.0, 99: 8.0},
    "wan": {90: 7.0, 99: 12.0},
}
"""{timing profile: {percent of the schedules: when they must be at rest}}."""
FEWEST = {90: 30, 99: 300}
"""{percent: how many schedules of a profile tell it}."""


def quantile(times: Sequence[float], percent: int) -> float:
    """The time within which ``percent`` of some schedules came to rest."""
    ranked = sorted(times)
    return ranked[min(len(ranked) * percent // 100, len(ranked) - 1)]


def too_slow(times: Mapping[str, Sequence[float]]) -> list[str]:
    """What is wrong with a batch, given {timing profile: its schedules' seconds}; empty when nothing is."""
    found = []
    for name, bounds in QUANTILES_S.items():
        for percent, bound_s in bounds.items():
            if len(times.get(name, ())) < FEWEST[percent]:
                continue
            took_s = quantile(times[name], percent)
            if took_s > bound_s:
                found.append(
                    f"{name}: {percent} % of the schedules came to rest within {took_s:.2f} s, not {bound_s:g}"
                )
    return found


def too_few(times: Mapping[str, Sequence[float]]) -> list[str]:
    """The timing profiles of a batch that have too few schedules for any of their bounds."""
    fewest = min(FEWEST.values())
    return [name for name in QUANTILES_S if len(times.get(name, ())) < fewest]


def spread(times: Sequence[float]) -> str:
    """Quantiles of some times, for people."""
    told = ", ".join(f"p{percent} {quantile(times, percent):.2f}" for percent in (50, 90, 99))
    return f"{told}, most {max(times):.2f} s, of {len(times)}"
