"""`zsched tune`: the settings of a task that operators may change while it runs.

Knows: their names, how a value is read and shown. Does not know: what a task does by them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Final

import typer

from zsched.commands.base.ask import ask_door
from zsched.commands.base.change import CODES, OrderView, Plan, consent, status_of, tell_results
from zsched.commands.base.common import CliError, Json, check_known, nearest, print_json, say, warn
from zsched.commands.base.options import Orders
from zsched.commands.base.page import NAMES, shares
from zsched.core.values.deadline import TELLS_NOTHING, DeadlineFault, deadline_fault
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.fleet import TUNED_LINKS, TUNED_RULES
from zsched.core.values.model import Reach, ScoreForm, Tuning, Weights
from zsched.core.values.struct import replace
from zsched.core.values.words import meant, shown

TUNING_SCHEMA: Final = "zsched.tuning/1"


_NUMBERS: Final = ("bonus", "deadline_ms")
_WORDS: Final[Mapping[str, type[StrEnum]]] = {
    "score": ScoreForm,
    "reach": Reach,
}
WEIGHTS: Final = NAMES
OF_THE_FILE: Final = (*TUNED_RULES, *TUNED_LINKS)
"""Settings that follow the fleet file, unless an operator has set another value."""
KEYS: Final = (*WEIGHTS, *_NUMBERS, "score", *OF_THE_FILE)


def tuned(before: Json, file: Json, pairs: Sequence[str]) -> dict[str, Any]:
    """A tuning, as JSON values, after ``key=value`` words; ``key=null`` is the file's value.

    >>> base = {"weights": {"cpu": 0.5, "memory": 0.5, "network": 0.0}, "bonus": 0.1}
    >>> tuned(base, base, ["bonus=0.2"])["bonus"]
    0.2

    Raises:
        CliError: a word is no such pair, or the key or its value is unknown.
    """
    after = {**before, "weights": shares(before["weights"])}
    by_file = shares(file["weights"])
    seen = set[str]()
    for pair in pairs:
        key, equals, text = pair.partition("=")
        key = key.removeprefix("weights.")
        if not equals:
            raise CliError(EXIT_USAGE, f"{pair!r} is no setting; write it like bonus=0.2, or bonus=null")
        if key not in KEYS:
            raise CliError(EXIT_USAGE, f"{pair!r}: there is no setting {key!r}{nearest(key, KEYS)}")
        if key in seen:
            raise CliError(EXIT_USAGE, f"{pair!r}: {key} is given twice; give it once")
        seen.add(key)
        place, source = (after["weights"], by_file) if key in WEIGHTS else (after, file)
        default = source.get(key, 0.0) if key in WEIGHTS else source.get(key)
        place[key] = default if text == "null" else _setting(pair, key, text)
    after["weights"] = shares(after["weights"])
    return after


def _setting(pair: str, key: str, text: str) -> Any:
    try:
        return str(_WORDS[key](text)) if key in _WORDS else float(text)
    except ValueError:
        kind = f"one of {', '.join(list(_WORDS[key]))}" if key in _WORDS else "a number"
        raise CliError(EXIT_USAGE, f"{pair!r}: {text!r} is not {kind}") from None


def tune(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: show all.")] = None,
    pairs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY=VALUE]...",
            help="Weights (of gauges, too), all of scheduling (deadline_ms, not objective) and link, as bonus=0.2; "
            "null: the file's.",
        ),
    ] = None,
) -> int:
    """Show a task's tuning, or change it on the whole running fleet.

    Example: zsched tune map_merge bonus=0.2

    A change is agreed like an allocation: it holds for every robot, or for none (exit 4 without a quorum).
    """
    view = said.order()
    status = status_of(view.door)
    check_known(status, "task", task)
    chosen = [one for one in status["tasks"] if task in (None, one["name"])]
    if task is None or not pairs:
        return _list(view, chosen)
    (known,) = chosen
    file = known["file_tuning"]
    after = tuned(known["tuning"], file, pairs)
    tuning = _checked(after, file)
    before, now = _flat(known["tuning"]), _flat(after)
    changed = [key for key in KEYS if before.get(key, 0.0) != now.get(key, 0.0)]
    rows = [(task, key, _figure(before.get(key, 0.0)), _figure(now.get(key, 0.0))) for key in changed]
    if now["deadline_ms"] not in (None, before["deadline_ms"]) and known.get("tells_no_jobs"):
        warn(f"{task}: {TELLS_NOTHING}")
    told = _told(known, after)
    outcome = {"outcome": "planned" if rows else "unchanged", "detail": ""}
    code = consent(view, Plan(rows=rows, body=_body([{**told, **outcome}]), is_change=bool(rows)))
    if code is not None:
        return code
    base = meant(view.revision, known["revision"])
    request = {"verb": "tune", "task": task, "tuning": tuning, "base_revision": base, **view.asked}
    result = ask_door(view.door, request)
    if view.is_json:
        print_json(_body([{**told, **result}]))
        return CODES.get(str(result["outcome"]), EXIT_FAILED)
    return tell_results({task: result})


def _checked(after: Json, file: Json) -> Json:
    """The tuning as a request carries it: a setting that is the file's is left to the file.

    Raises:
        CliError: a figure is out of range, or the weights' sum is not 1.
    """
    from zsched.core.values.codec import as_plain  # noqa: PLC0415 - the other orders need no codec

    total = math.fsum(after["weights"].values())
    if not math.isclose(total, 1.0, abs_tol=1e-6):
        given = " ".join(f"{name}={weight:g}" for name, weight in after["weights"].items())
        raise CliError(EXIT_USAGE, f"the weights' sum must be 1, and {given} make {total:g}; nothing was changed")
    try:
        deadline_ms = after.get("deadline_ms")
        tuning = Tuning(
            weights=Weights.of(after["weights"]),
            bonus=after["bonus"],
            score=ScoreForm(after["score"]),
            deadline_ms=deadline_ms,
            **_own(after),
        )
    except ValueError as error:
        raise CliError(EXIT_USAGE, f"{error}; nothing was changed") from None
    nu, rho = tuning.nu_dbm, tuning.rho_dbm
    if nu is not None and rho is not None and nu >= rho:
        raise CliError(EXIT_USAGE, f"nu_dbm ({nu:g}) must be below rho_dbm ({rho:g}); nothing was changed")
    check_deadline(after, file)
    kept: dict[str, Any] = {key: None for key in OF_THE_FILE if after.get(key) == file.get(key)}
    body: Json = as_plain(replace(tuning, **kept))
    return body


_INSTEAD: Final = {DeadlineFault.PAPER: "score=service", DeadlineFault.NO_CPU: "a weight for cpu"}


def check_deadline(tuning: Json, file: Json) -> None:
    """Raise `CliError` (2) where a tuning has a deadline that could not count, as a fleet file is refused for it.

    ``file``: the fleet file's tuning; the deadline that it has cannot be tuned away.
    """
    fault = deadline_fault(ScoreForm(tuning.get("score", ScoreForm.PAPER)), shares(tuning["weights"])["cpu"])
    if tuning.get("deadline_ms") is not None and fault is not None:
        is_own = file.get("deadline_ms") is None
        without = "deadline_ms=null" if is_own else "a fleet file without objective: latency and deadline_ms"
        raise CliError(EXIT_USAGE, f"{fault}: {_INSTEAD[fault]}, or {without}; nothing was changed")


def _own(after: Json) -> Json:
    """The settings of the file that this tuning has; those in words as their enumerations."""
    given = {key: after.get(key) for key in OF_THE_FILE}
    return {key: _WORDS[key](value) if key in _WORDS and value is not None else value for key, value in given.items()}


def _flat(tuning: Json) -> Json:
    """Every setting; of the gauges' weights those above 0."""
    return {**shares(tuning["weights"]), **{key: tuning.get(key) for key in KEYS if key not in WEIGHTS}}


def _figure(value: Any) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float | int) else str(value)


def _body(tasks: list[Json]) -> Json:
    return {"schema": TUNING_SCHEMA, "tasks": tasks}


def _told(task: Json, tuning: Json) -> Json:
    file = _flat(task["file_tuning"])
    return {"task": task["name"], "revision": task["revision"], "tuning": _flat(tuning), "file": file}


def _list(view: OrderView, tasks: Sequence[Json]) -> int:
    told = [_told(task, task["tuning"]) for task in tasks]
    if view.is_json:
        print_json(_body(told))
        return EXIT_OK
    for one in told:
        now, file = one["tuning"], one["file"]
        words = [
            f"{key}={_figure(now.get(key, 0.0))}{_differs(now.get(key, 0.0), file.get(key, 0.0))}"
            for key in KEYS
            if key in now or key in file
        ]
        say(f"{one['task']} (revision {shown(one['revision'])}): {' '.join(words)}")
    return EXIT_OK


def _differs(now: Any, file: Any) -> str:
    return "" if now == file else f" (file: {_figure(file)})"
