"""Options that several verbs take: each is declared once, and a verb takes a whole set of them as one parameter.

Knows: their names, words and the environment that stands in for them. Does not know: any verb.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zsched.commands.base.common import Verb, Verbs
from zsched.core.values.exits import EXIT_OK

if TYPE_CHECKING:
    from zsched.commands.base.ask import Door
    from zsched.commands.base.change import OrderView
    from zsched.commands.base.places import Machine as Where
    from zsched.commands.base.places import Places

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", "-c", metavar="FILE", help="Fleet file. [ZSCHED_CONFIG, else /etc/zsched/fleet.yaml]"),
]
NameOption = Annotated[
    str | None,
    typer.Option("--node", "-n", metavar="NAME", help="This machine's name in it. [ZSCHED_NODE, else the host name]"),
]
StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state-dir", metavar="DIR", help="Durable state. [ZSCHED_STATE_DIR, else /var/lib/zsched; yours if not root]"
    ),
]
RuntimeOption = Annotated[
    Path | None,
    typer.Option("--runtime-dir", metavar="DIR", help="Operator sockets. [ZSCHED_RUNTIME_DIR, else /run/zsched]"),
]
AskedOption = Annotated[
    str | None,
    typer.Option("--node", "-n", metavar="NAME", help="Ask this node of the fleet, or CELL/NODE of another one."),
]
HereOption = Annotated[
    str | None, typer.Option("--node", "-n", metavar="NAME", help="Which daemon on this machine, if there are several.")
]
ConnectOption = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINT", help="No daemon here: ask at this node's control endpoint."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON, with its schema; --json=1: of that version.")]
PlanOption = Annotated[
    bool, typer.Option("--plan", "--dry-run", help="Only show what would change; exits with 10 if anything.")
]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask; off a terminal it takes this.")]
ReasonOption = Annotated[str, typer.Option("--reason", "-m", metavar="TEXT", help="Why; the history tells it.")]
RevisionOption = Annotated[
    int | None, typer.Option("--revision", min=0, metavar="N", help="Only if this is still the revision.")
]
AcceptOption = Annotated[
    list[str] | None, typer.Option("--accept", metavar="DANGER", help="Accept this danger; give it once for each.")
]
ForOption = Annotated[
    str | None, typer.Option("--for", metavar="DURATION", help="End it by itself: 90s, 10m, 2h, 1d. [until taken back]")
]
NoColorOption = Annotated[bool, typer.Option("--no-color", help="Plain text (also: NO_COLOR).")]
AgeOption = Annotated[str | None, typer.Option("--since", metavar="AGE", help="Not older: 90s, 10m, 2h, 1d.")]
TaskArgument = Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet file.")]
OutputOption = Annotated[Path | None, typer.Option("--output", "-o", metavar="FILE", help="Where to; else stdout.")]
PauseAfterOption = Annotated[
    int | None,
    typer.Option(
        "--pause-after",
        min=1,
        max=1000,
        metavar="N",
        help="Changed workers start on N candidates, and wait for `zsched task promote`.",
    ),
]


class Options:
    """A set of options: each annotated field is one. What a verb's first parameter is of."""

    connect: str | None = None
    json_: bool = False
    revision: int | None = None
    accept: list[str] | None = None
    """Of a set without such an option."""

    def __init__(self, given: dict[str, Any]) -> None:
        vars(self).update(given)

    @classmethod
    def parameters(cls) -> dict[str, inspect.Parameter]:
        """{field: it, as a parameter of a verb}; the fields of a base follow its own."""
        found: dict[str, Any] = {}
        for kind in cls.__mro__[:-1]:
            for name, hint in inspect.get_annotations(kind, eval_str=True).items():
                found.setdefault(name, hint)
        by_name = inspect.Parameter.KEYWORD_ONLY
        return {
            name: inspect.Parameter(name, by_name, default=getattr(cls, name), annotation=hint)
            for name, hint in found.items()
            if hasattr(hint, "__metadata__")
        }


class Local(Options):
    """Which daemon of this machine is asked."""

    node: HereOption = None
    runtime_dir: RuntimeOption = None

    def door(self) -> Door:
        """To that daemon. Raises `CliError`: there is none."""
        from zsched.commands.base.ask import find_door  # noqa: PLC0415 - each verb imports what it needs

        return find_door(self.runtime_dir, self.node, connect=self.connect)


class Asks(Local):
    """Which daemon is asked, anywhere."""

    node: AskedOption = None
    connect: ConnectOption = None


class Answers(Asks):
    """How its answer is shown, too."""

    json_: JsonOption = False


