"""Gathers what the checks look at: the fleet file, the own daemon's status, and with ``--fleet`` every node's.

Knows: the operator socket, sessions of a moment to nodes with an address. Does not know: what the answers mean.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from zsched.commands.base.places import Machine
from zsched.config.difference import unseated, warnings_in_force
from zsched.config.load import CheckResult, check_bytes, check_file
from zsched.core.electorate.numbers import in_force
from zsched.core.values.codec import from_plain
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import AdapterError, ConfigError, WireError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.report import snapshot_json
from zsched.core.values.struct import Struct, replace
from zsched.host import paths as places
from zsched.host.clock import monotonic_s
from zsched.host.document_store import DocumentStore
from zsched.host.operator_client import ask
from zsched.host.state_file import StateFile
from zsched.link.bus.fleet_poll import ask_fleet
from zsched.link.pipe.relay_socket import ask_relay
from zsched.link.sessions.tls import asker_in, visits
from zsched.link.sessions.zenoh_file import judged
from zsched.tools.doctor.fleet import differs
from zsched.tools.doctor.model import Json, Scene

ASK_S: Final = 5.0
AT_ONCE: Final = 8
"""Nodes asked at a time; the socket has 16 places."""
TRIES: Final = 3
"""A slow answer is asked for again this many times: the shortest counts."""
AGAIN_S: Final = 1.0
"""A move that was under way is over by then."""


class _Asked(Struct, frozen=True, kw_only=True):
    """What the nodes answered, and how long those took that were asked through the daemon here."""

    statuses: Mapping[NodeId, Json]
    answered_s: Mapping[NodeId, float]


def look(machine: Machine, *, is_fleet: bool) -> Scene:
    """Everything that the checks need; blocks for some seconds when nodes are silent."""
    reading = judged(check_file(machine.file))
    socket, node = places.socket_path(machine.runtime_folder, machine.node), machine.node
    own, refusal = _own(socket)
    door = None if own is None else socket
    document, text, revision, without_seat = _agreed(machine, reading.fleet, door)
    known = reading.fleet if document is None else document.fleet
    asked = _Asked(statuses={}, answered_s={})
    if is_fleet:
        asked = _all(known, node, door)
        if differs(asked.statuses):
            threading.Event().wait(AGAIN_S)
            asked = _all(known, node, door)
    return Scene(
        file=machine.file,
        reading=reading,
        document=document,
        text=text,
        revision=revision,
        unseated=without_seat,
        node=node,
        relay_version=_relay_version(machine.runtime_folder, node),
        state_folder=machine.state_folder,
        own=own,
        refusal=refusal,
        is_fleet=is_fleet,
        statuses=asked.statuses,
        answered_s=asked.answered_s,
        sides={} if door is None else _sides(door, node),
    )


def _agreed(
    machine: Machine, by_file: Fleet | None, door: Path | None
) -> tuple[CheckResult | None, str, int, tuple[NodeId, ...]]:
    """(what the agreed document says with the electors in force, its text, its revision, electors that are none).

    From daemon or disk.

    Without the first: no document is agreed, or none that can be read here.
    """
    held = _by_disk(machine, by_file) if door is None else _by_daemon(door)
    if held is None:
        return None, "", 0, ()
    text, value = held
    result = check_bytes(text.encode("utf-8", "replace"), str(machine.file.parent / "the fleet's document"))
    if result.fleet is None:
        return None, text, value.revision, ()
    warnings = warnings_in_force(text, result.warnings)
    agreed = replace(result, fleet=in_force(result.fleet, value), warnings=warnings)
    return agreed, text, value.revision, unseated(text, result.fleet, value.electorate.names)


def _by_daemon(door: Path) -> tuple[str, FleetValue] | None:
    try:
        told = ask(door, {"verb": "fleet"}, ASK_S)
        if not told.get("text") or not told.get("value"):
            return None
        return str(told["text"]), from_plain(told["value"], FleetValue)
    except (AdapterError, WireError):
        return None


def _by_disk(machine: Machine, by_file: Fleet | None) -> tuple[str, FleetValue] | None:
    if by_file is None:
        return None
    state = StateFile(machine.state_folder, fleet=by_file.name, node=machine.node).load().state
    register = None if state is None else state.fleet_register
    value = None if register is None else register.learnt
    content = None if value is None else DocumentStore(machine.state_folder).load(value.document)
    return None if value is None or content is None else (content.text, value)


def _sides(door: Path, node: NodeId) -> Mapping[str, str]:
    """How to join the data network here; empty: the daemon does not tell."""
    try:
        answer = ask(door, {"verb": "access", "node": node}, ASK_S)
    except AdapterError:
        return {}
    found: dict[str, str] = answer.get("sides", {})
    return found


def _relay_version(folder: Path, node: NodeId) -> str:
    """By its own word."""
    here = ask_relay(places.relay_path(folder, node))
    return "" if here is None else here.version


def _own(door: Path) -> tuple[Json | None, str]:
    """(the status of the daemon here, or why there is none)."""
    try:
        status = ask(door, {"verb": "status"}, ASK_S)
    except AdapterError as error:
        if isinstance(error.__cause__, PermissionError):
            return None, f"permission denied at {door}: run the doctor as root"
        return None, str(error)
    return (status, "") if "error" not in status else (None, str(status["error"]))


def _all(fleet: Fleet | None, asker: NodeId, door: Path | None) -> _Asked:
    """Every node's status: through the daemon here, and of those that do not answer by their own address."""
    statuses: dict[NodeId, Json] = {}
    took: dict[NodeId, float] = {}
    if fleet is None:
        return _Asked(statuses=statuses, answered_s=took)
    names = [spec.name for spec in fleet.nodes]
    if door is not None:
        with ThreadPoolExecutor(max_workers=AT_ONCE) as pool:
            for name, (status, seconds) in zip(names, pool.map(lambda name: _through(door, name), names), strict=True):
                if status is not None:
                    statuses[name] = status
                    took |= {name: seconds} if name != asker else {}
        for name in [name for name, seconds in took.items() if seconds > fleet.timing.gather_s]:
            # asked together they wait for one another
            again = [_through(door, name) for _ in range(TRIES)]
            took[name] = min([took[name], *(seconds for status, seconds in again if status is not None)])
    for status in _directly(fleet, asker, [name for name in names if name not in statuses]):
        statuses.setdefault(str(status["node"]), status)
    return _Asked(statuses=statuses, answered_s=took)


def _through(door: Path, node: NodeId) -> tuple[Json | None, float]:
    began = monotonic_s()
    try:
        answer = ask(door, {"verb": "status", "node": node}, ASK_S)
    except AdapterError:
        return None, 0.0
    return (None if "error" in answer else answer), monotonic_s() - began


def _directly(fleet: Fleet, asker: NodeId, missing: list[NodeId]) -> list[Json]:
    endpoints = [spec.control_at for spec in fleet.nodes if spec.name in missing and spec.control_at]
    try:
        configs, asker = visits(fleet, endpoints), asker_in(fleet, asker)
    except (ConfigError, ValueError):
        return []  # a check of its own says what is wrong with that file
    return [snapshot_json(answer) for answer in ask_fleet(fleet.name, asker, configs)]
