"""`zsched rehearse`: plays faults on a live fleet, by consent, and tells what the fleet makes of them.

Knows: how the fleet is looked at and how each step is done; that the task goes back where it was. Does not know: which
step comes when and when to stop (`zsched.tools.rehearsal.programme`), how the outcome is shown
(`zsched.tools.rehearsal.report`).
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final, TypeVar

import typer

from zsched.commands.act.flags import drain_quietly, is_given_for, lift_quietly
from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.change import IN_FORCE_S, OrderView, Plan, asker, consent, document_text, in_force
from zsched.commands.base.common import (
    CliError,
    Json,
    check_known,
    counted,
    ends_as_by_ctrl_c,
    nearest,
    print_json,
    say,
    told_task,
    warn,
)
from zsched.commands.base.options import Orders
from zsched.commands.base.page import Row
from zsched.commands.look.wait import Condition, missing
from zsched.core.values.codec import from_plain
from zsched.core.values.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT, EXIT_USAGE
from zsched.core.values.rehearsal import FAULTS, MAX_CUT_S, Promised, Step
from zsched.core.values.struct import Struct, field, replace
from zsched.core.values.words import MAX_ASKED, meant, shown
from zsched.host import paths as places
from zsched.host.clock import monotonic_s, wall_s
from zsched.host.screen import printable, screen_width
from zsched.tools.rehearsal.programme import MIN_CALM_S, Do, Lift, Look, Over, Programme, Result, Sight
from zsched.tools.rehearsal.report import SCHEMA, as_json, table

LOOK_S: Final = 0.2
"""Between two looks at the fleet."""
ANSWER_S: Final = 0.3
"""A daemon begins this long after it has answered (`zsched.runtime.strikes`)."""
CUT_MORE_S: Final = 2.0
"""A cut lasts this much longer than deciding may take, so that the task moves within it."""
BACK_S: Final = 30.0
"""How long the way back may take."""
DRAIN_MORE_S: Final = 60.0
"""A drain that nobody ends is over this long after the step's limit: the fleet itself sees to that."""
UNSURE_S: Final = IN_FORCE_S
"""How long to look for a drain of which nobody has said whether it is agreed."""
REFUSED: Final = (EXIT_FAILED, EXIT_USAGE, EXIT_DEGRADED)
"""Exit codes that say: nothing was changed."""
DEFAULT_PAUSE_S: Final = 12.0
DEFAULT_LIMIT_S: Final = 60.0
DOES: Final = {
    Step.MOVE: "is moved to another candidate",
    Step.DRAIN: "its owner is drained: every task leaves it",
    Step.WORKER: "its owner's worker is killed",
    Step.DAEMON: "its owner's daemon is killed",
    Step.LINK: "its owner's links are cut",
}
T = TypeVar("T")


class RehearseOrder(Struct, frozen=True, kw_only=True):
    """What is rehearsed."""

    task: str
    steps: tuple[Step, ...]
    rounds: int = 1
    pause_s: float = DEFAULT_PAUSE_S
    limit_s: float = DEFAULT_LIMIT_S
    cut_s: float | None = None
    """``None``: as long as it takes until the task has moved."""


def parse_steps(text: str) -> tuple[Step, ...]:
    """The steps that a list of words names, in their order.

    >>> parse_steps("move,worker")
    (<Step.MOVE: 'move'>, <Step.WORKER: 'worker'>)

    Raises:
        CliError: a word is no step.
    """
    known = [step.value for step in Step]
    words = [word.strip() for word in text.split(",") if word.strip()]
    for word in words:
        if word not in known:
            raise CliError(EXIT_USAGE, f"--steps: there is no step {word!r}{nearest(word, known)}")
    if not words:
        raise CliError(EXIT_USAGE, f"--steps: name at least one of {', '.join(known)}")
    return tuple(Step(word) for word in words)


# --- kept ones -------------------------------------------------------------------------------------------------------


def show_kept(door: Door, name: str | None, *, is_json: bool) -> int:
    """List the rehearsals that a node has kept, or show one; returns the exit code.

    Raises:
        CliError: nobody answers, or there is no such rehearsal.
    """
    told = ask_door(door, {"verb": "rehearsals", "name": name or ""})
    if "outcome" in told:
        raise CliError(EXIT_FAILED, str(told["detail"]))
    names = [str(one) for one in told["names"]]
    if name is not None and not told["body"]:
        raise CliError(EXIT_USAGE, f"{told['node']} has kept no rehearsal {name!r}{nearest(name, names)}")
    kept = printable(json.loads(told["body"])) if name is not None else None
    if is_json:
        print_json({"schema": SCHEMA, "node": told["node"], "names": names, "rehearsal": kept})
    elif kept is not None:
        sys.stdout.write(table(kept, screen_width()))
    elif not names:
        say(f"{told['node']} has kept no rehearsal")
    else:
        say("\n".join(names))
    return EXIT_OK


