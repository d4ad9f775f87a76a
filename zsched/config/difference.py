"""Decides what a changed fleet file changes: place by place in the file's own words, and what follows from each.

Knows: which parts of a running fleet are made from which keys. Does not know: how a change is agreed
(`zsched.core.electorate`), how a node takes it over.

Two sources are joined. The texts say where the files differ (`zsched.config.rows`). The validated fleets say what of it
matters: a place that differs while the fleets are equal there is noticed by nothing. A setting that follows from
another place, as candidates from a label, is a change of its own.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import fields
from enum import StrEnum
from typing import Any, Final

from zsched.config.drivers import DRIVER_KEYS
from zsched.config.reader import Fault, Scalar, read_yaml
from zsched.config.reader import Mapping as Block
from zsched.config.rows import rows
from zsched.core.route.route import named_rules, outputs_of
from zsched.core.values.certificates import Role, accepted
from zsched.core.values.fleet import (
    TASK_RULES,
    Cell,
    Fleet,
    NodeSpec,
    Security,
    StreamRule,
    TaskSpec,
    WorkerLink,
    WorkerSpec,
    runs_worker,
)
from zsched.core.values.model import NodeId, NodeKind, TaskId, Weights
from zsched.core.values.struct import Struct, replace

EVERY_DAEMON: Final = "every daemon must be restarted"
OPENED_ANEW: Final = "daemons begin again in turns: a robot's streams stop for that moment"


class Effect(StrEnum):
    """What a change does to the running fleet."""

    NOTHING = "nothing"
    AT_ONCE = "at_once"
    STREAMS = "streams"
    WORKERS = "workers"
    TASK = "task"
    NODE = "node"
    ELECTORS = "electors"
    RESTART = "restart"


class Danger(StrEnum):
    """A consequence that an operator must accept by this name."""

    REMOVE_TASK = "remove-task"
    REMOVE_NODE = "remove-node"
    MAKE_EXCLUSIVE = "make-exclusive"
    END_EXCLUSIVE = "end-exclusive"
    CHANGE_ELECTORS = "change-electors"
    PAUSE_TASK = "pause-task"
    END_SECURITY = "end-security"


_MEANS: Final[Mapping[Danger, str]] = {
    Danger.REMOVE_TASK: "{about}: its worker stops, its streams end, and its state is forgotten",
    Danger.REMOVE_NODE: "{about}: it does not belong to the fleet any more",
    Danger.MAKE_EXCLUSIVE: "{about}: it rests until all its candidates go by the new document",
    Danger.END_EXCLUSIVE: "{about}: two workers may work at the same time from then on",
    Danger.CHANGE_ELECTORS: "{about}: other nodes agree on everything from then on",
    Danger.PAUSE_TASK: "{about}: its only candidate restarts the worker in place",
    Danger.END_SECURITY: "{about}: whoever reaches its network reads and changes everything from then on",
}


class Change(Struct, frozen=True, kw_only=True):
    """One place of the file, and what follows."""

    path: str
    """As ``tasks.echo.weights.cpu``."""
    before: str | None
    """``None``: nothing stands there."""
    after: str | None
    effect: Effect
    consequence: str
    """One clause, for people."""
    danger: Danger | None = None
    about: str = ""
    """The task or node in danger."""

    def warning(self) -> str:
        """What an operator accepts with the danger's name; empty without a danger."""
        return "" if self.danger is None else _MEANS[self.danger].format(about=self.about)


class _Verdict(Struct, frozen=True, kw_only=True):
    """What follows where the two fleets differ in one part."""

    effect: Effect
    text: str
    paths: tuple[str, ...] = ()
    """Where the file may say it; the first stands for it when the file says it nowhere."""
    before: str | None = None
    after: str | None = None
    danger: Danger | None = None
    about: str = ""
    in_turns: str = ""
    """What follows instead where daemons begin again by themselves; empty: the same."""


NOTHING: Final = _Verdict(effect=Effect.NOTHING, text="nothing notices")
AT_ONCE: Final = _Verdict(effect=Effect.AT_ONCE, text="takes effect at once")
_ORDER: Final = tuple(Effect)
"""Of two effects of one place the later one comes first."""


