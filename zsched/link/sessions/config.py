"""Builds the zenoh configurations of every session zsched opens: control, data, workers, applications.

Knows: zenoh's configuration paths and the values that keep beats, data and workers out of each other's way.
Does not know: zenoh itself (imported only to read an operator's JSON5), which node is whose neighbour, what is sent.

Every function returns JSON text for ``zenoh.Config.from_json5``. Our settings lie on top of the operator's own file.
What they are for: multicast scouting off and explicit endpoints (no surprise neighbours), gossip on (seeds suffice),
a short lease (a frozen peer is seen after 0.67-1 lease; zenoh's default is 10 s), a quick and bounded connect retry,
random zids (a fixed one keeps a restarted node out until its old link's lease ends), a small send buffer on data links
(a full default buffer delays everything behind it by 0.4 s on a 20 Mbit/s radio).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from zsched.core.hop.room import SMALL
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import LocalMode, LocalSide, Timing, WorkerLink
from zsched.core.values.struct import replace

if TYPE_CHECKING:
    import zenoh

DATA_SEND_BUFFER: Final = SMALL
"""Kernel send buffer of data links in bytes at first: bounds what lies between a publisher and a slow radio."""
CONTROL_MAX_MESSAGE: Final = 1 << 20
"""Largest control message a peer may make us assemble, bytes (zenoh's default is 1 GiB)."""
CONTROL_KEEP_ALIVE: Final = 3
"""Signs of life in a lease of the control session, whose beats are more frequent than that, at rest, too."""
WORKERS_BY: Final = "unixsock-stream"
"""The protocol by which workers of other users join their relay in a secured fleet, whose key they have not."""
LOOPBACK_LISTEN: Final = "tcp/127.0.0.1:0"

OPEN_TIMEOUT_S: Final = 1.5
"""How long zenoh tries one dial: well between the times at which TCP sends a lost packet again (decision 0036).

When it ends just as the handshake succeeds, zenoh drops the dial half done: a link that sends, never reads, never ends,
and keeps every other link to the same peer out. A redial into a cut that has healed meanwhile succeeds with TCP's next
SYN, 1 s (then 2 s or 3 s) after the first, and the rest of the handshake 0.2 s, 0.6 s, 1.4 s after a packet was lost.
"""
ACCEPT_TIMEOUT_S: Final = 1.0
"""The other end, which begins with the connection, not with the SYN: between 0.6 s and 1.4 s."""
RELAY_START_S: Final = 10.0
"""A worker that is started together with its relay, on a busy machine, waits this long for it."""
FEWEST_THREADS: Final = 12
"""Of a pool: a fleet of one machine grows to five with one task before a daemon must be started again."""
TX_THREADS: Final = 4
"""Threads that transmit, beyond those for every link."""
DEFAULT_TIMING: Final = Timing()

Settings = dict[str, Any]
_WAIT_BEFORE_CLOSE: Final = "transport/link/tx/queue/congestion_control/block/wait_before_close"
WAIT_S: Final = 5.0
"""How long a message that must not be dropped waits for room at a link before zenoh ends it; zenoh's default.

On the control session no longer than a peer may be silent. While one waits, nobody else may use that link's queue, not
even zenoh to close it, and nobody dials that peer anew (1.10.2): some dozen answers to questions of a peer whose link
had ended, one after another, kept it away for minutes.
"""
DROP_WAIT_S: Final = 0.05
"""How long a put with congestion control DROP waits for room at one link (zenoh's default is 1 ms).

A receiver that keeps up may not run for some milliseconds on a busy machine, and then loses what it could have had.
One that takes nothing costs this time once: zenoh then drops at its link at once, until it takes something.
"""
_RECEIVERS: Final[Settings] = {
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": round(DROP_WAIT_S * 1e6),
}
"""Of sessions that applications receive outputs from."""
STANDSTILL_S: Final = 60.0
"""So long an application of the host may stand still: its link stays, and with it what it holds. This lease is no
failure detector: a program that ends, or is ended, closes its link."""


def control_config(
    *,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    timing: Timing = DEFAULT_TIMING,
    operator_json5: str = "",
    dials_by_gossip: bool = True,
    at_most_hz: Mapping[str, float] | None = None,
) -> str:
    """The daemon's control session: beats, ballots, status. Shared memory off, messages bounded, nothing shared.

    ``at_most_hz``: puts under these keys that come faster by one link are dropped by zenoh, before anybody looks.

    Without ``dials_by_gossip`` only ``connect`` is dialled: when that covers every pair from one side, two sessions
    never redial each other at once after a cut, which can leave a link that is kept alive and delivers nothing.
    ``listen`` and ``connect`` are zenoh endpoints such as ``tcp/0.0.0.0:7457``; never those of the data session.

    Raises:
        ValueError: the operator's JSON5 is not a zenoh configuration.
    """
    settings = _peer(listen, connect, timing)
    settings["connect/retry"] = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
    settings["transport/link/tx/lease"] = round(timing.control_lease_s * 1000)
    settings["transport/link/tx/keep_alive"] = CONTROL_KEEP_ALIVE
    settings[_WAIT_BEFORE_CLOSE] = round(1e6 * min(timing.suspect_s, WAIT_S))
    settings["transport/shared_memory/enabled"] = False
    settings["transport/link/rx/max_message_size"] = CONTROL_MAX_MESSAGE
    _set_gossip(settings, dials=dials_by_gossip)
    if at_most_hz:
        rules = [{"key_expr": key, "freq": hz} for key, hz in at_most_hz.items()]
        own = {"id": "zsched", "messages": ["put"], "flows": ["ingress"], "rules": rules}
        settings["downsampling"] = [own, *(setting(operator_json5, "downsampling") or [])]
    return _render(settings, operator_json5)


def data_config(
    *,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    timing: Timing = DEFAULT_TIMING,
    shared_memory: bool = True,
    operator_json5: str = "",
    dials_by_gossip: bool = True,
) -> str:
    """The relay's data session: the node's hub for local workers and applications, meshed with the other relays.

    ``shared_memory`` is used for local hops and puts only: a receiver that is descheduled for 0.1-0.2 s loses such a
    message silently, which a query would turn into a hang. Off it must be in network namespaces (they share
    ``/dev/shm``) and under a CPU quota.

    Raises:
        ValueError: the operator's JSON5 is not a zenoh configuration.
    """
    settings = _peer(_small_buffers(listen), _small_buffers(connect), timing)
    _set_shared_memory(settings, is_on=shared_memory)
    _set_gossip(settings, dials=dials_by_gossip)
    settings.update(_RECEIVERS)
    return _render(settings, operator_json5)


def worker_config(
    *,
    connect: tuple[str, ...],
    listen: tuple[str, ...] = (LOOPBACK_LISTEN,),
    timing: Timing = DEFAULT_TIMING,
    link: WorkerLink = WorkerLink.PEER,
    shared_memory: bool = True,
    operator_json5: str = "",
    dials_by_gossip: bool = True,
) -> str:
    """A worker's session: joined to its own node's relay (the first of ``connect``), by the rest or gossip to others.

    A daemon's workers ``listen`` nowhere: they dial, and nobody dials them (`zsched.link.sessions.endpoints` says why).
    With ``link: client`` everything goes through the node's relay (robots that the worker cannot dial).

    Raises:
        ValueError: the operator's JSON5 is not a zenoh configuration.
    """
    if link is WorkerLink.CLIENT:
        return client_config(
            connect=connect[:1],
            timing=timing,
            shared_memory=shared_memory,
            operator_json5=operator_json5,
            connect_s=RELAY_START_S,
        )
    settings = _peer(_small_buffers(listen), _small_buffers(connect), timing)
    _set_shared_memory(settings, is_on=shared_memory)
    _set_gossip(settings, dials=dials_by_gossip, is_dialled=bool(listen))
    return _render(settings, operator_json5)


def local_config(side: LocalSide, *, timing: Timing = DEFAULT_TIMING) -> str:
    """The relay's session on the host's own side: a client of its router, or a peer of its applications.

    The operator's zenoh file is the fleet's and does not apply here.
    """
    if side.mode is LocalMode.CLIENT:
        return client_config(connect=side.connect, timing=timing)
    settings = _peer(side.listen or (LOOPBACK_LISTEN,), side.connect, timing)
    settings["transport/link/tx/lease"] = round(STANDSTILL_S * 1000)
    settings[_WAIT_BEFORE_CLOSE] = round(STANDSTILL_S * 1e6)
    _set_shared_memory(settings, is_on=False)
    settings.update(_RECEIVERS)
    return _render(settings, "")


def client_config(
    *,
    connect: tuple[str, ...],
    timing: Timing = DEFAULT_TIMING,
    shared_memory: bool = False,
    operator_json5: str = "",
    connect_s: float = 0.0,
) -> str:
    """A session that hangs on one node: an application, the command line, a worker with ``link: client``.

    A client's ``open`` fails when nobody listens for ``connect_s`` (a peer's goes on trying in the background).

    Raises:
        ValueError: the operator's JSON5 is not a zenoh configuration.
    """
    settings = _common(timing)
    settings["mode"] = "client"
    settings["connect/endpoints"] = list(connect)
    settings["connect/timeout_ms"] = round(connect_s * 1000)
    _set_shared_memory(settings, is_on=shared_memory)
    return _render(settings, operator_json5)


def introduction_config(session: str) -> str | None:
    """Of a session (its configuration) that meets others by gossip: one that dials the same nodes and their peers.

    ``None`` when the session does not dial by gossip, or nobody at all by its configuration: there is nothing to mend,
    or nobody to begin with. See `zsched.link.sessions.relink`.
    """
    if setting(session, "mode") != "peer" or not setting(session, "connect/endpoints"):
        return None
    if setting(session, "scouting/gossip/autoconnect") is not None:
        return None  # our own setting for "only what is in `connect`"
    return on_top_of(
        session,
        {
            "listen/endpoints": [],
            "scouting/gossip/autoconnect": {"router": [], "peer": ["router", "peer"]},
            "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "always"}},
            "transport/shared_memory/enabled": False,
        },
    )


def lease_s(session: str) -> float:
    """How long a peer of a session (its configuration) may be silent before zenoh ends the link."""
    return float(setting(session, "transport/link/tx/lease")) / 1000


def relay_endpoint(session: str) -> str:
    """Where a worker's session dials its own node's relay (the first of ``connect``); empty: nowhere."""
    endpoints = setting(session, "connect/endpoints")
    first = endpoints[0] if isinstance(endpoints, list) and endpoints else ""
    return first if isinstance(first, str) else ""


def setting(text: str, path: str) -> Any:
    """What a configuration says at one place, else zenoh's default; ``None`` where there is no text.

    Raises:
        ValueError: it is not a zenoh configuration.
    """
    return json.loads(_parsed(text).get_json(path)) if text.strip() else None


def tls_settings(operator_json5: str) -> Settings:
    """The settings of ``transport/link/tls`` that the operator's own text makes.

    Raises:
        ValueError: it is not a zenoh configuration.
    """
    found = setting(operator_json5, "transport/link/tls") or {}
    return {name: value for name, value in found.items() if value is not None}


def secured(
    *,
    certificate: str,
    key: str,
    trusted: str,
    rules: Settings,
    operator_json5: str = "",
    protocols: tuple[str, ...] = ("tls",),
) -> str:
    """The operator's text with TLS both ways and access control over it; the other three are paths, PEM.

    Which address a certificate is for is not looked at: robots change theirs. A connecting session also trusts the
    authorities of the public web, whatever ``trusted`` says; what lets in is ``rules``, by names that none of them
    issues. No link outlives the certificate at its other end.

    Raises:
        ValueError: the operator's JSON5 is not a zenoh configuration.
    """
    settings: Settings = {
        "transport/link/protocols": list(protocols),
        "transport/link/tls": {
            "root_ca_certificate": trusted,
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        },
        "access_control": rules,
    }
    return _render(settings, operator_json5)


# --- threads ---------------------------------------------------------------------------------------------------------


def pool_threads(nodes: int, tasks: int = 0) -> int:
    """How many threads zenoh's pools of one process need for so many nodes and tasks (`FEWEST_THREADS`..64).

    A link that falls silent holds one of them when its lease ends: about a second, or 10 s (zenoh's SO_LINGER) where
    something was still to be sent. With fewer threads than links, a split that takes all of them also silences those
    that still work: beats stop, the living look dead, a robot that is cut off is not served by its own worker. On the
    data network every worker is a peer of its own: a node may have a relay and one worker per task.
    """
    return min(max(nodes * (1 + tasks) + 2, FEWEST_THREADS), 64)


def daemon_pools(nodes: int) -> str:
    """The value of ``ZENOH_RUNTIME`` for a daemon with links to this many nodes (zenoh reads it once).

    What receives, transmits, closes links and shakes hands shares one pool: with a pool each, every packet wakes twice
    as many threads (decision 0016). Closing a link that is dead one way holds a thread for zenoh's SO_LINGER, 10 s, and
    a stalled peer holds one that transmits: so there is one for every link, and `TX_THREADS`. A daemon's frames are
    small; large values starve behind one pool, so relays and workers have their own.
    """
    shared = ", ".join(f"{pool}: (handover: rx)" for pool in ("tx", "net", "acc"))
    return f"(rx: (worker_threads: {pool_threads(nodes) + TX_THREADS}), {shared})"


def worker_pools(nodes: int, tasks: int) -> str:
    """The value of ``ZENOH_RUNTIME`` for a worker in a fleet with this many nodes and tasks.

    ``net`` closes links and dials, ``acc`` shakes hands with peers that dial us; both have one thread by default.
    Closing a link that is dead one way holds a thread for zenoh's SO_LINGER, 10 s, in which no other link came or went.
    """
    threads = pool_threads(nodes, tasks)
    return _pools(rx=threads, tx=TX_THREADS, net=threads, acc=threads)


def relay_pools(threads: int) -> str:
    """The value of ``ZENOH_RUNTIME`` for a relay: ``threads`` that receive, transmit, dial, and accept, each.

    One stalled target holds one thread that transmits, and later the one that closes its link. ``net`` and ``acc`` have
    as many as ``rx``, because a socket is read by the pool that opened it: ``net`` also receives on every link that
    this process has dialled, ``acc`` on those of its worker and its applications, which have dialled it. A machine that
    dies while it shakes hands holds a thread of ``acc`` for zenoh's SO_LINGER, 10 s (docs/decisions/0016).
    """
    return _pools(rx=threads, tx=threads, net=threads, acc=threads)


def _pools(**threads: int) -> str:
    return f"({', '.join(f'{name}: (worker_threads: {count})' for name, count in threads.items())})"


# --- parts -----------------------------------------------------------------------------------------------------------


def _common(timing: Timing) -> Settings:
    return {
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": round(timing.zenoh_lease_s * 1000),
        "transport/link/tx/keep_alive": timing.data_signs,
        "transport/unicast/open_timeout": round(OPEN_TIMEOUT_S * 1000),
        "transport/unicast/accept_timeout": round(ACCEPT_TIMEOUT_S * 1000),
        "timestamping/enabled": False,
        # also of clients: a relay that dies is back within 0.3 s, zenoh's default looks after 1 s, then 2, then 4
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 1000, "period_increase_factor": 1.25},
    }