# --- one rehearsal ---------------------------------------------------------------------------------------------------


def play(view: OrderView, order: RehearseOrder, runtime: Path) -> int:
    """Show the programme, ask, play it, tell what came, and bring the task back; returns the exit code.

    Raises:
        CliError: nobody answers, there is no such task, it may not be touched, or it was not agreed to.
    """
    if len(view.reason) > MAX_ASKED - len("rehearsal 20260101-000000: "):
        raise CliError(EXIT_USAGE, f"--reason: {len(view.reason)} characters are too many")
    if order.pause_s < MIN_CALM_S:
        raise CliError(EXIT_USAGE, f"--pause: at least {MIN_CALM_S:g} s, or one step's gap is taken for the usual one")
    stage = Stage(view, order, runtime)
    look = stage.look()
    if look.hold:
        raise CliError(EXIT_FAILED, look.hold)
    planned = {step: stage.why_not(step, look.owner or "") for step in dict.fromkeys(order.steps)}
    rows: list[Row] = [
        (order.task, step.value, DOES[step], f"left out: {planned[step]}" if planned[step] else _after(step))
        for step in planned
    ]
    doable = [step for step in planned if not planned[step]]
    if not look.fit:
        raise CliError(EXIT_FAILED, f"{order.task}: no candidate but {look.owner} is fit; {_why_unfit(look)}")
    warning = f"This disturbs the running fleet {order.rounds} x {len(doable)} times; it stops at the first surprise."
    plan = {"schema": SCHEMA, "node": stage.first["node"], "names": [], "rehearsal": None}
    plan["plan"] = [{"step": step.value, "left_out": why or None} for step, why in planned.items()]
    if not doable and not view.is_plan:
        told = f"{order.task}: no step can be done: " + "; ".join(f"{step}: {why}" for step, why in planned.items())
        raise CliError(EXIT_FAILED, f"{told}; nothing was done")
    code = consent(view, Plan(rows=rows, body=plan, is_change=bool(doable), warning=warning))
    if code is not None:
        return code
    stage.refused = {step: why for step, why in planned.items() if why}
    return _play(view, order, stage)


def _after(step: Step) -> str:
    return "it is undrained" if step is Step.DRAIN else "it recovers"


def _why_unfit(look: Look) -> str:
    return "; ".join(look.lacks) or "`zsched explain` says why"


def _play(view: OrderView, order: RehearseOrder, stage: Stage) -> int:
    programme = Programme(order.steps, stage.promised, rounds=order.rounds, calm_s=order.pause_s, limit_s=order.limit_s)
    interrupted = ""
    over = Over(is_kept=False, why="interrupted")
    still_drained = way_back = ""
    with ends_as_by_ctrl_c():
        try:
            over = _run(programme, stage)
        except KeyboardInterrupt:
            interrupted = "interrupted"
            warn("\ninterrupted: nothing more is done")
        except CliError as error:
            over = Over(is_kept=False, why=str(error))
        finally:
            still_drained = stage.lift()
        way_back = still_drained or stage.go_back()
    body = as_json(
        name=stage.name,
        at=stage.at,
        asked=stage.asked,
        order={
            "task": order.task,
            "steps": [step.value for step in order.steps],
            "rounds": order.rounds,
            "pause_s": order.pause_s,
            "limit_s": order.limit_s,
            "cut_s": stage.cut_s,
        },
        timing=stage.timing,
        promised=stage.promised,
        results=programme.results,
        over=over,
        way_back=way_back,
    )
    kept_by = stage.keep(body)
    if view.is_json:
        print_json({"schema": SCHEMA, "node": kept_by, "names": [stage.name], "rehearsal": body})
    else:
        sys.stdout.write(table(body, screen_width()))
    if over.is_kept:
        return EXIT_FAILED if still_drained or stage.is_elsewhere else EXIT_OK
    is_told = programme.is_all_left_out or any(result.broken for result in programme.results)
    return EXIT_FAILED if is_told and not interrupted else EXIT_TIMED_OUT