def names_electors(text: str) -> bool:
    """Whether a fleet file says who its electors are."""
    root, _ = read_yaml(text.encode())
    named = [held for key, held in root.pairs if key.text == "electorate"] if isinstance(root, Block) else []
    return any(not isinstance(held, Scalar) for held in named)


def warnings_in_force(text: str, warnings: tuple[Fault, ...]) -> tuple[Fault, ...]:
    """Those of a document's warnings that count once electors are agreed.

    Where it names no electors, those that are agreed stay, and what the file's default would be is moot.
    """
    return warnings if names_electors(text) else tuple(one for one in warnings if not one.is_of_electors)


def wanted_electors(agreed: Sequence[NodeId], new: Fleet, text: str) -> tuple[NodeId, ...]:
    """The electors that a fleet gets by its new file, sorted; ``agreed`` are those that it has.

    A file that names electors means them. Another one leaves them as they are, but for nodes that it does not have.
    """
    if names_electors(text):
        return new.electors
    nodes = {node.name for node in new.nodes}
    return tuple(sorted(name for name in agreed if name in nodes))


SEAT_AGAIN: Final = ("zsched fleet export -o FILE", "zsched apply FILE --accept change-electors")
"""What gives an elector its seat again that a document names, and that is none."""


def unseated(text: str, fleet: Fleet, agreed: Sequence[NodeId]) -> tuple[NodeId, ...]:
    """The electors that a document names, and that the fleet has not agreed as such, sorted.

    A leave that was taken back, and a recovery, leave some: they become electors once the document is applied again.

    Args:
        text: the document.
        fleet: what it says.
        agreed: the electors in force.
    """
    return tuple(name for name in wanted_electors(agreed, fleet, text) if name not in agreed)


def difference(
    old: Fleet,
    new: Fleet,
    texts: tuple[str, str],
    owners: Mapping[TaskId, NodeId | None] | None = None,
    electors: Sequence[NodeId] = (),
    bound: Container[TaskId] = (),
) -> tuple[Change, ...]:
    """All changes from ``old`` to ``new``, in the order of the new file; what only follows stands behind.

    Args:
        old: the fleet in force.
        new: the wanted one.
        texts: the files of the two.
        owners: the owner of each task now; without them nobody is said to move.
        electors: those that are agreed; none: the old file's.
        bound: the tasks that are pinned hard, so that their owner keeps them though it is no candidate.
    """
    (before, _), (after, _) = (read_yaml(text.encode()) for text in texts)
    agreed = tuple(sorted(electors)) or old.electors
    wanted = wanted_electors(agreed, new, texts[1])
    elections = (_electors(agreed, wanted),) if agreed != wanted else ()
    verdicts = (*_in_turns(tuple(_verdicts(old, new, owners or {}, bound))), *elections)
    changes: list[Change] = []
    told: set[_Verdict] = set()
    for row in rows(before, after):
        found = [verdict for verdict in verdicts if any(_meet(path, row.path) for path in verdict.paths)]
        told.update(found)
        changes += _joined(row.path, row.before, row.after, found or [NOTHING])
    for verdict in verdicts:
        if verdict not in told:
            changes += _joined(verdict.paths[0], verdict.before, verdict.after, [verdict])
    return tuple(changes)


def _meet(one: str, other: str) -> bool:
    """Whether one place is the other, or a place in it."""
    inner, outer = (one, other) if len(one) >= len(other) else (other, one)
    return inner == outer or inner.startswith((f"{outer}.", f"{outer}["))


def _joined(path: str, before: str | None, after: str | None, found: list[_Verdict]) -> Iterator[Change]:
    """One change of all that follows from one place; dangers beyond the first are changes of their own.

    Where a setting begins or ceases to be written down, its default is shown.
    """
    whole = next((one for one in found if one.paths[:1] == (path,) and one.before and one.after), None)
    if whole is not None:
        before, after = before or whole.before, after or whole.after
    found = sorted(found, key=lambda one: (one.danger is None, -_ORDER.index(one.effect)))
    effect = max((one.effect for one in found), key=_ORDER.index)
    texts = list(dict.fromkeys(one.text for one in found))
    text = "; ".join([one for one in texts if one != AT_ONCE.text] or texts)  # beside another one it would contradict
    first = found[0]
    yield Change(
        path=path,
        before=before,
        after=after,
        effect=effect,
        consequence=text,
        danger=first.danger,
        about=first.about,
    )
    for one in found[1:]:
        if one.danger is not None and one.danger is not first.danger:
            yield Change(
                path=path,
                before=before,
                after=after,
                effect=one.effect,
                consequence=one.text,
                danger=one.danger,
                about=one.about,
            )


