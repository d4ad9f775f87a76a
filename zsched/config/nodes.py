"""Decides what the `nodes:` of a fleet file say: machines, endpoints, links, and which nodes a selection means.

Knows: how the values of one node, and the nodes among each other, relate. Does not know: tasks.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from zsched.config.blocks import Located, Section
from zsched.config.reader import Collector, Place, nearest
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import LinkSpec, LocalMode, LocalSide, NodeSpec
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.profile import LinkSource
from zsched.core.values.struct import Struct

_SOURCES = ("wifi", "wired", "fixed", "trace")


class Cast(Struct, frozen=True, kw_only=True):
    """The nodes of the file: all names, and those nodes that could be read."""

    place: Place
    names: tuple[NodeId, ...]
    nodes: tuple[NodeSpec, ...]
    sound: frozenset[NodeId]
    """Names of the nodes without a fault of their own: only these are judged in what refers to them."""
    is_whole: bool
    """Every node could be read: only then does an empty selection mean something."""

    def labels(self) -> tuple[str, ...]:
        """All labels as ``key=value``, sorted."""
        return tuple(sorted({f"{key}={value}" for node in self.nodes for key, value in node.labels}))

    def of_kind(self, kind: NodeKind) -> tuple[NodeId, ...]:
        """Names of all nodes of ``kind``, sorted."""
        return tuple(sorted(node.name for node in self.nodes if node.kind is kind))

    def known(self, names: tuple[Located[str], ...], out: Collector) -> Iterator[Located[str]]:
        """Those of ``names`` that are nodes; the others, and doubles, are faults."""
        seen: set[str] = set()
        for name in names:
            if name.value not in self.names:
                out.error(name.place, f"there is no node {name.value!r}", nearest(name.value, self.names))
            elif name.value in seen:
                out.error(name.place, f"{name.value!r} is there twice")
            else:
                seen.add(name.value)
                yield name


def select(given: tuple[Located[str], ...] | Section, cast: Cast, out: Collector) -> tuple[NodeId, ...]:
    """The nodes that a list of names or a selection means, sorted. An empty selection is the caller's to judge."""
    if not isinstance(given, Section):
        return tuple(sorted(name.value for name in cast.known(given, out)))
    if not given.places:
        out.error(given.place, "the selection is empty", "for example {kind: edge}, or a list of names")
        return ()
    kind = given.get("kind")
    labels = {key: held.value for key, held in given.get("labels", {}).items()}
    return tuple(
        sorted(
            node.name
            for node in cast.nodes
            if (kind is None or node.kind is kind) and labels.items() <= dict(node.labels).items()
        )
    )


def read_nodes(section: Section, folder: Path, out: Collector) -> Cast:
    """All nodes of the file, with what is wrong between them reported."""
    entries: dict[str, Located[Section | None]] = section.get("nodes", {})
    before = out.count
    nodes: list[NodeSpec] = []
    for name, entry in entries.items():
        if entry.value is not None:
            node = _node(name, entry.value, tuple(entries), folder, out)
            if node is not None:
                nodes.append(node)
    place = section.where("nodes")
    if not entries and "nodes" in section.values:
        out.error(place, "the fleet has no nodes")
    is_whole = out.count == before and len(nodes) == len(entries) > 0
    _check_endpoints(entries, out)
    sound = frozenset(name for name, entry in entries.items() if entry.value is not None and entry.value.is_whole)
    return Cast(place=place, names=tuple(entries), nodes=tuple(nodes), sound=sound, is_whole=is_whole)


def _node(name: str, given: Section, names: tuple[str, ...], folder: Path, out: Collector) -> NodeSpec | None:
    links = tuple(_links(name, given, names, folder, out))
    if "kind" not in given.values:
        return None
    listen: Section | None = given.get("listen")
    labels = given.get("labels", {})
    return NodeSpec(
        name=name,
        kind=given.get("kind"),
        host=given.get("host", ""),
        listen_control=listen.get("control", "") if listen is not None else "",
        listen_data=listen.get("data", "") if listen is not None else "",
        labels=tuple(sorted((key, held.value) for key, held in labels.items() if held.value is not None)),
        links=links,
        local=_local(given, out),
    )


