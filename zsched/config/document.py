"""What an agreed document of the fleet says on one node, if it can be used there.

Knows: its name, this node in it, what it may not end. Does not know: where a document comes from, which one is wanted.
"""

from __future__ import annotations

from pathlib import Path

from zsched.config.load import check_bytes, check_file
from zsched.config.reader import render_all
from zsched.core.values.document import Document, Rollout
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.struct import replace


class TakenOutError(ConfigError):
    """The document does not name this node."""


def read_document(content: Document, fleet: str, node: NodeId, config: Path) -> Fleet:
    """What a document says, if it can be used on this node.

    Args:
        content: the document.
        fleet: the name that it must have.
        node: this node, which must be in it.
        config: the file this node was started with: paths in the document are relative to its folder. Where it secures
            the node, a document that does not cannot be used: nobody else may take that away.

    Raises:
        ConfigError: it cannot be used here.
    """
    result = check_bytes(content.text.encode("utf-8", "replace"), str(config.parent / "the fleet's document"))
    if result.fleet is None:
        raise ConfigError(render_all("the document", result.faults))
    if result.fleet.name != fleet:
        raise ConfigError(f"the document is of the fleet {result.fleet.name!r}, this node of {fleet!r}")
    if all(one.name != node for one in result.fleet.nodes):
        advice = "this machine was taken out, and goes on by its last one until `zsched leave`"
        raise TakenOutError(f"the document names no node {node!r}: {advice}")
    if result.fleet.security is None and _secures(config, fleet):
        advice = "put it into the document, or, to end it, first delete it from the fleet file of every machine"
        raise ConfigError(f"the document has no section `security:`, and {config} has one: {advice}")
    return with_rollouts(result.fleet, content.rollouts)


def _secures(config: Path, fleet: str) -> bool:
    """Whether the machine's own file secures this fleet. It is read anew: an operator who ends that changes it first.

    One that cannot be used says nothing: no daemon starts by it.
    """
    own = check_file(config).fleet
    return own is not None and own.name == fleet and own.security is not None


def with_rollouts(fleet: Fleet, rollouts: tuple[Rollout, ...]) -> Fleet:
    """The fleet with what its document says of workers that not all nodes run yet; a task that is gone has none."""
    said = {one.task: one for one in rollouts}
    return replace(fleet, tasks=tuple(replace(task, rollout=said.get(task.name)) for task in fleet.tasks))
