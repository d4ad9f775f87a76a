"""Makes of an operator's fleet file one whose nodes all run on this machine.

Names, kinds, labels, candidates, streams and timing stay. Addresses are loopback, and radio links count as perfect.
A local side listens itself, in place of the machine's router. What belongs to the real machines goes: certificates,
shared memory.

Knows: which keys of a fleet file belong to a machine. Does not know: processes, ports, what a task does.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from zsched.config import reader
from zsched.config.load import check_bytes
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct
from zsched.host.files import read_regular

PLAIN: Final = re.compile(r"[A-Za-z0-9_.+][A-Za-z0-9_.+-]*|-[0-9.][0-9A-Za-z_.+-]*")
"""Scalars without quotes that mean the same inside of brackets."""
KEPT: Final = ("kind", "labels", "fixed")
"""Of a node: what is not its machine's."""
NOWHERE: Final = reader.NOWHERE


class Addresses(Struct, frozen=True, kw_only=True):
    """Where one node listens while its fleet runs here: zenoh endpoints on loopback."""

    control: str
    data: str
    local: str = ""
    """Of a node whose applications have a network of their own: where they join it."""

    @property
    def joins(self) -> str:
        """Where the node's applications join."""
        return self.local or self.data


class LoopbackFile(Struct, frozen=True, kw_only=True):
    """A fleet file for this machine."""

    text: str
    left_out: tuple[str, ...]
    """What of the operator's file does not hold here, in words."""


def on_loopback(
    file: Path, addresses: Mapping[NodeId, Addresses], commands: Mapping[TaskId, Sequence[str]]
) -> LoopbackFile:
    """The fleet of ``file``, which has no fault, with ``addresses`` for nodes and other ``commands`` for some tasks.

    Raises:
        ConfigError: it cannot be run on one machine.
    """
    root = _root(file)
    left_out = [*_left_out(root)]
    nodes = _entry(root, "nodes")
    tasks = _entry(root, "tasks")
    assert isinstance(nodes, reader.Mapping)
    new_nodes = _changed(nodes, {name: _node_here(_entry(nodes, name), one) for name, one in addresses.items()})
    changes: dict[str, reader.Node] = {"nodes": new_nodes, "shared_memory": _node("off")}
    if commands:
        assert isinstance(tasks, reader.Mapping)
        new = {task: _with_command(_entry(tasks, task), command) for task, command in commands.items()}
        changes["tasks"] = _changed(tasks, new)
    text = _text(_changed(_without(root, ("security", "zenoh")), changes))
    result = check_bytes(text.encode(), str(file))
    if result.fleet is None:
        told = "; ".join(f"{fault.message}; {fault.hint}" for fault in result.faults)
        raise ConfigError(f"{file}: it cannot be run on one machine: {told}")
    return LoopbackFile(text=text, left_out=tuple(left_out))


def _root(file: Path) -> reader.Mapping:
    try:
        root, _ = reader.read_yaml(read_regular(file, reader.MAX_FILE_BYTES))
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    if not isinstance(root, reader.Mapping):
        raise ConfigError(f"{file}: it changed while it was read; try again")
    return root


def _left_out(root: reader.Mapping) -> list[str]:
    nodes = _entry(root, "nodes")
    assert isinstance(nodes, reader.Mapping)
    having: dict[str, list[str]] = {}
    for name, node in nodes.pairs:
        for key, _ in node.pairs if isinstance(node, reader.Mapping) else ():
            having.setdefault(key.text, []).append(name.text)
    found = []
    if links := sorted({name for key in ("wifi", "trace", "links") for name in having.get(key, ())}):
        found.append(f"radio links count as perfect ({', '.join(links)})")
    if local := having.get("local"):
        found.append(f"local sides listen themselves, with no router beside them ({', '.join(local)})")
    if _entry(root, "zenoh") is not None:
        found.append("no settings of zenoh's own (`zenoh:`), so no certificates")
    if _entry(root, "security") is not None:
        found.append("no certificates (`security:`): whoever is on this machine is let in")
    return found


def _node_here(given: reader.Node | None, addresses: Addresses) -> reader.Mapping:
    assert isinstance(given, reader.Mapping)
    kept = tuple((key, value) for key, value in given.pairs if key.text in KEPT)
    host = Endpoint.of(addresses.data).host
    listen = {"control": addresses.control, "data": addresses.data}
    new: dict[str, Any] = {"host": host, "listen": listen}
    if addresses.local:
        new["local"] = {"mode": "peer", "listen": [addresses.local]}
    if not any(key.text == "fixed" for key, _ in kept):
        new["wired"] = True
    own = _node(new)
    assert isinstance(own, reader.Mapping)
    return reader.Mapping(pairs=(*kept, *own.pairs), place=NOWHERE)


def _with_command(task: reader.Node | None, command: Sequence[str]) -> reader.Node:
    assert isinstance(task, reader.Mapping)
    worker = _entry(task, "worker")
    base = worker if isinstance(worker, reader.Mapping) else reader.Mapping(pairs=(), place=NOWHERE)
    return _changed(task, {"worker": _changed(base, {"command": _node(list(command))})})


# --- trees -----------------------------------------------------------------------------------------------------------


def _entry(mapping: reader.Node | None, name: str) -> reader.Node | None:
    pairs = mapping.pairs if isinstance(mapping, reader.Mapping) else ()
    return next((value for key, value in pairs if key.text == name), None)


def _without(mapping: reader.Mapping, names: Sequence[str]) -> reader.Mapping:
    return reader.Mapping(pairs=tuple(pair for pair in mapping.pairs if pair[0].text not in names), place=mapping.place)


def _changed(mapping: reader.Mapping, new: Mapping[str, reader.Node]) -> reader.Mapping:
    """The mapping with some values replaced, in their places, or added at its end."""
    there = {key.text for key, _ in mapping.pairs}
    pairs = [(key, new.get(key.text, value)) for key, value in mapping.pairs]
    pairs += [(_key(name), value) for name, value in new.items() if name not in there]
    return reader.Mapping(pairs=tuple(pairs), place=mapping.place)


def _key(name: str) -> reader.Scalar:
    return reader.Scalar(text=name, is_plain=False, place=NOWHERE)


def _node(value: Any) -> reader.Node:
    if isinstance(value, dict):
        return reader.Mapping(pairs=tuple((_key(name), _node(held)) for name, held in value.items()), place=NOWHERE)
    if isinstance(value, list):
        return reader.Sequence(items=tuple(map(_node, value)), place=NOWHERE)
    if isinstance(value, bool):
        return reader.Scalar(text=str(value).lower(), is_plain=True, place=NOWHERE)
    return reader.Scalar(text=value, is_plain=False, place=NOWHERE)


def _text(node: reader.Node) -> str:
    """The tree as YAML in brackets; numbers and booleans as they were written, all other scalars in quotes."""
    if isinstance(node, reader.Mapping):
        return "{" + ", ".join(f"{_quoted(key.text)}: {_text(value)}" for key, value in node.pairs) + "}"
    if isinstance(node, reader.Sequence):
        return "[" + ", ".join(map(_text, node.items)) + "]"
    if node.is_null:
        return "null"
    return node.text if node.is_plain and PLAIN.fullmatch(node.text) else _quoted(node.text)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
