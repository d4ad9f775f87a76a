"""What every verb of the command line shares: how options are read, errors as text, output as JSON, when to use colour.

Knows: the contract (stdout is data, stderr everything else). Does not know: any verb.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final, TextIO

import typer
from typer.core import TyperCommand, TyperGroup

from zsched.core.values.errors import AdapterError, ConfigError, WireError, ZschedError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE
from zsched.core.values.words import A_NAME, MAX_ASKED, NAME
from zsched.host.latch import Latch
from zsched.host.screen import fitted

Json = dict[str, Any]
NAMED_OTHERWISE: Final = {
    "events": "event",
    **dict.fromkeys(("task.add", "task.remove", "task.promote", "node.add", "node.remove", "node.forget"), "apply"),
    **dict.fromkeys(("fleet.create", "join", "leave"), "member"),
    "tune": "tuning",
    **dict.fromkeys(("pin", "unpin", "pause", "resume"), "task"),
    "undrain": "drain",
}
OBEYED: Final = re.compile("[\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""What JSON leaves as it is and a terminal may obey: more controls, turns of the writing, halves of characters."""
SHARED: Final = {
    "Before a change": ("plan", "yes", "reason", "revision", "accept"),
    "Which daemon, which files": ("node", "connect", "runtime_dir", "config", "state_dir"),
}
"""{title in a verb's help: options that many verbs have}; all others are its own."""
LONGEST_SENTENCE: Final = 1000
"""Characters."""
USAGE_ERROR: Final = "Error: "
"""What typer writes in front of a complaint."""
ARGUMENT: Final = "argument"
"""As typer calls such a parameter."""
SCHEMAS: Final = Path(__file__).parents[2] / "schemas"
"""A JSON Schema per kind of output and major version."""
BECOME_A_NODE: Final = "make this machine a node: zsched fleet create NAME, or zsched join INVITATION"
"""Advice where the fleet file is missing."""


class CliError(ZschedError):
    """A verb cannot do what was asked: what failed, where, why, one thing to do; ends the command with ``code``."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


def plain_value(param: Any, value: Any) -> tuple[Any, ...]:
    """(``value`` as the verb wants it,) where that takes no coercion; ``()`` where it does, or where one is missing.

    Words, paths and what has its type already take none. ``param`` is typer's; one that does not tell its type is of a
    typer without pydantic, and takes one.
    """
    annotation = getattr(getattr(param, "type_descriptor", None), "annotation", None)
    if annotation is None or param.callback is not None or (param.required and param.value_is_missing(value)):
        return ()
    if annotation == list[str] and (value is None or isinstance(value, tuple)):
        return (list(value or ()),)
    if param.nargs != 1 or param.multiple or not isinstance(annotation, type):
        return ()
    if value is None or isinstance(value, annotation):
        return (value,)
    return (Path(value),) if annotation is Path else ()


def no_help_yet(option: Any) -> Any:
    """The option --help with a default that has its type: typer's own is ``None``, and ``None`` is coerced."""
    if option is not None:
        option.default = False
    return option


def of_known_major(ctx: Any, verb: Any, args: Sequence[str]) -> list[str]:
    """The arguments with ``--json=1`` as ``--json``, where that major version of the verb's schema is what it prints.

    Raises:
        CliError: it prints another one.
    """
    found = list(args)
    for at, word in enumerate(found):
        if word == "--":
            break
        if word.startswith("--json=") and any("--json" in param.opts for param in verb.params):
            found[at], wanted = "--json", word.partition("=")[2]
            schema = schema_of(ctx.command_path.split()[1:])
            majors = known_majors(schema)
            if wanted not in majors:
                raise CliError(EXIT_USAGE, f"{word}: {schema} has the major version {' and '.join(majors)}")
    return found


def schema_of(words: Sequence[str]) -> str:
    """The schema of a verb's JSON: a verb that prints a line for each of many is called by the many.

    Every verb that changes the document tells it as `zsched apply` does.

    >>> schema_of(["stream", "list"]), schema_of(["events"])
    ('zsched.stream.list', 'zsched.event')
    """
    name = ".".join(words)
    return f"zsched.{NAMED_OTHERWISE.get(name, name)}"


