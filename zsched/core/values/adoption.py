"""What of a changed fleet file a running node can take over, and what only its next start does.

Knows: which fields a daemon is built on for its whole life. Does not know: how a node takes the rest over
(`zsched.core.node.fleet`), sessions and processes (`zsched.link.sessions.restarts`).
"""

from __future__ import annotations

from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.struct import replace


def obstacle(old: Fleet, new: Fleet, me: NodeId) -> str:
    """Why node ``me`` cannot take over anything of ``new``; empty: it can."""
    if new.name != old.name:
        return f"the file is of fleet {new.name!r}, this daemon of {old.name!r}"
    found = next((node for node in new.nodes if node.name == me), None)
    if found is None:
        return f"the file has no node {me!r}: stop this daemon, or put the node back"
    if found.kind is not old.node(me).kind:
        return f"the file makes {me!r} a node of kind {found.kind}: restart this daemon"
    return ""


def in_force(old: Fleet, new: Fleet, *, electors: tuple[NodeId, ...] | None = None) -> Fleet:
    """``new`` as a running node goes by it: electors and the length of leases stay, and with an elector its node.

    Other nodes count with both. They change by agreement (`zsched.core.electorate`), or with a new generation, for
    which every daemon is stopped.

    Args:
        old: the fleet in force.
        new: the file that is taken over.
        electors: with whom the node counts; ``None``: with those of ``old``.
    """
    counted = old.electors if electors is None else electors
    named = {node.name for node in new.nodes}
    stay = tuple(node for node in old.nodes if node.name in counted and node.name not in named)
    return replace(
        new,
        electors=counted,
        nodes=tuple(sorted((*new.nodes, *stay), key=lambda node: node.name)),
        timing=replace(new.timing, lease_s=old.timing.lease_s),
    )
