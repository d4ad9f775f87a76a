"""Decides which keys a fleet file has, what each takes, and says so in the reference table.

Knows: every key with its kind, range and one sentence. Those of a field stand beside the field, with its default
(`zsched.core.values.limits`); the others stand here. Does not know: how the values relate (`zsched.config.load`).
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from typing import Any, Final

from zsched.config.blocks import (
    NAME_BLOCK,
    Block,
    Choice,
    Field,
    Flag,
    Forms,
    Here,
    ListOf,
    MapOf,
    Number,
    Record,
    Text,
)
from zsched.config.drivers import DRIVER_KEYS
from zsched.config.keys import keys
from zsched.config.ros2 import ros2_record
from zsched.config.timing import PROFILES
from zsched.core.values.certificates import parse_label
from zsched.core.values.endpoint import HOST_PORT, WITH_PATH, Endpoint
from zsched.core.values.fleet import (
    DEFAULT_BONUS,
    DEFAULT_SCORE,
    TASK_RULES,
    Demand,
    Fleet,
    LinkLimits,
    LinkSpec,
    LocalSide,
    Signatures,
    TaskSpec,
    Timing,
    WorkerSpec,
)
from zsched.core.values.gauges import GAUGES, Gauge
from zsched.core.values.model import (
    MAX_DEADLINE_MS,
    MIN_DEADLINE_MS,
    RSSI_MAX_DBM,
    RSSI_MIN_DBM,
    NodeKind,
    Objective,
    ScoreForm,
)
from zsched.core.values.plan import ServiceSettings, StreamSettings

PKI_FOLDER: Final = "pki"
_HOST: Final = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?:\.(?!-)[A-Za-z0-9_-]{1,63})*\.?")
_MAC: Final = re.compile(r"[0-9a-fA-F]{2}(:[0-9a-fA-F]{2}){5}")
_ENV_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_USER: Final = re.compile(r"[a-z_][a-z0-9_-]{0,31}")
_INTERFACE: Final = re.compile(r"[^\s/]{1,15}")


def host_fault(text: str) -> str | None:
    """Why ``text`` is no host name, IPv4 or IPv6 address."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        is_number = re.fullmatch(r"[0-9.]+", text) is not None
        if not is_number and len(text) <= 253 and _HOST.fullmatch(text) is not None:
            return None
        return "not an address" if is_number else "letters, digits, '-' and '.' only"
    if address.version == 6 and (address.is_link_local or "%" in text):
        return "an address of one card (link-local, with a zone) cannot be dialled from elsewhere: give another one"
    return None


def endpoint_fault(text: str) -> str | None:
    """Why ``text`` is no zenoh endpoint (``PROTOCOL/ADDRESS[?metadata][#options]``)."""
    end = Endpoint.of(text)
    if not text.startswith(f"{end.protocol}/") or end.protocol not in HOST_PORT + WITH_PATH:
        return f"it must begin with one of {', '.join(name + '/' for name in HOST_PORT + WITH_PATH)}"
    if str(end) != text or "?" in end.options:
        return "behind the address come ?metadata, then #options, neither of them empty"
    if end.protocol in WITH_PATH:
        return None if end.address else "nothing follows the protocol"
    if end.port is None or end.port > 65535:
        return "it must end with ':PORT', PORT 0..65535"
    host = end.address.rpartition(":")[0]
    if host.startswith("[") and host.endswith("]"):
        return host_fault(host[1:-1]) if ":" in host else "brackets are for IPv6 addresses"
    return "an IPv6 address stands in brackets" if ":" in host else host_fault(host)


def _matches(pattern: re.Pattern[str], why: str) -> Any:
    return lambda text: None if pattern.fullmatch(text) is not None else why


def _text_fault(text: str) -> str | None:
    if "\0" in text or len(text) > 4096:
        return "it holds a NUL or more than 4096 characters"
    return None


_TEXT: Final = Text("text", _text_fault)
_FILE: Final = Text("a file name", lambda text: "it is empty" if not text else _text_fault(text))
_ENDPOINT: Final = Text("a zenoh endpoint", endpoint_fault, 'for example "tcp/0.0.0.0:7457"')
_INTERFACE_NAME: Final = Text("a network interface", _matches(_INTERFACE, "1 to 15 characters, no blank, no '/'"))
_LABEL: Final = Text("a label", lambda text: None if text and len(text) <= 63 else "1 to 63 characters")
_LABELS: Final = MapOf(_LABEL, _LABEL)
_NAMES: Final = ListOf(Here(NAME_BLOCK), least=1)
_LABEL_OF_KEY: Final = Text(
    "a certificate's name", lambda text: None if parse_label(text) else "for example robot1, robot1.k2, ana.operator"
)
_TEMPLATE: Final = Text("a key template", _text_fault)