def _run(programme: Programme, stage: Stage) -> Over:
    """Look and act until the programme is over."""
    told, known = "", 0
    while True:
        began = monotonic_s()
        action = programme.advance(stage.look())
        for result in programme.results[known:]:
            _say(_line(result))
        known = len(programme.results)
        if isinstance(action, Over):
            return action
        if isinstance(action, Do):
            _say(f"round {action.round}: {action.step} of {action.node}")
            at, why = stage.act(action)
            if why:
                programme.leave_out(why)
            else:
                programme.struck(at)
            continue
        if isinstance(action, Lift):
            stage.lift_once()
            time.sleep(LOOK_S)
            continue
        if action.why != told and not action.why.startswith("calm"):
            told = action.why
            _say(f"  {told}")
        time.sleep(max(0.0, LOOK_S - (monotonic_s() - began)))


def _say(text: str) -> None:
    warn(text, indent=4)


def _line(result: Result) -> str:
    if result.left_out:
        return f"  left out: {result.left_out}"
    gaps = [gap.more_s for gap in result.gaps if gap.more_s is not None]
    gap = f"at most {max(gaps) * 1000:.0f} ms without an answer more than usual" if gaps else "no gap measured"
    word = f"BROKEN: {result.broken[0]}" if result.broken else "as promised"
    whole = "" if result.whole_s is None else f", whole after {result.whole_s:.1f} s"
    return f"  {gap}{whole}, lost {result.lost}: {word}"


class _Base(Struct):
    """What was there when the rehearsal began."""

    alive: frozenset[str]
    ready: frozenset[str]
    """Nodes whose worker of the task was ready."""
    owner: str
    moved: bool = field(default=False)