# --- the fleets ------------------------------------------------------------------------------------------------------


def _verdicts(
    old: Fleet, new: Fleet, owners: Mapping[TaskId, NodeId | None], bound: Container[TaskId]
) -> Iterator[_Verdict]:
    yield from _timing(old, new)
    yield from _nodes(old, new)
    yield from _tasks(old, new, owners, bound)
    yield from _sessions(old, new)
    if old.seeds != new.seeds:
        text = "every daemon dials them from its next start on"
        come = [node.name for node in new.nodes if all(node.name != other.name for other in old.nodes)]
        if _dialled(new)[-len(come) :] == come and _dialled(new)[: -len(come)] == _dialled(old):
            yield _set(replace(AT_ONCE, text=f"{', '.join(come)} dials the others"), "seeds", old.seeds, new.seeds)
        else:
            yield _restart(text, "seeds", old.seeds, new.seeds)
    yield from _access(old, new)
    before, after = (fleet.zenoh_config.rpartition("/")[2] for fleet in (old, new))
    if before != after:
        yield _restart_all("zenoh", before, after)
    for name in ("replace_s", "away_s"):
        if getattr(old, name) != getattr(new, name):
            yield _set(AT_ONCE, name, getattr(old, name), getattr(new, name))
    if _cells(old) != _cells(new):
        yield _set(AT_ONCE, "site", *(", ".join(cell.name for cell in fleet.cells) for fleet in (old, new)))
    if old.is_auto is not new.is_auto:
        text = "electors that are gone are replaced by themselves" if new.is_auto else "electors are replaced no more"
        words = ["auto" if fleet.is_auto else "named" for fleet in (old, new)]
        yield _set(replace(AT_ONCE, text=text), "electorate", *words)
    if old.shared_memory is not new.shared_memory:
        yield _restart_all("shared_memory", old.shared_memory, new.shared_memory)


def _cells(fleet: Fleet) -> list[Cell]:
    """The other cells; of their files' paths only the name counts."""
    return [replace(cell, file=cell.file.rpartition("/")[2]) for cell in fleet.cells]


def _dialled(fleet: Fleet) -> list[NodeId]:
    """The nodes with an address, each behind those that it dials."""
    others = (node.name for node in fleet.nodes if node.listen_control and node.name not in fleet.seeds)
    return [*fleet.seeds, *others]


def _timing(old: Fleet, new: Fleet) -> Iterator[_Verdict]:
    for one in fields(old.timing):
        before, after = getattr(old.timing, one.name), getattr(new.timing, one.name)
        if one.name == "name" or before == after:
            continue
        is_more_signs = one.name == "lease_s" and new.timing.data_signs > old.timing.data_signs
        if one.name == "zenoh_lease_s" or is_more_signs:
            yield _restart_all(f"timing.{one.name}", before, after)
        else:
            yield _set(AT_ONCE, f"timing.{one.name}", before, after)
    clocks = [(fleet.timing.zenoh_lease_s, fleet.timing.data_signs) for fleet in (old, new)]
    if clocks[0] != clocks[1]:  # these are in the sessions that workers open
        field = "zenoh_lease_s" if clocks[0][0] != clocks[1][0] else "lease_s"
        tasks = {task.name for task in old.tasks}
        for verdict in (_renewed(task) for task in new.tasks if task.name in tasks):
            yield replace(verdict, paths=(f"timing.{field}",))


