"""Decides whether the stream rules of all tasks can live together: no loops through relays, one writer per key.

Knows: rules, robots, candidates. Does not know: where in a file a rule stands, zenoh.

Every rule is expanded for every robot and candidate (robots included). A relay hands what matches its ``from`` on to
its ``to``; where one relay's ``to`` meets another's ``from``, the data goes on. A circle of relays alone would multiply
messages for ever. A circle that passes a worker is that worker's business, but worth a word. Two relays publishing
under one key would mix two streams that no receiver can tell apart.

Requests flow like samples from ``from`` to ``to``, but never become samples: services are held against each other only.
There a clash is one key that two rules answer.

A robot with a local side keeps its applications' keys to itself: its inputs' ``from`` and its outputs' ``to`` are in a
room of their own (here: behind a verbatim chunk with the robot's name), so that three robots may all publish ``map``.

Rules are first compared with every placeholder left open, which is cheap and never misses; only those that could meet
are expanded.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.route.keytree import KeyTree
from zsched.core.route.route import NOBODY, named_rules, widened
from zsched.core.values.fleet import StreamRule, TaskSpec
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import Direction
from zsched.core.values.struct import Struct

MAX_COMPARED: Final = 200_000
"""Pairs of rules and expanded rules that are looked at, together: some seconds' worth."""


class RuleConflict(Struct, frozen=True, kw_only=True):
    """Rules that cannot live together. ``streams`` are their names (``<task>/in/<i>``), the first is where to look."""

    streams: tuple[str, ...]
    message: str
    is_fatal: bool = True


class _Rule(Struct, frozen=True):
    stream: str
    task: TaskSpec
    rule: StreamRule
    open_from: str
    """With every placeholder left open; as ``open_to``."""
    open_to: str


class _TooMany(Exception):  # noqa: N818 - an outcome, caught where the search began
    """The rules could meet in more ways than are looked at."""


