"""`zsched weights`: shows weights, or has one task's changed, before and after first.

Knows: outcomes as exit codes. Does not know: how weights are written, how a change is agreed.
"""

from __future__ import annotations

from collections.abc import Sequence

from zsched.commands.ask import ask_door
from zsched.commands.common import CliError, Json, nearest, print_json, say
from zsched.commands.orders import OrderView, Row, begin, check_said
from zsched.commands.weight_words import NAMES, parse_weights, shares
from zsched.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE

SCHEMA = "zsched.weights/1"
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


def weights(view: OrderView, name: str | None, pairs: Sequence[str]) -> int:
    """Show tasks' weights, or change those of one on the whole running fleet; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task or weight, it was not agreed to, or (as text) the change did not
            come about.
    """
    wanted = parse_weights(pairs) if pairs else {}
    check_said(view)
    status = ask_door(view.door, {"verb": "status"})
    tasks = {str(known["name"]): known for known in status["tasks"]}
    if name is not None and name not in tasks:
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no task {name!r}{nearest(name, list(tasks))}")
    if name is None or not wanted:
        for one in tasks if name is None else (name,):
            _print(one, shares(tasks[one]["tuning"]["weights"]), tasks[one]["revision"], view, {}, is_line=name is None)
        return EXIT_OK
    task = tasks[name]
    before = shares(task["tuning"]["weights"])
    if task["tuning"].get("deadline_ms") is not None:
        # most tasks have none, and need no rule of it
        from zsched.commands.tune import check_deadline, file_tuning  # noqa: PLC0415

        check_deadline({**task["tuning"], "weights": wanted}, file_tuning(task))
    keys = [key for key in NAMES if before.get(key, 0.0) != wanted.get(key, 0.0)]
    rows: list[Row] = [(name, key, f"{before.get(key, 0.0):g}", f"{wanted.get(key, 0.0):g}") for key in keys]
    plan = {"schema": SCHEMA, "task": name, "weights": wanted, "revision": task["revision"]}
    plan |= {"outcome": "planned" if rows else "unchanged", "detail": ""}
    code = begin(view, rows, plan, is_change=bool(rows))
    return _change(view, task, wanted) if code is None else code


def _change(view: OrderView, task: Json, wanted: dict[str, float]) -> int:
    """Ask for new weights, and print what became of it."""
    name = str(task["name"])
    base = task["revision"] if view.revision is None else view.revision
    answer = ask_door(view.door, {"verb": "weights", "task": name, **wanted, "base_revision": base, **view.asked})
    outcome, detail = str(answer["outcome"]), str(answer["detail"])
    code = CODES.get(outcome, EXIT_FAILED)
    if code != EXIT_OK and not view.is_json:
        advice = ADVICE.get(outcome, "").format(task=name)
        raise CliError(code, f"{name}: {outcome.replace('_', ' ')}: {detail}{'; ' if advice else ''}{advice}")
    _print(name, wanted, answer["revision"], view, {"outcome": outcome, "detail": detail})
    return code


def _print(
    task: str, weights: dict[str, float], revision: int | None, view: OrderView, more: Json, *, is_line: bool = False
) -> None:
    if view.is_json:
        print_json({"schema": SCHEMA, "task": task, "weights": weights, "revision": revision, **more}, is_line=is_line)
        return
    text = " ".join(f"{name}={weight:g}" for name, weight in weights.items())
    notes = [f"revision {revision}"] if revision is not None else []
    notes += ["unchanged"] if more.get("outcome") == "unchanged" else []
    note = f" ({', '.join(notes)})" if notes else ""
    say(f"{task}: {text}{note}")