class Stage:
    """The fleet as the rehearsal sees and touches it."""

    def __init__(self, view: OrderView, order: RehearseOrder, runtime: Path) -> None:
        """Look for the first time.

        Raises:
            CliError: nobody answers, or there is no such task.
        """
        self._view, self._order = view, order
        self._sockets = {path.stem: path for path in places.local_sockets(runtime)} if runtime.is_dir() else {}
        self.first = self._status(view.door)
        check_known(self.first, "task", order.task)
        task = told_task(self.first, order.task)
        self.at = wall_s()
        self.name = time.strftime("%Y%m%d-%H%M%S", time.gmtime(self.at)) + f"-{os.getpid() % 1000:03d}"
        reason = f"rehearsal {self.name}" + (f": {view.reason}" if view.reason else "")
        self.asked: Json = {"by": asker(view.door), "reason": reason}
        told = ask_door(view.door, {"verb": "rehearsals", "task": order.task})
        if "outcome" in told:
            raise CliError(EXIT_FAILED, str(told["detail"]))
        self.timing = str(told["timing"])
        known = {step.value: step for step in Step}  # a newer daemon may promise more
        promised = {known[step]: one for step, one in told["promised"].items() if step in known}
        self.promised = {step: from_plain(one, Promised) for step, one in promised.items()}
        silent_s = self.promised[Step.LINK].decide_s or 0.0
        self.cut_s = order.cut_s if order.cut_s is not None else min(silent_s + CUT_MORE_S, MAX_CUT_S)
        if Step.LINK in order.steps and not silent_s < self.cut_s <= MAX_CUT_S:
            text = f"--cut: more than {silent_s:.1f} s (before that nobody misses the owner), at most {MAX_CUT_S:g} s"
            raise CliError(EXIT_USAGE, text)
        self._base = _Base(
            alive=frozenset(str(node["name"]) for node in self.first["nodes"] if node["state"] == "alive"),
            ready=frozenset(_ready(self.first, order.task)),
            owner=str(task["owner"] or ""),
        )
        if meant(view.revision, task["revision"]) != task["revision"]:
            now = f"{order.task} has revision {shown(task['revision'])}"
            raise CliError(EXIT_FAILED, f"revision {view.revision} is overtaken: {now}")
        self._drains = replace(
            view, revision=None, reason=str(self.asked["reason"]), for_s=order.limit_s + DRAIN_MORE_S
        )
        self._has_drained = self._is_unsure = False
        self.is_elsewhere = False
        """The task could not be brought back to where it was."""
        self._since = 0
        self.refused: Mapping[Step, str] = {}
        """{step that was shown as left out: why}: nobody has agreed to it, so it stays out when it becomes possible."""

    # --- looking -----------------------------------------------------------------------------------------------------

    def _way(self, node: str) -> Door:
        """The shortest way to a node: its own socket here, else by the door."""
        own = self._sockets.get(node)
        return self._view.door.to(node) if own is None else Door(socket=own)

    def _status(self, door: Door) -> Json:
        return ask_door(door, {"verb": "status"})

    def look(self) -> Look:
        """What the robots tell now; what cannot be asked is something that the task lacks."""
        now = monotonic_s()
        statuses: dict[str, Json] = {}
        silent = []
        robots = [node["name"] for node in self.first["nodes"] if node["kind"] == "robot"]
        for robot in [str(name) for name in robots if name in self._base.alive]:
            try:
                statuses[robot] = self._status(self._way(robot))
            except CliError as error:
                silent.append(f"{robot} does not answer: {error}")
        if not statuses:
            return Look(now=now, owner=None, epoch=-1, lacks=tuple(silent))
        first = next(iter(statuses.values()))
        lacks = [*silent, *self._lacks(statuses, first)]
        tasks = {robot: task for robot, status in statuses.items() if (task := told_task(status, self._order.task))}
        if not tasks:
            return Look(now=now, owner=None, epoch=-1, lacks=tuple(lacks))
        task = max(tasks.values(), key=lambda one: int(one["epoch"]))
        switched = [one["switched_s"] for one in tasks.values() if one["epoch"] == task["epoch"]]
        return Look(
            now=now,
            owner=task["owner"],
            epoch=int(task["epoch"]),
            since_s=float("inf") if task["since_s"] is None else float(task["since_s"]),
            switched_s=None if None in switched else max(switched, default=None),
            hold=_hold(task),
            lacks=tuple(lacks),
            fit=() if lacks else self._fit(task),
            sights=tuple(_sights(tasks)),
            drained=tuple(sorted({name for status in statuses.values() for name in self._drained(status)})),
        )

    def _drained(self, status: Json) -> list[str]:
        """The nodes with a drain of this rehearsal, as one node knows them."""
        nodes, why = status["nodes"], self._drains.reason
        return [str(node["name"]) for node in nodes if any(is_given_for(why, flag) for flag in node.get("flags", ()))]

    def _lacks(self, statuses: Mapping[str, Json], first: Json) -> list[str]:
        """What is missing at full strength, by what was there at the beginning."""
        lacks = missing(Condition(kind="settled", task=self._order.task), statuses)
        for observer, status in statuses.items():
            states = {str(node["name"]): str(node["state"]) for node in status["nodes"]}
            lacks += [
                f"{name} is {states.get(name, 'not known')} to {observer}"
                for name in sorted(self._base.alive)
                if states.get(name) != "alive"
            ]
        ready = _ready(first, self._order.task)
        lacks += [f"the worker on {name} is not ready" for name in sorted(self._base.ready - ready)]
        if not first["quorum"]["ok"]:
            lacks.append("no quorum")
        return lacks

    def _fit(self, task: Json) -> tuple[str, ...]:
        """The other candidates that could have the task at once, by the answering node's own check of a move."""
        others = [str(name) for name in task["candidates"] if name != task["owner"]]
        return tuple(name for name in others if not self._why_no_move(name))

    def _why_no_move(self, target: str) -> str:
        result = self._move(target, is_plan=True)
        return "" if result["outcome"] == "ok" else str(result["detail"])

    def _move(self, target: str, *, is_plan: bool = False) -> Json:
        return self._ask({"verb": "move", "task": self._order.task, "target": target, "plan": is_plan, **self.asked})

    def _ask(self, request: Json) -> Json:
        """The answer of the first node that gives one."""
        return self._through(lambda door: ask_door(door, request))

    def _through(self, act: Callable[[Door], T]) -> T:
        """What comes of it at the first node that answers: the door's own daemon may be down."""
        doors = [self._view.door, *(Door(socket=path) for path in self._sockets.values())]
        failure: CliError | None = None
        for door in doors:
            try:
                return act(door)
            except CliError as error:
                failure = failure or error
        assert failure is not None
        raise failure

    # --- doing -------------------------------------------------------------------------------------------------------

    def why_not(self, step: Step, owner: str) -> str:
        """Why a step cannot be done to this owner now; empty: it can."""
        if step not in self.promised:
            return f"the program of {self.first['node']} is older, and does not know this step"
        if step is Step.DRAIN:
            return self._why_no_drain(owner)
        if step not in FAULTS:
            return ""
        if step is not Step.WORKER and not self._has_other_eye(owner):
            return f"this rehearsal looks at the fleet through {owner}: give it another node by --connect"
        return self._strike(step, owner, is_plan=True)

    def _why_no_drain(self, owner: str) -> str:
        try:
            document_text(in_force(self._view.door))
        except CliError as error:
            return str(error)
        return self._strike(Step.DRAIN, owner, is_plan=True)

    def _has_other_eye(self, owner: str) -> bool:
        """Whether the fleet can still be seen without this node."""
        door = self._view.door
        if door.endpoint:
            try:
                passed_on_by = ask_door(replace(door, node=None), {"verb": "status"})["node"]
            except CliError:
                return False
            return owner not in (door.node, passed_on_by)
        return any(name != owner for name in self._sockets)

    def _strike(self, step: Step, owner: str, *, is_plan: bool) -> str:
        request = {"verb": "strike", "task": self._order.task, "step": step.value, "plan": is_plan, **self.asked}
        if step is Step.LINK:
            request["cut_s"] = self.cut_s
        result = ask_door(self._way(owner), request)
        return "" if result["outcome"] == "ok" else str(result["detail"])

    def act(self, do: Do) -> tuple[float, str]:
        """Do a step: (when it began, why it was not done)."""
        at = monotonic_s()
        if why := self.refused.get(do.step, ""):
            return at, why
        if do.step is Step.MOVE:
            result = self._move(do.target)
            if result["outcome"] == "ok":
                self._base.moved = True
                return at, ""
            return at, str(result["detail"])
        try:
            why = self.why_not(do.step, do.node)
            if do.step is Step.DRAIN and not why:
                self._drain(do.node)
                return at, ""
            why = why or self._strike(do.step, do.node, is_plan=False)
        except CliError as error:
            why = str(error)
        if why:
            return at, why
        self._base.moved = True
        return (at if do.step is Step.WORKER else monotonic_s() + ANSWER_S), ""

    def _drain(self, node: str) -> None:
        """Have the owner drained.

        Raises:
            CliError: it is not agreed, or nobody tells whether it is.
        """
        self._has_drained = self._is_unsure = self._base.moved = True
        try:
            self._since = drain_quietly(self._drains, node)
        except CliError as error:
            self._is_unsure = error.code not in REFUSED
            raise
        self._is_unsure = False

    def lift_once(self) -> bool:
        """End the drains of this rehearsal; whether there were any.

        Raises:
            CliError: nobody answers, or it is not agreed.
        """
        nodes = self._through(lambda door: lift_quietly(replace(self._drains, door=door), self._since))
        for node in nodes:
            _say(f"  {node} is undrained")
        return bool(nodes)

    def lift(self) -> str:
        """See to it that no drain of this rehearsal is left, also when it is interrupted; what is left, or empty."""
        began, why = monotonic_s(), "it takes too long"
        while self._has_drained and monotonic_s() - began < BACK_S:
            try:
                why, is_lifted = self._lifted()
                if not why and (is_lifted or not self._is_unsure or monotonic_s() - began >= UNSURE_S):
                    return ""
                time.sleep(LOOK_S)
            except KeyboardInterrupt:
                _say("the drain is ended first")
        if not self._has_drained:
            return ""
        why = why or "it takes too long"
        ends = f"it ends by itself within {self._drains.for_s or 0.0:.0f} s"
        return f"a node may still be drained: {why}; `zsched status` tells, and {ends}"

    def _lifted(self) -> tuple[str, bool]:
        """(why the drains cannot be ended now, whether there were any)."""
        try:
            return "", self.lift_once()
        except CliError as error:
            return str(error), False

    def go_back(self) -> str:
        """Bring the task back to the node that had it, if it is elsewhere; what became of that."""
        owner = self._base.owner
        if not self._base.moved or not owner:
            return "nothing has changed"
        began, why = monotonic_s(), ""
        while monotonic_s() - began < BACK_S:
            try:
                is_back, why = self._moved_back(owner)
                if is_back:
                    return f"{self._order.task} is on {owner} again, where it was"
                time.sleep(LOOK_S)
            except KeyboardInterrupt:
                why = "interrupted"
                break
        self.is_elsewhere = True
        return f"{self._order.task} is not back on {owner}: {why or 'it takes too long'}; `zsched move` brings it there"

    def _moved_back(self, owner: str) -> tuple[bool, str]:
        """(whether the task is where it was, why it cannot go there now); it is moved if it can."""
        try:
            look = self.look()
            if look.owner == owner or look.lacks:
                return look.owner == owner, "; ".join(look.lacks)
            result = self._move(owner)
        except CliError as error:
            return False, str(error)
        return False, "" if result["outcome"] in ("ok", "unchanged") else str(result["detail"])

    def keep(self, body: Json) -> str:
        """Have the outcome kept; the node that keeps it, or empty."""
        text = json.dumps(body, ensure_ascii=False, separators=(",", ":"))
        request = {"verb": "keep", "task": self._order.task, "name": self.name, "body": text, **self.asked}
        try:
            result = self._ask({**request, "told": _told(body)})
        except CliError as error:
            _say(f"the outcome is not kept: {error}")
            return ""
        if result["outcome"] != "ok":
            _say(f"the outcome is not kept: {result['detail']}")
            return ""
        return str(self.first["node"])


