"""Says what of a changed fleet file a running daemon cannot take over, in sentences for its operator.

Knows: what a daemon, its relay and its sessions are made with at their start; zenoh 1.10 cannot change whom an open
session dials, where it listens, its lease. Does not know: what the daemon does take over
(`zsched.core.node.fleet`).
"""

from __future__ import annotations

from collections.abc import Iterator

from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.model import NodeId
from zsched.link.sessions.access_rules import Side, access_control
from zsched.link.sessions.config import pool_threads
from zsched.link.sessions.endpoints import Endpoints, endpoints_for

_FIELDS = (
    ("zenoh_config", "`zenoh: {config}`"),
    ("shared_memory", "`shared_memory`"),
)
_OWN = (
    ("listen_control", "`listen: {control}`"),
    ("listen_data", "`listen: {data}`"),
    ("local", "`local`"),
)


def restarts(old: Fleet, new: Fleet, me: NodeId, *, is_agreed: bool = False) -> tuple[str, ...]:
    """What of ``new`` holds on node ``me`` after a restart of its daemon only, one sentence each; empty: nothing.

    Args:
        old: the file that the daemon was started with.
        new: the file that it goes by now; it names ``me``, with the same kind.
        me: the node.
        is_agreed: electors and leases of ``new`` are those in force.
    """
    clocks = _signs(old, new) if is_agreed else _agreed(old, new)
    return (*clocks, *_made(old, new, me), *_links(old, new, me))


def opens_anew(old: Fleet, new: Fleet) -> bool:
    """Whether sessions that are open by ``old`` let in others, or elsewhere, than ``new`` says; both are secured.

    Such a daemon begins again by itself (`zsched.runtime.reopening`). What else of the section is another does not keep
    it from that: it begins by the whole section, once it can (`zsched.runtime.session_watch`).
    """
    before, after = old.security, new.security
    if before is None or after is None:
        return False
    if old.has_keyless_workers != new.has_keyless_workers:
        return True
    return any(access_control(old, before, side) != access_control(new, after, side) for side in Side)


def waits_for(needs: tuple[str, ...], begins_again: bool) -> str | None:
    """The problem of a daemon that cannot take ``needs`` over yet (`restarts`); ``None``: there is none.

    ``begins_again``: it does so by itself (`opens_anew`), and nobody has to restart it.
    """
    until = "begins again, by itself in its turn" if begins_again else "is restarted"
    return f"until this daemon {until}: {'; '.join(needs)}" if needs else None


def moved(old: Fleet, new: Fleet, me: NodeId) -> tuple[NodeId, ...]:
    """The nodes of both files that ``me`` would dial elsewhere by ``new`` than its open sessions do.

    Such a daemon begins again by itself once it hears one of them no more (`zsched.runtime.reopening`).
    """
    before, after = _dialled(old, me), _dialled(new, me)
    return tuple(name for name, ends in after.items() if name in before and ends - before[name])


def _dialled(fleet: Fleet, me: NodeId) -> dict[NodeId, set[str]]:
    """{other node: where this one dials it}."""
    points = _points(fleet, me)
    dialled = {*points.control_connect, *points.data_connect}
    return {node.name: {node.control_at, node.data_at} & dialled for node in fleet.nodes if node.name != me}


def _agreed(old: Fleet, new: Fleet) -> Iterator[str]:
    if new.electors != old.electors:
        yield (
            f"the electors stay {', '.join(old.electors)}: others ({', '.join(new.electors)}) need a new generation, "
            "with every daemon stopped, and until then no restart of any "
            "(docs/guide/service.md, Add or remove a machine)"
        )
    if new.timing.lease_s != old.timing.lease_s:
        yield (
            f"leases of exclusive tasks stay {old.timing.lease_s:g} s ({new.timing.lease_s:g} s from the restart on): "
            "restart all daemons soon, for nodes with leases of different lengths grant each other none"
        )


def _signs(old: Fleet, new: Fleet) -> Iterator[str]:
    """Where open sessions send too few signs of life for a lease that is in force; too many harm nobody."""
    timing = new.timing
    if timing.data_signs > old.timing.data_signs and timing.zenoh_lease_s == old.timing.zenoh_lease_s:
        told = f"`lease_s` of {timing.lease_s:g} s needs {timing.data_signs} signs of life in zenoh's lease"
        yield f"{told}, and its sessions send {old.timing.data_signs} until they open anew"


def _made(old: Fleet, new: Fleet, me: NodeId) -> Iterator[str]:
    changed = [text for name, text in _FIELDS if getattr(new, name) != getattr(old, name)]
    sections = [fleet.security and fleet.security.nameless() for fleet in (old, new)]
    if sections[0] != sections[1]:
        changed.append("`security`")
    before, after = old.node(me), new.node(me)
    changed += [f"{me}: {text}" for name, text in _OWN if getattr(after, name) != getattr(before, name)]
    if new.timing.zenoh_lease_s != old.timing.zenoh_lease_s:
        changed.append(f"zenoh's lease ({new.timing.zenoh_lease_s:g} s, in `timing`)")
    if changed:
        yield f"{', '.join(changed)}: its sessions and its relay are made with these at the start"
    threads = pool_threads(len(new.nodes), len(new.tasks))
    if threads > pool_threads(len(old.nodes), len(old.tasks)):
        yield f"so many links need {threads} threads in zenoh's pools, which are made at the start"


def _links(old: Fleet, new: Fleet, me: NodeId) -> Iterator[str]:
    """The nodes that the open sessions would have to dial, and do not."""
    before, after = _points(old, me), _points(new, me)
    missing = [one for one in after.control_connect if one not in before.control_connect]
    missing += [one for one in after.data_connect if one not in before.data_connect]
    if missing:
        others = moved(old, new, me)
        how = "a new node itself dials those that are named under `seeds`"
        if others:
            how = f"this daemon begins again by itself once it does not hear {' or '.join(others)} where it was"
        yield f"{', '.join(missing)} would be dialled from here, and an open session dials nobody else ({how})"
    if (after.control_by_gossip, after.data_by_gossip) != (before.control_by_gossip, before.data_by_gossip):
        yield "sessions find other nodes by gossip, or not any more: open ones stay as they are"


def _points(fleet: Fleet, me: NodeId) -> Endpoints:
    spec: NodeSpec = fleet.node(me)
    return endpoints_for(fleet, spec, lambda: 1)