class _Budget:
    """How much is compared before a file is refused: nobody waits for minutes."""

    def __init__(self) -> None:
        self._left = MAX_COMPARED

    def spend(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise _TooMany


class _Relay(Struct, frozen=True):
    """One rule for one robot and candidate."""

    stream: str
    task: TaskId
    direction: Direction
    robot: NodeId
    candidate: NodeId
    from_expr: str
    to_expr: str


_LOCAL: Final = "@local"
"""First chunk of the keys in a robot's own room."""


class _Robots(Struct, frozen=True):
    budget: _Budget
    names: tuple[NodeId, ...]
    split: frozenset[NodeId]
    """Those with a local side."""

    def place(self, expr: str, robot: NodeId) -> str:
        """A key of the robot's applications, in the robot's own room if it has one."""
        return f"{_LOCAL}/{robot}/{expr}" if robot in self.split else expr


def _shown(expr: str) -> str:
    """As the file's reader knows it: without the room, and with the owner's place where no candidate is known."""
    known = expr.split("/", 2)[2] if expr.startswith(f"{_LOCAL}/") else expr
    return "/".join("{target}" if chunk == NOBODY else chunk for chunk in known.split("/"))


_Graph = Mapping[str, Iterable[str]]
_WORKER: Final = "worker "
"""Prefix of the nodes that stand for a task's worker on a candidate."""


def rule_conflicts(
    tasks: Iterable[TaskSpec], robots: Iterable[NodeId], with_local_side: Collection[NodeId] = ()
) -> tuple[RuleConflict, ...]:
    """Every loop and clash among the rules of ``tasks`` for ``robots``; empty when there is none.

    Rules that could meet in more ways than `MAX_COMPARED` are refused as one conflict.
    """
    rules = [_rule(stream, task, rule) for task in tasks for stream, rule in named_rules(task)]
    cast = _Robots(budget=_Budget(), names=tuple(robots), split=frozenset(with_local_side))
    try:
        return _conflicts(rules, cast)
    except _TooMany:
        message = (
            f"{len(rules)} rules could meet in so many ways that they are not checked: put a word of its own, "
            "such as the task's name, in front of the wildcards and placeholders of each"
        )
        return (RuleConflict(streams=tuple(rule.stream for rule in rules[:1]), message=message),)


def _rule(stream: str, task: TaskSpec, rule: StreamRule) -> _Rule:
    return _Rule(
        stream=stream,
        task=task,
        rule=rule,
        open_from=widened(rule.from_template, task=task.name),
        open_to=widened(rule.to_template, task=task.name),
    )


def _conflicts(rules: list[_Rule], cast: _Robots) -> tuple[RuleConflict, ...]:
    services = [rule for rule in rules if rule.rule.direction is Direction.SERVICE]
    streams = [rule for rule in rules if rule.rule.direction is not Direction.SERVICE]
    return (
        *_clashes(streams, cast),
        *_loops(streams, cast),
        *_service_clashes(services, cast),
        *_loops(services, cast),
    )


# --- clashes ---------------------------------------------------------------------------------------------------------


def _clashes(rules: list[_Rule], robots: _Robots) -> Iterator[RuleConflict]:
    """One conflict per pair of rules (or per rule that meets itself on another robot)."""
    tree = KeyTree((rule.open_to for rule in rules), robots.budget.spend)
    for index, first in enumerate(rules):
        own = _self_clash(first, robots)
        if own is not None:
            yield own
        for other in tree.meeting(first.open_to):
            if other > index:
                yield from _pair_clash(first, rules[other], robots)


def _names_its_robot(template: str) -> bool:
    """Whether one chunk, at a place that no ``**`` moves, is the robot's name alone: no two robots' keys meet."""
    for chunk in template.split("/"):
        if chunk in ("{robot}", "{node}"):
            return True
        if chunk == keyexpr.DOUBLE:
            return False
    return False


def _self_clash(rule: _Rule, robots: _Robots) -> RuleConflict | None:
    if _names_its_robot(rule.rule.to_template):
        return None
    relays = list(_expand(rule, robots))
    index = _Index(relays, lambda relay: relay.to_expr, robots.budget)
    for relay in relays:
        for other in index.meeting(relay.to_expr):
            if other.robot == relay.robot:
                continue
            message = (
                f"{relay.robot} and {other.robot} would both publish {_shown(relay.to_expr)!r}: add {{robot}} to 'to'"
            )
            return RuleConflict(streams=(rule.stream,), message=message)
    return None


def _pair_clash(first: _Rule, second: _Rule, robots: _Robots) -> Iterator[RuleConflict]:
    index = _Index(_expand(second, robots), lambda relay: relay.to_expr, robots.budget)
    for relay in _expand(first, robots):
        for other in index.meeting(relay.to_expr):
            message = f"two rules publish {_shown(relay.to_expr)!r}; a receiver could not tell their streams apart"
            yield RuleConflict(streams=(first.stream, second.stream), message=_on(message, relay, other))
            return


def _service_clashes(rules: list[_Rule], robots: _Robots) -> Iterator[RuleConflict]:
    tree = KeyTree((rule.open_from for rule in rules), robots.budget.spend)
    pairs = ((number, other) for number, rule in enumerate(rules) for other in tree.meeting(rule.open_from))
    for first, second in ((rules[number], rules[other]) for number, other in pairs if other > number):
        index = _Index(_expand(second, robots), lambda relay: relay.from_expr, robots.budget)
        both = ((relay, other) for relay in _expand(first, robots) for other in index.meeting(relay.from_expr))
        for relay, other in itertools.islice(both, 1):
            message = f"two services answer {_shown(relay.from_expr)!r}: one request would be carried out twice"
            yield RuleConflict(streams=(first.stream, second.stream), message=_on(message, relay, other))


def _on(message: str, first: _Relay, second: _Relay) -> str:
    where = first.robot if first.robot == second.robot else f"{first.robot} and {second.robot}"
    return f"{message} (on {where})"


# --- loops -----------------------------------------------------------------------------------------------------------


def _loops(rules: list[_Rule], robots: _Robots) -> Iterator[RuleConflict]:
    tree = KeyTree((rule.open_from for rule in rules), robots.budget.spend)
    relay_graph = {rule.stream: [rules[number].stream for number in tree.meeting(rule.open_to)] for rule in rules}
    fatal: set[str] = set()
    for part in _circles(relay_graph):
        chain = _loop_in([rule for rule in rules if rule.stream in part], robots, with_workers=False)
        if chain:
            fatal.update(part)
            yield RuleConflict(streams=_streams(chain), message=_loop_text("relays feed each other", chain))
    for part in _circles(_with_workers(relay_graph, rules)):
        if part & fatal:
            continue
        chain = _loop_in([rule for rule in rules if rule.stream in part], robots, with_workers=True)
        if chain:
            text = _loop_text("a worker's output comes back to it as input", chain)
            yield RuleConflict(streams=_streams(chain), message=text, is_fatal=False)


def _with_workers(relay_graph: _Graph, rules: list[_Rule]) -> _Graph:
    """The graph with a node per task's worker, behind its inputs and in front of its outputs."""
    graph = {stream: list(targets) for stream, targets in relay_graph.items()}
    for rule in rules:
        worker = graph.setdefault(f"{_WORKER}{rule.task.name}", [])
        if rule.rule.direction is Direction.INPUT:
            graph[rule.stream].append(f"{_WORKER}{rule.task.name}")
        elif rule.rule.direction is Direction.OUTPUT:
            worker.append(rule.stream)
    return graph


def _loop_in(rules: list[_Rule], robots: _Robots, *, with_workers: bool) -> list[_Relay]:
    """One circle among the expanded ``rules``, in its order; empty when there is none."""
    relays = [relay for rule in rules for relay in _expand(rule, robots)]
    by_name = {str(number): relay for number, relay in enumerate(relays)}
    index = _Index(relays, lambda relay: relay.from_expr, robots.budget)
    name_of = {id(relay): name for name, relay in by_name.items()}
    graph: dict[str, list[str]] = {
        name: [name_of[id(other)] for other in index.meeting(relay.to_expr)] for name, relay in by_name.items()
    }
    if with_workers:
        for name, relay in by_name.items():
            worker = f"{_WORKER}{relay.task} {relay.candidate}"
            if relay.direction is Direction.INPUT:
                graph[name].append(worker)
                graph.setdefault(worker, [])
            else:
                graph.setdefault(worker, []).append(name)
    for part in _circles(graph):
        return [by_name[name] for name in _walk(graph, part) if name in by_name]
    return []


def _streams(chain: list[_Relay]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(relay.stream for relay in chain))


def _loop_text(what: str, chain: list[_Relay]) -> str:
    steps = [
        f"{_shown(relay.from_expr)} -> {_shown(relay.to_expr)} (on {relay.robot}, owner {relay.candidate})"
        for relay in chain[:6]
    ]
    more = [f"{len(chain) - 6} more"] if len(chain) > 6 else []
    return f"loop, {what}: {', then '.join((*steps, *more))}"


# --- expansion, index, graph -----------------------------------------------------------------------------------------


def _expand(rule: _Rule, robots: _Robots) -> Iterator[_Relay]:
    is_output = rule.rule.direction is Direction.OUTPUT
    robots.budget.spend(len(robots.names) * len(rule.task.candidates))
    for robot in robots.names:
        for candidate in rule.task.candidates:
            names = {"robot": robot, "node": robot, "target": candidate, "task": rule.task.name}
            from_expr, to_expr = widened(rule.rule.from_template, **names), widened(rule.rule.to_template, **names)
            yield _Relay(
                stream=rule.stream,
                task=rule.task.name,
                direction=rule.rule.direction,
                robot=robot,
                candidate=candidate,
                from_expr=from_expr if is_output else robots.place(from_expr, robot),
                to_expr=robots.place(to_expr, robot) if is_output else to_expr,
            )


class _Index:
    """Relays by one of their key expressions."""

    def __init__(self, relays: Iterable[_Relay], key: Callable[[_Relay], str], budget: _Budget) -> None:
        self._relays = tuple(relays)
        self._tree = KeyTree((key(relay) for relay in self._relays), budget.spend)

    def meeting(self, expr: str) -> Iterator[_Relay]:
        """All relays whose expression shares a key with ``expr``."""
        return (self._relays[number] for number in self._tree.meeting(expr))


def _circles(graph: _Graph) -> Iterator[set[str]]:
    """Strongly connected parts of ``graph`` that hold a circle. Source: Tarjan 1972, with a stack of our own."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    held: list[str] = []
    on_stack: set[str] = set()
    for root in graph:
        work = [] if root in order else [(root, iter(graph[root]))]
        while work:
            node, targets = work[-1]
            if node not in order:
                order[node] = low[node] = len(order)
                held.append(node)
                on_stack.add(node)
            target = next((one for one in targets if one not in order or one in on_stack), None)
            if target is not None and target not in order:
                work.append((target, iter(graph[target])))
            elif target is not None:
                low[node] = min(low[node], order[target])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[node])
                if low[node] == order[node]:
                    part = _cut(held, node)
                    on_stack -= part
                    if len(part) > 1 or node in graph[node]:
                        yield part


def _cut(held: list[str], node: str) -> set[str]:
    at = held.index(node)
    part = set(held[at:])
    del held[at:]
    return part


def _walk(graph: _Graph, part: set[str]) -> list[str]:
    """A shortest circle through the first node (by name) of a strongly connected ``part``: there always is one."""
    start = min(part)
    came_from: dict[str, str] = {}
    row = [start]
    while True:
        ahead: list[str] = []
        for node in row:
            for target in graph[node]:
                if target == start:
                    return _path_back(came_from, start, node)
                if target in part and target not in came_from:
                    came_from[target] = node
                    ahead.append(target)
        row = ahead


def _path_back(came_from: Mapping[str, str], start: str, end: str) -> list[str]:
    path = [end]
    while path[-1] != start:
        path.append(came_from[path[-1]])
    return path[::-1]
