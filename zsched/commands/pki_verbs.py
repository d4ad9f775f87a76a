"""The verbs below `zsched pki`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.pki`, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from zsched.commands.options import AskedOption, ConfigOption, JsonOption, Options, RuntimeOption, new_group
from zsched.core.values.certificates import Role

if TYPE_CHECKING:
    from zsched.commands.pki import Where

AuthorityOption = Annotated[
    Path | None,
    typer.Option("--authority", metavar="DIR", help="Its folder. [ZSCHED_AUTHORITY, else below ~/.local/share/zsched]"),
]
RequestOption = Annotated[
    Path | None,
    typer.Option("--csr", metavar="FILE", help="A certificate request: the key stays where it was made."),
]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Where the files go. [./NAME]")]
LabelArgument = Annotated[str, typer.Argument(metavar="NAME", help="As `zsched pki show` names it: robot1, robot1.k2.")]


class Authority(Options):
    """Which authority is meant, and of which fleet."""

    config: ConfigOption = None
    authority: AuthorityOption = None

    def where(self) -> Where:
        """The same, as `zsched.commands.pki` takes it."""
        from zsched.commands.pki import Where  # noqa: PLC0415 - each verb imports what it needs

        return Where(config=self.config, authority=self.authority)


def init(
    where: Authority,
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Lock its key. [ZSCHED_AUTHORITY_PASSPHRASE, else it asks]")
    ] = False,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="DANGER", help="second-authority: the fleet's own is lost for good."),
    ] = None,
) -> None:
    """Make the fleet's authority: a key that signs certificates, on this machine only.

    Refused where this machine trusts an authority already: that one is on another machine, and signs for the fleet.
    """
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(pki.init(where.where(), asks_passphrase=passphrase, accepted=accept or ()))


def issue(
    where: Authority,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A node of the fleet file, or a person or tool.")],
    role: Annotated[Role, typer.Option("--role", help="What NAME is.")] = Role.NODE,
    csr: RequestOption = None,
    out: OutOption = None,
) -> None:
    """Make the key and the first certificate of a node, an operator or a guest; it lasts 30 days.

    Nodes may do what zsched does. An operator may also give commands from a machine that is no node. A guest reads
    status and streams.
    """
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(pki.issue(where.where(), name, role, csr, out))


def show(
    where: Authority,
    json_: JsonOption = False,
) -> None:
    """List every key that was certified: until when, and whether it is due, revoked or ended."""
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(pki.show(where.where(), is_json=json_))


def renew(
    where: Authority,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Only this one. [all that are due]")] = None,
    csr: RequestOption = None,
    out: OutOption = None,
    deliver: Annotated[
        bool, typer.Option("--deliver", help="Send each node its newest one, through the daemon here; no files.")
    ] = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Make new certificates for keys that have one. A certificate is due after two thirds of its life.

    With --deliver the nodes take them by themselves; the timer zsched-renew does that every day.
    """
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    if deliver:
        from zsched.commands.ask import find_door  # noqa: PLC0415 - as above
        from zsched.commands.common import CliError  # noqa: PLC0415 - as above
        from zsched.exits import EXIT_USAGE  # noqa: PLC0415 - as above

        if csr is not None or out is not None:
            raise CliError(EXIT_USAGE, "--csr and --out go without --deliver")
        raise typer.Exit(pki.deliver(where.where(), find_door(runtime_dir, node), name))
    raise typer.Exit(pki.renew(where.where(), name, csr, out))


def revoke(where: Authority, name: LabelArgument) -> None:
    """Never certify a key again, and say which line of the fleet file keeps it out."""
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(pki.revoke(where.where(), name))


def rotate(
    where: Authority,
    finish: Annotated[bool, typer.Option("--finish", help="Stop trusting the former authority.")] = False,
) -> None:
    """Begin with a new authority. Both are trusted until --finish, which waits for every certificate to be renewed."""
    from zsched.commands import pki  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(pki.rotate(where.where(), is_end=finish))


GROUP = new_group(
    "pki",
    "The fleet's authority and its certificates.",
    {"init": init, "issue": issue, "show": show, "renew": renew, "revoke": revoke, "rotate": rotate},
)