def _electors(agreed: tuple[NodeId, ...], wanted: tuple[NodeId, ...]) -> _Verdict:
    come = [f"{name} becomes one" for name in wanted if name not in agreed]
    go = [f"{name} is none any more" for name in agreed if name not in wanted]
    return _Verdict(
        effect=Effect.ELECTORS,
        text=f"electors change: {', '.join((*come, *go))}",
        paths=("electorate",),
        before=_text(agreed),
        after=_text(wanted),
        danger=Danger.CHANGE_ELECTORS,
        about=", ".join(wanted) or "nobody",
    )


def _sessions(old: Fleet, new: Fleet) -> Iterator[_Verdict]:
    """Workers but those of `link: client` dial every robot that has an address: a new one takes a new session."""
    before, tasks = _addresses(old), {task.name for task in old.tasks}
    known = {address for addresses in before.values() for address in addresses}
    come = [name for name, addresses in _addresses(new).items() if addresses - known]
    for name in come:
        node = f"nodes.{name}"
        paths = (f"{node}.listen", f"{node}.host") if name in before else (node,)
        dialling = (task for task in new.tasks if task.name in tasks and new.link_of(task) is WorkerLink.PEER)
        for verdict in map(_renewed, dialling):
            yield replace(verdict, text=f"{verdict.text}, to dial {name}", paths=paths)
    yield from _by_gossip(old, new)


def _by_gossip(old: Fleet, new: Fleet) -> Iterator[_Verdict]:
    """They look for robots without an address where there is one: its coming and its going are another session, too."""
    before, after = _hidden(old), _hidden(new)
    if before == after:
        return
    tasks, stay = {task.name for task in old.tasks}, {node.name for node in old.nodes}
    name = min(after - before or before - after)
    node = f"nodes.{name}"
    is_there = name in stay and any(one.name == name for one in new.nodes)
    paths = (f"{node}.listen", f"{node}.host", f"{node}.kind") if is_there else (node,)
    for task in new.tasks:
        homes = [one.name for one in new.nodes if one.name in stay and runs_worker(task, one.name, one.kind)]
        differs = any(bool(before - {home}) is not bool(after - {home}) for home in homes)
        if task.name in tasks and new.link_of(task) is WorkerLink.PEER and differs:
            verdict = _renewed(task)
            text = f"{verdict.text}, to find {name}" if name in after else verdict.text
            yield replace(verdict, text=text, paths=paths)


def _hidden(fleet: Fleet) -> set[NodeId]:
    """The robots that workers cannot dial by the file, and find by gossip."""
    robots = [node for node in fleet.nodes if node.kind is NodeKind.ROBOT]
    return {one.name for one in robots if not one.data_at}


def _access(old: Fleet, new: Fleet) -> Iterator[_Verdict]:
    """Sessions of a secured fleet let in by rules that were made when they opened."""
    before, after = (
        None if one is None else replace(one, folder=one.folder.rpartition("/")[2])
        for one in (old.security, new.security)
    )
    anew = _Verdict(effect=Effect.STREAMS, text=OPENED_ANEW)
    if before is None or after is None:
        if before is not after:
            verdict = _restart_all("security", _plain(before), _plain(after))
            is_end = after is None
            yield replace(verdict, danger=Danger.END_SECURITY, about=old.name) if is_end else verdict
        return
    if before.nameless() != after.nameless():
        yield _restart_all("security", _plain(before), _plain(after))
    stay = [node.name for node in new.nodes if any(one.name == node.name for one in old.nodes)]
    if _let_in(before, stay) != _let_in(after, stay):
        yield _set(anew, "security", _plain(before), _plain(after))
    elif come := [label for label in after.revoked if label not in before.revoked]:
        text = (
            f"a key that was made out for {', '.join(come)} before lets nobody in"  # whoever it is comes with another
        )
        yield replace(AT_ONCE, text=text, paths=("security.revoked",))
    if before.orders != after.orders:
        yield _set(AT_ONCE, "security.orders", _plain(before.orders), _plain(after.orders))
    nodes, others = ({node.name: (node.kind, _is_on_streams(node)) for node in fleet.nodes} for fleet in (old, new))
    for name in dict.fromkeys((*others, *nodes)):
        if name not in nodes or name not in others:
            yield replace(anew, paths=(f"nodes.{name}",))
        elif nodes[name] != others[name]:
            yield replace(anew, paths=(f"nodes.{name}.kind", f"nodes.{name}.local"))
    speaking, then = ({task.name: _spoken(fleet, task) for task in fleet.tasks if task.rules} for fleet in (old, new))
    for name in dict.fromkeys((*then, *speaking)):
        if speaking.get(name) != then.get(name):
            yield replace(anew, paths=(f"tasks.{name}",))
    if old.has_keyless_workers != new.has_keyless_workers:  # relays listen for them, or not any more
        users, had = ({task.name: task.worker.user for task in fleet.tasks} for fleet in (old, new))
        for name in dict.fromkeys((*had, *users)):
            if users.get(name) != had.get(name):
                yield replace(anew, paths=(f"tasks.{name}",))


