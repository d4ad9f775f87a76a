"""Decides which certificate may say what on a session of a secured fleet: zenoh's access control, from the fleet file.

Knows: the fleet's nodes, operators and guests, the control keys, the stream rules. Does not know: certificates' files.

Everything is denied that no rule allows: a rule that denies a narrow key does not stop the subscriber of a wider one.
zenoh applies the rules at each link, by the common name of the certificate at its other end. So a node speaks under its
own keys only, whatever its frames say. ``**`` matches no chunk that begins with ``@``, so such chunks are named.

Members may read everything of the fleet. What the rules hold apart is who speaks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import Any, Final

from zsched.core.route.keyexpr import includes, intersects
from zsched.core.route.ros2 import BUFFERS, is_rmw_key
from zsched.core.route.route import widened
from zsched.core.values.certificates import Role, accepted
from zsched.core.values.fleet import Fleet, NodeSpec, Security, StreamRule, TaskSpec, runs_worker
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.plan import Direction, RosGraph
from zsched.link.keyspace import ROOT, Keyspace
from zsched.link.sessions.config import WORKERS_BY

Json = dict[str, Any]

TOKEN: Final = "liveliness_token"
SPEAK: Final = ("put", "delete", "reply", "declare_queryable", TOKEN)
ASK: Final = ("query",)
LISTEN: Final = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
GET: Final = ("put", "delete", "reply", "liveliness_token")
"""What a reader is sent."""
ALL: Final = (*SPEAK, *ASK, *LISTEN)
FLOWS: Final = ("ingress", "egress")
ANYTHING: Final = "**"
ADVANCED: Final = "@adv"
"""The chunk of the caches and tokens of zenoh's advanced publishers."""
GRAPH: Final = ("@ros2_lv/**", "@/*/@ros2_lv/**")
"""ROS 2 graph tokens of rmw_zenoh and of the ros2dds bridge (`zsched.core.route.ros2`)."""


class Side(StrEnum):
    """The kind of session that the rules are for."""

    CONTROL = "control"
    DATA = "data"
    """Of a relay, and of a worker that is a peer."""
    VISIT = "visit"
    """A client's: what comes by its one link, a member has passed on."""


