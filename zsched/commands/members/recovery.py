"""`zsched fleet recover`, also with --rejoin: read the states that are there, ask the others, write the new state.

Knows: state files and documents on disk, which nodes to ask. Does not know: what speaks against it
(`zsched.core.electorate.recovery`), how it is shown and confirmed.

Both work on a node whose daemon is stopped. The daemon that starts by the new state is one that has just started:
so a start does what ballots, leases and workers need.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from pathlib import Path

from zsched.commands.members.blank import ask_others
from zsched.config.document import read_document
from zsched.core.electorate.founding import newest_fleet
from zsched.core.electorate.recovery import Found, Recovery, Sides, choose_side, rejoined, sides_of
from zsched.core.values.codec import decode_state, document_hash
from zsched.core.values.document import Document, Text
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError, ConfigError, WireError
from zsched.core.values.fleet import Fleet
from zsched.core.values.instructions import RecordStory
from zsched.core.values.model import NodeId
from zsched.host import decision_log
from zsched.host.clock import wall_tenths
from zsched.host.document_store import DocumentStore
from zsched.host.files import read_regular
from zsched.host.state_file import MAX_STATE_BYTES, StateFile, hardware_id


def look(fleet: Fleet, node: NodeId, config: Path, folder: Path, brought: Sequence[Path]) -> Found:
    """Read this node's state and those that were brought, with the documents beside them, and ask the other nodes.

    Args:
        fleet: the fleet file.
        node: this node.
        config: the fleet file's path.
        folder: this node's state folder.
        brought: state files of other machines' disks.

    Raises:
        AdapterError: a daemon runs in that folder, it is another node's, or a state that was brought cannot be read.
        ConfigError: the operator's zenoh file is not usable.
    """
    own = _own_state(fleet, node, folder)
    others = tuple(map(read_state, brought))
    states = (() if own is None else (own,)) + others
    stores = [DocumentStore(folder), *(DocumentStore(path.parent) for path in brought)]
    documents = {}
    for name in sorted({name for state in states for name in _named(state)}):
        content = next((found for store in stores if (found := store.load(name)) is not None), None)
        read = None if content is None else _read(content, fleet.name, node, config)
        if read is not None:
            documents[name] = read
    newest = newest_fleet([one.fleet_register for one in states if one.fleet_register is not None])
    known = fleet if newest is None else documents.get(newest.document, fleet)
    return Found(
        fleet=fleet,
        me=node,
        own=own,
        others=others,
        answers=ask_others(known, node).answers,
        documents=documents,
        file_hash=document_hash(_document_of(config)),
    )


def _named(state: DurableState) -> tuple[str, ...]:
    """The documents that a state names."""
    register = state.fleet_register
    held = () if register is None else (register.learnt, None if register.accepted is None else register.accepted.value)
    return tuple(value.document for value in held if value is not None and value.document)


def _read(content: Document, fleet: str, node: NodeId, config: Path) -> Fleet | None:
    try:
        return read_document(content, fleet, node, config)
    except ConfigError:
        return None  # as if it were not there: the operator hears so


def _document_of(config: Path) -> Document:
    try:
        return Document(text=Text(config.read_text("utf-8")))
    except (OSError, ValueError) as error:
        raise AdapterError(f"{config} cannot be a document: {error}") from error


def note(folder: Path, node: NodeId, state: DurableState, text: str, by: str) -> str:
    """Tell the decision log of this folder what an operator has done; why that failed, empty: it did not."""
    try:
        decision_log.note(folder, node, state.incarnation, RecordStory(stage="membership", text=text, by=by))
    except OSError as error:
        return f"the decision log in {folder} does not tell of it: {error.strerror}"
    return ""


def read_state(path: Path) -> DurableState:
    """A state file from another machine's disk.

    Raises:
        AdapterError: it cannot be read, or is damaged.
    """
    try:
        return decode_state(read_regular(path, MAX_STATE_BYTES))
    except OSError as error:
        raise AdapterError(
            f"{path} cannot be read: {error.strerror}; give the file `state` of a state folder"
        ) from error
    except WireError as error:
        raise AdapterError(f"{path} is damaged, or no state file: {error}; leave it out") from error


def recover(recovery: Recovery, config: Path, folder: Path, brought: Sequence[Path]) -> DurableState:
    """Write the document, then the state of the new generation; the state.

    Raises:
        AdapterError: the disk is full or read-only, or a daemon was started meanwhile, though it may have ended since;
            the old state is whole.
    """
    found = recovery.found
    state = recovery.carry_out(
        generation_id=secrets.token_hex(16),
        disk=secrets.token_hex(8),
        incarnation=wall_tenths(),
        hardware=hardware_id(),
    )
    with StateFile(folder, fleet=found.fleet.name, node=found.me) as file:
        _check_unchanged(file, found.own)
        store = DocumentStore(folder)
        if recovery.agreed is not None:
            store.save(_document_of(config))
        elif store.load(recovery.before.document) is None:
            store.save(_brought(recovery.before.document, brought))
        file.save(state)
    return state


def _check_unchanged(file: StateFile, looked_at: DurableState | None) -> None:
    """Refuse to take the place of another state than the one that was looked at: it may know more, or have voted.

    Raises:
        AdapterError: a daemon has run here since.
    """
    if file.load().state != looked_at:
        raise AdapterError(f"{file.path}: nothing was changed, a daemon has run here meanwhile; give the command again")


def _brought(document: str, brought: Sequence[Path]) -> Document:
    """A document that lies beside a state that was brought."""
    stores = (DocumentStore(path.parent) for path in brought)
    return next(content for store in stores if (content := store.load(document)) is not None)


def _own_state(fleet: Fleet, node: NodeId, folder: Path) -> DurableState | None:
    file = StateFile(folder, fleet=fleet.name, node=node)
    with file:  # a running daemon holds it: said before anybody is asked
        file.check_owner()
        return file.load().state


def find_side(fleet: Fleet, node: NodeId, folder: Path, wanted: str) -> tuple[DurableState | None, Sides | str]:
    """(this node's state, the generation that it changes to or why there is none).

    Raises:
        AdapterError: a daemon runs in that folder, or it is another node's.
        ConfigError: the operator's zenoh file is not usable.
    """
    own = _own_state(fleet, node, folder)
    return own, choose_side(fleet, own, sides_of(ask_others(fleet, node).answers), wanted)


def rejoin(
    fleet: Fleet, node: NodeId, folder: Path, own: DurableState | None, side: Sides
) -> tuple[Path, DurableState]:
    """Write the blank state of a node that changes sides; the file's path, and the state.

    Raises:
        AdapterError: the disk is full or read-only, or a daemon was started meanwhile; the old state is whole.
    """
    state = rejoined(
        fleet,
        node,
        own,
        side,
        disk=secrets.token_hex(8),
        incarnation=wall_tenths(),
        hardware=hardware_id(),
    )
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        _check_unchanged(file, own)
        file.save(state)
        return file.path, state
