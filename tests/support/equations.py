"""Eq. 4 of one candidate."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet

from zsched.core.scheduler.utility import Total
from zsched.core.values.model import ScoreForm, Weights


def total_utility(
    weights: Weights,
    *,
    measured: AbstractSet[str],
    form: ScoreForm = ScoreForm.PAPER,
    gauges: Mapping[str, float] | None = None,
    **terms: float | None,
) -> float | None:
    """The utility of its ``terms``, ``None`` where one is not measured, beside candidates with ``measured`` ones."""
    told = {name: term for name, term in terms.items() if term is not None}
    return Total(weights, measured, form).of(told | dict(gauges or {}))