def _told(body: Json) -> str:
    done = sum(1 for one in body["steps_done"] if not one["left_out"])
    word = "every promise was kept" if body["is_kept"] else str(body["why"])
    return f"{counted(done, 'steps')}, {word}; `zsched rehearse --show {body['id']}`"


def _ready(status: Json, task: str) -> set[str]:
    found = set()
    for node in status["nodes"]:
        if any(worker["task"] == task and worker["state"] == "ready" for worker in node["workers"]):
            found.add(str(node["name"]))
    return found


def _hold(task: Json) -> str:
    """Why nobody may touch the task."""
    name = task["name"]
    if task["pause"] is not None:
        return f"{name} is paused: a dead owner is not replaced; `zsched resume {name}` first"
    if task["pin"] is not None:
        return f"{name} is pinned: it may not move; `zsched unpin {name}` first"
    return ""


def _sights(tasks: Mapping[str, Json]) -> list[Sight]:
    return [
        Sight(
            robot=robot,
            stream=str(stream["stream"]),
            messages=int(stream["messages"]),
            lost=int(stream["lost"]),
            at_most_lost=int(stream["at_most_lost"]),
            doubled=int(stream["doubled"]),
            gap_s=stream.get("gap_s"),
            move_gap_s=stream.get("move_gap_s"),
            move_epoch=int(stream.get("move_epoch") or 0),
        )
        for robot, task in tasks.items()
        for stream in task["streams"]
    ]


