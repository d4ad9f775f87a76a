"""`zsched fleet recover`, also with --rejoin: show what would become of the fleet, ask, and do it.

Knows: tables, dangers that are accepted by name, what comes next. Does not know: what speaks against it
(`zsched.core.electorate.recovery`), files and sessions (`zsched.commands.members.recovery`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.base.ask import Door
from zsched.commands.base.change import OrderView, Plan, consent, user_name
from zsched.commands.base.common import CliError, check_dangers, say, warn
from zsched.commands.base.options import AcceptOption, Here, PlanOption, YesOption
from zsched.commands.members import recovery as runtime
from zsched.commands.members.init import Place, create_state, place_of
from zsched.core.electorate.recovery import Danger, Recovery, consider
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import SAID_DIGITS, FleetValue
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.model import RegisterState
from zsched.core.values.words import MAX_ASKER, shown

DANGERS = tuple(danger.value for danger in Danger)


def begin_generation(place: Place, view: OrderView, brought: Sequence[Path]) -> int:
    """Make this node the only elector of a new generation; the exit code.

    Raises:
        CliError: something speaks against it, a danger is not accepted, or the operator says no.
        AdapterError: a daemon runs here, or a state cannot be read or written.
    """
    check_dangers(view.accepted, DANGERS)
    plan = consider(runtime.look(place.fleet, place.node, place.config, place.folder, brought))
    if isinstance(plan, str):
        raise CliError(EXIT_FAILED, f"nothing was changed: {plan}")
    draft = plan.carry_out(generation_id="0", disk="", incarnation=0, hardware="")
    shown = Plan(
        text=_table(plan, draft),
        body={},
        dangers=[(danger.value, means) for danger, means in plan.dangers],
        question=f"Make {place.node} the only elector of a new generation of {place.fleet.name}?",
    )
    code = consent(view, shown)
    if code is not None:
        return code
    state = runtime.recover(plan, place.config, place.folder, brought)
    before, after = plan.before, _value_of(state)
    _note(
        place,
        state,
        f"recovered {after.fleet}: generation {before.generation_id[:SAID_DIGITS]} -> "
        f"{after.generation_id[:SAID_DIGITS]}, electors {', '.join(before.electorate.names)} -> {place.node}",
    )
    say(_next(plan, after))
    return EXIT_OK


def rejoin_side(place: Place, view: OrderView, wanted: str) -> int:
    """Let this node change sides to another generation; the exit code.

    Raises:
        CliError: there is no such generation, or the operator says no.
        AdapterError: a daemon runs here, or its state cannot be written.
    """
    own, side = runtime.find_side(place.fleet, place.node, place.folder, wanted)
    if isinstance(side, str):
        raise CliError(EXIT_FAILED, f"nothing was changed: {side}")
    by = f", recovered by {side.recovered_by}" if side.recovered_by else ""
    told = f"generation {side.generation_id[:SAID_DIGITS]}{by} ({', '.join(side.nodes)} count by it)"
    what = f"follows {told}, and starts blank there; what it knew of its own generation is dropped"
    code = consent(view, Plan(text=f"{place.node}: {what}", body={}, question=f"Let {place.node} change sides?"))
    if code is not None:
        return code
    path, state = runtime.rejoin(place.fleet, place.node, place.folder, own, side)
    _note(place, state, f"rejoined generation {side.generation_id[:SAID_DIGITS]}{by}")
    say(f"{path}: blank state of {place.node}, which is to follow {side.generation_id[:SAID_DIGITS]}")
    say("next: start this daemon; it fetches the rest, and is no elector until it is added as one")
    return EXIT_OK


def _note(place: Place, state: DurableState, what: str) -> None:
    """`zsched history` on this node tells of it."""
    by = f"{user_name()}@{place.node}"[:MAX_ASKER]
    if trouble := runtime.note(place.folder, place.node, state, f"{by}: {what}", by):
        warn(trouble)


def _value_of(state: DurableState) -> FleetValue:
    assert state.fleet_register is not None
    assert state.fleet_register.learnt is not None
    return state.fleet_register.learnt


def _table(plan: Recovery, draft: DurableState) -> str:
    """What changes: before -> after."""
    before, after = plan.before, _value_of(draft)
    by = f" (recovered by {before.recovered_by})" if before.recovered_by else ""
    rows = [
        ("generation", f"{before.generation_id[:SAID_DIGITS]}{by}", f"a new one, recovered by {after.recovered_by}"),
        ("number", str(before.number), str(after.number)),
        ("electors", ", ".join(before.electorate.names), ", ".join(after.electorate.names)),
    ]
    if before.document != after.document:
        old = before.document[:SAID_DIGITS] or "each node by its own file"
        rows.append(("document", old, f"this machine's file, {after.document[:SAID_DIGITS]}"))
    held = {state.task: state for state in draft.registers}
    olds = _epochs(plan)
    rows += [(f"task {one.task}", olds.get(one.task, "no value"), _begins(held.get(one.task))) for one in after.tasks]
    wide = max(len(what) for what, _, _ in rows)
    return "\n".join([f"{after.fleet}:", *(f"  {what:{wide}}  {old} -> {new}" for what, old, new in rows)])


def _epochs(plan: Recovery) -> dict[str, str]:
    """{task: its newest value among the states that were given}; whose it is tells what may be lost."""
    found: dict[str, tuple[int, str]] = {}
    for state in plan.found.states:
        for register in state.registers:
            held = None if register.accepted is None else register.accepted.value
            for value in (held, register.learnt):
                if value is not None and value.revision >= found.get(register.task, (0, ""))[0]:
                    told = f"{value.owner or 'nobody'}, epoch {shown(value.epoch)} (state of {state.node})"
                    found[register.task] = value.revision, told
    return {task: told for task, (_, told) in found.items()}


def _begins(state: RegisterState | None) -> str:
    return (state and state.learnt and state.learnt.owner) or "nobody"


def _next(plan: Recovery, value: FleetValue) -> str:
    """What the operator does now."""
    named = value.generation_id[:SAID_DIGITS]
    others = [node.name for node in plan.document.nodes if node.name != value.recovered_by]
    lines = [f"{value.recovered_by} is the only elector of generation {named}", "next: start this daemon"]
    if others:
        lines.append(
            f"then on each of {', '.join(others)}: stop zsched, `zsched fleet recover --rejoin {named}`, start it"
        )
        lines.append("for each of them that is lost for good: `zsched node forget NODE` here")
    if plan.document.is_auto:
        lines.append("electors are added by themselves once those nodes are back (`zsched fleet show`)")
    elif others:
        lines.append(
            "its document names the electors: when they are back, `zsched apply` the fleet file adds them, "
            "`electorate: auto` in it lets them be added by themselves"
        )
    return "\n".join(lines)


def recover_fleet(
    here: Here,
    wanted: Annotated[
        str, typer.Argument(metavar="[GENERATION]", help="With --rejoin: how its id begins, where there are several.")
    ] = "",
    brought: Annotated[
        list[Path] | None,
        typer.Option("--from", metavar="STATE_FILE", help="State of a dead machine's disk; give it once for each."),
    ] = None,
    rejoin: Annotated[
        bool, typer.Option("--rejoin", help="Change sides to another generation, and start blank.")
    ] = False,
    generation: Annotated[
        int, typer.Option("--generation", metavar="G", min=0, help="No state is left to go on with: start anew as G.")
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="With --generation: although nobody says that it is needed.")
    ] = False,
    settle: Annotated[
        bool, typer.Option("--settle", help="The other machine of this name is gone: be an elector again.")
    ] = False,
    plan: PlanOption = False,
    yes: YesOption = False,
    accept: AcceptOption = None,
) -> int:
    """Begin a new generation on one survivor when a majority of the electors is lost for good.

    Example: sudo zsched fleet recover

    Tasks keep their newest values of all states that are given, under higher epochs. Its daemon must be stopped. It is
    refused while a majority of the electors can agree.

    With --rejoin the daemon of another node, stopped too, is brought over: what that one has promised and learnt in its
    own generation is dropped. With --generation, on every node, all daemons stopped, the fleet starts anew with the G
    that `zsched status` names; refused while it agrees, and where a good state would be lost.
    """
    is_anew, accepted = bool(generation or settle or force), tuple(accept or ())
    if rejoin + settle + (generation > 0) > 1 or (plan and is_anew):
        raise CliError(EXIT_USAGE, "give one of --rejoin, --generation G and --settle; the last two go without --plan")
    if (wanted and not rejoin) or (brought and (rejoin or is_anew)):
        raise CliError(EXIT_USAGE, "a GENERATION goes with --rejoin, and --from with neither it nor --generation")
    place, view = place_of(here), OrderView(door=Door(socket=Path()), is_plan=plan, is_yes=yes, accepted=accepted)
    if is_anew:
        create_state(place, generation, is_forced=force, is_settling=settle, accepted=accepted)
        return EXIT_OK
    return rejoin_side(place, view, wanted) if rejoin else begin_generation(place, view, tuple(brought or ()))
