"""A changed fleet file at the door: another fleet is in force, tasks come, change and go.

All parts read the fleet in force (`zsched.core.values.in_force`) at each step. A node that has taken file B over acts
from then on as one that was started with B, with what it knows of nodes and tasks that are in both. Only what begins or
ends with a task is done here: registers, leases, rounds, workers, streams.

Knows: which parts have something to begin or end. Does not know: who read the file, how processes and sessions follow
(`zsched.runtime.adoption`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.executor.handover import Executor
from zsched.core.node.stages import Handler, Stages
from zsched.core.node.work import take_known
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.adoption import in_force, obstacle
from zsched.core.values.fleet import Fleet, TaskSpec, file_hash, fleet_hash
from zsched.core.values.model import Allocation, NodeKind
from zsched.core.values.problems import Problem
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP


def go_by(node: Stages, fleet: Fleet, todo: ToDo, now: float) -> None:
    """Go by another validated fleet from now on; the same one again changes nothing.

    One that this daemon cannot take over at all becomes a problem in the status, and the one before stays in force.

    Args:
        node: the stages.
        fleet: with the electors and the length of leases that are counted with.
        todo: what there is to do.
        now: monotonic seconds.
    """
    before, values = node.fleet, node.values()
    anew = frozenset(
        name for name, one in node.executors.items() if name in values and _is_of_before(one, values[name])
    )
    if _is_refused(node, fleet):
        return
    if fleet == before and not anew:
        return
    node.in_force.take(fleet, anew)
    node.clear_problems(Problem.FLEET, Problem.OWN_FILE)
    node.profiler.retune(fleet.timing)
    node.gateway.shares.keep(node.in_force.nodes)
    node.rounds.on_fleet(now, anew)
    node.agreement.on_fleet(todo, now)
    node.unconfirmed = {name: why for name, why in node.unconfirmed.items() if name in node.registers}
    _change_work(node, fleet, todo, now)
    node.retuning.want(before, node.values(), now)
    text = f"goes by another fleet file: {node.fleet_file}"
    todo.add(do.RecordStory(stage="membership", text=text))
    for task, change in node.rollouts.take(fleet, now):
        todo.add(do.RecordStory(stage="executor", text=f"changed worker: {change}", task=task, is_rollout=True))
    todo.must_beat = todo.must_decide = True


def _is_refused(node: Stages, fleet: Fleet) -> bool:
    """Whether this daemon cannot take a fleet over at all; the status says so."""
    why = obstacle(node.fleet, fleet, node.me)
    node.set_problem(Problem.FLEET, f"a changed fleet file is not in force here: {why}" if why else None)
    return bool(why)


def follow(node: Stages, fleet: Fleet, todo: ToDo, *, is_agreed: bool = False) -> None:
    """Let the runtime follow another fleet, and tell what it cannot follow; the same one again is not told."""
    if fleet != node.told_fleet and not obstacle(node.fleet, fleet, node.me):
        node.told_fleet = fleet
        todo.add(do.AdoptFleet(fleet=fleet, is_agreed=is_agreed))


def _change_work(node: Stages, fleet: Fleet, todo: ToDo, now: float) -> None:
    """EXECUTOR and ROUTE: workers, roles and streams of tasks that come, stay and go."""
    kept = dict(node.executors)
    node.executors.clear()  # tenure and sealing go by the same table
    values, come = node.values(), []
    for spec in fleet.tasks:
        executor = kept.get(spec.name)
        if executor is None or _is_of_before(executor, values[spec.name]):
            executor = Executor(spec=spec, me=node.me, has_streams=node.kind is NodeKind.ROBOT)
            come.append(executor)
        else:
            del kept[spec.name]
            if _runs_another_program(executor.spec, spec):
                _learn_anew(node, values[spec.name], now)
            executor.on_spec(spec, todo, now, is_agreed_leased=values[spec.name].leased)
        node.executors[spec.name] = executor
    for executor in kept.values():
        executor.end(todo)
    node.workers.on_fleet(fleet, node.me, node.busy())
    for name in node.executors:
        node.tenure.hold(values[name], node.beat_sequence + 1)
    for name in kept:
        node.renewing.forget(name)
        node.gateway.forget(name)
        node.set_problem(Problem.RELAY, None, name)
    for stream in [stream for stream in node.missed if stream.partition("/")[0] in kept]:
        del node.missed[stream]
    for executor in come:
        executor.start(todo)
        value = values[executor.spec.name]
        if value.revision > 0:
            reason = "placed before the task came into this node's fleet"
            take_known(node, value, reason, todo, now)


def _is_of_before(executor: Executor, value: Allocation) -> bool:
    """Whether the task was removed and added again unheard here: it is another task (decision 0043)."""
    return 0 < executor.epoch < value.epoch // CREATION_STEP * CREATION_STEP


def _runs_another_program(before: TaskSpec, after: TaskSpec) -> bool:
    """Whether any candidate does: the first nodes of a rollout when it begins, all others when it ends."""
    workers = ((before.worker_on(node), after.worker_on(node)) for node in after.candidates)
    return any((old.command, old.env) != (new.command, new.env) for old, new in workers)


def _learn_anew(node: Stages, value: Allocation, now: float) -> None:
    """Know what the worker needs that the task's owner still runs, and nothing where it has none.

    A worker that was made smaller because no candidate had room for it is never placed by what it needed before. When
    the owner runs the changed one, its need is learnt from nothing.
    """
    node.gateway.expect_another(value.task)
    node.gateway.learn_demand(value.task, value.owner, now)


def compare_file(node: Stages) -> None:
    """Show whether this machine's fleet file says something else than the agreed document.

    A file that was written as a copy of an earlier document, and that nobody has changed, says nothing of its own.
    """
    agreed = node.agreement.document
    complaint = None
    if agreed is not None and node.by_file not in (file_hash(agreed), node.startup.copied_file):
        complaint = (
            f"the fleet file here differs from the agreed document, by which this node goes; what it would change: "
            f"`zsched apply {node.startup.fleet_path} --plan`; to take the document: "
            f"`zsched fleet export -o {node.startup.fleet_path}`, then `systemctl reload zsched` (SIGHUP)"
        )
    node.set_problem(Problem.OWN_FILE, complaint)


def _on_fleet(node: Stages, event: ev.FleetChanged, todo: ToDo, now: float) -> None:
    """An operator has changed the file; once a document is agreed, a file is only compared with it.

    A document that was not valid beside the file as it was is asked for again.
    """
    node.by_file = fleet_hash(event.fleet)
    node.agreement.retry_documents()
    compare_file(node)
    if node.agreement.document is not None or _is_refused(node, event.fleet):
        return
    follow(node, event.fleet, todo)
    go_by(node, in_force(node.fleet, event.fleet), todo, now)


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.FleetChanged: _on_fleet,
    ev.RecipeCompared: lambda node, event, _todo, _now: node.renewing.on_compared(event.task, is_old=event.is_old),
}
