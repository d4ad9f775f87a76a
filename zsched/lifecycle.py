"""`zsched init`: creates a node's blank durable state, which states "this name has never voted here".

Knows: what a blank state holds, and whom to ask whether that is true. Does not know: how daemons use it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from zsched import zenoh_config
from zsched.adapters.control_bus import ask_fleet
from zsched.adapters.state_file import StateFile, hardware_id
from zsched.clock import wall_tenths
from zsched.core.belief import MAX_GENERATION
from zsched.core.fleet import Fleet, dial_endpoint, electorate_hash
from zsched.core.generations import first_registers
from zsched.core.model import DurableState, NodeId
from zsched.daemon_tls import operator_json5, protocol_of
from zsched.errors import AdapterError


def init_state(fleet: Fleet, node: NodeId, folder: Path, generation: int) -> Path:
    """Write the blank state of ``node``; returns the file's path.

    With a generation above 0 every task starts at revision and epoch ``generation * 2**32`` without an owner: for a
    fleet that lost too many states to agree, on every node at once.

    Raises:
        AdapterError: there is a state already, another node's for instance, or the folder cannot be written.
    """
    if not 0 <= generation <= MAX_GENERATION:
        raise AdapterError(f"generation {generation}: at most {MAX_GENERATION}, or no revision could follow its first")
    before = StateFile(folder, fleet=fleet.name, node=node).load().state
    registers = first_registers(fleet, generation, () if before is None else before.registers)
    state = DurableState(
        fleet=fleet.name,
        node=node,
        incarnation=wall_tenths(),
        generation=generation,
        hardware=hardware_id(),
        electorate=electorate_hash(fleet),
        registers=registers,
    )
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        file.create(state)
        return file.path


def standing_generation(fleet: Fleet, node: NodeId, folder: Path) -> int | None:
    """The generation of this node's valid state for this electorate; ``None`` when `init` has something to do."""
    state = StateFile(folder, fleet=fleet.name, node=node).load().state
    return state.generation if state is not None and state.electorate == electorate_hash(fleet) else None


def check_never_voted(fleet: Fleet, node: NodeId) -> int:
    """Ask every node that can be reached whether ``node`` is known as an elector that has voted.

    Returns:
        How many nodes answered; 0 when none could be reached (then nothing is known).

    Raises:
        ConfigError: the operator's zenoh file is not usable.
        AdapterError: somebody remembers its votes: a blank state would make it break its promises.
    """
    others = [spec for spec in fleet.nodes if spec.name != node and spec.listen_control]
    endpoints = tuple(filter(None, (dial_endpoint(spec.listen_control, spec.host) for spec in others)))
    if not endpoints or node not in fleet.electors:
        return 0
    text = operator_json5(fleet)
    protocol_of(fleet, text)  # with TLS that cannot work nobody would answer
    config = zenoh_config.client_config(connect=endpoints, timing=fleet.timing, operator_json5=text)
    answers = ask_fleet(fleet.name, node, config)
    for answer in answers:
        if node in answer.quorum.voted and answer.node != node:
            raise AdapterError(
                f"{answer.node} knows {node} as an elector that has voted; a blank state would let it vote twice. "
                "Start a new generation on every node with `zsched init --generation G`"
            )
    return len(answers)


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