def _let_in(security: Security, nodes: Sequence[NodeId]) -> tuple[object, ...]:
    """Whom the section lets in besides, and by which keys each of them and of ``nodes``; another's key says nothing."""
    people = ((Role.OPERATOR, security.operators), (Role.GUEST, security.guests))
    named = [(name, role) for role, names in ((Role.NODE, nodes), *people) for name in names]
    return *people, [accepted(name, role, security.revoked) for name, role in named]


def _is_on_streams(node: NodeSpec) -> bool:
    """Whether a robot's applications are on the fleet's data network: then it speaks under their keys there."""
    return node.kind is NodeKind.ROBOT and node.local is None


def _spoken(fleet: Fleet, task: TaskSpec) -> tuple[object, ...]:
    """What of a task says who speaks under which keys: its rules' keys, and where its worker may be."""
    rules = [(one.direction, one.from_template, one.to_template, one.settings.graph) for one in task.rules]
    return rules, [node.name for node in fleet.nodes if runs_worker(task, node.name, node.kind)]


def _in_turns(verdicts: tuple[_Verdict, ...]) -> Iterator[_Verdict]:
    """Where daemons begin again by themselves, nobody has to restart one."""
    begins_again = any(one.text == OPENED_ANEW for one in verdicts)
    for one in verdicts:
        is_other = begins_again and one.in_turns
        yield replace(one, text=one.in_turns, effect=Effect.STREAMS) if is_other else one


def _addresses(fleet: Fleet) -> dict[NodeId, set[str]]:
    """{robot: where workers dial its data session}."""
    return {node.name: {node.data_at} - {""} for node in fleet.nodes if node.kind is NodeKind.ROBOT}


def _nodes(old: Fleet, new: Fleet) -> Iterator[_Verdict]:
    before, after = ({node.name: node for node in fleet.nodes} for fleet in (old, new))
    for name in (name for name in after if name not in before):
        yield _Verdict(effect=Effect.NODE, text=f"{name} may join: start its daemon", paths=(f"nodes.{name}",))
    for name in (name for name in before if name not in after):
        text = f"node {name} is removed: the others forget it"
        yield _Verdict(effect=Effect.NODE, text=text, paths=(f"nodes.{name}",), danger=Danger.REMOVE_NODE, about=name)
    for name, node in before.items():
        if name in after and after[name] != node:
            yield from _node(node, after[name])


def _node(old: NodeSpec, new: NodeSpec) -> Iterator[_Verdict]:
    path = f"nodes.{old.name}"
    restart = f"the daemon of {old.name} must be restarted"
    again = f"the daemon of {old.name} begins again, by itself in its turn"
    if old.kind is not new.kind:
        yield _restart(restart, f"{path}.kind", old.kind, new.kind)  # by itself it does not go by the file
    if old.host != new.host:
        text = f"the others dial {old.name} there once it is gone from where it was"
        yield _restart(text, f"{path}.host", old.host, new.host)
    for name in ("control", "data"):
        before, after = getattr(old, f"listen_{name}"), getattr(new, f"listen_{name}")
        if before != after:
            yield _restart(restart, f"{path}.listen.{name}", before, after, again)
    if old.local != new.local:
        yield _restart(restart, f"{path}.local", _plain(old.local), _plain(new.local), again)
    if old.labels != new.labels:
        yield _set(AT_ONCE, f"{path}.labels", old.labels, new.labels)
    if old.links != new.links:
        sources = tuple(f"{path}.{source}" for source in ("links", "wifi", "wired", "fixed", "trace"))
        yield replace(AT_ONCE, paths=sources)


