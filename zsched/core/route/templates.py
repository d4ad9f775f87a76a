"""Decides which templates a rule of a task may have.

Knows: where each placeholder may stand, and why. Does not know: what a template becomes (`zsched.core.route.route`),
YAML, other tasks (`zsched.config.rulecheck` holds rules against each other).

====================  =====================================================  =============================
place                 placeholders                                           must hold
====================  =====================================================  =============================
input ``from``        ``{robot} {node} {task}``                              (without ``{robot}``: see below)
input ``to``          ``{robot} {node} {target} {task}``                     ``{target}``
output ``from``       ``{robot} {node} {target} {task} {epoch}``             ``{target}``
output ``to``         ``{robot} {node} {task}``                              (without ``{robot}``: see below)
service ``from``      ``{robot} {node} {task}``                              (without ``{robot}``: see below)
service ``to``        ``{robot} {node} {target} {task}``                     ``{target}``
====================  =====================================================  =============================

``{robot}`` and ``{node}`` are both the robot whose relay carries the stream, ``{target}`` is the owner.

A robot's own side without ``{robot}``: an input is then one stream for everybody, or, on a robot that has a local side,
that robot's own; outputs and services make sense on local sides only (`shared_key_fault`).

Wildcards (``*``, ``**``, ``$*``) of ``from`` are captured and fill those of ``to`` in order
(`zsched.core.route.wildcards`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.route import wildcards as capture
from zsched.core.route.route import BRACES, PLACEHOLDERS, fill, placeholders
from zsched.core.values.fleet import StreamRule
from zsched.core.values.plan import Direction

RESERVED_CHUNK: Final = "@zsched"
"""Root of the control keys and of the in-band end markers; no rule of a user may touch it."""

_NEEDED: Final[Mapping[tuple[Direction, str], tuple[frozenset[str], str]]] = {
    (Direction.INPUT, "to"): (
        frozenset({"target"}),
        "it lacks {target}: an input goes to whichever node owns the task",
    ),
    (Direction.OUTPUT, "from"): (
        frozenset({"target"}),
        "it lacks {target}: an output comes from whichever node owns the task",
    ),
    (Direction.SERVICE, "to"): (
        frozenset({"target"}),
        "it lacks {target}: a request goes to whichever node owns the task",
    ),
}
_A: Final = {Direction.INPUT: "an input", Direction.OUTPUT: "an output", Direction.SERVICE: "a service"}
_EVERYWHERE: Final = frozenset({"robot", "node", "task"})
_ALLOWED: Final[Mapping[tuple[Direction, str], frozenset[str]]] = {
    (Direction.INPUT, "from"): _EVERYWHERE,
    (Direction.INPUT, "to"): _EVERYWHERE | {"target"},
    (Direction.OUTPUT, "from"): _EVERYWHERE | {"target", "epoch"},
    (Direction.OUTPUT, "to"): _EVERYWHERE,
    (Direction.SERVICE, "from"): _EVERYWHERE,
    (Direction.SERVICE, "to"): _EVERYWHERE | {"target"},
}
_WHY_NOT: Final[Mapping[tuple[Direction, str, str], str]] = {
    (Direction.INPUT, "from", "target"): "an input comes from the robot's own applications, whoever owns the task",
    (Direction.OUTPUT, "to", "target"): "an output keeps its key when the owner changes",
    (Direction.SERVICE, "from", "target"): "a service keeps its key when the owner changes",
}


def template_fault(template: str, direction: Direction, side: str) -> str | None:
    """Why ``template`` may not stand as ``side`` (``from`` or ``to``) of a rule; ``None`` when it may."""
    return (
        _placeholder_fault(template, direction, side)
        or _missing_fault(template, direction, side)
        or _expression_fault(template)
    )


def rule_fault(rule: StreamRule) -> str | None:
    """Why the two valid templates of ``rule`` make no stream together; ``None`` when they do."""
    if rule.from_template == rule.to_template:
        return "'from' and 'to' are the same key: the stream would feed itself"
    return capture.capture_fault(rule.from_template, rule.to_template)


def merges_keys(rule: StreamRule) -> bool:
    """True when several keys of ``from`` become one key of ``to``, so that a receiver cannot tell them apart."""
    return len(capture.wildcards(rule.to_template)) < len(capture.wildcards(rule.from_template))


def _placeholder_fault(template: str, direction: Direction, side: str) -> str | None:
    allowed = _ALLOWED[direction, side]
    for name in placeholders(template):
        if name not in PLACEHOLDERS:
            return f"there is no placeholder {{{name}}}"
        if name in allowed:
            continue
        why = _WHY_NOT.get((direction, side, name), f"only the 'from' of an output has {{{name}}}")
        return f"{{{name}}} may not stand in the '{side}' of {_A[direction]}: {why}"
    if "{" in BRACES.sub("", template) or "}" in BRACES.sub("", template):
        return "a brace is not closed"
    if template.count("{epoch}") > 1 or ("{epoch}" in template and "{epoch}" not in template.split("/")):
        return "{epoch} must be one whole chunk, once: the gate subscribes to exactly one epoch"
    return None


def _missing_fault(template: str, direction: Direction, side: str) -> str | None:
    needed, why = _NEEDED.get((direction, side), (frozenset(), ""))
    is_there = not needed or needed & set(placeholders(template))
    return None if is_there else why


def shared_key_fault(rule: StreamRule) -> str | None:
    """Why ``rule`` needs a local side on every robot (its applications' key has no ``{robot}``); ``None``: it does not.

    An input needs none: it is then one stream that every robot forwards.
    """
    if rule.direction is Direction.INPUT:
        return None
    is_output = rule.direction is Direction.OUTPUT
    if {"robot", "node"} & set(placeholders(rule.to_template if is_output else rule.from_template)):
        return None
    if is_output:
        return "it lacks {robot}: every robot would publish its copy under one key"
    return "it lacks {robot}: every robot would take the same request, and it would be carried out once for each"


def _expression_fault(template: str) -> str | None:
    sample = fill(template, robot="r", node="r", target="t", task="k", epoch="1")
    if RESERVED_CHUNK in sample.split("/"):
        return f"keys with a chunk '{RESERVED_CHUNK}' belong to zsched itself"
    problem = keyexpr.fault(sample)
    if problem is not None:
        return f"it is no key expression: {problem}"
    return capture.ambiguity(template)