class Consents(Answers):
    """What every verb takes that changes something."""

    plan: PlanOption = False
    yes: YesOption = False
    reason: ReasonOption = ""

    def order(self, *words: str, for_: str | None = None, pause_after: int | None = None, **more: bool) -> OrderView:
        """The order, or the change of the document that ``words`` make; ``for_``: how long it holds.

        Raises:
            CliError: that is no time, or no daemon is there.
        """
        from zsched.commands.base.change import OrderView, check_said  # noqa: PLC0415 - as above
        from zsched.commands.base.page import duration_s  # noqa: PLC0415 - as above

        for_s = None if for_ is None else duration_s(for_)
        check_said(self.reason, for_s)
        return OrderView(
            door=self.door(),
            is_json=self.json_,
            is_yes=self.yes,
            is_plan=self.plan,
            reason=self.reason,
            revision=self.revision,
            for_s=for_s,
            accepted=tuple(self.accept or ()),
            words=words,
            pause_after=pause_after,
            **more,
        )


class Orders(Consents):
    """What an order takes that the fleet agrees."""

    revision: RevisionOption = None


class Changes(Orders):
    """What a change takes that may be dangerous."""

    accept: AcceptOption = None


class Edits(Changes):
    """The same where stdout is for something else."""

    json_: bool = False


class Files(Options):
    """Where this machine's files are."""

    config: ConfigOption = None
    state_dir: StateOption = None

    def places(self) -> Places:
        """The same, with what stands in for what is not given."""
        from zsched.commands.base.places import Places  # noqa: PLC0415 - as above
        from zsched.host import paths  # noqa: PLC0415 - as above

        return Places(
            config=paths.config_path(self.config, os.environ), state=paths.state_folder(self.state_dir, os.environ)
        )


class Here(Files):
    """Which node this machine is, too."""

    node: NameOption = None


class Machine(Here):
    """Where its daemon listens, too."""

    runtime_dir: RuntimeOption = None

    def machine(self) -> Where:
        """The same, by the options and the environment.

        Raises:
            CliError: the node's name is none, or several daemons run here and nothing says which is meant (2).
        """
        from zsched.commands.base.ask import name_here  # noqa: PLC0415 - as above
        from zsched.commands.base.here import own_name  # noqa: PLC0415 - as above
        from zsched.commands.base.places import Machine as Where  # noqa: PLC0415 - as above
        from zsched.host import paths  # noqa: PLC0415 - as above

        own_name(self.node)
        runtime = paths.asked_folder(self.runtime_dir, os.environ)
        return Where(
            file=paths.config_path(self.config, os.environ),
            state_folder=paths.asked_state_folder(self.state_dir, os.environ, runtime),
            runtime_folder=runtime,
            node=name_here(self.node, self.runtime_dir),
        )


class _Spread:
    """A verb as typer sees it: where its first parameter is a set of options, each of these is one of its own."""

    def __init__(self, verb: Callable[..., int | None]) -> None:
        functools.update_wrapper(self, verb)
        self._verb = verb
        self._set: tuple[str, type[Options]] | None = None
        """(that parameter's name, the set), once typer has looked."""

    @functools.cached_property
    def __signature__(self) -> inspect.Signature:
        """Made when typer asks for it: of one verb, where one is named."""
        whole = inspect.signature(self._verb, eval_str=True)
        first, *others = whole.parameters.values()
        kind = first.annotation
        if not (isinstance(kind, type) and issubclass(kind, Options)):
            return whole
        self._set = first.name, kind
        return whole.replace(parameters=[*others, *kind.parameters().values()])

    def __call__(self, **given: Any) -> None:
        """Run it; the code that it returns is the exit code."""
        if self._set is not None:
            name, kind = self._set
            given[name] = kind({option: given.pop(option) for option in kind.parameters()})
        raise typer.Exit(self._verb(**given) or EXIT_OK)


def command_of(name: str, verb: Callable[..., int | None] | typer.Typer) -> Any:
    """A function or a group as a command of that name."""
    if isinstance(verb, typer.Typer):
        return typer.main.get_command(verb)
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(name, cls=Verb)(_Spread(verb))
    return typer.main.get_command(app)


def new_group(name: str, about: str, verbs: dict[str, Callable[..., int | None]]) -> typer.Typer:
    """A verb with verbs below it, by their names; ``about``: what its help says."""
    group = typer.Typer(
        name=name, cls=Verbs, help=about, no_args_is_help=True, add_completion=False, rich_markup_mode=None
    )
    for below, verb in verbs.items():
        group.command(below, cls=Verb)(_Spread(verb))
    return group