def _tasks(
    old: Fleet, new: Fleet, owners: Mapping[TaskId, NodeId | None], bound: Container[TaskId]
) -> Iterator[_Verdict]:
    before, after = ({task.name: task for task in fleet.tasks} for fleet in (old, new))
    for name in (name for name in after if name not in before):
        text = f"task {name} begins, on one of {', '.join(after[name].candidates)}"
        yield _Verdict(effect=Effect.TASK, text=text, paths=(f"tasks.{name}",))
    for name in (name for name in before if name not in after):
        text = f"task {name} is removed: its worker stops, its streams end"
        yield _Verdict(effect=Effect.TASK, text=text, paths=(f"tasks.{name}",), danger=Danger.REMOVE_TASK, about=name)
    for name, task in before.items():
        if name in after and after[name] != task:
            yield from _task(task, after[name], (old, new), owners.get(name), is_bound=name in bound)


def _task(
    old: TaskSpec, new: TaskSpec, fleets: tuple[Fleet, Fleet], owner: NodeId | None, *, is_bound: bool
) -> Iterator[_Verdict]:
    path = f"tasks.{old.name}"
    if old.candidates != new.candidates:
        verdict = AT_ONCE
        if owner is not None and owner not in new.candidates:
            text = f"{old.name} leaves {owner}: its streams move"
            if is_bound:
                text = f"{old.name} stays on {owner}, where it is pinned hard, until `zsched unpin {old.name}`"
            verdict = _Verdict(effect=Effect.TASK if is_bound else Effect.STREAMS, text=text)
        yield _set(verdict, f"{path}.candidates", old.candidates, new.candidates)
    yield from _tuning(old, new, path)
    for name, key in _OWN_KEYS.items():
        if getattr(old, name) != getattr(new, name):
            yield _set(AT_ONCE, f"{path}.{key}", _plain(getattr(old, name)), _plain(getattr(new, name)))
    if old.exclusive != new.exclusive:
        text = f"{old.name} rests until all its candidates go by this" if new.exclusive else "its leases end"
        danger = Danger.MAKE_EXCLUSIVE if new.exclusive else Danger.END_EXCLUSIVE
        verdict = _Verdict(effect=Effect.TASK, text=text, danger=danger, about=old.name)
        yield _set(verdict, f"{path}.exclusive", old.exclusive, new.exclusive)
    yield from _worker(old, new, fleets)
    yield from _rules(old, new)


_OWN_KEYS: Final = {
    "demand": "demand",
    "limits": "link",
    "gauge_limits": "limits",
    "on_isolation": "on_isolation",
    "drain_s": "drain_s",
}
"""Fields of a task that one key of the task makes, and that nothing else follows from."""


def _tuning(old: TaskSpec, new: TaskSpec, path: str) -> Iterator[_Verdict]:
    for one in fields(old.tuning):
        before, after = getattr(old.tuning, one.name), getattr(new.tuning, one.name)
        if before != after:
            key = "weights" if one.name == "weights" else f"scheduling.{one.name}"
            told = _set(AT_ONCE, f"{path}.{key}", _plain(before), _plain(after))
            objective = (f"{path}.scheduling.objective",) if one.name == "deadline_ms" else ()
            yield replace(told, paths=(*told.paths, *objective))
    for name in (*TASK_RULES, "prefer"):
        if getattr(old, name) != getattr(new, name):
            yield _set(AT_ONCE, f"{path}.scheduling.{name}", _plain(getattr(old, name)), _plain(getattr(new, name)))
    if old.beside != new.beside:
        told = _set(AT_ONCE, f"{path}.scheduling.together", _plain(old.beside), _plain(new.beside))
        yield replace(told, paths=(*told.paths, f"{path}.scheduling.spread"))


_OF_A_PROCESS: Final = ("command", "env", "link", "user")
"""What a worker's process keeps until it ends."""


