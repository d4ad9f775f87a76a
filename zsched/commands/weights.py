"""`zsched weights`: reads ``cpu=0.6 memory=0.4``, sends it, and says what became of it.

Knows: the weights' names, ranges and sum, outcomes as exit codes. Does not know: how a change is agreed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable

from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, nearest, print_json
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import PAPER_METRICS
from zsched.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

SCHEMA = "zsched.weights/1"
NAMES = (*PAPER_METRICS, *BY_NAME)
SUM_TOLERANCE = 1e-6
"""As `zsched.core.values.model.Weights`."""

CODES = {
    "ok": EXIT_OK,
    "unchanged": EXIT_OK,
    "conflict": EXIT_FAILED,
    "no_quorum": EXIT_DEGRADED,
    "invalid": EXIT_USAGE,
    "unknown": EXIT_TIMED_OUT,
}
ADVICE = {
    "conflict": "look at the weights in force, then try again",
    "no_quorum": "nothing was changed; `zsched status` shows which electors are away",
    "invalid": "nothing was changed; `zsched status` shows the tasks",
    "unknown": "it may or may not have been agreed: `zsched weights {task}` shows which",
}


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


def show_weights(door: Door, task: str, *, is_json: bool) -> None:
    """Print the weights in force.

    Raises:
        CliError: nobody answers, or there is no such task.
    """
    status = ask_door(door, {"verb": "status"})
    tasks = {str(known["name"]): known for known in status["tasks"]}
    if task not in tasks:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no task {task!r}{nearest(task, list(tasks))}")
    found = tasks[task]
    _print(task, shares(found["tuning"]["weights"]), found["revision"], is_json=is_json, more={})


def change_weights(door: Door, task: str, wanted: dict[str, float], revision: int | None, *, is_json: bool) -> int:
    """Ask for new weights and print what became of it; returns the exit code.

    Raises:
        CliError: nobody answers, or (as text) the change did not come about.
    """
    answer = ask_door(door, {"verb": "weights", "task": task, **wanted, "base_revision": revision})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    code = CODES.get(outcome, EXIT_FAILED)
    if code != EXIT_OK and not is_json:
        advice = ADVICE.get(outcome, "").format(task=task)
        raise CliError(code, f"{task}: {outcome.replace('_', ' ')}: {detail}{'; ' if advice else ''}{advice}")
    _print(task, wanted, answer["revision"], is_json=is_json, more={"outcome": outcome, "detail": detail})
    return code


def _number(pair: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise CliError(EXIT_USAGE, f"{pair!r}: {text!r} is not a number; give one from 0 to 1") from None
    if not 0.0 <= number <= 1.0:
        raise CliError(EXIT_USAGE, f"{pair!r}: {number:g} is not in [0, 1]")
    return number


def _print(task: str, weights: dict[str, float], revision: int | None, *, is_json: bool, more: Json) -> None:
    if is_json:
        print_json({"schema": SCHEMA, "task": task, "weights": weights, "revision": revision, **more})
        return
    text = " ".join(f"{name}={weight:g}" for name, weight in weights.items())
    notes = [f"revision {revision}"] if revision is not None else []
    notes += ["unchanged"] if more.get("outcome") == "unchanged" else []
    note = f" ({', '.join(notes)})" if notes else ""
    sys.stdout.write(f"{task}: {text}{note}\n")
