"""Says what of a changed fleet file a running daemon cannot take over, in sentences for its operator.

Knows: what a daemon, its relay and its sessions are made with at their start; zenoh 1.10 cannot change whom an open
session dials, where it listens, its lease. Does not know: what the daemon does take over
(`zsched.core.handlers.fleet`).
"""

from __future__ import annotations

from collections.abc import Iterator

from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.model import NodeId
from zsched.runtime.access_rules import Side, access_control
from zsched.runtime.endpoints import Endpoints, endpoints_for
from zsched.sessions.config import pool_threads

_FIELDS = (
    ("zenoh_config", "`zenoh: {config}`"),
    ("security", "`security`"),
    ("shared_memory", "`shared_memory`"),
    ("relay_orphan_s", "`relay_orphan_s`"),
)
_OWN = (("listen_control", "`listen: {control}`"), ("listen_data", "`listen: {data}`"), ("local", "`local`"))


def restarts(old: Fleet, new: Fleet, me: NodeId, *, is_agreed: bool = False) -> tuple[str, ...]:
    """What of ``new`` holds on node ``me`` after a restart of its daemon only, one sentence each; empty: nothing.

    Args:
        old: the file that the daemon was started with.
        new: the file that it goes by now; it names ``me``, with the same kind.
        me: the node.
        is_agreed: electors and leases of ``new`` are those in force.
    """
    return (*(() if is_agreed else _agreed(old, new)), *_made(old, new, me), *_rules(old, new), *_links(old, new, me))


def _agreed(old: Fleet, new: Fleet) -> Iterator[str]:
    if new.electors != old.electors:
        yield (
            f"the electors stay {', '.join(old.electors)}: others ({', '.join(new.electors)}) need a new generation, "
            "with every daemon stopped (`zsched init --generation N --force`)"
        )
    if new.timing.lease_s != old.timing.lease_s:
        yield (
            f"leases of exclusive tasks stay {old.timing.lease_s:g} s ({new.timing.lease_s:g} s from the restart on): "
            "restart all daemons soon, for nodes with leases of different lengths grant each other none"
        )


def _made(old: Fleet, new: Fleet, me: NodeId) -> Iterator[str]:
    changed = [text for name, text in _FIELDS if getattr(new, name) != getattr(old, name)]
    before, after = old.node(me), new.node(me)
    changed += [f"{me}: {text}" for name, text in _OWN if getattr(after, name) != getattr(before, name)]
    if new.timing.zenoh_lease_s != old.timing.zenoh_lease_s:
        changed.append(f"zenoh's lease ({new.timing.zenoh_lease_s:g} s, in `timing`)")
    if changed:
        yield f"{', '.join(changed)}: its sessions and its relay are made with these at the start"
    threads = pool_threads(len(new.nodes), len(new.tasks))
    if threads > pool_threads(len(old.nodes), len(old.tasks)):
        yield f"so many links need {threads} threads in zenoh's pools, which are made at the start"


def _rules(old: Fleet, new: Fleet) -> Iterator[str]:
    """Whom the open sessions of a secured fleet would have to let in, and do not."""
    security = new.security
    if security is None or security != old.security:
        return
    if any(access_control(old, security, side) != access_control(new, security, side) for side in Side):
        yield "the access rules are for other nodes or streams: open sessions keep those that they were opened with"


def _links(old: Fleet, new: Fleet, me: NodeId) -> Iterator[str]:
    """Whom the open sessions would have to dial, and do not."""
    before, after = _points(old, me), _points(new, me)
    missing = [one for one in after.control_connect if one not in before.control_connect]
    missing += [one for one in after.data_connect if one not in before.data_connect]
    if missing:
        yield (
            f"{', '.join(missing)} would be dialled from here, and an open session dials nobody else (a new node "
            "itself dials those that are named under `seeds`)"
        )
    if (after.control_by_gossip, after.data_by_gossip) != (before.control_by_gossip, before.data_by_gossip):
        yield "sessions find other nodes by gossip, or not any more: open ones stay as they are"


def _points(fleet: Fleet, me: NodeId) -> Endpoints:
    spec: NodeSpec = fleet.node(me)
    return endpoints_for(fleet, spec, lambda: 1)