TRACE: Final = Record(
    "a trace",
    {
        "file": Field(_FILE, "CSV (or .csv.gz) of a recorded drive, relative to the fleet file.", required=True),
        **keys(LinkSpec, column=_TEXT),
    },
)

_LINK_FIELDS: Final = {
    "wifi": Field(_INTERFACE_NAME, "Read this interface's signal (nl80211, else /proc/net/wireless)."),
    "wired": Field(Flag(only=True), "A cable: the link counts 1."),
    "fixed": Field(Number(RSSI_MIN_DBM, RSSI_MAX_DBM, "dBm"), "A constant, for links that cannot be measured."),
    "trace": Field(TRACE, "Replay a recorded drive (lab and tests)."),
}

PEER_LINK: Final = Record(
    "a link",
    {
        **_LINK_FIELDS,
        "mac": Field(
            Text("a MAC address", _matches(_MAC, "six pairs of hex digits with ':' between")),
            "The peer is this station of the `wifi` interface (ad hoc, mesh, own access point).",
        ),
    },
)

_ENDPOINTS: Final = ListOf(Here(_ENDPOINT), least=1)
LOCAL: Final = Record("a local side", keys(LocalSide, connect=_ENDPOINTS, listen=_ENDPOINTS))

NODE: Final = Record(
    "a node",
    {
        "kind": Field(Choice.of(NodeKind), "Robots vote and have streams; edges are candidates only.", required=True),
        "host": Field(Text("a host name or IP address", host_fault), "How the others reach this machine."),
        "listen": Field(
            Record(
                "a listen section",
                {
                    "control": Field(_ENDPOINT, "Endpoint of the control session.", default="any free port"),
                    "data": Field(
                        _ENDPOINT,
                        "Endpoint of the data session, another port.",
                        default="port 7458 if it is free, else any free port",
                    ),
                },
                removed={"streams": "delete it: an application joins its robot's relay as a client of zenoh"},
            ),
            "Where this node listens.",
        ),
        "local": Field(LOCAL, "A network for the host's applications alone."),
        "labels": Field(_LABELS, "Free pairs of text that `candidates` may ask for."),
        **_LINK_FIELDS,
        "links": Field(MapOf(NAME_BLOCK, PEER_LINK), "Links to single peers, where they differ from the node's own."),
    },
)

SELECTOR: Final = Record(
    "a selection of nodes",
    {
        "kind": Field(Choice.of(NodeKind), "All nodes of this kind."),
        "labels": Field(_LABELS, "All nodes that have all these labels."),
    },
)
_NODES: Final = Forms(listing=_NAMES, mapping=SELECTOR)

_SHARE: Final = Number(0, 1)


def _weight_told(gauge: Gauge) -> str:
    unknown = "is out while another candidate has one" if gauge.is_needed else "counts 1"
    best, worst = gauge.shown(gauge.best), gauge.shown(gauge.worst)
    return f"Weight of {gauge.says}: {best} is worth 1, {worst} nothing; without it a node {unknown}."


def _limit_told(gauge: Gauge) -> str:
    beyond, inside = ("below", "above") if gauge.is_floor else ("above", "below")
    back = f"{gauge.margin * 100:g} %" if not gauge.unit else f"{gauge.margin:g} {gauge.unit}"
    return f"Limit of {gauge.says}: the owner is left {beyond} it, another gets the task {back} {inside} it."


WEIGHTS: Final = Record(
    "the weights section",
    {
        "cpu": Field(
            _SHARE,
            "Weight of the CPU.",
            default="`0`",
        ),
        "memory": Field(_SHARE, "Weight of the memory.", default="`0`"),
        "network": Field(_SHARE, "Weight of the radio link (Eq. 3).", default="`0`"),
        **{gauge.name: Field(_SHARE, _weight_told(gauge), default="`0`") for gauge in GAUGES},
    },
)

LIMITS: Final = Record(
    "a limits section",
    {gauge.name: Field(Number(gauge.low, gauge.high, gauge.unit), _limit_told(gauge)) for gauge in GAUGES},
)

DEMAND: Final = Record("a demand", keys(Demand))

