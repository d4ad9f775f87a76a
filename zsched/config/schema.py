"""Decides which keys a fleet file has, what each takes, and says so in the reference table.

Knows: every key with its kind, range and one sentence. Does not know: how the values relate (`zsched.config.load`), and
the defaults, which live in `zsched.core.values.fleet`, `zsched.core.values.plan` and `zsched.core.values.model`.
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
    Removed,
    Text,
    Whole,
)
from zsched.config.ros2 import ros2_record
from zsched.config.timing import PROFILES
from zsched.core.scheduler.patience import CHOICES
from zsched.core.values.fleet import (
    DEFAULT_FORESEE_S,
    DEFAULT_SCORE,
    PAPER_PATIENCE,
    PATIENT_BONUS,
    PATIENT_COOL_DOWN_S,
    RADIO_PATIENCE,
    Demand,
    Fleet,
    LinkLimits,
    LocalMode,
    LocalSide,
    OnIsolation,
    PairReading,
    Reach,
    SharedMemory,
    Standby,
    TaskSpec,
    Timing,
    WorkerLink,
    WorkerSpec,
)
from zsched.core.values.model import (
    MAX_DEADLINE_MS,
    MIN_DEADLINE_MS,
    RSSI_MAX_DBM,
    RSSI_MIN_DBM,
    Aggregate,
    NodeKind,
    Objective,
    ScoreForm,
    Tuning,
)
from zsched.core.values.plan import HandoverRule, OnCrash, ReadyWhen, ServiceSettings, StreamClass, StreamSettings

_HOST_PORT: Final = ("tcp", "udp", "tls", "quic", "ws")
_WITH_PATH: Final = ("unixsock-stream", "unixpipe", "serial", "vsock")
_HOST: Final = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?:\.(?!-)[A-Za-z0-9_-]{1,63})*\.?")
_MAC: Final = re.compile(r"[0-9a-fA-F]{2}(:[0-9a-fA-F]{2}){5}")
_ENV_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_INTERFACE: Final = re.compile(r"[^\s/]{1,15}")


def host_fault(text: str) -> str | None:
    """Why ``text`` is no host name, IPv4 or IPv6 address."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        is_number = re.fullmatch(r"[0-9.]+", text) is not None
        if not is_number and len(text) <= 253 and _HOST.fullmatch(text) is not None:
            return None
        return "not an address" if is_number else "letters, digits, '-' and '.' only"
    return None


def endpoint_fault(text: str) -> str | None:
    """Why ``text`` is no zenoh endpoint (``PROTOCOL/ADDRESS[?metadata][#config]``)."""
    protocol, slash, rest = text.partition("/")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if not slash or protocol not in _HOST_PORT + _WITH_PATH:
        return f"it must begin with one of {', '.join(name + '/' for name in _HOST_PORT + _WITH_PATH)}"
    if protocol in _WITH_PATH:
        return None if address else "nothing follows the protocol"
    host, colon, port = address.rpartition(":")
    if not colon or not port.isascii() or not port.isdigit() or len(port) > 5 or int(port) > 65535:
        return "it must end with ':PORT', PORT 0..65535"
    if host.startswith("[") and host.endswith("]"):
        return host_fault(host[1:-1]) if ":" in host else "brackets are for IPv6 addresses"
    return "an IPv6 address stands in brackets" if ":" in host else host_fault(host)


def _matches(pattern: re.Pattern[str], why: str) -> Any:
    return lambda text: None if pattern.fullmatch(text) is not None else why


def _text_fault(text: str) -> str | None:
    if "\0" in text or len(text) > 4096:
        return "it holds a NUL or more than 4096 characters"
    return None


_SECONDS: Final = Number(0.01, 3600, "s")
_DBM: Final = Number(RSSI_MIN_DBM, RSSI_MAX_DBM, "dBm")
_TEXT: Final = Text("text", _text_fault)
_FILE: Final = Text("a file name", lambda text: "it is empty" if not text else _text_fault(text))
_ENDPOINT: Final = Text("a zenoh endpoint", endpoint_fault, 'for example "tcp/0.0.0.0:7457"')
_INTERFACE_NAME: Final = Text("a network interface", _matches(_INTERFACE, "1 to 15 characters, no blank, no '/'"))
_LABEL: Final = Text("a label", lambda text: None if text and len(text) <= 63 else "1 to 63 characters")
_LABELS: Final = MapOf(_LABEL, _LABEL)
_NAMES: Final = ListOf(Here(NAME_BLOCK), least=1)
_TEMPLATE: Final = Text("a key template", _text_fault)


