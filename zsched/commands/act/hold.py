"""`zsched pause`, `resume`, `pin`, `unpin`: orders that last, and their end.

Knows: how they are shown before and after, when each robot knows them. Does not know: what a task does by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.change import (
    CODES,
    NOTHING,
    OrderView,
    Plan,
    ask_all,
    consent,
    refused,
    status_of,
    tell_results,
    until,
)
from zsched.commands.base.common import CliError, Json, check_known, print_json, say
from zsched.commands.base.options import ForOption, Orders
from zsched.commands.base.page import span
from zsched.commands.base.report import told_hold
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE
from zsched.core.values.struct import Struct
from zsched.core.values.words import meant, shown

TASK_SCHEMA: Final = "zsched.task/1"
KNOWN_S: Final = 30.0
"""How long `pause --wait` may take."""
ENDS: Final = {"resume": "pause", "unpin": "pin"}
TasksArgument = Annotated[list[str] | None, typer.Argument(metavar="[TASK]...", help="Tasks of the fleet file.")]
OrListArgument = Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; without it: list the pins.")]
AllOption = Annotated[bool, typer.Option("--all", help="Every task.")]


def pin(
    said: Orders,
    task: OrListArgument = None,
    to: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Where it belongs. [its owner]")] = None,
    hard: Annotated[bool, typer.Option("--hard", help="No other node ever gets it, though this one be dead.")] = False,
    for_: ForOption = None,
) -> int:
    """Keep a task on a node: it moves for an escape only, and comes back when that node is fit again.

    Example: zsched pin map_merge edge2 --for 2h

    Without a task it lists the pins.
    """
    return _Hold(view=said.order(for_=for_), verb="pin", node=to, is_hard=hard).give([task] if task else [])


def unpin(said: Orders, task: OrListArgument = None) -> int:
    """End a task's pin: the fleet places it again. Without a task it lists the pins.

    Example: zsched unpin map_merge
    """
    return _Hold(view=said.order(), verb="unpin").give([task] if task else [])


def pause(
    said: Orders,
    tasks: TasksArgument = None,
    all_: AllOption = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Until every node that is alive knows it; at most 30 s.")
    ] = False,
    for_: ForOption = None,
) -> int:
    """Let nothing move tasks but `zsched move`: a dead owner is not replaced.

    Example: zsched pause --all --for 10m

    Without a task it lists the pauses.
    """
    return _Hold(view=said.order(for_=for_), verb="pause", is_waiting=wait).give(tasks or [], is_all=all_)


def resume(said: Orders, tasks: TasksArgument = None, all_: AllOption = False) -> int:
    """End the pause of tasks. Without a task it lists the pauses.

    Example: zsched resume --all
    """
    return _Hold(view=said.order(), verb="resume").give(tasks or [], is_all=all_)


class _Hold(Struct, frozen=True, kw_only=True):
    """A pause or a pin, or the end of one."""

    view: OrderView
    verb: str
    node: str | None = None
    is_hard: bool = False
    is_waiting: bool = False
    """Until every node that is alive knows it."""

    @property
    def kind(self) -> str:
        """``pause`` or ``pin``."""
        return ENDS.get(self.verb, self.verb)

    def give(self, names: Sequence[str], *, is_all: bool = False) -> int:
        """Give it for tasks, or list those that are in force; the exit code.

        Raises:
            CliError: there is no such task or node, it was not agreed to, or an order was not agreed.
        """
        if names and is_all:
            raise CliError(EXIT_USAGE, "--all goes without tasks")
        view, node = self.view, self.node
        status = status_of(view.door)
        known = {str(task["name"]): task for task in status["tasks"]}
        chosen = list(known) if is_all else list(dict.fromkeys(names))
        check_known(status, "task", *chosen)
        check_known(status, "node", node)
        for name in chosen if node is not None else ():  # the daemon plans no pin: a plan would say yes to it
            if node not in (able := known[name]["candidates"]):
                detail = f"{node!r} is no candidate; there are {', '.join(able)}"
                raise refused(name, {"outcome": "invalid", "detail": detail})
        if not chosen:
            return self._list(list(known.values()))
        if view.revision is not None and len(chosen) > 1:
            raise CliError(EXIT_USAGE, "--revision goes with one task")
        before = {name: known[name].get(self.kind) for name in chosen}
        after = {name: self._after(known[name]) for name in chosen}
        changing = [name for name in chosen if after[name] is not before[name]]
        rows = [(name, self.kind, self._told(before[name]), self._told(after[name])) for name in chosen]
        outcomes = {name: "planned" if name in changing else "unchanged" for name in chosen}
        plans = [{**_held(known[row[0]]), "outcome": outcomes[row[0]], "detail": row[3]} for row in rows]
        plan = Plan(rows=rows, body=_body(plans), is_change=bool(changing), warning=self._warning())
        code = consent(view, plan)
        if code is not None and not (self.is_waiting and not changing and not view.is_plan):
            return code
        results = self._give({name: after[name] for name in changing}, known)
        return self._tell(chosen, known, results)

    def _after(self, task: Json) -> Json | None:
        """The order in force afterwards; the one that is in force where it says the same.

        A reason that is not given again stays, and a time that is given again begins anew.
        """
        held: Json | None = task.get(self.kind)
        if self.verb in ENDS:
            return None
        place = ((self.node or task["owner"]) if self.kind == "pin" else None, self.is_hard)
        is_same = held is not None and (self.kind == "pause" or (held["node"], held["is_hard"]) == place)
        reason = self.view.reason or (str(held["reason"]) if held is not None and is_same else "")
        if held is not None and is_same and (self.view.for_s, held["for_s"], held["reason"]) == (None, None, reason):
            return held
        asked = {**self.view.asked, "reason": reason}
        return {"node": place[0], "is_hard": place[1], **asked, "for_s": self.view.for_s}

    def _told(self, order: Json | None) -> str:
        return NOTHING if order is None else told_hold(self.kind, order)

    def _warning(self) -> str:
        if self.verb == "pause":
            return "A dead owner will not be replaced."
        return "Without that node nobody does the task." if self.is_hard else ""

    def _give(self, after: Mapping[str, Json | None], known: Mapping[str, Json]) -> dict[str, Json]:
        """{task: what became of its order}; behind one that is agreed an error is the next one's result, and no end.

        Raises:
            CliError: the first one is refused, or nobody answers it.
        """
        view, results = self.view, dict[str, Json]()
        said = {"verb": "hold", "hold": self.verb, "target": self.node, "hard": self.is_hard, "for_s": view.for_s}
        for name, order in after.items():
            base = meant(view.revision, known[name]["revision"])
            reason = view.reason if order is None else order["reason"]
            try:
                request = {**said, "task": name, "base_revision": base, **view.asked, "reason": reason}
                results[name] = ask_door(view.door, request)
            except CliError as error:
                if not results:
                    raise
                outcome = "invalid" if error.code == EXIT_FAILED else "unknown"
                results[name] = {"outcome": outcome, "detail": str(error), "revision": None}
        return results

    def _tell(self, chosen: Sequence[str], known: Mapping[str, Json], results: Mapping[str, Json]) -> int:
        """Say what became of it, and wait where that is wanted; the exit code."""
        now: dict[str, Json] = {}
        if self.view.is_json:
            try:
                now = {str(task["name"]): task for task in status_of(self.view.door)["tasks"]}
            except CliError:  # what was agreed is told all the same
                now = {}
        lacks: list[str] = []
        if self.is_waiting:
            # what an earlier order has agreed may be unknown somewhere, too
            held = {name: results.get(name, {**known[name], "outcome": "ok"}) for name in chosen}
            agreed = {name: int(one["revision"]) for name, one in held.items() if one["outcome"] == "ok"}
            lacks = until(lambda: _not_known(self.view.door, agreed), KNOWN_S)
        late = EXIT_TIMED_OUT if lacks else EXIT_OK
        if self.view.is_json:
            unchanged = {"outcome": "unchanged", "detail": ""}
            # one that was taken out of the document meanwhile is told as it was
            tasks = [{**_held(now.get(name, known[name])), **results.get(name, unchanged)} for name in chosen]
            print_json(_body(tasks, missing=lacks))
            return max([late, *(CODES.get(str(result["outcome"]), EXIT_FAILED) for result in results.values())])
        code = tell_results(results)
        for lack in lacks:
            say(f"  {lack}", indent=4)
        return max(code, late)

    def _list(self, tasks: Sequence[Json]) -> int:
        """The orders of one kind that are in force."""
        held = [task for task in tasks if task.get(self.kind) is not None]
        if self.view.is_json:
            print_json(_body([_held(task) for task in held]))
        elif not held:
            say(f"no task is {self.kind}{'ned' if self.kind == 'pin' else 'd'}")
        else:
            for task in held:
                order = task[self.kind]
                say(f"{task['name']}: {self._told(order)}, known for {span(order['known_s'])}")
        return EXIT_OK


def _not_known(door: Door, revisions: Mapping[str, int]) -> list[str]:
    """Which nodes that are alive have not learnt what was agreed."""
    first, lacks = status_of(door), []
    alive = [str(one["name"]) for one in first["nodes"] if one["state"] == "alive" and one["name"] != first["node"]]
    for node, status in {first["node"]: first, **ask_all(door, alive, {"verb": "status"})}.items():
        if isinstance(status, CliError):
            lacks.append(f"{node} does not answer: {status}")
            continue
        known = {str(task["name"]): int(task["revision"]) for task in status["tasks"]}
        late = [name for name, revision in revisions.items() if known.get(name, -1) < revision]
        lacks += [f"{node} has not learnt revision {shown(revisions[name])} of {name}" for name in late]
    return lacks


def _held(task: Json) -> Json:
    return {key: task.get(key) for key in ("owner", "revision", "pause", "pin")} | {"task": task["name"]}


def _body(tasks: Sequence[Json], **more: Sequence[str]) -> Json:
    return {"schema": TASK_SCHEMA, "tasks": list(tasks), **more}
