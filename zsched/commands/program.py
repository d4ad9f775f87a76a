"""The program's verbs: its own, and those that other installed distributions bring.

A verb is a function with its options, and its module is imported when the verb is named, or for the help: `status` must
answer within 200 ms. For the same reason, what is installed is looked at only when a verb is not the program's own.

Knows: in which module a verb is, the entry point group `zsched.commands`, whose names are verbs and whose values are
typer apps. Does not know: any verb.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

import typer

from zsched.commands.base.common import CliError, Verb, Verbs
from zsched.commands.base.options import command_of
from zsched.core.values.exits import EXIT_FAILED, EXIT_USAGE

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = "zsched.commands"
NOUNS: Final = {
    "the fleet": {
        "status": "commands.look.status",
        "top": "tools.watch.screen",
        "web": "tools.watch.web",
        "record": "tools.watch.record",
        "history": "commands.look.history",
        "events": "commands.look.history",
        "wait": "commands.look.wait",
        "rehearse": "tools.rehearsal.verb",
        "fleet": "commands.members.fleet",
        "check": "commands.look.check",
        "apply": "commands.act.apply",
        "edit": "commands.members.fleet",
        "pki": "commands.members.pki",
    },
    "a task and its streams": {
        "task": "commands.act.entries",
        "new": "tools.example",
        "dev": "tools.dev.verb",
        "explain": "commands.look.explain",
        "move": "commands.act.move",
        **dict.fromkeys(("pin", "unpin", "pause", "resume"), "commands.act.hold"),
        "tune": "commands.act.tune",
        "restart": "commands.act.restart",
        "logs": "commands.look.logs",
        "stream": "tools.stream",
        "trace": "tools.watch.trace",
    },
    "a node": {
        "node": "commands.act.entries",
        **dict.fromkeys(("invite", "join"), "commands.members.membership"),
        "leave": "commands.members.leave",
        **dict.fromkeys(("drain", "undrain"), "commands.act.flags"),
        "ping": "commands.look.ping",
        "metrics": "tools.metrics",
    },
    "this machine": {
        "doctor": "tools.doctor.verb",
        "bugreport": "tools.bugreport",
        **dict.fromkeys(("install", "uninstall"), "tools.install"),
        "init": "commands.members.init",
        "up": "commands.up",
        "version": "commands.base.versions",
    },
}
"""{noun: {verb: the module of `zsched` that has a function, or a group, of its name}}, as the long help shows them."""
VERBS: Final = {verb: module for verbs in NOUNS.values() for verb, module in verbs.items()}
FRONT: Final = """\
Usage: zsched VERB [OPTIONS] [ARGUMENTS]...

start  dev           run a fleet and your task on this machine alone
       new           write a small task to begin with
       fleet create  make this machine the first one of a new fleet
       invite        write the file with which another machine joins
       join          make this machine a node, by such a file

look   status        nodes, tasks, owners, and what is wrong
       top           the same on the full screen, live
       explain       why a task is where it is, and what would move it
       history       every move: when, from where to where, why
       doctor        what is wrong, and what to do

act    move          hand a task over to a node now
       drain         empty a node
       pin           keep a task on a node
       pause         let nothing move a task

more   zsched --help-all has every verb, zsched VERB --help one with its options
e.g.   zsched dev --task worker.py                              run your program
       zsched invite edge2 --address 192.0.2.22 > edge2.invite  add a machine
       zsched drain edge1 -m "new fan"                          empty a machine