TRACE: Final = Record(
    "a trace",
    {
        "file": Field(_FILE, "CSV (or .csv.gz) of a recorded drive, relative to the fleet file.", required=True),
        "column": Field(_TEXT, "The column that holds dBm.", default="`c_rssi`"),
        "offset_s": Field(Number(0, 1e6, "s"), "Where in the drive to start.", default="`0`"),
    },
)

_LINK_FIELDS: Final = {
    "wifi": Field(_INTERFACE_NAME, "Read this interface's signal (nl80211, else /proc/net/wireless)."),
    "wired": Field(Flag(only=True), "A cable: the link counts 1."),
    "fixed": Field(_DBM, "A constant, for tests and for links that cannot be measured."),
    "trace": Field(TRACE, "Replay a recorded drive (lab and tests)."),
}

PEER_LINK: Final = Record(
    "a link",
    {
        **_LINK_FIELDS,
        "mac": Field(
            Text("a MAC address", _matches(_MAC, "six pairs of hex digits with ':' between")),
            "The peer is this station of the node's `wifi` interface (ad hoc, mesh, or this node is the access point).",
        ),
    },
)

LOCAL: Final = Record(
    "a local side",
    {
        "mode": Field(Choice.of(LocalMode), "`client`: of the host's router; `peer`: among the host's peers."),
        "connect": Field(ListOf(Here(_ENDPOINT), least=1), "Whom to dial, such as the host's `rmw_zenohd`."),
        "listen": Field(ListOf(Here(_ENDPOINT), least=1), "Where the host's applications dial us (`peer` only)."),
    },
    LocalSide,
)

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
                    "data": Field(_ENDPOINT, "Endpoint of the data session, another port.", default="any free port"),
                },
            ),
            "Where this node listens; the others find it by gossip from the seeds.",
        ),
        "local": Field(LOCAL, "A network of its own for the host's applications: their keys stay on this machine."),
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
WEIGHTS: Final = Record(
    "the weights section",
    {
        "cpu": Field(_SHARE, "Weight of free CPU (Eq. 1). The three weights sum to 1.", default="`0`"),
        "memory": Field(_SHARE, "Weight of free memory (Eq. 2).", default="`0`"),
        "network": Field(_SHARE, "Weight of the radio link (Eq. 3).", default="`0`"),
    },
)

DEMAND: Final = Record(
    "a demand",
    {
        "cpu_cores": Field(Number(0, 4096, "cores"), "CPU that the task needs at least."),
        "memory_mb": Field(Number(0, 1e8, "MiB"), "Memory that the task needs at least."),
    },
    Demand,
)

SCHEDULING: Final = Record(
    "a scheduling section",
    {
        "bonus": Field(
            _SHARE,
            "Added to the owner's joint utility: what a move must gain.",
            default=f"`{PATIENT_BONUS:g}`; `0.1` with `time_to_trigger_s` alone",
        ),
        "time_to_trigger_s": Field(
            Number(0, 3600, "s"), "How long another candidate must lead, for tasks without `patience`.", default="none"
        ),
        "cool_down_s": Field(
            Number(0, 86400, "s"),
            "Least stay after a move.",
            default=f"`{PATIENT_COOL_DOWN_S:g}`; `10` with `time_to_trigger_s` alone",
        ),
        "score": Field(
            Choice.of(ScoreForm),
            "What a machine is worth to the task: `service`, the share of its work that the task would get done there; "
            "`paper`, the free share of it once the task is there (Eq. 1, 2, 4).",
            default=f"`{DEFAULT_SCORE}`",
        ),
        "objective": Field(
            Choice.of(Objective),
            "What the task wants: `service`, as many of its jobs done as possible; `latency`, as many as possible "
            "done within `deadline_ms`. With `score: service` only.",
            default=f"`{Objective.SERVICE}`",
        ),
        "deadline_ms": Field(
            Number(MIN_DEADLINE_MS, MAX_DEADLINE_MS, "ms"),
            "For `objective: latency`: a job that takes longer, from input to output and the network included, "
            "comes too late.",
            default="none",
        ),
        "aggregate": Field(Choice.of(Aggregate), "How the robots' utilities become one; `median` resists a liar."),
        "reach": Field(Choice.of(Reach), "Who must reach a candidate.", default=f"`{Reach.MAJORITY}`"),
        "memory_floor_ratio": Field(
            Number(0, 0.9),
            "Where a task leaves less memory free than this share, its memory counts up to 15 % less "
            "(`score: paper`: an owner that has less is left).",
            default="`0.05`",
        ),
        "max_moves_per_minute": Field(
            Whole(1, 100_000), "Hard cap of planned moves; escapes are bounded too, at 60.", default="`6`"
        ),
        "patience": Field(
            Number(0.001, 1000),
            "Move once staying has cost so much, lead times seconds (`time_to_trigger_s` does not count then): "
            "a big lead is followed sooner than a small one.",
            default=f"learnt, {CHOICES[0]:g} to {CHOICES[-1]:g}; `{RADIO_PATIENCE:g}` with a weight for the network; "
            f"`{PAPER_PATIENCE:g}` with `score: paper`; none with `time_to_trigger_s` alone",
        ),
    },
    Tuning,
    removed={
        "pays_off_in_s": Removed(
            why="it gained only where a move costs ten seconds and more, and no more than a larger bonus does there",
            instead="delete it; where moves are that dear: bonus: 0.2",
        ),
    },
)

