"""Weights as a status tells them.

Knows: the weights' names. Does not know: what is done with them.
"""

from __future__ import annotations

from zsched.commands.common import Json
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.words import PAPER_METRICS

NAMES = (*PAPER_METRICS, *BY_NAME)


def shares(weights: Json) -> dict[str, float]:
    """``{metric: weight}`` of a status' weights, or of some: the paper's three, and the gauges that have one.

    >>> shares({"cpu": 0.7, "memory": 0.0, "network": 0.0, "gauges": {"gpu": 0.3}})
    {'cpu': 0.7, 'memory': 0.0, 'network': 0.0, 'gpu': 0.3}
    """
    found = {**weights, **weights.get("gauges", {})}  # a later field of the schema's major version
    return {name: found.get(name, 0.0) for name in NAMES if name in PAPER_METRICS or found.get(name)}