SCHEDULING: Final = Record(
    "a scheduling section",
    {
        "bonus": Field(
            _SHARE,
            "What the owner is worth more.",
            default=f"`{DEFAULT_BONUS:g}`",
        ),
        "score": Field(
            Choice.of(ScoreForm),
            "A machine's worth: the share of its work that the task would get done there; `paper`: what is left free "
            "(Eq. 1, 2, 4).",
            default=f"`{DEFAULT_SCORE}`",
        ),
        "objective": Field(
            Choice.of(Objective),
            "As many jobs as possible done, or done within `deadline_ms` (a late one counts a tenth; `score: service` "
            "only).",
            default=f"`{Objective.SERVICE}`",
        ),
        "deadline_ms": Field(
            Number(MIN_DEADLINE_MS, MAX_DEADLINE_MS, "ms"),
            "For `objective: latency`: the time of a job, network included; for workers with the library.",
            default="none",
        ),
        "prefer": Field(
            MapOf(Text("a node, or KEY=VALUE of a label"), _SHARE),
            "How much more machines are worth: `{edge1: 0.05}`, or `{gpu=yes: 0.1}` by a label.",
            default="none",
        ),
        "together": Field(
            MapOf(NAME_BLOCK, _SHARE), "How much more a machine with this task is worth.", default="none"
        ),
        "spread": Field(MapOf(NAME_BLOCK, _SHARE), "How much less a machine with this task is worth.", default="none"),
        **keys(TaskSpec, *TASK_RULES),
    },
    removed={
        "patience": "delete it; or price_s: 0.3, what a move costs in seconds of the task's work",
        "cool_down_s": "delete it; where a move is dear: price_s: 2",
        "max_moves_per_minute": "delete it: it is 6",
        "aggregate": "delete it: it is the mean",
        "cpu_floor_ratio": "delete it; a program that is no task needs room: demand: {cpu_cores: 1}, or give it a task",
        "memory_floor_ratio": "delete it; what the task needs is kept free: demand: {memory_mb: 2000}",
    },
)

LINK_LIMITS: Final = Record(
    "a link section",
    keys(LinkLimits),
    removed={"pair": "delete it: the candidate's way counts", "foresee_s": "delete it: signals count as they are"},
)

WORKER: Final = Record(
    "a worker",
    {
        **DRIVER_KEYS,
        **keys(
            WorkerSpec,
            command=ListOf(Text("a word", _text_fault), least=1),
            env=MapOf(Text("a variable", _matches(_ENV_NAME, "letters, digits and '_'")), _TEXT),
            user=Text("a user of the machine", _matches(_USER, "lower-case letters, digits, '-' and '_'")),
        ),
    },
)

RULE: Final = Record(
    "a stream rule",
    {
        "from": Field(Here(_TEMPLATE), "Key that is subscribed to.", required=True),
        "to": Field(Here(_TEMPLATE), "Key that is published.", required=True),
        **keys(StreamSettings),
    },
)

SERVICE: Final = Record(
    "a service rule",
    {
        "from": Field(Here(_TEMPLATE), "Key under which the robot's applications ask.", required=True),
        "to": Field(Here(_TEMPLATE), "Key under which the owner's worker answers.", required=True),
        **keys(ServiceSettings),
    },
)

TASK: Final = Record(
    "a task",
    {
        "candidates": Field(_NODES, "The nodes that may own the task: names, or a selection.", required=True),
        "weights": Field(
            WEIGHTS,
            "How much CPU, memory, network and gauges count; their sum is 1.",
            required=True,
        ),
        "limits": Field(LIMITS, "How far a candidate's gauges may go."),
        "demand": Field(DEMAND, "What the task needs at least; where more is measured, that counts."),
        "scheduling": Field(SCHEDULING, "When a better candidate is worth a move."),
        "link": Field(LINK_LIMITS, "The limits of Eq. 3."),
        "worker": Field(WORKER, "The process that does the work."),
        "inputs": Field(ListOf(RULE), "Streams from the robots' applications to the owner's worker."),
        "outputs": Field(ListOf(RULE), "Streams from the owner's worker to the robots' applications."),
        "services": Field(ListOf(SERVICE), "Requests of the robots' applications that the owner's worker answers."),
        "ros2": Field(ros2_record(RULE, SERVICE), "The same by ROS 2 names."),
        **keys(TaskSpec, "on_isolation", "exclusive", "drain_s"),
    },
)

TIMING: Final = Record(
    "a timing section",
    {
        "profile": Field(Choice(PROFILES), "The profile from which the others differ.", default="`wifi`"),
        **keys(Timing),
    },
)

SECURITY: Final = Record(
    "a security section",
    {
        "folder": Field(
            _FILE,
            "Folder of `certificate.pem`, `key.pem` and `ca.pem`, relative to the fleet file.",
            default=f"`{PKI_FOLDER}`",
        ),
        "operators": Field(_NAMES, "People and tools that may give commands, besides the nodes."),
        "guests": Field(_NAMES, "People and tools that read status and streams, and nothing else."),
        "revoked": Field(
            ListOf(Here(_LABEL_OF_KEY), least=1),
            "Keys that are not let in, as `zsched pki revoke` names them.",
        ),
        "orders": Field(
            ListOf(Here(NAME_BLOCK)),
            "The only nodes that may give commands, besides operators.",
            default="every node",
        ),
        "signatures": Field(
            Choice.of(Signatures),
            "Signatures on votes, learnt values and commands; `offered`: unsigned frames are taken.",
            default="`required`",
        ),
    },
)