LINK_LIMITS: Final = Record(
    "a link section",
    {
        "nu_dbm": Field(_DBM, "Least usable signal (Eq. 3): below it the candidate's utility is 0."),
        "rho_dbm": Field(_DBM, "Best achievable signal (Eq. 3); above `nu_dbm`."),
        "pair": Field(
            Choice.of(
                PairReading,
                {
                    "mean": Removed(
                        why="its leads were a quarter of candidate's, less than the bonus that noise asks for",
                        instead="pair: candidate, which ranks three robots and more as mean did; of two: pair: weaker",
                    )
                },
            ),
            "Worth of a link through an access point: by the candidate's way (as printed), or by the weaker one.",
        ),
        "foresee_s": Field(
            Number(0, 30, "s"),
            "Signals count as they will be so far ahead along their trend (at most 6 dB); `0`: as they are.",
            default=f"`{DEFAULT_FORESEE_S:g}`",
        ),
    },
    LinkLimits,
    removed={
        "knee_dbm": Removed(
            why="a knee gained nothing, and which signal it is depends on the radio",
            instead="delete it: between nu_dbm and rho_dbm a link's worth is linear",
        ),
    },
)

WORKER: Final = Record(
    "a worker",
    {
        "command": Field(
            ListOf(Text("a word", _text_fault), least=1),
            "Program and arguments, no shell. A first word `python` is the daemon's own interpreter. "
            "Absent: the worker is started by somebody else.",
        ),
        "standby": Field(
            Choice.of(Standby), "`warm`: runs on every candidate; `cold`: started on the move, by its `command`."
        ),
        "ready": Field(
            Choice.of(ReadyWhen),
            "`token`: zsched.worker says so; `matching`: any zenoh program, while it takes every input and service.",
            default="`token`",
        ),
        "link": Field(Choice.of(WorkerLink), "How workers join the data network."),
        "env": Field(MapOf(Text("a variable", _matches(_ENV_NAME, "letters, digits and '_'")), _TEXT), "Environment."),
        "start_deadline_s": Field(
            _SECONDS, "Ready within this time, or the start has failed. So long may the owner's be away."
        ),
        "stop_grace_s": Field(_SECONDS, "Between SIGINT, SIGTERM and SIGKILL."),
        "output_deadline_s": Field(
            _SECONDS, "No output for so long while inputs flow counts as hung.", default="not watched"
        ),
        "max_failures": Field(Whole(1, 100), "So many failures in the window make the node ineligible."),
        "failure_window_s": Field(
            Number(1, 86400, "s"), "The window; failures since it was last ready count however old."
        ),
    },
    WorkerSpec,
)

RULE: Final = Record(
    "a stream rule",
    {
        "from": Field(Here(_TEMPLATE), "Key that is subscribed to; a template.", required=True),
        "to": Field(Here(_TEMPLATE), "Key that is published; a template.", required=True),
        "class": Field(Choice.of(StreamClass), "What the stream needs.", default=f"`{StreamClass.BEST_EFFORT}`"),
        "keep_last": Field(Whole(0, 1000), "Samples per key that a new owner gets at once (class `latest`)."),
        "depth": Field(Whole(1, 100_000), "Samples that may wait between subscriber and publisher."),
        "handover": Field(Choice.of(HandoverRule), "Outputs: switch at the new owner's first sample, or lose nothing."),
        "max_hz": Field(Number(0.01, 10_000, "Hz"), "Highest rate per key; not for `reliable`.", default="no limit"),
        "mirror": Field(Flag(), "Inputs: feed both owners during a move (outputs with handover `latest` only)."),
        "on_crash": Field(
            Choice.of(OnCrash),
            "Inputs of class `reliable`: what a dead owner had not acknowledged is reported (done at most once), "
            "or replayed to the next owner (at least once).",
        ),
    },
    StreamSettings,
)

