"""What every verb of the command line shares: exit codes, errors as text, output as JSON, when to use colour.

Knows: the contract (stdout is data, stderr everything else). Does not know: any verb.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from zsched.commands.page import harmless
from zsched.errors import AdapterError, ConfigError, ZschedError

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE, EXIT_DEGRADED, EXIT_TIMED_OUT, EXIT_CONFIG = 0, 1, 2, 3, 4, 5, 78

Json = dict[str, Any]


class CliError(ZschedError):
    """A verb cannot do what was asked: what failed, where, why, one thing to do; ends the command with ``code``."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


class PlainValue:
    """Reads one option's text without pydantic, whose import takes longer than all the rest of `zsched status`.

    A value that has its type already, words and a path need no coercion; all others still go typer's own way.
    """

    def __init__(self, param: Any) -> None:
        self._annotation = param.type_descriptor.annotation

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """The value as the verb wants it, as typer's own coercion does it."""
        annotation = self._annotation
        if annotation == list[str] and (value is None or isinstance(value, tuple)):
            return list(value or ())
        if param.nargs == 1 and not param.multiple and isinstance(annotation, type):
            if value is None or isinstance(value, annotation):
                return value
            if annotation is Path:
                return Path(value)
        param._runtime_param = None  # noqa: SLF001 - makes typer build its own
        return param.get_runtime_param().coerce(value, param=param, ctx=ctx)


def _read_plainly(params: list[Any]) -> list[Any]:
    """Give each parameter a `PlainValue`, where this typer has that seam (a test tells when it has not)."""
    for param in params:
        if getattr(param, "_runtime_param", 0) is None and hasattr(param, "type_descriptor"):
            param._runtime_param = PlainValue(param)  # noqa: SLF001 - typer has no public seam for it
    return params


class Verb(TyperCommand):
    """One verb of the command line."""

    def get_params(self, ctx: Any) -> Any:
        """Its options and arguments."""
        return _read_plainly(super().get_params(ctx))


class Verbs(TyperGroup):
    """Turns the errors we raise on purpose into one message on stderr and an exit code; bugs keep their traceback."""

    def get_params(self, ctx: Any) -> Any:
        """The options in front of a verb."""
        return _read_plainly(super().get_params(ctx))

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
        # a fleet file's faults start with its name, like a compiler's: nothing goes in front of them
        prefix = "" if code == EXIT_CONFIG else f"{ctx.command_path} {ctx.invoked_subcommand}: "
        typer.echo(f"{prefix}{harmless(text)}", err=True)
        raise typer.Exit(code)


def print_json(body: Mapping[str, Any], *, is_line: bool = False) -> None:
    """One JSON object on stdout: indented for people, or on one line (a stream of them is NDJSON)."""
    text = json.dumps(body, ensure_ascii=False, indent=None if is_line else 2)
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def nearest(name: str, known: Sequence[str]) -> str:
    """How a refusal of ``name`` goes on: ``; did you mean ...?`` or, when nothing is near, what there is."""
    import difflib  # noqa: PLC0415 - only when something is wrong

    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; there are {', '.join(known) or 'none'}"


def wants_color(is_refused: bool, env: Mapping[str, str] = os.environ) -> bool:
    """Colour only on a terminal, and not when ``--no-color``, ``NO_COLOR`` (no-color.org) or a dumb one says no."""
    return not is_refused and not env.get("NO_COLOR") and env.get("TERM") != "dumb" and sys.stdout.isatty()
