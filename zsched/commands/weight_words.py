"""Weights as people write them, ``cpu=0.6 memory=0.4``, and as a status tells them.

Knows: the weights' names, ranges and sum. Does not know: what is done with them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from zsched.commands.common import CliError, Json, nearest
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.words import PAPER_METRICS
from zsched.exits import EXIT_USAGE

NAMES = (*PAPER_METRICS, *BY_NAME)
SUM_TOLERANCE = 1e-6
"""As `zsched.core.values.model.Weights`."""


def parse_weights(pairs: Iterable[str]) -> dict[str, float]:
    """The weights out of ``name=number`` words; what is left out is 0, and of the gauges only what has a weight.

    >>> parse_weights(["cpu=0.6", "memory=0.4"])
    {'cpu': 0.6, 'memory': 0.4, 'network': 0.0}

    Raises:
        CliError: a word is no such pair, a name is unknown or given twice, a number is not in [0, 1], the sum not 1.
    """
    found: dict[str, float] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals:
            raise CliError(EXIT_USAGE, f"{pair!r} is no weight; write them like cpu=0.6 memory=0.4 network=0")
        if name not in NAMES:
            raise CliError(EXIT_USAGE, f"{pair!r}: there is no weight {name!r}{nearest(name, NAMES)}")
        if name in found:
            raise CliError(EXIT_USAGE, f"{pair!r}: {name} is given twice; give it once")
        found[name] = _number(pair, text)
    total = math.fsum(found.values())
    if not math.isclose(total, 1.0, abs_tol=SUM_TOLERANCE):
        left_out = [name for name in PAPER_METRICS if name not in found]
        zeros = f" ({', '.join(left_out)} left out: 0)" if left_out else ""
        raise CliError(EXIT_USAGE, f"the weights' sum is {total:g}{zeros}, not 1; change one of them")
    return shares(found)


def shares(weights: Json) -> dict[str, float]:
    """``{metric: weight}`` of a status' weights, or of some: the paper's three, and the gauges that have one.

    >>> shares({"cpu": 0.7, "memory": 0.0, "network": 0.0, "gauges": {"gpu": 0.3}})
    {'cpu': 0.7, 'memory': 0.0, 'network': 0.0, 'gpu': 0.3}
    """
    found = {**weights, **weights.get("gauges", {})}  # a later field of the schema's major version
    return {name: found.get(name, 0.0) for name in NAMES if name in PAPER_METRICS or found.get(name)}


def _number(pair: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise CliError(EXIT_USAGE, f"{pair!r}: {text!r} is not a number; give one from 0 to 1") from None
    if not 0.0 <= number <= 1.0:
        raise CliError(EXIT_USAGE, f"{pair!r}: {number:g} is not in [0, 1]")
    return number
