"""The program's verbs: its own, and those that other installed distributions bring.

A verb is a function with its options, and its module is imported when the verb is named, or for the help: `status` must
answer within 200 ms. For the same reason, what is installed is looked at only when a verb is not the program's own.

Knows: in which module a verb is, the entry point group `zsched.commands`, whose names are verbs and whose values are
typer apps. Does not know: any verb.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from zsched.commands.base.common import CliError, Verb, Verbs
from zsched.commands.base.options import command_of
from zsched.core.values.exits import EXIT_FAILED, EXIT_USAGE

if TYPE_CHECKING:
    from collections.abc import Iterable
    from importlib.metadata import EntryPoint

GROUP: Final = "zsched.commands"
VERBS: Final = {
    "up": "commands.up",
    "init": "commands.members.init",
    "new": "tools.example",
    "dev": "tools.dev.verb",
    "status": "commands.look.status",
    "top": "tools.watch.screen",
    "web": "tools.watch.web",
    "record": "tools.watch.record",
    "trace": "tools.watch.trace",
    "explain": "commands.look.explain",
    "history": "commands.look.history",
    "events": "commands.look.history",
    "move": "commands.act.move",
    **dict.fromkeys(("pin", "unpin", "pause", "resume"), "commands.act.hold"),
    "tune": "commands.act.tune",
    "restart": "commands.act.restart",
    **dict.fromkeys(("drain", "undrain"), "commands.act.flags"),
    **dict.fromkeys(("invite", "join"), "commands.members.membership"),
    "leave": "commands.members.leave",
    "rehearse": "tools.rehearsal.verb",
    "doctor": "tools.doctor.verb",
    "ping": "commands.look.ping",
    "bugreport": "tools.bugreport",
    "wait": "commands.look.wait",
    "logs": "commands.look.logs",
    "check": "commands.look.check",
    "apply": "commands.act.apply",
    "edit": "commands.members.fleet",
    "version": "commands.base.versions",
    **dict.fromkeys(("install", "uninstall"), "tools.install"),
    "stream": "tools.stream",
    "fleet": "commands.members.fleet",
    **dict.fromkeys(("task", "node"), "commands.act.entries"),
    "pki": "commands.members.pki",
    "metrics": "tools.metrics",
}
"""{verb: the module of `zsched` that has a function, or a group, of its name}, in the order of the help."""
UNTOLD: Final = {"complete": "commands.completion"}
"""The same, of those that the help leaves out."""
LAB_VERBS: Final = frozenset({"bench", "demo"})
"""Verbs of the distribution ``zsched-lab``, which a robot has not."""
INSTEAD: Final = {
    "add": "zsched task add FILE, or zsched node add NAME",
    "list": "zsched status (nodes and tasks), or zsched stream list",
    "weights": "zsched tune TASK cpu=0.6 memory=0.4 network=0",
    "retry": "zsched restart TASK NODE",
    **dict.fromkeys(("completion", "man"), "zsched install, which brings it"),
    "eligible": "zsched drain NODE --only new, or zsched undrain NODE",
    "replay": "zsched explain --replay FILE",
    "site": "zsched status --site",
    "recover": "zsched fleet recover",
    "rejoin": "zsched fleet recover --rejoin",
    "init --generation": "zsched fleet recover --generation G",
    "init --settle": "zsched fleet recover --settle",
    "init --example": "zsched new KIND [DIR]",
    "maint": "zsched status, which tells every order",
    "remove": "zsched node remove NODE, or zsched task remove TASK",
}
"""{words that are no verb, or none any more: what to write}: of other programs, and of older ones."""
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


def _told(name: str) -> str:
    """The first sentence of a verb's help, out of its source: to import all of them takes half a second, and zenoh."""
    spec = find_spec(f"zsched.{VERBS[name]}")
    assert spec is not None
    assert spec.origin is not None
    for node in ast.parse(Path(spec.origin).read_bytes()).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            first = (ast.get_docstring(node) or "").partition("\n\n")[0]
            return " ".join(f"{first} ".partition(". ")[0].split()).removesuffix(".") + "."
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name and isinstance(node.value, ast.Call):
            return str(ast.literal_eval(node.value.args[1]))
    raise AssertionError(name)


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
        del ctx
        return [*VERBS, *(name for name in installed_verbs() if name not in VERBS)]

    def told_briefly(self, ctx: Any, name: str) -> str:
        """As of any group; of a verb of the program it is read, and the verb not made."""
        return _told(name) if name in VERBS else super().told_briefly(ctx, name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As typer's; a verb that had an option says what is written in its place."""
        given = {word.partition("=")[0] for word in args[1:]}
        for words, told in INSTEAD.items():
            verb, _, option = words.partition(" ")
            if option in given and args[0] == verb:
                return verb, _refusing(verb, f"it has no {option}; write {told}", EXIT_USAGE), args[1:]
        return super().resolve_command(ctx, args)

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


def _instead(name: str, verbs: Iterable[str]) -> str:
    """What to write in place of a word that is no verb."""
    import difflib  # noqa: PLC0415 - only when something is wrong

    near = difflib.get_close_matches(name, sorted({*verbs} - DRASTIC), n=1)
    told = INSTEAD.get(name) or "".join(f"zsched {verb}" for verb in near)
    return f"write {told}" if told else "`zsched --help` lists them"


def _refusing(name: str, text: str, code: int = EXIT_FAILED) -> Any:
    """A verb that does nothing but say why it cannot."""
    app = typer.Typer(rich_markup_mode=None)

    @app.command(name, cls=Verb, help=text, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
    def refuse() -> None:
        raise CliError(code, text)

    return typer.main.get_command(app)
