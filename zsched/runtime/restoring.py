"""What a daemon starts with from its state folder: its durable state in a new life, and the document in force.

Knows: when a state may be used by this fleet file, and how a new life is numbered. Does not know: what the state means.
"""

from __future__ import annotations

import logging
import secrets
from pathlib import Path

from zsched.core.electorate.numbers import in_force
from zsched.core.values.document import Flag
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError, ConfigError
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import NodeId
from zsched.core.values.startup import NoState
from zsched.core.values.struct import Struct, field, replace
from zsched.host.clock import wall_tenths
from zsched.host.state_file import LoadResult, StateFile
from zsched.runtime.library import Library

log = logging.getLogger("zsched.daemon")


class Restored(Struct, frozen=True, kw_only=True):
    """What the state folder gave."""

    incarnation: int
    """Of this start: above that of each start before that the folder tells of, also where there is no state."""
    state: DurableState | None = None
    """With this life's incarnation; ``None``: this node is no elector."""
    is_unsaved: bool = False
    """The disk refuses this life: by the state it is known what was agreed, and this node is no elector."""
    problem: str | None = None
    """Why there is no state, or why it is not saved."""
    no_state: NoState | None = None


def restore(state_file: StateFile, fleet: Fleet, *, config: Path, node: NodeId, state_dir: Path) -> Restored:
    """The durable state with this start's incarnation on disk, or why it is not there; both are logged.

    ``config``, ``node`` and ``state_dir`` are named in the advice.
    """
    loaded = state_file.load()
    incarnation = _next_life(state_file, loaded)
    if loaded.state is None:
        command = f"zsched init --config {config} --node {node} --state-dir {state_dir}"
        advice = "" if loaded.no_state is NoState.ANOTHER_NODE else f" (here: `{command}`)"
        log.warning("no_state why=%s%s; no elector", loaded.problem, advice)
        return Restored(incarnation=incarnation, problem=loaded.problem, no_state=loaded.no_state)
    if loaded.state.electorate != electorate_hash(fleet) and not _is_agreed(loaded.state):
        generation = loaded.state.generation + 1
        why = (
            "the fleet file names another electorate than the state file, which is whole and stays; this node is "
            f"no elector. If the file is right, give it to all, stop all, `zsched fleet recover --generation "
            f"{generation} --force` on each, and start all"
        )
        log.warning("other_electorate %s", why)
        return Restored(incarnation=incarnation, problem=why, no_state=NoState.ANOTHER_ELECTORATE)
    state = replace(loaded.state, incarnation=incarnation, disk=loaded.state.disk or secrets.token_hex(8))
    try:
        state_file.save(state)
    except AdapterError as error:
        log.warning("state not saved why=%s; no elector", error)
        return Restored(incarnation=incarnation, state=state, is_unsaved=True, problem=str(error))
    return Restored(incarnation=incarnation, state=state)


def _next_life(state_file: StateFile, loaded: LoadResult) -> int:
    """This start's incarnation, noted beside the state.

    A node without a state needs it, too: others refuse what it signs in a lower life than one that they have heard, and
    a robot without a battery-backed clock starts in the past. Not just one more than the last one: a folder that was
    brought back from a backup must not live one of its lives again.
    """
    if loaded.no_state is NoState.ANOTHER_NODE:  # its lives are not ours to count
        return wall_tenths()
    last = max(state_file.last_life(), 0 if loaded.state is None else loaded.state.incarnation)
    incarnation = max(last + 1, wall_tenths())
    try:
        state_file.note_life(incarnation)
    except AdapterError as error:
        log.warning("life not noted why=%s", error)
    return incarnation


class Stored(Struct):
    """The documents that a state names, as far as they are stored here and can be used."""

    fleets: dict[str, Fleet] = field(default_factory=dict)
    """{hash: what it says}."""
    flags: dict[str, tuple[Flag, ...]] = field(default_factory=dict)
    """{hash: its flags}."""
    fleet: Fleet | None = None
    """By the agreed document; ``None``: the fleet file holds."""


def read_stored(library: Library, state: DurableState | None) -> Stored:
    """The documents that ``state`` names, and the fleet by the one that is agreed; ``library`` keeps them."""
    stored = Stored()
    register = None if state is None else state.fleet_register
    value = None if register is None else register.learnt
    if register is None or value is None:
        return stored
    accepted = "" if register.accepted is None else register.accepted.value.document
    named = tuple(filter(None, (value.document, accepted)))
    library.keep(named)
    for document in named:
        content = library.store.load(document)
        if content is None:
            continue
        try:
            stored.fleets[document], stored.flags[document] = library.read(content), content.flags
        except ConfigError as error:
            log.warning("document unusable document=%s why=%s", document, error)
    fleet = stored.fleets.get(value.document)
    if fleet is not None:
        stored.fleet = in_force(fleet, value)
        log.info("document in force revision=%d document=%s", value.revision, value.document)
    return stored


def _is_agreed(state: DurableState) -> bool:
    """Whether a fleet value names the electors, and no longer the file."""
    value = None if state.fleet_register is None else state.fleet_register.learnt
    return value is not None and not value.electorate.is_founding