def _peer(listen: tuple[str, ...], connect: tuple[str, ...], timing: Timing) -> Settings:
    settings = _common(timing)
    settings["mode"] = "peer"
    settings["scouting/gossip/enabled"] = True
    settings["listen/endpoints"] = list(listen)
    settings["connect/endpoints"] = list(connect)
    settings["connect/exit_on_failure"] = False
    return settings


def _set_gossip(settings: Settings, *, dials: bool, is_dialled: bool = True) -> None:
    """``is_dialled``: others can dial this session, too."""
    if not dials:
        settings["scouting/gossip/autoconnect"] = {"router": [], "peer": []}
        return
    # Of two that hear of each other one dials: where both redial after a cut, a link may come back dead.
    to_peer = "greater-zid" if is_dialled else "always"
    settings["scouting/gossip/autoconnect_strategy"] = {"peer": {"to_router": "always", "to_peer": to_peer}}


def _set_shared_memory(settings: Settings, *, is_on: bool) -> None:
    settings["transport/shared_memory/enabled"] = is_on
    if is_on:
        settings["transport/shared_memory/transport_optimization/messages"] = ["put"]


def _small_buffers(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(_small_buffer(endpoint) for endpoint in endpoints)


def _small_buffer(endpoint: str) -> str:
    """The endpoint with our send buffer, unless the operator has set one or the protocol has none."""
    end = Endpoint.of(endpoint)
    if end.protocol not in ("tcp", "tls") or end.option("so_sndbuf"):
        return endpoint
    return str(replace(end, options=";".join(filter(None, (end.options, f"so_sndbuf={DATA_SEND_BUFFER}")))))


def _render(settings: Settings, operator_json5: str) -> str:
    if operator_json5.strip():
        return on_top_of(operator_json5, settings)
    tree: Settings = {}
    for path, value in settings.items():
        *parents, leaf = path.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[leaf] = value
    return json.dumps(tree)


def on_top_of(operator_json5: str, settings: Settings) -> str:
    """A session's configuration with other settings over it.

    Raises:
        ValueError: it is not a zenoh configuration.
    """
    config = _parsed(operator_json5)
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return str(config)


def _parsed(operator_json5: str) -> zenoh.Config:
    """JSON5 is read by zenoh itself, so that its rules hold."""
    import zenoh  # noqa: PLC0415 - only who passes a file of his own pays for it here

    try:
        return zenoh.Config.from_json5(operator_json5)
    except Exception as error:
        raise ValueError(f"zenoh: config is not a zenoh configuration: {error}") from error