def known_majors(schema: str) -> list[str]:
    """The major versions of a schema, by its files."""
    files = SCHEMAS.glob(f"{schema}.*.json")
    return sorted(middle for file in files if (middle := file.name[len(schema) + 1 : -len(".json")]).isdigit())


def shown_argument(param: Any) -> str:
    """An argument in a line of usage: ``TASK``, ``[TASK]``, ``[NODE]...``."""
    name = str(param.metavar or param.name.upper())
    return name if param.required or name.startswith("[") else f"[{name}]"


class Verb(TyperCommand):
    """One verb of the command line."""

    def get_help_option(self, ctx: Any) -> Any:
        """As typer's."""
        return no_help_yet(super().get_help_option(ctx))

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Its arguments as they are declared: versions of typer put them into brackets in different ways."""
        arguments = (param for param in self.get_params(ctx) if param.param_type_name == ARGUMENT)
        return [self.options_metavar or "", *(shown_argument(param) for param in arguments)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Arguments and options; of an argument no type of Python's."""
        rows: dict[str, list[tuple[str, str]]] = {title: [] for title in ("Arguments", "Options", *SHARED)}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None and param.param_type_name == ARGUMENT:
                rows["Arguments"].append((shown_argument(param), record[1]))
            elif record is not None:
                rows[next((title for title, names in SHARED.items() if param.name in names), "Options")].append(record)
        for title, found in rows.items():
            if found:
                with formatter.section(title):
                    formatter.write_dl(found)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read its options and arguments, without pydantic if possible: its import takes as long as all of `status`.

        If one of them is no `plain_value`, or something is wrong, all go typer's own way.
        """
        args = of_known_major(ctx, self, args)
        try:
            return self._parsed(ctx, args)
        except Exception as error:
            _fit_usage(error)
            raise

    def _parsed(self, ctx: Any, args: list[str]) -> list[str]:
        opts, rest, _ = self.make_parser(ctx).parse_args(args=list(args))
        params = [param for param in self.get_params(ctx) if param.expose_value or opts.get(param.name)]
        found = {param.name: plain_value(param, param.consume_value(ctx, opts)[0]) for param in params}
        if rest or not all(found.values()):
            return super().parse_args(ctx, args)
        ctx.params.update({name: value for name, (value,) in found.items()})
        return rest


def _fit_usage(error: Any) -> None:
    """Let a complaint of typer's about a word fit the terminal, without pydantic's name for it."""
    if hasattr(error, "format_message"):
        text = fitted(f"{USAGE_ERROR}{error.format_message().replace('Value error, ', '')}", sys.stderr)
        error.format_message = lambda: text.removeprefix(USAGE_ERROR)


class Verbs(TyperGroup):
    """Turns the errors we raise on purpose into one message on stderr and an exit code; bugs keep their traceback."""

    def get_help_option(self, ctx: Any) -> Any:
        """As typer's."""
        return no_help_yet(super().get_help_option(ctx))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """All verbs below it."""
        self.write_verbs(ctx, formatter, "Commands", self.list_commands(ctx))

    def write_verbs(self, ctx: Any, formatter: Any, title: str, names: Iterable[str]) -> None:
        """Each with its whole first sentence, over several lines if need be: typer's own cuts it at the width."""
        commands: dict[str, Any] = {name: self.get_command(ctx, name) for name in names}
        with formatter.section(title):
            formatter.write_dl([(name, one.get_short_help_str(LONGEST_SENTENCE)) for name, one in commands.items()])

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except CliError as error:
            code, text = error.code, str(error)
        except ConfigError as error:
            code, text = EXIT_CONFIG, str(error)
        except AdapterError as error:
            code, text = EXIT_FAILED, str(error)
        except WireError as error:
            advice = "update the older of the two, zsched here or the daemon"
            code, text = EXIT_FAILED, f"a daemon's answer cannot be read ({error}); {advice}"
        except PermissionError as error:
            code, text = EXIT_FAILED, f"{error.filename}: {error.strerror}; run this by sudo, or from another folder"
        # a fleet file's faults start with its name, like a compiler's: nothing goes in front of them
        prefix = "" if code == EXIT_CONFIG else f"{ctx.command_path} {ctx.invoked_subcommand}: "
        warn(f"{prefix}{text}")
        raise typer.Exit(code)