CELL: Final = Record(
    "a cell",
    {
        "gateways": Field(_ENDPOINTS, "Control endpoints of two of its nodes, tried in this order.", required=True),
        "file": Field(_FILE, "Its fleet file, relative to this one; needed where it is secured."),
    },
)

FLEET: Final = Record(
    "the fleet file",
    {
        "fleet": Field(NAME_BLOCK, "Name of the fleet; others do not see it.", required=True),
        "timing": Field(Forms(word=Choice(PROFILES), mapping=TIMING), "Clocks of the protocol.", default="`wifi`"),
        "seeds": Field(
            _NAMES, "Nodes that everybody dials; gossip finds the rest.", default="the first two that can be dialled"
        ),
        "nodes": Field(MapOf(NAME_BLOCK, NODE), "The machines.", required=True),
        "tasks": Field(MapOf(NAME_BLOCK, TASK), "What must run somewhere, and its streams."),
        "electorate": Field(
            Forms(word=Choice({"auto": ()}), listing=_NAMES, mapping=SELECTOR),
            "Who agrees and stores what is agreed; `auto`: at first the robots (all nodes where there is none), which "
            "are replaced when they are gone.",
            default="`auto`",
        ),
        "zenoh": Field(
            Record(
                "a zenoh section",
                {"config": Field(_FILE, "JSON5 file of zenoh's settings, relative to the fleet file.")},
            ),
            "Settings of zenoh itself.",
        ),
        "site": Field(MapOf(NAME_BLOCK, CELL), "The other fleets of the site."),
        "security": Field(SECURITY, "Only holders of certificates of the fleet's authority are let in."),
        **keys(Fleet),
    },
)


_KEYS_BELOW: Final = re.compile(r"a mapping \{[^{}]*\}")
"""The keys of a mapping have a table of their own."""


MANY: Final = 4
"""Settings that two sections share are told once from this many on."""


def reference() -> str:
    """The reference of every key as Markdown: one table per section, sections in the order of the file.

    `docs/guide/fleet-file.md` holds it, and a test compares the two. Settings that sections share are in the first one;
    a range alone is of numbers. The clocks are not in it: docs/design/timing.md has them by their profiles.
    """
    sections: dict[int, tuple[Record, list[str]]] = {}
    _collect(FLEET, "", sections)
    del sections[id(TIMING)]
    before: dict[str, list[str]] = {}
    return "\n".join(_section(record, paths, before) for record, paths in sections.values())


def _collect(record: Record, path: str, sections: dict[int, tuple[Record, list[str]]]) -> None:
    """Every record below ``record`` with all the paths where it stands (the rules of inputs and outputs are one)."""
    sections.setdefault(id(record), (record, []))[1].append(path)
    for name, item in record.items.items():
        for suffix, inner in _records(item.block):
            _collect(inner, f"{path}{'.' if path else ''}{name}{suffix}", sections)


def _records(block: Block[Any]) -> Iterator[tuple[str, Record]]:
    if isinstance(block, Record):
        yield "", block
    elif isinstance(block, Forms):
        for inner in (block.listing, block.mapping):
            if inner is not None:
                yield from _records(inner)
    elif isinstance(block, MapOf):
        yield from ((f".NAME{suffix}", record) for suffix, record in _records(block.item))
    elif isinstance(block, ListOf):
        yield from ((f"[]{suffix}", record) for suffix, record in _records(block.item))


def _section(record: Record, paths: list[str], before: dict[str, list[str]]) -> str:
    """One table; ``before`` are the rows of the sections above it, to which this one is added."""
    heading = ", ".join(f"`{path}`" for path in paths) if paths != [""] else "The file"
    rows = []
    for name, item in record.items.items():
        takes = _KEYS_BELOW.sub("a mapping", item.block.says()).replace("a number ", "").replace("` or `", "`, `")
        takes = takes.removesuffix(", each a mapping").removesuffix(", each value a mapping")
        default = "required" if item.required else item.default
        rows.append(f"| `{name}` | {takes}{f' ({default})' if default else ''} | {item.doc} |")
    model = max(before, key=lambda name: len(set(before[name]) & set(rows)), default="")
    shared = [row for row in rows if row in before.get(model, ())]
    before[heading] = rows
    if len(shared) < MANY:
        shared = []
    own = [row for row in rows if row not in shared]
    table = ("| key | takes (default) | meaning |", "| --- | --- | --- |", *own) if own else ()
    names = ", ".join(row.split(" | ")[0].removeprefix("| ") for row in shared)
    more = ((f"\nAnd as in {model}: {names}." if own else f"As in {model}: {names}."),) if shared else ()
    return "\n".join((f"### {heading}\n", *table, *more, ""))