def _local(given: Section, out: Collector) -> LocalSide | None:
    """The local side, checked against the node's own endpoints."""
    section: Section | None = given.get("local")
    if section is None:
        return None
    if given.get("kind") is NodeKind.EDGE:
        out.warn(given.where("local"), "an edge has no streams of its own: its local side carries nothing")
    mode = section.get("mode", LocalMode.CLIENT)
    connect, listen = section.get("connect", ()), section.get("listen", ())
    if mode is LocalMode.CLIENT and "listen" in section.places:
        out.error(section.where("listen"), "a client does not listen", "mode: peer, or delete it")
    elif mode is LocalMode.CLIENT and "connect" not in section.places:
        out.error(section.place, "a client needs somebody to dial", 'for example connect: ["tcp/127.0.0.1:7447"]')
    elif not connect and not listen and section.is_whole:
        out.error(section.place, "it neither dials nor listens: nobody would be on it", "add connect or listen")
    own: Section | None = given.get("listen")
    kinds = ("control", "data")
    ports = {Endpoint.of(own.get(kind)).port: kind for kind in kinds if kind in own.values} if own else {}
    for endpoint in (*connect, *listen):
        end = Endpoint.of(endpoint.value)
        kind = ports.get(end.port) if end.is_own_host or end.is_everywhere else None
        if kind is not None:
            hint = "the local side is another network: a router or port of its own"
            out.error(endpoint.place, f"{endpoint.value} is this node's own {kind} session", hint)
    return LocalSide(mode=mode, connect=tuple(one.value for one in connect), listen=tuple(one.value for one in listen))


# --- endpoints -------------------------------------------------------------------------------------------------------


def _check_endpoints(entries: dict[str, Located[Section | None]], out: Collector) -> None:
    """No two sessions of the fleet may have one address, whatever else is wrong with their nodes."""
    taken: dict[str, str] = {}
    for name, entry in entries.items():
        section = entry.value
        listen: Section | None = section.get("listen") if section is not None else None
        if section is None or listen is None:
            continue
        for kind in ("control", "data"):
            # a node without a host listens "everywhere", but on its own machine
            endpoint = listen.get(kind, "")
            dialled = Endpoint.of(endpoint).dialled(section.get("host", "") or name)
            if not dialled:
                continue
            owner = taken.setdefault(Endpoint.of(dialled).place, f"{name}'s {kind} session")
            if owner != f"{name}'s {kind} session":
                out.error(
                    listen.where(kind),
                    f"{endpoint} is already {owner}",
                    "give each session a port of its own (`zsched invite --address HOST:PORT`)",
                )


# --- links -----------------------------------------------------------------------------------------------------------


def _links(name: str, given: Section, names: tuple[str, ...], folder: Path, out: Collector) -> Iterator[LinkSpec]:
    own = _link(given, None, "", folder, out)
    if own is not None:
        yield own
    for peer, entry in given.get("links", {}).items():
        if peer == name or peer not in names:
            why = f"{name!r} is this node itself" if peer == name else f"there is no node {peer!r}"
            out.error(entry.place, why, nearest(peer, (other for other in names if other != name)))
            continue
        if entry.value is None:
            continue
        link = _link(entry.value, peer, given.get("wifi", ""), folder, out)
        if link is not None:
            yield link
        elif not entry.value.places:
            out.error(entry.place, f"the link to {peer!r} has no source", f"one of: {', '.join((*_SOURCES, 'mac'))}")


def _link(given: Section, peer: str | None, interface: str, folder: Path, out: Collector) -> LinkSpec | None:
    """The one source of a link; ``interface`` is the node's own, for a link that names only the station."""
    sources = [source for source in _SOURCES if source in given.places]
    if len(sources) > 1:
        message = f"a link has one source, not {' and '.join(sources)}"
        out.error(given.where(sources[1]), message, "delete all but one")
        return None
    mac: str = given.get("mac", "")
    if mac and sources not in ([], ["wifi"]):
        out.error(
            given.where("mac"), f"a station is measured by `wifi`, not by `{sources[0]}`", "delete one of the two"
        )
        return None
    if mac and not (given.get("wifi") or interface):
        out.error(given.where("mac"), "this node has no `wifi` interface that hears the station", "add wifi: wlan0")
        return None
    if mac:
        value = given.get("wifi") or interface
        return LinkSpec(source=LinkSource.NL80211, peer=peer, value=value, mac=mac.lower())
    return _plain_link(given, peer, sources[0], folder, out) if sources and sources[0] in given.values else None


def _plain_link(given: Section, peer: str | None, source: str, folder: Path, out: Collector) -> LinkSpec:
    value = given.get(source)
    if source == "wifi":
        return LinkSpec(source=LinkSource.NL80211, peer=peer, value=value)
    if source == "wired":
        return LinkSpec(source=LinkSource.WIRED, peer=peer)
    if source == "fixed":
        return LinkSpec(source=LinkSource.FIXED, peer=peer, value=f"{value:g}")
    path = folder / value.get("file", "")
    if "file" in value.values:
        warn_missing(path, value.where("file"), out)
    more = {name: value.get(name) for name in ("column", "offset_s") if name in value.values}
    return LinkSpec(source=LinkSource.TRACE, peer=peer, value=str(path), **more)


def warn_missing(path: Path, place: Place, out: Collector) -> None:
    """The fleet file is the same on every machine, other files need not be: their absence is a warning."""
    try:
        is_there = path.is_file()
    except (OSError, ValueError):
        is_there = False
    if not is_there:
        out.warn(place, f"{path} is not on this machine")