def print_json(body: Mapping[str, Any], *, is_line: bool = False) -> None:
    """One JSON object on stdout: indented for people, or on one line (a stream of them is NDJSON)."""
    is_utf8 = (sys.stdout.encoding or "").lower().replace("-", "") in ("utf8", "")
    text = json.dumps(body, ensure_ascii=not is_utf8, indent=None if is_line else 2)
    sys.stdout.write(f"{harmless_json(text)}\n")
    sys.stdout.flush()


def harmless_json(text: str) -> str:
    """The JSON says the same, without what a terminal would obey."""
    return OBEYED.sub(lambda found: rf"\u{ord(found[0]):04x}", text)


def say(text: str, indent: int = 2) -> None:
    """Lines for people on stdout, without what a terminal would obey.

    On a terminal they wrap at its width, and go on at ``indent``; for a file or another program a line stays a line.
    """
    sys.stdout.write(f"{fitted(text, sys.stdout, indent)}\n")
    sys.stdout.flush()


def warn(text: str, indent: int = 2) -> None:
    """The same on stderr."""
    sys.stderr.write(f"{fitted(text, sys.stderr, indent)}\n")
    sys.stderr.flush()


class Away:
    """What a command that asks again and again says of a daemon that does not answer: once for each reason."""

    def __init__(self, verb: str, until: str = "") -> None:
        """``until``: how long it goes on, in words."""
        self._verb, self._until, self._told = verb, f" {until}".rstrip(), ""

    def tell(self, why: str) -> None:
        """The newest attempt failed for this reason; empty: it did not."""
        if why and why != self._told:
            warn(f"zsched {self._verb}: {why}; asking again{self._until}")
        self._told = why


def counted(number: int, plural: str) -> str:
    """A number and what it counts.

    >>> counted(1, "nodes"), counted(2, "nodes")
    ('1 node', '2 nodes')
    """
    return f"{number} {plural if number != 1 else plural.removesuffix('s')}"


def again(*more: str) -> str:
    """The command as it was given, with more words: to be copied."""
    return shlex.join(["zsched", *sys.argv[1:], *more])


def says_yes(question: str, stream: TextIO) -> bool:
    """Ask whoever sits at the terminal; anything but yes is no."""
    stream.write(f"{fitted(question, stream, 0)} [y/N] ")
    stream.flush()
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def check_name(name: str, where: str = "", advice: str = "") -> None:
    """Raise `CliError` (2) unless ``name``, given by ``where`` (``--node``), may be a node's, a task's or a fleet's."""
    if NAME.fullmatch(name) is None:
        said = f"{where}: {name!r} is not a name" if where else f"{name!r} is not a name"
        raise CliError(EXIT_USAGE, f"{said} ({A_NAME}){'; ' if advice else ''}{advice}")


def check_reason(reason: str) -> None:
    """Refuse a reason that no node would take, or that would not be one line of its journal.

    Raises:
        CliError: it is too long, or has a line end or a control character.
    """
    if len(reason) > MAX_ASKED:
        raise CliError(EXIT_USAGE, f"--reason: {len(reason)} characters, at most {MAX_ASKED}")
    if not reason.isprintable():
        raise CliError(EXIT_USAGE, "--reason: it has a line end or a control character; write one line of plain text")


def nearest(name: str, known: Sequence[str]) -> str:
    """How a refusal of ``name`` goes on: ``; did you mean ...?`` or, when nothing is near, what there is."""
    import difflib  # noqa: PLC0415 - only when something is wrong

    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; there are {', '.join(known) or 'none'}"


def check_known(status: Json, kind: str, *names: str | None) -> None:
    """Refuse tasks or nodes (``kind``) that the fleet has not, with the nearest one (`CliError`, 2)."""
    known = [str(one["name"]) for one in status[f"{kind}s"]]
    for name in names:
        if name is not None and name not in known:
            raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no {kind} {name!r}{nearest(name, known)}")


