"""`zsched init`: creates a node's blank durable state, which states "this name has never voted here".

Knows: what a blank state holds, and which nodes to ask whether that is true. Does not know: how daemons use it.
"""

from __future__ import annotations

import secrets
from pathlib import Path

from zsched.core.electorate.recovery import NEW_DISK, Sides, new_member, rejoined
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import NodeId
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import Struct, replace
from zsched.core.vote.belief import MAX_GENERATION
from zsched.core.vote.generations import blank_state, objection
from zsched.host.clock import wall_tenths
from zsched.host.state_file import StateFile, hardware_id
from zsched.link.bus.fleet_poll import ask_fleet
from zsched.link.sessions.tls import asker_in, protocol_of, visits
from zsched.link.sessions.zenoh_file import operator_json5


class Heard(Struct, frozen=True, kw_only=True):
    """What the other nodes said: how many have an address in the fleet file, and who of them answered."""

    asked: int
    answers: tuple[Snapshot, ...]
    side: Sides | None = None
    """The generation that knows this node by a seat which it must not answer for: see `begin_anew`."""


_MOVE_AWAY = "if this machine is {node} and no other one is, move the file away, then again"


def init_state(fleet: Fleet, node: NodeId, folder: Path, generation: int) -> Path:
    """Write the blank state of ``node``; returns the file's path. Asks nobody: see `check_blank`.

    With a generation above 0 every task starts at revision and epoch ``generation * 2**32`` without an owner: for a
    fleet that lost too many states to agree, on every node.

    Raises:
        AdapterError: there is a state already, another node's for instance, or the folder cannot be written.
    """
    _check_range(generation)
    found = StateFile(folder, fleet=fleet.name, node=node).load()
    state = blank_state(
        fleet,
        node,
        generation,
        found.state,
        incarnation=wall_tenths(),
        hardware=hardware_id(),
        disk=secrets.token_hex(8),
    )
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        if generation == 0 and file.path.exists() and found.state is None:
            file.check_owner()
            raise AdapterError(f"{file.path} exists already ({found.problem}); {_MOVE_AWAY.format(node=node)}")
        file.create(state)
        return file.path


def begin_anew(fleet: Fleet, node: NodeId, folder: Path, side: Sides) -> Path:
    """Write the blank state of a node whose disk is lost, and whose name has a seat; returns the file's path.

    As another member it answers nobody until its old seat is given up and it is added anew.

    Raises:
        AdapterError: there is a state file already, or the folder cannot be written.
    """
    state = rejoined(
        fleet,
        node,
        None,
        side,
        disk=secrets.token_hex(8),
        incarnation=wall_tenths(),
        hardware=hardware_id(),
        why=NEW_DISK,
    )
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        if file.path.exists():
            raise AdapterError(f"{file.path} exists already, and is not usable here; {_MOVE_AWAY.format(node=node)}")
        file.create(state)
        return file.path


def _check_range(generation: int) -> None:
    if not 0 <= generation <= MAX_GENERATION:
        raise AdapterError(f"generation {generation}: at most {MAX_GENERATION}, or no revision could follow its first")


def standing_state(fleet: Fleet, node: NodeId, folder: Path) -> DurableState | None:
    """This node's valid state for this electorate; ``None`` when `init` has something to do.

    Raises:
        AdapterError: the folder is another node's or fleet's.
    """
    file = StateFile(folder, fleet=fleet.name, node=node)
    file.check_owner()
    state = file.load().state
    return state if state is not None and state.electorate == electorate_hash(fleet) else None


def check_blank(
    fleet: Fleet, node: NodeId, folder: Path, generation: int, standing: DurableState | None, *, is_forced: bool
) -> Heard:
    """Ask every node that has an address whether ``node`` may have a blank state of ``generation``.

    Args:
        fleet: the fleet file.
        node: whose state it would be.
        folder: where.
        generation: 0, or a new one.
        standing: what `standing_state` has found there.
        is_forced: the operator says that a new generation is needed.

    Raises:
        ConfigError: the operator's zenoh file is not usable.
        AdapterError: a daemon runs in that folder, or what is known speaks against it (`objection`).
    """
    _check_range(generation)
    if standing is not None and generation <= standing.generation:
        raise AdapterError(
            f"{folder} holds {node}'s state of generation {standing.generation}, which is newer than {generation}"
        )
    if _is_there(folder):
        with StateFile(folder, fleet=fleet.name, node=node):
            pass  # in use, or not to be written: said before anybody is asked
    heard = ask_others(fleet, node)
    side = None if standing is not None or is_forced else new_member(node, generation, heard.answers)
    if side is not None:
        return replace(heard, side=side)
    is_elector = node in fleet.electors
    good = standing if standing is not None and not standing.lost else None
    why = objection(node, generation, good, heard.answers, is_elector=is_elector, is_forced=is_forced)
    if why is not None:
        raise AdapterError(why)
    return heard


def _is_there(folder: Path) -> bool:
    try:
        return folder.exists()
    except OSError:  # who opens it says why it cannot be used
        return True


def ask_others(fleet: Fleet, node: NodeId) -> Heard:
    """Ask every other node that has an address for its status."""
    others = [spec for spec in fleet.nodes if spec.name != node and spec.listen_control]
    endpoints = tuple(spec.control_at for spec in others if spec.control_at)
    protocol_of(fleet, operator_json5(fleet))  # with TLS that cannot work nobody would answer
    answers = ask_fleet(fleet.name, asker_in(fleet, node), visits(fleet, endpoints))
    return Heard(asked=len(endpoints), answers=tuple(answer for answer in answers if answer.node != node))


def settle_dispute(fleet: Fleet, node: NodeId, folder: Path) -> bool:
    """The operator has removed the other machine of this name: let this one be an elector again.

    Returns:
        Whether there was anything to settle.

    Raises:
        AdapterError: no valid state, or it cannot be written.
    """
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        loaded = file.load()
        if loaded.state is None:
            raise AdapterError(f"nothing to settle: {loaded.problem}")
        if not loaded.state.disputed:
            return False
        file.save(replace(loaded.state, disputed=""))
        return True
