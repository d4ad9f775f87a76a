"""`zsched init` and `zsched fleet recover --generation|--settle`: a node's blank state, or the end of a dispute.

Knows: whom the others' answers let begin, in words. Does not know: states and sessions
(`zsched.commands.members.blank`), what an authority's folder holds (`zsched.commands.members.pki`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.common import CliError, check_dangers, counted, say, warn
from zsched.commands.base.here import own_name
from zsched.commands.base.options import Here
from zsched.commands.members.blank import Heard, begin_anew, check_blank, init_state, settle_dispute, standing_state
from zsched.commands.members.pki import known_here
from zsched.config.load import load_fleet, require_node
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_FAILED, EXIT_USAGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.core.vote.belief import MAX_GENERATION
from zsched.host import paths as places
from zsched.host.machine import core_speed
from zsched.host.state_file import STATE_NAME

_LOST: Final = (
    "if {name} was in {fleet} before and has lost its state, {file} may be older than {fleet} is now, and name fewer: "
    "then do not start it; take {state} away, bring here what `zsched fleet export` writes on another node, and give "
    "`zsched init` again"
)
"""Of a secured fleet, whose files `fleet create` and `join` wrote, together with a state."""
LOST_STATE: Final = "lost-state"
"""The danger: the fleet lives on elsewhere, and this machine becomes a fleet of one of the same name."""
DANGERS: Final = (LOST_STATE,)


class Place(Struct, frozen=True, kw_only=True):
    """Which node it is, and where its files are."""

    fleet: Fleet
    node: NodeId
    config: Path
    folder: Path


def place_of(here: Here) -> Place:
    """The node that the options mean, or the environment.

    Raises:
        CliError: --node names none of the fleet file.
        ConfigError: the fleet file cannot be used, or has no node of this machine's name.
    """
    file = places.config_path(here.config, os.environ)
    fleet = load_fleet(file)
    name = own_name(here.node)
    try:
        require_node(fleet, name, file)
    except ConfigError as error:
        if here.node is None:
            raise
        raise CliError(EXIT_USAGE, str(error)) from error  # a wrong word, and no wrong file
    return Place(fleet=fleet, node=name, config=file, folder=places.state_folder(here.state_dir, os.environ))


def create_state(
    place: Place,
    generation: int = 0,
    *,
    is_forced: bool = False,
    is_settling: bool = False,
    accepted: Sequence[str] = (),
) -> None:
    """Write the blank state of this machine's node, where nothing speaks against it.

    Args:
        place: the node, and where its state goes.
        generation: above 0 the fleet starts anew with it.
        is_forced: although nobody says that it is needed.
        is_settling: write none, but make the node an elector again whose name another machine had.
        accepted: names of dangers.

    Raises:
        CliError: the words do not go together; or the state seems to be lost.
        AdapterError: something speaks against it, or the folder cannot be written.
    """
    check_dangers(accepted, DANGERS)
    if generation > MAX_GENERATION:
        raise CliError(EXIT_USAGE, f"--generation {generation}: at most {MAX_GENERATION}")
    fleet, name, file, state = place.fleet, place.node, place.config, place.folder
    if is_settling:
        done = settle_dispute(fleet, name, state)
        say(f"{name}: {'settled; start its daemon' if done else 'there was no dispute'}")
        return
    if is_forced and not generation:
        raise CliError(EXIT_USAGE, "--force goes with --generation G")
    standing = standing_state(fleet, name, state)
    if standing is not None and generation in (0, standing.generation):
        text = f"{name} has its state in fleet {fleet.name}, generation {standing.generation}: nothing to do"
        say(f"{state}: {text}")
        return
    if not is_forced and LOST_STATE not in accepted:
        _check_not_lost(fleet, name, file, state)
    heard = check_blank(fleet, name, state, generation, standing, is_forced=is_forced)
    side = heard.side
    path = init_state(fleet, name, state, generation) if side is None else begin_anew(fleet, name, state, side)
    warn(_heard(heard, name, generation, is_elector=name in fleet.electors))
    if fleet.security is not None and not heard.answers:
        warn(_LOST.format(name=name, fleet=fleet.name, file=file, state=path))
    say(f"a core of this machine has speed {core_speed.kept_or_new(state):.2f}")
    if side is not None:
        is_known = name in side.electors
        why = "know it as an elector with another disk" if is_known else "go by an agreed document"
        text = f"the others {why}: it is a new member, and no elector until it is added as one"
        say(f"{path}: blank state of {name} in fleet {fleet.name}; {text}")
        return
    say(f"{path}: blank state of {name} in fleet {fleet.name}, generation {generation}")


def _check_not_lost(fleet: Fleet, name: str, file: Path, state: Path) -> None:
    """Refuse where nobody else is named who could be asked, and the authority here tells that there was a state.

    Raises:
        CliError: it was made together with one, or it has certified other nodes.
    """
    if any(node.name != name for node in fleet.nodes) or (state / STATE_NAME).exists():
        return
    known = known_here(fleet)
    if known is None:
        return
    others = f" and has certified {', '.join(known.others)}" if known.others else ""
    raise CliError(
        EXIT_FAILED,
        f"nothing was written: {file} names nobody but {name}, and {known.folder} is the authority of a fleet that had "
        f"its state{others}. If {name} has lost it, the file may be of the first day, and this would make a fleet of "
        f"one: bring what `zsched fleet export` writes on a living node as {file}, then `zsched init` again. Only if "
        f"no other node is left: --accept {LOST_STATE}",
    )


def _heard(heard: Heard, name: str, generation: int, *, is_elector: bool) -> str:
    """Which nodes were asked before a blank state was written, and what their answers say."""
    if not heard.asked:
        return "no other node has an address in the fleet file: nobody was asked"
    asked = f"asked {counted(heard.asked, 'other nodes')}"
    if not heard.answers:
        return f"{asked}: none answered" + (f", so nobody could say whether {name} has voted" if is_elector else "")
    said = f"{asked}, {len(heard.answers)} answered"
    where = f" in generation {generation}" if generation else ""
    return f"{said}: none remembers a vote of {name}{where}" if is_elector else said


def init(
    here: Here,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="DANGER", help="lost-state: its state is lost, and no other node is left."),
    ] = None,
) -> None:
    """Create this node's blank state: "this name has never voted here".

    Example: sudo zsched init --config /etc/zsched/fleet.yaml

    Refuses in another node's folder, and when a node that can be reached knows this name as an elector that has voted.
    A machine that has lost its state gets the fleet's document first: what `zsched fleet export` writes on a living
    node, as its fleet file. Where too many states are lost to agree, `zsched fleet recover --generation` begins anew.
    """
    create_state(place_of(here), accepted=accept or ())
