"""The verbs by which machines come and go: `fleet create`, `fleet recover`, `invite`, `join`, `leave`.

Knows: options. Does not know: how anything is done (`zsched.commands.membership`, imported by
the verb that runs).
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands import fleet_verbs as fleet
from zsched.commands.common import CliError
from zsched.commands.options import (
    AcceptOption,
    Edits,
    Files,
    Here,
    JsonOption,
    OutputOption,
    PlanOption,
    ReasonOption,
    RuntimeOption,
    YesOption,
    new_group,
)
from zsched.exits import EXIT_USAGE


class Kind(StrEnum):
    """What a machine is."""

    ROBOT = "robot"
    EDGE = "edge"


class Profile(StrEnum):
    """The clocks of the protocol."""

    WIRED = "wired"
    WIFI = "wifi"
    WAN = "wan"


AddressHelp = "HOST or HOST:PORT of its control session; its data session has the next port."


def create(
    here: Here,
    name: Annotated[str, typer.Argument(metavar="NAME", help="The new fleet's name.")],
    kind: Annotated[
        Kind, typer.Option("--kind", "--role", help="A robot votes and has streams; an edge only works.")
    ] = Kind.ROBOT,
    address: Annotated[str | None, typer.Option("--address", metavar="ADDRESS", help=f"{AddressHelp} [found]")] = None,
    timing: Annotated[Profile, typer.Option("--timing", help="The clocks of the protocol.")] = Profile.WIFI,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Without certificates: whoever reaches the network changes everything.")
    ] = False,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="DIR", help="Where the fleet's authority goes. [as of zsched pki]"),
    ] = None,
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Lock its key. [ZSCHED_AUTHORITY_PASSPHRASE, else it asks]")
    ] = False,
    accept: AcceptOption = None,
    plan: PlanOption = False,
    json_: JsonOption = False,
) -> None:
    """Make this machine the first one of a new fleet: writes its fleet file, state, authority and certificate.

    Refused where a fleet file or a state is. A fleet of one works; `zsched invite` brings the next machine.
    """
    from zsched import paths  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.membership import CreateView, create  # noqa: PLC0415 - as above
    from zsched.core.values.model import NodeKind  # noqa: PLC0415 - as above

    view = CreateView(
        fleet=name,
        node=paths.node_name(here.node, os.environ),
        kind=NodeKind(kind.value),
        timing=timing.value,
        address=address,
        places=here.places(),
        is_secured=not insecure,
        authority=authority,
        asks_passphrase=passphrase,
        accepted=tuple(accept or ()),
        is_plan=plan,
        is_json=json_,
    )
    raise typer.Exit(create(view))


def invite(
    said: Edits,
    name: Annotated[str, typer.Argument(metavar="NAME", help="The new machine's name in the fleet.")],
    kind: Annotated[
        Kind | None,
        typer.Option("--kind", "--role", help="A robot votes and has streams; an edge only works. [robot]"),
    ] = None,
    address: Annotated[
        str | None, typer.Option("--address", metavar="ADDRESS", help=f"{AddressHelp} [nobody dials it]")
    ] = None,
    candidate_for: Annotated[
        list[str] | None,
        typer.Option("--candidate-for", metavar="TASK", help="It may own this task; give it once for each."),
    ] = None,
    output: OutputOption = None,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="DIR", help="In a secured fleet: who signs. [as of zsched pki]"),
    ] = None,
    csr: Annotated[
        Path | None,
        typer.Option("--csr", metavar="FILE", help="In a secured fleet: its request; its key stays where it was made."),
    ] = None,
) -> None:
    """Add a machine to the fleet, and write the file with which it joins (`zsched join`).

    In a secured fleet the file holds the machine's certificate, and its key unless --csr is given, where this machine
    has the authority.
    For a node that was never there it is written once more, with another key: the former one is revoked.
    """
    from zsched.commands.membership import Guest  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.membership import invite as bring  # noqa: PLC0415 - as above
    from zsched.core.values.model import NodeKind  # noqa: PLC0415 - as above

    guest = Guest(
        name=name,
        kind=None if kind is None else NodeKind(kind.value),
        address=address,
        tasks=tuple(candidate_for or ()),
        authority=authority,
        request=csr,
    )
    raise typer.Exit(bring(said.order("invite", name, is_data=True), guest, output))


def join(
    here: Files,
    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="What `zsched invite` wrote; -: stdin.")] = None,
    request: Annotated[
        str | None,
        typer.Option("--request", metavar="NAME", help="Before: make a key here, and NAME.csr for `zsched invite`."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="With --request: where it goes. [./NAME.csr]")
    ] = None,
    plan: PlanOption = False,
    json_: JsonOption = False,
) -> None:
    """Make this machine the node that an invitation names: writes its fleet file, state and certificate.

    With --request the machine makes its key by itself, and no key travels.
    Nothing of another fleet is touched: it is refused. Start the daemon then; it votes as soon as it hears the others.
    """
    from zsched.commands import membership  # noqa: PLC0415 - each verb imports what it needs

    if (file is None) == (request is None):
        raise CliError(EXIT_USAGE, "give the invitation's file, or --request NAME before you have one")
    if request is not None:
        if plan:
            raise CliError(EXIT_USAGE, "--plan goes with an invitation: --request writes a key and a request only")
        raise typer.Exit(membership.request(request, here.places(), output, is_json=json_))
    assert file is not None
    if output is not None:
        raise CliError(EXIT_USAGE, "--output goes with --request")
    raise typer.Exit(membership.join(file, here.places(), is_plan=plan, is_json=json_))


def leave(
    here: Files,
    purge: Annotated[
        bool,
        typer.Option("--purge", help="Delete this machine's files of the fleet, its key too; else they are renamed."),
    ] = False,
    deadline: Annotated[
        str, typer.Option("--deadline", metavar="DURATION", help="How long to wait in all: 90s, 10m, 2h.")
    ] = "10m",
    accept: AcceptOption = None,
    reason: ReasonOption = "",
    plan: PlanOption = False,
    yes: YesOption = False,
    json_: JsonOption = False,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Take this machine out of its fleet: its tasks move away, its seat among the electors too, and its daemon ends.

    Nothing of the others' streams is lost; in a secured fleet they pause while the daemons begin again. Exits with 5 at
    the deadline: the leave stays in force, and the same command goes on with it; `zsched undrain NODE` takes it back.
    Another machine is taken out by `zsched node forget`.
    """
    from zsched.commands.history import duration_s  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.leave import LeaveOrder  # noqa: PLC0415 - as above
    from zsched.commands.leave import leave as go  # noqa: PLC0415 - as above

    order = LeaveOrder(
        places=here.places(),
        runtime_dir=runtime_dir,
        is_purged=purge,
        deadline_s=duration_s(deadline),
        accepted=tuple(accept or ()),
        reason=reason,
        is_plan=plan,
        is_yes=yes,
        is_json=json_,
    )
    raise typer.Exit(go(order))


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
) -> None:
    """Begin a new generation on one survivor when a majority of the electors is lost for good.

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
    from zsched.commands import init, recover  # noqa: PLC0415 - each verb imports what it needs

    place, manner = init.place_of(here), recover.Manner(is_plan=plan, is_sure=yes, accepted=accepted)
    if is_anew:
        init.create_state(place, generation, is_forced=force, is_settling=settle, accepted=accepted)
    elif rejoin:
        raise typer.Exit(recover.rejoin(place, manner, wanted))
    else:
        raise typer.Exit(recover.recover(place, manner, tuple(brought or ())))


FLEET = new_group(
    "fleet",
    "The document that all nodes of the fleet go by.",
    {"show": fleet.show, "export": fleet.export, "create": create, "recover": recover_fleet},
)
