"""Checks of the daemon on this machine, by its own status.

Knows: the status of one node. Does not know: what other nodes say.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from zsched import __version__
from zsched.core.scheduler.flags import HANDS_OVER, told_flag
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.problems import Problem, of_kind
from zsched.core.values.words import has_lost_its_worker, told_of_worker
from zsched.tools.doctor.model import Json, Result, Scene, failed, joined, passed, skipped, warned

RENEW_RELAY: Final = "when this robot stands still: sudo systemctl stop zsched && sudo systemctl start zsched"


def answers(scene: Scene) -> Result:
    """Whether the daemon runs and answers."""
    if scene.own is not None:
        return passed(f"{scene.node} has been up for {scene.own['up_s']:.0f} s")
    if scene.is_fleet and not scene.is_node:
        return skipped("this machine is no node of the fleet")
    if "permission denied" in scene.refusal:
        return skipped(scene.refusal)
    fix = f"sudo systemctl start zsched (or zsched up --node {scene.node}); journalctl -u zsched says why it ended"
    if "did not answer within" in scene.refusal:  # systemd would find it started
        fix = "sudo systemctl restart zsched; journalctl -u zsched says where it stood"
    return failed(scene.refusal or f"the daemon of {scene.node} does not answer", fix=fix)


def is_quick(scene: Scene) -> Result:
    """Whether the daemon's decision loop turns in time for its beats."""
    return judged_lag(scene.node, scene.status, scene.fleet.timing.beat_s, scene.fleet.timing.suspect_s)


def judged_lag(node: str, status: Json, beat_s: float, suspect_s: float) -> Result:
    """What the lag of a decision loop means: it beats every ``beat_s``, and is suspect after ``suspect_s``."""
    lag_s = float(status["loop_lag_s"])
    told = f"{node}: its decision loop was up to {1000 * lag_s:.1f} ms late in the last half minute"
    told += f", a beat is due every {1000 * beat_s:g} ms"
    fix = f"see what takes the CPU of {node} (top); demand: {{cpu_cores:}} of its tasks; a slower `timing:`"
    if lag_s > suspect_s / 2:
        return failed(told, f"the others suspect it after {suspect_s:g} s of silence", fix=fix)
    return warned(told, fix=fix) if lag_s > beat_s else passed(told)


def is_of_this_version(scene: Scene) -> Result:
    """Whether the daemon is of the version that is installed here, and its relay, too."""
    running = scene.status["version"]
    if running != __version__:
        told = f"the daemon is zsched {running}, installed is {__version__}"
        return warned(told, fix="sudo systemctl restart zsched")
    if scene.relay_version not in ("", __version__):
        told = f"the daemon is zsched {running}; its relay carries the streams on by the code of {scene.relay_version}"
        return warned(told, fix=RENEW_RELAY)
    return passed(f"zsched {running}")


def sees_no_problem(scene: Scene) -> Result:
    """Whether the daemon names no problem, of itself, its tasks or the fleet."""
    found = problems_of(scene.status)
    if not found:
        return passed(f"{scene.node} names no problem")
    return warned(*found, fix="each line says what to do; zsched status shows them, too")


def problems_of(status: Json) -> list[str]:
    """What a node names: of itself and the fleet, then of its tasks."""
    tasks = [f"{task['name']}: {problem}" for task in status["tasks"] for problem in task["problems"]]
    return [*map(str, status["problems"]), *tasks]


def nodes_get_tasks(scene: Scene) -> Result:
    """Whether no operator keeps tasks from a node, and each task has a candidate that may get it."""
    status = scene.status
    flags = [(str(node["name"]), flag) for node in status["nodes"] for flag in node.get("flags", ())]
    closed = {name for name, _ in flags}
    found = []
    for task in status["tasks"]:
        if closed.issuperset(task["candidates"]):
            told = f"{task['name']}: no candidate may get it any more; when its owner ends, nobody does it"
            found.append(failed(told, fix="zsched undrain NODE, for one of its candidates"))
    lines = [f"{name} {_told(name, flag)}, known here for {flag['known_s']:.0f} s" for name, flag in flags]
    if lines:
        fix = "where the work is done: zsched undrain NODE"
        found.append(warned(*lines, fix=fix))
    return joined(found, passed("every node may get tasks"))


def _told(name: str, flag: Json) -> str:
    kind = FlagKind(flag["kind"])
    told = told_flag(Flag(kind=kind, subject=name, by=flag["by"], reason=flag["reason"]))
    return f"is {told}" if kind in HANDS_OVER else told


def tasks_have_owners(scene: Scene) -> Result:
    """Whether each task has a living owner, and the electors could choose another."""
    status, quorum = scene.status, scene.status["quorum"]
    owners = ", ".join(f"{task['name']} on {task['owner']}" for task in status["tasks"]) or "no tasks"
    return joined(
        lacks_of_owners(status),
        passed(f"{owners}; {quorum['alive']} of {quorum['electors']} electors, {quorum['needed']} needed"),
    )


def lacks_of_owners(status: Json) -> list[Result]:
    """What a node's status has to say of that: no quorum, tasks without an owner that works, or without a spare."""
    found, quorum = [], status["quorum"]
    if not quorum["ok"]:
        told = f"no quorum: {quorum['alive']} of {quorum['electors']} electors can answer, {quorum['needed']} needed"
        found.append(failed(told, fix="start the daemons of the other electors, or see PROBLEMS in zsched status"))
    for task in status["tasks"]:
        owner, state = task["owner"], task["owner_state"]
        if owner is None or state in ("gone", "unknown"):
            told = f"{task['name']} has no owner" if owner is None else f"{task['name']}: its owner {owner} is {state}"
            fix = f"zsched explain {task['name']} names why each candidate cannot have it"
            found.append(failed(told, fix=fix))
        found += _lost_workers(status, task)
        fix = "PROBLEMS in zsched status say what each of them lacks"
        found += [warned(f"{task['name']}: {text}", fix=fix) for text in of_kind(task, Problem.NO_SPARE)]
    return found


def _lost_workers(status: Json, task: Json) -> Iterator[Result]:
    """That the owner of a task does no work, as far as this node knows."""
    for node in status["nodes"]:
        for load in node["workers"] if node["name"] == task["owner"] else ():
            state, trouble, why = (str(load.get(key) or "") for key in ("state", "trouble", "reason"))
            if load["task"] == task["name"] and has_lost_its_worker(state, trouble):
                told = f"{task['name']}: the worker of its owner {task['owner']} {told_of_worker(state, trouble, why)}"
                yield failed(told, fix=f"zsched logs {task['name']} --node {task['owner']} shows what it printed")