def rehearse(
    said: Orders,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task of the fleet file.")] = None,
    steps: Annotated[
        str, typer.Option(metavar="STEPS", help="What is done, in this order: move, drain, worker, daemon, link.")
    ] = "move,drain,worker,daemon,link",
    rounds: Annotated[int, typer.Option(min=1, max=100, metavar="N", help="How often all of it.")] = 1,
    pause: Annotated[float, typer.Option(metavar="S", help="Seconds of calm before each step; at least 11.")] = 12.0,
    limit: Annotated[
        float, typer.Option(min=5.0, max=3600.0, metavar="S", help="Seconds that recovering may take.")
    ] = 60.0,
    cut: Annotated[
        float | None, typer.Option(metavar="S", help="Seconds of a cut. [until the task has moved, and 2 more]")
    ] = None,
    kept: Annotated[bool, typer.Option("--list", help="List the rehearsals that the node has kept.")] = False,
    show: Annotated[str | None, typer.Option(metavar="ID", help="Show one of them.")] = None,
) -> int:
    """Play faults on the running fleet, one at a time, and tell what it makes of them beside what is promised.

    Example: zsched rehearse map_merge --plan

    It asks first, needs a second fit candidate, waits for calm before each step, and stops at the first broken promise.
    Exits with 1 when one was broken, with 5 when it could not go on.
    """
    if kept or show is not None:
        if task is not None:
            raise CliError(EXIT_USAGE, "--list and --show go without a task")
        return show_kept(said.door(), show, is_json=said.json_)
    if task is None:
        raise CliError(EXIT_USAGE, "name a task, or --list: `zsched rehearse TASK`")
    order = RehearseOrder(task=task, steps=parse_steps(steps), rounds=rounds, pause_s=pause, limit_s=limit, cut_s=cut)
    return play(said.order(), order, places.asked_folder(said.runtime_dir, os.environ))