SERVICE: Final = Record(
    "a service rule",
    {
        "from": Field(Here(_TEMPLATE), "Key under which the robot's applications ask; a template.", required=True),
        "to": Field(Here(_TEMPLATE), "Key under which the owner's worker answers; a template.", required=True),
        "retry": Field(Flag(), "Ask the next owner when the old one did not answer: it may be done twice."),
        "timeout_s": Field(Number(0.05, 3600, "s"), "Every request is answered within this time."),
        "hold_s": Field(Number(0, 3600, "s"), "How long a request waits for an owner while there is none."),
        "max_pending": Field(Whole(1, 256), "Requests at the owner at one time; the next one is answered `busy`."),
    },
    ServiceSettings,
)

TASK: Final = Record(
    "a task",
    {
        "candidates": Field(_NODES, "The nodes that may own the task: names, or a selection.", required=True),
        "weights": Field(WEIGHTS, "Eq. 4.", required=True),
        "demand": Field(DEMAND, "What the task needs, before it was ever measured."),
        "scheduling": Field(SCHEDULING, "When a better candidate is worth a move."),
        "link": Field(LINK_LIMITS, "The limits of Eq. 3."),
        "worker": Field(WORKER, "The process that does the work."),
        "inputs": Field(ListOf(RULE), "Streams from the robots' applications to the owner's worker."),
        "outputs": Field(ListOf(RULE), "Streams from the owner's worker to the robots' applications."),
        "services": Field(ListOf(SERVICE), "Requests of the robots' applications that the owner's worker answers."),
        "ros2": Field(ros2_record(RULE, SERVICE), "The same three by ROS 2 names; they become rules like the others."),
        "on_isolation": Field(Choice.of(OnIsolation), "What a robot does that is cut off from the owner."),
        "exclusive": Field(
            Flag(),
            "The work must never run twice; needs `{epoch}` in every output's `from`. "
            "A task that has worked without it rests until all its candidates have answered by this file.",
        ),
        "drain_s": Field(Number(0, 600, "s"), "How long the old owner may finish what it has in work."),
    },
    TaskSpec,
)

TIMING: Final = Record(
    "a timing section",
    {
        "profile": Field(Choice(PROFILES), "The profile from which the others differ.", default="`wifi`"),
        "beat_s": Field(_SECONDS, "Period of the heartbeat."),
        "suspect_s": Field(_SECONDS, "Silence after which a peer is suspect."),
        "confirm_s": Field(_SECONDS, "How long a suspect may refute before it is gone."),
        "zenoh_lease_s": Field(_SECONDS, "zenoh's own lease."),
        "sample_s": Field(_SECONDS, "Period of the profilers."),
        "smoothing_s": Field(_SECONDS, "Time constant of CPU and memory, and of dBm where it is over 0.5 s."),
        "publish_s": Field(_SECONDS, "A profile at least so often."),
        "profile_ttl_s": Field(_SECONDS, "An older profile does not count."),
        "decide_s": Field(_SECONDS, "A robot's own round at least so often."),
        "gather_s": Field(_SECONDS, "Deadline for the peers' utilities."),
        "ballot_s": Field(_SECONDS, "Deadline of one prepare or accept phase."),
        "stagger_s": Field(Number(0, 10, "s"), "Wait per rank before a proposer starts."),
        "lease_s": Field(_SECONDS, "Exclusive tasks: how long an owner may work on the echoes of one beat."),
    },
    Timing,
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
        "electorate": Field(_NODES, "Who stores the allocations and agrees on them.", default="the robots"),
        "zenoh": Field(
            Record(
                "a zenoh section",
                {"config": Field(_FILE, "JSON5 file passed to zenoh untouched, relative to the fleet file.")},
            ),
            "Settings of zenoh itself.",
        ),
        "relay_orphan_s": Field(
            Number(0, 600, "s"), "How long a relay carries the streams on when its daemon is gone; 0: not at all."
        ),
        "shared_memory": Field(
            Choice.of(SharedMemory), "Large payloads within a machine; `auto`: where the node finds it fit."
        ),
    },
    Fleet,
)


def reference() -> str:
    """The reference of every key as Markdown: one table per section, sections in the order of the file.

    `docs/guide/fleet-file.md` holds it, and a test compares the two.
    """
    sections: dict[int, tuple[Record, list[str]]] = {}
    _collect(FLEET, "", sections)
    return "\n".join(_section(record, paths) for record, paths in sections.values())


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


def _section(record: Record, paths: list[str]) -> str:
    heading = ", ".join(f"`{path}`" for path in paths) if paths != [""] else "The file"
    rows = (
        f"| `{name}` | {item.block.says()} | {record.default_text(name)} | {item.doc} |"
        for name, item in record.items.items()
    )
    return "\n".join(
        (f"### {heading}\n", "| key | takes | default | meaning |", "| --- | --- | --- | --- |", *rows, "")
    )