def _worker(old: TaskSpec, new: TaskSpec, fleets: tuple[Fleet, Fleet]) -> Iterator[_Verdict]:
    path = f"tasks.{old.name}"
    kinds = {node.name: node.kind for fleet in fleets for node in fleet.nodes}
    homes = [name for name in sorted(kinds) if runs_worker(new, name, kinds[name])]
    for one in fields(WorkerSpec):
        before, after = getattr(old.worker, one.name), getattr(new.worker, one.name)
        if before != after:
            verdict = _renewed(new) if one.name in _OF_A_PROCESS else AT_ONCE
            key = "ready" if one.name == "ready_when" else one.name
            told = _set(verdict, f"{path}.worker.{key}", _plain(before), _plain(after))
            driven = (f"{path}.worker.{name}" for name in DRIVER_KEYS) if one.name == "command" else ()
            yield replace(told, paths=(*told.paths, *driven))
    deadlines = old.tuning.deadline_ms, new.tuning.deadline_ms
    if deadlines[0] != deadlines[1]:
        yield _set(_renewed(new), f"{path}.scheduling.deadline_ms", *deadlines)
    if any(outputs_of(old, name) != outputs_of(new, name) for name in homes):
        yield replace(_renewed(new), paths=(f"{path}.outputs", f"{path}.ros2.outputs", f"{path}.ros2.actions"))


def _renewed(task: TaskSpec) -> _Verdict:
    """What follows when a task's workers need another process."""
    if not task.worker.command:
        return _Verdict(effect=Effect.WORKERS, text=f"restart the workers of {task.name}, which somebody else starts")
    if len(task.candidates) > 1:
        return _Verdict(effect=Effect.WORKERS, text=f"workers of {task.name} restart one after another")
    text = f"the worker of {task.name} restarts in place"
    return _Verdict(effect=Effect.WORKERS, text=text, danger=Danger.PAUSE_TASK, about=task.name)


_LISTS: Final = {"in": "inputs", "out": "outputs", "srv": "services"}


def _rules(old: TaskSpec, new: TaskSpec) -> Iterator[_Verdict]:
    """Streams that come, go, or go another way; a stream is called by its place in its list."""
    for word, key in _LISTS.items():
        before, after = (_of_kind(task, word) for task in (old, new))
        come, go = [name for name in after if name not in before], [name for name in before if name not in after]
        differ = [name for name in before if name in after and before[name] != after[name]]
        texts = [
            f"{_streams(names)} {verb}" for names, verb in ((come, "begin"), (go, "end"), (differ, "move")) if names
        ]
        if texts:
            task = f"tasks.{old.name}"
            actions = () if word == "in" else (f"{task}.ros2.actions",)
            paths = (f"{task}.{key}", f"{task}.ros2.{key}", *actions)
            yield _Verdict(effect=Effect.STREAMS, text="; ".join(texts), paths=paths)


def _of_kind(task: TaskSpec, word: str) -> dict[str, StreamRule]:
    return {name: rule for name, rule in named_rules(task) if name.split("/")[1] == word}


def _streams(names: list[str]) -> str:
    return f"the streams {', '.join(names)}"


# --- values ----------------------------------------------------------------------------------------------------------


def _set(verdict: _Verdict, path: str, before: object, after: object) -> _Verdict:
    return replace(verdict, paths=(path,), before=_text(before), after=_text(after))


def _restart(text: str, path: str, before: object, after: object, in_turns: str = "") -> _Verdict:
    return _set(_Verdict(effect=Effect.RESTART, text=text, in_turns=in_turns), path, before, after)


def _restart_all(path: str, before: object, after: object) -> _Verdict:
    return _restart(EVERY_DAEMON, path, before, after, OPENED_ANEW)


def _plain(value: Any) -> Any:
    """A record as the file writes it."""
    if isinstance(value, Weights):
        return "{" + ", ".join(f"{name}: {weight:g}" for name, weight in value.shares) + "}"
    if hasattr(value, "__dataclass_fields__"):
        pairs = ((one.name, getattr(value, one.name)) for one in fields(value))
        return "{" + ", ".join(f"{name}: {_text(held)}" for name, held in pairs) + "}"
    return value


def _text(value: object) -> str | None:
    if value in (None, ""):
        return None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(" ".join(map(str, item)) if isinstance(item, tuple) else str(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