"""
"""What the help shows first: no more than a terminal of 80 columns and 24 lines."""
UNTOLD: Final = {"complete": "commands.completion"}
"""The same, of those that the help leaves out."""
LAB_VERBS: Final = frozenset({"bench", "demo"})
"""Verbs of the distribution ``zsched-lab``, which a robot has not."""
INSTEAD: Final = {
    "add": "zsched task add FILE, or zsched node add NAME",
    "list": "zsched status (nodes and tasks), or zsched stream list",
    "recover": "zsched fleet recover",
    "remove": "zsched node remove NODE, or zsched task remove TASK",
}
"""{a word that is no verb: what to write}: of other programs."""
DRASTIC: Final = frozenset({"init", "leave", "uninstall"})
"""Verbs that are proposed to nobody who has written something else."""


def installed_verbs() -> dict[str, EntryPoint]:
    """{verb: what brings it}, by name; of two of one name the first that is found."""
    from importlib.metadata import entry_points  # noqa: PLC0415 - it loads the whole of `email`

    found: dict[str, EntryPoint] = {}
    for point in entry_points(group=GROUP):
        found.setdefault(point.name, point)
    return dict(sorted(found.items()))


@cache
def _own(name: str) -> Any:
    module = import_module(f"zsched.{(VERBS | UNTOLD)[name]}")
    return command_of(name, getattr(module, name))


class OwnVerbs(Mapping[str, Any]):
    """{name: command} of the program's own verbs; each is made when it is looked up."""

    def __getitem__(self, name: str) -> Any:
        if name not in VERBS and name not in UNTOLD:
            raise KeyError(name)
        return _own(name)

    def __iter__(self) -> Iterator[str]:
        return iter(VERBS)

    def __len__(self) -> int:
        return len(VERBS)


class Program(Verbs):
    """The group of all verbs."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands: Any = OwnVerbs()

    def list_commands(self, ctx: Any) -> list[str]:
        """All verbs, for the help."""
        return [*super().list_commands(ctx), *(name for name in installed_verbs() if name not in VERBS)]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """A first screen; `zsched --help-all` is typer's help."""
        del ctx
        formatter.write(FRONT)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """All verbs, by the noun that they are about."""
        for noun, names in NOUNS.items():
            self.write_verbs(ctx, formatter, noun.capitalize(), names)
        if brought := [name for name in self.list_commands(ctx) if name not in VERBS]:
            self.write_verbs(ctx, formatter, "What other packages bring", brought)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """One verb.

        One that is none, whose distribution is not installed, or cannot be loaded, is a verb that says so.
        """
        own = super().get_command(ctx, cmd_name)
        if own is not None:
            return own
        point = installed_verbs().get(cmd_name)
        if point is None:
            if cmd_name in LAB_VERBS:
                return _refusing(cmd_name, "it comes with zsched-lab; in a checkout of zsched: pip install . ./lab")
            return _refusing(cmd_name, f"there is no such verb; {_instead(cmd_name, self.commands)}", EXIT_USAGE)
        try:
            command = typer.main.get_command(point.load())
        except Exception as error:  # noqa: BLE001 - another distribution's fault must not take the others' verbs along
            brought = point.value if point.dist is None else f"{point.value} of {point.dist.name} {point.dist.version}"
            return _refusing(cmd_name, f"{brought} cannot be loaded: {type(error).__name__}: {error}")
        command.name = cmd_name
        return command


def show_all(ctx: typer.Context, is_wanted: bool) -> None:
    """Typer's help of the program, if ``--help-all`` is given."""
    if is_wanted:
        formatter = ctx.make_formatter()
        Verbs.format_help(cast("Program", ctx.command), ctx, formatter)
        typer.echo(formatter.getvalue().rstrip())
        raise typer.Exit


def _instead(name: str, verbs: Mapping[str, Any]) -> str:
    """What to write in place of a word that is no verb."""
    import difflib  # noqa: PLC0415 - only when something is wrong

    near = difflib.get_close_matches(name, sorted({*verbs} - DRASTIC), n=1)
    told = INSTEAD.get(name) or "".join(f"zsched {verb}" for verb in near)
    return f"write {told}" if told else "`zsched --help-all` lists them"


def _refusing(name: str, text: str, code: int = EXIT_FAILED) -> Any:
    """A verb that does nothing but say why it cannot."""
    app = typer.Typer(rich_markup_mode=None)

    @app.command(name, cls=Verb, help=text, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
    def refuse() -> None:
        raise CliError(code, text)

    return typer.main.get_command(app)