def access_control(fleet: Fleet, security: Security, side: Side, home: NodeId = "") -> Json:
    """The value of zenoh's ``access_control`` for a session of ``fleet``.

    ``home``: the node whose workers join this session without a certificate, by a socket that only they reach.
    """
    rules: list[Json] = []
    policies: list[Json] = []
    subjects: list[Json] = []
    holders = [(subject, {"cert_common_names": names}, own) for subject, names, own in _holders(fleet, security, side)]
    if home:
        holders.append(("workers", {"link_protocols": [WORKERS_BY]}, list(_worker_rules(fleet, fleet.node(home)))))
    for subject, who, own in holders:
        subjects.append({"id": subject, **who})
        for number, (flow, messages, keys) in enumerate(own):
            name = f"{subject} {number}"
            rules.append(
                {
                    "id": name,
                    "permission": "allow",
                    "flows": [flow],
                    "messages": list(messages),
                    "key_exprs": list(dict.fromkeys(keys)),
                }
            )
            policies.append({"subjects": [subject], "rules": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def first_denied(fleet: Fleet, rules: Json) -> tuple[bool, str, str, str] | None:
    """What the fleet needs, and no rule of the ``access_control`` lets all do: (for sure, message, flow, key).

    Whom a rule is for only the link tells. So a rule that allows counts for everybody, and one that denies does not
    count where its subject is narrower than everybody. Narrow rules may allow together what none allows alone: for sure
    is what a rule denies, and a key of which no rule allows any part.
    """
    held = {rule["id"]: rule for rule in rules.get("rules") or ()}
    everybody = {one["id"] for one in rules.get("subjects") or () if not any(one[name] for name in one if name != "id")}
    allows, denies = [], []
    for policy in rules.get("policies") or ():
        for rule in (held[name] for name in policy["rules"] if name in held):
            if rule["permission"] == "allow":
                allows.append(rule)
            elif everybody & set(policy["subjects"]):
                denies.append(rule)

    def has(some: list[Json], message: str, flow: str, key: str) -> bool:
        return any(
            message in rule["messages"] and flow in (rule["flows"] or FLOWS) and includes(expr, key)
            for rule in some
            for expr in rule["key_exprs"]
        )

    is_open, doubtful = rules["default_permission"] == "allow", None
    for message, key in _needs(fleet):
        is_shut = not is_open and not any(intersects(expr, key) for rule in allows for expr in rule["key_exprs"])
        for flow in FLOWS:
            if is_shut or has(denies, message, flow, key):
                return True, message, flow, key
            if doubtful is None and not (is_open or has(allows, message, flow, key)):
                doubtful = False, message, flow, key
    return doubtful


def _needs(fleet: Fleet) -> Iterator[tuple[str, str]]:
    """(message, key) without which no fleet works, then those of its streams."""
    for node in fleet.nodes:
        yield from ((message, _own(fleet, node)) for message in ALL if message != "delete")
    for node in fleet.nodes:
        for key in _stream_keys(fleet, node)[0]:
            yield from ((message, key) for message in ("put", "declare_subscriber"))


def _own(fleet: Fleet, node: NodeSpec) -> str:
    """The keys under which only that node speaks."""
    return f"{Keyspace(fleet.name).all_puts().removesuffix('*/*')}*/{node.name}/**"


def common_names_of(fleet: Fleet, security: Security) -> frozenset[str]:
    """The common name of every certificate that is let in."""
    holders = _holders(fleet, security, Side.CONTROL)
    return frozenset(name for _, names, _ in holders for name in names)


def names_of(fleet: Fleet) -> tuple[str, ...]:
    """Everybody who may say or ask something on the control network: nodes, operators, guests."""
    security = fleet.security
    people = () if security is None else (*security.operators, *security.guests)
    return (*(node.name for node in fleet.nodes), *people)


Rule = tuple[str, tuple[str, ...], list[str]]
"""(flow, messages, keys)."""


def _holders(fleet: Fleet, security: Security, side: Side) -> Iterator[tuple[str, list[str], list[Rule]]]:
    """(id, common names, rules) of every name that is let in."""

    def names(name: str, role: Role) -> list[str]:
        return [one.common_name(fleet.name) for one in accepted(name, role, security.revoked)]

    for node in fleet.nodes:
        yield f"node {node.name}", names(node.name, Role.NODE), list(_node_rules(fleet, node, side))
    for role, people in ((Role.OPERATOR, security.operators), (Role.GUEST, security.guests)):
        for name in people if side is not Side.VISIT else ():
            yield f"{role} {name}", names(name, role), list(_visitor_rules(fleet, name, role, side))


def _node_rules(fleet: Fleet, node: NodeSpec, side: Side) -> Iterator[Rule]:
    keys, everything = Keyspace(fleet.name), _everything(fleet)
    if side is Side.VISIT:
        yield "ingress", ALL, everything
        yield "egress", ALL, everything
        return
    own = _own(fleet, node)
    if side is Side.CONTROL:
        # The last: a node passes on the questions of those that hang on it (`zsched status --connect`).
        asked = [keys.all_questions("*").removesuffix("*") + node.name, keys.status("*", "*")]
        yield "ingress", tuple(one for one in SPEAK if one != TOKEN), [own]
        yield "ingress", (TOKEN,), [keys.alive(node.name, "*")]
    else:
        speaks, asks = _stream_keys(fleet, node)
        asked = [*_with_suffixes(asks), keys.role("*", "*"), keys.snapshot("*", "*")]
        yield "ingress", SPEAK, [own, *_with_suffixes(speaks), *_graph(fleet)]
    yield "ingress", ASK, asked
    yield "ingress", LISTEN, everything
    yield "egress", ALL, everything


def _worker_rules(fleet: Fleet, node: NodeSpec) -> Iterator[Rule]:
    """What its node's relay passes on of a worker: what the library says, and the streams of the node's tasks."""
    keys, everything = Keyspace(fleet.name), _everything(fleet)
    of_library = [
        keys.worker(node.name, "*", "*"),
        f"{keys.role(node.name, '*')}/*",
        keys.trouble(node.name, "*", "*"),
        keys.ack(node.name, "*", "*", "*"),
        keys.snapshot(node.name, "*"),
    ]
    spoken = [key for task in fleet.tasks for rule in task.rules for key in _answered(fleet, task, rule, node)]
    yield "ingress", SPEAK, [*of_library, *_with_suffixes(spoken), *_graph(fleet)]
    yield "ingress", ASK, [keys.role(node.name, "*"), keys.snapshot("*", "*")]
    yield "ingress", LISTEN, everything
    yield "egress", ALL, everything


def _visitor_rules(fleet: Fleet, name: str, role: Role, side: Side) -> Iterator[Rule]:
    keys = Keyspace(fleet.name)
    if side is Side.CONTROL:
        asked = [keys.status("*", name)] + ([keys.command("*", name)] if role is Role.OPERATOR else [])
        yield "ingress", ASK, asked
        yield "egress", ("reply",), asked
        return
    readable = [ANYTHING, f"{ANYTHING}/{ADVANCED}/{ANYTHING}"]
    yield "ingress", (*LISTEN, *ASK), [readable[1], *GRAPH]
    yield "ingress", LISTEN, readable
    yield "egress", GET, [*readable, *GRAPH]
    yield "ingress", ASK, [keys.role("*", "*")]  # `zsched ping`
    yield "egress", ("reply",), [keys.role("*", "*")]


# --- keys ------------------------------------------------------------------------------------------------------------


def _everything(fleet: Fleet) -> list[str]:
    return [
        f"{ROOT}/{fleet.name}/{ANYTHING}",
        ANYTHING,
        f"{ANYTHING}/{ROOT}/{ANYTHING}",
        f"{ANYTHING}/{ADVANCED}/{ANYTHING}",
        *GRAPH,
    ]


def _graph(fleet: Fleet) -> tuple[str, ...]:
    has_graph = any(rule.settings.graph is not RosGraph.NONE for task in fleet.tasks for rule in task.rules)
    return GRAPH if has_graph else ()


def _with_suffixes(keys: Iterable[str]) -> Iterator[str]:
    """The keys, and what zsched, zenoh's advanced publishers and rmw_zenoh's buffers put behind them."""
    for key in keys:
        yield key
        if is_rmw_key(key):
            yield f"{key}{BUFFERS}"
        yield f"{key}/{ROOT}/{ANYTHING}"
        yield f"{key}/{ADVANCED}/{ANYTHING}"


def _stream_keys(fleet: Fleet, node: NodeSpec) -> tuple[list[str], list[str]]:
    """(keys of streams under which a node speaks, keys that it may ask), by the fleet's rules."""
    speaks: list[str] = []
    asks: list[str] = []
    for task in fleet.tasks:
        for rule in task.rules:
            spoken, asked = _keys_of(fleet, task, rule, node)
            speaks += spoken
            asks += asked
    return list(dict.fromkeys(speaks)), list(dict.fromkeys(asks))


def _keys_of(fleet: Fleet, task: TaskSpec, rule: StreamRule, node: NodeSpec) -> tuple[list[str], list[str]]:
    here = {"robot": node.name, "node": node.name, "task": task.name}
    inner = rule.to_template if rule.direction is not Direction.OUTPUT else rule.from_template
    outer = rule.from_template if rule.direction is not Direction.OUTPUT else rule.to_template
    speaks: list[str] = []
    asks: list[str] = []
    if node.kind is NodeKind.ROBOT:
        owners = [one.name for one in fleet.nodes if runs_worker(task, one.name, one.kind)]
        towards = _opened(inner, ("target",), owners, here)
        if node.local is None:  # else its applications are on a network of their own, whatever keys they have there
            speaks.append(widened(outer, **here))
            asks.append(widened(outer, **here))
        asks += towards
        if rule.direction is Direction.INPUT:
            speaks += towards
    return [*speaks, *_answered(fleet, task, rule, node)], asks


def _answered(fleet: Fleet, task: TaskSpec, rule: StreamRule, node: NodeSpec) -> list[str]:
    """The keys under which a node's worker puts out and serves."""
    if rule.direction is Direction.INPUT or not runs_worker(task, node.name, node.kind):
        return []
    inner = rule.to_template if rule.direction is not Direction.OUTPUT else rule.from_template
    robots = [one.name for one in fleet.nodes if one.kind is NodeKind.ROBOT]
    return _opened(inner, ("robot", "node"), robots, {"target": node.name, "task": task.name})


def _opened(template: str, free: tuple[str, ...], names: Iterable[str], known: dict[str, str]) -> list[str]:
    """The keys of a template for all ``names`` in the place of its ``free`` placeholders.

    One that is a chunk by itself stays open. Beside other text it would also stand for the rest of a longer name:
    ``robot1_*`` is a key of ``robot1_b``, too.
    """
    braces = [f"{{{name}}}" for name in free]
    if not any(brace in chunk and chunk != brace for chunk in template.split("/") for brace in braces):
        return [widened(template, **known)]
    return [widened(template, **known, **dict.fromkeys(free, name)) for name in names]