def check_dangers(accepted: Iterable[str], known: Sequence[str]) -> None:
    """Refuse an ``--accept`` that names none of the dangers which a verb knows.

    Raises:
        CliError: one is unknown.
    """
    for name in accepted:
        if name not in known:
            raise CliError(EXIT_USAGE, f"--accept: there is no danger {name!r}{nearest(name, known)}")


def check_taken(dangers: Iterable[tuple[str, str]], accepted: Iterable[str]) -> None:
    """Refuse where one of the dangers, each with what it means, is not accepted by its name.

    Raises:
        CliError: with the command that accepts it.
    """
    missing = [(name, means) for name, means in dangers if name not in accepted]
    if missing:
        names = [part for name in dict.fromkeys(name for name, _ in missing) for part in ("--accept", name)]
        lines = "\n".join(f"  {name}: {means}" for name, means in missing)
        raise CliError(EXIT_FAILED, f"nothing was changed; if this may be:\n{lines}\n{again(*names)}")


def confirm(question: str, *, is_sure: bool, can_ask: bool = True, stream: TextIO | None = None) -> None:
    """Let the operator decide who has not said --yes.

    Raises:
        CliError: off a terminal (2), or the answer is no (1).
    """
    if is_sure:
        return
    if not (can_ask and sys.stdin.isatty()):
        raise CliError(EXIT_USAGE, f"nothing was done, for nobody can be asked here; to do it:\n{again('--yes')}")
    sys.stdout.flush()
    if not says_yes(question, stream or sys.stderr):
        raise CliError(EXIT_FAILED, "nothing was done")


def told_task(status: Json, task: str) -> Json:
    """What a status tells of the task; empty: nothing."""
    return next((one for one in status["tasks"] if one["name"] == task), {})


def wants_color(is_refused: bool, env: Mapping[str, str] = os.environ) -> bool:
    """Colour only on a terminal, and not when ``--no-color``, ``NO_COLOR`` (no-color.org) or a dumb one says no."""
    return not is_refused and not env.get("NO_COLOR") and env.get("TERM") != "dumb" and sys.stdout.isatty()


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C, a terminal that closes and SIGTERM do nothing meanwhile.

    For files that belong together, which are written in a part of a second.
    """
    with _at_signals(dict.fromkeys(_ENDS, _too_late)):
        yield


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """They work as ever meanwhile: while somebody is asked, within `uninterrupted`."""
    with _at_signals({**dict.fromkeys(_ENDS, signal.SIG_DFL), signal.SIGINT: signal.default_int_handler}):
        yield


@contextlib.contextmanager
def ends_as_by_ctrl_c() -> Iterator[None]:
    """A terminal that closes and SIGTERM raise `KeyboardInterrupt` meanwhile: nothing stays as a step has made it."""
    with _at_signals(dict.fromkeys((signal.SIGTERM, signal.SIGHUP), signal.default_int_handler)):
        yield


@contextlib.contextmanager
def stopped_by_signal() -> Iterator[Latch]:
    """A latch that Ctrl-C, a terminal that closes and SIGTERM set meanwhile; none of them interrupts anything."""
    stop = Latch()
    with _at_signals(dict.fromkeys(_ENDS, lambda _number, _frame: stop.set())):
        yield stop


_ENDS: Final = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM)


def _too_late(_number: int, _frame: FrameType | None) -> None:
    """What is begun ends in a moment, and the verb says what it has made."""


@contextlib.contextmanager
def _at_signals(handlers: Mapping[signal.Signals, Any]) -> Iterator[None]:
    """Handle signals so meanwhile, but those that are ignored (`nohup`)."""
    if threading.current_thread() is not threading.main_thread():  # only that one may say what a signal does
        yield
        return
    ours = {number: handler for number, handler in handlers.items() if signal.getsignal(number) is not signal.SIG_IGN}
    before = {number: signal.signal(number, handler) for number, handler in ours.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
